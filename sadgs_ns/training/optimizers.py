"""Names under which `config.yml` of runs before version 1.1 finds these classes."""

from sadgs_ns.training.step.optimizers import (
    FusedAdam,
    FusedAdamOptimizerConfig,
    RunLengthDecayScheduler,
    RunLengthDecaySchedulerConfig,
)

__all__ = ["FusedAdam", "FusedAdamOptimizerConfig", "RunLengthDecayScheduler", "RunLengthDecaySchedulerConfig"]
