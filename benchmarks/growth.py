"""How a training step grows with Gaussians and with pixels, beside gsplat's: `python -m benchmarks growth`."""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Callable, Sequence

import torch

from benchmarks import command_lines, plots
from benchmarks.step import Step, milliseconds

ASPECT = 1.5
"""Width of the images, relative to their height."""


def whole_step(gaussians: int, megapixels: float, fused: bool) -> float | None:
    """Time a step of one view on made-up Gaussians.

    Args:
        gaussians: Number of Gaussians.
        megapixels: Size of the image, about.
        fused: Use our kernels; without, gsplat's and torch's.

    Returns:
        Milliseconds, or None where the device's memory is too small.
    """
    height = round((megapixels * 1e6 / ASPECT) ** 0.5)
    try:
        return milliseconds(Step(gaussians, round(ASPECT * height), height, fused).whole)
    except torch.cuda.OutOfMemoryError:
        return None


def measure(
    gaussians: Sequence[int],
    megapixels: Sequence[float],
    time_step: Callable[[int, float, bool], float | None] = whole_step,
) -> list[plots.Growth]:
    """Time steps of all numbers of Gaussians with the first size, and of all sizes with the first number.

    Args:
        gaussians: Numbers of Gaussians.
        megapixels: Sizes of the image.
        time_step: As `whole_step`.
    """
    pairs = [(n, megapixels[0]) for n in gaussians] + [(gaussians[0], size) for size in megapixels[1:]]
    return [plots.Growth(n, size, time_step(n, size, True), time_step(n, size, False)) for n, size in pairs]


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table, and write it as CSV with its plot; returns the exit code, 1 where there is no CUDA device."""
    options = command_lines.growth().parse_args(argv)
    if not torch.cuda.is_available():
        print("This comparison needs a CUDA device, and torch finds none.", file=sys.stderr)
        return 1
    rows = measure(options.gaussians, options.megapixels)
    written = io.StringIO()
    table = csv.writer(written, lineterminator="\n")
    table.writerows([plots.Growth._fields, *rows])
    options.output.mkdir(parents=True, exist_ok=True)
    (options.output / "growth.csv").write_text(written.getvalue(), encoding="utf-8")
    plots.save(plots.growth(rows), options.output / "growth")
    print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}\n\n{written.getvalue()}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
