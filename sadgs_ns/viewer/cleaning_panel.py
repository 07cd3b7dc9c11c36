"""The viewer's panel for cleaning, which shows what `sadgs-export` removes with the options that the panel prints."""

from __future__ import annotations

from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.viewer.viewer_elements import ViewerControl, ViewerDropdown, ViewerSlider, ViewerVec3
from torch import Tensor

from sadgs_ns.errors import reason
from sadgs_ns.geometry.cleaning import Cleaning, Visibility, find_remaining, measure_visibility
from sadgs_ns.viewer.elements import ViewerMarkdown, show_output
from sadgs_ns.viewer.shown_run import ShownRun

OUTPUT = "cleaned"  # Name of the panel's picture among the viewer's output types
OFF, STAYS, GOES = "off", "what stays", "what goes"
NEAREST, FURTHEST = (-100.0, -100.0, -100.0), (100.0, 100.0, 100.0)
"""Corners of the box at first, in world units, which crop nothing."""


class CleaningPanel(torch.nn.Module):
    """The panel's elements and picture. It is a module because the viewer looks for elements in modules only."""

    def __init__(self, run: ShownRun) -> None:
        super().__init__()
        self._run = run
        self._seen: tuple[tuple[int, int], Visibility] | None = None
        self._stays = torch.ones(0, dtype=torch.bool)
        self._shown, self._text = OFF, ""
        self.choice = ViewerDropdown(
            "Preview", OFF, [OFF, STAYS, GOES], cb_hook=self._changed, hint="What the output type “cleaned” shows"
        )
        self.crop_from = ViewerVec3("crop from", NEAREST, cb_hook=self._changed, hint="Lowest x, y and z that stay")
        self.crop_to = ViewerVec3("crop to", FURTHEST, cb_hook=self._changed, hint="Highest x, y and z that stay")
        self.dust = self._slider("dust", 20.0, 0.1, "Pixels that a Gaussian must make up in some training view")
        self.max_extent = self._slider("max extent", 2.0, 0.01, "Longest standard deviation that stays; 0 is no limit")
        self.min_views = self._slider(
            "min views", len(run.datamanager.train_dataset), 1, "Training views that must see a Gaussian"
        )
        self.text = ViewerMarkdown("taken away", lambda: self._text)
        self.viewer = ViewerControl()

    def _slider(self, name: str, most: float, step: float, hint: str) -> ViewerSlider[Any]:
        return ViewerSlider(name, type(most)(0), type(most)(0), most, step, cb_hook=self._changed, hint=hint)

    @property
    def cleaning(self) -> Cleaning:
        """The elements' values; raises InputError if the box is reversed."""
        low, high = self.crop_from.value, self.crop_to.value
        crop: Any = None if (tuple(low), tuple(high)) == (NEAREST, FURTHEST) else (*low, *high)
        return Cleaning(int(self.min_views.value), self.max_extent.value or None, crop, self.dust.value)

    def _changed(self, _: Any) -> None:
        """Refresh, and show any error in the panel; viser swallows exceptions of callbacks."""
        try:
            self.refresh()
        except (RuntimeError, ValueError) as error:  # Memory is full, the box is reversed, or photos went away.
            self._say(f"The picture stays as it was: {reason(error)}.")
            self._run.warn(self._text)
            return
        show_output(self.viewer, "rgb" if self._shown == OFF else OUTPUT)

    def refresh(self) -> None:
        """Find which Gaussians stay, and show how many; raises InputError if the box is reversed."""
        cleaning, model = self.cleaning, self._run.model
        params = dict(model.gauss_params.items())
        now = (model.num_points, model.step)  # Training outdates what was seen.
        if cleaning.needs_views and (self._seen is None or self._seen[0] != now):
            self._say("Looking from all training views …")
            cameras = [(view.viewmats[0], view.Ks[0], view.width, view.height) for view in self._run.view_cameras()]
            self._seen = now, measure_visibility(params, cameras, model.drawing)
        stays, sentences = find_remaining(params, cleaning, None if self._seen is None else self._seen[1])
        self._stays, self._shown = stays, self.choice.value
        left = f"{int(stays.sum()):,} of {len(stays):,} Gaussians would stay."
        options = command_line_options(cleaning)
        how = f"\n\n`sadgs-export RUN --output splat.ply {options}` does this." if options else ""
        self._say("\n\n".join([*sentences, left]) + how)

    def _say(self, text: str) -> None:
        self._text = text
        self.text.refresh()

    def outputs(self, camera: Cameras, rendered: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return `cleaned` [H, W, 3] in [0, 1]; it is `rgb` once densification changed the Gaussians."""
        model, stays = self._run.model, self._stays
        if self._shown == OFF or len(stays) != model.num_points:
            return {OUTPUT: rendered["rgb"]}
        drawn = stays if self._shown == STAYS else ~stays
        return {OUTPUT: model.get_outputs(camera, drawn)["rgb"]}


def command_line_options(cleaning: Cleaning) -> str:
    """Return the options of `sadgs-export` for the same cleaning, or "" for none."""
    options = [f"--min-views {cleaning.min_views}"] if cleaning.min_views else []
    options += [] if cleaning.max_extent is None else [f"--max-extent {cleaning.max_extent:g}"]
    options += [] if cleaning.crop is None else ["--crop " + " ".join(f"{value:g}" for value in cleaning.crop)]
    options += [f"--dust {cleaning.dust:g}"] if cleaning.dust else []
    return " ".join(options)
