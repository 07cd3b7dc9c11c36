"""nerfstudio glue: fused Adam and learning rates that decay over the run's own length."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from sadgs_ns import kernels
from sadgs_ns.finite import NonFiniteLog, leave_out_nonfinite


class FusedAdam(torch.optim.Adam):
    """torch's Adam, updated by our Triton kernel where that runs; state and results are torch's.

    Gradients that are NaN, infinite or beyond `finite.MAX_GRADIENT` count as 0: parameters and moments stay finite.

    Args:
        params: Parameters, all on one device.
        fused: Use the Triton kernel on CUDA, torch's fused implementation elsewhere.
        **options: As torch's.
    """

    def __init__(self, params: Iterable[torch.Tensor], *, fused: bool = True, **options: Any) -> None:
        parameters = list(params)
        self._triton = fused and kernels.available(parameters[0].device) and not options.get("weight_decay")
        # torch's own keeps the step count on the device, which would make the host wait for it.
        super().__init__(parameters, fused=fused and not self._triton, **options)
        self.log = NonFiniteLog(parameters[0].device, capacity=1)
        """Where it is noted that a gradient was left out; the pipeline puts its own here."""

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """Update the parameters that have a gradient."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        noted = self.log.gradients
        if not self._triton:
            for group in self.param_groups:
                for parameter in group["params"]:
                    if parameter.grad is not None:
                        leave_out_nonfinite(parameter.grad, noted)
            super().step()
            return loss
        from sadgs_ns.kernels.adam import adam_step

        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                state = self.state[parameter]
                if not state:
                    state["step"] = torch.tensor(0.0)
                    state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
                state["step"] = state["step"].cpu() + 1
                adam_step(
                    parameter,
                    parameter.grad.contiguous(),
                    state["exp_avg"],
                    state["exp_avg_sq"],
                    noted,
                    step=int(state["step"]),
                    lr=group["lr"],
                    betas=group["betas"],
                    eps=group["eps"],
                )
        return loss


@dataclass
class FusedAdamOptimizerConfig(AdamOptimizerConfig):
    """Adam in one kernel per parameter."""

    _target: type = FusedAdam
    fused: bool = True
    """Update each parameter in a single kernel: ours on CUDA, torch's elsewhere."""


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
