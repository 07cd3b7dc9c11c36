"""nerfstudio's parsers, by their names on the command line, and which one fits a capture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro
from nerfstudio.configs.dataparser_configs import all_dataparsers
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from sadgs_ns.data.layouts import automatic_options, layout_of, unreadable
from sadgs_ns.errors import InputError


@dataclass
class AutomaticDataParserConfig(DataParserConfig):
    """The parser that fits what the folder holds: transforms.json, a COLMAP reconstruction or a Blender scene."""


PARSERS: dict[str, DataParserConfig] = {
    "automatic": AutomaticDataParserConfig(),
    **all_dataparsers,
    "nerfstudio-data": NerfstudioDataParserConfig(load_3D_points=True),
}
"""Parsers by their names on the command line: ours, then nerfstudio's."""

if TYPE_CHECKING:
    AnyParserConfig = DataParserConfig
else:
    AnyParserConfig = tyro.conf.OmitSubcommandPrefixes[
        tyro.extras.subcommand_type_from_defaults(PARSERS, prefix_names=False)
    ]
    """The union that tyro turns into subcommands, as nerfstudio does with its own parsers."""


def choose_parser(config: FullImageDatamanagerConfig) -> None:
    """Replace the automatic parser by one that fits, which `config.yml` names; raise InputError for unreadable data."""
    if not isinstance(config.dataparser, AutomaticDataParserConfig):
        return
    data = Path(config.data or config.dataparser.data)
    try:
        layout = layout_of(data)
    except OSError as error:
        raise InputError(unreadable(error)) from error
    if layout == "blender":
        config.dataparser = BlenderDataParserConfig(data=data)
    elif layout == "colmap":
        options = automatic_options(data)
        config.dataparser = ColmapDataParserConfig(
            data=data,
            colmap_path=options.colmap_path,
            images_path=options.images_path,
            downscale_factor=options.downscale_factor,
            downscale_rounding_mode=options.downscale_rounding_mode,
        )
    else:
        config.dataparser = NerfstudioDataParserConfig(data=data, load_3D_points=True)
