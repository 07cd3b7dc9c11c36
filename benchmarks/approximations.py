"""`python -m benchmarks kernels`: what each shortcut in the frequency analysis gets wrong, beside what it costs.

Four tables: how S̄ is computed and stored, how many samples a footprint gets, how often η is observed, and how S̄ reacts
to image perturbations as in the paper's supplement. Errors are against float64 or brute force; times are medians, on a
CPU of processor time.
"""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from benchmarks import command_lines, results
from benchmarks.eta_errors import RUNS, demo_training_set, footprint_rows, interval_rows, random_footprints
from benchmarks.table import grid
from benchmarks.tensor_errors import AXIS_LENGTHS, Image, Row, batch, robustness_rows, structure_tensor_rows
from examples.drawn_scene.drawing import render
from examples.drawn_scene.scene import describe_scene
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.2g}"


def _percent(value: float) -> str:
    return f"{_number(100 * value)} %"


@dataclass(frozen=True)
class Table:
    """How rows are printed."""

    title: str
    note: str
    """What the numbers mean."""
    columns: dict[str, tuple[str, Callable[[Any], str]]]
    """Header and format of each number."""


_LENGTHS = ", ".join(f"{length:g}" for length in AXIS_LENGTHS)
TABLES = {
    "structure_tensor": Table(
        "S̄ and Λ: computing and storing",
        "Λ: |Λ / Λ_ref − 1| over the pixels. Flips: pixels × axes of "
        f"{_LENGTHS} px on the other side of η = 1. Rows that say *alone* are held against float64 with the kernels as "
        "shipped, the others against the reference. The time of storage is that of encoding.",
        {
            "bytes": ("Bytes/px", str),
            "median": ("Λ, median", _percent),
            "p95": ("Λ, 95 %", _percent),
            "max": ("Λ, max", _percent),
            "flips": ("η > 1 flips", _percent),
            "ms": ("ms an image", _number),
        },
    ),
    "footprint": Table(
        "η: samples in a footprint",
        "η: |η / η_ref − 1| over random footprints of 1 to 32 px. Flips: axes on the other side of η = 1.",
        {
            "median": ("η, median", _percent),
            "p95": ("η, 95 %", _percent),
            "max": ("η, max", _percent),
            "flips": ("η > 1 flips", _percent),
            "ms": ("ms a view", _number),
        },
    ),
    "interval": Table(
        "η: every k-th iteration",
        "Ratio: |Δ N_high / N_total| over the axes, in [0, 1]. Flips: axes whose decision to split changes. The last "
        f"row is what chance alone changes. Means over {RUNS} runs.",
        {
            "mean": ("Ratio, mean", _number),
            "p95": ("Ratio, 95 %", _number),
            "max": ("Ratio, max", _number),
            "flips": ("Axes that flip", _percent),
            "splits": ("Gaussians split otherwise", _percent),
            "growth": ("Gaussians afterwards", _percent),
            "ms": ("ms an iteration", _number),
        },
    ),
    "robustness": Table(
        "Robustness of S̄",
        "Change of S̄: mean ‖ΔS̄‖ over mean ‖S̄‖; the paper's is from its supplement, on its own images. "
        "Λ and flips as above.",
        {
            "change": ("Change of S̄", _percent),
            "paper": ("Paper", _percent),
            "median": ("Λ, median", _percent),
            "p95": ("Λ, 95 %", _percent),
            "flips": ("η > 1 flips", _percent),
        },
    ),
}


def markdown(rows: Sequence[Row]) -> str:
    """One table's rows as a titled Markdown table; what is None is a dash."""
    table = TABLES[rows[0]["table"]]
    return f"### {table.title}\n\n{table.note}\n\n{body(rows)}"


def body(rows: Sequence[Row]) -> str:
    """As `markdown`, without title and note."""
    columns = TABLES[rows[0]["table"]].columns
    header = ("Variant", *(header for header, _ in columns.values()))
    lines = (
        (row["variant"], *("–" if row[name] is None else form(row[name]) for name, (_, form) in columns.items()))
        for row in rows
    )
    return grid(header, lines)


@dataclass(frozen=True)
class Workload:
    """How much is measured; the tests measure less."""

    repeats: int = command_lines.KERNEL_REPEATS
    longest_side: int | None = None
    """px; None is 1600 for a photo and 320 for the demo's images."""
    gaussians: int = command_lines.KERNEL_GAUSSIANS
    views: int = 24
    """Of the demo scene."""
    analysed_views: int = 2
    """So many of the demo's images stand in for a photo."""
    iterations: int = StructureAwareStrategy().windows.structure_every
    """Between two structure steps."""


def find_device(name: str) -> torch.device:
    """The device of a name.

    Raises:
        ValueError: If there is none, or it lacks float64.
    """
    try:
        device = torch.device(name)
        if device.type not in ("cpu", "cuda"):
            raise RuntimeError("only cpu and cuda compute in float64")
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:  # a torch without CUDA asserts
        reason = str(error).splitlines()[0].rstrip(".")
        raise ValueError(f"--device {name!r} cannot be used ({reason}); give cpu, cuda or cuda:N.") from error
    return device


def read_image(path: Path, longest_side: int) -> Image:
    """A photo as RGB, reduced so that no side exceeds `longest_side` px. [H, W, 3]

    Raises:
        ValueError: If it cannot be read.
    """
    try:
        bgr = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    except (OSError, cv2.error):
        bgr = None
    if bgr is None:
        raise ValueError(f"--image {path} cannot be read as an image; give a JPEG or PNG file.")
    height, width = bgr.shape[:2]
    factor = longest_side / max(height, width)
    if factor < 1:
        size = (max(round(factor * width), 1), max(round(factor * height), 1))
        bgr = cv2.resize(bgr, size, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(bgr[..., ::-1], dtype=np.uint8)


def measure(device: torch.device, photo: Image | None, workload: Workload) -> Iterator[list[Row]]:
    """Everything, one table at a time.

    Args:
        device: Where it is measured.
        photo: RGB [H, W, 3], or None for the demo's images. η over iterations needs posed views: always the demo's.
        workload: How much.
    """
    width = workload.longest_side or 320
    if photo is not None:
        width = min(width, 320)
    scene = describe_scene(width, width * 3 // 4, workload.views, workload.gaussians)
    drawn = [render(scene.surfaces, view) for view in scene.views]
    analysed = drawn[: workload.analysed_views] if photo is None else [photo]
    images = batch(analysed, device)
    yield list(structure_tensor_rows(images, workload.repeats))
    footprints = random_footprints(workload.gaussians, images)
    yield list(footprint_rows(multiscale_structure_tensor(images), footprints, workload.repeats))
    training = demo_training_set(scene, batch(drawn, torch.device("cpu")), device)
    yield list(interval_rows(training, workload.iterations, workload.repeats))
    yield list(robustness_rows(analysed, device))


def _device_name(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"CPU ({platform.machine()}, {torch.get_num_threads()} threads)"


def main(argv: Sequence[str] | None = None) -> int:
    """Print the tables; returns the exit code, 2 if the input is wrong."""
    given = command_lines.kernels().parse_args(argv)
    try:
        for name, value, least in (("repeats", given.repeats, 1), ("gaussians", given.gaussians, 10),
                                   ("longest-side", given.longest_side, 32)):  # fmt: skip
            if value is not None and value < least:
                raise ValueError(f"--{name} is {value}; give at least {least}.")
        if given.output is not None and given.output.is_dir():
            raise ValueError(f"--output {given.output} is a folder; name a file.")
        device = find_device(given.device)
        photo = None if given.image is None else read_image(given.image, given.longest_side or 1600)
    except ValueError as error:
        print(f"python -m benchmarks kernels: {error}", file=sys.stderr)
        return 2

    workload = Workload(given.repeats, given.longest_side, given.gaussians)
    where, source = _device_name(device), "demo" if given.image is None else given.image.name
    print(f"{source} on {where}, torch {torch.__version__}, median of {workload.repeats} calls\n", flush=True)
    rows: list[Row] = []
    for table in measure(device, photo, workload):
        print(markdown(table), end="\n\n", flush=True)
        rows += table
    if given.output is not None:
        common = {"input": source, "device": where, "torch": torch.__version__, "repeats": workload.repeats}
        for row in rows:
            key = "/".join((where, source, row["table"], row["variant"]))
            results.append(given.output, {"key": key, **common, **row})
    return 0


if __name__ == "__main__":
    sys.exit(main())
