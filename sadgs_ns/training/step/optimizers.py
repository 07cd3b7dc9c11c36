"""Adam in one launch for all parameters, and learning rates that decay over the run's length."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from inspect import unwrap
from typing import Any

import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig, Optimizers
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch import Tensor
from torch.optim import Adam, Optimizer
from torch.optim.lr_scheduler import LambdaLR

from sadgs_ns.kernels import use_triton
from sadgs_ns.training.options import Hidden, hide
from sadgs_ns.training.step.nonfinite import MAX_GRADIENT, leave_out_nonfinite
from sadgs_ns.training.step.row_adam import RowUpdate, empty_moments, move_rows

_ONE = torch.tensor(1.0, device="cpu")  # Adding this to a count of steps takes a third of the time of adding Python's 1


class FusedAdam(Adam):
    """torch's fused Adam of one parameter, or its state that our kernel updates."""

    # Around these methods torch has others that import its compiler, which takes a second.
    add_param_group = unwrap(Adam.add_param_group)
    state_dict = unwrap(Adam.state_dict)
    load_state_dict = unwrap(Adam.load_state_dict)
    step = torch.no_grad()(unwrap(Adam.step))

    def __init__(self, params: Iterable[Tensor], **options: Any) -> None:
        (parameter,) = params
        # torch's fused Adam keeps the step count on the device, where the host would have to wait for it.
        super().__init__([parameter], fused=not use_triton(parameter.device), **options)


class RowAdam(FusedAdam):
    """Adam's state of a table, of which an update moves some rows (row_adam.py)."""


class AdamUpdate:
    """An update of parameters, given by name, by our kernel, or else by torch's fused Adam, all on one device.

    One launch of the kernel updates all parameters of one length with equal betas and eps, which spares the host's
    time. Tables with a `RowAdam` come last. Gradients of at least `nonfinite.MAX_GRADIENT`, or NaN, count as 0.
    """

    def __init__(self, optimizers: Mapping[str, Adam]) -> None:
        alike: dict[tuple[int, Any, float], dict[str, Adam]] = {}  # By length, betas and eps
        self._tables = {name: adam for name, adam in optimizers.items() if isinstance(adam, RowAdam)}
        for name, optimizer in optimizers.items():
            if name in self._tables:
                continue
            group = optimizer.param_groups[0]
            key = (len(group["params"][0]), group["betas"], group["eps"])
            alike.setdefault(key, {})[name] = optimizer
        self._launches = [(key, list(chosen)) for key, chosen in alike.items()]
        self._optimizers = {name: adam for chosen in alike.values() for name, adam in chosen.items()}
        self._optimizers |= self._tables
        self._groups = [adam.param_groups[0] for adam in self._optimizers.values()]
        present = (group["params"][0] for group in self._groups)
        self.parameters: dict[str, Tensor] = dict(zip(self._optimizers, present, strict=True))
        self.device = next(iter(self.parameters.values())).device
        self._triton = use_triton(self.device)
        self._states = [self._optimizers[name].state[parameter] for name, parameter in self.parameters.items()]
        for (name, parameter), state in zip(self.parameters.items(), self._states, strict=True):
            if self._triton and not state and name not in self._tables:
                state["step"] = torch.tensor(0.0)
                state["exp_avg"] = torch.zeros_like(parameter)
                state["exp_avg_sq"] = torch.zeros_like(parameter)
        for name, adam in self._tables.items():
            table = self.parameters[name]
            state = adam.state[table]
            if not state:
                state.update(empty_moments(table))
            state["step"] = state["step"].to(table.device)  # A checkpoint's may be on the host.
        self.exp_avgs = tuple(state["exp_avg"] for state in self._states if state)
        self.exp_avg_sqs = tuple(state["exp_avg_sq"] for state in self._states if state)

    def tensors(self) -> list[Tensor]:
        """Return all tensors that an update changes in place."""
        counts = [adam.state[self.parameters[name]]["step"] for name, adam in self._tables.items()]
        return [*self.parameters.values(), *self.exp_avgs, *self.exp_avg_sqs, *counts]

    def factors(self) -> Tensor:
        """Count an update of each parameter, and return the factors of `rate_and_scale` for our kernel.

        They are float32 [2, P] on the host, in pinned memory with CUDA, and [2, 0] where torch's Adam is used. Tables
        come last, with their learning rates and 1.
        """
        if not self._triton:
            return torch.empty((2, 0))
        from sadgs_ns.kernels.adam import rate_and_scale

        columns = []  # Two factors of each parameter
        for name, group, state in zip(self.parameters, self._groups, self._states, strict=True):
            if name in self._tables:  # The device counts the updates of each row.
                columns.append((group["lr"], 1.0))
                continue
            state["step"] = state["step"].cpu() + _ONE
            columns.append(rate_and_scale(int(state["step"]), group["lr"], group["betas"]))
        return torch.tensor(list(zip(*columns, strict=True)), pin_memory=self.device.type == "cuda")

    @torch.no_grad()
    def launch(
        self,
        gradients: Mapping[str, Tensor],
        factors: Tensor,
        nonfinite_flag: Tensor,
        overflowed: tuple[Tensor, ...] = (),
        rows: RowUpdate | None = None,
    ) -> None:
        """Update the parameters by gradients, given by the parameters' names.

        Args:
            gradients: Each has its parameter's shape.
            factors: From `factors`, on the device; torch's Adam ignores them. [2, P]
            nonfinite_flag: Becomes NaN if a gradient is not finite. [1]
            overflowed: As for `kernels.adam.adam_step`; torch's Adam ignores it.
            rows: The rows of the tables that are moved, and how far. Without it the tables stay.
        """
        if rows is not None:
            self._move_tables(gradients, factors, nonfinite_flag, rows)
        if not self._triton:
            for name, optimizer in self._optimizers.items():
                if name in self._tables:
                    continue
                leave_out_nonfinite(gradients[name], nonfinite_flag)
                self.parameters[name].grad = gradients[name]
                optimizer.step()
                self.parameters[name].grad = None
            return
        from sadgs_ns.kernels.adam import adam_step

        begin = 0
        for (_, betas, eps), names in self._launches:
            part = slice(begin, begin + len(names))
            begin = begin + len(names)
            parameters = tuple(self.parameters[name] for name in names)
            chosen = tuple(gradients[name].contiguous() for name in names)
            adam_step(
                parameters, chosen, self.exp_avgs[part], self.exp_avg_sqs[part], factors[:, part], nonfinite_flag,
                overflowed, betas=betas, eps=eps, max_gradient=MAX_GRADIENT,
            )  # fmt: skip

    def _move_tables(
        self, gradients: Mapping[str, Tensor], factors: Tensor, nonfinite_flag: Tensor, rows: RowUpdate
    ) -> None:
        """Update the tables, whose columns of `factors` are the last ones."""
        first = len(self.parameters) - len(self._tables)
        for column, (name, adam) in enumerate(self._tables.items(), first):
            table = self.parameters[name]
            group = adam.param_groups[0]
            rate: Tensor | float = group["lr"]
            if self._triton:
                rate = factors[0, column]
            move_rows(
                table, gradients[name], adam.state[table], rows, rate, group["betas"], group["eps"], nonfinite_flag
            )


class SadgsOptimizers(Optimizers):
    """nerfstudio's set of optimizers, each a `FusedAdam`, whose parameters are updated together."""

    def __init__(self, config: dict[str, Any], param_groups: dict[str, list[torch.nn.Parameter]]) -> None:
        super().__init__(config, param_groups)
        # nerfstudio would keep the first parameters, which densification replaces, to clip their gradients.
        self.parameters.clear()

    def load_optimizers(self, loaded_state: dict[str, Any]) -> None:
        """Take over a checkpoint's moments and counts of steps; rates, betas and eps stay those of this run."""
        for name, state in loaded_state.items():
            optimizer = self.optimizers[name]
            own_groups = optimizer.state_dict()["param_groups"]
            optimizer.load_state_dict({**state, "param_groups": own_groups})

    def go_on_after(self, iterations: int, loaded_state: Mapping[str, Any]) -> None:
        """Set the rates to those of this run's schedules after some iterations, also where a checkpoint had none.

        Schedulers of other kinds than ours take over what the checkpoint has of them.
        """
        for name, scheduler in self.schedulers.items():
            if not isinstance(scheduler, LambdaLR):
                if name in loaded_state:
                    scheduler.load_state_dict(loaded_state[name])
                continue
            # torch sets the rate of the optimizer when it makes a scheduler, and does the first step then.
            gone_on = LambdaLR(scheduler.optimizer, scheduler.lr_lambdas, last_epoch=iterations - 1)
            gone_on._step_count = iterations + 1
            self.schedulers[name] = gone_on

    def update(self) -> AdamUpdate:
        """Return an update of all present parameters that are not empty."""
        adams: Any = self.optimizers.items()
        for _, adam in adams:
            adam._opt_called = True  # for torch's schedulers
        return AdamUpdate({name: adam for name, adam in adams if adam.param_groups[0]["params"][0].numel()})


@hide("max_norm", "weight_decay")
@dataclass
class FusedAdamOptimizerConfig(AdamOptimizerConfig):
    """Adam; only its rate is an option on the command line."""

    _target: type = FusedAdam
    lr: float = 1e-3
    """Learning rate; where there is a schedule, its factors multiply it."""
    eps: Hidden[float] = 1e-15
    """Adam adds this to the root of the second moment; as in 3DGS."""


@hide("max_norm", "weight_decay")
@dataclass
class RowAdamOptimizerConfig(FusedAdamOptimizerConfig):
    """Adam of the poses' corrections, of which a step moves those of its views."""

    _target: type = RowAdam
    lr: float = 0.05
    """About how far a step moves the image of each of its views, in px; its schedule's factors multiply it."""


@dataclass
class RunLengthDecaySchedulerConfig(SchedulerConfig):
    """Exponential decay over the run, or over its last part, whatever `--max-num-iterations` is."""

    _target: type = field(default_factory=lambda: RunLengthDecayScheduler)
    initial_factor: Hidden[float] = 1.0
    """Learning rate at the first iteration, relative to the optimizer's."""
    final_factor: float = 1.0
    """Learning rate at the last iteration, relative to the optimizer's."""
    hold_share: Hidden[float] = 0.0
    """Share of the run in [0, 1) in which the learning rate stays as at the first iteration."""
    max_steps: Hidden[int | None] = None
    """Iterations until `final_factor`; None is the length of the run."""


class RunLengthDecayScheduler(Scheduler):
    """lr(t) = lr · initial^(1−t) · final^t with t the fraction of the run after `hold_share` that has passed."""

    config: RunLengthDecaySchedulerConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LambdaLR:
        """Make torch's scheduler, whose state torch's safe loader can load."""
        max_steps = self.config.max_steps
        hold = self.config.hold_share
        initial = self.config.initial_factor
        final = self.config.final_factor
        assert max_steps is not None, "the plan of the run sets it"

        def factor(step: int) -> float:
            t = min(max((step / max(max_steps, 1) - hold) / (1 - hold), 0.0), 1.0)
            return float(initial ** (1 - t) * final**t)

        return LambdaLR(optimizer, factor)


def pose_optimizer() -> dict[str, Any]:
    """Return Adam and the schedule of refined poses."""
    return {"optimizer": RowAdamOptimizerConfig(), "scheduler": RunLengthDecaySchedulerConfig(final_factor=0.1)}
