"""Checks of a data folder before nerfstudio parses it, in under a second for a few hundred images.

They need no torch; only `capture`, the check with the settings of a run, imports nerfstudio.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sadgs_ns.data.checks.colmap import check_colmap
from sadgs_ns.data.checks.findings import Finding, collect_findings
from sadgs_ns.data.checks.transforms import check_blender, check_nerfstudio
from sadgs_ns.data.layouts import ParserOptions, automatic_options, layout_of
from sadgs_ns.files import check_encoding


@collect_findings
def check_data(data: Path) -> Iterator[Finding]:
    """Return findings on a folder, or on a `transforms.json`, as `ns-train` reads it where no parser is named."""
    check_encoding(data)
    layout = layout_of(data)
    if layout == "colmap":
        yield from check_colmap(data, automatic_options(data))
    elif layout == "blender":
        yield from check_blender(data, ParserOptions())
    else:  # Without a known layout, this says what is missing.
        yield from check_nerfstudio(data, ParserOptions())
