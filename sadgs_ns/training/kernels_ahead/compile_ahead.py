"""Compile the kernels of the method's defaults from the first second of a machine's first run, in other processes.

One process finds which kernels the stages of a step would launch, without launching any, and forks others that compile
them side by side into Triton's cache; threads of one process would wait for each other in Python. No process outlives
the run. A file in the cache tells later runs that this is done.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import select
import signal
import subprocess
import sys
import threading
from concurrent.futures import ProcessPoolExecutor, as_completed
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from sadgs_ns.events import progress
from sadgs_ns.host import num_cores

_FEWEST_CORES = 3  # The run itself keeps two busy
_LONGEST = 60.0  # Seconds without progress after which the run no longer waits
_HERE = Path(__file__).parent
_CARDS = Path("/proc/driver/nvidia/gpus")
_process: subprocess.Popen[bytes] | None = None
_found: list[tuple[Any, Any, dict[str, Any]]] = []  # Source, target and options of each kernel, for forked processes


def begin() -> None:
    """Begin to compile, unless that has begun, was done before, or there is no GPU or no spare core."""
    global _process
    if _process is not None:
        return
    marker = _marker()
    if marker is None or marker.exists():
        return
    code = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import main; main()"
    _process = subprocess.Popen(
        [sys.executable, "-c", code, str(marker)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def wait() -> None:
    """Wait until the process of `begin` has ended, and report its progress."""
    global _process
    if _process is None:
        return
    assert _process.stdout is not None
    output = _process.stdout.fileno()
    while True:
        readable, _, _ = select.select([output], [], [], _LONGEST)
        if not readable:
            break
        lines = os.read(output, 2**16)
        if not lines:  # The process has ended.
            break
        for done, total in re.findall(rb"(\d+) of (\d+)\n", lines)[-1:]:
            progress("compiling kernels", int(done), int(total))
    with _process:  # It ends when its input closes.
        _process = None


def _marker() -> Path | None:
    """Return the file in Triton's cache that exists once the kernels are compiled; this imports no torch.

    None if they should not be compiled ahead: without an NVIDIA card, torch or Triton, with few cores, or if
    `SADGS_TRITON=0` turns the kernels off.
    """
    models = [re.findall("Model:.*", path.read_text()) for path in sorted(_CARDS.glob("*/information"))]
    if not models or num_cores() < _FEWEST_CORES or os.environ.get("SADGS_TRITON") == "0":
        return None
    try:
        versions = f"{version('torch')} {version('triton')} {sys.version}"
    except PackageNotFoundError:
        return None
    key = f"{models} {os.environ.get('CUDA_VISIBLE_DEVICES')} {versions}"
    digest = hashlib.sha256(key.encode())
    kernels = sorted((_HERE.parents[1] / "kernels").glob("*.py"))
    for path in (*kernels, _HERE / "probes.py", _HERE / "compile_ahead.py"):
        digest.update(path.read_bytes())
    home = Path(os.environ.get("TRITON_HOME") or Path.home())
    cache = Path(os.environ.get("TRITON_CACHE_DIR") or home / ".triton" / "cache")
    return cache / f"sadgs-{digest.hexdigest()[:16]}"


def find_kernels() -> None:
    """Collect in `_found` the kernels of a step's stages; from then on this process launches none."""
    import torch
    from triton import knobs
    from triton.compiler import ASTSource
    from triton.runtime import driver

    from sadgs_ns.kernels import tiles, trial, triton_switched
    from sadgs_ns.training.kernels_ahead.probes import KernelChoice, Stages

    known = set()  # Names of kernels, each with the key of its signature and options

    def collect(*, key: str, fn: Any, compile: Any, **_: Any) -> bool:
        """Add a kernel to `_found` if it is new there; Triton calls this before it would compile the kernel."""
        if (fn.name, key) not in known:
            known.add((fn.name, key))
            source = ASTSource(fn.jit_function, compile["signature"], compile["constants"], compile["configs"][0])
            target = driver.active.get_current_target()
            options = json.loads(compile["specialization_data"])["options"]
            for name, value in options.items():
                if isinstance(value, list):  # JSON has no tuples.
                    options[name] = tuple(value)
            _found.append((source, target, options))
        return True  # Triton then neither compiles nor launches it.

    # The kernel that counts pairs is not launched either.
    tiles.PairCounts.wait = lambda self: [1]
    knobs.runtime.jit_cache_hook = collect
    trial.hash_kernels()
    torch.set_num_threads(1)
    stages = Stages(KernelChoice(torch.device("cpu")))
    with triton_switched(True):
        for stage in (*stages.without_projection().values(), stages.project, *stages.after_projection().values()):
            stage()
        Stages(KernelChoice(torch.device("cpu"), size=(4096, 4096))).tile_lists()  # More tiles have longer numbers.


def compile_kernel(index: int) -> None:
    """Compile a kernel that `find_kernels` found, and the code that launches it, into Triton's cache."""
    from triton import compile
    from triton.runtime import driver

    source, target, options = _found[index]
    kernel = compile(source, target=target, options=options)
    active: Any = driver.active
    active.launcher_cls(source, kernel.metadata)


def main() -> None:
    """Compile all kernels, and print after each how many of all are done; runs in the process of `begin`."""
    os.nice(5)  # The run must go on meanwhile.
    find_kernels()
    processes = min(len(_found), num_cores() - 1)
    with ProcessPoolExecutor(processes, get_context("fork"), _begin_compiler) as pool:
        compiled = [pool.submit(compile_kernel, index) for index in range(len(_found))]
        threading.Thread(target=_end_with_the_run, daemon=True).start()
        for done, kernel in enumerate(as_completed(compiled), 1):
            kernel.result()
            print(f"{done} of {len(_found)}", flush=True)
    Path(sys.argv[1]).touch()


def _begin_compiler() -> None:
    """Prepare a forked process for compiling."""
    # Only the first process prints to the run, which reads until the last writer has ended.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    threading.Thread(target=_end_with_the_run, daemon=True).start()


def _end_with_the_run() -> None:
    """End this process, its siblings and their children when the run closes their input, or ends."""
    os.read(0, 1)
    os.killpg(0, signal.SIGKILL)
