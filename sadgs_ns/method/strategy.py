"""The options of densification, which gsplat's users take as a strategy (paper, sections 3.4–3.6)."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from gsplat.strategy.base import Strategy

from sadgs_ns.distributed.world import World
from sadgs_ns.method.ops import Optimizers, Params, State
from sadgs_ns.method.running_strategy import Infos, RunningStrategy
from sadgs_ns.method.schedule import Windows, windows

DEFAULT_ITERATIONS = 3000
"""Length of the run for which the options densify if they are used as a strategy themselves."""


@dataclass
class StructureAwareStrategy(Strategy):
    """Structure-aware densification: split where η says so, in one step, into an anisotropic grid.

    These are the options. They are a gsplat `Strategy`, too, which densifies as in a run of 3,000 iterations; `for_run`
    makes one for another length. Its training loop stands in docs/strategy.md. Iterations are counted from 1: `step` s
    is iteration s + 1. `info` is gsplat's of the C views of a step, unpacked, with `structure_tensors` [C, H, W, 3],
    `viewmats` [C, 4, 4] and `Ks` [C, 3, 3]. Where views of different sizes are rendered, it lists their infos.
    """

    max_gaussians: int = 4_000_000
    """Hard cap on the number of Gaussians, never exceeded; of a resumed run with more, none is taken away.
    A run that would outgrow it lets those grow first that need it most, and fills it when densification ends.
    On CUDA fewer are added, with a warning, if the device's memory cannot hold more."""
    structure_every: int | None = None
    """Iterations between structure-aware split and prune steps; None is a sixth of the run, 0 turns them off."""
    absgs_every: int | None = None
    """Iterations between AbsGS steps, skipped where a structure step falls.
    None is a thirtieth of the run, 0 turns them off."""
    refine_start_iter: int | None = None
    """First iteration at which densification may run; None is a thirtieth of the run."""
    refine_stop_iter: int | None = None
    """Last iteration at which densification may run; Gaussians less than 0.1 opaque are pruned there.
    None is 16/30 of the run, and 19/30 are the most; 0 adds and removes none at all."""
    eta_every: int | None = None
    """Iterations between η observations; None is a three-hundredth of the run.
    The paper observes at every iteration, which takes time and improves nothing."""
    tau_split: float = 0.8
    """Fraction of a Gaussian's observations that must violate (η > 1) before an axis is split."""
    min_observations: int = 3
    """Observations of η that a Gaussian needs before a structure step splits it, or prunes it for low η.
    With 1, as in the paper, one violation of one observation is enough."""
    split_min_opacity: float = 0.3
    """Opacity in [0, 1] that a Gaussian needs to be split by a structure step; 0, as in the paper, splits all."""
    child_scale: float = 1.5
    """k in [1, 2): children are k times the paper's s/n long on the axes that are split, which closes their gaps.
    They stand closer and are 1/k as opaque an axis, which keeps the covariance and the mass; 1 is the paper's."""
    clone_grad2d: float = 2.25e-4
    """AbsGS: normalised mean screen gradient at which a small Gaussian is cloned; AbsGS's own is 2e-4.
    `ns-train` lowers this and the next one for an effort above 1 if views are many; a stereo start adds 25 %."""
    split_absgrad2d: float = 4.5e-4
    """AbsGS: normalised mean absolute screen gradient at which a large Gaussian is split; AbsGS's own is 4e-4."""
    absgs_long_axis: bool = True
    """AbsGS halves a large Gaussian's longest axis in its place, instead of drawing the places of two at random."""
    min_opacity: float = 0.02
    """Opacity under which every densification step prunes; AbsGS's own is 0.005."""
    reset_every: int | None = None
    """Iterations between opacity resets inside the densification window; 0 turns them off.
    None is 12/30 of the run, and 0 in runs of fewer than 600 iterations, which would not recover."""

    def fitted(self, num_iterations: int) -> StructureAwareStrategy:
        """Return these options for a run of some length, from which the windows that are None are derived."""
        return replace(self, **asdict(windows(num_iterations, **self._given)))

    def for_run(self, num_iterations: int, world: World | None = None) -> RunningStrategy:
        """Return the strategy of a run of some length, from which the windows that are None are derived.

        `world` are the processes among which the Gaussians are shared out; None is this process alone.
        """
        fitted = self.fitted(num_iterations)
        if world is None:
            world = World()
        return RunningStrategy(fitted, fitted.windows, world)

    @property
    def windows(self) -> Windows:
        """The times of densification; a window that is None is as in a run of 3,000 iterations."""
        given = self._given
        if None in given.values():
            return windows(DEFAULT_ITERATIONS, **given)
        return Windows(**given)

    @property
    def _given(self) -> dict[str, Any]:
        """The windows as they are among the options, which may be None."""
        return {field.name: getattr(self, field.name) for field in fields(Windows)}

    def check(self) -> None:
        """Raise ValueError if an option is out of its range."""
        for name in ("max_gaussians", "eta_every", "min_observations"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"strategy.{name} must be at least 1, got {value}.")
        iterations = ("structure_every", "absgs_every", "refine_start_iter", "refine_stop_iter", "reset_every")
        for name in (*iterations, "clone_grad2d", "split_absgrad2d"):
            value = getattr(self, name)
            if value is not None and not value >= 0:  # This refuses NaN, too.
                raise ValueError(f"strategy.{name} must not be negative, got {value:g}.")
        if not 1 <= self.child_scale < 2:
            raise ValueError(f"strategy.child_scale must be at least 1 and less than 2, got {self.child_scale:g}.")
        for name in ("tau_split", "split_min_opacity", "min_opacity"):
            value = getattr(self, name)
            if not 0 <= value <= 1:
                raise ValueError(f"strategy.{name} must be in [0, 1], got {value:g}.")

    # --- gsplat's interface of a strategy; `RunningStrategy` documents it ---

    @property
    def _running(self) -> RunningStrategy:
        # Made anew each time, because options may be changed.
        return RunningStrategy(self, self.windows)

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """Return the state to pass to the other methods, given `camera_extent`; raises ValueError as `check`."""
        return self._running.initialize_state(scene_scale)

    def check_sanity(self, params: Params, optimizers: Optimizers) -> None:
        """Check as gsplat's strategies do, and raise ValueError if a parameter that the method needs is missing."""
        self._running.check_sanity(params, optimizers)

    def needs_absgrad(self, step: int) -> bool:
        """Tell whether an AbsGS step will read this step's absolute screen gradients; a structure step drops them."""
        return self._running.needs_absgrad(step)

    def step_pre_backward(self, params: Params, optimizers: Optimizers, state: State, step: int, info: Infos) -> None:
        """Observe η, and ask for the screen gradients, before `loss.backward()`."""
        self._running.step_pre_backward(params, optimizers, state, step, info)

    def step_post_backward(
        self, params: Params, optimizers: Optimizers, state: State, step: int, info: Infos, packed: bool = False
    ) -> None:
        """Add up the screen gradients and densify when the schedule says so, after `loss.backward()`.

        Raise ValueError if `packed`: η and AbsGS read the unpacked meta.
        """
        self._running.step_post_backward(params, optimizers, state, step, info, packed)
