"""From photos or a video to a scene with the poses of the cameras: `place_photos`."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from sadgs_ns.data.checks.layouts import poses_elsewhere
from sadgs_ns.placing.colmap import Report, make_model, start_colmap
from sadgs_ns.placing.conversion import convert_photos, write_alpha, write_masks
from sadgs_ns.placing.folder import find_videos
from sadgs_ns.placing.options import PlacingOptions
from sadgs_ns.placing.panoramas import VIEWS
from sadgs_ns.placing.photos import Photo, empty_folder, photos_by_camera, read_photos
from sadgs_ns.placing.plan import Summary, choose_matching
from sadgs_ns.placing.publishing import publish
from sadgs_ns.placing.scene import Scene
from sadgs_ns.placing.stamps import photo_stamps
from sadgs_ns.placing.video import video_frames, write_frames

Say = Callable[..., None]  # Called with an event, a sentence on it, and by keyword the fields of the event


@dataclasses.dataclass(frozen=True)
class Placed:
    """A scene that was made, and sentences on files of its source that are not used."""

    summary: Summary
    unused: list[str]


def place_photos(options: PlacingOptions, report: Report, say: Say) -> Placed:
    """Make a scene of photos or a video.

    A run that was interrupted goes on. New photos are added to a finished scene, whose other cameras stay as they are.

    Raise InputError if the photos, the folder or the settings cannot be used, OSError if a file cannot be written,
    and RunError if COLMAP fails: the work so far is kept.
    """
    scene = Scene(options)
    if scene.finished and not scene.added:
        scene.remove_intermediate_files()
        say("unchanged", f"{options.out} is finished; delete it to make it again.")
        summary = Summary(**scene.finished)
    else:
        if options.source.is_dir() and (poses := poses_elsewhere(options.source)):
            say("aside", f"Poses are computed anew. {poses}")
        summary = _make(scene, report, say)
    unused = list(scene.left_out)
    if not scene.is_video and (videos := find_videos(options.source)):
        told = f"Its videos ({len(videos)}, such as {videos[0]}) are not used: give them in a folder of their own."
        unused.append(told)
    return Placed(summary, unused)


def _make(scene: Scene, report: Report, say: Say) -> Summary:
    options, work = scene.options, scene.work

    # It starts at once, to import what it needs while photos are read, and ends before its folder is left.
    with contextlib.ExitStack() as alone, start_colmap() as colmap:
        folder, names = options.source, scene.settings["photos"]
        if scene.is_video:
            if names:
                say("aside", f"Frames of {len(names)} videos are taken, each with a camera of its own.")
            folder = work / "frames"
            chosen = [] if folder.exists() else video_frames(options.source, names, options.frames)
            scene.settings["files"] = scene.begun.get("files") or photo_stamps(options.source, names or [""])
            alone.enter_context(scene.alone())  # It notes the settings, by which an interrupted run goes on.
            if not folder.exists():
                partial = empty_folder(work / "frames.partial")
                write_frames(chosen, partial, lambda done: report("frames", done, options.frames))
                partial.rename(folder)
            names = sorted(photo.relative_to(folder).as_posix() for photo in folder.rglob("*.jpg"))
        photos = read_photos(folder, names, report)
        if scene.is_video:
            photos = [dataclasses.replace(photo, camera=(os.path.dirname(photo.name), photo.size)) for photo in photos]
        views = sum(len(photo.views) for photo in photos)
        matching = choose_matching(options.matching, views, options.source.is_file())
        if not scene.is_video:
            stamps = scene.begun.get("files", {})
            scene.settings["files"] = stamps | photo_stamps(folder, [name for name in names if name not in stamps])
            alone.enter_context(scene.alone())  # Only now, when the photos are known to be readable.
            masks = [name for name in scene.masks.values() if name not in stamps]
            scene.settings["files"] |= photo_stamps(folder, masks)  # They are noted when the scene is finished.
        _tell_work(scene, photos, say)
        if scene.added:  # An interrupted run may have made these without some of them.
            for path in (scene.model, work / "photos"):
                shutil.rmtree(path, ignore_errors=True)
        rigs = [[view.name for view in photo.views] for photo in photos if photo.is_panorama]
        folder, photos = _convert(scene, folder, photos, say)
        photos = [photo for photo in photos if photo.camera]  # without the views
        groups = [[photo.name] for photo in photos] if options.camera_per_photo else photos_by_camera(photos)
        arguments = (folder, groups, matching, options.max_size, scene.model, scene.base, rigs)
        summary = Summary(**make_model(colmap, *arguments, folder=work, report=report))
        publish(work / "undistorted", options.out, bool(scene.added))
        if summary.is_poor and not scene.added:  # The features serve another way of matching.
            shutil.rmtree(scene.model)
        else:
            scene.note(max_size=options.max_size, finished=dataclasses.asdict(summary), model=scene.model.name)
            scene.remove_intermediate_files()
    return summary


def _tell_work(scene: Scene, photos: Sequence[Photo], say: Say) -> None:
    if scene.added:
        added = f"{scene.added} photo{'s' * (scene.added > 1)} added to {len(scene.begun['photos'])}"
        say("added", f"{added}.", photos=added)
    if panoramas := sum(photo.is_panorama for photo in photos):
        held_out = "all those of a panorama" if len(photos) > 4 else "single ones"
        say(
            "panoramas",
            f"{panoramas} of the {len(photos)} photos are panoramas: each is cut into {VIEWS} views of 90°, which "
            f"leave out 30° about the zenith and the nadir; {held_out} are held out.",
        )


def _convert(scene: Scene, folder: Path, stored: Sequence[Photo], say: Say) -> tuple[Path, list[Photo]]:
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
