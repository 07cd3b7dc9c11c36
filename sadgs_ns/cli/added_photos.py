"""Another run for photos that were added, in the frame of the earlier one and with the same held-out views."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Any

from sadgs_ns.cli.sadgs_folder import SadgsFolder
from sadgs_ns.data.coordinates import FRAME_KEYS, TRANSFORMS_NAME
from sadgs_ns.files import write_json

_TRAIN_FRACTION = 0.9  # Share of the views for training; nerfstudio's


def choose_run(folder: SadgsFolder, train_options: Sequence[str]) -> None:
    """Begin another run if photos were added since the present one began."""
    settings = folder.settings
    views = folder.views()
    before = settings.views
    if views == before:
        return
    if before:
        _keep_frame_and_split(folder, before, views, train_options)
        if folder.checkpoint():
            settings.run = f"run-{len(views)}"
            settings.trained = None
    settings.views = views
    folder.write_settings()


def _keep_frame_and_split(
    folder: SadgsFolder, before: Sequence[str], views: Sequence[str], train_options: Sequence[str]
) -> None:
    """Write into the scene how the present run moved its images, `before`, and which of them it held out.

    The added photos are divided as nerfstudio would, unless an option divides them. Without a run nothing is kept.
    """
    file = folder.scene / "transforms.json"
    described = json.loads(file.read_bytes())
    if FRAME_KEYS[0] not in described:
        if not folder.checkpoint():
            return
        moved = json.loads((folder.run / TRANSFORMS_NAME).read_bytes())
        transform_key, scale_key = FRAME_KEYS
        described[transform_key] = moved["transform"]
        described[scale_key] = moved["scale"]
    if not any(re.match("--(eval|train|test)", option) for option in train_options):
        described |= _split(described, [before, views])
    write_json(file, described)


def _split(described: dict[str, Any], additions: Sequence[Sequence[str]]) -> dict[str, list[str]]:
    """Return the division of the views: those that are divided stay, then each addition is divided by itself."""
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
