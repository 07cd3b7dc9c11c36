"""The optimizers: Adam in one launch for all parameters, and learning rates that decay over the run's own length."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig, Optimizers
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch import Tensor
from torch.cuda.amp.grad_scaler import GradScaler
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR
from tyro.conf import Suppress

from sadgs_ns.kernels import use_triton
from sadgs_ns.plugin.nonfinite import MAX_GRADIENT, NonFiniteLog, leave_out_nonfinite
from sadgs_ns.plugin.options import hide

_ONE = torch.tensor(1.0, device="cpu")
"""Adding it to the count of steps costs the host a third of adding Python's 1."""


class FusedAdam(torch.optim.Adam):
    """torch's Adam, updated by our Triton kernel where that runs; its state and its results are torch's.

    Gradients that are NaN, infinite or beyond `nonfinite.MAX_GRADIENT` count as 0: parameters, all on one device, and
    moments stay finite.
    """

    def __init__(self, params: Iterable[torch.Tensor], **options: Any) -> None:
        parameters = list(params)
        plain = not any(options.get(name) for name in ("weight_decay", "amsgrad", "maximize"))
        self.triton = plain and use_triton(parameters[0].device)
        """Whether the Triton kernel is used."""
        # torch's fused Adam keeps the step count on the device, and our kernel would make the host wait for it.
        super().__init__(parameters, fused=not self.triton, **options)
        self.log = NonFiniteLog(parameters[0].device, capacity=1)
        """Log of gradients that were left out; the pipeline puts its own here."""

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """Update the parameters that have a gradient."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        if not self.triton:
            noted = self.log.gradients
            for group in self.param_groups:
                for parameter in group["params"]:
                    if parameter.grad is not None:
                        leave_out_nonfinite(parameter.grad, noted)
            super().step()
            return loss
        step_together([self])
        return loss


def step_together(optimizers: Iterable[FusedAdam]) -> None:
    """Step several optimizers that use Triton, equal to the bit to one after the other.

    Parameters of one length whose betas, eps and log agree are updated in one launch.
    """
    from sadgs_ns.kernels.adam import adam_step

    launches: dict[Any, list[tuple[Any, ...]]] = {}
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                gradient = parameter.grad
                if gradient is None:
                    continue
                state = optimizer.state[parameter]
                if not state:
                    state["step"] = torch.tensor(0.0)
                    state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
                step = _count(state)
                key = optimizer.log, group["betas"], group["eps"], parameter.shape[:1]
                launches.setdefault(key, []).append(
                    (parameter, gradient.contiguous(), state["exp_avg"], state["exp_avg_sq"], step, group["lr"])
                )
    for (log, betas, eps, _), updates in launches.items():
        parameters, gradients, exp_avgs, exp_avg_sqs, steps, lrs = zip(*updates, strict=True)
        adam_step(
            parameters, gradients, exp_avgs, exp_avg_sqs, log.gradients,
            steps=steps, lrs=lrs, betas=betas, eps=eps, max_gradient=MAX_GRADIENT,
        )  # fmt: skip


def _count(state: dict[str, Any]) -> int:
    """Count an update in the state of a parameter, and return which one it is, from 1."""
    state["step"] = state["step"].cpu() + _ONE
    return int(state["step"])


class RepeatedUpdate:
    """An update of the same parameters that a CUDA graph repeats, with rates that are read from the device.

    It equals `step_together` to the bit. Those that do not differ in length, betas or eps are updated in one launch.

    Attributes:
        parameters: By names, as they are now.
        exp_avgs: Their first moments.
        exp_avg_sqs: Their second moments.
        begun: Whether each of them has been updated before.

    Args:
        optimizers: Optimizers that use the Triton kernel, of one parameter each, by names.
    """

    def __init__(self, optimizers: Mapping[str, FusedAdam]) -> None:
        alike: dict[Any, dict[str, FusedAdam]] = {}
        for name, optimizer in optimizers.items():
            group = optimizer.param_groups[0]
            alike.setdefault((len(group["params"][0]), group["betas"], group["eps"]), {})[name] = optimizer
        self._launches: list[tuple[Any, list[str]]] = [(key, list(chosen)) for key, chosen in alike.items()]
        in_order = {name: optimizer for chosen in alike.values() for name, optimizer in chosen.items()}
        self._groups = [optimizer.param_groups[0] for optimizer in in_order.values()]
        self.parameters: dict[str, Tensor] = {}
        self._states: list[dict[str, Any]] = []
        for (name, optimizer), group in zip(in_order.items(), self._groups, strict=True):
            self.parameters[name] = parameter = group["params"][0]
            self._states.append(optimizer.state.get(parameter) or {})
        self.begun = all(self._states)
        self.exp_avgs, self.exp_avg_sqs = (
            tuple(state[key] for state in self._states if state) for key in ("exp_avg", "exp_avg_sq")
        )

    def factors(self) -> Tensor:
        """Count an update of each parameter and return its factors on the host, float32 [2, P].

        They are in pinned memory where there is CUDA.
        """
        from sadgs_ns.kernels.adam import rates_and_scales

        columns = [
            rates_and_scales([_count(state)], [group["lr"]], group["betas"])
            for state, group in zip(self._states, self._groups, strict=True)
        ]
        on_cuda = next(iter(self.parameters.values())).is_cuda
        return torch.tensor([[rate for (rate,), _ in columns], [scale for _, (scale,) in columns]], pin_memory=on_cuda)

    @torch.no_grad()
    def launch(self, gradients: Mapping[str, Tensor], noted: Tensor, factors: Tensor) -> None:
        """Update the parameters, without counting that.

        Args:
            gradients: By the parameters' names, of their shapes.
            noted: Becomes NaN if a gradient was not finite. float32 [1]
            factors: What `factors` returned, on the parameters' device. [2, P]
        """
        from sadgs_ns.kernels.adam import adam_step_with_factors

        begin = 0
        for (_, betas, eps), names in self._launches:
            these, begin = slice(begin, begin + len(names)), begin + len(names)
            parameters = tuple(self.parameters[name] for name in names)
            in_order = tuple(gradients[name].contiguous() for name in names)
            adam_step_with_factors(
                parameters, in_order, self.exp_avgs[these], self.exp_avg_sqs[these], noted, factors[:, these],
                betas=betas, eps=eps, max_gradient=MAX_GRADIENT,
            )  # fmt: skip


class SadgsOptimizers(Optimizers):
    """nerfstudio's set of optimizers, which updates in one launch all parameters that `FusedAdam` updates in Triton.

    At 300k Gaussians the GPU waits for the host, which spent a quarter of a step on six optimizers. Parameters whose
    gradients are scaled or clipped (max_norm), and those of other optimizers, are updated as in nerfstudio. Hooks on
    the `step` of optimizers that are updated together are not called.
    """

    def zero_grad_some(self, param_groups: list[str]) -> None:
        """Forget the gradients of the named parameters; torch's own way takes the host 60 times as long."""
        for name in param_groups:
            optimizer = self.optimizers[name]
            # nerfstudio would keep the parameters of the start, which densification has replaced: they would hold
            # memory, and gradients would be clipped on them instead of on the present ones.
            self.parameters[name] = optimizer.param_groups[0]["params"]
            if not isinstance(optimizer, FusedAdam):
                optimizer.zero_grad()
                continue
            for group in optimizer.param_groups:
                for parameter in group["params"]:
                    parameter.grad = None

    def optimizer_scaler_step_some(self, grad_scaler: GradScaler, param_groups: list[str]) -> None:
        """Update the named parameters."""
        together: dict[str, FusedAdam] = {}
        for name in param_groups:
            optimizer = self.optimizers[name]
            plain = self.config[name]["optimizer"].max_norm is None and not grad_scaler.is_enabled()
            if plain and isinstance(optimizer, FusedAdam) and optimizer.triton:
                together[name] = optimizer
                optimizer._opt_called = True  # type: ignore[attr-defined] # torch's schedulers look for it.
        step_together(together.values())
        super().optimizer_scaler_step_some(grad_scaler, [name for name in param_groups if name not in together])


@hide("max_norm", "weight_decay")
@dataclass
class FusedAdamOptimizerConfig(AdamOptimizerConfig):
    """Adam; only its rate is an option of the command line."""

    _target: type = FusedAdam
    lr: float = 1e-3
    """Learning rate; where there is a schedule, its factors multiply it."""
    eps: Suppress[float] = 1e-15
    """What Adam adds to the root of the second moment; as in 3DGS."""


@dataclass
class RunLengthDecaySchedulerConfig(SchedulerConfig):
    """Exponential decay over the length of the run, or over its last part, whatever `--max-num-iterations` is."""

    _target: type = field(default_factory=lambda: RunLengthDecayScheduler)
    initial_factor: Suppress[float] = 1.0
    """Learning rate at the first iteration, relative to the optimizer's."""
    final_factor: float = 1.0
    """Learning rate at the last iteration, relative to the optimizer's."""
    hold_share: Suppress[float] = 0.0
    """Share of the run in [0, 1) in which the learning rate stays as at the first iteration."""
    max_steps: Suppress[int | None] = None
    """Iterations until `final_factor`; None is the length of the run."""


@hide("lr")
@dataclass
class UnlistedAdamOptimizerConfig(FusedAdamOptimizerConfig):
    """Adam whose rate `--help` does not list; a config.yml, or a benchmark's protocol, can set it."""


@hide("final_factor")
@dataclass
class UnlistedDecaySchedulerConfig(RunLengthDecaySchedulerConfig):
    """Exponential decay as above, whose factors `--help` does not list."""


class RunLengthDecayScheduler(Scheduler):
    """lr(t) = lr · initial^(1−t) · final^t with t the fraction that has passed of the run after `hold_share`."""

    config: RunLengthDecaySchedulerConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LambdaLR:
        """Make torch's scheduler. Its state holds Python numbers only, which torch's safe loader loads."""
        max_steps = self.config.max_steps
        if max_steps is None:
            raise ValueError("max_steps is unset: SadgsTrainer sets it to the length of the run.")
        initial, final, hold = self.config.initial_factor, self.config.final_factor, self.config.hold_share

        def factor(step: int) -> float:
            t = min(max((step / max(max_steps, 1) - hold) / (1 - hold), 0.0), 1.0)
            return float(initial ** (1 - t) * final**t)

        return LambdaLR(optimizer, factor)
