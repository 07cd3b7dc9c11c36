"""The sentences for folders whose layout is not known."""

from __future__ import annotations

import shlex
from pathlib import Path

from sadgs_ns.data import colmap
from sadgs_ns.data.images import images_in
from sadgs_ns.data.layouts import COLMAP_FOLDERS, find_reconstructions, layout_of
from sadgs_ns.data.transforms import GIVE_POSES

_BUNDLER = (
    "kapture_import_bundler.py -i {file} -l LIST.txt -im {photos} --add-reconstruction -o KAPTURE && "
    "kapture_export_colmap.py -i KAPTURE -db KAPTURE/colmap.db -txt {data}/sparse"
)
_EXPORTS = {
    "*.xml": (b"<chunk", "ns-process-data metashape --data {photos} --xml {file} --output-dir FOLDER"),
    "*.psx": (b"", "ns-process-data metashape --data {photos} --xml EXPORTED.xml --output-dir FOLDER"),
    "*.csv": (b"#name,", "ns-process-data realitycapture --data {photos} --csv {file} --output-dir FOLDER"),
    "*.xmp": (b"xcr:Rotation", "ns-process-data realitycapture --data {photos} --csv EXPORTED.csv --output-dir FOLDER"),
    "odm_report/shots.geojson": (b"", "ns-process-data odm --data {data} --output-dir FOLDER"),
    "keyframes/cameras/*.json": (b"", "ns-process-data polycam --data {data} --output-dir FOLDER"),
    "metadata.json": (b'"poses"', "ns-process-data record3d --data {data} --output-dir FOLDER"),
    "reconstruction.json": (b'"shots"', "opensfm export_colmap {data} && mv {data}/colmap_export {data}/sparse"),
    "*sfm*": (b'"poses"', "aliceVision_exportColmap --input {file} --output FOLDER --copyImages true"),
    "bundle.out": (b"# Bundle", _BUNDLER),
}
"""Files with other programs' poses, a part of their content, and the command that reads them."""


def poses_elsewhere(data: Path) -> str | None:
    """Return the sentence for a folder with another program's poses, which a command reads, or None."""
    for pattern, (mark, command) in _EXPORTS.items():
        if files := [file for file in sorted(data.glob(pattern)) if file.is_file() and mark in file.read_bytes()]:
            photos = next((folder for folder in (data, *sorted(data.glob("*/"))) if images_in(folder)), data)
            named = {"file": files[0], "photos": photos, "data": data}
            command = command.format(**{name: shlex.quote(str(path)) for name, path in named.items()})
            return f"{files[0]} has poses: `{command}` keeps them."
    return None


def no_layout(data: Path) -> str:
    """Return the sentence for a folder without poses."""
    config = data if data.name == "config.yml" else data / "config.yml"
    if config.is_file() and any(config.parent.glob("nerfstudio_models/step-*.ckpt")):
        run = shlex.quote(str(config))
        shown = f"`ns-viewer --load-config {run}` shows it"
        return f"{data} is a run and no capture: {shown}, and `sadgs-export {run} --output splat.ply` exports it."
    if not data.is_dir():
        return f"{data} {'is a file' if data.exists() else 'does not exist'}: give --data the folder of a capture."
    if models := find_reconstructions(data):
        told = f"{data} holds no transforms.json, but {data / next(iter(models))} holds a COLMAP reconstruction"
        return f"{told}: leave `nerfstudio-data` out of the command."
    around = data.absolute()
    for other in around.parents[:3]:
        inside = around.relative_to(other).parts[0]
        if (inside.startswith("images") or inside in ("masks", "sparse", "colmap")) and layout_of(other) is not None:
            return f"{data} is a part of the capture {other}: give --data that folder."
    if kind := colmap.model_kind(data):
        first = colmap.image_names(data)[:1]
        return f"{data}/images.{kind} has poses, but its images, such as {first}, are not in {data}: put them there."
    if told := poses_elsewhere(data):
        return told
    photos = data if images_in(data) else data / "images"
    if images := images_in(photos):
        command = f"`sadgs-process {shlex.quote(str(photos))} FOLDER`"
        return f"{data} holds {len(images)} images but no camera poses: compute them with {command}."
    for other in sorted(data.iterdir())[:100]:
        if other.is_dir() and layout_of(other) is not None:
            return f"{data} is no capture, but {other} in it is one: give --data that folder."
    return (
        f"{data.absolute()} holds neither transforms.json nor a COLMAP reconstruction ({', '.join(COLMAP_FOLDERS)}): "
        f"give --data another folder, or {GIVE_POSES}."
    )
