"""How a capture's folder is laid out, and what to say where there is no layout that is known."""

from __future__ import annotations

from pathlib import Path

from sadgs_ns.data.validation.images import images_in

COLMAP_FOLDERS = ("colmap/sparse/0", "sparse/0", "sparse", "colmap")
"""Folders in which a reconstruction is looked for; nerfstudio's default is the first."""
GIVE_POSES = "compute poses with `sadgs-process PHOTOS FOLDER` or `ns-process-data`"


def find_reconstruction(data: Path) -> Path | None:
    """The folder of a COLMAP reconstruction, relative to the data, or None."""
    for folder in COLMAP_FOLDERS:
        if any((data / folder / f"cameras.{kind}").is_file() for kind in ("txt", "bin")):
            return Path(folder)
    return None


def no_layout(data: Path) -> str:
    """The sentence for a folder without poses."""
    if not data.exists():
        return f"{data} does not exist: give --data the folder of a capture."
    images = images_in(data) or images_in(data / "images")
    if images:
        return f"{data} holds {len(images)} images but no camera poses: {GIVE_POSES}."
    return (
        f"{data.absolute()} holds neither transforms.json nor a COLMAP reconstruction ({', '.join(COLMAP_FOLDERS)}): "
        f"give --data another folder, or {GIVE_POSES}."
    )
