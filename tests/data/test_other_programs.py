"""`transforms.json` and Blender scenes as other programs write them, read with the cameras that they mean."""

from __future__ import annotations

import itertools
import math
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import tyro
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image
from torch.testing import assert_close

from helpers import forked_python
from helpers.json_files import read_json, write_json
from helpers.short_runs import blender_data, nerfstudio_data
from helpers.small_scenes import HEIGHT, WIDTH
from sadgs_ns.data.checks import check_data
from sadgs_ns.data.checks.layouts import poses_elsewhere
from sadgs_ns.data.run_cameras import read_cameras
from sadgs_ns.data.transforms_parser import TransformsParser

# nerfstudio opens an image, to look for smaller copies of it, and leaves it open.
pytestmark = pytest.mark.filterwarnings(
    "ignore:Exception ignored in. <_io.FileIO:pytest.PytestUnraisableExceptionWarning"
)

PINHOLE = ("fl_x", "fl_y", "cx", "cy", "w", "h")
FOCAL = 0.8 * WIDTH
ANGLES = {"camera_angle_x": 2 * math.atan(0.5 / 0.8), "camera_angle_y": 2 * math.atan(0.5 * HEIGHT / FOCAL)}


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset as ns-process-data writes it, with all values in the frames, and one as Blender does."""
    folder = tmp_path_factory.mktemp("captures")
    nerfstudio_data(folder / "transforms")
    blender_data(folder / "blender", "white")
    return folder


@pytest.fixture
def write(captures: Path, tmp_path: Path) -> Callable[..., Path]:
    """Copies a dataset, with a function called with the content of each JSON file and with each of its frames."""

    def change(
        of_file: Callable[[dict[str, Any]], Any] = dict,
        of_frame: Callable[[dict[str, Any]], Any] = dict,
        kind: str = "",
    ) -> Path:
        data = Path(shutil.copytree(captures / (kind or "transforms"), tmp_path / "data"))
        for path in data.glob("transforms*.json"):
            meta = read_json(path)
            of_file(meta)
            for frame in meta["frames"]:
                of_frame(frame)
            write_json(path, meta)
        return data

    return change


def errors(data: Path) -> list[str]:
    return [finding.sentence for finding in check_data(data) if finding.severity == "error"]


def parsed(data: Path) -> Any:
    return (
        TransformsParser(NerfstudioDataParserConfig(data=data, downscale_factor=1))
        .get_dataparser_outputs("train")
        .cameras
    )


def expect_the_same_cameras(data: Path, original: Path) -> None:
    """What is read is what the original means, and nothing in the folder has changed."""
    files = {path: path.read_bytes() for path in data.rglob("*") if path.is_file()}
    assert errors(data) == []
    found = read_cameras(data / "no run", data)
    expected = read_cameras(data / "no run", original)
    assert_close(found.camera_to_worlds, expected.camera_to_worlds)
    assert_close(found.Ks, expected.Ks, rtol=1e-5, atol=1e-4)
    assert found.sizes == expected.sizes
    assert files == {path: path.read_bytes() for path in data.rglob("*") if path.is_file()}


def without(*names: str) -> Callable[[dict[str, Any]], Any]:
    return lambda frame: [frame.pop(name) for name in names]


def with_other_names(change: Callable[[str], str]) -> Callable[[dict[str, Any]], None]:
    return lambda frame: frame.update(file_path=change(frame["file_path"]))


@pytest.mark.hard_case(
    "a `transforms.json` with the file's intrinsics beside other ones of its frames; with an angle of view alone; with "
    "names of images that lack their suffix or have backslashes",
    "read as the programs that write it mean it; the frames' values were left out, and the others refused",
)
@pytest.mark.parametrize(
    "change",
    {
        "values of frames beside other ones of the file": (lambda m: m.update(fl_x=9.0, fl_y=5.0, cx=1.0, w=7, h=7),),
        "an angle alone": (lambda m: m.update(camera_angle_x=ANGLES["camera_angle_x"]), without(*PINHOLE)),
        "two angles and sizes": (lambda m: m.update(ANGLES, w=WIDTH, h=HEIGHT), without(*PINHOLE)),
        "an angle in each frame": (dict, lambda f: [without(*PINHOLE)(f), f.update(ANGLES)]),
        "an angle in each frame beside the file's focal length": (
            lambda m: m.update(fl_x=9.0, fl_y=5.0),
            lambda f: [without("fl_x", "fl_y")(f), f.update(camera_angle_x=ANGLES["camera_angle_x"])],
        ),
        "one focal length": (dict, without("fl_y", "cx", "cy", "w", "h")),
        "names without suffix": (dict, with_other_names(lambda name: name.removesuffix(".png"))),
        "backslashes": (dict, with_other_names(lambda name: name.replace("/", "\\"))),
    }.values(),
)
def test_a_transforms_json_is_read_as_its_program_means_it(
    change: tuple[Any, ...], write: Callable[..., Path], captures: Path
):
    expect_the_same_cameras(write(*change), captures / "transforms")


@pytest.mark.hard_case("lenses and camera models in frames; `is_fisheye`", "read; mixed ones are refused")
def test_lenses_and_models_of_frames_count(write: Callable[..., Path]):
    data = write(lambda m: m.update(k1=0.5, p1=0.1), lambda f: f.update(k1=0.01, k2=0.02))
    actual = parsed(data).distortion_params
    expected = torch.tensor([0.01, 0.02, 0, 0, 0, 0]).expand(9, 6)
    assert_close(actual, expected)
    shutil.rmtree(data)
    data = write(lambda m: m.update(is_fisheye=True, k1=0.01))
    assert errors(data) == []
    actual = set(parsed(data).camera_type.flatten().tolist())
    assert actual == {CameraType.FISHEYE.value}
    shutil.rmtree(data)
    data = write(lambda m: m.pop("camera_model"), lambda f: f.update(camera_model="OPENCV_FISHEYE", k1=0.01))
    assert errors(data) == []
    actual = set(parsed(data).camera_type.flatten().tolist())
    assert actual == {CameraType.FISHEYE.value}
    shutil.rmtree(data)
    (said,) = errors(write(lambda m: m["frames"][3].update(camera_model="OPENCV_FISHEYE")))
    assert said.endswith("mixes the camera models OPENCV and OPENCV_FISHEYE: keep the frames of one of them.")


@pytest.mark.hard_case("a `mask_path` with backslashes, as of Windows, or without a suffix", "read")
@pytest.mark.parametrize("name", [r"masks\0.png", "masks/0"])
def test_names_of_masks_are_mended_as_those_of_images(name: str, write: Callable[..., Path]):
    data = write(of_frame=lambda frame: frame.update(mask_path=name))
    (data / "masks").mkdir()
    Image.new("L", (WIDTH, HEIGHT), 255).save(data / "masks/0.png")
    (told,) = [finding.sentence for finding in check_data(data) if finding.sentence.endswith(" masks.")]
    assert re.search(r" with (\d+) masks\.$", told)
    config = NerfstudioDataParserConfig(data=data)
    config._target = TransformsParser
    assert {*config.setup().get_dataparser_outputs().mask_filenames} == {data / "masks/0.png"}


@pytest.mark.hard_case(
    "a folder `masks`, or a PLY, beside a `transforms.json` that names neither",
    "a warning: name them there; they were left out in silence",
)
@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("masks/000.png", "holds masks that are not used, as {path} names none: name each as mask_path of its frame"),
        ("sparse_pc.ply", "training will start from random points, not from {file}, unless you name it there."),
    ],
)
def test_what_lies_beside_a_transforms_json_unnamed_is_told(name: str, told: str, write: Callable[..., Path]):
    data = write()
    (data / name).parent.mkdir(exist_ok=True)
    (data / name).touch()
    (warning,) = [finding.sentence for finding in check_data(data) if finding.severity == "warning"]
    assert told.format(path=data / "transforms.json", file=data / name) in warning


@pytest.mark.hard_case(
    "a `transforms.json`, or a Blender scene of D-NeRF, whose frames have a `time`",
    "trains as one moment, with a warning, unless the times are equal",
)
@pytest.mark.parametrize(("kind", "file"), [("transforms", "transforms.json"), ("blender", "transforms_train.json")])
def test_a_scene_that_moves_is_told(kind: str, file: str, write: Callable[..., Path]):
    times = itertools.count()
    data = write(of_frame=lambda frame: frame.update(time=next(times) / 10), kind=kind)
    (warning,) = [finding.sentence for finding in check_data(data) if finding.severity == "warning"]
    assert warning.startswith(f"{data}/{file} gives each frame a time, as of a scene that moves, and ")
    shutil.rmtree(data)
    data = write(of_frame=lambda frame: frame.update(time=0.5), kind=kind)
    actual = [finding for finding in check_data(data) if finding.severity == "warning"]
    assert actual == []


@pytest.mark.hard_case(
    "a Blender scene with the training views' file alone, as BlenderNeRF may write it",
    "refused: rename it to `transforms.json`, which trains",
)
def test_a_blender_scene_of_training_views_alone_is_read_of_a_transforms_json(write: Callable[..., Path]):
    data = write(kind="blender")
    for split in ("val", "test"):
        (data / f"transforms_{split}.json").unlink()
    assert errors(data) == [
        f"{data}/transforms_val.json does not exist, nor a transforms_test.json: rename transforms_train.json to "
        "transforms.json, and some views are held out."
    ]
    (data / "transforms_train.json").rename(data / "transforms.json")
    assert errors(data) == []


@pytest.mark.hard_case(
    "a Blender scene whose names end in .png, or without a file of validation", "read; the names became `.png.png`"
)
def test_a_blender_scene_is_read_with_and_without_suffixes(write: Callable[..., Path], captures: Path):
    data = write(of_frame=with_other_names(lambda name: f"{name}.png"), kind="blender")
    (data / "transforms_val.json").unlink()
    expect_the_same_cameras(data, captures / "blender")


@pytest.mark.hard_case(
    "a Blender scene with a principal point, a lens or JPEGs, which its parser does not read",
    "refused: rename the file to `transforms.json`, of which all is read",
)
def test_what_is_not_read_of_a_blender_scene_is_read_of_a_transforms_json(write: Callable[..., Path]):
    data = write(lambda m: m.update(cx=20.0, k1=0.001), kind="blender")
    (said,) = errors(data)
    assert said.endswith("transforms_train.json: of Blender scenes cx is not read; rename it to transforms.json.")
    (data / "transforms_train.json").rename(data / "transforms.json")
    assert errors(data) == []
    cameras = parsed(data)
    expected = torch.full_like(cameras.fx, FOCAL)
    assert_close(cameras.fx, expected)
    actual = set(cameras.cx.flatten().tolist())
    assert actual == {20.0}
    assert (cameras.distortion_params[:, 0] > 0).all()


@pytest.mark.hard_case(
    "a Blender scene whose files have focal lengths instead of angles of view",
    "refused once: renamed to transforms.json, it trains",
)
@pytest.mark.parametrize("in_frames", [False, True])
def test_focal_lengths_in_a_blender_scene_are_refused_before_missing_angles(
    in_frames: bool, write: Callable[..., Path]
):
    def of_file(meta: dict[str, Any]) -> None:
        del meta["camera_angle_x"]
        if not in_frames:
            meta["fl_x"] = FOCAL

    def of_frame(frame: dict[str, Any]) -> None:
        if in_frames:
            frame["fl_x"] = FOCAL

    data = write(of_file, of_frame, kind="blender")
    (said,) = errors(data)
    assert said == f"{data}/transforms_train.json: of Blender scenes fl_x is not read; rename it to transforms.json."
    (data / "transforms_train.json").rename(data / "transforms.json")
    assert errors(data) == []


@pytest.mark.hard_case(
    "an image that is there with another suffix, in other case, or in another folder than a `transforms.json` (also of "
    "Windows) or a Blender scene says",
    "refused: the sentence names the file that is there",
)
@pytest.mark.parametrize("name", ["images/a.jpg", "/home/me/scene/a.jpg", "A.png", r"C:\scene\images\A.png"])
def test_an_image_elsewhere_is_named(name: str, write: Callable[..., Path]):
    data = write(lambda m: m["frames"][0].update(file_path=name))
    (data / "images/000.png").rename(data / "images/A.png")
    (said,) = errors(data)
    assert said == (
        f"{data / name} does not exist, but {data / 'images/A.png'} does: correct the name, or save that as this."
    )


def test_an_image_saved_as_the_name_says_is_read(write: Callable[..., Path]):
    data = write(kind="blender")
    image = data / "images/005.png"
    Image.open(image).convert("RGB").save(image.with_suffix(".jpg"))
    image.unlink()
    (said,) = errors(data)
    assert said.startswith(f"{image} does not exist, but {image.with_suffix('.jpg')} does: ")
    Image.open(image.with_suffix(".jpg")).save(image)
    assert errors(data) == []


@pytest.mark.hard_case(
    "exports of Metashape (cameras, project), RealityCapture (CSV, XMP), ODM, Polycam and Record3D",
    "the `ns-process-data` command that keeps their poses is named, also where new ones are computed",
)
@pytest.mark.parametrize(
    ("file", "content", "photos", "kind", "options"),
    [
        ("cameras.xml", "<document><chunk>", "photos", "ProcessMetashape", {"xml": "cameras.xml"}),
        ("house.psx", "", "", "ProcessMetashape", {"xml": "EXPORTED.xml"}),
        ("poses.csv", "#name,x,y,alt\n", "", "ProcessRealityCapture", {"csv": "poses.csv"}),
        ("1.xmp", "<xcr:Rotation>", "", "ProcessRealityCapture", {"csv": "EXPORTED.csv"}),
        ("odm_report/shots.geojson", "{}", "images", "ProcessODM", {}),
        ("keyframes/cameras/1.json", "{}", "keyframes/images", "ProcessPolycam", {}),
        ("metadata.json", '{"poses": []}', "rgb", "ProcessRecord3D", {}),
    ],
)
@pytest.mark.usefixtures("open3d")
def test_the_command_that_keeps_an_export_s_poses_is_named(
    file: str, content: str, photos: str, kind: str, options: dict[str, str], tmp_path: Path
):
    from nerfstudio.scripts import process_data

    data = tmp_path / "my export"
    for path in (data / file, data / photos / "1.jpg", data / "keyframes/depth/1.png"):
        path.parent.mkdir(parents=True, exist_ok=True)
    (data / file).write_text(content)
    Image.new("RGB", (8, 8)).save(data / photos / "1.jpg")
    (said,) = errors(data)
    named = re.search("`ns-process-data ([^`]*)`", said)
    assert said.startswith(f"{data / file} has poses: `ns-process-data ")
    assert named
    words = shlex.split(named[1].replace("FOLDER", str(tmp_path / "out")))
    commands: Any = process_data.Commands
    command = tyro.cli(commands, args=words)
    assert type(command).__name__ == kind
    assert command.output_dir == tmp_path / "out"
    assert command.data == (data / photos if options else data)
    for name, value in options.items():
        assert getattr(command, name).name == value
    assert poses_elsewhere(data) == said
    assert poses_elsewhere(tmp_path / "out") is None


@pytest.mark.hard_case(
    "a capture of Polycam without LiDAR", "the command makes the folder of depth that `ns-process-data` asks for"
)
def test_a_capture_of_polycam_without_depth_is_converted_with_its_poses(tmp_path: Path):
    """In a process of its own, nerfstudio's script needs neither Open3D nor FFmpeg, which a machine may lack."""
    data = tmp_path / "my capture"
    pose = {f"t_{row}{column}": float(row == column) for row in range(3) for column in range(4)}
    camera = {"fx": 90.0, "fy": 90.0, "cx": 50.0, "cy": 40.0, "width": 100, "height": 80, "blur_score": 99.0}
    for name in ("keyframes/images/1.jpg", "keyframes/cameras/1.json"):
        (data / name).parent.mkdir(parents=True)
    Image.new("RGB", (100, 80)).save(data / "keyframes/images/1.jpg")
    write_json(data / "keyframes/cameras/1.json", pose | camera)
    (said,) = errors(data)
    converting = f"ns-process-data polycam --data '{data}' --output-dir FOLDER"
    making = f"mkdir '{data}'/keyframes/depth"
    assert said == f"{data}/keyframes/cameras/1.json has poses: `{making} && {converting}` keeps them."
    code = f"""
import sys
from pathlib import Path
from unittest.mock import MagicMock
sys.modules["open3d"] = MagicMock()
from nerfstudio.process_data import process_data_utils
from nerfstudio.scripts.process_data import ProcessPolycam
process_data_utils.copy_images_list = lambda images, image_dir, **others: [image_dir / image.name for image in images]
ProcessPolycam(data=Path({str(data)!r}), output_dir=Path({str(tmp_path / "out")!r})).main()
"""
    assert "Depth map directory" in forked_python.python(code).stderr
    subprocess.run(making, shell=True, check=True)
    assert forked_python.python(code).returncode == 0
    (frame,) = read_json(tmp_path / "out/transforms.json")["frames"]
    assert frame["fl_x"] == 90
    assert errors(data) == [f"{data}/keyframes/cameras/1.json has poses: `{converting}` keeps them."]


@pytest.mark.hard_case("poses of LLFF (`poses_bounds.npy`) or in a `capture.json`", "the file is named: it is not read")
@pytest.mark.parametrize("name", ["poses_bounds.npy", "capture.json"])
def test_poses_in_a_format_that_is_not_read_are_named(name: str, captures: Path, tmp_path: Path):
    shutil.copytree(captures / "transforms/images", tmp_path / "images")
    (tmp_path / name).touch()
    computing = f"`sadgs-process {tmp_path}/images FOLDER` computes others"
    problem = f"{tmp_path / name} may have poses, but in a format that is not read"
    said = f"{problem}: write them to a transforms.json to keep them; {computing}."
    assert errors(tmp_path) == [said] == [poses_elsewhere(tmp_path)]


@pytest.mark.hard_case(
    "poses of OpenSfM, Meshroom or Bundler",
    "the command that makes a COLMAP model of them is named, which is then read",
)
@pytest.mark.parametrize(
    ("file", "content", "command"),
    [
        (
            "reconstruction.json",
            '[{"shots": {}}]',
            "opensfm export_colmap {data} && mv {data}/colmap_export {data}/sparse",
        ),
        ("cameras.sfm", '{"poses": []}', "aliceVision_exportColmap --input {file} --output FOLDER --copyImages true"),
        ("sfm.json", '{"poses": []}', "aliceVision_exportColmap --input {file} --output FOLDER --copyImages true"),
        (
            "bundle.out",
            "# Bundle file v0.3\n",
            "kapture_import_bundler.py -i {file} -l LIST.txt -im {data}/images --add-reconstruction -o KAPTURE && "
            "kapture_export_colmap.py -i KAPTURE -db KAPTURE/colmap.db -txt {data}/sparse",
        ),
    ],
)
def test_the_command_that_makes_a_colmap_model_of_other_poses_is_named(
    file: str, content: str, command: str, captures: Path, tmp_path: Path
):
    shutil.copytree(captures / "transforms/images", tmp_path / "images")
    (tmp_path / file).write_text("")
    assert poses_elsewhere(tmp_path) is None
    (tmp_path / file).write_text(content)
    named = command.format(data=tmp_path, file=tmp_path / file)
    assert errors(tmp_path) == [f"{tmp_path / file} has poses: `{named}` keeps them."] == [poses_elsewhere(tmp_path)]
