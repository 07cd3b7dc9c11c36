"""Training, resuming, evaluating and exporting through nerfstudio, on a tiny drawn scene, on a GPU if there is one."""

from __future__ import annotations

import copy
import dataclasses
import math
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.models.splatfacto import SplatfactoModel
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.scripts.train import entrypoint
from nerfstudio.utils.eval_utils import eval_setup
from plyfile import PlyData
from torch.testing import assert_close

from examples.drawn_scene.scene import SPARSE_FOLDER
from helpers import forked_python
from helpers.closeness import assert_within_share
from helpers.json_files import read_json
from helpers.kill_and_resume import differences, set_up
from helpers.refusals import refusal
from helpers.short_runs import (
    ITERATIONS,
    SCHEDULE,
    TRAIN_VIEWS,
    blender_data,
    checkpoint,
    configure,
    is_finite,
    nerfstudio_data,
    train,
)
from helpers.small_scenes import HEIGHT, POINTS, VIEWS, WIDTH
from sadgs_ns.gsplat_compat import NEAR_PLANE
from sadgs_ns.method.quantization import dequantize
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world, visible
from sadgs_ns.render.types import Cameras as Pinholes
from sadgs_ns.training import model as model_module
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.lpips import load_lpips
from sadgs_ns.training.model import SadgsModel
from sadgs_ns.training.presets import RATES
from sadgs_ns.training.run.trainer import SadgsTrainer
from sadgs_ns.training.step.optimizers import AdamUpdate, FusedAdam
from sadgs_ns.training.step.train_step import training_step
from sadgs_ns.training.step.views import ViewSampler


@pytest.fixture(scope="module")
def finished(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run that `ns-train sadgs` made, here in this process, which has imported everything."""
    output = tmp_path_factory.mktemp("cli")
    options = {
        "output-dir": output,
        "experiment-name": "room",
        "timestamp": "run",
        "vis": "tensorboard",
        "max-num-iterations": ITERATIONS,
        "pipeline.views-per-iteration": 2,
        **{f"pipeline.model.strategy.{name.replace('_', '-')}": value for name, value in SCHEDULE.items()},
    }
    parser = {
        "data": scene,
        "colmap-path": SPARSE_FOLDER,
        "downscale-factor": 1,
        "eval-mode": "interval",
        "eval-interval": 8,
    }
    command = ["ns-train", "sadgs"]
    command += [word for name, value in options.items() for word in (f"--{name}", str(value))] + ["colmap"]
    command += [word for name, value in parser.items() for word in (f"--{name}", str(value))]
    with pytest.MonkeyPatch.context() as patched:
        patched.delenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", raising=False)
        patched.setattr(sys, "argv", command)
        entrypoint()
    return output / "room/sadgs/run"


def test_ns_train_leaves_one_checkpoint_of_the_last_iteration_that_loads_safely(finished: Path):
    (path,) = (finished / "nerfstudio_models").iterdir()
    assert path.name == f"step-{ITERATIONS - 1:09d}.ckpt"
    state = torch.load(path, weights_only=True)
    assert state["step"] == ITERATIONS - 1
    means = state["pipeline"]["_model.gauss_params.means"]
    assert len(means) > POINTS
    assert means.isfinite().all()


def test_making_lpips_draws_no_number_that_training_would(monkeypatch: pytest.MonkeyPatch):
    def weights(*args: object, **kwargs: object) -> torch.nn.Module:
        return torch.nn.Linear(3, 3)  # draws its weights, as AlexNet does before it loads its own

    monkeypatch.setattr("torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity", weights)
    before = torch.random.get_rng_state()
    assert load_lpips(torch.device("cpu")) is not None
    assert torch.equal(torch.random.get_rng_state(), before)


def test_ns_eval_reports_psnr_and_ssim_and_says_once_why_lpips_is_missing(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.delenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "no weights"))
    for name in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")  # where nothing listens
    ComputePSNR(load_config=finished / "config.yml", output_path=tmp_path / "output.json").main()
    results = read_json(tmp_path / "output.json")["results"]
    assert 5 < results["psnr"] < 60
    assert 0 < results["ssim"] <= 1
    assert not [name for name in results if "lpips" in name]
    printed = capsys.readouterr().out
    assert printed.count("LPIPS is not reported") == 1
    assert "urlopen" in printed  # not for any other reason


def test_ns_export_writes_every_gaussian_that_can_be_seen(finished: Path, tmp_path: Path, open3d: None):
    from nerfstudio.scripts.exporter import ExportGaussianSplat  # which imports it

    ExportGaussianSplat(load_config=finished / "config.yml", output_dir=tmp_path).main()
    (path,) = (finished / "nerfstudio_models").iterdir()
    opacities = torch.load(path, weights_only=True)["pipeline"]["_model.gauss_params.opacities"]
    vertices = PlyData.read(tmp_path / "splat.ply")["vertex"]
    assert len(vertices["x"]) == int((opacities >= -5.5373).sum()) > 0
    assert {"f_dc_0", "f_rest_44", "opacity", "scale_2", "rot_3"} <= set(vertices.data.dtype.names)


# --- training ---


@pytest.mark.parametrize("views", [1, 2])
def test_each_iteration_takes_its_number_of_views_in_nerfstudio_s_order(
    views: int, colmap: ColmapDataParserConfig, tmp_path: Path
):
    config = configure(tmp_path, colmap, iterations=3)
    config.pipeline.views_per_iteration = views
    trainer = set_up(config)
    order = trainer.pipeline.datamanager.train_unseen_cameras  # of nerfstudio, which draws nothing from it
    assert len(order) == TRAIN_VIEWS
    trainer.train()
    actual = trainer.pipeline.views.sampler.draw(TRAIN_VIEWS - 3 * views)
    assert actual == order[3 * views :]


def test_an_iteration_takes_no_more_views_than_there_are(
    colmap: ColmapDataParserConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    config = configure(tmp_path, colmap, iterations=3)
    config.pipeline.views_per_iteration = TRAIN_VIEWS + 3
    seen: list[list[int]] = []
    draw = ViewSampler.draw
    monkeypatch.setattr(ViewSampler, "draw", lambda *args: seen.append(draw(*args)) or seen[-1])
    assert train(config).pipeline.model.plan.views_per_iteration == TRAIN_VIEWS
    assert len(seen) == 3, "a round each"
    for drawn in seen:
        assert sorted(drawn) == list(range(TRAIN_VIEWS)), "a round each"


def test_no_view_at_all_per_iteration_is_refused(colmap: ColmapDataParserConfig, tmp_path: Path):
    config = configure(tmp_path, colmap)
    config.pipeline.views_per_iteration = 0
    with pytest.raises(ValueError, match=r"views_per_iteration must be at least 1, got 0\."):
        set_up(config)


def test_training_makes_the_training_views_more_alike(colmap: ColmapDataParserConfig, tmp_path: Path):
    psnr: list[float] = []
    config = configure(tmp_path, colmap, iterations=ITERATIONS)
    config.pipeline.model.strategy.refine_stop_iter = 0  # So few iterations do not make up for the final prune.

    def measure(trainer: SadgsTrainer) -> None:
        if trainer.step in (0, ITERATIONS - 1):
            with torch.no_grad():
                trainer.pipeline.eval()
                model = trainer.pipeline.model
                metrics = []
                for _ in range(TRAIN_VIEWS):
                    camera, batch = trainer.pipeline.datamanager.next_train(0)
                    metrics.append(model.get_metrics_dict(model.get_outputs(camera), batch)["psnr"])
            psnr.append(float(sum(metrics)) / TRAIN_VIEWS)

    train(config, measure)
    assert psnr[1] > psnr[0] + 0.5


def test_a_resumed_run_equals_one_that_was_never_stopped(colmap: ColmapDataParserConfig, tmp_path: Path):
    middle = 7  # after the structure step of iteration 6, and before AbsGS at 9
    last = 15  # beyond the last of them
    config = configure(tmp_path / "whole", colmap, iterations=last + 1)
    config.machine.device_type = "cpu"  # A GPU adds up gradients in no fixed order.
    config.pipeline.views_per_iteration = 2
    config.steps_per_save = middle
    config.save_only_latest_checkpoint = False
    whole = train(config)
    stopped = checkpoint(whole, middle)
    expected = checkpoint(whole, last)
    numbers = [len(state["pipeline"]["_model.gauss_params.means"]) for state in (stopped, expected)]
    assert POINTS < numbers[0] != numbers[1]

    resumed_config = configure(tmp_path / "resumed", copy.deepcopy(colmap), iterations=last + 1)
    resumed_config.machine.device_type = "cpu"
    resumed_config.pipeline.views_per_iteration = 2
    resumed_config.load_dir = whole.checkpoint_dir
    resumed_config.load_step = middle
    steps: list[int] = []
    resumed = train(resumed_config, lambda trainer: steps.append(trainer.step))

    assert steps == list(range(middle + 1, last + 1))
    actual = differences(checkpoint(resumed, last), expected)
    assert actual == []
    assert differences(stopped, expected) != []


def test_a_finished_run_is_the_mean_of_its_last_iterations_also_when_it_was_stopped_among_them(
    colmap: ColmapDataParserConfig, tmp_path: Path
):
    iterations = 20
    averaged = 6  # The mean is of the iterations 15 to 20.
    stop = 16

    def configured(folder: str, share: float) -> SadgsTrainerConfig:
        config = configure(tmp_path / folder, copy.deepcopy(colmap), iterations)
        config.pipeline.model.averaged_share = share
        config.machine.device_type = "cpu"  # A GPU adds up gradients in no fixed order.
        return config

    iterates: list[dict[str, torch.Tensor]] = []

    def keep(trainer: SadgsTrainer) -> None:
        params = trainer.pipeline.model.gauss_params
        iterates.append({name: value.detach().clone() for name, value in params.items()})

    train(configured("last", 0.0), keep)
    config = configured("whole", averaged / iterations)
    config.steps_per_save = stop
    config.save_only_latest_checkpoint = False
    whole = train(config)
    for name, value in whole.pipeline.model.gauss_params.items():
        expected = torch.stack([iterate[name] for iterate in iterates[-averaged:]]).double().mean(0)
        actual = value.detach().double()
        assert_close(actual, expected, rtol=1e-5, atol=1e-5)
    assert not torch.equal(whole.pipeline.model.means, iterates[-1]["means"])

    actual = checkpoint(whole, stop)["pipeline"]["_model._extra_state"]["average"]["count"]
    assert actual == stop + 1 - 14
    config = configured("resumed", averaged / iterations)
    config.load_dir = whole.checkpoint_dir
    config.load_step = stop
    last = iterations - 1
    assert differences(checkpoint(train(config), last), checkpoint(whole, last)) == []


@pytest.mark.hard_case(
    "haze that arises after the last densification step, where nothing else prunes",
    "is pruned every 100 iterations, the last time just before averaging begins",
)
def test_haze_is_pruned_after_densification_too_but_not_while_the_run_averages(
    monkeypatch: pytest.MonkeyPatch, colmap: ColmapDataParserConfig, tmp_path: Path
):
    monkeypatch.setattr(model_module, "HAZE_EVERY", 4)
    config = configure(tmp_path, copy.deepcopy(colmap), 20, refine_start_iter=2, refine_stop_iter=6)
    config.pipeline.model.averaged_share = 0.2  # of the iterations 17 to 20
    arises = {9, 13, 17}
    counts = [0]

    def add_haze(trainer: SadgsTrainer) -> None:
        model = trainer.pipeline.model
        paths = model.strategy_state["camera_paths"]
        counts.append(model.num_points)
        if len(counts) - 1 in arises:
            model.means.data[0] = paths.starts[0]
            model.scales.data[0] = math.log(paths.reach)

    assert is_finite(train(config, add_haze).pipeline.model)
    gone = {i for i in range(7, 21) if counts[i] != counts[i - 1]}
    assert gone == {12, 16}
    assert counts[20] == counts[6] - 2


@pytest.mark.hard_case(
    "Gaussians of a run that grow many times longer than their distance from the cameras",
    "are limited every 25 iterations and at the end",
)
@pytest.mark.parametrize("limit", [0.0, 0.5])
def test_no_gaussian_of_a_run_is_larger_than_its_distance_from_the_cameras_allows(
    limit: float, colmap: ColmapDataParserConfig, tmp_path: Path
):
    config = configure(tmp_path, copy.deepcopy(colmap), 28, refine_stop_iter=0)
    config.pipeline.model.max_angular_scale = limit
    config.optimizers["scales"]["optimizer"].lr = 0.3  # so that some grow into giants
    largest: list[float] = []

    def look(trainer: SadgsTrainer) -> None:
        model = trainer.pipeline.model
        cameras = trainer.pipeline.datamanager.train_dataset.cameras
        positions = cameras.camera_to_worlds[:, :, 3].to(model.means)
        distances = (model.means.detach()[:, None] - positions).norm(dim=-1).amin(dim=1)  # [N]
        largest.append(float((model.scales.detach().exp().amax(dim=1) / distances).max()))

    assert is_finite(train(config, look).pipeline.model)
    at_limits = [largest[iteration - 1] for iteration in (25, 28)]
    if limit:
        assert max(at_limits) <= limit * 1.0001
        assert max(largest) > 2 * limit  # in between they grow, or the limit would have nothing to do
    else:
        assert min(at_limits) > 1


@pytest.mark.parametrize(("views", "share"), [(1, 0.1), (2, 0.1**0.5), (4, 1.0)])
def test_rates_of_colours_and_opacities_fall_after_densification_in_steps_of_few_views(
    views: int, share: float, colmap: ColmapDataParserConfig, tmp_path: Path
):
    iterations = 30
    config = configure(tmp_path, colmap, iterations)
    config.pipeline.views_per_iteration = views
    optimizers = set_up(config).optimizers
    for name, more in (
        ("features_dc", 1.0),
        ("features_rest", 1.0),
        ("opacities", 1.5 ** (math.log(views) / math.log(4))),
    ):
        start = RATES[name][0] * more
        factor = optimizers.schedulers[name].lr_lambdas[0] if name in optimizers.schedulers else lambda step: 1.0
        rates = [config.optimizers[name]["optimizer"].lr * more * factor(step) for step in (0, 16, 23, iterations)]
        assert rates == pytest.approx([start, start, start * share**0.5, start * share])
        assert optimizers.optimizers[name].param_groups[0]["lr"] == pytest.approx(start)


def test_resuming_with_other_settings_says_which(
    finished: Path, colmap: ColmapDataParserConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    for views, tau_split in ((2, 0.8), (4, 0.7)):
        config = configure(tmp_path / str(views), copy.deepcopy(colmap), iterations=ITERATIONS, tau_split=tau_split)
        config.pipeline.views_per_iteration = views
        config.load_dir = finished / "nerfstudio_models"
        set_up(config)
        printed = " ".join(capsys.readouterr().out.split())
        assert ("other settings" in printed) == (views == 4)
    assert (
        "other settings; this one goes on with its own: pipeline.views_per_iteration was 2 and is 4, "
        "pipeline.model.strategy.tau_split was 0.8 and is 0.7."
    ) in printed


def test_resuming_a_finished_run_trains_no_further(finished: Path, colmap: ColmapDataParserConfig, tmp_path: Path):
    config = configure(tmp_path, colmap, iterations=ITERATIONS)
    config.pipeline.views_per_iteration = 2
    config.load_dir = finished / "nerfstudio_models"
    steps: list[int] = []
    trainer = train(config, lambda trainer: steps.append(trainer.step))
    (path,) = config.load_dir.iterdir()
    saved = torch.load(path, weights_only=True)
    assert steps == []
    actual = differences(checkpoint(trainer, ITERATIONS - 1)["pipeline"], saved["pipeline"])
    assert actual == []


def test_max_gaussians_is_never_exceeded(colmap: ColmapDataParserConfig, tmp_path: Path):
    cap = POINTS + 20
    numbers: list[int] = []
    config = configure(tmp_path, colmap, iterations=ITERATIONS, max_gaussians=cap, clone_grad2d=0.0)
    train(config, lambda trainer: numbers.append(trainer.pipeline.model.num_points))
    assert max(numbers) == cap


def test_the_mean_opacity_weighs_in_the_loss_while_densification_runs(
    colmap: ColmapDataParserConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    config = configure(
        tmp_path,
        colmap,
        8,
        absgs_every=0,
        structure_every=0,
        refine_stop_iter=4,
        reset_every=0,
    )
    config.pipeline.model.opacity_reg = 100.0  # against which the images weigh nothing
    config.cuda_graphs = False  # A graph would not ask what is replaced below.
    opacities: list[float] = []
    regularized: list[bool] = []

    def look(model: SadgsModel, groups: Any, opacity_reg: float, *args: Any) -> Any:
        opacities.append(float(torch.sigmoid(model.opacities.detach()).mean()))
        result = training_step(model, groups, opacity_reg, *args)
        regularized.append(opacity_reg > 0)
        photometric = float(result.loss) - opacity_reg * opacities[-1]
        assert 0 < photometric < 2
        assert opacity_reg in (0, 100)
        return result

    monkeypatch.setattr("sadgs_ns.training.run.trainer.training_step", look)
    set_up(config).train()
    assert regularized == [True] * 4 + [False] * 4
    assert opacities[0] > opacities[1] > opacities[2] > opacities[3]


@pytest.mark.parametrize(("degree", "degrees"), [(0, [None] * 5), (1, [0, 1, 1, 1, 1]), (3, [0, 1, 2, 3, 3])])
def test_the_degree_of_harmonics_rises_by_one_each_iteration_up_to_the_option(
    degree: int,
    degrees: list[int | None],
    colmap: ColmapDataParserConfig,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    config = configure(tmp_path, colmap, iterations=5)
    config.pipeline.model.sh_degree = degree
    config.cuda_graphs = False  # A graph would not ask what is replaced below.
    drawn: list[int | None] = []

    def look(model: SadgsModel, groups: Any, *args: Any) -> Any:
        drawn.extend(group.options.sh_degree for group in groups)
        return training_step(model, groups, *args)

    monkeypatch.setattr("sadgs_ns.training.run.trainer.training_step", look)
    set_up(config).train()
    assert drawn == degrees


def test_sfm_points_start_as_opaque_as_asked_and_no_others(colmap: ColmapDataParserConfig, tmp_path: Path):
    config = configure(tmp_path, colmap)
    config.pipeline.model.initial_opacity = 0.4
    config.pipeline.model.bounding_box_points = True
    model = set_up(config).pipeline.model
    opacities = [round(x, 4) for x in model.opacities.sigmoid().flatten().tolist()]
    assert sorted(set(opacities)) == [0.05, 0.4]
    assert opacities.count(0.05) <= 6 * 2**2, "images of few pixels have few points on the box"
    config.pipeline.model.random_init = True
    model = set_up(config).pipeline.model
    actual = {round(x, 4) for x in model.opacities.sigmoid().flatten().tolist()}
    assert actual == {0.1}


@pytest.mark.hard_case(
    "a cap smaller than the initial count, in `ns-train`", "keeps a random `max_gaussians` of the points and says so"
)
def test_more_initial_points_than_max_gaussians_are_thinned_out(
    colmap: ColmapDataParserConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    trainer = set_up(configure(tmp_path, colmap, max_gaussians=50))
    assert trainer.pipeline.model.num_points == 50
    printed = capsys.readouterr().out
    assert "Keeping a random 50 of 300 initial points" in printed


def test_without_densification_the_number_of_gaussians_stays(colmap: ColmapDataParserConfig, tmp_path: Path):
    config = configure(tmp_path, colmap, iterations=ITERATIONS)
    config.pipeline.model.strategy.refine_stop_iter = 0
    trainer = set_up(config)
    before = trainer.pipeline.model.means.detach().clone()
    trainer.train()
    assert trainer.pipeline.model.means.shape == before.shape
    assert not torch.equal(trainer.pipeline.model.means, before)


@pytest.mark.parametrize("iterations", [5, 12])
def test_the_position_rate_ends_at_a_hundredth_whatever_the_length_of_the_run(
    iterations: int, colmap: ColmapDataParserConfig, tmp_path: Path
):
    config = configure(tmp_path, colmap, iterations)
    rates: list[float] = []
    trainer = set_up(config)
    start = RATES["means"][0] * trainer.pipeline.model.strategy_state["scene_scale"]
    rate = trainer.optimizers.schedulers["means"].get_last_lr
    rates += rate()
    trainer.train()
    rates += rate()
    assert rates == pytest.approx([start, start / 100])


def test_a_training_step_updates_the_gaussians_in_one_launch(
    colmap: ColmapDataParserConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    adam = pytest.importorskip("sadgs_ns.kernels.adam", reason="Triton is not installed")
    launch = adam.adam_step
    launched = []
    config = configure(tmp_path, colmap, 3)
    config.cuda_graphs = False  # A graph would not ask what is replaced below.
    trainer = set_up(config)  # On a GPU this launches the kernel once to compile it.

    def counted(parameters: tuple[torch.Tensor, ...], *args: Any, **kwargs: Any) -> None:
        launched.append(len(parameters))
        launch(parameters, *args, **kwargs)

    monkeypatch.setattr(adam, "adam_step", counted)
    before = {name: parameter.detach().clone() for name, parameter in trainer.pipeline.model.gauss_params.items()}
    monkeypatch.setattr(
        "sadgs_ns.training.step.optimizers.use_triton", lambda place: True
    )  # in its interpreter, without CUDA
    trainer.train()
    assert launched == [6] * 3
    for name, parameter in trainer.pipeline.model.gauss_params.items():
        assert parameter.isfinite().all()
        assert name == "features_rest" or not torch.equal(parameter, before[name])


def test_the_position_rate_grows_with_the_cameras_extent(colmap: ColmapDataParserConfig, tmp_path: Path):
    trainer = set_up(configure(tmp_path, colmap))
    extent = trainer.pipeline.model.strategy_state["scene_scale"]
    assert extent != pytest.approx(1.0)
    actual = trainer.optimizers.schedulers["means"].get_last_lr()
    expected = pytest.approx([RATES["means"][0] * extent])
    assert actual == expected


def test_the_seed_decides_the_order_of_the_views(colmap: ColmapDataParserConfig, tmp_path: Path):
    orders = []
    for seed in (42, 1, 1):
        config = configure(tmp_path, colmap)
        config.machine.seed = seed
        orders.append(set_up(config).pipeline.views.sampler.draw(TRAIN_VIEWS))
    assert orders[0] != orders[1] == orders[2]
    actual = sorted(orders[0])
    assert actual == sorted(orders[1])


# --- checkpoints ---


def test_a_save_that_fails_leaves_the_previous_checkpoint_alone(
    colmap: ColmapDataParserConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    trainer = set_up(configure(tmp_path, colmap))
    trainer.save_checkpoint(1)

    def full_disk(state: Any, path: Path) -> None:
        path.write_bytes(b"half a checkpoint")
        raise OSError("no space left on device")

    monkeypatch.setattr(torch, "save", full_disk)
    with pytest.raises(OSError, match="no space left"):
        trainer.save_checkpoint(2)
    names = [path.name for path in trainer.checkpoint_dir.iterdir()]
    assert names == ["step-000000001.ckpt"]
    assert list(tmp_path.rglob("*.partial")) == []
    assert checkpoint(trainer, 1)["step"] == 1


@pytest.mark.hard_case(
    "a `.partial` of a killed save lies there", "ignored; the next save in that folder replaces and removes it"
)
def test_what_a_killed_save_leaves_does_not_hinder_resuming(colmap: ColmapDataParserConfig, tmp_path: Path):
    config = configure(tmp_path, colmap)
    trainer = set_up(config)
    trainer.save_checkpoint(1)
    code = f"""
import os, signal, torch
from pathlib import Path
from sadgs_ns.training.run import checkpoints
def killed(state, path):
    path.write_bytes(b"half a checkpoint")
    os.kill(os.getpid(), signal.SIGKILL)
torch.save = killed
checkpoints.write(Path({str(trainer.checkpoint_dir)!r}), 2, {{}}, keep_others=False)
"""
    assert forked_python.python(code).returncode == -9
    assert len(list(tmp_path.rglob("*.partial"))) == 1
    config.load_dir = trainer.checkpoint_dir
    resumed = set_up(config)
    assert resumed._start_step == 2
    resumed.save_checkpoint(3)
    assert list(tmp_path.rglob("*.partial")) == []


# --- other data ---


def test_views_of_two_sizes_train_together(tmp_path: Path):
    sizes = [(WIDTH, HEIGHT), (40, 30)]
    config = configure(tmp_path / "out", nerfstudio_data(tmp_path / "data", sizes), iterations=13)
    config.pipeline.views_per_iteration = 2
    numbers_of_sizes: list[int] = []
    trainer = set_up(config)
    pipeline = trainer.pipeline
    next_views = pipeline.next_views

    def count_sizes(step: int) -> Any:
        groups = next_views(step)
        numbers_of_sizes.append(len({group.cameras[2:] for group in groups}))
        assert len(groups) == numbers_of_sizes[-1]
        return groups

    pipeline.next_views = count_sizes  # type: ignore[method-assign]
    trainer.train()
    assert set(numbers_of_sizes) == {1, 2}
    sizes = {tuple(pipeline.structure_cache[index].shape[:2]) for index in range(len(pipeline.views))}
    assert sizes == {(HEIGHT, WIDTH), (30, 40)}
    assert is_finite(pipeline.model)


@pytest.mark.parametrize("poses", ["fixed", "refined"])
def test_the_loss_of_views_is_the_mean_of_their_own(tmp_path: Path, poses: Any):
    """Each with its own camera, whether they are rendered together or, being of two sizes, one by one."""
    config = configure(tmp_path / "out", nerfstudio_data(tmp_path / "data", [(WIDTH, HEIGHT), (40, 30)]), iterations=3)
    config.pipeline.model.poses = poses
    config.pipeline.model.strategy.refine_stop_iter = 0
    pipeline = set_up(config).pipeline
    model = pipeline.model
    if model.poses is not None:
        with torch.no_grad():
            model.poses.table.add_(0.01 * torch.randn(model.poses.table.shape, device=model.device))
            model.poses.hold_frame()

    def loss(*indices: int) -> torch.Tensor:
        pipeline.follow(dataclasses.replace(pipeline.model.plan, views_per_iteration=len(indices)))
        pipeline.views.sampler.requeue(indices)
        update = AdamUpdate({"means": FusedAdam([model.means], lr=0.0)})
        return training_step(
            model, pipeline.next_views(0), 0.0, update, update.factors(), pipeline.log.nonfinite_flag
        ).loss

    alone = [loss(index) for index in range(5)]
    assert len({round(float(value), 4) for value in alone}) == 5
    for indices in [(0, 2), (3, 1), (0, 1), (4, 1, 2)]:
        expected = torch.stack([alone[i] for i in indices]).mean()
        assert_within_share(loss(*indices), expected, 1e-5)


def test_images_in_bytes_become_what_two_operations_made_of_them(tmp_path: Path, colmap: ColmapDataParserConfig):
    model = set_up(configure(tmp_path, colmap)).pipeline.model
    image = torch.arange(256, dtype=torch.uint8).view(-1, 2, 1).expand(-1, -1, 3)
    on_device = image.to(model.device)
    assert torch.equal(model.get_gt_img(image), on_device.float() / 255.0)
    assert torch.equal(model.get_gt_img(image.double()), on_device.double())


def test_masked_pixels_have_no_structure_tensor_and_no_part_in_the_loss(tmp_path: Path):
    config = configure(tmp_path / "out", nerfstudio_data(tmp_path / "data", masks=True), iterations=7)
    config.pipeline.views_per_iteration = 2
    trainer = train(config)
    pipeline = trainer.pipeline
    for index in range(len(pipeline.views)):
        tensor = pipeline.structure_cache[index]
        assert dequantize(tensor[:, : WIDTH // 2]).isnan().all()
        assert dequantize(tensor[:, WIDTH // 2 :]).amax() > 0
    data = pipeline.datamanager.cached_train[0]
    background = torch.zeros(3, device=pipeline.device)

    def loss(rgb: torch.Tensor) -> torch.Tensor:
        return pipeline.model.get_loss_dict({"rgb": rgb, "background": background}, data)["main_loss"]

    rgb = torch.rand((HEIGHT, WIDTH, 3), device=pipeline.device)
    left = rgb.clone()
    right = rgb.clone()
    left[:, : WIDTH // 2] += 0.3
    right[:, WIDTH // 2 :] += 0.3
    assert loss(left) == loss(rgb) != loss(right)
    assert is_finite(pipeline.model)


def test_transparent_images_train_in_front_of_the_background(tmp_path: Path):
    config = configure(tmp_path / "out", blender_data(tmp_path / "data", alpha_color=None), iterations=7)
    config.pipeline.model.background_color = "white"
    config.pipeline.model.random_init = True
    trainer = set_up(config)
    model = trainer.pipeline.model
    data = trainer.pipeline.datamanager.cached_train[0]
    assert data["image"].shape[-1] == 4
    white = torch.ones(3, device=model.device)
    target = model.composite_with_background(data["image"].to(model.device) / 255, white)
    assert (target[:, : WIDTH // 2] == 1).all()
    assert target[:, WIDTH // 2 :].amin() < 1
    model.set_background(torch.zeros(3))  # as the viewer does whenever it draws
    actual = trainer.pipeline.structure_cache.photo(data)
    assert_close(actual, target)
    trainer.train()
    assert is_finite(model)


def test_blender_data_train_with_the_alpha_colour_that_its_parser_gives_them(tmp_path: Path):
    trainer = train(configure(tmp_path / "out", blender_data(tmp_path / "data", alpha_color="white")))
    image = trainer.pipeline.datamanager.cached_train[0]["image"]
    assert image.shape[-1] == 3
    assert (image[:, : WIDTH // 2] == 255).all()
    assert is_finite(trainer.pipeline.model)


def test_data_without_sfm_points_start_from_random_ones_and_say_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    trainer = set_up(configure(tmp_path / "out", nerfstudio_data(tmp_path / "data")))
    assert 0 < trainer.pipeline.model.num_points <= POINTS
    printed = " ".join(capsys.readouterr().out.split())
    assert "The data has no SfM points: starting from 300 random ones in a cube of side 10.0." in printed


def test_random_points_on_request_need_no_warning(
    colmap: ColmapDataParserConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    config = configure(tmp_path, colmap)
    config.pipeline.model.random_init = True
    set_up(config)
    printed = capsys.readouterr().out
    assert "no SfM points" not in printed


# --- rendering ---


@pytest.fixture(scope="module")
def trained(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> SadgsTrainer:
    """A few iterations, ready to render."""
    parser = ColmapDataParserConfig(data=scene, colmap_path=SPARSE_FOLDER, downscale_factor=1, eval_mode="interval")
    trainer = train(configure(tmp_path_factory.mktemp("trained"), parser))
    trainer.pipeline.eval()
    return trainer


@torch.no_grad()
def test_held_out_cameras_render_as_nerfstudio_expects(trained: SadgsTrainer):
    pipeline = trained.pipeline
    assert isinstance(pipeline.model, SplatfactoModel)  # what the viewer and the exporter ask for
    assert len(pipeline.datamanager.eval_dataset) == VIEWS - TRAIN_VIEWS
    for index in range(VIEWS - TRAIN_VIEWS):
        camera = pipeline.datamanager.eval_dataset.cameras[index : index + 1]
        outputs = pipeline.model.get_outputs_for_camera(camera)
        channels = {"rgb": 3, "depth": 1, "accumulation": 1, "background": 3, "normals": 3}
        actual = {name: tuple(value.shape) for name, value in outputs.items()}
        expected = {name: (HEIGHT, WIDTH, count) for name, count in channels.items()}
        assert actual == expected
        assert 0 <= outputs["rgb"].min() < outputs["rgb"].max() <= 1
        assert outputs["depth"].min() > 0


@torch.no_grad()
def test_training_evaluation_and_a_loaded_run_draw_from_the_same_plane(finished: Path, colmap: ColmapDataParserConfig):
    (path,) = (finished / "nerfstudio_models").iterdir()
    stored = torch.load(path, weights_only=True)["pipeline"]["_extra_state"]["plan"]["near_plane"]
    _, pipeline, _, _ = eval_setup(finished / "config.yml")
    model: Any = pipeline.model
    assert isinstance(model, SadgsModel)
    assert model.config.near_plane == "viewers"
    assert model.plan.near_plane == stored == NEAR_PLANE
    datamanager: Any = pipeline.datamanager
    cameras = datamanager.train_dataset.cameras
    model.means.data[:] = model.means.data[:1] + 1e-5 * torch.randn_like(model.means)
    pose = cameras.camera_to_worlds[:1].clone()
    for share, drawn in ((0.9, 0), (1.1, model.num_points)):
        pose[0, :, 3] = model.means.data[0].cpu() + share * stored * pose[0, :, 2]
        viewmat = viewmats_from_camera_to_world(pose).to(model.device)
        Ks = cameras.get_intrinsics_matrices()[:1].to(model.device)
        _, _, info = model.render(Pinholes(viewmat, Ks, WIDTH, HEIGHT), model.color_options())
        actual = int(visible(info).sum())
        assert actual == drawn


def test_a_plane_that_is_given_is_kept_also_where_the_checkpoint_has_another(
    finished: Path, colmap: ColmapDataParserConfig, tmp_path: Path
):
    config = configure(tmp_path, colmap, ITERATIONS)
    config.pipeline.model.near_plane = 0.123
    assert set_up(config).pipeline.model.plan.near_plane == 0.123
    config.load_dir = finished / "nerfstudio_models"
    assert set_up(config).pipeline.model.plan.near_plane == 0.123
    config.pipeline.model.near_plane = 0.0
    with refusal(r"^pipeline\.model\.near_plane must be viewers, scene, or positive and finite, got 0\.$"):
        set_up(config)


@torch.no_grad()
def test_after_the_viewer_has_rendered_the_whole_model_trains_again(trained: SadgsTrainer):
    pipeline = trained.pipeline
    pipeline.train()
    pipeline.model.eval()  # as nerfstudio's viewer does
    assert pipeline.train() is pipeline
    for module in pipeline.modules():
        assert module.training
    for module in pipeline.eval().modules():
        assert not module.training


def test_a_crop_box_hides_what_lies_outside(trained: SadgsTrainer):
    model = trained.pipeline.model
    camera = trained.pipeline.datamanager.eval_dataset.cameras[:1]

    def accumulation(x: float) -> torch.Tensor:
        """Of what lies in a box of side 1,000 around (x, 0, 0)."""
        box = OrientedBox(R=torch.eye(3), T=torch.tensor([x, 0.0, 0.0]), S=torch.full((3,), 1000.0))
        return model.get_outputs_for_camera(camera, obb_box=box)["accumulation"]

    everything = model.get_outputs_for_camera(camera)["accumulation"]
    assert torch.equal(accumulation(0.0), everything)
    middle = float(model.means[:, 0].median())
    assert 0 < accumulation(middle - 500.0).sum() < everything.sum()
    assert torch.equal(accumulation(5000.0), torch.zeros_like(everything))
    assert torch.equal(model.get_outputs_for_camera(camera)["accumulation"], everything)
