"""The check of a run's capture, with the settings of its parser, before nerfstudio parses it."""

from __future__ import annotations

import copy
from dataclasses import fields
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
    vars(config).pop("findings", None)
    choose_parser(config)
    parser = config.dataparser
    data = Path(config.data or parser.data)
    names = [field.name for field in fields(ParserOptions) if hasattr(parser, field.name)]
    options = ParserOptions(**{name: getattr(parser, name) for name in names})
    checks = [check for kind, check in CHECKS.items() if isinstance(parser, kind)]
    findings = checks[0](data, options, open_images) if checks else []
    check_findings(findings, data)
    return findings


def keep_findings(config: FullImageDatamanagerConfig, findings: list[Finding]) -> None:
    """Keep what `check_capture` found with these settings, which `findings_of` then returns once without a check."""
    vars(config)["findings"] = copy.deepcopy(config), findings


def findings_of(config: FullImageDatamanagerConfig, open_images: bool = True) -> list[Finding]:
    """Return the findings that were kept in these settings, or else those of `check_capture`."""
    checked, findings = vars(config).pop("findings", (None, []))
    return findings if checked == config else check_capture(config, open_images)
