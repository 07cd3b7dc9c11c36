"""Looks at a data folder before nerfstudio parses it, and says in one sentence each what would go wrong.

A few hundred images take under a second. Nothing here needs torch, and only `parsers` needs nerfstudio.
"""

from __future__ import annotations

from pathlib import Path

from sadgs_ns.data.validation.blender import check_blender
from sadgs_ns.data.validation.colmap import check_colmap
from sadgs_ns.data.validation.findings import Finding, refuse
from sadgs_ns.data.validation.layouts import find_reconstruction, no_layout
from sadgs_ns.data.validation.transforms import check_nerfstudio

__all__ = ["Finding", "check_blender", "check_colmap", "check_data", "check_nerfstudio", "refuse"]


def check_data(data: Path) -> list[Finding]:
    """Check a folder in whatever layout it has, nerfstudio's, COLMAP's or Blender's, with the parsers' default options.

    Args:
        data: The folder, or a file in the layout of `transforms.json`.

    Returns:
        What was found; nothing if all is well.
    """
    if data.is_file() or (data / "transforms.json").is_file():
        return check_nerfstudio(data)
    if (data / "transforms_train.json").is_file():
        return check_blender(data)
    if (folder := find_reconstruction(data)) is not None:
        return check_colmap(data, colmap_path=folder)
    return [Finding("error", no_layout(data))]
