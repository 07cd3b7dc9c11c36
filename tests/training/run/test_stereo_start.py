"""Runs that start from points of stereo depth, on the drawn scene."""

from __future__ import annotations

import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.models.splatfacto import SH2RGB
from PIL import Image
from torch.testing import assert_close

from examples.drawn_scene.scene import room_surfaces
from helpers.kill_and_resume import set_up
from helpers.refusals import refusal
from helpers.short_runs import TRAIN_VIEWS, configure, nerfstudio_data, train
from helpers.small_scenes import HEIGHT, POINTS, WIDTH
from sadgs_ns.data.run_frame import points_in_the_run
from sadgs_ns.geometry.stereo import depth_maps
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world
from sadgs_ns.training import datamanager, pipeline, presets
from sadgs_ns.training.run import stereo_start
from sadgs_ns.training.step.images import LazyImages


@pytest.fixture
def config(colmap: ColmapDataParserConfig, tmp_path: Path) -> Any:
    config = configure(tmp_path / "out", colmap, iterations=2)
    config.pipeline.model.stereo_points = 400
    return config


def test_points_near_the_surfaces_are_added_to_the_initial_ones_whatever_the_seed(config: Any):
    started = set_up(config).pipeline
    config.machine.seed = 7
    model = started.model
    again = set_up(config).pipeline.model
    assert torch.equal(model.means, again.means)
    assert not torch.equal(model.quats, again.quats)
    config.pipeline.model.stereo_points = 0
    before = set_up(config).pipeline.model.means
    assert len(before) + 100 < model.num_points <= len(before) + 400
    assert (model.means[: len(before)] == before).all()
    added = {name: value.detach()[len(before) :].cpu().double() for name, value in model.gauss_params.items()}
    assert (added["opacities"].sigmoid() - model.config.initial_opacity).abs().max() < 1e-5
    ways = (added["means"][:, None] - model.means.detach().cpu().double()).norm(dim=2)
    shares = added["scales"].exp() / ways.topk(4, largest=False).values[:, 1:].mean(dim=1, keepdim=True)
    assert 0.01 < shares.min() < 0.5, "only short wavelengths make points smaller"
    assert shares.max() < 1 + 1e-4, "only short wavelengths make points smaller"
    data = started.datamanager.train_dataparser_outputs
    rng = np.random.default_rng(0)
    samples = []
    for surface in room_surfaces():
        points = surface.sample(5000, rng)
        samples.append((points, surface.colour(points)))
    positions, colors = (np.concatenate(parts) for parts in zip(*samples, strict=True))
    drawn = points_in_the_run(positions, colors, data.dataparser_transform, data.dataparser_scale)
    distances, nearest = torch.cdist(added["means"], drawn["points3D_xyz"].double()).min(dim=1)
    colors = SH2RGB(added["features_dc"])
    assert distances.median() < 0.05
    assert colors.min() > -1e-5
    assert colors.max() < 1 + 1e-5
    assert (colors - drawn["points3D_rgb"][nearest]).abs().mean() < 0.12


def test_few_points_are_joined_by_stereo_depth_or_a_line_says_why_not(config: Any, monkeypatch: Any, capsys: Any):
    monkeypatch.setattr(stereo_start, "PIXELS_OF_A_POINT", 1)

    def check(says_so: bool) -> None:
        started = set_up(config).pipeline
        said = "no points of stereo depth, which takes minutes on the CPU." in " ".join(capsys.readouterr().out.split())
        with monkeypatch.context() as patched:
            patched.setattr(pipeline.SadgsPipeline, "device", torch.device("cuda"))
            number = stereo_start.number_of_points(started)
        assert said == says_so
        assert number == stereo_start.NUMBER * says_so
        assert started.model.num_points <= POINTS

    config.machine.device_type, model = "cpu", config.pipeline.model
    for model.stereo_points, model.random_init in ((0, False), (400, True), (None, True), (None, False)):
        check(model.stereo_points is None and not model.random_init)
    sparse = WIDTH * HEIGHT // POINTS
    for fewest, pixels_of_a_point in ((8, sparse), (9, sparse), (3, sparse + 1), (3, 1)):
        monkeypatch.setattr(stereo_start, "FEWEST_VIEWS", fewest)
        monkeypatch.setattr(stereo_start, "PIXELS_OF_A_POINT", pixels_of_a_point)
        check(fewest <= TRAIN_VIEWS and pixels_of_a_point <= sparse)
    config.pipeline.datamanager.dataparser = nerfstudio_data(config.output_dir / "data")
    check(False)


def test_of_many_views_some_are_taken_that_lie_evenly(config: Any, monkeypatch: pytest.MonkeyPatch):
    counts: list[int] = []

    def counted(images: Any, viewmats: torch.Tensor, Ks: torch.Tensor, *others: Any, **options: Any) -> Any:
        counts.append(len(viewmats))
        assert len(Ks) == len(options["masks"]) == len(viewmats)
        return depth_maps(images, viewmats, Ks, *others, **options)

    monkeypatch.setattr(stereo_start, "depth_maps", counted)
    everything = set_up(config).pipeline.model.num_points
    monkeypatch.setattr(stereo_start, "MOST_VIEWS", TRAIN_VIEWS - 2)
    assert POINTS + 100 < set_up(config).pipeline.model.num_points <= everything
    assert counts == [TRAIN_VIEWS, TRAIN_VIEWS - 2]


def test_images_that_stay_compressed_are_decoded_one_by_one(config: Any, monkeypatch: pytest.MonkeyPatch):
    decoded: list[weakref.ref[torch.Tensor]] = []
    alive: list[int] = []
    decode = LazyImages.__getitem__

    def counted(images: LazyImages, index: Any) -> Any:
        data = decode(images, index)
        decoded.append(weakref.ref(data["image"]))
        alive.append(sum(image() is not None for image in decoded))
        return data

    config.pipeline.datamanager.cache_images = "compressed"
    monkeypatch.setattr(LazyImages, "__getitem__", counted)
    set_up(config)
    assert len(alive) >= TRAIN_VIEWS
    assert max(alive) < TRAIN_VIEWS / 2


@pytest.mark.parametrize("cap", [POINTS - 100, POINTS, POINTS + 50])
def test_no_more_points_are_added_than_the_cap_has_room_for(cap: int, config: Any):
    config.pipeline.model.strategy.max_gaussians = cap
    assert set_up(config).pipeline.model.num_points == cap


def test_a_resumed_run_does_not_look_for_depth_again(config: Any, monkeypatch: pytest.MonkeyPatch):
    trained = train(config)
    monkeypatch.setattr(stereo_start, "depth_maps", None)
    with pytest.raises(TypeError, match="not callable"):
        set_up(config)
    config.load_dir = trained.checkpoint_dir
    assert torch.equal(set_up(config).pipeline.model.means, trained.pipeline.model.means)


def test_points_lie_where_two_views_are_not_masked(config: Any, scene: Path, tmp_path: Path):
    right_half = np.tile(np.where(np.arange(WIDTH) < WIDTH // 2, 0, 255).astype(np.uint8), (HEIGHT, 1))
    for image in (scene / "images").iterdir():
        Image.fromarray(right_half).save(tmp_path / image.name)
    data = config.pipeline.datamanager
    data.dataparser.masks_path = tmp_path
    data.cache_images = "compressed"
    masked = set_up(config).pipeline
    cameras = masked.datamanager.train_dataset.cameras
    viewmats = viewmats_from_camera_to_world(cameras.camera_to_worlds)
    points = masked.model.means.detach()[POINTS:].cpu() @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    x = (points @ cameras.get_intrinsics_matrices().mT)[..., 0] / points[..., 2]  # px [V, P]
    assert x.shape[1] > 50
    assert ((x > WIDTH // 2 - 1e-3) & (x < WIDTH)).sum(dim=0).min() >= 2


def test_the_paper_s_presets_start_as_the_paper_says():
    models: list[Any] = [p.config.pipeline.model for p in (presets.sadgs_paper, presets.sadgs_paper_indoor)]
    actual = [(m.stereo_points, m.clear_paths, m.near_plane) for m in models]
    expected = [(0, False, "scene")] * 2
    assert actual == expected


@pytest.mark.parametrize("asked", [True, False])
def test_the_cameras_paths_are_kept_clear_if_the_options_ask_for_it(asked: bool, config: Any):
    config.pipeline.model.stereo_points = 0
    config.pipeline.model.clear_paths = asked
    assert ("camera_paths" in set_up(config).pipeline.model.strategy_state) == asked


@pytest.mark.hard_case(
    "SfM points from which no Gaussian starts, near cameras or because random ones are wanted",
    "these still tell surfaces from haze",
)
def test_sfm_points_are_of_surfaces_if_no_gaussian_starts_from_them(config: Any, monkeypatch: pytest.MonkeyPatch):
    config.pipeline.model.stereo_points = 0
    points = []
    for clearance, config.pipeline.model.random_init in ((0.0, False), (20.0, False), (0.0, True)):
        monkeypatch.setattr("sadgs_ns.training.model.CAMERA_CLEARANCE", clearance)
        model = set_up(config).pipeline.model
        points.append({tuple(point) for point in model.strategy_state["camera_paths"].points.tolist()})
        assert (model.num_points < 300) is (clearance > 0)
    assert points[0] == points[1] == points[2] != set()


def test_a_checkpoint_holds_the_paths(config: Any, tmp_path: Path):
    config.pipeline.model.stereo_points = 0
    started: Any = set_up(config).pipeline.model
    torch.save(started.get_extra_state(), tmp_path / "state")
    paths = started.strategy_state.pop("camera_paths")
    started.set_extra_state(torch.load(tmp_path / "state", weights_only=True))
    assert len(paths.points) > 0
    for name, value in vars(paths).items():
        actual = getattr(started.strategy_state["camera_paths"], name)
        assert_close(actual, value, rtol=0, atol=0)
    started.config.clear_paths = False
    started.set_extra_state(torch.load(tmp_path / "state", weights_only=True))
    assert "camera_paths" not in started.strategy_state, "the option turns the pruning off in a resumed run, too"


def test_a_negative_number_of_points_is_refused(config: Any):
    config.pipeline.model.stereo_points = -1
    with refusal(r"^pipeline\.model\.stereo_points must be in \[0, 10,000,000\], got -1\.$"):
        set_up(config)


def test_a_point_that_is_not_finite_does_not_hide_the_others(config: Any, monkeypatch: pytest.MonkeyPatch):
    parser = config.pipeline.datamanager.dataparser
    positions, colors = datamanager.colmap.read_points(parser.data / parser.colmap_path / "points3D.bin")
    wild = positions.copy()
    wild[0] = 1e200  # It becomes infinite in the run.
    monkeypatch.setattr(datamanager.colmap, "read_points", lambda path: (wild, colors))
    assert set_up(config).pipeline.model.num_points > POINTS + 100
