"""The cameras of a finished run, read from its capture; nothing of the run's files is executed."""

from __future__ import annotations

from dataclasses import dataclass
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


class _PlainLoader(yaml.SafeLoader):
    """Reads Python objects as the mappings, lists and texts that they are written as, and makes none."""


def _plain(loader: _PlainLoader, _: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return loader.construct_scalar(node)  # type: ignore[arg-type]


_PlainLoader.add_multi_constructor("tag:yaml.org,2002:python/", _plain)


def find_capture(run: Path) -> Path:
    """Return the capture's folder that a run's `config.yml` names; raise InputError if it names none that exists."""
    path = run / "config.yml"
    try:
        manager = yaml.load(path.read_bytes(), Loader=_PlainLoader)["pipeline"]["datamanager"]
        data = Path(*(manager.get("data") or manager["dataparser"]["data"]))
    except (OSError, yaml.YAMLError, KeyError, TypeError, AttributeError) as error:
        what = type(error).__name__ if isinstance(error, KeyError) else reason(error)
        raise InputError(f"{path} does not tell where the capture is ({what}): give its folder with --data.") from error
    if not data.exists():
        raise InputError(f"{data}, on which {run} was trained, is not there: give the capture's folder with --data.")
    return data


def read_cameras(run: Path, data: Path | None = None, split: str = "train") -> RunCameras:
    """Read a run's cameras, in its frame, with the parser that fits the capture's folder.

    `data` is that folder; None is where the run's `config.yml` says it was. `split` is "train", or "test" for the views
    that are held out. InputError is raised if the capture cannot be read, or the run does not tell how it was moved.
    """
    # nerfstudio takes ten seconds to import, which `--help` and wrong arguments need not wait for.
    from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig

    from sadgs_ns.data.automatic import AutomaticDataParserConfig, choose_parser

    data = find_capture(run) if data is None else data
    config = FullImageDatamanagerConfig(data=data, dataparser=AutomaticDataParserConfig(data=data))  # type: ignore[arg-type]
    try:
        choose_parser(config)
        outputs = config.dataparser.setup().get_dataparser_outputs(split=split)
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
