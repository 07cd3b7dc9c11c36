"""The viewer's panel of the method: pictures of η and S̄, a table of structure steps, and two settings.

The viewer finds the elements in the pipeline, and shows them in alphabetical order of their attributes.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, TypeVar

import cv2
import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.viewer.viewer_elements import ViewerButton, ViewerControl, ViewerDropdown, ViewerNumber, ViewerSlider
from torch import Tensor

from sadgs_ns.errors import reason
from sadgs_ns.method.growth import Options
from sadgs_ns.method.quantization import dequantize
from sadgs_ns.viewer import color_scales, maps
from sadgs_ns.viewer.color_scales import CHILDREN, ETA, LOW, PERIOD, Panel, to_picture
from sadgs_ns.viewer.elements import ViewerMarkdown, show_output
from sadgs_ns.viewer.shown_run import Model, Plan, ShownRun

OUTPUT = "structure"  # Name of the panel's picture among the viewer's output types
OFF, ETA_OF, CHILDREN_OF, LOW_OF = "off", "η", "children", "low"
PERIOD_NEAR, ELLIPSES_NEAR = "wavelength of the nearest photo", "ellipses of the nearest photo"
OF_PHOTOS = (PERIOD_NEAR, ELLIPSES_NEAR)  # Choices that need the training photos
OF_STATISTICS = (ETA_OF, CHILDREN_OF, LOW_OF)  # Choices that need observations of the training views
CHOICES = [OFF, *OF_STATISTICS, *OF_PHOTOS]
RANGES = {"tau_split": (0.0, 1.0), "max_gaussians": (1, 100_000_000)}
"""Smallest and largest values of the strategy's fields that may change while a run trains."""
ROWS = 8  # Number of the last structure steps in the table


AnyPlan = TypeVar("AnyPlan", bound=Plan)


def changed(plan: AnyPlan, name: str, value: float) -> AnyPlan:
    """Return a plan with another value of one of `RANGES`' fields; raise ValueError if it is out of range."""
    low, high = RANGES[name]
    if not (isinstance(value, int | float) and math.isfinite(value) and low <= value <= high):
        raise ValueError(f"{name} must be in {low} … {high}, got {value}; it stays {getattr(plan.strategy, name)}.")
    option: dict[str, Any] = {name: int(value) if isinstance(low, int) else float(value)}
    return replace(plan, strategy=replace(plan.strategy, **option))


def describe(strategy: Options, num_points: int, state: dict[str, Any]) -> str:
    """Return Markdown of the number of Gaussians, and of how structure steps, AbsGS and pruning changed it."""
    lines = [f"**{num_points:,} Gaussians** (cap {strategy.max_gaussians:,})", ""]
    steps = state.get("structure_steps", [])[-ROWS:]
    if not steps:
        return "\n".join([*lines, "No structure step yet."])
    lines += ["| iteration | step | violate | low | Gaussians |", "| --- | --- | --- | --- | --- |"]
    number, last = steps[0]["before"], ""
    for step in steps:
        if step["before"] != number:
            lines.append(_between(f"to {step['iteration']}", number, step["before"]))
        change = f"{step['before']:,} → {step['after']:,}"
        lines.append(f"| {step['iteration']} | structure | {step['violating']:,} | {step['low']:,} | {change} |")
        number, last = step["after"], f"since {step['iteration']}"
    if number != num_points:
        lines.append(_between(last, number, num_points))
    return "\n".join(lines)


def _between(when: str, before: int, after: int) -> str:
    return f"| {when} | AbsGS, pruning | | | {before:,} → {after:,} |"


def nearest_view(cameras: Tensor, camera: Tensor, extent: float) -> int:
    """Return the index of the pose [C, 3, 4] nearest to one [3, 4]; a distance of `extent` counts as 1 rad."""
    distance = (cameras[:, :, 3] - camera[:, 3]).norm(dim=-1) / max(extent, 1e-12)
    angle = (cameras[:, :, 2] @ camera[:, 2]).clamp(-1, 1).acos()
    return int((distance + angle).argmin())


class StructurePanel(torch.nn.Module):
    """The panel's elements and picture. It is a module because the viewer looks for elements in modules only."""

    def __init__(self, run: ShownRun) -> None:
        super().__init__()
        self._run = run
        self._observed: dict[str, Tensor] = {}
        self._refreshed = 0.0
        self._status, self._shown, self._legend = "", OFF, ""
        hint = "What the output type “structure” shows"
        self.choice = ViewerDropdown("Show", OFF, CHOICES, cb_hook=lambda _: self._call(self.choose), hint=hint)
        self.legend = ViewerMarkdown("legend", lambda: self._legend)
        self.observe = ViewerButton("Observe all training views", cb_hook=lambda _: self._call(self.observe_now))
        strategy, hint, hook = self._model.strategy.options, "Hard cap, from the next densification on", self._change
        self.set_max_gaussians = ViewerNumber("max_gaussians", strategy.max_gaussians, cb_hook=hook, hint=hint)
        hint, (low, high) = "Share of observations that must violate, at the next structure step", RANGES["tau_split"]
        self.set_tau_split = ViewerSlider("tau_split", strategy.tau_split, low, high, 0.05, cb_hook=hook, hint=hint)
        self.table = ViewerMarkdown("counts", self._describe)
        self.viewer = ViewerControl()

    @property
    def _model(self) -> Model:
        """The model; with a public name, the viewer would find its elements twice."""
        return self._run.model

    def _describe(self) -> str:
        model = self._model
        text = describe(model.strategy.options, model.num_points, model.strategy_state)
        return f"{self._status}\n\n{text}" if self._status else text

    def _say(self, status: str) -> None:
        self._status = status
        self.table.refresh()

    def _change(self, element: ViewerNumber | ViewerSlider) -> None:
        plan, name = self._model.plan, element.name  # elements have the names of the strategy's fields
        try:
            if element.value != getattr(plan.strategy, name):
                self._model.follow(changed(plan, name, element.value))
        except ValueError as error:
            self._run.warn(str(error))
            element.value = getattr(plan.strategy, name)
        self.table.refresh()

    def _call(self, act: Callable[[], None]) -> None:
        """Call `act`, and show any error in the panel; viser swallows exceptions of callbacks."""
        self._say("")
        try:
            act()
        except (RuntimeError, ValueError) as error:  # Memory is full, or data went away.
            text = f"The viewer's panel stays as it was: {reason(error)}"
            self._run.warn(text)
            self._say(text)

    def refresh(self) -> None:
        """Show the present numbers in the table, at most once a second."""
        now = time.monotonic()
        if self.table.gui_handle is not None and now - self._refreshed > 1.0:
            self._refreshed = now
            self.table.refresh()

    def statistics(self) -> dict[str, Tensor] | None:
        """Return the run's sums of η since the last structure step, or `observe_now`'s; None if there are none."""
        model = self._model
        live, n = model.strategy_state, model.num_points
        if "n_total" in live and len(live["n_total"]) == n and bool((live["n_total"] > 0).any()):
            return live
        return self._observed if len(self._observed.get("n_total", ())) == n else None

    def observe_now(self) -> None:
        """Observe all training views with the present Gaussians, and show the progress above the table."""
        number = len(self._run.datamanager.train_dataset)
        self._disable_button(True)
        try:
            self._read_photos()
            self._observed = self._run.observe(self._with_progress)
        finally:
            self._disable_button(False)
        seen = int((self._observed["n_total"] > 0).sum())
        told = f"Observed {number:,} training views, which see {seen:,} Gaussians"
        self._say(f"{told}: “{ETA_OF}”, “{CHILDREN_OF}” and “{LOW_OF}” show what was found.")

    def _with_progress(self, views: range) -> Iterator[int]:
        """Yield the views, and show at most twice a second which one it is."""
        due = 0.0
        for view in views:
            if time.monotonic() >= due:
                self._say(f"Observing training view {view + 1:,} of {len(views):,} …")
                due = time.monotonic() + 0.5
            yield view

    def _read_photos(self) -> None:
        """Compute the structure tensors of the training photos, unless they were computed before."""
        if not self._run.structure_tensors.filled:
            self._say("Reading the training photos and their texture …")
            self._run.structure_tensors.fill()

    def _disable_button(self, disabled: bool) -> None:
        if self.observe.gui_handle is not None:
            self.observe.set_disabled(disabled)

    def choose(self) -> None:
        """Compute what the present choice needs, and have the viewer show it.

        `picture` does not, because the viewer aborts drawing at any line, and photos undistorted twice would be wrong.
        """
        chosen = self.choice.value
        if chosen in OF_STATISTICS and self.statistics() is None:
            self.observe_now()
        elif chosen in OF_PHOTOS:
            self._read_photos()
            self._say("")
        self._shown = chosen
        if chosen == OFF:
            self._show_legend("")
        show_output(self.viewer, "rgb" if chosen == OFF else OUTPUT)

    def outputs(self, camera: Cameras, rendered: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return `structure` [H, W, 3] in [0, 1], whatever is chosen: the viewer's thread needs each output."""
        if self._shown == OFF:
            return {OUTPUT: rendered["rgb"]}
        drawn = self.picture(self._shown, camera, rendered["rgb"])
        self._show_legend(color_scales.legend(drawn.title, drawn.scale))
        return {OUTPUT: torch.from_numpy(drawn.picture).to(rendered["rgb"]) / 255}

    def _show_legend(self, legend: str) -> None:
        """Show a legend beside the picture; inside, the viewer would shrink it."""
        self._legend = legend
        self.legend.refresh()

    @torch.no_grad()
    def picture(self, choice: str, camera: Cameras, rgb: Tensor) -> Panel:
        """Draw one of `CHOICES`, but not "off", for a camera, shape [1], that sees `rgb` [H, W, 3] in [0, 1]."""
        cache, datamanager, (height, width) = self._run.structure_tensors, self._run.datamanager, rgb.shape[:2]
        constant = cache.frequency_constant
        if choice in OF_STATISTICS:
            return self._of_gaussians(choice, camera, width, height)
        cameras = datamanager.train_dataset.cameras.camera_to_worlds
        extent = float(self._model.strategy_state["scene_scale"])
        index = nearest_view(cameras, camera.camera_to_worlds[0].to(cameras), extent)
        photo, tensor = to_picture(cache.photo(datamanager.cached_train[index])), dequantize(cache[index])
        name = f"the nearest training view, `{datamanager.train_dataset.image_filenames[index].name}`"
        scale = min(height / photo.shape[0], width / photo.shape[1])
        size = max(round(scale * photo.shape[0]), 1), max(round(scale * photo.shape[1]), 1)
        if choice == ELLIPSES_NEAR:
            drawn = maps.draw_ellipses(photo, tensor, constant, size)
            title = "S̄⁻¹ as ellipses, coloured by period,"
        else:
            drawn = cv2.resize(PERIOD(maps.texture_period(tensor, constant)), size[::-1])
            title = "Period of the texture, px,"
        top, left = (height - size[0]) // 2, (width - size[1]) // 2
        whole = np.zeros((height, width, 3), np.uint8)
        whole[top : top + size[0], left : left + size[1]] = drawn
        return Panel(f"{title} of {name}", whole, PERIOD)

    def _of_gaussians(self, choice: str, camera: Cameras, width: int, height: int) -> Panel:
        model, statistics = self._model, self.statistics()
        if statistics is None:
            text = "No observations yet: press “Observe all training views”, or wait for some iterations."
            return Panel(text, np.zeros((height, width, 3), np.uint8))
        kept = {name: statistics[name] for name in ("eta_max", "n_total")}
        kept["children"] = model.strategy.planned_children(model.gauss_params, statistics)
        kept["low"] = model.strategy.consistently_low(statistics)
        rows = model.cropped({**model.gauss_params, **kept})
        if len(rows["means"]) == 0:
            return Panel("No Gaussians in the crop box.", np.zeros((height, width, 3), np.uint8))
        pinhole = model.pinhole(camera)
        seen = f"{int((statistics['n_total'] > 0).sum()):,} of {model.num_points:,} Gaussians observed"
        if choice == ETA_OF:
            drawn, scale = maps.eta_map(rows, rows, pinhole, model.drawing), ETA
            text = f"largest η: over 1 violates, under 0.1 is low ({seen})"
        elif choice == CHILDREN_OF:
            drawn, scale = maps.children_map(rows, rows["children"], pinhole, model.drawing), CHILDREN
            split = int((kept["children"] > 1).any(dim=1).sum())
            text = f"children at a structure step now: {split:,} Gaussians would split ({seen})"
        else:
            drawn, scale = maps.mean_map(rows, rows["low"].float(), pinhole, model.drawing), LOW
            text = f"share of consistently low Gaussians, {int(kept['low'].sum()):,} in all ({seen})"
        return Panel(text, scale(drawn), scale)
