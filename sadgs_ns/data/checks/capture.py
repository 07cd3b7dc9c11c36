"""The check of a run's capture, with the settings of its parser, before nerfstudio parses it."""

from __future__ import annotations

import copy
from dataclasses import dataclass, fields
from pathlib import Path

from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from sadgs_ns.data.checks.colmap import check_colmap
from sadgs_ns.data.checks.findings import Finding, check_findings
from sadgs_ns.data.checks.transforms import check_blender, check_nerfstudio
from sadgs_ns.data.layouts import ParserOptions
from sadgs_ns.data.parsers import choose_parser

CHECKS = {
    ColmapDataParserConfig: check_colmap,
    NerfstudioDataParserConfig: check_nerfstudio,
    BlenderDataParserConfig: check_blender,
}
"""The check of each parser's data; other parsers' data are not checked."""


def check_capture(config: FullImageDatamanagerConfig, open_images: bool = True) -> list[Finding]:
    """Choose the parser if none was named, and check the data before nerfstudio parses them.

    Return the findings that do not stop training; raise InputError with the first that does, and as `choose_parser`.
    """
    choose_parser(config)
    parser = config.dataparser
    data = Path(config.data or parser.data)
    names = [field.name for field in fields(ParserOptions) if hasattr(parser, field.name)]
    options = ParserOptions(**{name: getattr(parser, name) for name in names})
    for kind, check in CHECKS.items():
        if isinstance(parser, kind):
            findings = check(data, options, open_images)
            check_findings(findings, data)
            return findings
    return []


@dataclass(frozen=True)
class _CheckAhead:
    """A check at the start of a run, whose findings wait for the pipeline of the same run."""

    config: FullImageDatamanagerConfig  # The settings that were checked; the pipeline must be made of the same object
    settings: FullImageDatamanagerConfig  # A copy of them as they were then, which shows whether they have changed
    findings: list[Finding]


_ahead: _CheckAhead | None = None


def check_ahead(config: FullImageDatamanagerConfig) -> None:
    """Check a capture at the start of a run, and keep the findings for `findings_of`; raises as `check_capture`.

    nerfstudio makes a pipeline of its settings alone. The findings are no settings, and `config.yml` must not hold
    them, so they are kept here. A process that did not check ahead, as one of several devices, checks for itself.
    """
    global _ahead
    _ahead = None
    findings = check_capture(config)
    _ahead = _CheckAhead(config, copy.deepcopy(config), findings)


def findings_of(config: FullImageDatamanagerConfig, open_images: bool = True) -> list[Finding]:
    """Return the findings on a capture; raises as `check_capture`.

    They are those of `check_ahead`, if it checked these settings, they have not changed and nobody asked before.
    """
    global _ahead
    ahead = _ahead
    if ahead is None or ahead.config is not config:
        return check_capture(config, open_images)
    _ahead = None
    if ahead.settings != config:
        return check_capture(config, open_images)
    return ahead.findings
