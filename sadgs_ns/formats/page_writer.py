"""The program that makes a page: PlayCanvas's splat-transform for Node.js, as `npm/package-lock.json` pins it.

It is installed once, into a folder of the user's cache. npm compares each package with its hash in the lock file, and
runs none of the packages' own scripts.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

from sadgs_ns.errors import InputError, reason

PACKAGES = Path(__file__).parent / "npm"
"""What npm reads: the packages, and their hashes."""
PROGRAM = Path("node_modules/@playcanvas/splat-transform/bin/cli.mjs")
DOWNLOAD = "PlayCanvas's splat-transform with the packages that it needs, 215 MB"
"""What is downloaded, for sentences to users."""
OLDEST_NODE = (18, 20)
"""Oldest tested version that makes a page: 18.20, 20.0 and 20.20 do, and 18.3 fails. The program asks for 22."""
NEEDED_NODE = "Node.js {}.{} or newer".format(*OLDEST_NODE)
REMEDY = f"install {NEEDED_NODE}, be online the first time, or choose another format"
_SECONDS = 300  # Longest time of the download, and of making a page


def node_version() -> tuple[int, ...] | None:
    """Return the version of the Node.js that is installed, such as (20, 11, 1); None if there is none that runs."""
    try:
        told = subprocess.run(["node", "--version"], check=True, capture_output=True, text=True, timeout=_SECONDS)
    except (OSError, subprocess.SubprocessError):
        return None
    found = re.match(r"v(\d+)\.(\d+)\.(\d+)", told.stdout)
    if found is None:
        return None
    return tuple(int(part) for part in found.groups())


def has_node() -> bool:
    """Tell whether Node.js is installed, with npm, in a version that makes pages."""
    version = node_version()
    return _has_programs() and version is not None and version >= OLDEST_NODE


def _has_programs() -> bool:
    return shutil.which("node") is not None and shutil.which("npm") is not None


def is_installed() -> bool:
    """Tell whether the program is in the user's cache, so that nothing is downloaded."""
    return (folder() / PROGRAM).exists()


def folder() -> Path:
    """Return the folder of the program, which its lock file names."""
    lock_file = (PACKAGES / "package-lock.json").read_bytes()
    version = hashlib.sha256(lock_file).hexdigest()[:12]
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(cache) / "sadgs_ns" / f"page-{version}"


def install() -> None:
    """Download the program, unless it is there; raise InputError if that fails, and leave nothing half done."""
    if is_installed():
        return
    if not _has_programs():
        problem = "HTML is written with the help of Node.js, whose node and npm are not there"
        raise InputError(f"{problem}: {REMEDY}.")
    target = folder()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(dir=target.parent))
        try:
            for name in ("package.json", "package-lock.json"):
                shutil.copyfile(PACKAGES / name, work / name)
            _run(["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund"], work)
            work.rename(target)
        finally:
            shutil.rmtree(work, ignore_errors=True)
    except OSError as error:
        if is_installed():  # Another process was quicker.
            return
        problem = f"What writes pages could not be stored in {target.parent} ({reason(error)})"
        raise InputError(f"{problem}: make room there, set XDG_CACHE_HOME, or choose another format.") from error


def write_page(points: Path, page: Path) -> None:
    """Make a page of a PLY; raise InputError if the program cannot be had or fails."""
    install()
    _run(["node", str(folder() / PROGRAM), "--quiet", "--gpu", "cpu", str(points), str(page)], points.parent)


def _run(command: list[str], work: Path) -> None:
    """Run a program of Node.js in a folder; raise InputError, with the last line that it printed, if it fails."""
    name = " ".join(Path(word).name for word in command[:2])
    try:
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=_SECONDS, cwd=work)
    except subprocess.TimeoutExpired as error:
        raise InputError(f"`{name}` took more than {_SECONDS} s: {REMEDY}.") from error
    except subprocess.CalledProcessError as error:
        lines = error.stderr.strip().splitlines()
        cause = reason(error)
        if lines:
            cause = lines[-1]
        raise InputError(f"`{name}` failed ({cause}): {REMEDY}.") from error
