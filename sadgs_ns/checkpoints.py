"""Which checkpoint a run resumes from, read so that nothing in the file is executed."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path
from typing import Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE

_NAME = re.compile(r"step-(\d+)\.ckpt")
_PARTS = ("step", "pipeline", "optimizers", "scalers")


def read(path: Path) -> dict[str, Any]:
    """Read one checkpoint into the CPU's memory, with torch's safe loader whatever its version and environment say.

    Raises:
        ValueError: There is no such file, it is cut off or damaged, or it holds anything but a checkpoint's tensors and
            plain values; one sentence that names it.
    """
    if not path.is_file():
        raise ValueError(f"{path} is not there; give --load-dir the folder nerfstudio_models of a run.")
    try:
        with zipfile.ZipFile(path) as file:  # torch itself does not look at the checksums
            if (damaged := file.testzip()) is not None:
                raise zipfile.BadZipFile(f"wrong checksum of {damaged}")
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # zip, pickle and tensors each raise their own
        reason = re.split(r"(?<=[a-z])[.:]\s|\n", str(error).strip(), maxsplit=1)[0] or type(error).__name__
        raise ValueError(f"{path} is cut off, damaged or not of tensors and plain values alone ({reason}).") from error
    if not isinstance(state, dict) or not all(part in state for part in _PARTS) or type(state["step"]) is not int:
        raise ValueError(f"{path} is not a checkpoint that nerfstudio's trainer wrote.")
    return state


def read_latest(folder: Path) -> tuple[Path, dict[str, Any]]:
    """Read the checkpoint of the latest step; for each that cannot be read, say so and take the one before it.

    Other files in the folder, such as those of a save that was killed, are ignored.

    Returns:
        Its path and its content.

    Raises:
        ValueError: There is no checkpoint in the folder, or none that can be read; one sentence.
    """
    steps = {int(match[1]): path for path in folder.glob("*") if (match := _NAME.fullmatch(path.name))}
    if not steps:
        raise ValueError(f"{folder} holds no checkpoint (step-*.ckpt); give --load-dir a run's nerfstudio_models.")
    reasons = []
    for step in sorted(steps, reverse=True):
        try:
            state = read(steps[step])
        except ValueError as error:
            reasons.append(str(error))
            continue
        for reason in reasons:
            CONSOLE.print(f"{reason} Going on from step {step} instead.", style="yellow", markup=False, soft_wrap=True)
        return steps[step], state
    raise ValueError(
        f"{reasons[0]} {folder} holds no other that can be read: train from the start, without --load-dir."
    )
