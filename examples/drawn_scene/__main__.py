"""`python -m examples.drawn_scene`: draw the demo scene, train on it with and without densification, and compare."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code, 2 if the input is wrong."""
    parser = argparse.ArgumentParser(prog="python -m examples.drawn_scene", description=(__doc__ or "").split(": ")[1])
    parser.add_argument("--output", type=Path, default=Path("demo-output"), help="folder (default %(default)s)")
    parser.add_argument("--max-num-iterations", type=int, default=300, help="of each run (default %(default)s)")
    parser.add_argument("--max-gaussians", type=int, default=8000, help="cap on their number (default %(default)s)")
    parser.add_argument("--width", type=int, default=160, help="image width in px (default %(default)s)")
    parser.add_argument("--height", type=int, default=120, help="image height in px (default %(default)s)")
    parser.add_argument("--views", type=int, default=40, help="training and held-out views (default %(default)s)")
    given = parser.parse_args(arguments)
    # nerfstudio and torch warn about their own internals, which is not what the demo is about.
    warnings.filterwarnings("ignore", module=r"(torch|nerfstudio|torchmetrics)\b")
    # This import takes ten seconds, which `--help` and wrong arguments need not wait for.
    from examples.drawn_scene.demonstration import demonstrate

    try:
        demonstrate(given.output, given.max_num_iterations, given.max_gaussians, given.width, given.height, given.views)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
