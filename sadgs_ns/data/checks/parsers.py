"""The check of a run's data with the options of its parser, made before anything is written."""

from __future__ import annotations

import copy
from dataclasses import fields
from pathlib import Path

from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from sadgs_ns.data.automatic import choose_parser
from sadgs_ns.data.checks.colmap import check_colmap
from sadgs_ns.data.checks.findings import Finding, refuse
from sadgs_ns.data.checks.layouts import ParserOptions
from sadgs_ns.data.checks.transforms import check_blender, check_nerfstudio

CHECKS = {
    ColmapDataParserConfig: check_colmap,
    NerfstudioDataParserConfig: check_nerfstudio,
    BlenderDataParserConfig: check_blender,
}
"""The check of each parser's data; other parsers' data are not checked."""


def keep_findings(config: FullImageDatamanagerConfig, findings: list[Finding]) -> None:
    """Keep in settings what `refuse_bad_data` found with them, so that `findings_of` need not check again, once."""
    vars(config)["findings"] = copy.deepcopy(config), findings


def findings_of(config: FullImageDatamanagerConfig, open_images: bool = True) -> list[Finding]:
    """Return the findings that were kept in these settings, or else those of a check now, as `refuse_bad_data`."""
    checked, findings = vars(config).pop("findings", (None, []))
    return findings if checked == config else refuse_bad_data(config, open_images)


def refuse_bad_data(config: FullImageDatamanagerConfig, open_images: bool = True) -> list[Finding]:
    """Choose the parser where none was named, and check the data before nerfstudio parses them.

    Returns the findings that do not stop training, and raises the first other one as InputError. The parser in `config`
    is replaced where it is the automatic one.
    """
    vars(config).pop("findings", None)
    choose_parser(config)
    parser = config.dataparser
    data = Path(config.data or parser.data)
    names = [field.name for field in fields(ParserOptions) if hasattr(parser, field.name)]
    options = ParserOptions(**{name: getattr(parser, name) for name in names})
    checks = [check for kind, check in CHECKS.items() if isinstance(parser, kind)]
    findings = checks[0](data, options, open_images) if checks else []
    refuse(findings, data)
    return findings
