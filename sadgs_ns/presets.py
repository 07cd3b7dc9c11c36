"""The registered methods, read from the YAML presets in `configs/`, which are their one source."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from nerfstudio.plugins.types import MethodSpecification

from sadgs_ns.errors import InputError
from sadgs_ns.optimizers import FusedAdamOptimizerConfig, RunLengthDecaySchedulerConfig
from sadgs_ns.trainer import SadgsTrainerConfig

if TYPE_CHECKING:
    from importlib.abc import Traversable


def load_preset(name: str) -> MethodSpecification:
    """Read `configs/NAME.yaml` into a method.

    Besides `description`, the keys are those of the method's configuration, nested as on its command line. An entry
    of `optimizers` holds fields of `FusedAdamOptimizerConfig` and, under `schedule`, of
    `RunLengthDecaySchedulerConfig`.

    Args:
        name: The preset and the method, such as `sadgs-indoor`.

    Raises:
        FileNotFoundError: If there is no such preset.
        ValueError: If the preset has an unknown key or a value of another kind.
    """
    values = yaml.safe_load((_configs() / f"{name}.yaml").read_text(encoding="utf8"))
    description = values.pop("description")
    optimizers = values.pop("optimizers")
    config = SadgsTrainerConfig(method_name=name, vis="viewer")
    set_fields(config, values, where=f"{name}.yaml")
    config.optimizers = {
        group: _optimizer(dict(entry), f"{name}.yaml: optimizers.{group}") for group, entry in optimizers.items()
    }
    return MethodSpecification(config=config, description=description)


def _configs() -> Traversable:
    """The folder of presets: installed as `sadgs_ns.configs`, `configs/` beside the package in a checkout."""
    try:
        return files("sadgs_ns.configs")
    except ModuleNotFoundError:
        return Path(__file__).parents[1] / "configs"


def set_fields(config: Any, values: Mapping[str, Any], where: str) -> None:
    """Set nested dataclass fields in place, strictly.

    Args:
        config: A dataclass instance.
        values: Field names to values, or to mappings where the field is itself a dataclass.
        where: What errors name as the place of the values.

    Raises:
        ValueError: If a name is unknown or a value is of another kind than the field's present one.
    """
    known = {f.name for f in dataclasses.fields(config)}
    for name, value in values.items():
        if name not in known:
            raise ValueError(f"{where}: unknown key {name!r}; known are {', '.join(sorted(known))}.")
        current = getattr(config, name)
        if dataclasses.is_dataclass(current) and isinstance(value, Mapping):
            set_fields(current, value, where=f"{where}: {name}")
            continue
        if isinstance(current, float) and type(value) is int:
            value = float(value)
        if current is not None and type(value) is not type(current):
            raise ValueError(
                f"{where}: {name} must be of type {type(current).__name__}, got {type(value).__name__} {value!r}."
            )
        setattr(config, name, value)


def _optimizer(entry: dict[str, Any], where: str) -> dict[str, Any]:
    schedule = entry.pop("schedule", None)
    optimizer = FusedAdamOptimizerConfig()
    set_fields(optimizer, entry, where)
    if schedule is None:
        return {"optimizer": optimizer, "scheduler": None}
    scheduler = RunLengthDecaySchedulerConfig()
    set_fields(scheduler, schedule, f"{where}.schedule")
    return {"optimizer": optimizer, "scheduler": scheduler}


def _registered(name: str) -> MethodSpecification:
    """A preset for nerfstudio's commands, which then end with one sentence if it has a mistake."""
    try:
        return load_preset(name)
    except ValueError as error:
        raise InputError(f"{_configs() / f'{name}.yaml'} has a mistake: {error}") from error


sadgs = _registered("sadgs")
sadgs_indoor = _registered("sadgs-indoor")
sadgs_large = _registered("sadgs-large")
