"""A run that an earlier version trained can be resumed, measured, shown, exported and inspected.

Its files are in `tests/old_runs`, in a folder named after the commit that trained it, where a README.md says how. All
paths in its `config.yml` are relative to the working directory. So the tests copy run and scene to where they belong,
and change nothing in the files.
"""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import tyro
import yaml
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.scripts.train import main as ns_train
from nerfstudio.scripts.viewer import run_viewer
from nerfstudio.scripts.viewer.run_viewer import RunViewer, ViewerConfigWithoutNumRays
from nerfstudio.viewer.viewer import Viewer
from plyfile import PlyData

from helpers.kill_and_resume import set_up
from helpers.short_runs import in_the_viewer
from sadgs_ns.cli import export, inspect
from sadgs_ns.errors import InputError
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.training.config import SadgsTrainerConfig, SadgsViewerConfig
from sadgs_ns.training.model import SadgsModel
from sadgs_ns.training.pipeline import SadgsPipeline
from sadgs_ns.training.run.run_plan import Rate, RunPlan, unknown_fields
from sadgs_ns.viewer import color_scales
from sadgs_ns.viewer.structure_panel import OUTPUT

OLD_RUN = Path(__file__).parents[2] / "old_runs" / "d6de779"
RUN = Path("outputs/drawn/sadgs/first")
"""The run's folder, as its `config.yml` says."""
CHECKPOINTS = RUN / "nerfstudio_models"
ITERATIONS, DONE, GAUSSIANS = 40, 20, 344
"""Length of the run, iterations that are done, and Gaussians that it has then."""
MEASURED = json.loads((OLD_RUN / "measured.json").read_text("utf8"))
"""What the old version measured of its run, when it was interrupted and when it was finished."""


def copy_run(scene: Path, folder: Path) -> None:
    """Copy run and scene into a folder from which all paths in the run's `config.yml` are right."""
    shutil.copytree(scene, folder / "scene")
    shutil.copytree(OLD_RUN / "run", folder / RUN)


@pytest.fixture(scope="module")
def loadable(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The old run's `config.yml`, to be read only, relative to the working directory that this sets."""
    folder = tmp_path_factory.mktemp("old_run")
    copy_run(scene, folder)
    with pytest.MonkeyPatch.context() as patched:
        patched.chdir(folder)
        yield RUN / "config.yml"


@pytest.fixture
def resumable(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The `config.yml` of a copy that a test may resume, relative to a working directory of the test's own."""
    copy_run(scene, tmp_path)
    monkeypatch.chdir(tmp_path)
    return RUN / "config.yml"


@pytest.fixture(autouse=True)
def no_lpips(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SadgsModel, "lpips", lambda *_: float("nan"))  # Its weights would be downloaded.


def read_checkpoint(step: int) -> dict[str, Any]:
    return torch.load(CHECKPOINTS / f"step-{step:09d}.ckpt", weights_only=True)


def strategy_state(checkpoint: dict[str, Any]) -> dict[str, Any]:
    return checkpoint["pipeline"]["_model._extra_state"]["strategy_state"]


def measure(config: Path, results: Path) -> dict[str, float]:
    """Measure a run's held-out views as `ns-eval` does."""
    ComputePSNR(config, results).main()
    return json.loads(results.read_text())["results"]


def test_the_checkpoint_holds_what_a_run_in_the_midst_of_densification_needs(loadable: Path):
    checkpoint = read_checkpoint(DONE - 1)
    state = strategy_state(checkpoint)
    assert {"camera_paths", "n_high", "n_low", "n_total", "eta_max", "grad2d", "absgrad2d"} <= state.keys()
    assert len(checkpoint["pipeline"]["_model.gauss_params.means"]) == GAUSSIANS
    assert {"camera_opt", "color_matrices"} < checkpoint["optimizers"].keys()
    assert [step["iteration"] for step in state["structure_steps"]] == [8, 16]
    config = yaml.load(loadable.read_text("utf8"), Loader=yaml.Loader)
    paths = [config.data, config.output_dir, config.load_dir, config.pipeline.datamanager.dataparser.data]
    assert not any(path.is_absolute() for path in paths)


@pytest.mark.hard_case(
    "a run of an earlier version, resumed with the command that it printed when it was interrupted",
    "goes on with its options, statistics and optimizers, and ends as it did with that version",
)
def test_an_old_run_goes_on_with_the_command_that_it_printed(resumable: Path, capsys: pytest.CaptureFixture[str]):
    before = read_checkpoint(DONE - 1)
    ns_train(tyro.cli(AnnotatedBaseConfigUnion, args=["sadgs", "--load-config", str(resumable)]))
    printed = capsys.readouterr().out
    assert f"Resuming after step {DONE - 1} of {CHECKPOINTS}" in printed
    assert f"{ITERATIONS} iterations of 2 views, of which {DONE} are done" in printed
    assert "had other settings" not in printed
    assert [path.name for path in CHECKPOINTS.iterdir()] == [f"step-{ITERATIONS - 1:09d}.ckpt"]

    after = read_checkpoint(ITERATIONS - 1)
    *earlier, last = strategy_state(after)["structure_steps"]
    assert earlier == strategy_state(before)["structure_steps"]
    assert last["iteration"] == 24 and last["split"] > 0, "the statistics of the checkpoint decide about this split"
    poses = after["optimizers"].pop("poses")
    assert {*after["optimizers"], "camera_opt"} == before["optimizers"].keys()
    steps_done = {
        float(moments["step"]) for group in after["optimizers"].values() for moments in group["state"].values()
    }
    assert steps_done == {ITERATIONS}
    assert float(poses["state"][0]["step"].sum()) == 2 * (ITERATIONS - DONE)
    assert before["pipeline"]["_model.camera_optimizer.pose_adjustment"].any()
    assert after["pipeline"]["_model.poses.table"].all()

    now = measure(resumable, Path("results.json"))
    # Processors sum in other orders, and then a split can come out differently.
    assert now["psnr"] == pytest.approx(MEASURED["finished"]["psnr"], abs=0.5)
    assert now["ssim"] == pytest.approx(MEASURED["finished"]["ssim"], abs=0.02)


@pytest.mark.hard_case("a run of an earlier version, resumed with `--load-dir` and other options", "goes on with these")
def test_an_old_run_goes_on_with_other_options(resumable: Path, capsys: pytest.CaptureFixture[str]):
    config = yaml.load(resumable.read_text("utf8"), Loader=yaml.Loader)
    config.load_dir, config.output_dir = RUN, Path("resumed")
    config.max_num_iterations = 50
    config.pipeline.model.strategy.tau_split = 0.7
    trainer = set_up(config)
    plan = trainer.pipeline.model.plan
    assert trainer._start_step == DONE and plan.iterations == 50 and plan.strategy.tau_split == 0.7
    assert "other settings; this one goes on with its own: pipeline.model.strategy.tau_split was 0.8 and is 0.7." in (
        capsys.readouterr().out
    )


@pytest.mark.hard_case("`ns-eval` of a run of an earlier version", "the same PSNR and SSIM")
def test_ns_eval_measures_an_old_run_as_before(loadable: Path, tmp_path: Path):
    now = measure(loadable, tmp_path / "results.json")
    assert now["psnr"] == pytest.approx(MEASURED["interrupted"]["psnr"], abs=0.01)
    assert now["ssim"] == pytest.approx(MEASURED["interrupted"]["ssim"], abs=0.001)


class ViewerStarted(Exception):
    """Ends `ns-viewer` where it would wait for its user."""


@pytest.mark.hard_case("`ns-viewer` of a run of an earlier version", "shown, with the panels")
@pytest.mark.filterwarnings("ignore")  # One in viser's thread would end it, and the test would wait for ever.
def test_ns_viewer_shows_an_old_run_with_the_panels(loadable: Path, monkeypatch: pytest.MonkeyPatch):
    viewers: list[Viewer] = []

    def keep(*arguments: Any, **options: Any) -> Viewer:
        viewers.append(Viewer(*arguments, **options))
        return viewers[-1]

    def stop(seconds: float) -> None:
        raise ViewerStarted

    monkeypatch.setattr(run_viewer, "ViewerState", keep)
    monkeypatch.setattr(run_viewer, "time", SimpleNamespace(sleep=stop))
    this_machine = ViewerConfigWithoutNumRays(websocket_host="127.0.0.1")
    try:
        with pytest.raises(ViewerStarted):
            RunViewer(loadable, this_machine).main()
        (viewer,) = viewers
        labels = {element.name for _, element in viewer.viewer_elements}
        assert {"Show", "Preview", "max_gaussians"} <= labels
        pipeline: Any = viewer.pipeline
        assert isinstance(pipeline, SadgsPipeline)
        assert pipeline.model.num_points == GAUSSIANS
        pipeline.structure.choice.value = "η"
        camera = pipeline.datamanager.train_dataset.cameras[:1]
        pictures = in_the_viewer(lambda: pipeline.model.get_outputs_for_camera(camera))
        assert {"rgb", "depth", "normals", OUTPUT, "cleaned"} <= pictures.keys()
        assert pictures["rgb"].std() > 0.05
    finally:
        for viewer in viewers:
            viewer.viser_server.stop()


@pytest.mark.hard_case("`sadgs-export` of a run of an earlier version", "a splat of all Gaussians")
def test_sadgs_export_writes_the_gaussians_of_an_old_run(loadable: Path, tmp_path: Path):
    assert export.main([str(loadable), "--output", str(tmp_path / "splat.ply")]) == 0
    vertices = PlyData.read(str(tmp_path / "splat.ply"))["vertex"]
    positions = np.stack([vertices[axis] for axis in "xyz"], axis=-1)
    np.testing.assert_array_equal(positions, read_checkpoint(DONE - 1)["pipeline"]["_model.gauss_params.means"])
    plan = yaml.safe_load(loadable.with_name("plan.yml").read_text("utf8"))
    _, drawing = export.read_checkpoint(loadable)
    assert (drawing.near_plane, drawing.max_off_axis) == (plan["near_plane"], plan["max_off_axis"])


@pytest.mark.hard_case("`sadgs-inspect` of a run of an earlier version", "all pictures")
def test_sadgs_inspect_draws_an_old_run(
    loadable: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def write_nothing(path: Path, *_: Any, **__: Any) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()

    monkeypatch.setattr(color_scales, "draw", write_nothing)  # Drawing takes ten times as long as what is drawn.
    assert inspect.main([str(loadable), "--view", "1", "--output", str(tmp_path)]) == 0
    assert f"after {DONE} iterations" in capsys.readouterr().out
    names = ("ellipses", "wavelength", "eta", "children", "low", "step")
    assert {path.name for path in tmp_path.iterdir()} == {f"train-001-{name}.png" for name in names}


# --- runs of versions with other options ---


@dataclass
class LaterStrategy(StructureAwareStrategy):
    """A strategy of a later version, with an option whose default a function makes."""

    weights: list[float] = field(default_factory=lambda: [1.0, 2.0])


def change_plan(plan: dict[str, Any]) -> None:
    """Let another version have written a checkpoint's plan: with more fields, and without some."""
    plan["color_space"] = "linear"
    plan["strategy"]["tau_merge"] = 2.0
    del plan["strategy"]["child_scale"]
    for rate in plan["rates"].values():
        rate["warmup"] = 3
        del rate["initial_factor"]
    plan["requested"]["model.strategy.tau_merge"] = 2.0
    del plan["requested"]["model.strategy.child_scale"], plan["requested"]["effort"]


UNKNOWN = "color_space, strategy.tau_merge, rates.warmup"


def change_checkpoint() -> None:
    """Let another version have written the run's checkpoint, in the working directory."""
    checkpoint = read_checkpoint(DONE - 1)
    change_plan(checkpoint["pipeline"]["_extra_state"]["plan"])
    torch.save(checkpoint, CHECKPOINTS / f"step-{DONE - 1:09d}.ckpt")


def change_config(path: Path) -> None:
    """Let another version have written a `config.yml`: with more options, and without some."""
    config = yaml.load(path.read_text("utf8"), Loader=yaml.Loader)
    old = vars(config.pipeline.model.strategy)
    config.pipeline.model.strategy = LaterStrategy(**old)
    strategy = vars(config.pipeline.model.strategy)
    strategy["tau_merge"] = 2.0
    config.optimizers["means"]["optimizer"].amsgrad = True
    for values, name in ((strategy, "child_scale"), (strategy, "weights"), (vars(config), "viewer")):
        del values[name]
    path.write_text(yaml.dump(config), "utf8")


def lines_with(text: str, word: str) -> list[str]:
    return [line for line in text.splitlines() if word in line]


def test_a_plan_of_another_version_has_defaults_where_fields_are_missing(loadable: Path):
    plan = read_checkpoint(DONE - 1)["pipeline"]["_extra_state"]["plan"]
    assert unknown_fields(plan) == []
    changed = copy.deepcopy(plan)
    changed["strategy"]["child_scale"] = 1.25
    changed["rates"]["means"]["initial_factor"] = 0.5
    assert RunPlan.of(changed).strategy.child_scale == 1.25
    change_plan(changed)
    read = RunPlan.of(changed)
    assert read.strategy.child_scale == StructureAwareStrategy.child_scale != 1.25
    assert read.rates["means"] == Rate(**{**plan["rates"]["means"], "initial_factor": Rate.initial_factor})
    assert read.iterations == ITERATIONS
    assert ", ".join(unknown_fields(changed)) == UNKNOWN


@pytest.mark.hard_case(
    "a checkpoint whose plan lacks a field that has no default", "one sentence, which names the field"
)
@pytest.mark.parametrize("names", [("iterations",), ("strategy",), ("rates", "means", "lr")])
def test_a_field_without_a_default_that_is_missing_is_named(names: tuple[str, ...], resumable: Path):
    checkpoint = read_checkpoint(DONE - 1)
    values = checkpoint["pipeline"]["_extra_state"]["plan"]
    for name in names[:-1]:
        values = values[name]
    del values[names[-1]]
    torch.save(checkpoint, CHECKPOINTS / f"step-{DONE - 1:09d}.ckpt")
    problem = rf"The checkpoint's plan has no {'.'.join(names)}: load it with the version of sadgs that wrote it"
    with pytest.raises(InputError, match=rf"^{problem}\.$"):
        measure(resumable, Path("results.json"))
    config = yaml.load(resumable.read_text("utf8"), Loader=yaml.Loader)
    with pytest.raises(InputError, match=rf"\.ckpt cannot be continued: {problem}; give --load-dir "):
        set_up(config)


@pytest.mark.hard_case(
    "a checkpoint of a version whose plan, strategy or rates have other fields",
    "goes on with the defaults of missing ones; one line names those that are ignored",
)
def test_a_checkpoint_of_a_version_with_other_options_goes_on(resumable: Path, capsys: pytest.CaptureFixture[str]):
    change_checkpoint()
    config = yaml.load(resumable.read_text("utf8"), Loader=yaml.Loader)
    config.max_num_iterations = None  # The plan's is taken if the effort is the same.
    trainer = set_up(config)
    printed = capsys.readouterr().out
    assert lines_with(printed, "tau_merge") == [
        f"The checkpoint's plan has options that this version of sadgs does not have; they are ignored: {UNKNOWN}."
    ]
    assert "had other settings" not in printed
    assert trainer._start_step == DONE and trainer.pipeline.model.plan.iterations == ITERATIONS
    trainer.train()
    assert unknown_fields(read_checkpoint(ITERATIONS - 1)["pipeline"]["_extra_state"]["plan"]) == []


def test_a_checkpoint_of_a_version_with_other_options_is_measured_as_before(
    resumable: Path, capsys: pytest.CaptureFixture[str]
):
    change_checkpoint()
    now = measure(resumable, Path("results.json"))
    assert now["psnr"] == pytest.approx(MEASURED["interrupted"]["psnr"], abs=0.01)
    (line,) = lines_with(capsys.readouterr().out, "tau_merge")
    assert line.endswith(f"they are ignored: {UNKNOWN}.")


def test_a_config_of_a_version_with_other_options_has_defaults_where_some_are_missing(resumable: Path):
    change_config(resumable)
    text = resumable.read_text("utf8")
    assert "tau_merge" in text and not {"child_scale", "weights", "viewer"} & set(text.replace(":", " ").split())
    config = yaml.load(text, Loader=yaml.Loader)
    assert isinstance(config, SadgsTrainerConfig)
    strategy: Any = config.pipeline.model.strategy
    assert vars(strategy)["child_scale"] == StructureAwareStrategy.child_scale
    assert strategy.weights == [1.0, 2.0] and config.viewer == SadgsViewerConfig()
    assert strategy.max_gaussians == 400 and config.load_dir == CHECKPOINTS, "what the file says stays"
    again = yaml.load(text, Loader=yaml.Loader)
    assert again.pipeline.model.strategy.weights is not strategy.weights
    assert measure(resumable, Path("results.json"))["psnr"] == pytest.approx(MEASURED["interrupted"]["psnr"], abs=0.01)


@pytest.mark.hard_case(
    "a `config.yml` of a version with other options",
    "goes on with the defaults of missing ones; one line names those that are ignored, and the new file lacks them",
)
def test_a_config_of_a_version_with_other_options_goes_on(resumable: Path, capsys: pytest.CaptureFixture[str]):
    change_config(resumable)
    ns_train(tyro.cli(AnnotatedBaseConfigUnion, args=["sadgs", "--load-config", str(resumable)]))
    printed = capsys.readouterr().out
    assert lines_with(printed, "tau_merge") == [
        "config.yml has options that this version of sadgs does not have; they are ignored: "
        "pipeline.model.strategy.tau_merge, optimizers.means.optimizer.amsgrad."
    ]
    assert "had other settings" not in printed
    assert [path.name for path in CHECKPOINTS.iterdir()] == [f"step-{ITERATIONS - 1:09d}.ckpt"]
    written = resumable.read_text("utf8")
    assert "tau_merge" not in written and "amsgrad" not in written and "weights" in written
