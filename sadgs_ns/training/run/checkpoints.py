"""Choose, read and write checkpoints; reading a file never executes anything in it."""

from __future__ import annotations

import os
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.errors import InputError, reason
from sadgs_ns.files import atomic_path
from sadgs_ns.training.run.progress import warn

REMEDY = "give --load-dir the folder of a run of sadgs, or train from scratch"
_FOLDER = "nerfstudio_models"  # Name of the folder of checkpoints in a run's folder
_PARTS = ("step", "pipeline", "optimizers", "scalers")  # Keys of every checkpoint of nerfstudio's trainer


def read(path: Path, remedy: str = REMEDY, mmap: bool = False) -> dict[str, Any]:
    """Read one checkpoint into the CPU's memory with torch's safe loader, whatever torch's version and environment.

    With `mmap`, tensors stay in the file until they are used. Raises InputError, which ends with `remedy`, if the file
    is damaged, or holds anything but a checkpoint's tensors and plain values.
    """
    try:
        with zipfile.ZipFile(path) as file:  # torch itself does not check the checksums.
            if (damaged := file.testzip()) is not None:
                raise zipfile.BadZipFile(f"wrong checksum of {damaged}")
        state = torch.load(path, map_location="cpu", weights_only=True, mmap=mmap or None)
    except Exception as error:  # Damaged archives, pickles and tensors raise different errors.
        # The rest of torch's message advises to load the file unsafely.
        problem = re.split(r"(?<=[a-z])[.:]\s", reason(error), maxsplit=1)[0]
        raise InputError(
            f"{path} is cut off, damaged or not of tensors and plain values alone ({problem}): {remedy}."
        ) from error
    missing = [part for part in _PARTS if not isinstance(state, dict) or part not in state]
    if missing or type(state["step"]) is not int:
        problem = f"it has no {missing[0]}" if missing else "its step is no number"
        raise InputError(f"{path} is not a checkpoint that nerfstudio's trainer wrote ({problem}): {remedy}.")
    return state


def checkpoint_paths(load_dir: Path | None, load_step: int | None, load_checkpoint: Path | None) -> list[Path]:
    """Return the checkpoints that nerfstudio's options for resuming name, in the order to try them.

    `load_dir` is the folder of a run, or its folder of checkpoints; without `load_step` the latest one comes first.
    Raises InputError if both a folder and a file are given, or one does not exist.
    """
    if load_dir is None:
        if load_checkpoint is None:
            return []
        if not load_checkpoint.is_file():
            raise InputError(f"{load_checkpoint} is no file: give --load-checkpoint one, or --load-dir a run's folder.")
        return [load_checkpoint]
    if load_checkpoint is not None:
        raise InputError("load_dir and load_checkpoint both name where the run goes on: give one of them.")
    steps = _checkpoints_in(load_dir)
    if load_step is None:
        return [steps[step] for step in sorted(steps, reverse=True)]
    if load_step not in steps:
        there = ", ".join(map(str, sorted(steps)))
        raise InputError(f"{load_dir} holds no checkpoint of step {load_step}: give --load-step one of {there}.")
    return [steps[load_step]]


def _checkpoints_in(load_dir: Path) -> dict[int, Path]:
    """Return the checkpoints of a run's folder, or of its folder of checkpoints, by their steps."""
    if (load_dir / _FOLDER).is_dir():
        load_dir = load_dir / _FOLDER
    files = ((re.fullmatch(r"step-(\d+)\.ckpt", path.name), path) for path in sorted(load_dir.glob("*")))
    steps = {int(match[1]): path for match, path in files if match}
    if not steps:
        below = [path.parent for depth in ("*", "*/*", "*/*/*") for path in load_dir.glob(f"{depth}/{_FOLDER}")]
        latest = max(below, key=lambda run: (run / _FOLDER).stat().st_mtime, default=None)
        example = "" if latest is None else f", such as {latest}"
        raise InputError(f"{load_dir} holds no checkpoint: give --load-dir the folder of a run of sadgs{example}.")
    return steps


def map_rows(state: dict[str, Any], change: Callable[[Tensor], Tensor]) -> dict[str, Any]:
    """Return a checkpoint after `change` was applied to its tensors [N, …] of Gaussians, in a fixed order."""
    pipeline = dict(state["pipeline"])
    optimizers = dict(state["optimizers"])
    names = sorted(name for name in pipeline if ".gauss_params." in name)
    pipeline |= {name: change(pipeline[name]) for name in names}
    for name in sorted(key for name in names if (key := name.rpartition(".")[2]) in optimizers):
        moments = {index: _rows(values, change) for index, values in sorted(optimizers[name]["state"].items())}
        optimizers[name] = {**optimizers[name], "state": moments}
    if "_model._extra_state" in pipeline:
        extra = pipeline["_model._extra_state"]
        statistics = _rows(extra["strategy_state"], change)
        average = extra["average"]
        average = {**average, "means": _rows(average["means"], change)}
        pipeline["_model._extra_state"] = {**extra, "strategy_state": statistics, "average": average}
    return {**state, "pipeline": pipeline, "optimizers": optimizers}


def _rows(values: dict[str, Any], change: Callable[[Tensor], Tensor]) -> dict[str, Any]:
    """Change tensors that have rows, which Adam's number of steps has not."""
    return {
        key: change(value) if isinstance(value, Tensor) and value.dim() > 0 else value
        for key, value in sorted(values.items())
    }


def write(folder: Path, step: int, state: dict[str, Any], keep: bool) -> None:
    """Save a checkpoint whole, and delete the run's others unless they are to be kept. Raises WriteError."""
    path = folder / f"step-{step:09d}.ckpt"
    others = [other for other in folder.glob(f"step-{9 * '[0-9]'}.ckpt") if other != path]  # no user's copy.ckpt
    with atomic_path(path, beside=folder) as partial:  # nerfstudio takes every file inside for a checkpoint.
        try:
            torch.save(state, partial)
        except RuntimeError as error:  # This is how torch's writer reports a full disk.
            raise OSError(reason(error)) from error
        if others:  # The new checkpoint must survive a power cut before these are deleted.
            with partial.open("rb+") as file:
                os.fsync(file.fileno())
    for other in [] if keep else others:
        other.unlink()


def check_chosen(load_dir: Path | None, load_step: int | None, load_checkpoint: Path | None) -> None:
    """Raise InputError if none of the files for `read_chosen` is whole; their content is not read."""
    tried = checkpoint_paths(load_dir, load_step, load_checkpoint)
    if tried and not any(map(zipfile.is_zipfile, tried)):  # A zip file's table of contents is at its end.
        read(tried[0])  # raises the error that says what is wrong


def read_chosen(
    load_dir: Path | None, load_step: int | None, load_checkpoint: Path | None, remedy: str = REMEDY, mmap: bool = False
) -> tuple[Path, dict[str, Any]] | None:
    """Return path and content of the checkpoint that these options name, or None, with errors as `read`.

    A damaged one is skipped for the one before it, unless a step was asked for.
    """
    errors = []
    for path in checkpoint_paths(load_dir, load_step, load_checkpoint):
        try:
            state = read(path, remedy, mmap)
        except InputError as error:
            errors.append(error)
            continue
        for error in errors:
            warn(f"{error} Going on from {path} instead.")
        return path, state
    if errors:
        raise errors[0]
    return None
