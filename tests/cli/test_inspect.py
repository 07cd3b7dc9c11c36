"""`sadgs-inspect` on a small run that training left half way, and the viewer's panel on its pipeline."""

from __future__ import annotations

import copy
import dataclasses
import math
import re
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.configs.method_configs import method_configs
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer_elements import ViewerElement
from PIL import Image
from torch.testing import assert_close

from examples.drawn_scene.scene import write_scene
from helpers.kill_and_resume import configure, set_up
from helpers.refusals import refusal
from helpers.short_runs import in_the_viewer
from sadgs_ns.cli import inspect, inspection
from sadgs_ns.method.growth import structure_aware
from sadgs_ns.method.quantization import INVALID
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.render import blending, rasterization
from sadgs_ns.render.types import Cameras as Pinholes
from sadgs_ns.render.types import Gaussians
from sadgs_ns.training.outputs import warn_once
from sadgs_ns.training.pipeline import SadgsPipeline
from sadgs_ns.training.step.structure_cache import observe_training_views
from sadgs_ns.viewer import color_scales, maps
from sadgs_ns.viewer.structure_panel import CHOICES, OFF, OUTPUT, StructurePanel, changed, describe, nearest_view

WIDTH = 48
HEIGHT = 36
TRAIN_VIEWS = 8
EVAL_VIEWS = 2
ITERATIONS = 60
"""Structure steps come at 10, 20, 30: at the end the run has dropped its statistics."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The config.yml of a run with checkpoints at 8, before any split, and at the end."""
    folder = tmp_path_factory.mktemp("inspect")
    write_scene(folder / "scene", WIDTH, HEIGHT, TRAIN_VIEWS + EVAL_VIEWS, points=200)
    config = configure(folder / "scene", folder / "runs", ITERATIONS, save_every=8)
    config.save_only_latest_checkpoint = False
    config.pipeline.model.bounding_box_points = False
    config.pipeline.model.strategy.split_min_opacity = 0.0
    config.pipeline.model.strategy.min_observations = 1
    config.save_config()
    set_up(config).train()
    return config.get_base_dir() / "config.yml"


@pytest.fixture(scope="module")
def early(run: Path) -> SadgsPipeline:
    """The run after 9 iterations, to be looked at only."""
    pipeline, iterations = inspection.load_run(run, load_step=8)
    assert iterations == 9
    return pipeline


@pytest.fixture
def panel(run: Path) -> StructurePanel:
    """Of a pipeline of its own, which is kept alive."""
    pipeline, _ = inspection.load_run(run)
    panel = pipeline.structure
    panel.keeps = [pipeline]  # type: ignore[assignment]
    return panel


def pipeline_of(panel: StructurePanel) -> SadgsPipeline:
    return panel.keeps[0]  # type: ignore[index,return-value]


# --- the command line ---


def test_all_pictures_of_a_finished_run_are_written(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    status = inspect.main([str(run), "--view", "1", "--output", str(tmp_path / "new")])
    assert status == 0
    names = [f"train-001-{name}.png" for name in ("ellipses", "wavelength", "eta", "children", "low", "step")]
    actual = sorted(path.name for path in (tmp_path / "new").iterdir())
    assert actual == sorted(names)
    printed = capsys.readouterr().out
    assert f"after {ITERATIONS} iterations" in printed
    assert f"{TRAIN_VIEWS} training views" in printed
    for name in names:
        assert str(tmp_path / "new" / name) in printed
        with Image.open(tmp_path / "new" / name) as image:
            colors = image.convert("RGB").getcolors(1 << 24)
        assert colors is not None
        assert len(colors) > 30


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let files of pictures be empty: drawing six takes ten times as long as what is drawn."""

    def write_nothing(path: Path, *_: Any, **__: Any) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()

    monkeypatch.setattr(color_scales, "draw", write_nothing)


@pytest.mark.usefixtures("undrawn")
def test_held_out_views_and_earlier_checkpoints_can_be_asked_for(run: Path, tmp_path: Path):
    written = inspection.inspect_run(run.parent, EVAL_VIEWS - 1, "eval", tmp_path, 8, None)
    for path in written:
        assert path.name.startswith("eval-001-")
        assert path.is_file()
    assert len(written) == 6


def wrong(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    status = inspect.main(arguments)
    assert status == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


@pytest.mark.parametrize(("number", "split", "last"), [(8, "train", 7), (-1, "train", 7), (2, "eval", 1)])
def test_a_view_that_is_not_there_is_named_with_those_that_are(
    number: int, split: str, last: int, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    output = tmp_path / "out"
    line = wrong([str(run), f"--view={number}", "--split", split, "--output", str(output)], capsys)
    assert f"--view {number}: the {split} split has views 0 to {last}" in line
    assert not output.exists()


def test_what_is_no_run_of_sadgs_is_refused(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    missing = tmp_path / "config.yml"
    assert f"{missing} does not exist" in wrong([str(missing)], capsys)
    missing.write_text(yaml.dump(method_configs["splatfacto"]))
    assert f"{missing} is of the method splatfacto" in wrong([str(missing)], capsys)
    missing.write_text("a: [1,")
    assert "cannot be read as a run's config.yml" in wrong([str(missing)], capsys)
    missing.write_text("just: text")
    assert "no run's config.yml" in wrong([str(missing)], capsys)
    missing.write_bytes(run.read_bytes())
    assert "holds no checkpoint yet" in wrong([str(missing)], capsys)
    assert "no checkpoint of step 7: give --load-step one of 8, 16" in wrong([str(run), "--load-step", "7"], capsys)


@pytest.mark.usefixtures("undrawn")
def test_a_run_and_its_capture_may_have_moved(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    config = yaml.load(run.read_text(), Loader=yaml.Loader)
    scene = Path(config.pipeline.datamanager.dataparser.data)
    shutil.copytree(run.parent, tmp_path / "moved")
    config.pipeline.datamanager.data = config.pipeline.datamanager.dataparser.data = Path(
        "scene"
    )  # as trained elsewhere
    (tmp_path / "moved/config.yml").write_text(yaml.dump(config))
    monkeypatch.chdir(tmp_path)
    assert "scene does not exist: give --data" in wrong(["moved"], capsys)
    status = inspect.main(["moved", "--data", str(scene)])
    assert status == 0
    assert len(list(Path("moved/inspect").iterdir())) == 6


def test_checkpoints_that_cannot_be_used_are_named_with_options_that_there_are(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    shutil.copytree(run.parent, tmp_path / "run")
    folder = tmp_path / "run/nerfstudio_models"
    latest = max(folder.iterdir())
    state = torch.load(latest, weights_only=True)
    means = state["pipeline"].pop("_model.gauss_params.means")
    torch.save(state, latest)
    remedy = "give another with --load-step, or another run of sadgs."
    line = wrong([str(tmp_path / "run")], capsys)
    assert f"{latest} does not fit its run: The checkpoint has no means" in line
    assert line.endswith(remedy)
    state["pipeline"] |= {"_model.gauss_params.means": means}
    extra = state["pipeline"].pop("_extra_state")
    state["pipeline"]["_extra_state"] = {}
    torch.save(state, latest)
    line = wrong([str(tmp_path / "run")], capsys)
    assert f"{latest} is not of this version of sadgs (" in line
    assert line.endswith(remedy)
    state["pipeline"]["_extra_state"] = extra
    state["pipeline"] |= {"_model.poses.table": torch.zeros(1, 6)}
    torch.save(state, latest)
    config = yaml.load(run.read_text(), Loader=yaml.Loader)
    config.pipeline.model.poses = "refined"
    (tmp_path / "run/config.yml").write_text(yaml.dump(config))
    line = wrong([str(tmp_path / "run")], capsys)
    assert f"{latest} does not fit its run: The checkpoint's _model.poses.table" in line
    assert line.endswith(remedy)
    (folder / "step-000000008.ckpt").write_bytes(b"half")
    line = wrong([str(tmp_path / "run"), "--load-step", "8"], capsys)
    assert "step-000000008.ckpt is cut off, damaged" in line
    assert line.endswith(remedy)


def test_a_gpu_that_is_full_is_one_sentence(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def full(**_: Any) -> None:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 22.00 MiB.")

    monkeypatch.setattr(inspection, "inspect_run", full)
    assert f"memory does not hold {run}: end other programs on it" in wrong([str(run)], capsys)


# --- what is drawn ---


def test_observing_all_views_finds_what_training_finds(run: Path):
    """Training's own code, shown every view once and nothing learned in between."""
    pipeline, _ = inspection.load_run(run, load_step=8)
    observed = observe_training_views(pipeline.structure_cache)
    model = pipeline.model
    model.train()
    model.optimizers = {}
    model.strategy_state = model.strategy.initialize_state()
    model.step = 0
    for index in range(TRAIN_VIEWS):
        tensors = pipeline.structure_cache[index][None]
        Ks = pipeline.views.cameras[1][index][None]
        viewmats = pipeline.views.viewmat(index)[None]
        cameras = Pinholes(viewmats, Ks, WIDTH, HEIGHT)
        _, _, info = model.render(cameras, model.step_options(cameras, [index]))
        info |= {"viewmats": viewmats, "Ks": Ks, "structure_tensors": tensors}
        model.strategy.step_pre_backward(model.gauss_params, {}, model.strategy_state, model.step, info)
    trained = model.strategy_state
    # The places of the samples are drawn anew, so some fall inside the image here and outside there.
    assert float((trained["n_total"] - observed["n_total"]).abs().mean()) < 0.5 < float(observed["n_total"].mean())
    both = (trained["n_total"] > 3) & (observed["n_total"] > 3)
    assert int(both.sum()) > 50
    logs = torch.stack([s["eta_max"][both].amax(dim=1).clamp_min(1e-3).log() for s in (trained, observed)])
    assert float(torch.corrcoef(logs)[0, 1]) > 0.9


def test_observing_leaves_the_run_as_it_was(early: SadgsPipeline):
    before = early.state_dict()["_model.gauss_params.means"].clone()
    random = torch.get_rng_state()
    first = observe_training_views(early.structure_cache)
    actual = observe_training_views(early.structure_cache)
    assert_close(actual, first)
    inspection.screen_gradients(early, iter)
    assert torch.equal(torch.get_rng_state(), random)
    assert torch.equal(early.model.means, before)
    for parameter in early.model.parameters():
        assert parameter.grad is None


def test_the_structure_step_makes_the_children_of_the_plan(early: SadgsPipeline):
    model = early.model
    statistics = observe_training_views(early.structure_cache)
    children = model.strategy.planned_children(model.gauss_params, statistics).prod(dim=1)
    step = inspection.structure_step(model, statistics)
    assert int(children.max()) > 1
    assert torch.equal(torch.bincount(step["origins"], minlength=model.num_points), children)
    whole = step["origins"][torch.bincount(step["origins"])[step["origins"]] == 1]
    actual = step["means"][: len(whole)]
    expected = model.means.detach()[whole]
    assert_close(actual, expected)


def test_the_conventional_step_clones_or_splits_in_two(early: SadgsPipeline):
    model = early.model
    gradients = inspection.screen_gradients(early, iter)
    assert float(gradients["grad_count"].max()) == TRAIN_VIEWS
    assert float(gradients["absgrad2d"].max()) > float(gradients["grad2d"].max()) > 0
    step = inspection.conventional_step(model, gradients)
    sizes = torch.bincount(step["origins"], minlength=model.num_points)
    actual = set(sizes.unique().tolist())
    assert actual == {1, 2}
    assert len(step["means"]) == len(step["origins"]) > model.num_points
    assert torch.equal(inspection.conventional_step(model, gradients)["means"], step["means"])


def test_the_photo_and_its_camera_belong_together(early: SadgsPipeline):
    """Where a view's camera puts the SfM points, its photo has their colours, more than any other photo."""
    assert early.model.seed_points is not None
    points, colors = (values.to(early.device).float() for values in early.model.seed_points)
    colors = colors / 255
    views = [inspection.get_view(early, index) for index in range(TRAIN_VIEWS)]
    for number, view in enumerate(views):
        viewmat = view.camera.viewmats[0]
        pixels = (points @ viewmat[:3, :3].T + viewmat[:3, 3]) @ view.camera.Ks[0].T
        x, y = (pixels[:, :2] / pixels[:, 2:]).floor().long().unbind(-1)
        inside = (pixels[:, 2] > 0) & (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
        errors = [(other.photo[y[inside], x[inside]] - colors[inside]).abs().mean() for other in views]
        actual = int(torch.stack(errors).argmin())
        assert actual == number
        assert int(inside.sum()) > 30


# --- the panel ---


def a_camera(pipeline: SadgsPipeline, index: int = 0) -> Cameras:
    return pipeline.datamanager.train_dataset.cameras[index : index + 1]


@pytest.mark.filterwarnings("ignore:This property will be removed:DeprecationWarning")  # of torchmetrics, not ours
def test_the_viewer_finds_the_elements_in_their_order(panel: StructurePanel):
    found = [path for path, _ in parse_object(pipeline_of(panel), ViewerElement, "Custom Elements")]
    actual = [path.removeprefix("Custom Elements/structure/") for path in found if "/structure/" in path]
    assert actual == [
        "choice", "legend", "observe", "set_max_gaussians", "set_tau_split", "table",
    ]  # fmt: skip


def test_the_panel_is_no_part_of_a_checkpoint(panel: StructurePanel):
    assert not [name for name in pipeline_of(panel).state_dict() if "structure" in name.lower()]


@torch.no_grad()
def test_every_choice_is_a_picture_for_the_viewer_and_nothing_for_evaluation(panel: StructurePanel):
    pipeline = pipeline_of(panel)
    camera = a_camera(pipeline)
    camera.rescale_output_resolution(4)
    panel.legend.gui_handle = told = SimpleNamespace(content="")
    shown = {}
    legends = {}
    for choice in CHOICES:
        panel.choice.value = choice
        panel.choose()
        assert OUTPUT not in pipeline.model.get_outputs_for_camera(camera)
        outputs = in_the_viewer(lambda: pipeline.model.get_outputs_for_camera(camera))
        shown[choice] = outputs[OUTPUT]
        legends[choice] = told.content
        assert outputs[OUTPUT].shape == outputs["rgb"].shape == (4 * HEIGHT, 4 * WIDTH, 3)
        assert 0 <= float(outputs[OUTPUT].min()) < float(outputs[OUTPUT].max()) <= 1
    assert torch.equal(shown[OFF], outputs["rgb"])
    assert not legends[OFF]
    assert all("](data:image/png;base64," in legends[choice] for choice in CHOICES if choice != OFF)
    assert "Gaussians observed)" in legends["η"]
    assert re.search(r"view, `\d+\.png`", legends["ellipses of the nearest photo"])
    panel.choice.value = OFF
    panel.choose()
    assert told.content == "", "nothing is said of a picture that is not shown"
    pairs = [(a, b) for i, a in enumerate(CHOICES) for b in CHOICES[:i]]
    same = [pair for pair in pairs if torch.equal(shown[pair[0]], shown[pair[1]])]
    assert not [pair for pair in same if legends[pair[0]] == legends[pair[1]]]


@pytest.mark.parametrize("choice", ["wavelength of the nearest photo", "ellipses of the nearest photo", "η"])
def test_drawing_which_the_viewer_may_break_off_loads_no_photo(choice: str, panel: StructurePanel):
    pipeline = pipeline_of(panel)
    panel.choice.value = choice  # as the viewer sets it, before it calls the panel
    outputs = in_the_viewer(lambda: pipeline.model.get_outputs_for_camera(a_camera(pipeline)))
    assert torch.equal(outputs[OUTPUT], outputs["rgb"])
    assert "cached_train" not in vars(pipeline.datamanager)
    panel.choose()
    assert "cached_train" in vars(pipeline.datamanager)
    assert pipeline.structure_cache.filled
    outputs = in_the_viewer(lambda: pipeline.model.get_outputs_for_camera(a_camera(pipeline)))
    assert not torch.equal(outputs[OUTPUT], outputs["rgb"])


@torch.no_grad()
def test_the_pictures_survive_tiny_windows_and_crop_boxes(panel: StructurePanel, monkeypatch: pytest.MonkeyPatch):
    rendered: list[int] = []

    def rasterize(gaussians: Gaussians, *args: Any) -> Any:
        rendered.append(len(gaussians.means))
        return rasterization.rasterize(gaussians, *args)

    monkeypatch.setattr(blending, "rasterize", rasterize)
    pipeline = pipeline_of(panel)
    camera = a_camera(pipeline)
    camera.rescale_output_resolution(0.2)
    nowhere = OrientedBox(R=torch.eye(3), T=torch.full((3,), 100.0), S=torch.ones(3))
    middle = OrientedBox(R=torch.eye(3), T=pipeline.model.means.median(dim=0).values, S=torch.full((3,), 0.5))
    for choice in CHOICES:
        panel.choice.value = choice
        panel.choose()
        for box in (None, nowhere, middle):
            outputs = in_the_viewer(lambda box=box: pipeline.model.get_outputs_for_camera(camera, obb_box=box))
            assert outputs[OUTPUT].shape == outputs["rgb"].shape
    assert rendered, "the kernels cannot render nothing"
    assert 0 not in rendered, "the kernels cannot render nothing"


@torch.no_grad()
@pytest.mark.parametrize("choice", CHOICES)
def test_the_viewer_is_told_of_a_camera_that_is_no_pinhole_and_goes_on(choice: str, panel: StructurePanel, capsys: Any):
    pipeline = pipeline_of(panel)
    panel.choice.value = choice
    panel.choose()
    camera = copy.deepcopy(a_camera(pipeline))
    camera.camera_type = torch.full_like(camera.camera_type, CameraType.EQUIRECTANGULAR.value)
    warn_once.cache_clear()
    for _ in range(2):
        outputs = in_the_viewer(lambda: pipeline.model.get_outputs_for_camera(camera))
        assert outputs[OUTPUT].shape == outputs["rgb"].shape == (HEIGHT, WIDTH, 3)
    printed = capsys.readouterr().out
    assert printed.count("EQUIRECTANGULAR") == 1
    with refusal("EQUIRECTANGULAR"):  # ns-render
        pipeline.model.get_outputs_for_camera(camera)


def test_a_finished_run_is_observed_when_eta_is_asked_for(panel: StructurePanel):
    assert panel.statistics() is None, "the final checkpoint has none"
    panel.choice.value = "wavelength of the nearest photo"
    panel.choose()
    assert panel.statistics() is None
    panel.choice.value = "η"
    panel.choose()
    statistics = panel.statistics()
    assert statistics is not None
    assert len(statistics["n_total"]) == pipeline_of(panel).model.num_points
    with torch.no_grad():  # as a densification does
        for parameter in pipeline_of(panel).model.gauss_params.values():
            parameter.data = parameter.data[:-1]
    assert panel.statistics() is None, "they are of other Gaussians"


def test_where_every_pixel_is_masked_the_panel_says_that_none_was_observed(panel: StructurePanel):
    pipeline = pipeline_of(panel)
    for index in range(len(pipeline.views)):
        pipeline.structure_cache[index][..., 1] = INVALID
    panel.choice.value = "η"
    panel.choose()
    statistics = panel.statistics()
    assert statistics is not None
    assert not (statistics["n_total"] > 0).any()
    picture = panel.picture("η", a_camera(pipeline), torch.zeros(HEIGHT, WIDTH, 3)).picture
    assert (picture == 0).all(), "black"


def test_sliders_reach_the_strategy_and_the_plan(panel: StructurePanel):
    pipeline = pipeline_of(panel)
    asked = pipeline.model.plan.strategy
    statistics = observe_training_views(pipeline.structure_cache)
    before = dataclasses.asdict(asked)
    split = []
    for tau in (1.0, 0.5, 0.0):
        panel.set_tau_split.value = tau
        panel.set_tau_split.cb_hook(panel.set_tau_split)
        strategy = pipeline.model.plan.strategy
        assert strategy.tau_split == tau
        assert pipeline.model.strategy == strategy.for_run(pipeline.model.plan.iterations)
        counts = structure_aware(strategy, pipeline.model.gauss_params, statistics).children
        split.append(int((counts > 1).any(dim=1).sum()))
    assert split[0] == 0 < split[1] < split[2]
    panel.set_max_gaussians.value = 777
    panel.set_max_gaussians.cb_hook(panel.set_max_gaussians)
    strategy = pipeline.model.plan.strategy
    assert strategy.max_gaussians == 777
    assert type(strategy.max_gaussians) is int
    assert "cap 777" in panel.table.text()
    assert pipeline.config.model.strategy.max_gaussians != 777, "what was configured stays"
    assert dataclasses.asdict(asked) == before, "a plan is replaced, not changed"


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("tau_split", [math.nan, -0.1, 1.1, math.inf, "0.5"]),
        ("max_gaussians", [0, -5, math.nan, math.inf, 10**12]),
    ],
)
def test_values_out_of_range_are_refused_and_put_back(name: str, values: list[Any], panel: StructurePanel):
    plan = pipeline_of(panel).model.plan
    element = getattr(panel, f"set_{name}")
    before = getattr(plan.strategy, name)
    for value in values:
        with pytest.raises(ValueError, match=name):
            changed(plan, name, value)
        element.value = value
        element.cb_hook(element)
        assert pipeline_of(panel).model.plan == plan
        assert before == element.value


def test_counts_of_the_structure_steps_are_kept_in_checkpoints_and_told(run: Path, panel: StructurePanel):
    steps: list[dict[str, int]] = pipeline_of(panel).model.strategy_state["structure_steps"]  # type: ignore[assignment]
    actual = [step["iteration"] for step in steps]
    assert actual == [10, 20, 30]
    for step in steps:
        assert step["split"] <= step["violating"] <= step["before"]
        assert step["low"] <= step["before"]
        assert step["after"] >= step["before"] - step["pruned"] + step["split"]
    assert sum(step["split"] for step in steps) > 0
    for step in steps:
        assert f"| {step['iteration']} | structure | {step['violating']:,} | {step['low']:,} |" in panel.table.text()
    assert "No structure step yet" in describe(StructureAwareStrategy(), 5, {})


def test_the_table_is_refreshed_while_training_only_where_somebody_looks(panel: StructurePanel):
    class Handle:
        content = ""

    model = pipeline_of(panel).model
    model.follow(changed(model.plan, "max_gaussians", 4321))
    panel.refresh()
    assert panel.table.gui_handle is None
    panel.table.gui_handle = Handle()
    panel.refresh()
    assert "cap 4,321" in panel.table.gui_handle.content
    model.follow(changed(model.plan, "max_gaussians", 1234))
    panel.refresh()
    assert "cap 4,321" in panel.table.gui_handle.content, "once a second is enough"


def test_the_nearest_view_is_near_and_looks_the_same_way():
    here = torch.eye(4)[:3]
    behind = here * torch.tensor([-1.0, 1, -1, 1])  # looks the other way
    far = here.clone()
    far[:, 3] = 5.0
    near = here.clone()
    near[0, 3] = 0.3
    actual = nearest_view(torch.stack([behind, far, near]), here, extent=1.0)
    assert actual == 2
    actual = nearest_view(torch.stack([behind, far]), here, extent=100.0)
    assert actual == 1


def test_what_the_panel_draws_of_a_training_view_is_what_the_command_draws(panel: StructurePanel):
    pipeline = pipeline_of(panel)
    panel.observe_now()
    statistics = panel.statistics()
    assert statistics is not None
    view = inspection.get_view(pipeline, 2)
    with torch.no_grad():
        rgb = pipeline.model.get_outputs_for_camera(a_camera(pipeline, 2))["rgb"]
    drawn = panel.picture("η", a_camera(pipeline, 2), rgb).picture
    expected = inspection.view_panels(pipeline, view, statistics)["eta"].picture
    assert (np.abs(drawn.astype(int) - expected) <= 2).mean() > 0.99
    near = panel.picture("wavelength of the nearest photo", a_camera(pipeline, 2), rgb).picture
    assert np.array_equal(near, color_scales.PERIOD(maps.texture_period(view.structure_tensor)))
