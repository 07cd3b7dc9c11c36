"""The viewer's panel of the method: pictures of η and S̄, a table of structure steps, and two settings."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
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
from sadgs_ns.viewer.color_scales import CHILDREN, ETA, LOW, PERIOD, Panel, Picture, to_picture
from sadgs_ns.viewer.elements import ViewerMarkdown, show_output
from sadgs_ns.viewer.shown_run import GaussiansReference, Plan, ShownRun

OUTPUT = "structure"  # Name of the panel's picture among the viewer's output types

# Choices of what the picture shows
OFF = "off"
SHOW_ETA = "η"
SHOW_CHILDREN = "children"
SHOW_LOW = "low"
SHOW_PERIOD = "wavelength of the nearest photo"
SHOW_ELLIPSES = "ellipses of the nearest photo"
NEED_STATISTICS = (SHOW_ETA, SHOW_CHILDREN, SHOW_LOW)  # Choices that need observations of the training views
NEED_PHOTOS = (SHOW_PERIOD, SHOW_ELLIPSES)  # Choices that need the training photos
CHOICES = [OFF, *NEED_STATISTICS, *NEED_PHOTOS]

RANGES = {"tau_split": (0.0, 1.0), "max_gaussians": (1, 100_000_000)}
"""Smallest and largest values of the strategy's fields that may change while a run trains."""
ROWS = 8  # Number of the last structure steps in the table
REFRESH_SECONDS = 1.0  # Time between refreshes of the table while a run trains
PROGRESS_SECONDS = 0.5  # Time between texts about which view is observed

AnyPlan = TypeVar("AnyPlan", bound=Plan)


def changed(plan: AnyPlan, name: str, value: float) -> AnyPlan:
    """Return a plan with another value of one of `RANGES`' fields; raise ValueError if it is out of range."""
    low, high = RANGES[name]
    is_finite = isinstance(value, int | float) and math.isfinite(value)
    if not (is_finite and low <= value <= high):
        raise ValueError(f"{name} must be in {low} … {high}, got {value}; it stays {getattr(plan.strategy, name)}.")
    field: dict[str, Any] = {name: float(value)}
    if isinstance(low, int):
        field = {name: int(value)}
    return replace(plan, strategy=replace(plan.strategy, **field))


def describe(strategy: Options, num_points: int, state: Mapping[str, Any]) -> str:
    """Return Markdown of the number of Gaussians, and of how structure steps, AbsGS and pruning changed it."""
    lines = [f"**{num_points:,} Gaussians** (cap {strategy.max_gaussians:,})", ""]
    steps = state.get("structure_steps", [])[-ROWS:]
    if not steps:
        lines.append("No structure step yet.")
        return "\n".join(lines)
    lines.append("| iteration | step | violate | low | Gaussians |")
    lines.append("| --- | --- | --- | --- | --- |")
    number = steps[0]["before"]
    for step in steps:
        iteration = step["iteration"]
        before = step["before"]
        after = step["after"]
        if before != number:
            lines.append(_row_between_steps(f"to {iteration}", number, before))
        lines.append(f"| {iteration} | structure | {step['violating']:,} | {step['low']:,} | {before:,} → {after:,} |")
        number = after
    if number != num_points:
        lines.append(_row_between_steps(f"since {steps[-1]['iteration']}", number, num_points))
    return "\n".join(lines)


def _row_between_steps(when: str, before: int, after: int) -> str:
    return f"| {when} | AbsGS, pruning | | | {before:,} → {after:,} |"


def nearest_view(poses: Tensor, pose: Tensor, extent: float) -> int:
    """Return the index of the pose nearest to a given one in position and viewing direction.

    Args:
        poses: Camera to world. [C, 3, 4]
        pose: Camera to world. [3, 4]
        extent: Distance in world units that counts as much as an angle of 1 rad.
    """
    distances = (poses[:, :, 3] - pose[:, 3]).norm(dim=-1) / max(extent, 1e-12)  # [C]
    cosines = poses[:, :, 2] @ pose[:, 2]  # [C]
    angles = cosines.clamp(-1, 1).acos()  # [C]
    return int((distances + angles).argmin())


class StructurePanel(torch.nn.Module):
    """The panel's elements and picture. It is a module because the viewer looks for elements in modules only.

    The viewer shows the elements in the alphabetical order of their attributes.
    """

    def __init__(self, run: ShownRun) -> None:
        super().__init__()
        self._run = run
        self._observed: dict[str, Tensor] = {}  # Statistics from `observe_now`
        self._gaussians: GaussiansReference | None = None  # Those that `_observed` is of
        self._refreshed = 0.0  # Time of the last `refresh`
        self._status = ""  # Text above the table
        self._shown = OFF  # Choice that `outputs` draws
        self._legend = ""
        strategy = run.model.strategy.options
        self.choice = ViewerDropdown(
            "Show",
            OFF,
            CHOICES,
            cb_hook=lambda _: self._call(self.choose),
            hint="What the output type “structure” shows",
        )
        self.legend = ViewerMarkdown("legend", lambda: self._legend)
        self.observe = ViewerButton("Observe all training views", cb_hook=lambda _: self._call(self.observe_now))
        self.set_max_gaussians = ViewerNumber(
            "max_gaussians",
            strategy.max_gaussians,
            cb_hook=self._change_strategy,
            hint="Hard cap, from the next densification on",
        )
        lowest, highest = RANGES["tau_split"]
        self.set_tau_split = ViewerSlider(
            "tau_split",
            strategy.tau_split,
            lowest,
            highest,
            0.05,
            cb_hook=self._change_strategy,
            hint="Share of observations that must violate, at the next structure step",
        )
        self.table = ViewerMarkdown("counts", self._describe)
        self.viewer = ViewerControl()

    def _describe(self) -> str:
        model = self._run.model
        text = describe(model.strategy.options, model.num_points, model.strategy_state)
        if self._status:
            return f"{self._status}\n\n{text}"
        return text

    def _show_status(self, status: str) -> None:
        """Show a text above the table, in place of the last one."""
        self._status = status
        self.table.refresh()

    def _change_strategy(self, element: ViewerNumber | ViewerSlider) -> None:
        """Give an element's value to the strategy, or a value that is out of range back to the element."""
        model = self._run.model
        plan = model.plan
        name = element.name  # Elements have the names of the strategy's fields.
        present = getattr(plan.strategy, name)
        try:
            if element.value != present:
                model.follow(changed(plan, name, element.value))
        except ValueError as error:
            self._run.warn(str(error))
            element.value = present
        self.table.refresh()

    def _call(self, act: Callable[[], None]) -> None:
        """Call `act`, and show any error in the panel; viser swallows exceptions of callbacks."""
        self._show_status("")
        try:
            act()
        except (RuntimeError, ValueError) as error:  # Memory is full, or data went away.
            text = f"The viewer's panel stays as it was: {reason(error)}"
            self._run.warn(text)
            self._show_status(text)

    def refresh(self) -> None:
        """Show the present numbers in the table, at most once a second."""
        if self.table.gui_handle is None:
            return
        now = time.monotonic()
        if now - self._refreshed > REFRESH_SECONDS:
            self._refreshed = now
            self.table.refresh()

    def statistics(self) -> dict[str, Tensor] | None:
        """Return the run's sums of η since the last structure step, or `observe_now`'s; None if there are none."""
        model = self._run.model
        running = model.strategy_state.get("n_total")  # The run drops its statistics when densification ends. [N]
        if running is not None and len(running) == model.num_points and bool((running > 0).any()):
            return model.strategy_state
        if not self._run.are_present(self._gaussians):
            return None
        observed = self._observed.get("n_total")  # [N]
        if observed is not None and len(observed) == model.num_points:
            return self._observed
        return None

    def observe_now(self) -> None:
        """Observe all training views with the present Gaussians, and show the progress above the table."""
        self._disable_button(True)
        try:
            self._read_photos()
            gaussians = self._run.present_gaussians()
            self._observed = self._run.observe(self._with_progress)
            self._gaussians = gaussians
        finally:
            self._disable_button(False)
        num_views = len(self._run.datamanager.train_dataset)
        num_seen = int((self._observed["n_total"] > 0).sum())
        self._show_status(
            f"Observed {num_views:,} training views, which see {num_seen:,} Gaussians: “{SHOW_ETA}”, “{SHOW_CHILDREN}” "
            f"and “{SHOW_LOW}” show what was found."
        )

    def _with_progress(self, views: range) -> Iterator[int]:
        """Yield the views, and show at most twice a second which one it is."""
        due = 0.0
        for view in views:
            if time.monotonic() >= due:
                self._show_status(f"Observing training view {view + 1:,} of {len(views):,} …")
                due = time.monotonic() + PROGRESS_SECONDS
            yield view

    def _read_photos(self) -> None:
        """Compute the structure tensors of the training photos, unless they were computed before."""
        structure_tensors = self._run.structure_tensors
        if not structure_tensors.filled:
            self._show_status("Reading the training photos and their texture …")
            structure_tensors.fill()

    def _disable_button(self, disabled: bool) -> None:
        if self.observe.gui_handle is not None:
            self.observe.set_disabled(disabled)

    def choose(self) -> None:
        """Compute what the present choice needs, and have the viewer show it.

        `picture` computes none of it, because the viewer may break off drawing at any line, and photos that are
        undistorted twice would be wrong.
        """
        chosen = self.choice.value
        if chosen in NEED_STATISTICS and self.statistics() is None:
            self.observe_now()
        elif chosen in NEED_PHOTOS:
            self._read_photos()
            self._show_status("")
        self._shown = chosen
        if chosen == OFF:
            self._show_legend("")
            show_output(self.viewer, "rgb")
        else:
            show_output(self.viewer, OUTPUT)

    def outputs(self, camera: Cameras, rendered: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return `structure` [H, W, 3] in [0, 1], whatever is chosen: the viewer's thread needs each output."""
        rgb = rendered["rgb"]
        if self._shown == OFF:
            return {OUTPUT: rgb}
        drawn = self.picture(self._shown, camera, rgb)
        self._show_legend(color_scales.legend(drawn.title, drawn.scale))
        return {OUTPUT: torch.from_numpy(drawn.picture).to(rgb) / 255}

    def _show_legend(self, legend: str) -> None:
        """Show a legend beside the picture; inside, the viewer would shrink it."""
        self._legend = legend
        self.legend.refresh()

    @torch.no_grad()
    def picture(self, choice: str, camera: Cameras, rgb: Tensor) -> Panel:
        """Draw one of `CHOICES`, but not "off", for a camera, shape [1], that sees `rgb` [H, W, 3] in [0, 1]."""
        height, width = rgb.shape[:2]
        if choice in NEED_STATISTICS:
            return self._picture_of_gaussians(choice, camera, width, height)
        return self._picture_of_nearest_photo(choice, camera, width, height)

    def _picture_of_nearest_photo(self, choice: str, camera: Cameras, width: int, height: int) -> Panel:
        """Draw the texture of the photo nearest to a camera, as large as fits, in the middle of a black picture."""
        structure_tensors = self._run.structure_tensors
        datamanager = self._run.datamanager
        dataset = datamanager.train_dataset
        poses = dataset.cameras.camera_to_worlds  # [C, 3, 4]
        pose = camera.camera_to_worlds[0].to(poses)  # [3, 4]
        extent = float(self._run.model.strategy_state["scene_scale"])
        index = nearest_view(poses, pose, extent)
        photo = to_picture(structure_tensors.photo(datamanager.cached_train[index]))
        structure_tensor = dequantize(structure_tensors[index])  # [photo's height, photo's width, 3]

        enlarge = min(height / photo.shape[0], width / photo.shape[1])
        drawn_height = max(round(enlarge * photo.shape[0]), 1)
        drawn_width = max(round(enlarge * photo.shape[1]), 1)
        constant = structure_tensors.frequency_constant
        if choice == SHOW_ELLIPSES:
            title = "S̄⁻¹ as ellipses, coloured by period,"
            drawn = maps.draw_ellipses(photo, structure_tensor, constant, (drawn_height, drawn_width))
        else:
            title = "Period of the texture, px,"
            period = maps.texture_period(structure_tensor, constant)
            drawn = cv2.resize(PERIOD(period), (drawn_width, drawn_height))
        top = (height - drawn_height) // 2
        left = (width - drawn_width) // 2
        whole = _black_picture(width, height)
        whole[top : top + drawn_height, left : left + drawn_width] = drawn
        name = dataset.image_filenames[index].name
        return Panel(f"{title} of the nearest training view, `{name}`", whole, PERIOD)

    def _picture_of_gaussians(self, choice: str, camera: Cameras, width: int, height: int) -> Panel:
        """Draw what the statistics say of the Gaussians inside the viewer's crop box."""
        model = self._run.model
        statistics = self.statistics()
        if statistics is None:
            text = "No observations yet: press “Observe all training views”, or wait for some iterations."
            return Panel(text, _black_picture(width, height))
        children = model.strategy.planned_children(model.gauss_params, statistics)  # [N, 3]
        is_low = model.strategy.consistently_low(statistics)  # [N]
        eta = {name: statistics[name] for name in ("eta_max", "n_total")}
        rows = model.cropped({**model.gauss_params, **eta, "children": children, "low": is_low})
        if len(rows["means"]) == 0:
            return Panel("No Gaussians in the crop box.", _black_picture(width, height))
        num_seen = int((statistics["n_total"] > 0).sum())
        seen = f"{num_seen:,} of {model.num_points:,} Gaussians observed"
        pinhole = model.pinhole(camera)
        if choice == SHOW_ETA:
            eta_map = maps.eta_map(rows, rows, pinhole, model.drawing)
            return Panel(f"largest η: over 1 violates, under 0.1 is low ({seen})", ETA(eta_map), ETA)
        if choice == SHOW_CHILDREN:
            children_map = maps.children_map(rows, rows["children"], pinhole, model.drawing)
            num_split = int((children > 1).any(dim=1).sum())
            text = f"children at a structure step now: {num_split:,} Gaussians would split ({seen})"
            return Panel(text, CHILDREN(children_map), CHILDREN)
        low_map = maps.mean_map(rows, rows["low"].float(), pinhole, model.drawing)
        text = f"share of consistently low Gaussians, {int(is_low.sum()):,} in all ({seen})"
        return Panel(text, LOW(low_map), LOW)


def _black_picture(width: int, height: int) -> Picture:
    return np.zeros((height, width, 3), np.uint8)
