"""Checks of data with the settings of nerfstudio's parsers, made once a run, before anything is written."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath

from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.utils import dataparsers_utils as splits

from sadgs_ns.data import checks
from sadgs_ns.data.automatic import choose_parser
from sadgs_ns.errors import InputError

_checked: list[tuple[FullImageDatamanagerConfig, list[checks.Finding]]] = []
"""Settings whose data were just found good, at most one, with the findings that do not stop training."""


def check_ahead(config: FullImageDatamanagerConfig) -> None:
    """Check the data of the pipeline that will be made next; with these settings it then does not check them again.

    Raises:
        InputError: As `refuse_bad_data`.
    """
    _checked.clear()
    findings = refuse_bad_data(config)
    _checked.append((copy.deepcopy(config), findings))


def findings_of(config: FullImageDatamanagerConfig, open_images: bool = True) -> list[checks.Finding]:
    """Return the findings of `check_ahead`, once, if it checked these settings, or else those of a check now.

    Raises:
        InputError: As `refuse_bad_data`.
    """
    while _checked:
        settings, findings = _checked.pop()
        if settings == config:
            return findings
    return refuse_bad_data(config, open_images)


def refuse_bad_data(config: FullImageDatamanagerConfig, open_images: bool = True) -> list[checks.Finding]:
    """Choose the parser where none was named, and check the data before nerfstudio parses them.

    Parsers other than nerfstudio's three common ones are not checked.

    Args:
        config: Its parser is replaced where it is the automatic one.
        open_images: Whether to look into the images, too.

    Returns:
        Findings that do not stop training.

    Raises:
        InputError: With the first finding that does.
    """
    choose_parser(config)
    parser = config.dataparser
    data = Path(config.data or parser.data)
    if isinstance(parser, ColmapDataParserConfig):
        findings = checks.check_colmap(
            data,
            images_path=parser.images_path,
            colmap_path=parser.colmap_path,
            masks_path=parser.masks_path,
            downscale_factor=parser.downscale_factor,
            rounding=parser.downscale_rounding_mode,
            load_points=parser.load_3D_points,
            training_images=_training_images(parser),
            open_images=open_images,
        )
    elif isinstance(parser, NerfstudioDataParserConfig):
        findings = checks.check_nerfstudio(
            data,
            downscale_factor=parser.downscale_factor,
            load_points=parser.load_3D_points,
            training_images=_training_images(parser),
            open_images=open_images,
        )
    elif isinstance(parser, BlenderDataParserConfig):
        findings = checks.check_blender(data, ply_path=parser.ply_path, open_images=open_images)
    else:
        findings = []
    checks.refuse(findings, data)
    return findings


def _training_images(parser: ColmapDataParserConfig | NerfstudioDataParserConfig) -> Callable[[Sequence[str]], int]:
    """Return a function of all images' names that says how many of them the parser trains on."""

    def count(names: Sequence[str]) -> int:
        if parser.eval_mode == "fraction":
            chosen, _ = splits.get_train_eval_split_fraction(list(names), parser.train_split_fraction)
        elif parser.eval_mode == "interval":
            chosen, _ = splits.get_train_eval_split_interval(list(names), parser.eval_interval)
        elif parser.eval_mode == "filename":
            for name in names:
                if not any(word in PurePosixPath(name).name for word in ("train", "eval")):
                    raise InputError(
                        f"{name} has neither train nor eval in its name, by which `--eval-mode filename` divides the "
                        "images: rename them, or leave that option out."
                    )
            chosen, _ = splits.get_train_eval_split_filename(list(names))
        else:
            return len(names)
        return len(chosen)

    return count
