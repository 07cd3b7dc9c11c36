"""Which of a capture's images see which of its points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.data import colmap


def points_seen(source: Path, files: Sequence[Path]) -> list[NDArray[np.int64]] | None:
    """Return the points that each image file sees, from the tracks of a COLMAP reconstruction.

    The points have their numbers in the order of `colmap.read_points`. Raises InputError if the reconstruction is
    damaged.

    Args:
        source: The reconstruction's file of points.
        files: Image files. A file belongs to the image whose name its path ends with.

    Returns:
        The sorted numbers of each file's points, or None if the reconstruction has no tracks.
    """
    image_ids, points = colmap.read_tracks(source)
    kind = colmap.model_kind(source.parent)
    if len(points) == 0 or kind is None:
        return None
    names = colmap.read_image_ids(source.parent / f"images.{kind}")
    ids_by_name = {name: image_id for image_id, name in names.items()}
    order = np.argsort(image_ids, kind="stable")
    sorted_ids = image_ids[order]
    seen = []
    for file in files:
        image_id = _id_of(file, ids_by_name)
        start = np.searchsorted(sorted_ids, image_id, side="left")
        end = np.searchsorted(sorted_ids, image_id, side="right")
        observations = order[start:end]
        seen.append(np.unique(points[observations]))
    return seen


def _id_of(file: Path, ids: dict[str, int]) -> int:
    """Return the id of the image with the longest name that the file's path ends with, or −1."""
    for start in range(len(file.parts)):
        name = "/".join(file.parts[start:])
        if name in ids:
            return ids[name]
    return -1
