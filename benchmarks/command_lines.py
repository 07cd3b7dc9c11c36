"""The options of the commands of `python -m benchmarks` that measure something, apart from what they import.

`python -m benchmarks COMMAND --help` and wrong options so are answered before torch and nerfstudio are imported, which
takes between two and ten seconds.
"""

from __future__ import annotations

import argparse
from pathlib import Path

KERNEL_REPEATS = 5
"""Number of timed calls of `python -m benchmarks kernels`."""
KERNEL_GAUSSIANS = 5000
"""Number of Gaussians in the tables of η of `python -m benchmarks kernels`."""


def report() -> argparse.ArgumentParser:
    """Return the options of `python -m benchmarks report`."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks report", description="Draw a results file: plots and a page."
    )
    parser.add_argument("results", type=Path, help="JSON-lines file that python -m benchmarks wrote")
    parser.add_argument("--output", type=Path, required=True, metavar="FOLDER", help="takes report.html and the plots")
    parser.add_argument("--images", type=Path, metavar="FOLDER", help="held-out views that the runs wrote, to compare")
    parser.add_argument("--views", type=int, default=3, metavar="N", help="held-out views to show of each scene")
    parser.add_argument("--reference", metavar="LABEL", help="row whose loop seconds are 1 in the column Ratio")
    parser.add_argument("--title", default="Benchmark", help="heading of the page")
    parser.add_argument("--command", metavar="TEXT", help="command that made the results, to be shown on the page")
    return parser


def documents() -> argparse.ArgumentParser:
    """Return the options of `python -m benchmarks documents`."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks documents",
        description="Write the tables that stand between `<!-- table: NAME -->` and `<!-- end -->` in README.md and "
        "docs/*.md, and figures, as docs/results/tables.yaml describes them, from the rows in docs/results.",
    )
    parser.add_argument(
        "checkout", type=Path, nargs="?", default=Path(), help="folder of README.md and docs (default: this one)"
    )
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if one is not as its rows")
    return parser


def kernels() -> argparse.ArgumentParser:
    """Return the options of `python -m benchmarks kernels`."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks kernels",
        description="Four tables: how S̄ is computed and stored, how many samples a footprint gets, how often η is "
        "observed, and how S̄ reacts to image perturbations as in the paper's supplement. Errors are against float64 or "
        "brute force; times are medians, on a CPU of processor time.",
    )
    parser.add_argument("--image", type=Path, metavar="FILE", help="a photo (default: images of the demo scene)")
    parser.add_argument("--device", default="cpu", help="cpu, cuda or cuda:N (default %(default)s)")
    parser.add_argument("--repeats", type=int, default=KERNEL_REPEATS, help="timed calls (default %(default)s)")
    parser.add_argument(
        "--longest-side", type=int, metavar="PX",
        help="a larger photo is reduced to it (default 1600), the demo is drawn at it (default 320)",
    )  # fmt: skip
    parser.add_argument(
        "--gaussians", type=int, default=KERNEL_GAUSSIANS, help="for the tables of η (default %(default)s)"
    )
    parser.add_argument("--output", type=Path, metavar="FILE", help="JSON-lines file that the rows are added to")
    return parser


def step() -> argparse.ArgumentParser:
    """Return the options of `python -m benchmarks step`."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks step", description="Time the parts of a training step with and without our kernels."
    )
    parser.add_argument("--gaussians", type=int, nargs="+", default=[500_000, 4_000_000])
    parser.add_argument("--width", type=int, default=1600, help="px")
    parser.add_argument("--height", type=int, default=1060, help="px")
    return parser


def growth() -> argparse.ArgumentParser:
    """Return the options of `python -m benchmarks growth`."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks growth",
        description="Time training steps of more and more Gaussians, and of larger images.",
    )
    numbers, sizes = [1_000_000, 100_000, 300_000, 4_000_000, 16_000_000], [2.0, 0.3, 1.0, 4.0, 8.0, 16.0]
    of_first = "the first of them goes with all"
    parser.add_argument("--gaussians", type=int, nargs="+", default=numbers, help=f"{of_first} sizes")
    parser.add_argument("--megapixels", type=float, nargs="+", default=sizes, help=f"{of_first} numbers of Gaussians")
    parser.add_argument("--output", type=Path, default=Path("growth"), help="folder for growth.csv, .png and .svg")
    return parser


def validation() -> argparse.ArgumentParser:
    """Return the options of `python -m benchmarks validation`."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks validation", description="Hold out validation views, and leave test views out."
    )
    parser.add_argument("root", type=Path, help="folder that holds the scenes")
    parser.add_argument("out", type=Path, help="folder for the copies")
    parser.add_argument(
        "--folds", metavar="2,4,6", help="write NAME-2, … with every 8th view from 2, … held out (default: 4, as NAME)"
    )
    parser.add_argument("--masked", nargs="*", default=[], metavar="SCENE", help="also write NAME-masked of these")
    parser.add_argument("--noisy", nargs="*", default=[], metavar="SCENE", help="also write NAME-noisy of these")
    return parser


def views() -> argparse.ArgumentParser:
    """Return the options of `python -m benchmarks views`."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks views",
        description="Print the PSNR of held-out views, and which lie 3 dB or more under the best label's median.",
    )
    parser.add_argument(
        "results", type=Path, nargs="+", metavar="RESULTS.jsonl", help="file that python -m benchmarks wrote"
    )
    of_references = "files whose runs alone are that reference (default: the results)"
    parser.add_argument("--references", type=Path, nargs="+", metavar="REF.jsonl", help=of_references)
    return parser


def exposures() -> argparse.ArgumentParser:
    """Return the options of `python -m benchmarks exposures`."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks exposures",
        description="Copy a COLMAP scene, with known exposures of its training photos.",
    )
    parser.add_argument("scene", type=Path, help="folder of a COLMAP scene")
    parser.add_argument("out", type=Path, help="folder for the copy")
    parser.add_argument(
        "--spread", type=float, default=4.0, help="largest gain over the smallest (default %(default)s)"
    )
    parser.add_argument(
        "--white-balance", type=float, default=0.1, metavar="SHARE", help="change of a channel (default %(default)s)"
    )
    parser.add_argument(
        "--mean", type=float, help="geometric mean of the gains (default: the largest at which nothing saturates)"
    )
    parser.add_argument("--seed", type=int, default=0, help="which photo gets which gain (default %(default)s)")
    return parser


def memory() -> argparse.ArgumentParser:
    """Return the options of `python -m benchmarks memory`."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks memory", description="Compare the memory plan with the real peaks of training steps."
    )
    parser.add_argument("--gaussians", type=int, nargs="+", default=[300_000, 1_000_000])
    parser.add_argument("--megapixels", type=float, nargs="+", default=[0.4, 2.0, 5.0])
    parser.add_argument("--views", type=int, nargs="+", default=[1, 4])
    return parser


def shards() -> argparse.ArgumentParser:
    """Return the options of `python -m benchmarks shards`."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks shards",
        description="Time training steps of made-up Gaussians that are spread over the devices of the processes that "
        "torchrun starts; without torchrun, on one device.",
    )
    parser.add_argument("--gaussians", type=int, nargs="+", default=[8_000_000], help="of all devices together")
    parser.add_argument("--megapixels", type=float, nargs="+", default=[2.0, 8.0])
    parser.add_argument("--views", type=int, nargs="+", default=[2], help="of a step")
    parser.add_argument("--blocks", type=int, default=1, help="parts of the scene, of which a view sees one")
    parser.add_argument("--repeats", type=int, default=10, help="steps in each of three rounds (default %(default)s)")
    parser.add_argument("--profile", action="store_true", help="also print what takes the first device its time")
    return parser


def parts() -> argparse.ArgumentParser:
    """Return the options of `python -m benchmarks parts`."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks parts", description="Time the parts of a training step of a finished run (CUDA)."
    )
    parser.add_argument("run", type=Path, help="folder of a run, or its config.yml")
    parser.add_argument("--data", type=Path, help="folder of the capture (default: where it was in training)")
    parser.add_argument("--views", type=int, default=1, help="training views of a step (default %(default)s)")
    parser.add_argument("--max-off-axis", type=float, default=4.0, help="as pipeline.model.max-off-axis")
    return parser


def formats() -> argparse.ArgumentParser:
    """Return the options of `python -m benchmarks formats`."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks formats",
        description="Write a run's Gaussians in every format, read them back, and compare sizes and renderings.",
    )
    parser.add_argument("run", type=Path, help="folder of a run, or its config.yml")
    parser.add_argument("--output", type=Path, default=Path("formats"), metavar="FOLDER", help="takes the files")
    parser.add_argument("--data", type=Path, help="folder of the capture (default: where it was in training)")
    return parser
