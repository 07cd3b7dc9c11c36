"""Training steps of few Gaussians as CUDA graphs: one call on the host launches all kernels of a step.

On a small scene the host takes longer to launch a step than the GPU to run it. A graph repeats launches with the
arguments with which they were captured. So cameras, images, masks and Adam's rates are copied, before each step, into
tensors that keep their addresses. All else that a step depends on is part of its graph's key. Densification drops all
graphs.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sadgs_ns.errors import reason
from sadgs_ns.render.types import Cameras
from sadgs_ns.training.model import SadgsModel
from sadgs_ns.training.run.progress import warn
from sadgs_ns.training.step.images import stack_masks
from sadgs_ns.training.step.optimizers import AdamUpdate
from sadgs_ns.training.step.train_step import StepResult, ViewGroup, training_step

MOST_GAUSSIANS = 2**20  # Steps of more Gaussians × views keep a GPU busy without a graph, which would only take memory
MOST_GRAPHS = 16
"""Largest number of graphs. With images of many sizes, or views of very different numbers of Gaussians, steps would
otherwise be captured more often than they are replayed."""


class Results(NamedTuple):
    """The results of a graph on the device; its next replay overwrites them."""

    values: Tensor  # Loss, PSNR in dB, two unused numbers, and NaN if a gradient was left out, else 0. [5]
    pair_counts: Tensor  # Pairs of a Gaussian and a tile of each view. int64 [V]
    means_gradient: Tensor  # Gradient of the loss by the centres. [N, 3]


class CudaGraphs:
    """Captures functions as CUDA graphs on a device. They share memory, since only one runs at a time."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._stream = torch.cuda.Stream(device)
        self._pool = torch.cuda.graph_pool_handle()
        # The shared memory lives as long as one of its graphs, so this one is kept.
        self._first = self.capture(lambda: torch.zeros((), device=device))

    def capture(self, function: Callable[[], Any], generators: Sequence[torch.Generator] = ()) -> Callable[[], Any]:
        """Capture what a function launches, without running it, and return one that replays it.

        The results of all replays are the same tensors. The function may launch only kernels that were launched before,
        since none may be compiled meanwhile. It may draw random numbers of torch's own generator and of `generators`.
        Raises as the function or RuntimeError; torch's own context would wait.
        """
        graph = torch.cuda.CUDAGraph()
        for generator in generators:
            graph.register_generator_state(generator)
        with torch.cuda.stream(self._stream):
            # Other threads load images and draw for the viewer meanwhile.
            graph.capture_begin(pool=self._pool, capture_error_mode="relaxed")
            try:
                results = function()
            except BaseException:
                with contextlib.suppress(RuntimeError):  # The function's own error tells more.
                    graph.capture_end()
                self._repair_generator()
                raise
            try:
                graph.capture_end()
            except RuntimeError:
                self._repair_generator()
                raise

        def replay() -> Any:
            graph.replay()
            return results

        return replay

    def wait(self) -> None:
        """Wait until no graph is running; a running one must not be dropped."""
        torch.cuda.synchronize(self._device)

    def _repair_generator(self) -> None:
        """Let torch draw random numbers again, which it refuses after a failed capture."""
        generator = torch.cuda.default_generators[torch.cuda.current_device()]
        generator.graphsafe_set_state(generator.clone_state())


def has_room(device: torch.device) -> bool:
    """Tell whether there is free memory for a graph, which takes at most what the process has reserved."""
    return device.type != "cuda" or torch.cuda.mem_get_info(device)[0] >= torch.cuda.memory_reserved(device)


@dataclass(frozen=True)
class _Inputs:
    """What changes from step to step, in tensors that a graph reads."""

    group: ViewGroup
    factors: Tensor  # of Adam, [2, P]

    @staticmethod
    def like(group: ViewGroup, factors: Tensor) -> _Inputs:
        """Make the tensors for steps like a first one, with its values."""
        images = torch.stack([data["image"] for data in group.data])
        masks = _masks_of(group)
        if masks is not None:
            masks = masks.clone()
        viewmats, Ks, *size = group.cameras
        cameras = Cameras(viewmats.clone(), Ks.clone(), *size)
        view_ids = group.view_ids
        if view_ids is not None:
            view_ids = view_ids.clone()
        data = [{}] * len(images)
        copied = replace(group, cameras=cameras, view_ids=view_ids, data=data, images=images, masks=masks)
        return _Inputs(copied, factors.to(images.device))

    def write(self, group: ViewGroup, factors: Tensor) -> None:
        """Copy a step's values into the tensors, without waiting for the device."""
        self.group.cameras.viewmats.copy_(group.cameras.viewmats)
        self.group.cameras.Ks.copy_(group.cameras.Ks)
        if self.group.view_ids is not None and group.view_ids is not None:
            self.group.view_ids.copy_(group.view_ids)
        torch.stack([data["image"] for data in group.data], out=self.group.images)
        masks = _masks_of(group)
        if self.group.masks is not None and masks is not None:
            self.group.masks.copy_(masks)
        self.factors.copy_(factors, non_blocking=True)


def _masks_of(group: ViewGroup) -> Tensor | None:
    """Return the masks of a group's views, ones where a view has none; None if no view has. bool [V, H, W, 1]"""
    return stack_masks(group.data, (group.cameras.height, group.cameras.width), group.cameras.viewmats.device)


class GraphedSteps:
    """Captures and replays training steps of a model that this process holds alone.

    The first step of a key after parameters were replaced is launched kernel by kernel, which compiles and loads what
    is missing. The second one is captured, and all later ones are `replayed`. `failure` says why none is captured.
    """

    def __init__(self, model: SadgsModel) -> None:
        self._model = model
        self._recorder: CudaGraphs | None = None
        self._addresses: tuple[int, ...] = ()
        self._launched: set[Any] = set()  # keys of steps that were launched at these addresses
        self._graphs: dict[Any, tuple[Callable[[], Results], _Inputs]] = {}
        self.replayed = 0
        self.failure = ""

    def prepare(self, num_views: int) -> bool:
        """Tell whether steps of this many views may be replayed now. If not, free the graphs' memory."""
        if not self.failure and num_views * self._model.num_points <= MOST_GAUSSIANS:
            return True
        self._drop()
        self._recorder = None
        return False

    def replay(
        self,
        groups: Sequence[ViewGroup],
        opacity_reg: float,
        update: AdamUpdate,
        factors: Tensor,
        nonfinite_flag: Tensor,
    ) -> StepResult | None:
        """Do `training_step` with `factors` on the host by a graph; return None if the step cannot be one."""
        from sadgs_ns.kernels.tiles import PairCounts

        strategy = self._model.strategy
        state = self._model.strategy_state
        group = groups[0]
        step = self._model.step
        # Transparency takes more launches.
        plain = all(data["image"].shape[-1] == 3 for data in group.data)
        known = group.options.tile_capacity is not None and (not group.options.absgrad or "grad2d" in state)
        observes = group.structure_tensors is not None
        if self.failure or len(groups) > 1 or not plain or not known or observes or strategy.densifies(step):
            return None
        found = self._graph(group, opacity_reg, update, factors)
        if found is None:
            return None
        replay, inputs = found
        inputs.write(group, factors)
        results = replay()
        self.replayed += 1
        values = results.values.clone()
        nonfinite_flag.copy_(values[4:])
        counts = PairCounts.sent(results.pair_counts)
        return StepResult(values[0], values[1], results.means_gradient, [{"pair_counts": counts}])

    def _graph(
        self, group: ViewGroup, opacity_reg: float, update: AdamUpdate, factors: Tensor
    ) -> tuple[Callable[[], Results], _Inputs] | None:
        """Return what replays such a step, and its inputs. The second step of a key is captured if there is memory."""
        sums = [value for value in self._model.strategy_state.values() if isinstance(value, Tensor)]
        changed = (*update.tensors(), *sums)
        # New tensors of another length may have the old addresses.
        addresses = (len(update.parameters["means"]), *[tensor.data_ptr() for tensor in changed])
        if addresses != self._addresses:
            self._drop()
            self._addresses = addresses
        is_masked = any("mask" in data for data in group.data)
        image = group.data[0]["image"]
        key = group.cameras[2:], group.options, opacity_reg, image.dtype, len(group.indices), is_masked
        wanted = key in self._launched and key not in self._graphs and len(self._graphs) < MOST_GRAPHS
        if wanted and has_room(update.device):
            try:
                inputs = _Inputs.like(group, factors)
                self._recorder = self._recorder or CudaGraphs(update.device)
                step = partial(_captured_step, self._model, inputs, opacity_reg, update)
                generators = []
                if self._model.dropout is not None:
                    generators.append(self._model.dropout.generator)
                self._graphs[key] = self._recorder.capture(step, generators), inputs
            except Exception as error:  # CUDA, torch and Triton each raise their own.
                self._give_up(error)
        self._launched.add(key)
        return self._graphs.get(key)

    def _drop(self) -> None:
        if self._graphs and self._recorder is not None:
            self._recorder.wait()
        self._graphs.clear()
        self._launched.clear()

    def _give_up(self, error: Exception) -> None:
        """Stop capturing steps, and print why."""
        self.failure = reason(error)
        self._drop()
        self._recorder = None
        warn(
            f"A training step could not be captured as a CUDA graph ({self.failure}): the kernels of this run are "
            "launched one by one, which takes longer where Gaussians are few."
        )


def _captured_step(model: SadgsModel, inputs: _Inputs, opacity_reg: float, update: AdamUpdate) -> Results:
    """Launch a training step, and keep what the host reads of it."""
    # The flag begins at 16 bytes, because Triton would compile Adam anew for a lesser alignment.
    values = torch.zeros(5, device=update.device)
    nonfinite_flag = values[4:]
    result = training_step(model, [inputs.group], opacity_reg, update, inputs.factors, nonfinite_flag)
    # `copy_` copies memory; a kernel that no step has launched before would be loaded during the capture.
    values[0].copy_(result.loss)
    values[1].copy_(result.psnr)
    return Results(values, result.infos[0]["pair_counts"].counts.clone(), result.means_gradient)
