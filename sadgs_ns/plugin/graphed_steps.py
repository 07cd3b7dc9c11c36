"""Training steps of few Gaussians as CUDA graphs, which the host launches in one call instead of one by one.

On a small scene the host takes longer to launch a step than the GPU to run it. A graph repeats launches with the very
arguments with which they were captured. What changes from step to step is therefore written, beforehand, into tensors
that stay where they are: cameras, images and Adam's rates. What else the launches depend on is a graph's key, and where
parameters are replaced, as densification does, all graphs are dropped.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol

import torch
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape
from torch import Tensor

from sadgs_ns.errors import reason
from sadgs_ns.method.absgs import accumulate_gradients, keep_gradient
from sadgs_ns.plugin.config import CheckedTrainerConfig
from sadgs_ns.plugin.model import SadgsModel, StepKind
from sadgs_ns.plugin.optimizers import FusedAdam, RepeatedUpdate
from sadgs_ns.plugin.pipeline import SadgsPipeline

MOST_GAUSSIANS = 2**20
"""Steps of more Gaussians, counted once for each view, keep the GPU busy without a graph, which would only take memory
from them."""
MOST_GRAPHS = 16
"""Largest number of graphs at a time. Images of many sizes, or views that see very different numbers of Gaussians,
would otherwise be captured more often than they are replayed."""


class Results(NamedTuple):
    """What a step leaves on the device for the host; the next replay of its graph overwrites it."""

    values: Tensor
    """Loss, PSNR in dB, two numbers that mean nothing, and NaN if a gradient was left out, else 0. [5]"""
    pair_counts: Tensor
    """Pairs of a Gaussian and a tile of each view. int64 [V]"""
    means_gradient: Tensor
    """Gradient of the loss by the centres. [N, 3]"""


class Graph(Protocol):
    """Launches that were captured."""

    def replay(self) -> Results:
        """Launch them all, and return what they write."""
        ...


@dataclass(frozen=True)
class _CudaGraph:
    graph: torch.cuda.CUDAGraph
    results: Any

    def replay(self) -> Results:
        self.graph.replay()
        return self.results


class CudaGraphs:
    """Captures functions as CUDA graphs, which share memory, since only one of them runs at a time.

    Args:
        device: Device of training.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._stream = torch.cuda.Stream(device)
        self._pool = torch.cuda.graph_pool_handle()
        # The shared memory lives as long as one of its graphs, so one that does nothing else is kept.
        self._first = self.capture(lambda: torch.zeros((), device=device))

    def capture(self, function: Callable[[], Any]) -> Graph:
        """Capture what a function launches, which is not run by that.

        torch's context manager would wait for the device, and give its unused memory back, at each capture.

        Args:
            function: It may launch only what was launched before, so that nothing is compiled or loaded meanwhile. The
                tensors that it returns stay where they are.

        Raises:
            Exception: What the function raises, or RuntimeError, if it did what cannot be captured.
        """
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.stream(self._stream):
            # Other threads load images and draw for the viewer meanwhile.
            graph.capture_begin(pool=self._pool, capture_error_mode="relaxed")
            try:
                results = function()
            except BaseException:
                with contextlib.suppress(RuntimeError):  # The function's own error says more.
                    graph.capture_end()
                self._repair_generator()
                raise
            try:
                graph.capture_end()
            except RuntimeError:
                self._repair_generator()
                raise
        return _CudaGraph(graph, results)

    def wait(self) -> None:
        """Wait until no graph is running, before which none may be dropped."""
        torch.cuda.synchronize(self._device)

    def _repair_generator(self) -> None:
        """Let random numbers be drawn again, which torch refuses after a capture that did not end well."""
        generator = torch.cuda.default_generators[torch.cuda.current_device()]
        generator.graphsafe_set_state(generator.clone_state())


def has_room(device: torch.device) -> bool:
    """Tell whether the memory for a graph's step is free, which is at most what the process has reserved."""
    return device.type != "cuda" or torch.cuda.mem_get_info(device)[0] >= torch.cuda.memory_reserved(device)


@dataclass(frozen=True)
class _Inputs:
    """What a graph reads that changes from step to step."""

    viewmats: Tensor
    """World to camera. [V, 4, 4]"""
    Ks: Tensor
    """Intrinsics in px. [V, 3, 3]"""
    numbers: Tensor | None
    """As `SadgsModel.numbers_of` returns them. int64 [V]"""
    images: Tensor
    """uint8, or floats in [0, 1]. [V, H, W, 3]"""
    factors: Tensor
    """Of Adam, as `RepeatedUpdate.factors` returns them. [2, P]"""

    def write(
        self, viewmats: Tensor, Ks: Tensor, numbers: Tensor | None, images: Sequence[Tensor], factors: Tensor
    ) -> None:
        """Put a step's values in the place of those before, without waiting for the device."""
        self.viewmats.copy_(viewmats)
        self.Ks.copy_(Ks)
        if self.numbers is not None and numbers is not None:
            self.numbers.copy_(numbers)
        torch.stack(list(images), out=self.images)
        self.factors.copy_(factors, non_blocking=True)


def launch_step(
    model: SadgsModel, kind: StepKind, inputs: _Inputs, update: RepeatedUpdate, sums: Mapping[str, Tensor]
) -> Results:
    """Launch a training step that densifies nothing and does not observe η; only tensors are changed.

    Args:
        model: The model, in training.
        kind: What the step's launches depend on.
        inputs: Cameras, images and rates.
        update: The update of all parameters.
        sums: AbsGS's sums, as `empty_gradients` makes them, read and changed with `kind.options.absgrad` only.
    """
    # Gradients of the parameters themselves would be added up on the stream on which these were first used, which is
    # not the one that is captured.
    leaves = {name: parameter.detach().requires_grad_() for name, parameter in update.parameters.items()}
    outputs, info = model.render_step(kind, inputs.viewmats, inputs.Ks, leaves, inputs.numbers)
    if kind.options.absgrad:
        keep_gradient(info["means2d"])
    loss = model.get_loss_dict(outputs, {"image": inputs.images})["main_loss"]
    loss.backward()
    # What notes gradients begins at 16 bytes, because Triton would compile Adam anew for what is less aligned.
    values = torch.zeros(5, device=loss.device)
    gradients = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    update.launch(gradients, values[4:], inputs.factors)
    if kind.options.absgrad:
        accumulate_gradients(dict(sums), info, len(inputs.viewmats))
    # These are copies of memory. A kernel that no step has launched before would be loaded while it is captured.
    values[0].copy_(loss.detach())
    values[1].copy_(outputs["psnr"])
    return Results(values, info["pair_counts"].counts.clone(), gradients["means"])


class GraphedSteps:
    """Trains steps by replaying graphs, which it captures where that pays.

    The first step of a kind after parameters were replaced is launched one by one, which compiles and loads what is
    missing. The second one is captured, and those after it are replayed.

    Attributes:
        replayed: Number of steps that were trained by a graph.
        failure: Why all steps are launched one by one from now on; empty where they are not.

    Args:
        pipeline: The pipeline, after its setup.
        optimizers: The optimizers of all that a step trains, by the names of `SadgsModel.trained_params`.
        zero_gradients: Forgets the gradients of the parameters.
    """

    def __init__(
        self, pipeline: SadgsPipeline, optimizers: Mapping[str, FusedAdam], zero_gradients: Callable[[], None]
    ) -> None:
        self._pipeline, self._zero_gradients = pipeline, zero_gradients
        # What has no numbers, as the harmonics of degree 0 alone have no others, has no gradient.
        self._optimizers = {name: o for name, o in optimizers.items() if pipeline.model.trained_params[name].numel()}
        self._recorder: CudaGraphs | None = None
        self._addresses: tuple[int, ...] = ()
        self._launched: set[Any] = set()  # These are keys of steps that were launched one by one at these addresses.
        self._graphs: dict[Any, tuple[Graph, _Inputs]] = {}
        self.replayed = 0
        self.failure = ""

    @staticmethod
    def of(config: CheckedTrainerConfig, pipeline: SadgsPipeline, optimizers: Optimizers) -> GraphedSteps | None:
        """Return what graphs the steps of a run; None where its steps must always be launched one by one."""
        model = pipeline.model
        if not config.cuda_graphs or config.log_gradients:
            return None
        # Several processes send each other Gaussians in a step, whose numbers the host must know.
        if not pipeline.world.alone:
            return None
        # Without a forecast the host waits in each step, and what a camera optimizer does is not in the graphs.
        if model.backend != "triton" or model.tile_forecast is None:
            return None
        if model.camera_optimizer.config.mode != "off" or optimizers.optimizers.keys() != model.trained_params.keys():
            return None
        together: dict[str, FusedAdam] = {}
        for name, optimizer in optimizers.optimizers.items():
            if not isinstance(optimizer, FusedAdam) or not optimizer.triton:
                return None
            if optimizers.config[name]["optimizer"].max_norm is not None:
                return None
            together[name] = optimizer
        return GraphedSteps(pipeline, together, lambda: optimizers.zero_grad_some(list(together)))

    def train(self, step: int) -> tuple[Tensor, dict[str, Tensor], dict[str, Any]] | None:
        """Train a step by a graph, all but the learning rates' schedules and what follows the update.

        Args:
            step: The step, counted from 0, before which the model knows it.

        Returns:
            Loss, losses and metrics as nerfstudio's `train_iteration` returns them; None where the step must be
            launched one by one, with the views that the pipeline has drawn and put aside.
        """
        from sadgs_ns.kernels.tiles import PairCounts

        pipeline, model = self._pipeline, self._pipeline.model
        few = not self.failure and pipeline.views_per_iteration * model.num_points <= MOST_GAUSSIANS
        if (forecast := model.tile_forecast) is None:
            return None
        forecast.coarse = few
        if not few:
            self._drop_graphs()
            self._recorder = None  # Its memory is for the Gaussians that are too many.
        if not few or model.strategy.observes(step) or model.strategy.densifies(step):
            return None
        pipeline.put_aside = drawn = pipeline.draw(step)
        views = next(iter(drawn.values()))
        indices, images = [index for index, _ in views], [data["image"] for _, data in views]
        height, width, channels = images[0].shape
        if len(drawn) > 1 or channels != 3 or any("mask" in data for _, data in views):
            return None
        update = RepeatedUpdate(self._optimizers)
        kind = model.kind_of_step(width, height, indices)
        sums = {name: value for name, value in model.strategy_state.items() if isinstance(value, Tensor)}
        if kind.options.tile_capacity is None or not update.begun or (kind.options.absgrad and "grad2d" not in sums):
            return None
        viewmats, Ks = pipeline.views.stacked_cameras(indices)
        numbers = model.numbers_of(indices)
        found = self._graph(kind, update, sums, viewmats, Ks, numbers, images)
        if found is None:
            return None
        graph, inputs = found
        pipeline.put_aside = None
        inputs.write(viewmats, Ks, numbers, images, update.factors())
        self._zero_gradients()
        results = graph.replay()
        self.replayed += 1
        for optimizer in self._optimizers.values():
            optimizer._opt_called = True  # type: ignore[attr-defined] # torch's schedulers look for it.
        update.parameters["means"].grad = results.means_gradient  # The end of a run that learns nothing looks at it.
        values = results.values.clone()
        loss, psnr = values[:2].unbind()
        pipeline.log.begin_step(step, indices, loss)
        pipeline.log.gradients.copy_(values[4:])
        counts = PairCounts.sent(results.pair_counts)
        forecast.rendered(indices, (width, height), kind.options.tile_capacity, counts)
        return loss, {"main_loss": loss}, model.get_metrics_dict({"psnr": psnr}, {})

    def _graph(
        self,
        kind: StepKind,
        update: RepeatedUpdate,
        sums: Mapping[str, Tensor],
        viewmats: Tensor,
        Ks: Tensor,
        numbers: Tensor | None,
        images: Sequence[Tensor],
    ) -> tuple[Graph, _Inputs] | None:
        """Return the graph of such a step; None if there is none.

        One is captured if such a step was launched one by one before, and memory is not short.
        """
        changed = (*update.parameters.values(), *update.exp_avgs, *update.exp_avg_sqs, *sums.values())
        # Tensors of other lengths may lie where those before did.
        addresses = (len(update.parameters["means"]), *[tensor.data_ptr() for tensor in changed])
        if addresses != self._addresses:
            self._drop_graphs()
            self._addresses = addresses
        key = kind, images[0].dtype, len(images)
        wanted = key in self._launched and key not in self._graphs and len(self._graphs) < MOST_GRAPHS
        if wanted and has_room(viewmats.device):
            try:
                factors = viewmats.new_zeros((2, len(update.parameters)))
                kept = None if numbers is None else numbers.clone()
                inputs = _Inputs(viewmats.clone(), Ks.clone(), kept, torch.stack(list(images)), factors)
                self._recorder = self._recorder or CudaGraphs(viewmats.device)
                step = partial(launch_step, self._pipeline.model, kind, inputs, update, sums)
                self._graphs[key] = self._recorder.capture(step), inputs
            except Exception as error:  # CUDA, torch and Triton each raise their own.
                self._give_up(error)
        self._launched.add(key)
        return self._graphs.get(key)

    def _drop_graphs(self) -> None:
        if self._graphs and self._recorder is not None:
            self._recorder.wait()
        self._graphs.clear()
        self._launched.clear()

    def _give_up(self, error: Exception) -> None:
        """Launch all steps one by one from now on, and say so."""
        self.failure = reason(error)
        self._drop_graphs()
        self._recorder = None
        CONSOLE.print(
            f"[yellow]A training step could not be captured as a CUDA graph ({escape(self.failure)}): the kernels of "
            "this run are launched one by one, which takes longer where Gaussians are few.[/]",
            soft_wrap=True,
        )
