"""Runs that cannot go on: full and read-only disks, unusable checkpoints and full memory end them with one sentence.

Out-of-memory errors are raised artificially; full disks are real (`/dev/full`). `ns-export` writes with nerfstudio's
own code, not atomically.

Tried by hand: if port 7007 is taken and none was given, a free one is taken and printed. A run with
`--viewer.max-num-display-images` of −5 or 0 trains. A run whose data are moved away trains on, since images are in
memory.
"""

from __future__ import annotations

import dataclasses
import math
import re
import shutil
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import writer

from helpers.kill_and_resume import differences, parser_of, set_up
from helpers.refusals import refusal
from helpers.short_runs import checkpoint, configure, is_finite, train
from helpers.small_scenes import HEIGHT, WIDTH
from sadgs_ns.cli.export import write_gaussians
from sadgs_ns.errors import InputError, RunError, WriteError
from sadgs_ns.gsplat_compat import NEAR_PLANE
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.presets import sadgs
from sadgs_ns.training.run import checkpoints
from sadgs_ns.training.run.run_folder import write_config
from sadgs_ns.training.run.trainer import SadgsTrainer
from sadgs_ns.training.step import nonfinite

ITERATIONS = 6


@pytest.fixture
def config(colmap: ColmapDataParserConfig, tmp_path: Path) -> SadgsTrainerConfig:
    return configure(tmp_path / "out", colmap, ITERATIONS)


# --- options ---


@pytest.mark.hard_case(
    "accumulated gradients; several devices on the CPU without torchrun; CUDA on a machine without it; "
    "a seed of −1 or 2³²; `--scale-factor`, `--camera-res-scale-factor` or `--train-split-fraction` of 0, −1 "
    "or NaN; `--eval-interval` 0, 1, −2; learning rates outside [0, 1], NaN or 10⁹; schedule factors that are "
    "not positive or leave that range; negative distances between checkpoints; a port beyond 65535; "
    "`--load-step` without `--load-dir`",
    "refused by name",
)
@pytest.mark.parametrize(
    ("option", "value", "sentence"),
    [
        ("gradient_accumulation_steps", {"means": 4}, "gradient_accumulation_steps must be 1: pipeline."),
        (
            "machine.num_devices",
            2,
            "machine.num_devices is 2, and nerfstudio starts several processes with CUDA only",
        ),
        ("machine.num_devices", 0, "machine.num_devices must be at least 1, got 0."),
        ("machine.num_machines", 2, "machine.num_machines must be 1, since `torchrun --nnodes … "),
        ("machine.device_type", "cuda", "machine.device_type is cuda, but torch finds no CUDA device: set it to cpu,"),
        (
            "pipeline.datamanager.cache_images_type",
            "float32",
            "pipeline.datamanager.cache_images_type must be uint8, which is what files of images hold, got float32.",
        ),
        (
            "pipeline.datamanager.train_cameras_sampling_strategy",
            "fps",
            "pipeline.datamanager.train_cameras_sampling_strategy must be random, which takes each view once a round, ",
        ),
        ("machine.seed", -1, "machine.seed must be in [0, 2³²), got -1."),
        ("machine.seed", 2**32, "machine.seed must be in [0, 2³²), got 4,294,967,296."),
        (
            "pipeline.datamanager.dataparser.scale_factor",
            0.0,
            "pipeline.datamanager.dataparser.scale_factor must be positive and finite, got 0.",
        ),
        (
            "pipeline.datamanager.dataparser.scale_factor",
            math.nan,
            "pipeline.datamanager.dataparser.scale_factor must be positive and finite, got nan.",
        ),
        (
            "pipeline.datamanager.dataparser.train_split_fraction",
            2.0,
            "pipeline.datamanager.dataparser.train_split_fraction must be in (0, 1], got 2.",
        ),
        (
            "pipeline.datamanager.dataparser.eval_interval",
            1,
            "pipeline.datamanager.dataparser.eval_interval must be at least 2, got 1.",
        ),
        (
            "pipeline.datamanager.camera_res_scale_factor",
            100.0,
            "pipeline.datamanager.camera_res_scale_factor must be in (0, 1], got 100.",
        ),
        (
            "pipeline.datamanager.camera_res_scale_factor",
            math.nan,
            "pipeline.datamanager.camera_res_scale_factor must be in (0, 1], got nan.",
        ),
        ("steps_per_save", -3, "steps_per_save must be at least 0, got -3."),
        ("seconds_per_save", math.nan, "seconds_per_save must be at least 0, got nan."),
        ("steps_per_eval_batch", -1, "steps_per_eval_batch must be at least 0, got -1."),
        ("steps_per_eval_image", -1, "steps_per_eval_image must be at least 0, got -1."),
        ("steps_per_eval_all_images", -1, "steps_per_eval_all_images must be at least 0, got -1."),
        ("logging.steps_per_log", 0, "logging.steps_per_log must be at least 1, got 0."),
        ("viewer.websocket_port", 99999, "viewer.websocket_port must be in [1, 65535], got 99,999."),
        ("pipeline.effort", 0.0, "pipeline.effort must be in (0, 100], got 0."),
        ("pipeline.model.averaged_share", 0.5, "pipeline.model.averaged_share must be in [0, 0.3], got 0.5."),
        (
            "pipeline.model.max_angular_scale",
            -0.1,
            "pipeline.model.max_angular_scale must be finite and not negative, got -0.1.",
        ),
        (
            "pipeline.model.max_off_axis",
            math.inf,
            "pipeline.model.max_off_axis must be finite and not negative, got inf.",
        ),
        (
            "pipeline.model.max_off_axis",
            0.5,
            "pipeline.model.max_off_axis must be 0, or at least 1, the image's border, got 0.5.",
        ),
        ("pipeline.effort", math.nan, "pipeline.effort must be in (0, 100], got nan."),
        ("load_step", 3, "load_step must be left out unless load_dir names a run, got 3."),
        ("optimizers.means.optimizer.lr", math.nan, "optimizers.means.optimizer.lr must be in [0, 1], got nan."),
        ("optimizers.quats.optimizer.lr", 1e9, "optimizers.quats.optimizer.lr must be in [0, 1], got 1e+09."),
        ("optimizers.scales.optimizer.lr", -1.0, "optimizers.scales.optimizer.lr must be in [0, 1], got -1."),
        (
            "optimizers.means.scheduler.initial_factor",
            1e9,
            "optimizers.means.scheduler.initial_factor must be positive, and 0.00016 times it at most 1, got 1e+09.",
        ),
        (
            "optimizers.means.scheduler.final_factor",
            0.0,
            "optimizers.means.scheduler.final_factor must be positive, and 0.00016 times it at most 1, got 0.",
        ),
    ],
)
def test_options_with_which_no_run_can_work_are_refused_before_anything_is_written(
    option: str, value: Any, sentence: str, config: SadgsTrainerConfig
):
    needs_none = value == "cuda" or (option == "machine.num_devices" and value == 2)
    if needs_none and torch.cuda.is_available():
        pytest.skip("there is a device of this kind")
    owner: Any = config
    *owners, name = option.split(".")
    for part in owners:
        owner = owner[part] if isinstance(owner, dict) else getattr(owner, part)
    setattr(owner, name, value)
    with pytest.raises(InputError) as refused:
        config.save_config()
    assert str(refused.value).startswith(sentence)
    assert "\n" not in str(refused.value)
    assert not config.output_dir.exists()


@pytest.mark.hard_case("images of less than 2 px after scaling", "refused: names the image")
@pytest.mark.filterwarnings("ignore:Skipping Gaussian Smoothing:UserWarning")  # of images smaller than SSIM's window
def test_images_that_are_too_small_after_scaling_are_named(config: SadgsTrainerConfig):
    config.pipeline.datamanager.camera_res_scale_factor = 1.5 / HEIGHT
    sentence = (
        rf"/images/\S+ would be trained on with {int(1.5 * WIDTH / HEIGHT)} × 1 px, and at least 2 × 2 are needed: "
    )
    with refusal(sentence):
        set_up(config)
    config.pipeline.datamanager.camera_res_scale_factor = 2.5 / HEIGHT
    assert is_finite(train(config).pipeline.model)


@pytest.mark.hard_case(
    "`--scale-factor` 10¹² (everything lies behind the far plane)",
    "refused: the extent of the cameras, and what is seen",
)
def test_cameras_that_see_nothing_are_refused(config: SadgsTrainerConfig):
    parser: Any = config.pipeline.datamanager.dataparser
    config.pipeline.datamanager.dataparser = dataclasses.replace(parser, scale_factor=1e12)
    with refusal(r"^The renderings would be empty, since a camera sees from 0\.01 to 1e\+10 units"):
        set_up(config)


def test_a_scene_in_tiny_units_is_seen_since_its_near_plane_is_in_them(config: SadgsTrainerConfig):
    config.pipeline.model.near_plane = "scene"
    plane = set_up(config).pipeline.model.plan.near_plane
    config.pipeline.model.near_plane = "viewers"
    assert set_up(config).pipeline.model.plan.near_plane == NEAR_PLANE < plane
    parser: Any = config.pipeline.datamanager.dataparser
    config.pipeline.datamanager.dataparser = dataclasses.replace(parser, scale_factor=1e-4)
    actual = set_up(config).pipeline.model.plan.near_plane
    expected = pytest.approx(1e-4 * plane, rel=1e-3)
    assert actual == expected


@pytest.mark.hard_case(
    "a viewer's port that is taken; `--viewer.websocket-host` unknown, or an address of another machine",
    "refused: give another, or no port for a free one",
)
def test_a_viewer_that_cannot_listen_where_it_is_told_to_is_refused(config: SadgsTrainerConfig):
    def refused() -> str:
        with pytest.raises(InputError) as error:
            config.save_config()
        assert not config.output_dir.exists()
        return str(error.value)

    config.vis = "viewer"
    with socket.create_server(("127.0.0.1", 0)) as other:
        config.viewer.websocket_port = port = other.getsockname()[1]
        told = (
            rf"^The viewer cannot listen on 127\.0\.0\.1:{port} \(.+\): give another viewer\.websocket_port, or none "
        )
        assert re.search(told, refused())
        config.vis = "tensorboard"
        config.save_config()
        shutil.rmtree(config.output_dir)
    config.vis = "viewer_legacy"
    config.viewer.websocket_port = None
    config.viewer.websocket_host = "192.0.2.1"  # an address that no machine has
    assert re.search(
        r"^The viewer cannot listen on 192\.0\.2\.1 \(.+\): give another .*viewer\.websocket_host", refused()
    )
    config.viewer.websocket_host = "no host"
    assert re.search(r"^The viewer cannot listen on no host \(.+\): .* 127\.0\.0\.1 opens the viewer", refused())
    config.viewer.websocket_host = "127.0.0.1"
    config.save_config()


@pytest.mark.hard_case(
    "options beside `--load-config` (`--max-num-iterations 6000`); `--load-config` with no file, a folder, "
    "another file",
    "refused: names them, and `--load-dir`; the sentence comes after one line of nerfstudio's, not after 300 "
    "lines of configuration",
)
def test_options_beside_a_config_that_nerfstudio_would_not_read_are_refused(
    config: SadgsTrainerConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    preset = sadgs.config
    file = write_config(config)
    dataclasses.replace(preset, load_config=file).print_to_terminal()
    printed = capsys.readouterr().out
    assert printed == ""
    with pytest.raises(InputError) as refused:
        dataclasses.replace(preset, load_config=file, max_num_iterations=9, pipeline=config.pipeline)
    assert str(refused.value) == (
        "With --load-config all options come from its file, and max_num_iterations, pipeline would be ignored: leave "
        "these out, change them in the file, or give --load-dir with the run's folder instead."
    )
    (tmp_path / "text").write_text("hello")
    (tmp_path / "bytes").write_bytes(b"\xff")
    for name, problem in (
        ("none", "No such file or directory"),
        ("", "Is a directory"),
        ("text", "it is no config.yml of a run"),
        ("bytes", ".+"),
    ):
        with refusal(rf"^{tmp_path / name} cannot be used \({problem}\): give --load-config the"):
            dataclasses.replace(preset, load_config=tmp_path / name)


def test_accumulating_over_one_iteration_is_what_everybody_does(config: SadgsTrainerConfig):
    config.gradient_accumulation_steps = {"means": 1}
    config.check()
    config.gradient_accumulation_steps = {"means": 2}
    with refusal("gradient_accumulation_steps"):
        config.check()


# --- the disk ---


def fill_disk(partial: Path) -> None:
    """Let what is written under this temporary name meet a full disk."""
    if not Path("/dev/full").exists():
        pytest.skip("only Linux has /dev/full")
    partial.symlink_to("/dev/full")


@pytest.mark.hard_case("an output folder below a file", "refused before anything is written")
def test_an_output_folder_that_cannot_be_made_is_named_before_anything_is_written(
    config: SadgsTrainerConfig, tmp_path: Path
):
    (tmp_path / "file").write_text("in the way")
    config.output_dir = tmp_path / "file/out"
    with pytest.raises(WriteError, match=r"/file/out/\S+/config\.yml could not be written \(Not a directory; .*name "):
        config.save_config()
    names = [path.name for path in tmp_path.iterdir()]
    assert names == ["file"]


@pytest.mark.hard_case("the name of a folder is longer than the file system allows", "refused")
def test_an_output_folder_whose_name_is_too_long_is_named(config: SadgsTrainerConfig):
    config.timestamp = "x" * 300
    with pytest.raises(WriteError, match=r"/x+/config\.yml could not be written \(File name too long; .* free there"):
        config.save_config()


@pytest.mark.hard_case("a read-only output folder", "refused before anything is written")
def test_a_read_only_output_folder_is_named(config: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch):
    def denied(path: Path, *args: Any, **kwargs: Any) -> None:
        raise PermissionError(13, "Permission denied", str(path))  # root, as in containers, may write everywhere

    monkeypatch.setattr(Path, "mkdir", denied)
    with pytest.raises(WriteError, match=r"config\.yml could not be written \(Permission denied; .*can be written;"):
        config.save_config()


@pytest.mark.hard_case(
    "the disk is full while a checkpoint is saved",
    "the run ends; the previous checkpoint is bitwise as it was, there is no partial file",
)
def test_a_full_disk_leaves_the_previous_checkpoint_and_ends_training_with_one_sentence(config: SadgsTrainerConfig):
    trainer = set_up(config)
    trainer.save_checkpoint(1)
    before = checkpoint(trainer, 1)
    partial = trainer.checkpoint_dir.with_name(".nerfstudio_models.partial")
    fill_disk(partial)
    with pytest.raises(
        WriteError, match=r"step-000000002\.ckpt could not be written \(.+ GB free there\): make room or"
    ):
        trainer.save_checkpoint(2)
    fill_disk(partial)
    with pytest.raises(
        WriteError, match=r"^\S+/step-000000005\.ckpt could not be written \(.+\): make room or [^\n]+\.$"
    ):
        trainer.train()
    names = [path.name for path in trainer.checkpoint_dir.iterdir()]
    assert names == ["step-000000001.ckpt"]
    actual = differences(checkpoint(trainer, 1), before)
    assert actual == []
    actual = list(config.output_dir.rglob("*.partial"))
    assert actual == []


@pytest.mark.hard_case("the disk is full in a logger (tensorboard)", "the run ends with the file's name")
def test_a_logger_s_full_disk_is_one_sentence_and_other_errors_of_reading_are_themselves(config: SadgsTrainerConfig):
    def failing(error: OSError) -> SadgsTrainer:
        trainer = set_up(config)

        def fail(step: int) -> Any:
            raise error

        trainer.pipeline.next_views = fail  # type: ignore[assignment]
        return trainer

    with pytest.raises(WriteError, match=r"^/x/events could not be written \(No space left on device; [^\n]+\.$"):
        failing(OSError(28, "No space left on device", "/x/events")).train()
    with pytest.raises(OSError, match=r"^broken data stream$"):
        failing(OSError("broken data stream")).train()


@pytest.mark.hard_case("the run's folder is deleted while it trains (tensorboard)", "saved again, one sentence")
def test_what_was_trained_is_saved_where_a_logger_fails_after_a_step(
    config: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch
):
    trainer = set_up(config)

    def write() -> None:  # as tensorboard's writer where the run's folder was deleted
        if trainer.step == 3:
            raise FileNotFoundError(2, "No such file or directory", b"/x/events")

    monkeypatch.setattr(writer, "write_out_storage", write)
    shutil.rmtree(trainer.base_dir)
    with pytest.raises(WriteError, match=r"^/x/events could not be written \(No such file or directory; "):
        trainer.train()
    names = [path.name for path in trainer.checkpoint_dir.iterdir()]
    assert names == ["step-000000003.ckpt"]


@pytest.mark.hard_case("the disk is full while a PLY is exported", "`WriteError`; the previous file is as it was")
def test_a_full_disk_leaves_the_previous_export(tmp_path: Path):
    def write(count: int) -> None:
        params = {name: torch.zeros(count, 3) for name in ("means", "scales", "features_dc")}
        params |= {"quats": torch.ones(count, 4), "opacities": torch.zeros(count, 1)}
        write_gaussians(tmp_path / "splat.ply", params | {"features_rest": torch.zeros(count, 0, 3)})

    write(10)
    before = (tmp_path / "splat.ply").read_bytes()
    fill_disk(tmp_path / ".splat.partial.ply")
    with pytest.raises(WriteError, match=r"splat\.ply could not be written \(.+ GB free there\): make room or "):
        write(10_000)
    names = [path.name for path in tmp_path.iterdir()]
    assert names == ["splat.ply"]
    assert (tmp_path / "splat.ply").read_bytes() == before


# --- checkpoints ---


@pytest.fixture(scope="module")
def saved(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint after a few iterations."""
    output = tmp_path_factory.mktemp("saved")
    trainer = train(configure(output, parser_of(scene), ITERATIONS))
    (path,) = trainer.checkpoint_dir.iterdir()
    return path


def rewrite(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def spoil(path: Path) -> None:
        state = torch.load(path, weights_only=True)
        change(state)
        torch.save(state, path)

    return spoil


def drop(state: dict[str, Any], part: str) -> None:
    for key in [key for key in state if part in key]:
        del state[key]


def fewer_harmonics(state: dict[str, Any]) -> None:
    key = "_model.gauss_params.features_rest"
    state["pipeline"][key] = state["pipeline"][key][:, :8]


CHECKPOINTS = {
    "not-one": (
        lambda path: path.write_bytes(b"hello"),
        r"\S+5\.ckpt is cut off, damaged or not of tensors .* \(File is not a zip file\): give --load-dir .*\.",
    ),
    "truncated": (
        lambda path: path.write_bytes(path.read_bytes()[:5000]),
        r"\S+5\.ckpt is cut off, damaged or not of tensors .* \(File is not a zip file\): give --load-dir .*\.",
    ),
    "no-pipeline": (
        rewrite(lambda state: state.pop("pipeline")),
        r"\S+5\.ckpt is not a checkpoint that nerfstudio's trainer wrote \(it has no pipeline\): give --load-dir .*\.",
    ),
    "another-method": (
        rewrite(lambda state: drop(state["pipeline"], "gauss_params")),
        r"\S+ cannot be continued: The checkpoint has no features_dc of Gaussians, so another method made it; .*\.",
    ),
    "splatfacto": (
        rewrite(lambda state: drop(state["pipeline"], "_extra_state")),
        r"\S+ cannot be continued: The checkpoint lacks the state of structure-aware .*, so splatfacto made it; .*\.",
    ),
    "other-degree": (
        rewrite(fewer_harmonics),
        r"\S+ cannot be continued: The checkpoint's features_rest have the shape \[8, 3\], the model's \[15, 3\]: .*\.",
    ),
    "other-version": (
        rewrite(lambda state: state["pipeline"]["_model._extra_state"].pop("strategy_state")),
        r"\S+ is not a checkpoint of this version of sadgs \(KeyError: 'strategy_state'\): .*\.",
    ),
    "empty-folder": (lambda path: path.unlink(), r"\S+ holds no checkpoint: give --load-dir the folder .*\."),
}


@pytest.mark.hard_case(
    "a checkpoint of another method, of splatfacto, of other harmonics, of another version, cut off, or none",
    "refused: names the file (nerfstudio would go on from a mixture)",
)
@pytest.mark.parametrize("case", CHECKPOINTS)
def test_a_checkpoint_that_cannot_be_continued_is_refused_in_one_sentence(
    case: str, saved: Path, config: SadgsTrainerConfig, tmp_path: Path
):
    spoil, sentence = CHECKPOINTS[case]
    (tmp_path / "models").mkdir()
    spoil(Path(shutil.copy(saved, tmp_path / "models")))
    config.load_dir = tmp_path / "models"
    with pytest.raises(InputError) as refused:
        set_up(config)
    assert re.fullmatch(sentence, str(refused.value)), str(refused.value)


@pytest.mark.parametrize("case", ["not-one", "truncated", "empty-folder"])
def test_a_checkpoint_that_is_none_is_refused_before_anything_is_written(
    case: str, saved: Path, config: SadgsTrainerConfig, tmp_path: Path
):
    spoil, sentence = CHECKPOINTS[case]
    (tmp_path / "models").mkdir()
    spoil(Path(shutil.copy(saved, tmp_path / "models")))
    config.load_dir = tmp_path / "models"
    config.output_dir = tmp_path / "out"
    with pytest.raises(InputError) as refused:
        config.save_config()
    assert re.fullmatch(sentence, str(refused.value)), str(refused.value)
    assert not config.output_dir.exists()


def test_one_whole_checkpoint_among_damaged_ones_is_enough(saved: Path, tmp_path: Path):
    shutil.copy(saved, tmp_path)
    latest = tmp_path / "step-000000009.ckpt"
    latest.write_bytes(b"cut off")
    checkpoints.check_chosen(tmp_path, None, None)
    with refusal(r"9\.ckpt is cut off"):
        checkpoints.check_chosen(tmp_path, 9, None)


@pytest.mark.hard_case("other files in a run's folder of checkpoints", "passed over, and kept")
@pytest.mark.parametrize("name", ["notes.txt", "best.ckpt", "step-000000005 (copy).ckpt", "step-000000005.ckpt.bak"])
def test_a_file_of_the_user_s_among_checkpoints_is_passed_over_and_kept(name: str, saved: Path, tmp_path: Path):
    for path in (saved.name, name):
        shutil.copy(saved, tmp_path / path)
    actual = checkpoints.checkpoint_paths(tmp_path, None, None)
    assert actual == [tmp_path / saved.name]
    checkpoints.write(tmp_path, 9, {}, keep_others=False)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"step-000000009.ckpt", name}


@pytest.mark.hard_case("no checkpoint in the folder, none of that step", "refused: the steps there are")
def test_a_step_or_file_without_a_checkpoint_is_named(saved: Path, tmp_path: Path):
    with refusal(r"no checkpoint of step 3: give --load-step one of 5\."):
        checkpoints.checkpoint_paths(saved.parent, 3, None)
    with refusal(r"\S+/none\.ckpt is no file: give --load-checkpoint one"):
        checkpoints.checkpoint_paths(None, None, tmp_path / "none.ckpt")
    for step in (None, 5):
        actual = checkpoints.checkpoint_paths(saved.parent, step, None)
        assert actual == [saved]
    actual = checkpoints.checkpoint_paths(None, None, None)
    assert actual == []


@pytest.mark.hard_case(
    "`--load-dir` with a folder above the runs; `--load-checkpoint` with a folder, `--load-dir` with a file, "
    "both options",
    "refused: holds no checkpoint, such as the latest run below it; which option it belongs to",
)
def test_what_is_given_to_the_wrong_option_is_told_where_it_belongs(saved: Path, tmp_path: Path):
    run = saved.parents[1]
    for folder in (run, saved.parent):
        with refusal(rf"^{folder} is no file: give --load-checkpoint one, or --load-dir"):
            checkpoints.checkpoint_paths(None, None, folder)
    with refusal(rf"^{saved} holds no checkpoint: give --load-dir the folder of a run"):
        checkpoints.checkpoint_paths(saved, None, None)
    with refusal(r"^load_dir and load_checkpoint both name where the run goes on: give one"):
        checkpoints.checkpoint_paths(run, None, saved)
    for above in run.parents[:3]:  # the folders of the method, the experiment and all outputs
        with refusal(rf"^{above} holds no checkpoint: give .* of sadgs, such as {run}\.$"):
            checkpoints.checkpoint_paths(above, None, None)
    with refusal(rf"^{tmp_path} holds no checkpoint: give --load-dir the .* run of sadgs\.$"):
        checkpoints.checkpoint_paths(tmp_path, None, None)


# --- runs that learn nothing ---


def poison(trainer: SadgsTrainer, what: str) -> None:
    """Let every loss, or every gradient of means, be NaN from now on; or the gradient of the first Gaussian alone."""
    trainer.graphed = None  # A graph repeats what was launched before it was poisoned.
    model = trainer.pipeline.model
    before_background = model.before_background
    gaussians = model.gaussians
    rows = slice(None) if what == "gradients" else slice(1)

    def spoil(gradient: torch.Tensor) -> torch.Tensor:
        gradient = gradient.clone()
        gradient[rows] = math.nan
        return gradient

    def spoiled(params: dict[str, torch.Tensor], *args: Any) -> Any:
        for leaf in params.values():
            leaf.register_hook(spoil)
        return gaussians(params, *args)

    if what == "loss":
        model.before_background = lambda *args: before_background(*args) * math.nan  # type: ignore[method-assign]
    else:
        model.gaussians = spoiled  # type: ignore[method-assign]


@pytest.mark.hard_case(
    "every loss, or every gradient, is NaN for 100 iterations",
    "one sentence with the images and the remedy, exit code 1; finite Gaussians are saved, earlier checkpoints stay",
)
@pytest.mark.parametrize("what", ["loss", "gradients"])
def test_a_run_that_learns_nothing_stops_with_one_sentence_and_a_finite_checkpoint(
    what: str, config: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setattr(nonfinite, "DIVERGED_STEPS", 8)
    config.max_num_iterations = 24
    config.steps_per_save = 3
    config.pipeline.model.strategy.refine_stop_iter = 0
    trainer = set_up(config)
    trainer.pipeline.log.capacity = 4  # read every 4 iterations
    location = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
    trainer.callbacks.append(
        TrainingCallback(location, lambda step: poison(trainer, what) if step == 4 else None)  # the second of a window
    )
    with pytest.raises(RunError) as stopped:
        trainer.train()
    said = "the loss was nan" if what == "loss" else "gradients were not finite"
    assert re.fullmatch(
        rf"Nothing was learned in the last 11 iterations, up to iteration 16: {said} \(images (\S+\.png, ){{3}}\S+\.png"
        r"\); look at them with sadgs-doctor, and lower the learning rates if you raised them; the Gaussians as they "
        r"are now are saved and go on with --load-dir \S+/nerfstudio_models\.",
        str(stopped.value),
    ), str(stopped.value)
    assert is_finite(trainer.pipeline.model)
    state = checkpoint(trainer, 15)
    assert all(v.isfinite().all() for k, v in state["pipeline"].items() if "gauss_params" in k)
    assert (trainer.checkpoint_dir / "step-000000012.ckpt").exists()  # it may be the better one
    config.load_dir = trainer.checkpoint_dir
    config.output_dir = tmp_path / "resumed"
    assert is_finite(train(config).pipeline.model)


@pytest.mark.hard_case(
    "every gradient is NaN for the whole of a run of fewer than 100 iterations",
    "one sentence with the images and the remedy, exit code 1; finite Gaussians are saved",
)
def test_a_short_run_whose_every_gradient_is_nan_does_not_end_well(config: SadgsTrainerConfig):
    config.pipeline.model.strategy.refine_stop_iter = 0
    trainer = set_up(config)
    poison(trainer, "gradients")
    with pytest.raises(
        RunError, match=rf"^Nothing was learned in the last {ITERATIONS} iterations, up to iteration 6: gr"
    ):
        trainer.train()
    assert checkpoint(trainer, ITERATIONS - 1)["step"] == ITERATIONS - 1


@pytest.mark.hard_case("every loss is NaN, and the Gaussians are, too", "the sentence says so, nothing is saved")
def test_gaussians_that_are_not_finite_are_not_saved(config: SadgsTrainerConfig):
    config.pipeline.model.strategy.refine_stop_iter = 0
    trainer = set_up(config)
    trainer.pipeline.model.gauss_params["features_dc"].data.fill_(math.nan)
    with pytest.raises(
        RunError, match=r"; the Gaussians themselves are not finite: train anew, or from a checkpoint .+\.$"
    ):
        trainer.train()


@pytest.mark.hard_case("one Gaussian whose gradient is always NaN", "stops nobody")
def test_one_gaussian_whose_gradient_is_always_nan_stops_nobody(
    config: SadgsTrainerConfig, capsys: pytest.CaptureFixture[str]
):
    config.pipeline.model.strategy.refine_stop_iter = 0
    trainer = set_up(config)
    poison(trainer, "one gradient")
    trainer.train()
    printed = capsys.readouterr().out
    assert "gradients were not finite" in printed
    assert is_finite(trainer.pipeline.model)


# --- the GPU's memory ---

FULL = torch.cuda.OutOfMemoryError(
    "CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has a total capacity of 8 GiB of which 1 MiB is free."
)


def fail_at(trainer: SadgsTrainer, step: int) -> None:
    """Let the memory be full in the forward pass of this iteration."""
    next_views = trainer.pipeline.next_views

    def full(number: int) -> Any:
        if number == step:
            raise FULL
        return next_views(number)

    trainer.pipeline.next_views = full  # type: ignore[method-assign]


@pytest.mark.hard_case(
    "CUDA is out of memory in an iteration",
    "the run ends; the sentence names the last checkpoint, `max-gaussians` and image size",
)
@pytest.mark.parametrize("steps", [0, 2])
def test_full_memory_ends_the_run_with_a_sentence_that_says_what_helps(steps: int, config: SadgsTrainerConfig):
    config.steps_per_save = steps
    config.seconds_per_save = 0
    trainer = set_up(config)
    fail_at(trainer, 4)
    with pytest.raises(RunError) as stopped:
        trainer.train()
    kept = r"what the last checkpoint holds goes on with --load-dir \S+/nerfstudio_models"
    assert re.fullmatch(
        r"The GPU's memory was full at iteration 4 with \d+ Gaussians \(CUDA out of memory\. Tried to allocate 2\.00 "
        r"GiB\): lower --pipeline\.model\.strategy\.max-gaussians or --pipeline\.views-per-iteration, or take smaller "
        rf"images .*; {kept if steps else 'this run has made no checkpoint yet'}\.",
        str(stopped.value),
    )


@pytest.mark.hard_case("CUDA is out of memory at the start", "the run ends in one sentence")
def test_full_memory_at_the_start_is_one_sentence(config: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch):
    def full(*args: Any, **kwargs: Any) -> None:
        raise FULL

    monkeypatch.setattr(Trainer, "setup", full)
    with pytest.raises(
        RunError, match=r"^The GPU's memory is too small to start \(CUDA out of memory\. .*GiB\): lower"
    ):
        set_up(config)
