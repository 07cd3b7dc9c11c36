"""Runs that refine the training cameras' poses, and the update of a table of which a step moves some rows."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.utils import colmap_parsing_utils
from nerfstudio.scripts.render import DatasetRender
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.testing import assert_close

from examples.drawn_scene.scene import EVAL_INTERVAL, SPARSE_FOLDER, write_scene
from helpers.closeness import assert_within
from helpers.generators import seeded
from helpers.kill_and_resume import differences, parser_of, set_up
from helpers.refusals import refusal
from helpers.short_runs import TRAIN_VIEWS, blender_data, checkpoint, configure, train
from sadgs_ns.geometry.poses import corrected, image_motion
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.run.trainer import SadgsTrainer
from sadgs_ns.training.step.nonfinite import MAX_GRADIENT
from sadgs_ns.training.step.optimizers import AdamUpdate, FusedAdam, RowAdam
from sadgs_ns.training.step.poses import RefinedPoses
from sadgs_ns.training.step.row_adam import RowUpdate, empty_moments, move_rows

BETAS = (0.9, 0.999)
EPS = 1e-15
WIDTH = 64
HEIGHT = 48
VIEWS = 14
POINTS = 1000
"""Of the room whose cameras are disturbed."""
PIXELS = 2.0
"""How far the disturbance moves a camera's image, about."""


def run_of(parser: ColmapDataParserConfig, output: Path, iterations: int, poses: Any = "refined") -> SadgsTrainerConfig:
    config = configure(output, parser, iterations)
    config.machine.device_type = "cpu"
    config.pipeline.views_per_iteration = 1
    config.pipeline.model.poses = poses
    return config


def poses_of(trainer: SadgsTrainer) -> RefinedPoses:
    poses = trainer.pipeline.model.poses
    assert poses is not None
    return poses


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=seeded(seed))


# --- Adam of rows ---


def test_rows_that_are_moved_in_every_step_go_as_torch_s_adam():
    table = random(5, 6)
    expected = torch.nn.Parameter(table.clone())
    adam = torch.optim.Adam([expected], lr=0.1, betas=BETAS, eps=EPS)
    state = empty_moments(table)
    rows = RowUpdate(torch.ones(5, dtype=torch.bool), torch.ones(5, 6))
    flag = torch.zeros(1)
    for step in range(10):
        gradient = random(5, 6, seed=step)
        expected.grad = gradient.clone()
        adam.step()
        move_rows(table, gradient, state, rows, torch.tensor(0.1), BETAS, EPS, flag)
    assert_close(table, expected.detach(), rtol=1e-5, atol=1e-6)
    assert not flag.isnan().any()


def test_a_row_that_is_seen_now_and_then_goes_as_if_there_were_no_other_steps():
    often = random(2, 6)
    alone = often[:1].clone()
    states = empty_moments(often), empty_moments(alone)
    units = 1 + random(2, 6, seed=1).abs()
    flag = torch.zeros(1)
    for step in range(12):
        gradient = random(2, 6, seed=step)
        seen = step % 4 == 0
        before = often.clone()
        move_rows(often, gradient, states[0], RowUpdate(torch.tensor([seen, not seen]), units), 0.1, BETAS, EPS, flag)
        assert torch.equal(often[0], before[0]) is not seen
        assert torch.equal(often[1], before[1]) is seen
        if seen:
            one = RowUpdate(torch.tensor([True]), units[:1])
            move_rows(alone, gradient[:1], states[1], one, 0.1, BETAS, EPS, flag)
    assert torch.equal(often[:1], alone)
    assert states[0]["step"].tolist() == [3.0, 9.0]


def test_the_first_update_goes_the_rate_times_the_unit_of_each_number():
    table = torch.zeros(3, 6)
    units = 1 + random(3, 6).abs()
    rows = RowUpdate(torch.tensor([True, False, True]), units)
    gradient = random(3, 6, seed=1)
    move_rows(table, gradient, empty_moments(table), rows, 0.05, BETAS, EPS, torch.zeros(1))
    expected = -0.05 * units * gradient.sign()
    expected[1] = 0
    assert_close(table, expected)


def test_gradients_of_rows_that_are_not_finite_count_as_0_and_are_flagged():
    gradient = random(3, 6)
    gradient[1, 2] = torch.nan
    gradient[2, 4] = 2 * MAX_GRADIENT
    given = gradient.clone()
    table = torch.zeros(3, 6)
    flag = torch.zeros(1)
    rows = RowUpdate(torch.ones(3, dtype=torch.bool), torch.ones(3, 6))
    move_rows(table, gradient, empty_moments(table), rows, 0.05, BETAS, EPS, flag)
    assert flag.isnan().all()
    assert table.isfinite().all()
    assert table[1, 2] == 0
    assert table[2, 4] == 0
    actual = int((table == 0).sum())
    assert actual == 2
    assert torch.equal(gradient.nan_to_num(), given.nan_to_num()), "the caller's gradients stay"


def test_an_update_moves_tables_beside_other_parameters():
    means = torch.nn.Parameter(random(4, 3))
    table = torch.nn.Parameter(random(5, 6))
    update = AdamUpdate({"poses": RowAdam([table], lr=0.05), "means": FusedAdam([means], lr=0.1)})
    assert list(update.parameters) == ["means", "poses"]
    gradients = {"means": random(4, 3, seed=1), "poses": random(5, 6, seed=2)}
    moved = torch.tensor([True, False, False, True, False])
    before = table.detach().clone()
    update.launch(gradients, update.factors(), torch.zeros(1))
    assert torch.equal(table.detach(), before), "no row was named"
    update.launch(gradients, update.factors(), torch.zeros(1), (), RowUpdate(moved, torch.ones(5, 6)))
    assert torch.equal((table.detach() != before).any(dim=1), moved)


def test_views_that_were_not_drawn_keep_their_poses():
    poses = RefinedPoses(6)
    poses.units = torch.ones(6, 6)
    views = [torch.tensor([4, 0]), torch.tensor([2]), torch.tensor([5])]
    flags = [torch.zeros(1, dtype=torch.int64), torch.ones(1, dtype=torch.int64), None]
    actual = poses.row_update(views, flags).moved.tolist()
    expected = [True, False, False, False, True, True]
    assert actual == expected


# --- runs ---


def test_each_step_moves_its_views_alone_but_for_the_common_motion(colmap: ColmapDataParserConfig, tmp_path: Path):
    trainer = set_up(run_of(colmap, tmp_path, 4))
    poses = poses_of(trainer)
    poses.hold_frame = lambda: None  # type: ignore[method-assign]
    trainer.train()
    actual = int((poses.table.detach() != 0).any(dim=1).sum())
    assert actual == 4
    in_pixels = poses.table.detach() / poses.units
    assert 0.01 < float(in_pixels.abs().max()) < 0.06, "a step moves about a twentieth of a pixel"


def test_fixed_poses_stay_and_are_no_part_of_a_run(colmap: ColmapDataParserConfig, tmp_path: Path):
    trainer = train(run_of(colmap, tmp_path, 2, poses="fixed"))
    assert trainer.pipeline.model.poses is None
    assert "poses" not in trainer.optimizers.optimizers
    state = checkpoint(trainer, 1)
    assert not [name for name in state["pipeline"] if "poses" in name]


def disturb(scene: Path) -> dict[str, np.ndarray]:
    """Turn each training camera of a drawn scene about its centre; return the true matrices by the images' names."""
    folder = str(scene / SPARSE_FOLDER)
    model = colmap_parsing_utils.read_model(folder)
    assert model is not None
    cameras, images, points = model
    rng = np.random.default_rng(0)
    true = {}
    for number, image in images.items():
        viewmat = np.eye(4)
        viewmat[:3, :3] = colmap_parsing_utils.qvec2rotmat(image.qvec)
        viewmat[:3, 3] = image.tvec
        true[image.name] = viewmat
        if (number - 1) % EVAL_INTERVAL:
            turn = Rotation.from_rotvec(PIXELS / (0.8 * WIDTH) * rng.normal(size=3) / np.sqrt(2)).as_matrix()
            turned = turn @ viewmat[:3]
            quaternion = colmap_parsing_utils.rotmat2qvec(turned[:, :3])
            images[number] = image._replace(qvec=quaternion, tvec=turned[:, 3])
    colmap_parsing_utils.write_model(cameras, images, points, folder, ext=".bin")
    return true


def errors_in_pixels(trainer: SadgsTrainer, true: dict[str, np.ndarray]) -> float:
    """How far the images are from those of the true cameras, after the best similarity of all cameras; px."""
    poses = poses_of(trainer)
    outputs = trainer.pipeline.datamanager.train_dataparser_outputs
    frame = np.eye(4)
    frame[:3] = outputs.dataparser_transform.double().numpy()
    wanted = []
    for path, initial in zip(outputs.image_filenames, poses.initial.double().numpy(), strict=True):
        # From the capture's frame to the run's, which is turned, moved and scaled.
        to_world = frame @ np.linalg.inv(true[path.name])
        rotation = to_world[:3, :3]
        centre = outputs.dataparser_scale * to_world[:3, 3]
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation.T
        viewmat[:3, 3] = -rotation.T @ centre
        correction = viewmat @ np.linalg.inv(initial)
        wanted.append([*Rotation.from_matrix(correction[:3, :3]).as_rotvec(), *correction[:3, 3]])
    error = poses.table.detach().double() - torch.tensor(np.array(wanted))
    error -= (poses.gauge.motions.double() * poses.gauge.common_motion(error.float()).double()).sum(dim=2)
    return float((error / poses.units.double()).square().sum(dim=1).mean().sqrt())


def test_disturbed_cameras_come_closer_to_the_truth_and_the_gauge_holds(tmp_path: Path):
    scene = tmp_path / "scene"
    write_scene(scene, WIDTH, HEIGHT, VIEWS, POINTS)
    true = disturb(scene)
    config = run_of(parser_of(scene), tmp_path / "out", 150)
    config.pipeline.model.strategy.refine_stop_iter = 0
    config.optimizers["poses"]["optimizer"].lr = 0.15  # Each view is seen a dozen times.
    trainer = set_up(config)
    before = errors_in_pixels(trainer, true)
    common = []
    hold = poses_of(trainer).hold_frame

    def measure() -> None:
        hold()
        poses = poses_of(trainer)
        common.append(float(poses.gauge.common_motion(poses.table.detach()).abs().max()))

    poses_of(trainer).hold_frame = measure  # type: ignore[method-assign]
    trainer.train()
    after = errors_in_pixels(trainer, true)
    assert 0.7 * PIXELS < before < 1.6 * PIXELS
    assert after < 0.85 * before
    assert len(common) == 150
    assert max(common) < 1e-7


@pytest.mark.hard_case("a run that refines poses, stopped and resumed", "goes on bit for bit as if it had not stopped")
def test_a_resumed_run_goes_on_with_its_poses_bit_for_bit(colmap: ColmapDataParserConfig, tmp_path: Path):
    whole = run_of(colmap, tmp_path / "whole", 12)
    whole.steps_per_save = 6
    whole.save_only_latest_checkpoint = False
    expected = checkpoint(train(whole), 11)
    assert expected["pipeline"]["_model.poses.table"].all()
    resumed = run_of(colmap, tmp_path / "resumed", 12)
    resumed.load_dir = whole.get_checkpoint_dir()
    resumed.load_step = 6
    found = checkpoint(train(resumed), 11)
    for part in ("pipeline", "optimizers", "schedulers"):
        actual = differences(expected[part], found[part])
        assert actual == []


def test_training_views_are_rendered_with_their_refined_poses_and_others_as_they_are(
    colmap: ColmapDataParserConfig, tmp_path: Path
):
    trainer = train(run_of(colmap, tmp_path, 6))
    pipeline = trainer.pipeline
    pipeline.eval()
    poses = poses_of(trainer)
    cameras = pipeline.datamanager.train_dataset.cameras
    for index in range(TRAIN_VIEWS):
        found = pipeline.model.pinhole(cameras[index : index + 1]).viewmats[0]
        expected = corrected(poses.initial[index : index + 1], poses.table[index : index + 1].detach())[0]
        assert torch.equal(found, expected)
        assert torch.equal(pipeline.views.viewmat(index), expected)
        actual = viewmats_from_camera_to_world(poses.camera_to_world(index)[None])[0]
        assert_within(actual, expected, 1e-6)
    camera, _ = pipeline.datamanager.fixed_indices_eval_dataloader[0]
    initial = viewmats_from_camera_to_world(camera.camera_to_worlds)
    assert torch.equal(pipeline.model.pinhole(camera).viewmats, initial)


def test_ns_render_draws_training_views_with_their_refined_poses(
    colmap: ColmapDataParserConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    options = run_of(colmap, tmp_path, 6)
    options.save_config()
    trainer = train(options)
    drawn: list[Tensor] = []
    model_class = type(trainer.pipeline.model)
    render = model_class.render

    def keep(model: Any, cameras: Any, *options: Any, **others: Any) -> Any:
        drawn.append(cameras.viewmats[0])
        return render(model, cameras, *options, **others)

    monkeypatch.setattr(model_class, "render", keep)
    config = trainer.base_dir / "config.yml"
    render_images = DatasetRender(config, output_path=tmp_path / "images")
    render_images.split = "train+test"
    render_images.rendered_output_names = ["rgb"]
    render_images.main()
    expected = [trainer.pipeline.views.viewmat(index) for index in range(TRAIN_VIEWS)]
    actual = torch.stack(drawn[:TRAIN_VIEWS])
    assert_within(actual, torch.stack(expected), 1e-6)
    assert not torch.allclose(drawn[0], poses_of(trainer).initial[0], rtol=0, atol=1e-6)
    held_out = viewmats_from_camera_to_world(trainer.pipeline.datamanager.eval_dataset.cameras.camera_to_worlds)
    actual = torch.stack(drawn[TRAIN_VIEWS:])
    assert_within(actual, held_out, 1e-6)


# --- where poses stay ---


def test_the_poses_of_blender_data_stay_and_a_line_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    config = configure(tmp_path / "out", blender_data(tmp_path / "data", "black"), 2)
    config.machine.device_type = "cpu"
    config.pipeline.model.poses = "refined"
    trainer = set_up(config)
    assert trainer.pipeline.model.poses is None
    printed = capsys.readouterr().out
    assert "The poses stay as they are: those of Blender data are exact." in printed


def test_a_checkpoint_with_fixed_poses_goes_on_with_refined_ones(colmap: ColmapDataParserConfig, tmp_path: Path):
    first = run_of(colmap, tmp_path / "first", 4, poses="fixed")
    train(first)
    second = run_of(colmap, tmp_path / "second", 8)
    second.load_dir = first.get_checkpoint_dir()
    trainer = train(second)
    assert poses_of(trainer).table.detach().any()


@pytest.mark.hard_case("a checkpoint with refined poses, resumed with fixed ones", "refused in one sentence")
def test_a_checkpoint_with_refined_poses_is_not_continued_with_fixed_ones(
    colmap: ColmapDataParserConfig, tmp_path: Path
):
    first = run_of(colmap, tmp_path / "first", 4)
    train(first)
    second = run_of(colmap, tmp_path / "second", 8, poses="fixed")
    second.load_dir = first.get_checkpoint_dir()
    with refusal(r"It optimized poses, too: set pipeline\.model\.color-model and"):
        set_up(second)


# --- earlier versions ---


def test_the_adjustments_of_earlier_versions_become_the_same_poses(colmap: ColmapDataParserConfig, tmp_path: Path):
    trainer = set_up(run_of(colmap, tmp_path, 2))
    poses = poses_of(trainer)
    cameras = copy.deepcopy(trainer.pipeline.datamanager.train_dataset.cameras)
    optimizer = CameraOptimizerConfig(mode="SO3xR3").setup(num_cameras=TRAIN_VIEWS, device="cpu")
    adjustment = 0.05 * random(TRAIN_VIEWS, 6)
    optimizer.pose_adjustment.data.copy_(adjustment)
    table = poses.of_pose_adjustment(adjustment)
    found = corrected(poses.initial, table)
    for index in range(TRAIN_VIEWS):
        camera = cameras[index : index + 1]
        camera.metadata = {"cam_idx": index}
        expected = viewmats_from_camera_to_world(optimizer.apply_to_camera(camera).detach())[0]
        assert_within(found[index], expected, 2e-6)


def test_units_move_an_image_by_one_pixel(colmap: ColmapDataParserConfig, tmp_path: Path):
    trainer = set_up(run_of(colmap, tmp_path, 2))
    poses = poses_of(trainer)
    cameras = trainer.pipeline.datamanager.train_dataset.cameras
    sizes = torch.cat([cameras.width, cameras.height], dim=1).float()
    points = trainer.pipeline.model.means.detach()
    depths = (points @ poses.initial[:, 2, :3].T + poses.initial[:, 2, 3]).median(dim=0).values  # [V]
    motion = image_motion(cameras.get_intrinsics_matrices(), sizes, depths[:, None])
    in_pixels = (poses.units.square() * motion.diagonal(dim1=1, dim2=2)).sqrt()
    assert in_pixels.min() > 0.6
    assert in_pixels.max() < 1.6
