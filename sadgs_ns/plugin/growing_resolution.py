"""At which level of resolution a run renders each of its steps, and when that grows."""

from __future__ import annotations

import torch

from sadgs_ns.method.resolution import FULL_SHARE, GRADIENTS_SHARE, coarsest_level, typical_length
from sadgs_ns.plugin.model import SadgsModel
from sadgs_ns.plugin.views import TrainingViews
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world

_SAMPLED_CAMERAS = 8
"""Training cameras in which the Gaussians are measured."""
_SAMPLED_GAUSSIANS = 100_000
"""About so many Gaussians are measured, since their median hardly changes with more."""


class GrowingResolution:
    """Renders early steps of a run small, by the rule of `method.resolution`, and later ones full.

    A run has one level at a time, which its smallest images allow. Full at any time are steps that observe η, whose
    structure tensors are those of the full images, steps that densify, since these look at the memory that a step
    takes, and the last share of the steps up to each one of AbsGS, which reads only gradients of full images.

    Args:
        views: The training views, whose reduced images are forgotten where the level changes.
        model: Its Gaussians and its strategy's schedule decide.
        strength: As in `coarsest_level`; None renders all steps full.
    """

    def __init__(self, views: TrainingViews, model: SadgsModel, strength: float | None) -> None:
        self._views, self._model, self._strength = views, model, strength
        self._views_per_step = 1
        self.level: int | None = None
        """Factor by which the sides of images are divided at present; None before `start`."""

    def start(self, views_per_step: int) -> None:
        """Choose the first level, unless a checkpoint had one; the strategy must know the length of the run.

        Args:
            views_per_step: Number of views that a step renders.
        """
        self._views_per_step = views_per_step
        if self._strength is None or self._model.step >= self._end:
            self.level = 1
        elif self.level is None:
            self.level = self._measured()

    def at(self, step: int) -> int:
        """Return the level of a step, counted from 0."""
        if self.level is None or self.level == 1:
            return 1
        strategy = self._model.strategy
        full = step >= self._end or strategy.observes(step) or strategy.densifies(step) or self._is_for_absgs(step)
        return 1 if full else self.level

    def grow(self, step: int) -> None:
        """Choose the level of the steps after this one: finer where densification made Gaussians shorter."""
        if self.level is None or self.level == 1:
            return
        level = 1 if step + 1 >= self._end else self.level
        if level > 1 and self._model.strategy.densifies(step):
            level = min(level, self._measured())
        if level != self.level:
            self.level = level
            self._views.forget_reduced()

    def _is_for_absgs(self, step: int) -> bool:
        """Tell whether a step is full for its gradients, which the next AbsGS step reads."""
        strategy = self._model.strategy
        every = strategy.windows.absgs_every
        return strategy.needs_absgrad(step) and -(step + 1) % every < GRADIENTS_SHARE * every

    @property
    def _end(self) -> int:
        """Step from which all images are full: where densification ends, or the last share of the run begins."""
        strategy = self._model.strategy
        return min(strategy.windows.refine_stop_iter, int((1 - FULL_SHARE) * strategy.run_length))

    @torch.no_grad()
    def _measured(self) -> int:
        """Return the level that fits the Gaussians as they are; the host waits for their length."""
        assert self._strength is not None
        cameras, params = self._views.datamanager.train_dataset.cameras, self._model.gauss_params
        pixels = self._views_per_step * int((cameras.width * cameras.height).min())
        chosen = torch.linspace(0, len(cameras) - 1, min(_SAMPLED_CAMERAS, len(cameras))).round().long()
        viewmats = viewmats_from_camera_to_world(cameras.camera_to_worlds[chosen])
        Ks = cameras.get_intrinsics_matrices()[chosen]
        sizes = torch.cat([cameras.width[chosen], cameras.height[chosen]], dim=-1).tolist()  # [C][2]
        every = -(-len(params["means"]) // _SAMPLED_GAUSSIANS)
        some = {name: params[name].detach()[::every] for name in ("means", "quats", "scales", "opacities")}
        device = self._model.device
        length = typical_length(some, viewmats.to(device), Ks.to(device), sizes)  # type: ignore[arg-type]
        return coarsest_level(float(length), pixels, self._strength)
