"""The gains of exposure of a run's held-out photos: `python -m benchmarks.held_out_gains RUN/config.yml OUT.json`.

A splat has the median exposure of its training photos. A photo that was held out has an exposure of its own, which the
colours of the SfM points tell that it shows (`--pipeline.model.exposure auto`). `benchmarks.chain` runs this.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from benchmarks.trained_run import load_pipeline


def gains_of(pipeline: Any) -> dict[str, list[float]]:
    """Return factors of sRGB's values for each channel [3] by the images' names; none if training used no gains."""
    gains = {}
    folder = pipeline.datamanager.config.data / "images"
    files = pipeline.datamanager.eval_dataset.image_filenames
    for file, data in zip(files, pipeline.datamanager.cached_eval, strict=True):
        found = pipeline.model.gain_of_held_out(data)
        if found is not None:
            gains[file.relative_to(folder).as_posix()] = found.tolist()
    return gains


def main() -> None:
    """Write the gains of a run as JSON."""
    config, output = sys.argv[1:]
    pipeline = load_pipeline(Path(config))
    Path(output).write_text(json.dumps(gains_of(pipeline)), "utf8")


if __name__ == "__main__":
    main()
