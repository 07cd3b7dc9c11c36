"""Whether the folders of a benchmark's scenes hold what nerfstudio will read: asked before anything runs.

nerfstudio itself asks on the terminal whether to make downscaled images that are missing; nobody is there to answer.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.protocol import Job

if TYPE_CHECKING:
    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig


def check(jobs: Sequence[Job], root: Path, source: str | None = None) -> None:
    """Check that the jobs' scenes are there below `root`, and build every config once; raises as `build_config`."""
    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

    from benchmarks.run import build_config

    missing = {}
    checked = set()
    for job in {(job.scene.name, job.row.label): job for job in jobs}.values():
        name = job.scene.name
        folder = root / job.scene.data
        if not folder.exists():
            missing[name] = f"{folder} does not exist"
            continue
        config: Any = build_config(job.scene, job.row, job.seed, root, Path("unused"))
        parser = config.pipeline.datamanager.dataparser
        if name in checked or not isinstance(parser, ColmapDataParserConfig):
            continue
        checked.add(name)
        try:
            names = image_names(parser, folder)
        except FileNotFoundError as error:
            missing[name] = str(error)
            continue
        if parser.eval_mode == "interval" and names != sorted(names):
            print(
                f"scene {name!r}: COLMAP numbered its images in another order than their names', so every "
                f"{parser.eval_interval}th view is not the one that papers hold out: compare with no published number.",
                file=sys.stderr,
            )
    if missing:
        faults = ", ".join(f"scene {name!r}: {text}" for name, text in missing.items())
        remedy = "check --scenes"
        if source:
            remedy = f"{remedy} or get {source}"
        raise ValueError(f"{faults}; {remedy}.")


def image_names(parser: ColmapDataParserConfig, data: Path) -> list[str]:
    """Names of a COLMAP scene's images in the order in which nerfstudio holds out every n-th.

    Raises FileNotFoundError with the path if the model, the folder of (downscaled) images or an image is missing.
    """
    from nerfstudio.data.utils import colmap_parsing_utils as colmap

    from sadgs_ns.data.images import MAX_AUTO_RESOLUTION, image_size, smaller_folder

    model = data / parser.colmap_path
    images = data / parser.images_path
    if (model / "cameras.txt").exists():  # nerfstudio's order of preference
        views = colmap.read_images_text(model / "images.txt")
    elif (model / "cameras.bin").exists():
        views = colmap.read_images_binary(model / "images.bin")
    else:
        raise FileNotFoundError(f"{model} holds no COLMAP model")
    names = [views[index].name for index in sorted(views)]
    factor = parser.downscale_factor
    if factor is None:
        longest = max(image_size(images / names[0]))
        factor = 1
        while longest / factor > MAX_AUTO_RESOLUTION:
            factor *= 2
    folder = smaller_folder(images, factor)
    if not folder.exists():
        raise FileNotFoundError(f"{folder} does not exist")
    absent = [name for name in names if not (folder / name).exists()]
    if absent:
        raise FileNotFoundError(f"{folder} lacks {len(absent)} of {len(names)} images, such as {absent[0]}")
    return names
