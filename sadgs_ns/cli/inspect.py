"""`sadgs-inspect CONFIG --view 12`: pictures of what the method sees in a view of a run, and of one step's splits."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code, 2 if the input is wrong."""
    parser = argparse.ArgumentParser(
        prog="sadgs-inspect",
        description="Pictures of a view of a run: the photo's structure tensor as ellipses and local wavelength, η of "
        "the Gaussians, how many children they would get, which are low, and one densification step, conventional "
        "against structure-aware, in random colours. A config.yml is a program, which this runs: give only those "
        "you trust.",
    )
    parser.add_argument("config", type=Path, help="config.yml of a finished or running run of sadgs, or its folder")
    parser.add_argument("--view", type=int, default=0, help="number of the view, from 0 (default %(default)s)")
    parser.add_argument("--split", choices=["train", "eval"], default="train", help="(default %(default)s)")
    parser.add_argument("--output", type=Path, help="folder for the PNGs (default: inspect beside the config)")
    parser.add_argument("--load-step", type=int, help="step of the checkpoint (default: the latest)")
    parser.add_argument("--data", type=Path, help="folder of the capture (default: where it was in training)")
    given = parser.parse_args(arguments)
    # nerfstudio and torch warn about their own internals.
    warnings.filterwarnings("ignore", module=r"(torch|nerfstudio|torchmetrics)\b")
    # These imports take ten seconds, which `--help` and wrong arguments need not wait for.
    import torch

    from sadgs_ns.cli.inspection import inspect_run

    try:
        written = inspect_run(given.config, given.view, given.split, given.output, given.load_step, given.data)
    except (ValueError, OSError) as error:
        print(f"sadgs-inspect: {error}", file=sys.stderr)
        return 2
    except torch.cuda.OutOfMemoryError:
        remedy = "end other programs on it, or draw on the CPU: CUDA_VISIBLE_DEVICES= sadgs-inspect …"
        print(f"sadgs-inspect: the GPU's memory does not hold {given.config}: {remedy}", file=sys.stderr)
        return 2
    for path in written:
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
