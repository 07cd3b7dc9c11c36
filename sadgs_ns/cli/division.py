"""The division of views into those that are trained on and those that are held out, by `sadgs --measure`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sadgs_ns.data.checks.splits import SPLITS
from sadgs_ns.data.layouts import layout_of
from sadgs_ns.data.transforms import read_json
from sadgs_ns.errors import InputError
from sadgs_ns.placing.panoramas import photo_of

INTERVAL = 8  # Every so many photos one is held out to be measured.
_TRAIN_FRACTION = 0.9  # Share of the views for training; nerfstudio's
_FEWEST_PHOTOS = 5  # Of fewer, a whole panorama would be too much to hold out.
_PARSER = "nerfstudio-data"  # Name of the parser of transforms.json
_OTHER_PARSER = re.compile(r"automatic|colmap|minimal-parser|(?!nerfstudio-)[\w-]+-data")

Lists = dict[str, list[str]]
"""The names of the images in each split, by the keys of transforms.json."""


def divides(train_options: Sequence[str]) -> bool:
    """Return whether options of ns-train say how views are divided."""
    return any(re.match("--(eval|train|test)", option) for option in train_options)


def is_divided(cameras: Path, source: Path, measure: bool, train_options: Sequence[str]) -> bool:
    """Return whether something else than `--measure` divides the views of given cameras.

    These are lists in their transforms.json, a parser of other files, or options of ns-train.

    Args:
        cameras: The file of the cameras.
        source: The folder that brings them, or the file itself.
        measure: Whether held-out views shall be measured.
        train_options: The options of ns-train.

    Raises:
        InputError: If views shall be measured, but the capture holds none out, or if the file cannot be read.
    """
    if divides(train_options) or any(_OTHER_PARSER.fullmatch(word) for word in train_options):
        return True
    layout = layout_of(source)
    if layout == "blender":
        tests = cameras.with_name("transforms_test.json")
        if measure and not tests.is_file():
            raise InputError(f"--measure needs views that are held out, and {tests} does not exist: leave it out.")
    if layout != "nerfstudio":
        return True
    described = read_json(cameras)
    lists = [described[f"{split}_filenames"] for split in SPLITS if f"{split}_filenames" in described]
    if lists and measure and not described.get("test_filenames"):
        problem = f"--measure needs views that are held out, and the lists in {cameras} hold out none"
        raise InputError(f"{problem}: name some as test_filenames, or remove all such lists.")
    return bool(lists)


def parser_options(measure: bool, train_options: Sequence[str]) -> list[str]:
    """Return options to add to those of ns-train, so that given cameras are divided as `divide` divides others."""
    words = []
    if _PARSER not in train_options:
        words.append(_PARSER)
    if measure:
        return [*words, "--eval-mode", "interval", "--eval-interval", str(INTERVAL)]
    return [*words, "--eval-mode", "fraction", "--train-split-fraction", "1"]


def divide(views: Sequence[str], measure: bool, earlier: Sequence[str] = (), held_out: Sequence[str] = ()) -> Lists:
    """Return the lists of views that are trained on and held out.

    All are trained on unless they shall be measured. Then every eighth photo is held out, the first one included. A
    panorama is held out with all its views. Of photos that were added, the eighth, the sixteenth, … are held out.

    Args:
        views: The names of all images, in their order.
        measure: Whether views are held out.
        earlier: The views with which an earlier run began, whose division stays.
        held_out: The views that this run held out.
    """
    if not measure:
        return _lists(views, [])
    known = set(earlier)
    chosen = {view for view in held_out if view in known}
    photos = {photo_of(view) for view in views}
    if chosen:
        added = [view for view in views if view not in known]
        chosen |= _every_eighth(added, INTERVAL - 1)
    elif len(photos) < _FEWEST_PHOTOS:
        chosen = set(views[::INTERVAL])
    else:
        chosen = _every_eighth(views, 0)
    return _lists(views, [view for view in views if view in chosen])


def _every_eighth(views: Sequence[str], first: int) -> set[str]:
    """Return the views of every eighth photo, from the one with this number on."""
    photos = list(dict.fromkeys(photo_of(view) for view in views))
    chosen = set(photos[first::INTERVAL])
    return {view for view in views if photo_of(view) in chosen}


def divide_additions(described: dict[str, Any], additions: Sequence[Sequence[str]]) -> Lists:
    """Return the division in a folder that an earlier version of sadgs began.

    Views that are divided already stay as they are. Then each addition is divided by itself, as nerfstudio does it.

    Args:
        described: The content of the folder's transforms.json.
        additions: The names of the folder's images, one list after each addition; a list may hold earlier ones.
    """
    from nerfstudio.data.utils.dataparsers_utils import get_train_eval_split_fraction

    trained = list(described.get("train_filenames", []))
    held_out = list(described.get("test_filenames", []))
    for names in additions:
        known = {*trained, *held_out}
        new = [name for name in names if name not in known]
        train_indices, test_indices = get_train_eval_split_fraction(new, _TRAIN_FRACTION)
        trained += [new[index] for index in train_indices]
        held_out += [new[index] for index in test_indices]
    return {"train_filenames": trained, "val_filenames": held_out, "test_filenames": held_out}


def _lists(views: Sequence[str], held_out: Sequence[str]) -> Lists:
    """Return the lists of a scene, given its views and those that are held out."""
    hidden = set(held_out)
    trained = [view for view in views if view not in hidden]
    return {"train_filenames": trained, "val_filenames": list(held_out), "test_filenames": list(held_out)}
