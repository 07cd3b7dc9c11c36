"""`sadgs-export --cameras` writes the training cameras of a run, with the poses that it refined."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from torch.testing import assert_close

from helpers.closeness import assert_within
from helpers.kill_and_resume import parser_of
from helpers.short_runs import TRAIN_VIEWS, configure, train
from sadgs_ns.cli import export
from sadgs_ns.data.coordinates import from_data
from sadgs_ns.data.own_parsers import OWN
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.run.trainer import SadgsTrainer


def run_of(scene: Path, output: Path, poses: str) -> tuple[Path, SadgsTrainer]:
    config: SadgsTrainerConfig = configure(output, parser_of(scene), 4)
    config.machine.device_type = "cpu"
    config.pipeline.model.poses = poses  # type: ignore[assignment]
    config.save_config()
    trainer = train(config)
    return trainer.base_dir / "config.yml", trainer


def refined_poses(trainer: SadgsTrainer) -> torch.Tensor:
    poses = trainer.pipeline.model.poses
    assert poses is not None
    return torch.stack([poses.camera_to_world(index) for index in range(TRAIN_VIEWS)])


def written_poses(file: Path) -> torch.Tensor:
    frames = json.loads(file.read_text("utf8"))["frames"]
    return torch.tensor([frame["transform_matrix"] for frame in frames])[:, :3]


def test_refined_cameras_are_written_in_either_frame(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run, trainer = run_of(scene, tmp_path, "refined")
    file = tmp_path / "cameras.json"
    status = export.main([str(run), "--output", str(tmp_path / "splat.ply"), "--cameras", str(file)])
    assert status == 0
    printed = capsys.readouterr().out
    assert f"{file}: {TRAIN_VIEWS} training cameras, refined" in printed
    expected = refined_poses(trainer)
    assert_within(written_poses(file), expected, 2e-6)
    initial = trainer.pipeline.datamanager.train_dataset.cameras.camera_to_worlds
    assert float((expected - initial).abs().max()) > 1e-4
    content = json.loads(file.read_text("utf8"))
    files = trainer.pipeline.datamanager.train_dataset.image_filenames
    actual = [frame["file_path"] for frame in content["frames"]]
    assert [(file.parent / name).resolve() for name in actual] == [path.resolve() for path in files]
    assert all(Path(name).is_absolute() for name in actual), "the images do not lie beside the file"

    arguments = ["--output", str(tmp_path / "splat.ply"), "--cameras", str(file), "--frame", "colmap"]
    status = export.main([str(run), *arguments])
    assert status == 0
    to_run = from_data(run.with_name("dataparser_transforms.json"))
    back = torch.from_numpy(to_run.poses(written_poses(file).double().numpy())).float()
    assert_within(back, expected, 5e-6)


def test_training_on_the_written_cameras_begins_where_the_run_ended(scene: Path, tmp_path: Path):
    run, trainer = run_of(scene, tmp_path, "refined")
    file = tmp_path / "again/transforms.json"
    status = export.main([str(run), "--output", str(tmp_path / "splat.ply"), "--cameras", str(file)])
    assert status == 0
    parser = NerfstudioDataParserConfig(data=file, eval_mode="all", downscale_factor=1)
    parser._target = OWN.get(parser._target, parser._target)
    outputs = parser.setup().get_dataparser_outputs("train")
    assert_within(outputs.cameras.camera_to_worlds, refined_poses(trainer), 2e-6)
    before = trainer.pipeline.datamanager.train_dataset.cameras
    actual = outputs.cameras.get_intrinsics_matrices()
    assert_close(actual, before.get_intrinsics_matrices())


def test_cameras_of_a_run_with_fixed_poses_are_those_of_the_capture(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    run, trainer = run_of(scene, tmp_path, "fixed")
    file = tmp_path / "cameras.json"
    status = export.main([str(run), "--output", str(tmp_path / "splat.ply"), "--cameras", str(file)])
    assert status == 0
    printed = capsys.readouterr().out
    assert f"{file}: {TRAIN_VIEWS} training cameras, as the capture has them" in printed
    initial = trainer.pipeline.datamanager.train_dataset.cameras.camera_to_worlds
    assert_within(written_poses(file), initial, 2e-6)


def test_a_capture_of_other_images_and_another_kind_of_file_are_refused(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    run, trainer = run_of(scene, tmp_path, "fixed")
    splat = tmp_path / "splat.ply"
    status = export.main([str(run), "--output", str(splat), "--cameras", "cameras.txt"])
    assert status == 2
    errors = capsys.readouterr().err
    assert "--cameras cameras.txt is for a file that ends in .json: name one." in errors
    checkpoint = trainer.checkpoint_dir / "step-000000003.ckpt"
    state = torch.load(checkpoint, weights_only=True)
    state["pipeline"]["_extra_state"]["images"] = ["a.png", "b.png"]
    torch.save(state, checkpoint)
    file = tmp_path / "cameras.json"
    status = export.main([str(run), "--output", str(splat), "--cameras", str(file)])
    assert status == 2
    error = capsys.readouterr().err
    assert f"The capture has {TRAIN_VIEWS} training images" in error
    assert "and the run had 2, a.png, …" in error
    assert not file.exists()
    assert not splat.exists()
