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
from sadgs_ns.geometry.extents import camera_extent
from sadgs_ns.training.run.progress import warn

REMEDY = "give --load-dir the folder of a run of sadgs, or train from scratch"
SAME_PLACE = 1e-3  # Cameras that are closer than this share of the cameras' extent count as one
_FOLDER = "nerfstudio_models"  # Name of the folder of checkpoints in a run's folder
_PARTS = ("step", "pipeline", "optimizers", "scalers")  # Keys of every checkpoint of nerfstudio's trainer


def read(path: Path, remedy: str = REMEDY, mmap: bool = False) -> dict[str, Any]:
    """Read one checkpoint into the CPU's memory with torch's safe loader, whatever torch's version and environment.

    With `mmap`, tensors stay in the file until they are used. Raises InputError, which ends with `remedy`, if the file
    is damaged, or holds anything but a checkpoint's tensors and plain values.
    """
    try:
        _check_checksums(path)
        state = torch.load(path, map_location="cpu", weights_only=True, mmap=mmap or None)
    except Exception as error:  # Damaged archives, pickles and tensors raise different errors.
        # The rest of torch's message advises to load the file unsafely.
        problem = re.split(r"(?<=[a-z])[.:]\s", reason(error), maxsplit=1)[0]
        raise InputError(
            f"{path} is cut off, damaged or not of tensors and plain values alone ({problem}): {remedy}."
        ) from error
    problem = _missing_part(state)
    if problem:
        raise InputError(f"{path} is not a checkpoint that nerfstudio's trainer wrote ({problem}): {remedy}.")
    return state


def _check_checksums(path: Path) -> None:
    """Raise zipfile.BadZipFile if a part of the file is damaged, which torch itself does not check."""
    with zipfile.ZipFile(path) as file:
        damaged = file.testzip()
    if damaged is not None:
        raise zipfile.BadZipFile(f"wrong checksum of {damaged}")


def _missing_part(state: Any) -> str:
    """Say what a file lacks to be a checkpoint of nerfstudio's trainer; "" if it lacks nothing."""
    for part in _PARTS:
        if not isinstance(state, dict) or part not in state:
            return f"it has no {part}"
    if type(state["step"]) is not int:
        return "its step is no number"
    return ""


def checkpoint_paths(load_dir: Path | None, load_step: int | None, load_checkpoint: Path | None) -> list[Path]:
    """Return the checkpoints that nerfstudio's options for resuming name, in the order to try them.

    `load_dir` is the folder of a run, or its folder of checkpoints; without `load_step` the latest one comes first.
    Raises InputError if both a folder and a file are given, or one does not exist.
    """
    if load_dir is not None and load_checkpoint is not None:
        raise InputError("load_dir and load_checkpoint both name where the run goes on: give one of them.")
    if load_checkpoint is not None:
        if not load_checkpoint.is_file():
            raise InputError(f"{load_checkpoint} is no file: give --load-checkpoint one, or --load-dir a run's folder.")
        return [load_checkpoint]
    if load_dir is None:
        return []
    paths = _checkpoints_in(load_dir)
    if load_step is None:
        return [paths[step] for step in sorted(paths, reverse=True)]
    if load_step not in paths:
        steps = ", ".join(str(step) for step in sorted(paths))
        raise InputError(f"{load_dir} holds no checkpoint of step {load_step}: give --load-step one of {steps}.")
    return [paths[load_step]]


def _checkpoints_in(load_dir: Path) -> dict[int, Path]:
    """Return the checkpoints in a run's folder, or in its folder of checkpoints, by their steps.

    Raises InputError if there is none. Its sentence names the latest run in the folders below, if there is one.
    """
    if (load_dir / _FOLDER).is_dir():
        load_dir = load_dir / _FOLDER
    paths = {}
    for path in sorted(load_dir.glob("*")):
        match = re.fullmatch(r"step-(\d+)\.ckpt", path.name)
        if match:
            paths[int(match[1])] = path
    if paths:
        return paths
    folders_below = []
    for depth in ("*", "*/*", "*/*/*"):
        folders_below += load_dir.glob(f"{depth}/{_FOLDER}")
    example = ""
    if folders_below:
        latest = max(folders_below, key=lambda folder: folder.stat().st_mtime)
        example = f", such as {latest.parent}"
    raise InputError(f"{load_dir} holds no checkpoint: give --load-dir the folder of a run of sadgs{example}.")


def check_number_of_views(name: str, value: Tensor, expected: Tensor) -> None:
    """Raise InputError if a checkpoint's tensor is for another number of training views than there are."""
    if value.shape != expected.shape:
        problem = f"The checkpoint's {name} is for {len(value)} training views, and there are {len(expected)}"
        raise InputError(f"{problem}: set the parser's options that choose them as they were.")


def check_order_of_views(
    name: str,
    before: Tensor | None,  # Positions of the checkpoint's training cameras [C, 3]
    now: Tensor,  # Positions of the present ones [C, 3]
) -> None:
    """Raise InputError if the views to which a checkpoint's tensor belongs are not the present ones in their order."""
    if before is None:  # Earlier versions did not store them.
        return
    check_number_of_views(name, before, now)
    distances = (torch.as_tensor(before) - torch.as_tensor(now)).norm(dim=-1)
    if (distances > SAME_PLACE * camera_extent(now)).any():
        problem = f"The checkpoint's {name} is for other training views, or for these in another order"
        raise InputError(f"{problem}: choose them, by transforms.json or the parser's options, as they were.")


def map_rows(state: dict[str, Any], change: Callable[[Tensor], Tensor]) -> dict[str, Any]:
    """Return a checkpoint after `change` was applied to its tensors [N, …] of Gaussians, in a fixed order."""
    pipeline = dict(state["pipeline"])
    optimizers = dict(state["optimizers"])
    names = sorted(name for name in pipeline if ".gauss_params." in name)
    for name in names:
        pipeline[name] = change(pipeline[name])
    for name in sorted(name.rpartition(".")[2] for name in names):
        if name in optimizers:
            states = sorted(optimizers[name]["state"].items())
            moments = {index: _map_tensors(values, change) for index, values in states}
            optimizers[name] = {**optimizers[name], "state": moments}
    if "_model._extra_state" in pipeline:
        extra = dict(pipeline["_model._extra_state"])
        extra["strategy_state"] = _map_tensors(extra["strategy_state"], change)
        means = _map_tensors(extra["average"]["means"], change)
        extra["average"] = {**extra["average"], "means": means}
        pipeline["_model._extra_state"] = extra
    return {**state, "pipeline": pipeline, "optimizers": optimizers}


def _map_tensors(values: dict[str, Any], change: Callable[[Tensor], Tensor]) -> dict[str, Any]:
    """Apply `change` to tensors that have rows; Adam's number of steps is a tensor without rows."""
    changed = {}
    for key, value in sorted(values.items()):
        if isinstance(value, Tensor) and value.dim() > 0:
            value = change(value)
        changed[key] = value
    return changed


def write(folder: Path, step: int, state: dict[str, Any], keep_others: bool) -> None:
    """Save a checkpoint whole, and delete the run's others unless they are to be kept. Raises WriteError."""
    path = folder / f"step-{step:09d}.ckpt"
    digits = 9 * "[0-9]"  # A copy that a user has made has another name, and is no checkpoint of the run.
    others = [other for other in folder.glob(f"step-{digits}.ckpt") if other != path]
    with atomic_path(path, beside=folder) as partial:  # nerfstudio takes every file inside for a checkpoint.
        try:
            torch.save(state, partial)
        except RuntimeError as error:  # This is how torch's writer reports a full disk.
            raise OSError(reason(error)) from error
        if others:  # The new checkpoint must survive a power cut before these are deleted.
            with partial.open("rb+") as file:
                os.fsync(file.fileno())
    if not keep_others:
        for other in others:
            other.unlink()


def check_chosen(load_dir: Path | None, load_step: int | None, load_checkpoint: Path | None) -> None:
    """Raise InputError if none of the files for `read_chosen` is whole; their content is not read."""
    paths = checkpoint_paths(load_dir, load_step, load_checkpoint)
    # A zip file's table of contents is at its end, so a file that was cut off has none.
    if paths and not any(zipfile.is_zipfile(path) for path in paths):
        read(paths[0])  # This raises the error that says what is wrong.


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
