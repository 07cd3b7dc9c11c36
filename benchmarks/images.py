"""Held-out views of a run as PNG, beside the photographs, for looking at."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from benchmarks.evaluate import View, render
from sadgs_ns.atomic import atomic_path

MAX_VIEWS = 4
"""Views of a scene that are kept."""


def file_name(text: str) -> str:
    """A text as the name of a file or folder; different texts get different names."""
    safe = re.sub(r"^\.+|^$|[^A-Za-z0-9._-]+", "_", text)
    return safe if safe == text else f"{safe}-{hashlib.sha256(text.encode()).hexdigest()[:6]}"


def chosen(count: int) -> list[int]:
    """Which of some views are kept: at most MAX_VIEWS, evenly spaced, the first and the last among them."""
    return torch.linspace(0, count - 1, min(count, MAX_VIEWS)).round().long().tolist()


def save(
    model: Any, views: Sequence[View], names: Sequence[str], folder: Path, scene: str, label: str, seed: int
) -> list[str]:
    """Render held-out views in eval mode and write them and their photographs.

    The photographs go to `scene/truth/view.png`, with their alpha channel if they have one, the renderings to
    `scene/label-seed/view.png`, the background behind them. Names that are not safe for a file are changed. What is
    there is replaced; a file appears complete or not at all.

    Args:
        views: All held-out views.
        names: Of the views' images, without a suffix; one that several have gets a number.
        folder: Created, with its parents.

    Returns:
        The renderings' paths, relative to the folder, with slashes.
    """
    paths = []
    for index in chosen(len(views)):
        name = names[index] if names.count(names[index]) == 1 else f"{names[index]}-{index}"
        picture = f"{file_name(name)}.png"
        image, _ = render(model, views[index])  # [1, 3, H, W]
        path = Path(file_name(scene), f"{file_name(label)}-{seed}", picture)
        _write(folder / path, image[0].movedim(0, -1))
        truth = folder / file_name(scene) / "truth" / picture
        # Runs side by side write the same photograph: each by way of a file of its own.
        _write(truth, views[index][1]["image"], beside=truth.with_name(f"{path.parent.name}-{picture}"))
        paths.append(path.as_posix())
    return paths


def _write(path: Path, image: Tensor, beside: Path | None = None) -> None:
    """image: [H, W, 3 or 4], uint8 or float in [0, 1]; `beside` as in `atomic_path`"""
    if image.dtype != torch.uint8:
        image = (255 * image).round().byte()
    with atomic_path(path, beside) as partial:
        Image.fromarray(image.cpu().numpy()).save(partial)
