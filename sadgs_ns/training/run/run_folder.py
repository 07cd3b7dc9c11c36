"""The start of a run's folder: its lock and `config.yml`, written once checkpoint and data were checked."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from typing import Any

import yaml
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE

from sadgs_ns.data.checks.capture import check_ahead
from sadgs_ns.errors import InputError, WriteError, reason
from sadgs_ns.files import atomic_path, check_encoding, lock_folder
from sadgs_ns.training.options import drop_unknown
from sadgs_ns.training.run import checkpoints, processes
from sadgs_ns.training.run.progress import warn

_locks: dict[Path, int] = {}  # The locked folders of this process's runs, and the file descriptors of their locks


def begin(config: TrainerConfig) -> None:
    """Check checkpoint, folder, viewer and data, or raise InputError; then lock the folder and write `config.yml`.

    The folder stays locked until `release`, or until this process ends, so that no other run writes there.
    A warning names options of a loaded `config.yml` that this version does not have, and the new one leaves them out.
    """
    for path in (config.get_base_dir(), config.load_dir, config.load_checkpoint):
        if path is not None:
            check_encoding(path)
    checkpoints.check_chosen(config.load_dir, config.load_step, config.load_checkpoint)
    _check_folder(config)
    if not processes.is_rank_zero():
        return
    unknown = drop_unknown(config)
    if unknown:
        problem = "config.yml has options that this version of sadgs does not have"
        warn(f"{problem}; they are ignored: {', '.join(unknown)}.")
    if config.is_viewer_enabled() or config.is_viewer_legacy_enabled():
        _check_address(config.viewer)
    data: Any = config.pipeline.datamanager
    check_ahead(data)
    _lock(config.get_base_dir())
    _check_folder(config)  # Another run may have ended there meanwhile.
    CONSOLE.log(f"Saving config to: {write_config(config)}")


def write_config(config: TrainerConfig) -> Path:
    """Write `config.yml` and return its path. Raise WriteError if that is not possible."""
    path = config.get_base_dir() / "config.yml"
    with atomic_path(path) as partial:
        partial.write_text(yaml.dump(config), "utf8")
    return path


def _lock(folder: Path) -> None:
    """Make and lock the folder of a run, unless this process has its lock. Raise InputError if another run has it."""
    path = folder.absolute()
    if path in _locks:
        return
    try:
        path.mkdir(parents=True, exist_ok=True)
        _locks[path] = lock_folder(
            path,
            f"Another run trains in {folder}: wait for it or stop it, or give this one another --timestamp, which is "
            "the second of its start if none is given.",
        )
    except OSError as error:
        raise WriteError(folder / "config.yml", error) from error


def release(folder: Path) -> None:
    """Release the lock of a run's folder, if this process has it."""
    lock = _locks.pop(folder.absolute(), None)
    if lock is not None:
        os.close(lock)


def _check_folder(config: TrainerConfig) -> None:
    """Raise InputError if the run would delete checkpoints of an earlier run in the same folder."""
    folder = config.get_checkpoint_dir()
    if not os.path.isdir(folder):
        return
    present = sorted(folder.glob("step-*.ckpt"))
    if not present:
        return
    start = config.load_dir
    if config.load_checkpoint is not None:
        start = config.load_checkpoint.parent
    if start is not None and start.resolve() in (folder.resolve(), folder.parent.resolve()):
        return  # The run goes on from these checkpoints.
    raise InputError(
        f"{folder} holds {present[-1].name} of an earlier run, which this run would delete: go on from it with "
        f"--load-dir {folder.parent} (load_dir in a config.yml), give another --timestamp, or remove it."
    )


def _check_address(viewer: ViewerConfig) -> None:
    """Raise InputError if the viewer cannot listen at its address; viser would take another port, or never return."""
    port = viewer.websocket_port or 0
    address = viewer.websocket_host
    if port:
        address = f"{address}:{port}"
    try:
        found = socket.getaddrinfo(viewer.websocket_host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        for family, _, _, _, socket_address in found:
            socket.create_server(socket_address, family=family).close()
    except OSError as error:
        problem = reason(error).partition(" (while")[0]
        raise InputError(
            f"The viewer cannot listen on {address} ({problem}): give another "
            "viewer.websocket_port, or none for a free one, or another viewer.websocket_host: 127.0.0.1 opens the "
            "viewer to this machine only, 0.0.0.0 to the network."
        ) from error
