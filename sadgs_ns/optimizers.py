"""nerfstudio glue: fused Adam and learning rates that decay over the run's own length."""

from __future__ import annotations

from dataclasses import dataclass, field

from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR


@dataclass
class FusedAdamOptimizerConfig(AdamOptimizerConfig):
    """Adam in one kernel per parameter."""

    fused: bool = True
    """Update each parameter in a single kernel; half the time of torch's default on a GPU."""


@dataclass
class RunLengthDecaySchedulerConfig(SchedulerConfig):
    """Exponential decay over the length of the run, whatever `--max-num-iterations` is."""

    _target: type = field(default_factory=lambda: RunLengthDecayScheduler)
    initial_factor: float = 1.0
    """Learning rate at the first iteration, relative to the optimizer's."""
    final_factor: float = 1.0
    """Learning rate at the last iteration, relative to the optimizer's."""
    max_steps: int | None = None
    """Iterations until `final_factor`; None is the length of the run."""


class RunLengthDecayScheduler(Scheduler):
    """lr(t) = lr · initial^(1−t) · final^t with t the fraction of the run that has passed."""

    config: RunLengthDecaySchedulerConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LambdaLR:
        """Make torch's scheduler.

        Its state holds Python numbers only, so that checkpoints load with torch's safe loader.
        """
        max_steps = self.config.max_steps
        if max_steps is None:
            raise ValueError("max_steps is unset: SadgsTrainer sets it to the length of the run.")
        initial, final = self.config.initial_factor, self.config.final_factor

        def factor(step: int) -> float:
            t = min(step / max(max_steps, 1), 1.0)
            return float(initial ** (1 - t) * final**t)

        return LambdaLR(optimizer, factor)
