"""The plan of a run: all values that `config.yml` leaves to rules, decided once before training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import yaml

from sadgs_ns.errors import InputError
from sadgs_ns.files import atomic_path
from sadgs_ns.method.schedule import Schedule, between_one_and_four
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.training.step.optimizers import RunLengthDecaySchedulerConfig

RATES_OF_FOUR_VIEWS = {"means": (3.0, 3.0), "opacities": (1.5, 1.5), "scales": (2.25, 0.375), "quats": (2.25, 0.375)}
"""Factors on learning rates at the first and at the last iteration in steps of four views. Rates that fall after
densification fall less in steps of several views, and not at all in steps of four."""
_HEAD = "# What was decided for this run before its first step; config.yml says what was asked for.\n"


@dataclass(frozen=True)
class Rate:
    """The learning rate of a group of parameters, and its decay as in `RunLengthDecaySchedulerConfig`."""

    lr: float
    initial_factor: float = 1.0
    final_factor: float = 1.0
    hold_share: float = 0.0
    max_steps: int | None = None  # Iterations of the decay; None if there is none, or another kind of scheduler


@dataclass(frozen=True)
class RunPlan:
    """What was decided for a run, in `plan.yml` and its checkpoints; `SadgsModel.follow` replaces it.

    A field that is added here, to `Rate` or to the strategy needs a default: checkpoints of earlier versions lack it.
    """

    iterations: int  # Length of the run in optimizer steps
    views_per_iteration: int  # Training views of a step; the loss is their mean
    devices: int  # Number of devices, each with a process and a part of the Gaussians
    images: str  # Where the images are kept: "gpu" (the training device), "cpu" (the host), or "compressed"
    near_plane: float  # Depth from which Gaussians are drawn, in the run's units
    max_off_axis: float  # As in the model's options
    strategy: StructureAwareStrategy  # Densification with the run's windows, thresholds and cap
    rates: dict[str, Rate]  # Learning rates by group of parameters
    requested: dict[str, Any]  # Pipeline options from which this was derived, by their names
    dropout: float = 0.0  # Probability with which a step leaves a Gaussian out

    @classmethod
    def of(cls, state: Mapping[str, Any]) -> RunPlan:
        """Make a plan of its `asdict`, which checkpoints hold, as this version or another one wrote it.

        Fields that this version does not have are left out (`unknown_fields`), and missing ones get their defaults.
        Raise InputError if one that has no default is missing.
        """
        values = _known_values(cls, state, "")
        strategy = _known_values(StructureAwareStrategy, state["strategy"], "strategy.")
        values["strategy"] = StructureAwareStrategy(**strategy)
        rates = {}
        for name, rate in state["rates"].items():
            rates[name] = Rate(**_known_values(Rate, rate, f"rates.{name}."))
        values["rates"] = rates
        return cls(**values)

    def write(self, folder: Path) -> None:
        """Write `plan.yml` into a run's folder. Raise WriteError if that is not possible."""
        with atomic_path(folder / "plan.yml") as partial:
            partial.write_text(_HEAD + yaml.safe_dump(asdict(self), sort_keys=False), "utf8")

    def optimizers(self, configs: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
        """Return nerfstudio's configurations of optimizers and schedulers with the planned rates."""
        planned = {}
        for name, rate in self.rates.items():
            group = configs[name]
            decay = asdict(rate)
            optimizer = replace(group["optimizer"], lr=decay.pop("lr"))
            scheduler = group.get("scheduler")
            if rate.max_steps is not None:
                scheduler = RunLengthDecaySchedulerConfig(**decay)
            planned[name] = {"optimizer": optimizer, "scheduler": scheduler}
        return planned


def unknown_fields(state: Mapping[str, Any]) -> list[str]:
    """Return the names of fields in a plan's `asdict` that this version does not have, such as "strategy.tau_split"."""
    parts: list[tuple[str, type, Mapping[str, Any]]] = [
        ("", RunPlan, state),
        ("strategy.", StructureAwareStrategy, state["strategy"]),
    ]
    for rate in state["rates"].values():
        parts.append(("rates.", Rate, rate))
    names = []
    for prefix, cls, values in parts:
        known = {field.name for field in fields(cls)}
        names += [prefix + name for name in values if name not in known]
    return list(dict.fromkeys(names))  # All groups of rates have the same fields.


def _known_values(cls: type, values: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Return the values of a dataclass's fields. Raise InputError if one is missing that has no default.

    `prefix` is what the error puts before the field's name.
    """
    known = {}
    for field in fields(cls):
        if field.name in values:
            known[field.name] = values[field.name]
        elif field.default is MISSING and field.default_factory is MISSING:
            problem = f"The checkpoint's plan has no {prefix}{field.name}"
            raise InputError(f"{problem}: load it with the version of sadgs that wrote it.")
    return known


def plan_rates(
    configs: Mapping[str, Mapping[str, Any]], length: Schedule, extent: float, follow_views: bool
) -> dict[str, Rate]:
    """Derive a run's learning rates from nerfstudio's configurations, which are for steps of one view.

    That of positions is in proportion to the cameras' extent, as in 3DGS; `follow_views` uses `RATES_OF_FOUR_VIEWS`.
    """
    rates = {}
    for name, group in configs.items():
        lr = group["optimizer"].lr
        decay = group.get("scheduler")
        start = 1.0
        end = 1.0
        if follow_views and name in RATES_OF_FOUR_VIEWS:
            start_of_four, end_of_four = RATES_OF_FOUR_VIEWS[name]
            start = between_one_and_four(length.views_per_iteration, start_of_four)
            end = between_one_and_four(length.views_per_iteration, end_of_four)
        lr *= start
        if name == "means":
            lr *= extent
        if decay is None and start != end:
            decay = RunLengthDecaySchedulerConfig()
        if not isinstance(decay, RunLengthDecaySchedulerConfig):
            rates[name] = Rate(lr)
            continue
        final = decay.final_factor * (end / start)
        if follow_views and decay.hold_share > 0:
            final *= between_one_and_four(length.views_per_iteration, 1 / final)
        steps = decay.max_steps
        if steps is None:
            steps = length.iterations
        rates[name] = Rate(lr, decay.initial_factor, final, decay.hold_share, steps)
    return rates
