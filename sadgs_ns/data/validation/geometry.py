"""Checks of numbers that all layouts share: cameras, poses and points."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sadgs_ns.data.validation.findings import Finding
from sadgs_ns.errors import InputError


def check_positive(values: dict[str, Any], where: str, names: Sequence[str]) -> None:
    """Raise InputError unless the names have finite values, positive but for the principal point."""
    for name in names:
        value = values.get(name)
        if name not in values:
            raise InputError(f"{where} has no {name}: give it one, for all frames or this one.")
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise InputError(f"{where} has {name} = {value!r}, which is no finite number: correct it.")
        if name not in ("cx", "cy") and value <= 0:
            raise InputError(f"{where} has {name} = {value}, which must be positive: correct it.")


def check_number(views: int, training: int | None, source: Path) -> Iterator[Finding]:
    """Findings for the number of views in all and of those that are trained on, where that is known."""
    if views < 2:
        yield Finding("error", f"{source} has 1 view, which shows no depth: take at least 2 images, better 20 or more.")
    elif training == 0:
        yield Finding("error", f"{source} leaves no view for training: name some in its list of training images.")
    elif training is not None and training < 3:
        yield Finding(
            "warning",
            f"{source} leaves {training} training view{'s' * (training > 1)}: so few fix no shape; take 20 or more.",
        )
    elif training == views and views < 10:
        yield Finding("note", f"{source} has {views} views, none of them held out: `ns-eval` cannot measure any.")


def check_centres(centres: np.ndarray, source: Path) -> Iterator[Finding]:
    """Findings for camera centres [V, 3]."""
    spread = np.abs(centres - centres.mean(axis=0)).max()
    if len(centres) > 1 and spread <= 1e-9 * max(np.abs(centres).max(), 1.0):
        yield Finding(
            "error", f"{source} has all {len(centres)} cameras in one place, which shows no depth: move between images."
        )
