"""The division of a scene's views, and another run, in the frame of the earlier one, for photos that were added."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Any

from sadgs_ns.cli.sadgs_folder import SadgsFolder
from sadgs_ns.data.coordinates import FRAME_KEYS, TRANSFORMS_NAME
from sadgs_ns.files import write_json

_TRAIN_FRACTION = 0.9  # Share of the views for training; nerfstudio's
_INTERVAL = 8  # Every so many photos one is held out to be measured.


def choose_run(folder: SadgsFolder, train_options: Sequence[str]) -> None:
    """Divide the views of a scene that is new or has grown, and begin another run if one began with fewer views.

    Nothing changes if the present run began with these views. Options that divide them are left to do it.
    """
    settings = folder.settings
    views = folder.views()
    before = settings.views
    has_checkpoint = folder.checkpoint() is not None
    if views == before and (has_checkpoint or settings.measure is None):
        return
    file = folder.scene / "transforms.json"
    described = json.loads(file.read_bytes())
    has_frame = FRAME_KEYS[0] in described
    if before and has_checkpoint and not has_frame:
        _keep_frame(folder, described)
    if not any(re.match("--(eval|train|test)", option) for option in train_options):
        if settings.measure is not None:
            described |= divide_views(described, views, settings.measure)
        elif before and (has_checkpoint or has_frame):
            described |= _divide_additions(described, [before, views])
    write_json(file, described)
    if before and has_checkpoint:
        settings.run = f"run-{len(views)}"
        settings.trained = None
        settings.measured = None
    settings.views = views
    folder.write_settings()


def _keep_frame(folder: SadgsFolder, described: dict[str, Any]) -> None:
    """Note in a scene's description how the present run moved its images."""
    moved = json.loads((folder.run / TRANSFORMS_NAME).read_bytes())
    transform_key, scale_key = FRAME_KEYS
    described[transform_key] = moved["transform"]
    described[scale_key] = moved["scale"]


def divide_views(described: dict[str, Any], views: Sequence[str], measure: bool) -> dict[str, list[str]]:
    """Return the lists of views that are trained on and held out.

    All are trained on unless they shall be measured. Then what is held out already, as whole panoramas are, stays so;
    otherwise every eighth view from the first is. Of views that were added every eighth is, from the eighth.

    Args:
        described: The content of the scene's transforms.json.
        views: The names of all its images, in their order.
        measure: Whether views are held out.
    """
    held_out: list[str] = []
    if measure:
        held_out = list(described.get("test_filenames", []))
        divided = {*described.get("train_filenames", []), *held_out}
        if held_out:
            added = [name for name in views if name not in divided]
            held_out += added[_INTERVAL - 1 :: _INTERVAL]
        else:
            held_out = list(views[::_INTERVAL])
    trained = [name for name in views if name not in held_out]
    return {"train_filenames": trained, "val_filenames": held_out, "test_filenames": held_out}


def _divide_additions(described: dict[str, Any], additions: Sequence[Sequence[str]]) -> dict[str, list[str]]:
    """Return the division in a folder that an earlier version began.

    Views that are divided stay so, then each addition is divided by itself as nerfstudio would.
    """
    from nerfstudio.data.utils.dataparsers_utils import get_train_eval_split_fraction

    trained = list(described.get("train_filenames", []))
    held_out = list(described.get("test_filenames", []))
    for names in additions:
        known = {*trained, *held_out}
        new = [name for name in names if name not in known]
        for_training, for_tests = get_train_eval_split_fraction(new, _TRAIN_FRACTION)
        trained += [new[i] for i in for_training]
        held_out += [new[i] for i in for_tests]
    return {"train_filenames": trained, "val_filenames": held_out, "test_filenames": held_out}
