"""Converts the photos of a scene, their opacities and masks into what COLMAP reads."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from sadgs_ns.placing.photos import Photo, convert_photos, write_alpha, write_masks
from sadgs_ns.placing.scene import Scene

Say = Callable[..., None]  # Called with an event, a sentence on it, and by keyword the fields of the event


def convert(scene: Scene, folder: Path, stored: Sequence[Photo], say: Say) -> tuple[Path, list[Photo]]:
    """Convert photos as `convert_photos`, and write their opacities, and masks if they or the scene have any."""
    work, masks = scene.work, scene.masks
    converted, photos = convert_photos(folder, stored, work / "photos")
    has_masks = (scene.options.out / "masks").exists() if scene.added else bool(masks)
    shutil.rmtree(work / "masks", ignore_errors=True)
    if has_masks:
        write_masks(scene.options.source, masks, stored, photos, work / "masks")
    if masks:
        why = "used" if has_masks else "not used, because the scene has none: give another folder for it"
        say("aside", f"Masks of {len(masks)} photos are {why}.")
    if transparent := write_alpha(converted, photos, work / "alpha"):
        say("transparent", f"{transparent} photos are partly transparent; their images in the scene are, too.")
    return converted, photos
