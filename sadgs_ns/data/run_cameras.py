"""The cameras of a finished run, read from its capture; nothing of the run's files is executed."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from sadgs_ns.data import colmap
from sadgs_ns.data.coordinates import TRANSFORMS_NAME, Similarity, from_data
from sadgs_ns.errors import InputError, reason


@dataclass(frozen=True)
class RunCameras:
    """C pinhole cameras in the frame of training; distortion is left out."""

    camera_to_worlds: Tensor  # OpenGL axes (x right, y up, z backward). [C, 3, 4]
    Ks: Tensor  # Intrinsics in px. [C, 3, 3]
    sizes: list[tuple[int, int]]  # Widths and heights in px


_CLASS = "<class>"  # Key of an object's class in its mapping


class _PlainLoader(yaml.SafeLoader):
    """Reads Python objects as mappings, lists, paths and texts, as they are written, and makes none of them."""


def _plain(loader: _PlainLoader, kind: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True) | {_CLASS: kind.removeprefix("object:")}
    if isinstance(node, yaml.SequenceNode):
        values = loader.construct_sequence(node, deep=True)
        return Path(*values) if kind.startswith("object/apply:pathlib.") else values
    return loader.construct_scalar(node)  # type: ignore[arg-type]


_PlainLoader.add_multi_constructor("tag:yaml.org,2002:python/", _plain)


def find_capture(run: Path) -> tuple[Path, dict[str, Any]]:
    """Return the capture's folder and its parser's settings in a run's `config.yml`, or raise InputError."""
    path = run / "config.yml"
    try:
        manager = yaml.load(path.read_bytes(), Loader=_PlainLoader)["pipeline"]["datamanager"]
        parser = manager["dataparser"]
        return Path(manager.get("data") or parser["data"]), parser
    except (OSError, yaml.YAMLError, KeyError, TypeError, AttributeError) as error:
        what = type(error).__name__ if isinstance(error, KeyError) else reason(error)
        raise InputError(f"{path} does not tell where the capture is ({what}): give its folder with --data.") from error


def _parser(settings: Mapping[str, Any], data: Path) -> Any:
    """Return a parser with settings as `find_capture` returns them, or the one that fits if they name none."""
    # nerfstudio takes ten seconds to import, which `--help` and wrong arguments need not wait for.
    from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser

    from sadgs_ns.data.images import automatic_factor
    from sadgs_ns.data.own_parsers import OWN
    from sadgs_ns.data.parsers import PARSERS, AutomaticDataParserConfig, choose_parser

    known = {f"{type(parser).__module__}.{type(parser).__qualname__}": parser for parser in PARSERS.values()}
    parser: Any = copy.deepcopy(known.get(settings.get(_CLASS, ""), AutomaticDataParserConfig()))
    for field in fields(parser):
        if field.name in settings and not field.name.startswith("_"):
            setattr(parser, field.name, settings[field.name])
    parser.data = data
    config = FullImageDatamanagerConfig(data=data, dataparser=parser)
    choose_parser(config)
    parser = config.dataparser
    parser._target = OWN.get(parser._target, parser._target)
    # Points are not needed. nerfstudio reads some with open3d, which a machine may lack, or asks whether to make a PLY.
    for name, value in (("load_3D_points", False), ("ply_path", None)):
        if hasattr(parser, name):
            setattr(parser, name, value)
    made = parser.setup()
    if isinstance(made, ColmapDataParser):  # It asks whether to make smaller images, which are not needed either.
        first = data / parser.images_path / colmap.image_names(data / parser.colmap_path)[0]
        made._downscale_factor = parser.downscale_factor or automatic_factor(first)
    return made


def _parse(settings: Mapping[str, Any], data: Path, as_fits: bool) -> Any:
    """Parse with settings for `_parser`; if that fails, as fits the folder, if that has another layout."""
    try:
        return _parser(settings, data).get_dataparser_outputs(split="train")
    except Exception:
        fitting = _parser({}, data) if as_fits and settings else None
        if fitting is None or settings.get(_CLASS, "").endswith(f".{type(fitting.config).__qualname__}"):
            raise  # The folder may hold another COLMAP model than the run's, whose frame is another.
        return fitting.get_dataparser_outputs(split="train")


def read_cameras(run: Path, data: Path | None = None) -> RunCameras:
    """Read a run's training cameras in its frame, as the run did, or as fits the folder if it does not tell how.

    `data` is the capture's folder, by default where the run's `config.yml` says that it was. Raise InputError if the
    capture cannot be read, or the run does not tell how it moved it.
    """
    try:
        found, settings = find_capture(run)
    except InputError:
        if data is None:
            raise
        found, settings = data, {}
    if data is None and not found.exists():
        raise InputError(f"{found}, on which {run} was trained, is not there: give the capture's folder with --data.")
    found = data or found
    try:
        outputs = _parse(settings, found, as_fits=data is not None)
    except Exception as error:  # The parsers' errors are of every kind.
        raise InputError(f"{found} cannot be read as a capture ({reason(error)}): give another with --data.") from error
    cameras, poses = outputs.cameras, outputs.cameras.camera_to_worlds.double().numpy()
    if (run / TRANSFORMS_NAME).is_file():  # The run's own options may have moved the capture otherwise.
        transform = outputs.dataparser_scale * outputs.dataparser_transform.double().numpy()
        for similarity in (Similarity.of(transform).inverse(), from_data(run / TRANSFORMS_NAME)):
            poses = similarity.poses(poses)
    sizes = [(int(width), int(height)) for width, height in zip(cameras.width, cameras.height, strict=True)]
    return RunCameras(torch.from_numpy(poses).float(), cameras.get_intrinsics_matrices(), sizes)
