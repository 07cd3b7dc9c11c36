"""The check of a run's capture, with the settings of its parser, before nerfstudio parses it."""

from __future__ import annotations

import copy
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from nerfstudio.configs.dataparser_configs import all_dataparsers
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from sadgs_ns.data.checks.colmap import check_colmap
from sadgs_ns.data.checks.findings import Finding, check_findings
from sadgs_ns.data.checks.geometry import check_times
from sadgs_ns.data.checks.transforms import check_blender, check_nerfstudio
from sadgs_ns.data.images import NO_MASK
from sadgs_ns.data.layouts import ParserOptions
from sadgs_ns.data.nearby import NearbyFiles
from sadgs_ns.data.own_parsers import OWN
from sadgs_ns.data.parsers import choose_parser
from sadgs_ns.errors import InputError, reason
from sadgs_ns.files import check_encoding

CHECKS = {
    ColmapDataParserConfig: check_colmap,
    NerfstudioDataParserConfig: check_nerfstudio,
    BlenderDataParserConfig: check_blender,
}
"""The check of each parser's data; other parsers' data are parsed as a trial."""


def check_capture(config: FullImageDatamanagerConfig, open_images: bool = True) -> list[Finding]:
    """Choose the parser if none was named, and check the data before nerfstudio parses them.

    Return the findings that do not stop training; raise InputError with the first that does, and as `choose_parser`.
    """
    choose_parser(config)
    parser = config.dataparser
    data = Path(config.data or parser.data)
    check_encoding(data)
    names = [field.name for field in fields(ParserOptions) if hasattr(parser, field.name)]
    options = ParserOptions(**{name: getattr(parser, name) for name in names})
    for kind, check in CHECKS.items():
        if isinstance(parser, kind):
            findings = check(data, options, open_images)
            check_findings(findings, data)
            return findings
    if not open_images:
        return []
    return _parse_on_trial(parser, data)


def _parse_on_trial(config: DataParserConfig, data: Path) -> list[Finding]:
    """Parse data for which there is no check, and return the findings; raise InputError if the parser fails.

    These parsers raise errors of any class if the folder has another layout than theirs.
    """
    parser = copy.copy(config)
    parser.data = data
    parser._target = OWN.get(parser._target, parser._target)
    config_class = type(config)
    names = [name for name, other in all_dataparsers.items() if type(other) is config_class]
    name = next(iter(names), config_class.__name__)
    remedy = (
        "give --data the folder that this parser is for, or leave the parser out for transforms.json, COLMAP and "
        "Blender data"
    )
    findings = []
    for split in ("train", "val"):
        try:
            outputs = parser.setup().get_dataparser_outputs(split)
        except (InputError, MemoryError):
            raise
        except Exception as error:
            raise InputError(f"{data} cannot be read by {name} ({_cause(error)}): {remedy}.") from error
        _check_files([*outputs.image_filenames, *(outputs.mask_filenames or [])], data)
        if split == "train":
            if len(outputs.image_filenames) == 0:
                raise InputError(f"{name} finds no image to train on in {data}: {remedy}.")
            if outputs.cameras.times is not None:
                findings += check_times(outputs.cameras.times.flatten().tolist(), data)
    return findings


def _check_files(names: Sequence[Path | str], data: Path) -> None:
    """Raise InputError for the first file that a parser names and that is missing."""
    files = [Path(name) for name in names]
    nearby = NearbyFiles(data, files)
    for file in files:
        if file != NO_MASK and not file.is_file():
            problem = nearby.sentence(file) or "does not exist: put it there, or leave it out of the poses"
            raise InputError(f"{file} {problem}.")


def _cause(error: Exception) -> str:
    """Return the kind of an error, its first line, and the file that it is about if it names one."""
    file = ""
    if isinstance(error, OSError) and error.filename is not None:
        file = f": {os.fsdecode(error.filename)}"
    return f"{type(error).__name__}: {reason(error)}{file}"


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
