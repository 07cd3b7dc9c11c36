"""The cameras of a finished run, read from its capture; nothing of the run's files is executed."""

from __future__ import annotations

import copy
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from sadgs_ns.data.coordinates import TRANSFORMS_NAME, Similarity, from_data
from sadgs_ns.errors import InputError, reason


@dataclass(frozen=True)
class RunCameras:
    """C pinhole cameras in the frame of training; distortion is left out."""

    camera_to_worlds: Tensor
    """OpenGL axes (x right, y up, z backward). [C, 3, 4]"""
    Ks: Tensor
    """Intrinsics in px. [C, 3, 3]"""
    sizes: list[tuple[int, int]]
    """Width and height in px. C of them"""
    photos: list[Path]
    """The image files. C of them"""


_CLASS = "<class>"
"""Key under which an object's mapping has the name of its class."""


class _PlainLoader(yaml.SafeLoader):
    """Reads Python objects as the mappings, lists, paths and texts that they are written as, and makes none."""


def _plain(loader: _PlainLoader, kind: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True) | {_CLASS: kind.removeprefix("object:")}
    if isinstance(node, yaml.SequenceNode):
        values = loader.construct_sequence(node, deep=True)
        return Path(*values) if kind.startswith("object/apply:pathlib.") else values
    return loader.construct_scalar(node)  # type: ignore[arg-type]


_PlainLoader.add_multi_constructor("tag:yaml.org,2002:python/", _plain)


def _noted(run: Path) -> tuple[Path, dict[str, Any]]:
    """Return the capture's folder and the parser's settings of a run's `config.yml`, or raise InputError."""
    path = run / "config.yml"
    try:
        manager = yaml.load(path.read_bytes(), Loader=_PlainLoader)["pipeline"]["datamanager"]
        parser = manager["dataparser"]
        data = Path(manager.get("data") or parser["data"])
    except (OSError, yaml.YAMLError, KeyError, TypeError, AttributeError) as error:
        what = type(error).__name__ if isinstance(error, KeyError) else reason(error)
        raise InputError(f"{path} does not tell where the capture is ({what}): give its folder with --data.") from error
    return data, parser


def find_capture(run: Path) -> Path:
    """Return the capture's folder that a run's `config.yml` names; raise InputError if it names none that exists."""
    data, _ = _noted(run)
    if not data.exists():
        raise InputError(f"{data}, on which {run} was trained, is not there: give the capture's folder with --data.")
    return data


def _parser(run: Path, data: Path) -> Any:
    """Return the configuration of the parser with which a run read its capture, or of the one that fits the folder."""
    # nerfstudio takes ten seconds to import, which `--help` and wrong arguments need not wait for.
    from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig

    from sadgs_ns.data.automatic import PARSERS, AutomaticDataParserConfig, choose_parser

    try:
        _, noted = _noted(run)
    except InputError:
        noted = {}
    known = {f"{type(parser).__module__}.{type(parser).__qualname__}": parser for parser in PARSERS.values()}
    parser = copy.deepcopy(known.get(noted.get(_CLASS, ""), AutomaticDataParserConfig()))
    for field in fields(parser):
        if field.name in noted and not field.name.startswith("_"):
            setattr(parser, field.name, noted[field.name])
    parser.data = data
    config = FullImageDatamanagerConfig(data=data, dataparser=parser)  # type: ignore[arg-type]
    choose_parser(config)
    parser = config.dataparser
    # Points are not needed. nerfstudio reads some with open3d, which a machine may lack, or asks whether to make a PLY.
    for name, value in (("load_3D_points", False), ("ply_path", None)):
        if hasattr(parser, name):
            setattr(parser, name, value)
    return parser


def read_cameras(run: Path, data: Path | None = None, split: str = "train") -> RunCameras:
    """Read a run's cameras, in its frame, as the run read them; where it does not tell how, as fits the folder.

    `data` is that folder; None is where the run's `config.yml` says it was. `split` is "train", or "test" for the views
    that are held out. InputError is raised if the capture cannot be read, or the run does not tell how it was moved.
    """
    data = find_capture(run) if data is None else data
    try:
        outputs = _parser(run, data).setup().get_dataparser_outputs(split=split)
    except InputError:
        raise
    except Exception as error:  # The parsers' errors are of every kind.
        raise InputError(f"{data} cannot be read as a capture ({reason(error)}): give another with --data.") from error
    cameras, poses = outputs.cameras, outputs.cameras.camera_to_worlds.double().numpy()
    if (run / TRANSFORMS_NAME).is_file():  # The run's own options may have moved the capture otherwise.
        transform = outputs.dataparser_scale * outputs.dataparser_transform.double().numpy()
        for similarity in (Similarity.of(transform).inverse(), from_data(run / TRANSFORMS_NAME)):
            poses = similarity.poses(poses)
    sizes = torch.cat([cameras.width, cameras.height], dim=1).tolist()
    return RunCameras(
        torch.from_numpy(poses).float(),
        cameras.get_intrinsics_matrices(),
        [(width, height) for width, height in sizes],
        outputs.image_filenames,
    )
