"""Hide options from `--help`, check the ranges of their values, and fit those of other versions to this one."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from typing import TYPE_CHECKING, Any, TypeVar, get_type_hints

from tyro.conf import Suppress

from sadgs_ns.errors import InputError

if TYPE_CHECKING or not {"-h", "--help"}.isdisjoint(sys.argv):
    Hidden = Suppress
else:

    class Hidden:
        """Marks an option that `--help` leaves out and that is accepted all the same.

        tyro refuses options that it leaves out of the help, so they are marked only where the help is printed.
        """

        def __class_getitem__(cls, kind: Any) -> Any:
            return kind


_Class = TypeVar("_Class", bound=type)


def hide(*names: str) -> Callable[[_Class], _Class]:
    """Make a decorator of a dataclass that keeps fields, by their names, out of `--help`; they are still accepted."""

    def mark(cls: _Class) -> _Class:
        hints = get_type_hints(cls, include_extras=True)
        cls.__annotations__ |= {name: Hidden[hints[name]] for name in names}
        return cls

    return mark


def check_ranges(prefix: str, options: object, ranges: Iterable[tuple[str, bool, str]]) -> None:
    """Raise InputError for the first option that is out of its range.

    `ranges` have an option's name, whether it is in its range, and the range as the end of "must be …".
    """
    for name, fits, allowed in ranges:
        if not fits:
            value = _shown(getattr(options, name))
            raise InputError(f"{prefix}{name} must be {allowed}, got {value}.")


def check_unused(prefix: str, options: Any, reasons: Mapping[str, str]) -> None:
    """Raise InputError for the first option that has another value than its default though nothing reads it.

    `reasons` say why, as the end of a sentence, by the options' names.
    """
    for field in fields(options):
        if field.name not in reasons:
            continue
        default = field.default
        if field.default_factory is not MISSING:
            default = field.default_factory()
        if getattr(options, field.name) != default:
            raise InputError(f"{prefix}{field.name} has no effect here, since {reasons[field.name]}: leave it out.")


def _shown(value: object) -> str:
    """Return an option's value as a sentence shows it."""
    if isinstance(value, float):
        return f"{value:g}"
    if type(value) is int:  # True and False are no numbers here.
        return f"{value:,}"
    return str(value)


def fill_missing(options: Any) -> None:
    """Give options their defaults where they have no value, as those that an earlier version wrote to `config.yml`.

    A class of options gives its instances plain defaults, but not those that a `default_factory` makes.
    """
    for _, part in _nested(options):
        values = vars(part)
        for field in fields(part):
            if field.name in values:
                continue
            if field.default is not MISSING:
                values[field.name] = field.default
            elif field.default_factory is not MISSING:
                values[field.name] = field.default_factory()


def drop_unknown(options: Any) -> list[str]:
    """Remove options that this version does not have, and return their names, such as "pipeline.model.sh_degree"."""
    dropped = []
    for prefix, part in _nested(options):
        known = {field.name for field in fields(part)}
        values = vars(part)
        for name in [name for name in values if name not in known and not name.startswith("_")]:
            del values[name]
            dropped.append(prefix + name)
    return dropped


def _nested(options: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield options and all options inside them, dataclasses all, each after what precedes their names."""
    if is_dataclass(options) and not isinstance(options, type):
        yield prefix, options
        inside = {field.name: getattr(options, field.name, None) for field in fields(options)}
    elif isinstance(options, Mapping):  # such as those of the optimizers, by groups of parameters
        inside = options
    else:
        return
    for name, value in inside.items():
        yield from _nested(value, f"{prefix}{name}.")
