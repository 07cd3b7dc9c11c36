"""What nerfstudio's other commands, such as `ns-eval` and `ns-render`, say of a run where they cannot go on.

Tried by hand: `ns-*` commands in a deleted working directory end with "Intel oneMKL FATAL ERROR", because MKL ends the
process as nerfstudio imports torch, before any code of ours.
"""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.scripts.render import DatasetRender, RenderCameraPath, RenderInterpolated, SpiralRender
from nerfstudio.utils import install_checks, writer
from PIL import Image

from helpers.forked_python import HANGS
from helpers.json_files import read_json, write_json
from helpers.kill_and_resume import configure
from helpers.refusals import refusal
from helpers.short_runs import configure as short_run
from helpers.short_runs import nerfstudio_data, train
from helpers.small_scenes import VIEWS
from sadgs_ns import errors
from sadgs_ns.training.model import SadgsModel
from sadgs_ns.training.run.run_folder import write_config

HELD_OUT = {0: 1.0, 1: 0.9}
"""Number of held-out views, and the share of the drawn scene's 10 views that is then trained on."""


@pytest.fixture(scope="module", params=HELD_OUT)
def run(request: pytest.FixtureRequest, scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[int, Path]:
    """Number of held-out views, and the config.yml of a run that holds out so many."""
    config = configure(scene, tmp_path_factory.mktemp("run"), iterations=1, save_every=0)
    parser: Any = config.pipeline.datamanager.dataparser
    config.pipeline.datamanager.dataparser = dataclasses.replace(
        parser, eval_mode="fraction", train_split_fraction=HELD_OUT[request.param]
    )
    return request.param, write_config(train(config).config)


@pytest.fixture(autouse=True)
def no_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(install_checks, "check_ffmpeg_installed", lambda: None)
    monkeypatch.setattr(SadgsModel, "lpips", lambda *_: float("nan"))  # its weights would be downloaded


def said_of(command: Any) -> str | None:
    """What is printed in place of the traceback."""
    with pytest.raises(
        (
            ArithmeticError,
            AssertionError,
            AttributeError,
            EOFError,
            LookupError,
            OSError,
            RuntimeError,
            TypeError,
            ValueError,
        )
    ) as failed:
        command.main()
    return errors.sentence_of(failed.value)


@pytest.mark.hard_case("`ns-eval` with one held-out view; with none", "no deviations; refused")
def test_one_held_out_view_has_no_deviation_and_none_is_one_sentence(run: tuple[int, Path], tmp_path: Path):
    held_out, config = run
    command = ComputePSNR(config, tmp_path / "results.json")
    if held_out == 0:
        with refusal(r"^The run holds out no view, so that there is nothing to measure: train"):
            command.main()
        return
    command.main()

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    results = json.loads((tmp_path / "results.json").read_text(), parse_constant=refuse)["results"]
    assert {"psnr", "ssim", "fps"} <= results.keys()
    for name in results:
        assert not name.endswith("_std")


@pytest.mark.hard_case(
    "`ns-render interpolate` with one held-out view, or none; `spiral`; `dataset` without a held-out view",
    "one sentence: `--pose-source train`, or what to use instead",
)
def test_views_that_nerfstudio_cannot_render_are_one_sentence(run: tuple[int, Path], tmp_path: Path):
    held_out, config = run
    said = said_of(RenderInterpolated(config, tmp_path / "video.mp4"))
    assert said is not None
    assert said.startswith("A path between views needs two of them, and the run holds out fewer: ")
    said = said_of(SpiralRender(config, tmp_path / "video.mp4"))
    assert said is not None
    assert said.startswith("`ns-render spiral` does not work with methods that train on whole ")
    if held_out == 0:
        said = said_of(DatasetRender(load_config=config, output_path=tmp_path / "views"))
        assert said == (
            "The run holds out no view that could be rendered: add --split train, which takes the training views."
        )


CAMERA = {"camera_to_world": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 1, 0, 0, 0, 1], "fov": 50}
PATH: dict[str, Any] = {"seconds": 1, "render_height": 36, "render_width": 48, "camera_path": [CAMERA, CAMERA]}
"""A camera path as the viewer writes it, with whole numbers, as a program may write it."""
CROP = {"crop_bg_color": {"r": 255, "g": 0, "b": 0}, "crop_center": [0, 0, 0], "crop_scale": [1e-3, 1e-3, 1e-3]}


def path_command(config: Path, folder: Path, text: str | bytes | None, **options: Any) -> RenderCameraPath:
    """`ns-render camera-path` with a file of this content."""
    file = folder / "path.json"
    if isinstance(text, str):
        file.write_text(text)
    elif text is not None:
        file.write_bytes(text)
    images: dict[str, Any] = {"output_format": "images", "image_format": "png"}
    return RenderCameraPath(config, folder / "views", camera_path_filename=file, **{**images, **options})


@pytest.mark.hard_case(
    "`ns-render camera-path` with a path that is missing, empty, cut off, of another program, not UTF-8, without "
    "cameras, of 0 seconds or of 0 px, of a fisheye or 360°",
    "one sentence",
)
@pytest.mark.parametrize("run", [1], indirect=True)
@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            None,
            r"\S+/path\.json cannot be read \(No such file or directory\): give --camera-path-filename the file of ",
        ),
        (
            "",
            r"The file that --camera-path-filename names is no camera path \(Expecting value: line 1 .*\): give a file",
        ),
        (
            '{"seconds": 1',
            r"The file that --camera-path-filename names is no camera path \(Expecting .*\): give a file",
        ),
        (
            b"\xff\xfe",
            r"The file that --camera-path-filename names is no camera path \('utf-8' codec .*\): give a file",
        ),
        ("[]", r"The file that --camera-path-filename names is no camera path \(list indices .*\): give a file that"),
        (
            "{}",
            r"The file that --camera-path-filename names is no camera path, because it lacks 'seconds': give a file",
        ),
        (json.dumps(PATH | {"camera_path": []}), r"The file that --camera-path-filename names has no cameras: add key"),
        (
            json.dumps(PATH | {"camera_path": [{"camera_to_world": [1.0], "fov": 50}]}),
            r"The file that --camera-path-filename names has a value that cannot be read \(shape .*\): save the path",
        ),
        (
            json.dumps(PATH | {"camera_path": [{"camera_to_world": 16 * [1.0]}]}),
            r"The file that --camera-path-filename names is no camera path, because it lacks 'fov': give a file that ",
        ),
        (
            json.dumps(PATH | {"crop": {"crop_center": [0, 0, 0]}}),
            r"The file that --camera-path-filename names is no camera path, because it lacks 'crop_bg_color': give a ",
        ),
        (
            json.dumps(PATH | {"seconds": 0}),
            r"The camera path lasts 0 seconds: give it a longer duration in the viewer",
        ),
        *(
            (
                json.dumps(PATH | {"camera_type": kind}),
                r"Camera 0 of the path is \w+, which sadgs cannot draw: choose the camera type Perspective in",
            )
            for kind in ("fisheye", "equirectangular")
        ),
        (
            json.dumps(PATH | {"render_height": 0}),
            r"Camera 0 has 48 × 0 px: give it, or its path, a larger size\.",
        ),
    ],
)
def test_a_camera_path_that_cannot_be_drawn_is_one_sentence(
    text: str | bytes | None, sentence: str, run: tuple[int, Path], tmp_path: Path
):
    said = said_of(path_command(run[1], tmp_path, text))
    assert said is not None, said
    assert re.match(sentence, said), said


@pytest.mark.hard_case("`ns-render` with `rgba`", "PNGs without the background; one sentence for JPEG")
@pytest.mark.hard_case("a camera path with a crop box and a background colour", "drawn on its colour")
@pytest.mark.hard_case("`ns-render … --render-nearest-camera`", "one sentence")
@pytest.mark.parametrize("run", [1], indirect=True)
def test_opacity_and_the_colour_of_a_crop_are_drawn(run: tuple[int, Path], tmp_path: Path):
    path_command(run[1], tmp_path, json.dumps(PATH), rendered_output_names=["rgba"]).main()
    path_command(run[1], tmp_path / "views", json.dumps(PATH)).main()
    with Image.open(tmp_path / "views/00000.png") as image:
        rgba = np.asarray(image) / 255
    with Image.open(tmp_path / "views/views/00000.png") as image:
        rgb = np.asarray(image) / 255
    alpha = rgba[..., 3:]
    assert rgba.shape == (36, 48, 4)
    assert alpha.min() < 1 < 48 * 36 * alpha.mean()
    assert np.abs(alpha * rgba[..., :3] - rgb).max() < 0.02  # The model's background is black.
    path_command(run[1], tmp_path, json.dumps(PATH | {"crop": CROP})).main()
    with Image.open(tmp_path / "views/00000.png") as image:
        assert (np.asarray(image) >= [254, 0, 0]).all()
        assert (np.asarray(image)[..., 1:] <= 1).mean() > 0.9
    for options in ({"image_format": "jpeg"}, {"rendered_output_names": ["rgb", "rgba"]}):
        said = said_of(
            path_command(run[1], tmp_path, json.dumps(PATH), **{"rendered_output_names": ["rgba"], **options})
        )
        assert said is not None
        assert said.startswith("`rgba` fits into PNG alone, and beside no other output: give --ren")
    said = said_of(path_command(run[1], tmp_path, json.dumps(PATH), render_nearest_camera=True))
    assert said is not None
    assert said.startswith("--render-nearest-camera does not work with methods that train on whole")


@pytest.mark.hard_case("`ns-render dataset` of images `a/000.png` and `b/000.png`", "a file for each, in its folder")
@pytest.mark.hard_case("`ns-render dataset` of images `000.png` and `000.jpg`", "refused before rendering")
@pytest.mark.parametrize("names", [("a/000.png", "b/000.png"), ("000.png", "000.jpg")])
def test_no_rendering_replaces_another(names: tuple[str, str], tmp_path: Path):
    data = tmp_path / "data"
    parser: Any = nerfstudio_data(data)
    parser.eval_mode = "all"
    described = read_json(data / "transforms.json")
    for frame, name in zip(described["frames"], names, strict=False):
        (data / "images" / name).parent.mkdir(exist_ok=True)
        with Image.open(data / frame["file_path"]) as image:
            image.load()
        frame["file_path"] = f"images/{name}"
        image.save(data / frame["file_path"])
    write_json(data / "transforms.json", described)
    file = write_config(train(short_run(tmp_path / "out", parser, iterations=1)).config)
    command = DatasetRender(load_config=file, output_path=tmp_path / "views", rendered_output_names=["rgb"])
    if names[0].startswith("a"):
        command.main()
        written = [path.relative_to(tmp_path / "views/test/rgb") for path in (tmp_path / "views").rglob("*.jpg")]
        assert len(written) == VIEWS
        assert {Path("a/000.jpg"), Path("b/000.jpg")} <= {*written}
    else:
        with refusal(r"/000\.(jpg|png) and \S+/000\.(jpg|png) differ in their suffix alone"):
            command.main()
        assert not (tmp_path / "views").exists()


@pytest.mark.hard_case(
    "`ns-export pointcloud`, `poisson`, `tsdf` and `marching-cubes`; `cameras` of a COLMAP capture",
    "one sentence, which names `sadgs-export … .mesh.ply`, where a traceback was; the cameras' poses",
)
@pytest.mark.usefixtures("open3d")
@pytest.mark.parametrize("run", [1], indirect=True)
def test_exports_of_fields_name_the_one_of_splats(run: tuple[int, Path], tmp_path: Path):
    from nerfstudio.scripts import exporter

    for command in (
        exporter.ExportPointCloud(run[1], tmp_path),
        exporter.ExportPointCloud(run[1], tmp_path, normal_method="open3d"),
        exporter.ExportPoissonMesh(run[1], tmp_path),
        exporter.ExportTSDFMesh(run[1], tmp_path),
        exporter.ExportMarchingCubesMesh(run[1], tmp_path),
    ):
        said = said_of(command)
        assert said is not None, command
        assert "`sadgs-export RUN --output room.mesh.ply` writes a mesh" in said, command
    exporter.ExportCameraPoses(run[1], tmp_path).main()
    counts = [len(read_json(tmp_path / f"transforms_{part}.json")) for part in ("train", "eval")]
    assert counts == [9, 1]


@pytest.mark.hard_case(
    "`ns-eval` or `ns-render` with a config.yml that is missing or none; `ns-eval --output-path x.txt`", "one sentence"
)
def test_files_that_are_no_config_or_result_are_named(run: tuple[int, Path], tmp_path: Path):
    none = tmp_path / "none.yml"
    said = said_of(ComputePSNR(none))
    assert said is not None
    assert said.startswith(f"{none} cannot be read (No such file or directory): give --load-config the config.yml of a")
    none.write_text("hello")
    assert said_of(ComputePSNR(none)) == "The file that --load-config names is no config.yml of a run: give it one."
    actual = said_of(ComputePSNR(run[1], tmp_path / "results.txt"))
    assert actual == ("--output-path must end with .json: give the file of results another name.")


@pytest.mark.hard_case(
    "`ns-eval` or `ns-viewer` of a run whose capture is not where its `config.yml` says, as from another folder",
    "one sentence: change to the folder of training, or correct the path",
)
@pytest.mark.parametrize("run", [1], indirect=True)
@pytest.mark.parametrize(
    ("folder", "remedy"),
    [
        ("scene", "change to the folder in which training was started with `cd`, or correct scene in config.yml."),
        ("/no/scene", "put it there, or correct /no/scene in the run's config.yml."),
    ],
)
def test_a_run_from_another_folder_says_where_its_capture_was(
    folder: str, remedy: str, run: tuple[int, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    moved = Path(shutil.copytree(run[1].parent, tmp_path / "run")) / "config.yml"
    config = yaml.load(moved.read_text(), Loader=yaml.Loader)
    config.pipeline.datamanager.data = config.pipeline.datamanager.dataparser.data = Path(folder)
    config.output_dir = tmp_path
    moved.write_text(yaml.dump(config))
    monkeypatch.chdir(tmp_path)
    for command in (ComputePSNR(moved), path_command(moved, tmp_path, json.dumps(PATH))):
        assert said_of(command) == f"{Path(folder).absolute()}, on which the run was trained, is not there: {remedy}"


@pytest.mark.hard_case(
    "`ns-eval`, `ns-render` or `ns-viewer` of a run whose latest checkpoint is cut off", "one sentence"
)
@pytest.mark.parametrize("size", [0, 5000, 20_000])
def test_a_damaged_checkpoint_is_named(size: int, run: tuple[int, Path]):
    (checkpoint,) = run[1].parent.glob("nerfstudio_models/*.ckpt")
    damaged = checkpoint.with_name("step-000000009.ckpt")
    damaged.write_bytes(checkpoint.read_bytes()[:size])
    said = said_of(ComputePSNR(run[1]))
    damaged.unlink()
    assert said is not None
    assert said.startswith("The latest checkpoint in the run's folder nerfstudio_models cannot be")


@pytest.mark.hard_case("`--vis wandb` or `--vis comet` without a login", "one sentence")
def test_a_logger_that_cannot_start_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    def init(**options: Any) -> None:
        raise RuntimeError("No API key configured.")

    monkeypatch.setitem(sys.modules, "wandb", types.SimpleNamespace(init=init))
    with pytest.raises(RuntimeError) as failed:
        writer.setup_event_writer(True, False, False, log_dir=tmp_path, experiment_name="test")
    actual = errors.sentence_of(failed.value)
    assert actual == (
        "The logger that --vis names could not start (No API key configured): log in to its service, or choose another "
        "--vis."
    )


def test_errors_that_are_nobody_s_keep_their_traceback():
    with pytest.raises(ValueError) as failed:
        int("seven")
    assert errors.sentence_of(failed.value) is None


@pytest.mark.hard_case("a deleted working directory, our commands", "one sentence")
@pytest.mark.skipif(sys.platform == "win32", reason="Windows deletes no folder that a process works in")
def test_a_deleted_working_directory_is_named_before_torch_ends_the_process(tmp_path: Path):
    gone = tmp_path / "gone"
    gone.mkdir()
    code = f"import os; os.chdir({str(gone)!r}); os.rmdir({str(gone)!r}); import sadgs_ns.cli.doctor"
    path = {"PYTHONPATH": os.pathsep.join(sys.path)}
    result = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=HANGS,
        env={**os.environ, **path},
    )
    said = "error: The working directory was deleted: change to a folder that exists with `cd`.\n"
    assert result.returncode == 1
    assert result.stderr == said


@pytest.mark.hard_case("the working directory is deleted while a run saves, and the disk is full there", "one sentence")
@pytest.mark.skipif(sys.platform == "win32", reason="Windows deletes no folder that a process works in")
def test_free_space_is_told_in_a_deleted_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert errors.free_space(Path("outputs/scene")).endswith(" GB")
