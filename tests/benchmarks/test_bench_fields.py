"""What a benchmark's row holds: times, curve, metrics. Tiny runs on whatever device there is."""

from __future__ import annotations

import dataclasses
import importlib
import random
import subprocess
import sys
import time
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor
from torch.testing import assert_close

from benchmarks import __main__ as bench
from benchmarks import curve, evaluate, protocol, run
from benchmarks.curve import undisturbed
from benchmarks.protocol import Job, Row, Scene
from examples.drawn_scene.scene import SPARSE_FOLDER, write_scene
from helpers.forked_python import HANGS
from helpers.gsplat_like import splatted
from helpers.json_files import read_json
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world
from sadgs_ns.render.types import RenderOptions

WIDTH = 48
HEIGHT = 36
VIEWS = 10
ITERATIONS = 12
SCENE = Scene(
    "demo",
    "demo",
    "colmap",
    {"colmap_path": str(SPARSE_FOLDER), "downscale_factor": 1, "eval_mode": "interval", "eval_interval": 4},
)
SADGS = Row(
    "ours [c=1]",
    "sadgs",
    {
        "max_num_iterations": ITERATIONS,
        "pipeline.model.background_color": "white",
        "pipeline.model.bounding_box_points": False,
        "pipeline.model.strategy.refine_start_iter": 1,
        "pipeline.model.strategy.absgs_every": 2,
        "pipeline.model.strategy.structure_every": 3,
        "pipeline.model.strategy.eta_every": 2,
    },
)
SPLATFACTO = Row(
    "splatfacto",
    "splatfacto",
    {
        "max_num_iterations": ITERATIONS,
        "pipeline.model.num_downscales": 0,
        "pipeline.model.warmup_length": 2,
        "pipeline.model.refine_every": 2,
        "pipeline.model.densify_grad_thresh": 1e-6,
    },
)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder that holds the scene."""
    folder = tmp_path_factory.mktemp("scenes")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of nerfstudio's and its requirements' modules
        importlib.import_module("nerfstudio.scripts.train")
    write_scene(folder / "demo", WIDTH, HEIGHT, VIEWS, points=200)
    return folder


class RestlessNetwork(torch.nn.Module):
    """In LPIPS's place: the mean difference; draws from every source of chance and takes an hour."""

    hours = 0

    def forward(self, image: Tensor, truth: Tensor) -> Tensor:
        RestlessNetwork.hours += 1
        assert not torch.backends.cudnn.benchmark, "its search takes all memory, and nerfstudio turns it on"
        _ = random.random(), np.random.rand(), torch.rand(1)
        return (image - truth).abs().mean()


def replace_lpips(patch: pytest.MonkeyPatch) -> None:
    """LPIPS without weights, and a clock that an evaluation with it puts forward."""
    patch.setattr(evaluate, "load_lpips", RestlessNetwork)

    def now() -> float:
        return time.perf_counter() + 3600 * RestlessNetwork.hours

    patch.setattr(evaluate, "now", now)
    patch.setattr(curve, "now", now)


def replace_gsplat(patch: pytest.MonkeyPatch) -> None:
    """nerfstudio's own model without LPIPS and torch.compile and, where there is no GPU, with the splatter for gsplat.

    torch.compile takes a minute, and on a GPU warns that TensorFloat32 is off.
    """
    from nerfstudio.models import splatfacto
    from torchmetrics.image import lpip

    patch.setattr(lpip, "LearnedPerceptualImagePatchSimilarity", lambda normalize: torch.nn.Identity())
    patch.setattr(splatfacto, "get_viewmat", viewmats_from_camera_to_world)  # which is compiled
    if torch.cuda.is_available():
        return

    def rasterization(sparse_grad: bool, far_plane: float, **options: Any) -> Any:
        colors, alphas, info = splatted(**options)
        return colors, alphas, info | {"gaussian_ids": None}  # of packed calls, which gsplat's strategy asks for

    patch.setattr(splatfacto, "rasterization", rasterization)
    patch.setattr(torch.Tensor, "cuda", lambda tensor: tensor)


def checkpoint(work: Path) -> dict[str, Any]:
    (path,) = work.rglob("*.ckpt")
    return torch.load(path, weights_only=False)


Runs = dict[str, tuple[dict[str, Any], dict[str, Any]]]
"""Record and checkpoint of a run `with` and `without` the curve."""


@pytest.fixture(scope="module", params=[SADGS, SPLATFACTO], ids=["sadgs", "splatfacto"])
def runs(request: pytest.FixtureRequest, root: Path, tmp_path_factory: pytest.TempPathFactory) -> Runs:
    made = {}
    with pytest.MonkeyPatch.context() as patch:
        replace_lpips(patch)
        replace_gsplat(patch)
        for name, every in (("with", 5), ("without", None)):
            work = tmp_path_factory.mktemp(name)
            record = run.run_row(Job(SCENE, dataclasses.replace(request.param, curve_every=every), 0), root, work)
            made[name] = record, checkpoint(work)
            assert torch.backends.cudnn.benchmark  # as in a user's run
    return made


# Curve


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU adds up gradients in no fixed order")
def test_the_curve_changes_nothing_in_the_training(runs: Runs):
    _, measured = runs["with"]
    _, plain = runs["without"]
    assert len(plain["pipeline"]["_model.gauss_params.means"]) != 200, "densification took part"
    for name in ("images", "plan"):  # These are not numbers alone.
        here = measured["pipeline"].get("_extra_state", {}).pop(name, None)
        there = plain["pipeline"].get("_extra_state", {}).pop(name, None)
        assert here == there
    assert_close(measured, plain, rtol=0, atol=0)


def test_the_curve_ends_in_the_finished_run(runs: Runs):
    record, _ = runs["with"]
    points = record["curve"]
    actual = [set(point) for point in points]
    expected = [{"step", "seconds", "psnr", "ssim", "lpips", "gaussians"}] * 3
    assert actual == expected
    steps = [point["step"] for point in points]
    assert steps == [5, 10, ITERATIONS]
    actual = {name: record[name] for name in ("psnr", "ssim", "lpips", "gaussians")}
    expected = {name: points[-1][name] for name in ("psnr", "ssim", "lpips", "gaussians")}
    assert actual == expected
    assert points[0]["psnr"] != points[-1]["psnr"]
    assert "curve" not in runs["without"][0]


def test_no_time_contains_the_evaluation(runs: Runs):
    """Each of the curve's evaluations takes hours of the clock."""
    record, _ = runs["with"]
    times = [point["seconds"] for point in record["curve"]]
    assert 0 < times[0] < times[1] < times[2] == record["loop_seconds"] < 600


def test_the_timer_stops(monkeypatch: pytest.MonkeyPatch):
    clock = iter([1.0, 4.0, 16.0, 20.0])
    monkeypatch.setattr(curve, "now", lambda: next(clock))
    trainer = SimpleNamespace(config=SimpleNamespace(max_num_iterations=7), callbacks=[])
    watch = curve.LoopTimer()
    watch.attach(trainer)
    begin, end = trainer.callbacks
    begin.run_callback(0)
    with watch.stopped():
        assert watch.seconds == 3.0
    assert not watch.finished
    end.run_callback(5)
    end.run_callback(6)
    assert watch.seconds == 7.0
    assert watch.finished is True


def test_undisturbed_restores_what_a_rendering_notes():
    class Model(torch.nn.Linear):
        info: Any

    model = Model(1, 1)
    pipeline = torch.nn.Sequential(model, torch.nn.Dropout())
    pipeline.model = model
    model.info = noted = {"step": 3}
    with undisturbed(pipeline):
        assert not model.training
        assert not pipeline[1].training
        model.info = {}  # type: ignore[assignment]
        model.size = (3, 4)  # type: ignore[assignment]
    assert model.training
    assert pipeline[1].training
    assert model.info is noted
    assert not hasattr(model, "size")


# The record


INITIALIZATION_SECONDS = 0.5


@pytest.fixture(scope="module")
def written(root: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What `benchmarks.run` writes for the command that python -m benchmarks starts."""
    from sadgs_ns.training.model import SadgsModel

    folder = tmp_path_factory.mktemp("run")
    commands: list[list[str]] = []
    populate_modules = SadgsModel.populate_modules

    def populate_slowly(model: SadgsModel) -> None:
        time.sleep(INITIALIZATION_SECONDS)
        populate_modules(model)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(subprocess, "Popen", lambda command, **_: commands.append(command))
        bench.launcher(root)(Job(SCENE, SADGS, 3), None, folder)
    with pytest.MonkeyPatch.context() as patch:
        replace_lpips(patch)
        patch.setattr(SadgsModel, "populate_modules", populate_slowly)
        patch.setattr(sys, "argv", commands[0][2:])
        run.main()
        assert SadgsModel.populate_modules is populate_slowly, "the run has put it back"
    return read_json(folder / "result.json")


def test_a_record_holds_all_fields(written: dict[str, Any]):
    record = written
    assert record["status"] == "ok", record["error"]
    assert record["lpips"] is not None
    assert "curve" not in record
    assert len(record["view_psnr"]) == record["eval_views"]
    actual = sum(record["view_psnr"]) / record["eval_views"]
    expected = pytest.approx(record["psnr"], abs=0.005)
    assert actual == expected


def test_each_held_out_view_is_told_in_the_order_of_its_psnr(runs: Runs, root: Path, tmp_path: Path):
    record, _ = runs["with"]
    assert record["view_names"] == ["000", "004", "008"]
    assert len(record["ply_view_psnr"]) == 3
    assert max(map(abs, record["view_angles"])) < 90
    device = "cuda" if torch.cuda.is_available() else "cpu"
    for row in (SPLATFACTO, SADGS):  # The order is that of the loader whose views are evaluated.
        datamanager: Any = run.build_config(SCENE, row, 0, root, tmp_path).pipeline.datamanager.setup(test_mode="test")
        for name, (_, batch) in zip(record["view_names"], datamanager.fixed_indices_eval_dataloader, strict=True):
            photograph = np.asarray(Image.open(root / "demo/images" / f"{name}.png").convert("RGB"))
            image = batch["image"].cpu().numpy()
            assert np.array_equal(image if image.dtype == np.uint8 else np.rint(image * 255), photograph)
        # Without SfM points the Gaussians' centres stand for them.
        points = datamanager.train_dataset.metadata.pop("points3D_xyz")
        measured = run.angles_of_views(datamanager, SimpleNamespace(means=points, device=device))
        assert measured == {name: record[name] for name in ("view_names", "view_angles")}
        measured = run.angles_of_views(datamanager, SimpleNamespace(means=points * torch.nan, device=device))
        assert measured["view_angles"] == [None] * 3


def test_the_parts_before_the_loop_are_timed(written: dict[str, Any]):
    names = ("import", "setup", "initialization", "load", "warmup", "structure_tensor", "loop")
    parts = {name: written[f"{name}_seconds"] for name in names}
    assert parts["initialization"] >= INITIALIZATION_SECONDS
    for part in parts.values():
        assert part > 0


@pytest.mark.slow
def test_two_processes_train_one_splat_whose_row_the_first_writes(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """They start as on two GPUs, `--gpus 0+1`, and find none. LPIPS is left out, since its weights are missing."""
    monkeypatch.setenv("TORCH_HOME", "/dev/null")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    overrides = {
        **SADGS.overrides,
        "machine.device_type": "cpu",
        "pipeline.model.background_color": "black",
        "pipeline.views_per_iteration": 2,
        "share_always": True,
    }
    with bench.launcher(root)(Job(SCENE, Row("ours", "sadgs", overrides), 0), "0+1", tmp_path) as process:
        assert process.wait(HANGS) == 0, (tmp_path / "log").read_text()
    record = read_json(tmp_path / "result.json")
    assert record["status"] == "ok"
    assert record["devices"] == 2
    assert record["iterations"] == ITERATIONS
    assert record["psnr"] > 10
    assert record["gaussians"] > 100
    assert record["loop_seconds"] > 0


class FlatModel:
    """Renders grey on black."""

    @staticmethod
    def get_outputs_for_camera(camera: Any) -> dict[str, Tensor]:
        return {"rgb": torch.full((4, 5, 3), 0.5), "background": torch.zeros(3)}

    @staticmethod
    def get_gt_img(image: Tensor) -> Tensor:
        return image.float() / 255

    @staticmethod
    def composite_with_background(image: Tensor, background: Tensor) -> Tensor:
        return image[..., :3]


@pytest.mark.parametrize(
    ("near_plane", "max_off_axis", "drawn_as"),
    [(0.01, 0.0, []), (0.3, 0.0, [(0.01, 0.0)]), (0.01, 4.0, [(0.01, 0.0)])],
)
def test_views_are_measured_as_other_viewers_draw_them_and_the_plan_is_put_back(
    near_plane: float, max_off_axis: float, drawn_as: list[tuple[float, float]]
):
    model: Any = FlatModel()
    model.config = SimpleNamespace()
    model.device = "cpu"
    drawn = []
    plan = model.plan = RenderOptions(near_plane=near_plane, max_off_axis=max_off_axis)  # as much as is read of a plan

    def draw(camera: Any) -> dict[str, Tensor]:
        drawn.append((model.plan.near_plane, model.plan.max_off_axis))
        return {"rgb": torch.full((12, 12, 3), camera), "background": torch.zeros(3)}

    model.get_outputs_for_camera = draw
    view = (0.5, {"image": torch.zeros(12, 12, 3)})
    actual = evaluate.view_psnr_in_viewers(model, [view], [1.0])
    assert actual == ([6.02] if drawn_as else [1.0])
    if drawn_as:
        with pytest.raises(TypeError):  # of a camera that cannot be drawn
            evaluate.view_psnr_in_viewers(model, [(None, {})], [])
    assert drawn == 2 * drawn_as
    assert model.plan is plan


# Protocol and command


def content(**changes: Any) -> dict[str, Any]:
    scene = {"data": "demo", "dataparser": "colmap", "options": SCENE.options}
    return {"scenes": {"demo": scene}, "rows": [{"label": "a", "method": "sadgs"}], **changes}


def test_curve_every_is_part_of_the_key_only_where_it_is_given():
    plain, _ = protocol.parse(content()).jobs()
    measured, _ = protocol.parse(content(curve_every=500)).jobs()
    finer, _ = protocol.parse(content(curve_every=250)).jobs()
    assert plain.row.curve_every is None
    assert measured.row.curve_every == 500
    rows = [{"label": label, "method": "sadgs", "curve_every": every} for label, every in (("a", 100), ("b", None))]
    one, _, none, _ = protocol.parse(content(curve_every=500, rows=rows)).jobs()
    assert one.row.curve_every == 100, "a row's own comes first"
    assert none.row.curve_every is None, "a row's own comes first"
    assert len({plain.key, measured.key, finer.key}) == 3
    # The key of a row that docs/results holds: files of before continue.
    bonsai = Scene(
        "bonsai",
        "bonsai",
        "colmap",
        {"colmap_path": "sparse/0", "downscale_factor": 1, "eval_mode": "interval", "eval_interval": 8},
    )
    job = Job(bonsai, Row("full", "sadgs-paper-indoor"), 0)
    assert job.key in (Path(__file__).parents[2] / "docs/results/claims.jsonl").read_text()


@pytest.mark.parametrize("wrong", [0, -5, 1.5, "500", True])
def test_curve_every_is_a_positive_whole_number(wrong: object):
    with pytest.raises(ValueError, match="curve_every must be a whole number of iterations from 1, not"):
        protocol.parse(content(curve_every=wrong))
