"""The parts of a run that the panels show and set, described by what the panels read of them.

Training makes these parts, and the viewer imports nothing of it.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager
from torch import Tensor

from sadgs_ns.method.running_strategy import RunningStrategy
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.render.types import Cameras as Pinholes
from sadgs_ns.render.types import RenderOptions

GaussiansReference = weakref.ref[Tensor]
"""The Gaussians of one time of a run, until densification replaces them."""
Progress = Callable[[range], Iterable[int]]
"""Gets the numbers of the training views, yields them one after another, and shows how far it is."""


class Plan(Protocol):
    """The plan of a run. It is a dataclass, of which `dataclasses.replace` makes another."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def strategy(self) -> StructureAwareStrategy:
        """Densification with the run's windows, thresholds and cap."""
        ...


class Model(Protocol):
    """The model of a run, with N Gaussians."""

    @property
    def gauss_params(self) -> torch.nn.ParameterDict:
        """Raw parameters by name: means [N, 3], quats [N, 4], log scales [N, 3], logit opacities [N, 1] and colours."""
        ...

    @property
    def num_points(self) -> int:
        """Number of Gaussians, N."""
        ...

    @property
    def step(self) -> int:
        """Number of the present iteration."""
        ...

    @property
    def plan(self) -> Plan:
        """The plan that `follow` replaces."""
        ...

    @property
    def strategy(self) -> RunningStrategy:
        """Densification, which follows the plan's."""
        ...

    @property
    def strategy_state(self) -> dict[str, Any]:
        """State of the strategy: statistics of the Gaussians, counts of structure steps and the scene's extent."""
        ...

    @property
    def drawing(self) -> RenderOptions:
        """How all pictures of the Gaussians are drawn."""
        ...

    def follow(self, plan: Any) -> None:
        """From now on, train and draw according to a plan of the kind of `plan`."""
        ...

    def pinhole(self, camera: Cameras) -> Pinholes:
        """Return nerfstudio's camera, shape [1], as the rasterizer takes it."""
        ...

    def cropped(self, values: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
        """Return the rows of tensors [N, …] of the Gaussians inside the viewer's crop box."""
        ...

    def get_outputs(self, camera: Cameras, chosen: Tensor | None = None) -> Mapping[str, Any]:
        """Render one camera, shape [1], with the chosen Gaussians, bool [N]; `rgb` is in [0, 1]. [H, W, 3]"""
        ...


class StructureTensors(Protocol):
    """The structure tensors S̄ of the training views."""

    @property
    def frequency_constant(self) -> float:
        """The constant c of ω_l = c / σ_l."""
        ...

    @property
    def filled(self) -> bool:
        """Whether `fill` was called."""
        ...

    def fill(self) -> None:
        """Load the photos, and compute S̄ of those for which there is room."""
        ...

    def photo(self, data: Mapping[str, Any], /) -> Tensor:
        """Return an image of the datamanager as the loss sees it. [H, W, 3]"""
        ...

    def __getitem__(self, index: int) -> Tensor:
        """Quantized S̄ of a view. uint8 [H, W, 3]"""
        ...


@dataclass(frozen=True)
class ShownRun:
    """The parts of a run for its panels.

    A panel is a module, and a model that a module keeps becomes a part of it. So panels keep this instead.
    """

    model: Model
    datamanager: FullImageDatamanager
    structure_tensors: StructureTensors
    view_cameras: Callable[[], list[Pinholes]]
    """Returns the camera of each training view, with the present pose."""
    observe: Callable[[Progress], dict[str, Tensor]]
    """Observes η of the present Gaussians once in each training view, and returns the sums of `method.statistics`."""
    warn: Callable[[str], None]
    """Prints a warning for the user."""

    def present_gaussians(self) -> GaussiansReference:
        """Return a reference to the model's Gaussians, which `are_present` takes later."""
        return weakref.ref(self.model.gauss_params["means"])

    def are_present(self, gaussians: GaussiansReference | None) -> bool:
        """Tell whether the model still has these Gaussians; None is none.

        Densification replaces the parameters. Their number tells less, since it may stay.
        """
        return gaussians is not None and gaussians() is self.model.gauss_params["means"]
