"""The registered methods, read from the YAML presets in `configs/`, which are their one source."""

from __future__ import annotations

import dataclasses
import reprlib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

import yaml
from nerfstudio.plugins.types import MethodSpecification
from typeguard import CollectionCheckStrategy, TypeCheckError, check_type

from sadgs_ns.errors import InputError
from sadgs_ns.plugin.optimizers import FusedAdamOptimizerConfig, RunLengthDecaySchedulerConfig
from sadgs_ns.plugin.trainer import SadgsTrainerConfig

if TYPE_CHECKING:
    from importlib.abc import Traversable

OPTIMIZER_GROUPS = (
    "means",
    "features_dc",
    "features_rest",
    "opacities",
    "scales",
    "quats",
    "camera_opt",
    "bilateral_grid",
)
"""What a preset must name an optimizer for: the Gaussians' parameters, and what nerfstudio's options add."""


def load_preset(name: str) -> MethodSpecification:
    """Read `configs/NAME.yaml` into a method.

    A preset with a `base` begins with that one's values. Besides `description`, the keys are those of the method's
    configuration, nested as on its command line. An entry of `optimizers` holds fields of `FusedAdamOptimizerConfig`
    and, under `schedule`, of `RunLengthDecaySchedulerConfig`.

    Args:
        name: The preset and the method, such as `sadgs-indoor`.

    Raises:
        FileNotFoundError: If there is no such preset.
        ValueError: If it is not YAML, lacks a key, or has an unknown key or a value of another kind; one line that
            names the file and the key.
    """
    where = f"{name}.yaml"
    values = _read(where)
    for key in ("description", "optimizers"):
        if key not in values:
            raise ValueError(f"{where} lacks {key!r}; add it.")
    description, optimizers = values.pop("description"), values.pop("optimizers")
    if not isinstance(description, str):
        raise ValueError(f"{where}: description must be text, got {_show(description)}.")
    config = SadgsTrainerConfig(method_name=name, vis="viewer")
    set_fields(config, values, where)
    groups = _mapping(optimizers, f"{where}: optimizers")
    for group in groups:
        if group not in OPTIMIZER_GROUPS:
            raise ValueError(
                f"{where}: optimizers: unknown group {_show(group)}; known are {', '.join(OPTIMIZER_GROUPS)}."
            )
    config.optimizers = {group: _optimizer(entry, f"{where}: optimizers.{group}") for group, entry in groups.items()}
    for group in OPTIMIZER_GROUPS:
        if group not in groups:
            raise ValueError(f"{where}: optimizers lacks {group!r}; add it.")
    return MethodSpecification(config=config, description=description)


def _read(where: str) -> dict[Any, Any]:
    """Values of a file of presets, on top of its base's."""
    values = _read_alone(where)
    if "base" not in values:
        return values
    base = values.pop("base")
    known = sorted(p.name[:-5] for p in _configs().iterdir() if p.name.endswith(".yaml") and p.name != where)
    if base not in known:
        others = ", ".join(known)
        raise ValueError(f"{where}: base must be the name of another preset, got {_show(base)}; known are {others}.")
    below = _read_alone(f"{base}.yaml")
    if "base" in below:
        raise ValueError(f"{where}: base {base} has a base itself; name a preset that has none.")
    return _merged(below, values)


def _read_alone(where: str) -> dict[Any, Any]:
    return _mapping(_parse((_configs() / where).read_bytes(), where), where)


def _merged(below: dict[Any, Any], above: dict[Any, Any]) -> dict[Any, Any]:
    """Nested mappings, the second's values before the first's."""
    both = [key for key in above if isinstance(above[key], dict) and isinstance(below.get(key), dict)]
    return {**below, **above, **{key: _merged(below[key], above[key]) for key in both}}


def _parse(content: bytes, where: str) -> Any:
    """YAML that names no Python objects → its values."""
    try:
        return yaml.safe_load(content)
    except Exception as error:  # for some malformed values and deep nesting PyYAML raises more than its YAMLError
        reason = " ".join(str(error).split())
        raise ValueError(f"{where} is not YAML ({type(error).__name__}: {reason}).") from error


def _configs() -> Traversable:
    """The folder of presets: installed as `sadgs_ns.configs`, `configs/` beside the package in a checkout."""
    try:
        return files("sadgs_ns.configs")
    except ModuleNotFoundError:
        return Path(__file__).parents[2] / "configs"


def set_fields(config: Any, values: Mapping[str, Any], where: str) -> None:
    """Set nested dataclass fields in place, strictly.

    Args:
        config: A dataclass instance.
        values: Field names to values, or to mappings where the field is itself a dataclass.
        where: What errors name as the place of the values.

    Raises:
        ValueError: If a name is unknown or a value is of another kind than the field's present one.
    """
    known = {f.name for f in dataclasses.fields(config) if not f.name.startswith("_")}
    hints = get_type_hints(type(config))
    for name, value in values.items():
        if name not in known:
            raise ValueError(f"{where}: unknown key {_show(name)}; known are {', '.join(sorted(known))}.")
        current = getattr(config, name)
        if dataclasses.is_dataclass(current) and isinstance(value, Mapping):
            set_fields(current, value, where=f"{where}: {name}")
        else:
            setattr(config, name, _of_kind(hints[name], current, value, f"{where}: {name}"))


def _of_kind(hint: Any, current: Any, value: Any, where: str) -> Any:
    """The value, a float or Path where those are asked for, if it is of the field's type and the present value's."""
    kinds = {hint, *get_args(hint)}
    if type(value) is int and float in kinds and int not in kinds:
        try:
            value = float(value)
        except OverflowError as error:
            raise ValueError(f"{where} is {_show(value)}, too large a number.") from error
    elif isinstance(value, str) and Path in kinds:
        value = Path(value)
    if current is not None and value is not None and type(value) is not type(current):
        raise ValueError(
            f"{where} must be of type {type(current).__name__}, got {type(value).__name__} {_show(value)}."
        )
    try:
        check_type(value, hint, collection_check_strategy=CollectionCheckStrategy.ALL_ITEMS)
        if isinstance(value, bool) and not kinds & {bool, Any}:  # to Python it is an int
            raise TypeCheckError("is bool")
    except TypeCheckError as error:
        asked = hint.__name__ if isinstance(hint, type) else str(hint).replace("typing.", "")
        raise ValueError(f"{where} must be {asked}, got {type(value).__name__} {_show(value)}.") from error
    return value


def _mapping(value: Any, where: str) -> dict[Any, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{where} must be a mapping of names to values, got {type(value).__name__} {_show(value)}.")
    return dict(value)


def _show(value: Any) -> str:
    """At most a few words of a value, in one line."""
    shorten = reprlib.Repr()
    shorten.maxstring = shorten.maxother = 80
    return shorten.repr(value)


def _optimizer(entry: Any, where: str) -> dict[str, Any]:
    values = _mapping(entry, where)
    schedule = values.pop("schedule", None)
    optimizer = FusedAdamOptimizerConfig()
    set_fields(optimizer, values, where)
    if schedule is None:
        return {"optimizer": optimizer, "scheduler": None}
    scheduler = RunLengthDecaySchedulerConfig()
    set_fields(scheduler, _mapping(schedule, f"{where}.schedule"), f"{where}.schedule")
    return {"optimizer": optimizer, "scheduler": scheduler}


def _registered(name: str) -> MethodSpecification:
    """A preset for nerfstudio's commands, which then end with one sentence if it has a mistake."""
    try:
        return load_preset(name)
    except ValueError as error:
        raise InputError(f"{_configs() / f'{name}.yaml'} has a mistake: {error}") from error


sadgs: MethodSpecification = _registered("sadgs")
sadgs_indoor: MethodSpecification = _registered("sadgs-indoor")
sadgs_large: MethodSpecification = _registered("sadgs-large")
sadgs_paper: MethodSpecification = _registered("sadgs-paper")
sadgs_paper_indoor: MethodSpecification = _registered("sadgs-paper-indoor")
