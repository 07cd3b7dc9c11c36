"""From photos or a video to a scene with the poses of its cameras: `place_photos`."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shutil
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from sadgs_ns.data.checks.layouts import poses_elsewhere
from sadgs_ns.events import span
from sadgs_ns.placing import bit_depth
from sadgs_ns.placing.colmap import make_model, start_colmap
from sadgs_ns.placing.conversion import convert_photos, write_alpha, write_masks
from sadgs_ns.placing.folder import find_videos
from sadgs_ns.placing.options import PlacingOptions, Report, Say
from sadgs_ns.placing.panoramas import VIEWS
from sadgs_ns.placing.photos import (
    Photo,
    empty_folder,
    photos_by_camera,
    photos_by_camera_and_folder,
    read_photos,
)
from sadgs_ns.placing.plan import Summary, choose_matching
from sadgs_ns.placing.publishing import publish
from sadgs_ns.placing.scene import Scene
from sadgs_ns.placing.stamps import photo_stamps
from sadgs_ns.placing.video import video_frames, write_frames


@dataclasses.dataclass(frozen=True)
class Placed:
    """A scene that was made, and sentences on files of its source that are not used."""

    summary: Summary
    unused: list[str]


def place_photos(options: PlacingOptions, report: Report, say: Say) -> Placed:
    """Find the poses of photos, or of frames of a video, and write a scene for training.

    A run that was interrupted is resumed. New photos are added to a finished scene, whose other cameras stay as they
    are. If fewer than half of the photos register, or the cameras are wrong, the scene is written, but it does not
    count as finished.

    Raise InputError if the photos, the folder or the settings cannot be used, OSError if a file cannot be written,
    and RunError if COLMAP fails. The work so far is kept then, and also if an interrupt is raised.
    """
    options.check()
    scene = Scene(options)
    if scene.finished and not scene.added:
        scene.remove_intermediate_files()
        say("unchanged", f"{options.out} is finished; delete it to make it again.")
        summary = Summary(**scene.finished)
    else:
        if options.source.is_dir():
            poses = poses_elsewhere(options.source)
            if poses:
                say("aside", f"Poses are computed anew. {poses}")
        summary = _make_scene(scene, report, say)
    unused = list(scene.left_out)
    if not scene.is_video:
        videos = find_videos(options.source)
        if videos:
            found = f"Its videos ({len(videos)}, such as {videos[0]})"
            unused.append(f"{found} are not used: give them in a folder of their own.")
    return Placed(summary, unused)


def _make_scene(scene: Scene, report: Report, say: Say) -> Summary:
    # COLMAP's process starts at once, to import what it needs while photos are read, and ends before the lock does.
    with contextlib.ExitStack() as lock, start_colmap() as colmap:
        if scene.is_video:
            folder = scene.work / "frames"
            with span("frames"):
                photos = _take_frames(scene, folder, lock, report, say)
        else:
            folder = scene.options.source
            with span("photos"):
                photos = _read_folder(scene, lock, report)
        views = sum(len(photo.views) for photo in photos)
        matching = choose_matching(scene.options.matching, views, scene.options.source.is_file())
        _describe_photos(scene, photos, say)
        if scene.added:  # An interrupted run may have made these without some of the photos.
            shutil.rmtree(scene.model, ignore_errors=True)
            shutil.rmtree(scene.work / "photos", ignore_errors=True)
        with span("conversion"):
            folder, converted = _convert(scene, folder, photos, say)
            scene.note_masks()
        groups, alike = _group_by_camera(scene, converted)
        rigs = [[view.name for view in photo.views] for photo in photos if photo.is_panorama]
        arguments = (folder, groups, matching, scene.options.max_size, scene.model, scene.base, rigs, alike)
        longest_side = int(statistics.median(max(photo.size) for photo in photos))
        made = Summary(**make_model(colmap, *arguments, folder=scene.work, report=report))
        summary = dataclasses.replace(made, longest_side=longest_side)
        with span("publishing"):
            publish(scene.work / "undistorted", scene.options.out, bool(scene.added))
        if summary.is_poor and not scene.added:  # The features serve another way of matching.
            shutil.rmtree(scene.model)
        else:
            scene.finish(summary)
    return summary


def _take_frames(scene: Scene, folder: Path, lock: contextlib.ExitStack, report: Report, say: Say) -> list[Photo]:
    """Lock the scene, write frames of its videos to a folder unless an earlier run did, and return them as photos."""
    source = scene.options.source
    videos = scene.settings.photos
    if videos:
        say("aside", f"Frames of {len(videos)} videos are taken, each with a camera of its own.")
    is_new = not folder.exists()
    frames: Iterable[tuple[str, Any]] = []
    if is_new:  # Bad videos raise here, before anything is written.
        frames = video_frames(source, videos, scene.options.frames)
    if scene.begun is not None and scene.begun.files:
        scene.settings.files = scene.begun.files
    else:
        scene.settings.files = photo_stamps(source, videos or [""])
    lock.enter_context(scene.lock())  # It writes the settings, by which an interrupted run is resumed.
    if is_new:
        partial = empty_folder(folder.with_name(f"{folder.name}.partial"))
        write_frames(frames, partial, lambda done: report("frames", done, scene.options.frames))
        partial.rename(folder)
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.jpg"))
    photos = []
    for photo in read_photos(folder, names, report):
        video = os.path.dirname(photo.name)
        photos.append(dataclasses.replace(photo, camera=(video, photo.size)))
    return photos


def _read_folder(scene: Scene, lock: contextlib.ExitStack, report: Report) -> list[Photo]:
    """Read the photos of the source, stamp them and their masks, and lock the scene."""
    source = scene.options.source
    names = scene.settings.photos
    photos = read_photos(source, names, report)
    scene.settings.bit_depth = _choose_bit_depth(scene, photos)
    photos = _scale_values(photos, scene.settings.bit_depth)
    stamps: dict[str, list[int]] = {}
    if scene.begun is not None:
        stamps = scene.begun.files
    new = [name for name in names if name not in stamps]
    new_masks = [name for name in scene.masks.values() if name not in stamps]
    scene.settings.files = stamps | photo_stamps(source, new)
    lock.enter_context(scene.lock())  # Only now, when the photos are known to be readable.
    scene.settings.files |= photo_stamps(source, new_masks)  # They are written when the masks were read.
    return photos


def _choose_bit_depth(scene: Scene, photos: Sequence[Photo]) -> int | None:
    """Return the bits that the values of photos of 16 bits use, None if there are no such photos.

    It stays as it was chosen first, so that photos that are added later are as bright as the others.
    """
    largest_values = {photo.name: photo.largest_value for photo in photos if photo.largest_value is not None}
    if scene.begun is not None:
        if scene.begun.bit_depth is not None:
            return scene.begun.bit_depth
        if not largest_values.keys().isdisjoint(scene.begun.photos):
            return bit_depth.WHOLE  # An earlier version took them for this.
    if not largest_values:
        return None
    return bit_depth.depth_of(largest_values.values())


def _scale_values(photos: Sequence[Photo], depth: int | None) -> list[Photo]:
    """Let photos of 16 bits be scaled if their values use fewer, which is a matter of all photos together."""
    if depth is None or depth == bit_depth.WHOLE:
        return list(photos)
    scaled = []
    for photo in photos:
        if photo.largest_value is not None:
            photo = dataclasses.replace(photo, is_read=False, bit_depth=depth)
        scaled.append(photo)
    return scaled


def _describe_photos(scene: Scene, photos: Sequence[Photo], say: Say) -> None:
    """Say how many photos were added, how many are panoramas, and how many use a part of 16 bits."""
    if scene.added and scene.begun is not None:
        if scene.added == 1:
            added = "1 photo"
        else:
            added = f"{scene.added} photos"
        added = f"{added} added to {len(scene.begun.photos)}"
        say("added", f"{added}.", photos=added)
    panoramas = sum(photo.is_panorama for photo in photos)
    if panoramas:
        found = f"{panoramas} of the {len(photos)} photos are panoramas"
        views = f"each is cut into {VIEWS} views of 90°, which leave out 30° about the zenith and the nadir"
        say("panoramas", f"{found}: {views}.")
    largest_values = [photo.largest_value for photo in photos if photo.bit_depth and photo.largest_value is not None]
    if largest_values and scene.settings.bit_depth:
        say("aside", bit_depth.sentence_on_depth(scene.settings.bit_depth, largest_values))


def _convert(scene: Scene, folder: Path, stored: Sequence[Photo], say: Say) -> tuple[Path, list[Photo]]:
    """Convert photos as `convert_photos` does, and write their opacities, and masks if they or the scene have any."""
    masks = scene.masks
    converted, photos = convert_photos(folder, stored, scene.work / "photos")
    if scene.added:
        has_masks = scene.has_masks
    else:
        has_masks = bool(masks)
    shutil.rmtree(scene.work / "masks", ignore_errors=True)
    num_hiding = 0
    if has_masks:
        num_hiding = write_masks(scene.options.source, masks, stored, photos, scene.work / "masks")
    if masks:
        if num_hiding:
            use = "used"
        elif has_masks:
            use = "used, but hide nothing: make black what is to be hidden"
        else:
            use = "not used, because the scene has none: give another folder for it"
        say("aside", f"Masks of {len(masks)} photos are {use}.")
    transparent = write_alpha(converted, photos, scene.work / "alpha")
    if transparent:
        say("transparent", f"{transparent} photos are partly transparent; their images in the scene are, too.")
    return converted, photos


def _group_by_camera(scene: Scene, photos: Sequence[Photo]) -> tuple[list[list[str]], list[list[str]]]:
    """Return the names of the photos that have a camera for themselves, and of those whose cameras may be one."""
    others = [photo for photo in photos if photo.camera]  # Views of panoramas have none.
    if scene.options.camera_per_photo:
        return [[photo.name] for photo in others], []
    return photos_by_camera_and_folder(others), photos_by_camera(others)
