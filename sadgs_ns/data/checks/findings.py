"""The findings of a check, and how an error among them stops a run."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sadgs_ns.data.layouts import unreadable
from sadgs_ns.errors import InputError


@dataclass(frozen=True)
class Finding:
    """One thing to know about a data folder."""

    severity: Literal["error", "warning", "note"]  # Training is refused, may disappoint, or is worth a remark
    sentence: str  # A sentence that names the file and the remedy

    def __post_init__(self) -> None:  # A damaged file's names can hold a line's end.
        object.__setattr__(self, "sentence", _printable(self.sentence))


def _printable(text: str) -> str:
    """Return a text in which what cannot be printed is written as Python's ascii() does."""
    characters = []
    for character in text:
        if character.isprintable():
            characters.append(character)
        else:
            characters.append(ascii(character)[1:-1])
    return "".join(characters)


def fault(sentence: str) -> Finding:
    """Return the finding of an error."""
    return Finding("error", sentence)


def warning(sentence: str) -> Finding:
    """Return the finding of a warning."""
    return Finding("warning", sentence)


def note(sentence: str) -> Finding:
    """Return the finding of a remark."""
    return Finding("note", sentence)


def collect_findings(check: Callable[..., Iterator[Finding]]) -> Callable[..., list[Finding]]:
    """Make a list of a check's findings; where the check gives up with an error, that is the only finding."""

    @functools.wraps(check)
    def findings(*args: Any, **kwargs: Any) -> list[Finding]:
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # Some numbers are nearly infinite.
                return list(check(*args, **kwargs))
        except InputError as error:
            return [fault(str(error))]
        except OSError as error:
            return [fault(unreadable(error))]

    return findings


def and_more(where: object, count: int) -> str:
    """Return the start of a sentence on several files or views: the first of them, and how many others there are."""
    if count > 1:
        return f"{where} (and {count - 1} more)"
    return str(where)


def check_findings(findings: Sequence[Finding], data: Path) -> None:
    """Raise InputError with the first error among findings, if there is one, and how many more there are."""
    errors = [finding.sentence for finding in findings if finding.severity == "error"]
    if len(errors) > 1:
        raise InputError(f"{errors[0]} (`sadgs-doctor {data}` shows {len(errors) - 1} more.)")
    if errors:
        raise InputError(errors[0])
