"""The choice of nerfstudio's parser by what a capture's folder holds, for users who name none."""

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

from sadgs_ns.data.checks.colmap import automatic_options
from sadgs_ns.data.checks.findings import unreadable
from sadgs_ns.data.checks.layouts import find_reconstruction, layout_of
from sadgs_ns.errors import InputError


@dataclass
class AutomaticDataParserConfig(DataParserConfig):
    """The parser that fits what the folder holds: transforms.json, a COLMAP reconstruction or a Blender scene."""


PARSERS: dict[str, DataParserConfig] = {
    "automatic": AutomaticDataParserConfig(),
    **all_dataparsers,
    "nerfstudio-data": NerfstudioDataParserConfig(load_3D_points=True),
}
"""Parsers by the names that they have on the command line: ours, then nerfstudio's."""

if TYPE_CHECKING:
    AnyParserConfig = DataParserConfig
else:
    AnyParserConfig = tyro.conf.OmitSubcommandPrefixes[
        tyro.extras.subcommand_type_from_defaults(PARSERS, prefix_names=False)
    ]
    """Union of which tyro makes subcommands, as nerfstudio does of its own parsers."""


def choose_parser(config: FullImageDatamanagerConfig) -> None:
    """Replace the automatic parser by the one that fits the data, so that a run's `config.yml` names that one.

    Raises:
        InputError: If the folder cannot be read; as `automatic_options`.
    """
    if not isinstance(config.dataparser, AutomaticDataParserConfig):
        return
    data = Path(config.data or config.dataparser.data)
    try:
        layout, folder = layout_of(data), find_reconstruction(data)
    except OSError as error:
        raise InputError(unreadable(error)) from error
    if layout == "blender":
        config.dataparser = BlenderDataParserConfig(data=data)
    elif layout == "colmap" and folder is not None:
        options = automatic_options(data, folder)
        config.dataparser = ColmapDataParserConfig(
            data=data, colmap_path=folder, images_path=options.images_path, downscale_factor=options.downscale_factor
        )
    else:
        config.dataparser = NerfstudioDataParserConfig(data=data, load_3D_points=True)
