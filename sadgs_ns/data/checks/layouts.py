"""The sentences for folders whose layout is not known."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Sequence
from pathlib import Path

from sadgs_ns.data import colmap
from sadgs_ns.data.images import SMALL_PHOTO, VIDEO_SUFFIXES, image_size, images_in
from sadgs_ns.data.layouts import COLMAP_FOLDERS, find_reconstructions, layout_of
from sadgs_ns.data.nearby import NearbyFiles
from sadgs_ns.data.transforms import GIVE_POSES
from sadgs_ns.errors import InputError

_BUNDLER = (
    "kapture_import_bundler.py -i {file} -l LIST.txt -im {photos} --add-reconstruction -o KAPTURE && "
    "kapture_export_colmap.py -i KAPTURE -db KAPTURE/colmap.db -txt {data}/sparse"
)
_POLYCAM = "keyframes/cameras/*.json"
_EXPORTS = {
    "*.xml": (b"<chunk", "ns-process-data metashape --data {photos} --xml {file} --output-dir FOLDER"),
    "*.psx": (b"", "ns-process-data metashape --data {photos} --xml EXPORTED.xml --output-dir FOLDER"),
    "*.csv": (b"#name,", "ns-process-data realitycapture --data {photos} --csv {file} --output-dir FOLDER"),
    "*.xmp": (b"xcr:Rotation", "ns-process-data realitycapture --data {photos} --csv EXPORTED.csv --output-dir FOLDER"),
    "odm_report/shots.geojson": (b"", "ns-process-data odm --data {data} --output-dir FOLDER"),
    _POLYCAM: (b"", "ns-process-data polycam --data {data} --output-dir FOLDER"),
    "metadata.json": (b'"poses"', "ns-process-data record3d --data {data} --output-dir FOLDER"),
    "reconstruction.json": (b'"shots"', "opensfm export_colmap {data} && mv {data}/colmap_export {data}/sparse"),
    "*sfm*": (b'"poses"', "aliceVision_exportColmap --input {file} --output FOLDER --copyImages true"),
    "bundle.out": (b"# Bundle", _BUNDLER),
}
"""Files with other programs' poses, a part of their content, and the command that reads them."""
_UNREAD = ("poses_bounds.npy", "capture.json")
"""Files with poses that no command reads: those of LLFF, and those of some apps for phones."""


def poses_elsewhere(data: Path) -> str | None:
    """Return the sentence for a folder with another program's poses, which a command reads or none does, or None."""
    for pattern, (mark, command) in _EXPORTS.items():
        for file in sorted(data.glob(pattern)):
            if file.is_file() and mark in file.read_bytes():
                paths = {"file": file, "photos": _folder_of_photos(data), "data": data}
                quoted = {name: shlex.quote(str(path)) for name, path in paths.items()}
                if pattern == _POLYCAM and not (data / "keyframes" / "depth").exists():
                    # Captures without LiDAR lack the folder, which the command asks for and does not read.
                    command = f"mkdir {{data}}/keyframes/depth && {command}"
                return f"{file} has poses: `{command.format(**quoted)}` keeps them."
    for name in _UNREAD:
        file = data / name
        if file.is_file():
            compute = f"sadgs-process {shlex.quote(str(_folder_of_photos(data)))} FOLDER"
            problem = f"{file} may have poses, but in a format that is not read"
            return f"{problem}: write them to a transforms.json to keep them; `{compute}` computes others."
    return None


def _folder_of_photos(data: Path) -> Path:
    """Return a folder, or the first folder in it, that has images; the folder itself if none has."""
    for folder in (data, *sorted(data.glob("*/"))):
        if images_in(folder):
            return folder
    return data


def no_layout(data: Path) -> str:
    """Return the sentence for a folder without poses."""
    config = data
    if data.name != "config.yml":
        config = data / "config.yml"
    if config.is_file() and any(config.parent.glob("nerfstudio_models/step-*.ckpt")):
        run = shlex.quote(str(config))
        shown = f"`ns-viewer --load-config {run}` shows it"
        return f"{data} is a run and no capture: {shown}, and `sadgs-export {run} --output splat.ply` exports it."
    if not data.is_dir():
        return _no_folder(data)
    models = find_reconstructions(data)
    if models:
        model = data / next(iter(models))
        problem = f"{data} holds no transforms.json, but {model} holds a COLMAP reconstruction"
        return f"{problem}: leave `nerfstudio-data` out of the command."
    capture = _capture_around(data.absolute())
    if capture is not None:
        return f"{data} is a part of the capture {capture}: give --data that folder."
    kind = colmap.model_kind(data)
    if kind is not None:
        return _no_images(data, data / f"images.{kind}")
    elsewhere = poses_elsewhere(data)
    if elsewhere is not None:
        return elsewhere
    photos = data
    images = images_in(data)
    if not images:
        photos = data / "images"
        images = images_in(photos)
    if images:
        return f"{data} holds {len(images)} images but no camera poses: {_remedy_for_photos(photos, images)}."
    capture = _capture_inside(data)
    if capture is not None:
        return f"{data} is no capture, but {capture} in it is one: give --data that folder."
    return (
        f"{data.absolute()} holds neither transforms.json nor a COLMAP reconstruction ({', '.join(COLMAP_FOLDERS)}): "
        f"give --data another folder, or {GIVE_POSES}."
    )


def _remedy_for_photos(folder: Path, images: Sequence[Path]) -> str:
    """Return the commands for a folder of photos without poses, and what is against these photos."""
    quoted = shlex.quote(str(folder))
    remedy = f"`sadgs {quoted}` makes a splat of them, and `sadgs-process {quoted} FOLDER` computes the poses alone"
    longest = max(image_size(images[len(images) // 2]))
    if 0 < longest < SMALL_PHOTO:
        remedy += f"; photos of {longest} px show few features, so give them in their original size"
    return remedy


def _no_images(data: Path, poses: Path) -> str:
    """Return the sentence for a folder with a reconstruction, without the images of its poses."""
    names = colmap.image_names(data)
    for name in names[:1]:
        found = NearbyFiles(data).sentence(data / name)
        if found is not None:
            return f"{poses} has poses, but its image {data / name} {found}."
    return f"{poses} has poses, but its images, such as {names[:1]}, are not in {data}: put them there."


def _no_folder(data: Path) -> str:
    """Return the sentence for a path that is no folder."""
    if not data.exists():
        return f"{data} does not exist: give --data the folder of a capture."
    if data.suffix.lower() in VIDEO_SUFFIXES:
        command = f"sadgs-process {shlex.quote(str(data))} FOLDER"
        return f"{data} is a video and no capture: `{command}` makes a capture of it, and `sadgs` makes a splat."
    return f"{data} is a file: give --data the folder of a capture."


def _capture_around(folder: Path) -> Path | None:
    """Return the capture around an absolute folder of images, masks or poses; None if there is none."""
    for parent in folder.parents[:3]:
        part = folder.relative_to(parent).parts[0]
        is_known = part.startswith("images") or part in ("masks", "sparse", "colmap")
        if is_known and _is_capture(parent):
            return parent
    return None


def _capture_inside(data: Path) -> Path | None:
    """Return the first capture among the folders in a folder; None if there is none."""
    for folder in sorted(data.iterdir())[:100]:
        if folder.is_dir() and _is_capture(folder):
            return folder
    return None


def _is_capture(folder: Path) -> bool:
    """Return whether a folder has the layout of a capture. One that cannot be read is none to point to."""
    with contextlib.suppress(InputError):
        return layout_of(folder) is not None
    return False
