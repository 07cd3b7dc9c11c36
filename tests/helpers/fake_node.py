"""Programs in the place of Node.js and npm, and wheels that are not there."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest


def put_node_into_path(folder: Path, node: str, npm: str, monkeypatch: pytest.MonkeyPatch, version: str = "v22.1.0"):
    """Make shell scripts called node, which tells a version of Node.js, and npm, and put their folder first in PATH."""
    folder.mkdir()
    for name, script in {"node": f'[ "$1" = --version ] && echo {version} && exit\n{node}', "npm": npm}.items():
        (folder / name).write_text(f"#!/bin/sh\n{script}")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")


def hide_wheel(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a package seem not to be installed."""
    monkeypatch.setitem(sys.modules, package, None)
