"""`python -m benchmarks hashes`: hashes of what short runs and the Triton kernels compute, to compare two commits.

A refactoring must not change a bit of what is computed. Write the hashes of the commits before and after it, on one
machine and in one environment, and compare the two files with diff:

    python -m benchmarks hashes --output runs.txt               # the gate's four runs, and the demo's three
    python -m benchmarks hashes --kernels --output kernels.txt  # every Triton kernel, in Triton's interpreter

Hashes hold on one machine and for one set of versions only, because rounding depends on the processor and the
libraries. So no file of hashes is committed, and no test compares hashes.

A commit that lacks this module is hashed by a copy: put this file and `kernel_hashes.py` into the folder `benchmarks`
of a checkout of it, and run `python -m benchmarks.hashes` there, with the same options.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
"""The checkout whose package is hashed."""
GATE = ROOT / "configs/bench/demo-gate.yaml"
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": "", "TRITON_INTERPRET": "1", "PYTHONPATH": str(ROOT)}
"""Variables of the processes that compute: one thread, because sums depend on their number, and no GPU."""
DIGITS = 16
"""How many hexadecimal digits of a SHA-256 are printed."""
Part = Literal["gate", "demo", "kernels"]
STEPS_PER_SAVE = {"gate": 13, "demo": 48}
"""Iterations between checkpoints. Some are saved during densification, when the strategy has a state. The last one but
one, after 79 of 80 iterations and 289 of 300, lies among those over which the parameters' mean runs."""
LOG_LINES = 30
"""How many lines of a failed process's output are shown."""


def hash_tensors(tensors: Mapping[str, Tensor]) -> str:
    """Hash the names, types, shapes and bytes of tensors; the order of the names does not matter.

    Bytes are taken as they lie in memory, which is little-endian on the processors that torch supports.
    """
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()[:DIGITS]


def line_of(name: str, tensors: Mapping[str, Tensor]) -> str:
    """Return the line of a name and the hash of tensors."""
    return f"{name}  {hash_tensors(tensors)}"


def tensors_in(value: Any, path: str = "") -> dict[str, Tensor]:
    """Return the tensors in nested mappings and sequences, by their keys joined with dots; skip all other values."""
    if isinstance(value, Tensor):
        return {path: value}
    if isinstance(value, Mapping):
        children = list(value.items())
    elif isinstance(value, list | tuple):
        children = list(enumerate(value))
    else:
        return {}
    found: dict[str, Tensor] = {}
    for key, child in children:
        name = f"{path}.{key}" if path else str(key)
        found |= tensors_in(child, name)
    return found


def groups_of(checkpoint: Mapping[str, Any]) -> dict[str, dict[str, Tensor]]:
    """Return what is hashed of a checkpoint, by the names of groups, and in each group by the names of tensors.

    The plan, options and other values that are no tensors are left out, so that an option may get another name.
    """
    pipeline = checkpoint["pipeline"]
    model_state = pipeline["_model._extra_state"]
    moments = {name: optimizer["state"] for name, optimizer in checkpoint["optimizers"].items()}
    return {
        "parameters": {name: value for name, value in pipeline.items() if isinstance(value, Tensor)},
        "strategy": tensors_in(model_state["strategy_state"]),
        "optimizers": tensors_in(moments),
        "mean of the parameters": tensors_in(model_state["average"]["means"]),
        "random state": tensors_in(pipeline["_extra_state"]["torch"], "torch"),
    }


def train(config: Any, steps_per_save: int) -> list[Path]:
    """Train as a nerfstudio config says, and return the checkpoints, the earliest first."""
    from nerfstudio.scripts.train import _set_random_seed

    config.steps_per_save = steps_per_save
    config.save_only_latest_checkpoint = False
    _set_random_seed(config.machine.seed)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup(test_mode="test")
    trainer.train()
    return sorted(trainer.checkpoint_dir.glob("step-*.ckpt"))


def run_lines(name: str, checkpoints: Sequence[Path]) -> Iterator[str]:
    """Yield a line for each group of tensors in each checkpoint of a run, and for each parameter in the last one.

    A group without tensors has no line. The strategy has no tensors after densification. The mean of the parameters has
    some only during the last iterations; at the end of the last iteration the mean replaces the parameters.
    """
    for path in checkpoints:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        groups = groups_of(checkpoint)
        for group, tensors in groups.items():
            if tensors:
                yield line_of(f"{name}, {checkpoint['step'] + 1} iterations: {group}", tensors)
        is_last = path == checkpoints[-1]
        if is_last:
            for parameter, tensor in sorted(groups["parameters"].items()):
                yield line_of(f"{name}, end: {parameter}", {parameter: tensor})


def gate_configs(folder: Path) -> Iterator[tuple[str, Any]]:
    """Yield name and config of each run of `make gate`, whose scene and output lie in a folder."""
    from benchmarks import protocol
    from benchmarks.run import build_config
    from examples.drawn_scene.scene import write_scene

    write_scene(folder / "demo", width=80, height=60, views=24)
    for job in protocol.load(GATE).jobs():
        yield job.row.label, build_config(job.scene, job.row, job.seed, folder, folder / job.row.label)


def demo_configs(folder: Path) -> Iterator[tuple[str, Any]]:
    """Yield name and config of each run of `make demo`, whose scene and output lie in a folder."""
    from examples.drawn_scene.demonstration import ROWS, run_config
    from examples.drawn_scene.scene import write_scene

    write_scene(folder / "scene", width=160, height=120, views=40)
    for label in ROWS:
        yield label, run_config(folder, label, iterations=300, max_gaussians=8000)


def kernel_lines() -> Iterator[str]:
    """Yield a line for each output and gradient of each kernel."""
    from benchmarks.kernel_hashes import KERNELS, results_of

    for kernel in KERNELS:
        for name, tensor in results_of(kernel).items():
            yield line_of(f"{kernel}, {name}", {name: tensor})


def part_lines(part: str, folder: Path) -> Iterator[str]:
    """Compute a part and yield its lines; runs are written to a folder."""
    if part == "kernels":
        yield from kernel_lines()
        return
    configs = {"gate": gate_configs, "demo": demo_configs}[part]
    for label, config in configs(folder):
        yield from run_lines(f"{part}, {label}", train(config, STEPS_PER_SAVE[part]))


def write_part(part: str, folder: str) -> None:
    """Write the lines of a part to a file in a folder; this is called in a process with ENVIRONMENT.

    Raises:
        RuntimeError: If another checkout's package would be hashed.
    """
    import sadgs_ns

    imported = Path(sadgs_ns.__file__).resolve()
    if not imported.is_relative_to(ROOT):
        raise RuntimeError(f"sadgs_ns is imported from {imported.parent}, and not from {ROOT}")
    torch.set_num_threads(1)
    with (Path(folder) / f"{part}.txt").open("w", encoding="utf8") as file:
        for line in part_lines(part, Path(folder)):
            print(line, file=file, flush=True)


def run_part(part: str, folder: Path) -> list[str]:
    """Compute a part in a process of its own, and return its lines.

    Raises:
        ChildProcessError: If the process fails; the message ends with its output.
    """
    code = "import sys; from benchmarks import hashes; hashes.write_part(*sys.argv[1:])"
    log = folder / f"{part}.log"
    start = time.perf_counter()
    with log.open("wb") as output:
        process = subprocess.run(
            [sys.executable, "-c", code, part, str(folder)],
            cwd=ROOT,
            env={**os.environ, **ENVIRONMENT},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    if process.returncode != 0:
        shown = log.read_text("utf8", errors="replace").splitlines()[-LOG_LINES:]
        raise ChildProcessError("\n".join([f"the part {part} ended with code {process.returncode}:", *shown]))
    print(f"{part}: {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
    return (folder / f"{part}.txt").read_text("utf8").splitlines()


@dataclass
class Command:
    """Print hashes of what short runs or the Triton kernels compute, on the CPU with one thread, to compare commits."""

    kernels: bool = False
    """hash the outputs of the Triton kernels in Triton's interpreter, instead of runs"""
    runs: tuple[Literal["gate", "demo"], ...] = ("gate", "demo")
    """hash only these runs"""
    output: Path | None = None
    """file to write the lines to, besides printing them"""

    def __call__(self) -> int:
        parts = ("kernels",) if self.kernels else self.runs
        lines: list[str] = []
        for part in parts:
            with tempfile.TemporaryDirectory(prefix="hashes-") as folder:
                of_part = run_part(part, Path(folder))
            print(*of_part, sep="\n", flush=True)
            lines += of_part
        if self.output is not None:
            self.output.write_text("".join(f"{line}\n" for line in lines), "utf8")
        return 0


if __name__ == "__main__":
    command = tyro.cli(Command, prog="python -m benchmarks.hashes", config=(tyro.conf.FlagCreatePairsOff,))
    sys.exit(command())
