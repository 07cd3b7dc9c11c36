"""The viewer's panel for cleaning: it previews what `sadgs-export` removes, and prints the options for that."""

from __future__ import annotations

from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.viewer.viewer_elements import ViewerControl, ViewerDropdown, ViewerSlider, ViewerVec3
from torch import Tensor

from sadgs_ns.errors import InputError, reason
from sadgs_ns.geometry.cleaning import Cleaning, Visibility, choose_remaining, measure_visibility
from sadgs_ns.viewer.cleaning_text import check_options, removal_sentences
from sadgs_ns.viewer.elements import ViewerMarkdown, show_output
from sadgs_ns.viewer.shown_run import GaussiansReference, ShownRun

OUTPUT = "cleaned"  # Name of the panel's picture among the viewer's output types

# Choices of the preview
OFF = "off"
STAYS = "what stays"
GOES = "what goes"

# Corners of the box before anybody moves them, in world units; this box crops nothing.
LOWEST_CORNER = (-100.0, -100.0, -100.0)
HIGHEST_CORNER = (100.0, 100.0, 100.0)


class CleaningPanel(torch.nn.Module):
    """The panel's elements and picture. It is a module because the viewer looks for elements in modules only.

    The viewer shows the elements in the alphabetical order of their attributes.
    """

    def __init__(self, run: ShownRun) -> None:
        super().__init__()
        self._run = run
        self._visibility: Visibility | None = None
        self._measured_at: tuple[int, int] | None = None  # Number of Gaussians and iteration of `_visibility`
        self._stays = torch.ones(0, dtype=torch.bool)  # Which Gaussians stay. [N]
        self._gaussians: GaussiansReference | None = None  # Those that `_stays` is of
        self._shown = OFF
        self._text = ""
        self.choice = ViewerDropdown(
            "Preview",
            OFF,
            [OFF, STAYS, GOES],
            cb_hook=self._on_change,
            hint="What the output type “cleaned” shows",
        )
        self.crop_from = ViewerVec3(
            "crop from", LOWEST_CORNER, cb_hook=self._on_change, hint="Lowest x, y and z that stay"
        )
        self.crop_to = ViewerVec3(
            "crop to", HIGHEST_CORNER, cb_hook=self._on_change, hint="Highest x, y and z that stay"
        )
        self.dust = self._slider("dust", 20.0, 0.1, "Pixels that a Gaussian must make up in some training view")
        self.max_extent = self._slider("max extent", 2.0, 0.01, "Longest standard deviation that stays; 0 is no limit")
        num_views = len(run.datamanager.train_dataset)
        self.min_views = self._slider("min views", num_views, 1, "Training views that must see a Gaussian")
        self.text = ViewerMarkdown("taken away", lambda: self._text)
        self.viewer = ViewerControl()

    def _slider(self, name: str, largest: float, step: float, hint: str) -> ViewerSlider[Any]:
        """Make a slider that starts at 0, its least value."""
        zero = type(largest)(0)  # A slider of whole numbers must start at a whole one.
        return ViewerSlider(name, zero, zero, largest, step, cb_hook=self._on_change, hint=hint)

    @property
    def cleaning(self) -> Cleaning:
        """The elements' values; raises InputError if the box is reversed."""
        low = tuple(self.crop_from.value)
        high = tuple(self.crop_to.value)
        crop = None
        if (low, high) != (LOWEST_CORNER, HIGHEST_CORNER):
            crop = (*low, *high)
        cleaning = Cleaning(
            min_views=int(self.min_views.value),
            max_extent=self.max_extent.value or None,  # The slider's 0 is no limit.
            crop=crop,
            dust=self.dust.value,
        )
        check_options(cleaning)
        return cleaning

    def _on_change(self, _: Any) -> None:
        """Refresh, and show any error in the panel; viser swallows exceptions of callbacks."""
        try:
            self.refresh()
        except (RuntimeError, ValueError) as error:  # Memory is full, the box is reversed, or photos went away.
            self._show_text(f"The picture stays as it was: {reason(error)}.")
            self._run.warn(self._text)
            return
        if self._shown == OFF:
            show_output(self.viewer, "rgb")
        else:
            show_output(self.viewer, OUTPUT)

    def refresh(self) -> None:
        """Find which Gaussians stay, and show how many; raises InputError if the box is reversed."""
        cleaning = self.cleaning
        if cleaning.needs_views:
            self._measure_visibility()
        gaussians = self._run.present_gaussians()
        params = dict(self._run.model.gauss_params.items())
        remaining = choose_remaining(params, cleaning, self._visibility)
        stays = remaining.stays
        self._stays = stays
        self._gaussians = gaussians
        self._shown = self.choice.value
        sentences = removal_sentences(cleaning, remaining)
        sentences.append(f"{int(stays.sum()):,} of {len(stays):,} Gaussians would stay.")
        options = command_line_options(cleaning)
        if options:
            sentences.append(f"`sadgs-export RUN --output splat.ply {options}` does this.")
        self._show_text("\n\n".join(sentences))

    def _measure_visibility(self) -> None:
        """Measure how the training views see the Gaussians, if training has changed them since the last time."""
        model = self._run.model
        state_of_training = (model.num_points, model.step)
        if self._measured_at == state_of_training:
            return
        self._show_text("Looking from all training views …")
        params = dict(model.gauss_params.items())
        cameras = [(view.viewmats[0], view.Ks[0], view.width, view.height) for view in self._run.view_cameras()]
        self._visibility = measure_visibility(params, cameras, model.drawing)
        self._measured_at = state_of_training

    def _show_text(self, text: str) -> None:
        self._text = text
        self.text.refresh()

    def _is_outdated(self) -> bool:
        """Tell whether `_stays` is of other Gaussians than the model's."""
        if not self._run.are_present(self._gaussians):
            return True
        return len(self._stays) != self._run.model.num_points

    def outputs(self, camera: Cameras, rendered: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return `cleaned`, a picture of the Gaussians that stay or go. [H, W, 3] in [0, 1]

        It is `rgb` if the preview is off, and after densification, which changes the Gaussians.
        """
        model = self._run.model
        if self._shown == OFF or self._is_outdated():
            return {OUTPUT: rendered["rgb"]}
        if self._shown == STAYS:
            chosen = self._stays
        else:
            chosen = ~self._stays
        try:
            drawn = model.get_outputs(camera, chosen)
        except InputError:  # The camera is no pinhole: `rgb` shows nothing, and the model has warned of it.
            return {OUTPUT: rendered["rgb"]}
        return {OUTPUT: drawn["rgb"]}


def command_line_options(cleaning: Cleaning) -> str:
    """Return the options of `sadgs-export` for the same cleaning, or "" for none."""
    options = []
    if cleaning.min_views:
        options.append(f"--min-views {cleaning.min_views}")
    if cleaning.max_extent is not None:
        options.append(f"--max-extent {cleaning.max_extent:g}")
    if cleaning.crop is not None:
        corners = " ".join(f"{value:g}" for value in cleaning.crop)
        options.append(f"--crop {corners}")
    if cleaning.dust:
        options.append(f"--dust {cleaning.dust:g}")
    return " ".join(options)
