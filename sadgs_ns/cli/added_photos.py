"""The division of a scene's views, and another run in the same frame when photos were added."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sadgs_ns.cli.division import divide, divide_additions, divides
from sadgs_ns.cli.sadgs_folder import SadgsFolder
from sadgs_ns.data.coordinates import FRAME_KEYS, TRANSFORMS_NAME
from sadgs_ns.files import write_json


def choose_run(folder: SadgsFolder, train_options: Sequence[str]) -> None:
    """Divide the views of a scene that is new or has changed, and begin another run if one began with other views.

    Nothing changes if the present run began with these views. Options that divide them are left to do it. Of a scene
    that has changed the frame and the held-out views of the last run stay, also if the present run has other options
    and has saved nothing yet.
    """
    settings = folder.settings
    views = folder.views()
    before = settings.views
    has_checkpoint = folder.checkpoint() is not None
    if views == before and (has_checkpoint or settings.measure is None):
        return
    last_run = folder.last_run()
    file = folder.scene / "transforms.json"
    described = json.loads(file.read_bytes())
    has_frame = FRAME_KEYS[0] in described
    has_earlier = last_run is not None or has_frame
    has_changed = bool(before) and views != before
    if has_changed and last_run is not None and not has_frame:
        _keep_frame(last_run, described)
    if not divides(train_options):
        if settings.measure is None:
            if before and has_earlier:
                present = set(views)
                still_there = [view for view in before if view in present]
                described |= divide_additions(described, [still_there, views])
        elif before and has_earlier:
            described |= divide(views, settings.measure, before, described.get("test_filenames", []))
        else:
            described |= divide(views, settings.measure)
    write_json(file, described)
    if before and has_checkpoint:
        settings.run = folder.new_run_name(len(views))
        settings.trained = None
        settings.measured = None
    settings.views = views
    folder.write_settings()


def _keep_frame(run: Path, described: dict[str, Any]) -> None:
    """Note in a scene's description how a run moved its images."""
    moved = json.loads((run / TRANSFORMS_NAME).read_bytes())
    transform_key, scale_key = FRAME_KEYS
    described[transform_key] = moved["transform"]
    described[scale_key] = moved["scale"]
