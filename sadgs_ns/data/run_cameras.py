"""The cameras of a finished run, read from its capture. No code that the run's files name is executed."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
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
    """C cameras in the frame of training: pinholes, and the distortion of their photos."""

    camera_to_worlds: Tensor  # OpenGL axes (x right, y up, z backward). [C, 3, 4]
    Ks: Tensor  # Intrinsics in px. [C, 3, 3]
    sizes: list[tuple[int, int]]  # Widths and heights in px
    images: list[Path] = field(default_factory=list)  # Their photos
    distortion: Tensor | None = None  # nerfstudio's coefficients, k1 to k4, p1, p2. [C, 6]
    camera_model: str = "OPENCV"  # As `transforms.json` names it


CAMERA_MODELS = {1: "OPENCV", 2: "OPENCV_FISHEYE", 10: "FISHEYE624"}
"""Names in `transforms.json` of nerfstudio's types of cameras that training takes."""
_CLASS = "<class>"  # Key of an object's class in its mapping


class _PlainLoader(yaml.SafeLoader):
    """Reads Python objects as the mappings, lists, paths and texts that they are in the file, and makes no object."""


def _plain(loader: _PlainLoader, tag: str, node: yaml.Node) -> Any:
    """Construct a node of a Python object without the object; `tag` is the rest of its tag after "python/"."""
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True) | {_CLASS: tag.removeprefix("object:")}
    if isinstance(node, yaml.SequenceNode):
        values = loader.construct_sequence(node, deep=True)
        if tag.startswith("object/apply:pathlib."):
            return Path(*values)
        return values
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
        cause = reason(error)
        if isinstance(error, KeyError):  # Its text is the key alone.
            cause = type(error).__name__
        problem = f"{path} does not tell where the capture is ({cause})"
        raise InputError(f"{problem}: give its folder with --data.") from error


def _make_parser(settings: Mapping[str, Any], data: Path) -> Any:
    """Return a parser with settings as `find_capture` returns them, or the one that fits if they name none."""
    # nerfstudio takes ten seconds to import, which `--help` and wrong arguments need not wait for.
    from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser

    from sadgs_ns.data.images import automatic_factor
    from sadgs_ns.data.own_parsers import OWN
    from sadgs_ns.data.parsers import PARSERS, AutomaticDataParserConfig, choose_parser

    known = {f"{type(parser).__module__}.{type(parser).__qualname__}": parser for parser in PARSERS.values()}
    named = known.get(settings.get(_CLASS, ""), AutomaticDataParserConfig())
    parser: Any = copy.deepcopy(named)
    for option in fields(parser):
        if option.name in settings and not option.name.startswith("_"):
            setattr(parser, option.name, settings[option.name])
    parser.data = data
    manager = FullImageDatamanagerConfig(data=data, dataparser=parser)
    choose_parser(manager)
    parser = manager.dataparser
    parser._target = OWN.get(parser._target, parser._target)
    # Points are not needed. nerfstudio reads some with open3d, which a machine may lack, or asks whether to make a PLY.
    if hasattr(parser, "load_3D_points"):
        parser.load_3D_points = False
    if hasattr(parser, "ply_path"):
        parser.ply_path = None
    made = parser.setup()
    if isinstance(made, ColmapDataParser):  # It asks whether to make smaller images, which are not needed either.
        first = data / parser.images_path / colmap.image_names(data / parser.colmap_path)[0]
        made._downscale_factor = parser.downscale_factor or automatic_factor(first)
    return made


def _parse(settings: Mapping[str, Any], data: Path, may_be_other: bool) -> Any:
    """Parse the training views of a capture with settings for `_make_parser`.

    If that fails and `may_be_other`, the folder may have another layout than the settings are for: then the parser that
    fits the folder is used.
    """
    try:
        return _make_parser(settings, data).get_dataparser_outputs(split="train")
    except Exception:
        if not settings or not may_be_other:
            raise
        fitting = _make_parser({}, data)
        if settings.get(_CLASS, "").endswith(f".{type(fitting.config).__qualname__}"):
            raise  # With its defaults the same parser may read another COLMAP model than the run's, in another frame.
        return fitting.get_dataparser_outputs(split="train")


def _locate(run: Path, data: Path | None) -> tuple[Path, dict[str, Any]]:
    """Return a capture's folder, which is `data` if given, and its parser's settings; raise InputError if unknown."""
    if data is None:
        folder, settings = find_capture(run)
        if not folder.exists():
            problem = f"{folder}, on which {run} was trained, is not there"
            raise InputError(f"{problem}: give the capture's folder with --data.")
        return folder, settings
    try:
        _, settings = find_capture(run)
    except InputError:
        settings = {}
    return data, settings


def read_cameras(run: Path, data: Path | None = None) -> RunCameras:
    """Read a run's training cameras in its frame, with the run's parser, or one that fits if the run names none.

    `data` is the capture's folder, by default the one in the run's `config.yml`. Raise InputError if the capture cannot
    be read, or the run's `dataparser_transforms.json` cannot.
    """
    folder, settings = _locate(run, data)
    try:
        outputs = _parse(settings, folder, may_be_other=data is not None)
    except Exception as error:  # The parsers' errors are of every kind.
        problem = f"{folder} cannot be read as a capture ({reason(error)})"
        raise InputError(f"{problem}: give another with --data.") from error
    cameras = outputs.cameras
    poses = cameras.camera_to_worlds.double().numpy()  # [C, 3, 4]
    if (run / TRANSFORMS_NAME).is_file():  # The run's options may have moved the capture in another way.
        to_frame = Similarity.of(outputs.dataparser_scale * outputs.dataparser_transform.double().numpy())
        poses = to_frame.inverse().poses(poses)
        poses = from_data(run / TRANSFORMS_NAME).poses(poses)
    sizes = [(int(width), int(height)) for width, height in zip(cameras.width, cameras.height, strict=True)]
    return RunCameras(
        camera_to_worlds=torch.from_numpy(poses).float(),
        Ks=cameras.get_intrinsics_matrices(),
        sizes=sizes,
        images=list(outputs.image_filenames),
        distortion=cameras.distortion_params,
        camera_model=CAMERA_MODELS[int(cameras.camera_type[0])],
    )
