"""Hide options from `--help`, and check the ranges of their values."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar, get_type_hints

from tyro.conf import Suppress

from sadgs_ns.errors import InputError

_Class = TypeVar("_Class", bound=type)


def hide(*names: str) -> Callable[[_Class], _Class]:
    """Make a decorator of a dataclass that keeps fields, by their names, out of `--help`."""

    def mark(cls: _Class) -> _Class:
        hints = get_type_hints(cls, include_extras=True)
        cls.__annotations__ |= {name: Suppress[hints[name]] for name in names}
        return cls

    return mark


def check_ranges(prefix: str, options: object, ranges: Iterable[tuple[str, bool, str]]) -> None:
    """Raise InputError for the first option that is out of its range.

    `ranges` have an option's name, whether it is in its range, and the range as the end of "must be …".
    """
    for name, fits, allowed in ranges:
        if not fits:
            value = getattr(options, name)
            got = f"{value:g}" if isinstance(value, float) else f"{value:,}" if type(value) is int else str(value)
            raise InputError(f"{prefix}{name} must be {allowed}, got {got}.")
