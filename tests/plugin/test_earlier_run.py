"""Runs that start from the Gaussians of an earlier one, before photos were added."""

from __future__ import annotations

import copy
import dataclasses
import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import runs
import torch
from kill_and_resume import configure, set_up
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from scenes import ITERATIONS
from torch import Tensor

from examples.drawn_scene.scene import SPARSE_FOLDER
from sadgs_ns.data.coordinates import TRANSFORMS_NAME
from sadgs_ns.data.validation.layouts import COLMAP_FOLDERS
from sadgs_ns.errors import InputError
from sadgs_ns.method.schedule import CONTINUED_SHARE, schedule
from sadgs_ns.plugin.trainer import SadgsTrainer, SadgsTrainerConfig
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world

EARLIER_VIEWS = 6
"""Of the room's 10; of both every 4th is held out."""


@dataclasses.dataclass
class Capture:
    """A capture to which views were added, and the run on it before."""

    data: Path
    """The folder of all views."""
    before: SadgsTrainer
    """The run on the first `EARLIER_VIEWS`."""

    @property
    def run(self) -> Path:
        return self.before.base_dir

    def config(self, output: Path, iterations: int = ITERATIONS) -> SadgsTrainerConfig:
        """A run on all views."""
        return of_room(self.data, output, iterations)

    def fix_frame(self, data: Path) -> Path:
        """Copy the capture, with the frame of the earlier run in its description."""
        shutil.copytree(self.data, data)
        moved = json.loads((self.run / TRANSFORMS_NAME).read_text())
        change_description(data, dataparser_transform=moved["transform"], dataparser_scale=moved["scale"])
        return data


def of_room(data: Path, output: Path, iterations: int) -> SadgsTrainerConfig:
    config = configure(data, output, iterations, save_every=0)
    config.pipeline.datamanager.dataparser = NerfstudioDataParserConfig(
        data=data, load_3D_points=True, downscale_factor=1, eval_mode="interval", eval_interval=4
    )
    return config


def change_description(data: Path, **values: Any) -> dict[str, Any]:
    """Change values of the transforms.json of a capture, and return all."""
    described = json.loads((data / "transforms.json").read_text()) | values
    (data / "transforms.json").write_text(json.dumps(described))
    return described


@pytest.fixture(scope="module")
def capture(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Capture:
    folder = tmp_path_factory.mktemp("capture")
    runs.nerfstudio_data(folder / "all")
    shutil.copytree(scene / SPARSE_FOLDER, folder / "all" / COLMAP_FOLDERS[0])
    change_description(folder / "all", applied_transform=torch.eye(4)[:3].tolist())
    data = Path(shutil.copytree(folder / "all", folder / "first"))
    change_description(data, frames=change_description(data)["frames"][:EARLIER_VIEWS])
    trainer = set_up(of_room(data, folder / "before", 60))
    trainer.train()
    path = next(trainer.checkpoint_dir.glob("*.ckpt"))
    state = torch.load(path, weights_only=True)
    rest = state["pipeline"]["_model.gauss_params.features_rest"]
    rest += 0.1 * torch.randn(rest.shape, generator=torch.Generator().manual_seed(0))  # So that turning them shows.
    state["pipeline"]["_model.gauss_params.means"][0] = torch.nan
    torch.save(state, path)
    for name, parameter in trainer.pipeline.model.gauss_params.items():
        parameter.data = state["pipeline"][f"_model.gauss_params.{name}"][1:]
    return Capture(folder / "all", trainer)


def picture(trainer: SadgsTrainer, image: str, count: int) -> Tensor:
    """Render the first Gaussians of a run's model at a training view. [H, W, 3]"""
    dataset, model = trainer.pipeline.datamanager.train_dataset, trainer.pipeline.model
    index = [path.name for path in dataset.image_filenames].index(image)
    camera, params = dataset.cameras[index : index + 1], {n: v[:count] for n, v in model.gauss_params.items()}
    viewmats, size = viewmats_from_camera_to_world(camera.camera_to_worlds), (int(camera.width), int(camera.height))
    with torch.no_grad():
        Ks = camera.get_intrinsics_matrices()
        return model.render(viewmats, Ks, *size, "RGB", params=params, sh_degree=3)[0][0]


@pytest.mark.parametrize("options", [{}, {"orientation_method": "none", "scale_factor": 3.0}])
def test_the_gaussians_show_the_same_in_the_frame_of_the_new_run(
    options: dict[str, Any], capture: Capture, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    config = capture.config(tmp_path)
    parser: Any = config.pipeline.datamanager.dataparser
    config.pipeline.datamanager.dataparser = dataclasses.replace(parser, **options)
    config.pipeline.start_from = capture.run
    trainer, count = set_up(config), capture.before.pipeline.model.num_points
    assert f"Starting from {count:,} Gaussians of {capture.run}" in capsys.readouterr().out
    parsed, before = (t.pipeline.datamanager.train_dataparser_outputs for t in (trainer, capture.before))
    assert abs(parsed.dataparser_scale - before.dataparser_scale) > 0.01
    assert trainer.pipeline.model.num_points > count, "some random points lie where no Gaussian is"
    for image in ("001.png", "005.png"):
        expected = picture(capture.before, image, count)
        assert expected.std() > 0.1
        # At a pixel more or less, a Gaussian's faint rim is drawn.
        torch.testing.assert_close(picture(trainer, image, count), expected, atol=5e-3, rtol=0)


def test_in_a_frame_that_the_capture_fixes_nothing_is_moved(capture: Capture, tmp_path: Path):
    config = of_room(capture.fix_frame(tmp_path / "data"), tmp_path, ITERATIONS)
    config.pipeline.start_from = capture.run
    trainer, before = set_up(config), capture.before
    for name, parameter in before.pipeline.model.gauss_params.items():
        started = trainer.pipeline.model.gauss_params[name]
        assert torch.equal(started[: len(parameter)], parameter)
        assert len(trainer.optimizers.optimizers[name].param_groups[0]["params"][0]) == len(started)
    parsed, parsed_before = (t.pipeline.datamanager.train_dataparser_outputs for t in (trainer, before))
    assert torch.equal(parsed.dataparser_transform, parsed_before.dataparser_transform)
    assert parsed.dataparser_scale == parsed_before.dataparser_scale
    poses = dict(zip(parsed.image_filenames, parsed.cameras.camera_to_worlds, strict=True))
    poses = {path.name: pose for path, pose in poses.items()}
    for path, pose in zip(parsed_before.image_filenames, parsed_before.cameras.camera_to_worlds, strict=True):
        torch.testing.assert_close(poses[path.name], pose, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"dataparser_transform": [[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0]], "dataparser_scale": 1.0}, "no rotation"),
        ({"dataparser_transform": [[1, 0, 0, 0]] * 2, "dataparser_scale": 1.0}, "no transform of 3 rows"),
        ({"dataparser_scale": 1.0}, "'dataparser_transform'"),
    ],
)
def test_a_frame_that_is_none_is_refused(values: dict[str, Any], told: str, capture: Capture, tmp_path: Path):
    data = Path(shutil.copytree(capture.data, tmp_path / "data"))
    change_description(data, **values)
    with pytest.raises(InputError, match=rf"transforms.json does not tell with .* is to be moved \(.*{told}"):
        set_up(of_room(data, tmp_path, ITERATIONS))


def test_it_goes_on_from_its_own_checkpoint_without_the_earlier_run(capture: Capture, tmp_path: Path):
    config = capture.config(tmp_path / "out")
    config.max_num_iterations, config.pipeline.start_from = None, Path(shutil.copytree(capture.run, tmp_path / "run"))
    trainer = set_up(config)
    views = len(trainer.pipeline.datamanager.train_dataset)
    anew = schedule(views)
    assert trainer.config.max_num_iterations == round(CONTINUED_SHARE * anew.iterations) < anew.iterations
    trainer.save_checkpoint(3)
    shutil.rmtree(tmp_path / "run")
    config.load_dir = trainer.checkpoint_dir
    config.save_config()
    resumed = set_up(config)
    assert resumed._start_step == 4 and resumed.config.max_num_iterations == trainer.config.max_num_iterations
    for name, parameter in trainer.pipeline.model.gauss_params.items():
        assert torch.equal(resumed.pipeline.model.gauss_params[name], parameter)


def test_held_out_views_that_it_was_trained_on_are_told_of(
    capture: Capture, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    for interval, told in ((4, False), (3, True)):
        config = capture.config(tmp_path)
        parser: Any = config.pipeline.datamanager.dataparser
        config.pipeline.datamanager.dataparser = dataclasses.replace(parser, eval_interval=interval)
        config.pipeline.start_from = capture.run
        set_up(config)
        assert (f"1 of the 4 views that are held out were trained on by {capture.run}" in told_by(capsys)) == told


def told_by(capsys: pytest.CaptureFixture[str]) -> str:
    return re.sub(r"\s+", " ", capsys.readouterr().out)


def test_what_cannot_be_started_from_is_one_sentence(capture: Capture, tmp_path: Path):
    unmoved = Path(shutil.copytree(capture.run, tmp_path / "unmoved"))
    (unmoved / TRANSFORMS_NAME).unlink()
    remedy = r"give --pipeline\.start-from the folder of a finished run of sadgs on this capture, or leave it out\.$"
    other = Path(shutil.copytree(capture.data, tmp_path / "data"))
    frames = change_description(other)["frames"]
    for frame in frames:
        frame["transform_matrix"][0][3] *= -1
    change_description(other, frames=frames)
    degree = capture.config(tmp_path / "degree")
    degree.pipeline.model.sh_degree = 2
    cases = (
        (capture.config(tmp_path), tmp_path, f"{tmp_path} holds no checkpoint: give --load-dir the folder of a run"),
        (capture.config(tmp_path), unmoved, rf"unmoved holds no {TRANSFORMS_NAME}, which tells how .*: {remedy}"),
        (
            of_room(other, tmp_path, ITERATIONS),
            capture.run,
            rf"cannot be started from: It was trained on other data, .*; {remedy}",
        ),
        (degree, capture.run, rf"cannot be started from: The checkpoint's features_rest have the shape .*; {remedy}"),
    )
    for config, run, told in cases:
        config = copy.deepcopy(config)
        config.pipeline.start_from = run
        with pytest.raises(InputError, match=told) as refused:
            set_up(config)
        assert "\n" not in str(refused.value)


def test_views_added_where_nothing_was_seen_are_learned_as_well_as_from_scratch(capture: Capture, tmp_path: Path):
    def psnr_of(start: Path | None, iterations: int) -> float:
        config = capture.config(tmp_path / str(iterations), iterations)
        config.pipeline.start_from = start
        trainer = set_up(config)
        trainer.train()
        trainer.pipeline.eval()
        return trainer.pipeline.get_average_eval_image_metrics()["psnr"]

    continued, anew = psnr_of(capture.run, 60), psnr_of(None, 120)
    print(f"QUALITY {continued:.2f} dB continued, {anew:.2f} dB from scratch")
    assert continued > anew - 0.5
