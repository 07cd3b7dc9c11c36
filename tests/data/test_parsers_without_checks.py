"""Data of nerfstudio's other parsers, for which there is no check: they are parsed as a trial before a run begins."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nerfstudio.configs.dataparser_configs import all_dataparsers
from nerfstudio.data.dataparsers.dnerf_dataparser import DNeRFDataParserConfig
from nerfstudio.data.dataparsers.nerfosr_dataparser import NeRFOSRDataParserConfig
from PIL import Image

from helpers.json_files import read_json, write_json
from helpers.kill_and_resume import set_up
from helpers.short_runs import blender_data, configure, frames, is_finite, train
from helpers.small_scenes import HEIGHT, WIDTH
from sadgs_ns.data.checks.capture import CHECKS, check_capture
from sadgs_ns.errors import InputError

# imageio, with which these parsers read sizes, and nerfstudio's own code are older than the libraries around them.
pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
OTHERS = {name: parser for name, parser in all_dataparsers.items() if type(parser) not in CHECKS}


@pytest.mark.hard_case(
    "a folder of another kind for `arkit-data`, `dnerf-data`, `instant-ngp-data`, `nuscenes-data`, `dycheck-data`, …",
    "refused, and no run's folder is made",
)
@pytest.mark.parametrize("name", OTHERS)
def test_a_folder_that_a_parser_cannot_read_is_refused_before_a_run_begins(name: str, tmp_path: Path):
    (tmp_path / "data").mkdir()
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "data/a.png")
    parser: Any = copy.deepcopy(OTHERS[name])
    parser.data = tmp_path / "data"
    config = configure(tmp_path / "out", parser)
    with pytest.raises(InputError) as refused:
        config.save_config()
    sentence = str(refused.value)
    assert sentence.startswith(f"{tmp_path}/data cannot be read by {name} (")
    assert "give --data the folder" in sentence
    assert "\n" not in sentence
    assert not (tmp_path / "out").exists()


def moving_scene(folder: Path, times: list[float]) -> None:
    """Write a scene as D-NeRF has them."""
    blender_data(folder, "white")
    for path in folder.glob("transforms_*.json"):
        content = read_json(path)
        for frame, time in zip(content["frames"], 5 * times, strict=False):
            frame["time"] = time
        write_json(path, content)


@pytest.mark.hard_case("`dnerf-data`, whose frames have a `time`", "trains as one moment, with a warning")
@pytest.mark.parametrize(("times", "number"), [([0.0, 0.5], 1), ([0.5, 0.5], 0)])
def test_a_scene_that_moves_is_told_of_other_parsers_too(times: list[float], number: int, tmp_path: Path):
    moving_scene(tmp_path / "data", times)
    config = configure(tmp_path / "out", DNeRFDataParserConfig(data=tmp_path / "data"))
    warnings = [finding.sentence for finding in check_capture(config.pipeline.datamanager)]
    assert len(warnings) == number
    for warning in warnings:
        assert warning.startswith(f"{tmp_path}/data gives each frame a time, as of a scene that moves, and all are ")
    set_up(config)


@pytest.mark.hard_case("`nerfosr-data`, whose parser names files by texts", "trains")
def test_names_of_files_may_be_texts(tmp_path: Path):
    scene = tmp_path / "data/stjacob/final"
    described = frames(tmp_path / "drawn", [(WIDTH, HEIGHT)])
    for index, frame in enumerate(described):
        split = scene / ["validation", "test", "train"][min(index // 2, 2)]
        for name in ("rgb", "mask", "intrinsics", "pose"):
            (split / name).mkdir(parents=True, exist_ok=True)
        (tmp_path / "drawn" / frame["file_path"]).rename(split / "rgb" / f"{index}.png")
        Image.new("L", (WIDTH, HEIGHT), 255 * (index % 2)).save(split / "mask" / f"{index}.png")
        K = np.diag([frame["fl_x"], frame["fl_y"], 1.0, 1.0])
        K[:2, 2] = [WIDTH / 2, HEIGHT / 2]
        pose = np.array(frame["transform_matrix"]) * [1, -1, -1, 1]
        for name, matrix in (("intrinsics", K), ("pose", pose)):
            (split / name / f"{index}.txt").write_text(" ".join(map(str, matrix.ravel())))
    parser = NeRFOSRDataParserConfig(data=tmp_path / "data", use_masks=True)
    trainer = train(configure(tmp_path / "out", parser))
    assert is_finite(trainer.pipeline.model)
    outputs = trainer.pipeline.datamanager.train_dataset._dataparser_outputs
    assert outputs.mask_filenames is not None
    for path in (*outputs.image_filenames, *outputs.mask_filenames):
        assert isinstance(path, Path)
