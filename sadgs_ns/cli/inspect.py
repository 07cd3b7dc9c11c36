"""`sadgs-inspect CONFIG --view 12`: pictures of what the method sees in a view of a run, and of one step's splits."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sadgs_ns.cli.program import parse
from sadgs_ns.errors import sentence_on_full_gpu


@dataclass
class Inspect:
    """Pictures of a view of a run: the photo's structure tensor as ellipses and local wavelength, η of the Gaussians,
    how many children they would get, which are low, and one densification step, conventional against structure-aware,
    in random colours. A config.yml that names other code than nerfstudio's and ours is refused."""

    config: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CONFIG")]
    """config.yml of a finished or running run of sadgs, or its folder."""
    view: int = 0
    """Number of the view, from 0."""
    split: Literal["train", "eval"] = "train"
    """The views among which it is counted."""
    output: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Folder for the PNGs; by default inspect, beside the config."""
    load_step: Annotated[int | None, tyro.conf.arg(metavar="STEP")] = None
    """Step of the checkpoint; by default the latest."""
    data: Annotated[Path | None, tyro.conf.arg(metavar="DATA")] = None
    """Folder of the capture; by default where it was in training."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code, 2 if the input is wrong."""
    options = parse(Inspect, "sadgs-inspect", argv)
    # nerfstudio and torch warn about their own internals.
    warnings.filterwarnings("ignore", module=r"(torch|nerfstudio|torchmetrics)\b")
    # These imports take ten seconds, which `--help` and wrong arguments need not wait for.
    import torch

    from sadgs_ns.cli.inspection import inspect_run

    try:
        written = inspect_run(**vars(options))
    except (ValueError, OSError) as error:
        print(f"sadgs-inspect: {error}", file=sys.stderr)
        return 2
    except torch.cuda.OutOfMemoryError:
        print(sentence_on_full_gpu("sadgs-inspect", options.config), file=sys.stderr)
        return 2
    for path in written:
        print(path)
    return 0
