"""Bad input: one sentence that names file and remedy, in training as in `sadgs-doctor`, and nothing left over."""

from __future__ import annotations

import json
import os
import re
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.utils import colmap_parsing_utils
from nerfstudio.engine.trainer import Trainer
from PIL import Image, ImageFile
from test_nerfstudio import (
    HEIGHT,
    WIDTH,
    blender_data,
    checkpoint,
    configure,
    differences,
    is_finite,
    nerfstudio_data,
    set_up,
    train,
)

from sadgs_ns import checks, colmap, doctor, presets
from sadgs_ns.demo.scene import SPARSE_FOLDER, write_scene
from sadgs_ns.errors import InputError, RunError, WriteError
from sadgs_ns.export import write_ply
from sadgs_ns.trainer import SadgsTrainer, SadgsTrainerConfig

CHECKOUT = Path(__file__).parents[1]
PLY = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good dataset in each layout, to be copied."""
    folder = tmp_path_factory.mktemp("captures")
    write_scene(folder / "colmap", WIDTH, HEIGHT, 10, 60)
    nerfstudio_data(folder / "nerfstudio")
    blender_data(folder / "blender", "white")
    return folder


def parser_of(data: Path) -> DataParserConfig:
    """The parser for a copy of one of the captures, which keeps its name."""
    if data.name == "nerfstudio":
        return NerfstudioDataParserConfig(data=data, load_3D_points=True, downscale_factor=1)
    if data.name == "blender":
        return BlenderDataParserConfig(data=data)
    return ColmapDataParserConfig(data=data, colmap_path=SPARSE_FOLDER, downscale_factor=1)


# --- ways to spoil a capture ---


def overwrite(name: str, content: bytes | str) -> Callable[[Path], Any]:
    return lambda data: (data / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def remove(name: str) -> Callable[[Path], None]:
    return lambda data: shutil.rmtree(data / name) if (data / name).is_dir() else (data / name).unlink()


def cut(name: str, keep: float) -> Callable[[Path], None]:
    """Keep this part of a file."""

    def spoil(data: Path) -> None:
        content = (data / name).read_bytes()
        (data / name).write_bytes(content[: int(keep * len(content))])

    return spoil


def patch(name: str, offset: int, layout: str, value: Any) -> Callable[[Path], None]:
    """Overwrite a number in a binary file."""

    def spoil(data: Path) -> None:
        content = bytearray((data / name).read_bytes())
        struct.pack_into(layout, content, offset, value)
        (data / name).write_bytes(content)

    return spoil


def picture(name: str, size: tuple[int, int] = (WIDTH, HEIGHT), mode: str = "RGB") -> Callable[[Path], None]:
    return lambda data: Image.new(mode, size).save(data / name)


def meta(change: Callable[[dict[str, Any]], Any], name: str = "transforms.json") -> Callable[[Path], None]:
    """Change a transforms.json."""

    def spoil(data: Path) -> None:
        content = json.loads((data / name).read_text())
        change(content)
        (data / name).write_text(json.dumps(content))

    return spoil


def model(change: Callable[[dict, dict, dict], Any], ext: str = ".bin") -> Callable[[Path], None]:
    """Change cameras, images and points of a COLMAP model, and write it with nerfstudio's code."""

    def spoil(data: Path) -> None:
        folder = data / SPARSE_FOLDER
        parts = colmap_parsing_utils.read_model(str(folder), ".bin")
        assert parts is not None
        change(*parts)
        shutil.rmtree(folder)
        folder.mkdir()
        colmap_parsing_utils.write_model(*parts, str(folder), ext)

    return spoil


def set_pose(frame: int, row: int, column: int, value: float) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        content["frames"][frame]["transform_matrix"][row][column] = value

    return change


def in_one_place(content: dict[str, Any]) -> None:
    for frame in content["frames"]:
        for row in range(3):
            frame["transform_matrix"][row][3] = 1.5


def keep(number: int) -> Callable[[dict[str, Any]], None]:
    return lambda content: content.update(frames=content["frames"][:number])


def fisheye(cameras: dict, images: dict, points: dict) -> None:
    cameras[2] = colmap_parsing_utils.Camera(2, "OPENCV_FISHEYE", WIDTH, HEIGHT, np.array([40, 40, 24, 18, 0, 0, 0, 0]))
    images[1] = images[1]._replace(camera_id=2)


def flip_middle_byte(name: str) -> Callable[[Path], None]:
    """Flip a byte in the middle of a PNG's pixels."""

    def spoil(data: Path) -> None:
        content = bytearray((data / name).read_bytes())
        content[len(content) // 2] ^= 0xFF
        (data / name).write_bytes(content)

    return spoil


SPARSE = str(SPARSE_FOLDER)
FIRST = "images/000.png"

CASES = {
    # COLMAP: images
    "image-missing": ("colmap", remove(FIRST), r"\S+/000\.png does not exist: put it there, or leave it out of .*\."),
    "image-empty": ("colmap", overwrite(FIRST, ""), r"\S+/000\.png has 0 bytes: copy it again, or leave .*\."),
    "image-truncated": (
        "colmap",
        cut(FIRST, 0.6),
        r"\S+/000\.png cannot be read as an image \(.+\): copy it again.*\.",
    ),
    "image-corrupt": (
        "colmap",
        flip_middle_byte(FIRST),
        r"\S+/000\.png cannot be read as an image \(.+\): copy it.*\.",
    ),
    "image-not-one": ("colmap", overwrite(FIRST, "hello"), r"\S+/000\.png is no image that Pillow knows: copy it.*\."),
    "image-size": (
        "colmap",
        picture(FIRST, (40, 30)),
        r"\S+/000\.png has 40 × 30 px, but its camera in \S+/images\.bin 48 × 36: use the images that .*\.",
    ),
    "image-mode": ("colmap", picture(FIRST, mode="P"), r"\S+/000\.png has pixels of Pillow's mode P: convert it .*\."),
    # COLMAP: poses
    "no-poses": ("colmap", remove("sparse"), r"\S+ holds 10 images but no camera poses: .*ns-process-data.*\."),
    "no-images": (
        "colmap",
        model(lambda cameras, images, points: images.clear()),
        r"\S+/images\.bin holds no pose, so there is no image to train on: run COLMAP's mapper again\.",
    ),
    "no-image-folder": (
        "colmap",
        remove("images"),
        r"\S+ has poses of 10 images, but there is no folder \S+/images: .*",
    ),
    "nan-pose": (
        "colmap",
        patch(f"{SPARSE}/images.bin", 12, "<d", np.nan),
        r"\S+: image 000\.png has NaN or .* pose.*",
    ),
    "no-rotation": (
        "colmap",
        model(lambda cameras, images, points: images.update({1: images[1]._replace(qvec=np.zeros(4))})),
        r"\S+: image 000\.png has a rotation that is no unit quaternion: run COLMAP's mapper again\.",
    ),
    "camera-unknown": (
        "colmap",
        model(lambda cameras, images, points: images.update({1: images[1]._replace(camera_id=7)})),
        r"\S+: image 000\.png has camera 7, which \S+/cameras\.bin lacks: .*\.",
    ),
    "cameras-mixed-fisheye": ("colmap", model(fisheye), r"\S+/cameras\.bin mixes fisheye and other cameras, .*\."),
    "camera-unsupported": (
        "colmap",
        model(lambda cameras, images, points: cameras.update({1: cameras[1]._replace(model="FOV", params=np.ones(5))})),
        r"\S+: camera 1 has the model FOV, which nerfstudio cannot read: undistort the images with .*\.",
    ),
    "camera-focal": (
        "colmap",
        patch(f"{SPARSE}/cameras.bin", 32, "<d", -5.0),
        r"\S+: camera 1 has focal length x = -5\.0, which must be positive: correct it\.",
    ),
    "one-view": (
        "colmap",
        model(lambda cameras, images, points: [images.pop(i) for i in range(2, 11)]),
        r"\S+ has 1 view, which shows no depth: take at least 2 images, .*\.",
    ),
    # COLMAP: files
    "cameras-truncated": ("colmap", cut(f"{SPARSE}/cameras.bin", 0.5), r"\S+/cameras\.bin is cut off or corrupt \(.*"),
    "cameras-empty": ("colmap", overwrite(f"{SPARSE}/cameras.bin", ""), r"\S+/cameras\.bin is cut off or corrupt \(.*"),
    "cameras-corrupt": (
        "colmap",
        patch(f"{SPARSE}/cameras.bin", 12, "<i", 99),
        r"\S+/cameras\.bin is cut off or corrupt \(camera 1 has the unknown model 99\): copy it again, or .*\.",
    ),
    "images-missing": ("colmap", remove(f"{SPARSE}/images.bin"), r"\S+/images\.bin cannot be read \(No such file.*"),
    "images-truncated": ("colmap", cut(f"{SPARSE}/images.bin", 0.5), r"\S+/images\.bin is cut off or corrupt \(.*"),
    "images-corrupt-count": (
        "colmap",
        patch(f"{SPARSE}/images.bin", 8 + 64 + 8, "<Q", 2**60),  # keypoints of the first image: an exabyte
        r"\S+/images\.bin is cut off or corrupt \(it ends after \d+ bytes, .*\): copy it again, or .*\.",
    ),
    "points-missing": (
        "colmap",
        remove(f"{SPARSE}/points3D.bin"),
        r"\S+ has no points3D\.bin or \.txt: .*random points\.",
    ),
    "points-empty": (
        "colmap",
        model(lambda cameras, images, points: points.clear()),
        r"\S+/points3D\.bin holds no SfM point: .*--load-3D-points False.*\.",
    ),
    "points-truncated": ("colmap", cut(f"{SPARSE}/points3D.bin", 0.9), r"\S+/points3D\.bin is cut off or corrupt \(.*"),
    "points-nan": (
        "colmap",
        model(lambda cameras, images, points: points.update({1: points[1]._replace(xyz=np.full(3, np.nan))})),
        r"\S+/points3D\.bin has NaN or infinity in a point: .*\.",
    ),
    "text-corrupt": (
        "colmap",
        lambda data: (
            model(lambda *parts: None, ".txt")(data),
            overwrite(f"{SPARSE}/images.txt", "1 0.1 zero 0 0 0 0 0 1 000.png\n\n")(data),
        ),
        r"\S+/images\.txt is not COLMAP's text \(.*'zero'.*\): copy it again, or run COLMAP's mapper again\.",
    ),
    # nerfstudio's transforms.json
    "folder-missing": (
        "nerfstudio",
        lambda data: shutil.rmtree(data),
        r"\S+ does not exist: give --data the folder .*",
    ),
    "json-missing": ("nerfstudio", remove("transforms.json"), r"\S+ holds 10 images but no camera poses: .*"),
    "json-corrupt": (
        "nerfstudio",
        cut("transforms.json", 0.5),
        r"\S+/transforms\.json is not readable JSON \(.*line.*\): .*",
    ),
    "json-list": ("nerfstudio", overwrite("transforms.json", "[]"), r"\S+ holds a list instead of an object with .*\."),
    "json-no-frames": (
        "nerfstudio",
        meta(lambda m: m.update(frames=[])),
        r"\S+ lists no frames, so there is no image .*",
    ),
    "json-nan-pose": (
        "nerfstudio",
        meta(set_pose(3, 0, 0, np.nan)),
        r"\S+: frame images/003\.png has NaN or infinity.*",
    ),
    "json-short-pose": (
        "nerfstudio",
        meta(lambda m: m["frames"][2].update(transform_matrix=[[1, 0, 0, 0]])),
        r"\S+: frame images/002\.png has no pose of 4 × 4 numbers: .*\.",
    ),
    "json-no-focal": (
        "nerfstudio",
        meta(lambda m: m["frames"][1].pop("fl_x")),
        r"\S+: frame images/001\.png has no fl_x: .*",
    ),
    "json-camera-model": (
        "nerfstudio",
        meta(lambda m: m.update(camera_model="LENS")),
        r"\S+ has the camera model 'LENS'.*",
    ),
    "json-one-place": (
        "nerfstudio",
        meta(in_one_place),
        r"\S+ has all 10 cameras in one place, which shows no depth: .*",
    ),
    "json-one-view": (
        "nerfstudio",
        meta(keep(1)),
        r"\S+ has 1 view, which shows no depth: take at least 2 images, .*\.",
    ),
    "json-size": (
        "nerfstudio",
        picture(FIRST, (36, 48)),
        r"\S+/000\.png has 36 × 48 px, but its camera in \S+ 48 × 36: .*",
    ),
    "json-image-missing": ("nerfstudio", remove("images/004.png"), r"\S+/images/004\.png does not exist: .*"),
    "json-some-masks": (
        "nerfstudio",
        meta(lambda m: m["frames"][0].update(mask_path="images/001.png")),
        r"\S+ names masks for 1 of 10 frames: give all of them one, or none\.",
    ),
    "json-mask-size": (
        "nerfstudio",
        lambda data: (
            picture("mask.png", (10, 10), "L")(data),
            meta(lambda m: [frame.update(mask_path="mask.png") for frame in m["frames"]])(data),
        ),
        r"\S+/mask\.png \(and 9 more\) is a mask of another size than \S+/000\.png: resize it\.",
    ),
    "ply-missing": (
        "nerfstudio",
        meta(lambda m: m.update(ply_file_path="points.ply")),
        r"\S+/points\.ply should hold the SfM points but cannot be read \(No such file .*\): .*random points\.",
    ),
    "ply-empty": (
        "nerfstudio",
        lambda data: (
            overwrite("p.ply", PLY.format(0))(data),
            meta(lambda m: m.update(ply_file_path="p.ply"))(data),
        ),
        r"\S+/p\.ply should hold the SfM points but is empty: .*\.",
    ),
    "ply-truncated": (
        "nerfstudio",
        lambda data: (
            overwrite("p.ply", PLY.format(3) + "0 0 0\n1 1 1\n")(data),
            meta(lambda m: m.update(ply_file_path="p.ply"))(data),
        ),
        r"\S+/p\.ply should hold the SfM points but is cut off: its header promises 3 points: .*\.",
    ),
    "ply-not-one": (
        "nerfstudio",
        lambda data: meta(lambda m: m.update(ply_file_path=FIRST))(data),
        r"\S+/000\.png should hold the SfM points but is not a PLY file of points: .*\.",
    ),
    # Blender's
    "blender-no-val": (
        "blender",
        remove("transforms_val.json"),
        r"\S+/transforms_val\.json does not exist: restore it.*",
    ),
    "blender-nan": (
        "blender",
        meta(set_pose(0, 1, 3, np.inf), "transforms_train.json"),
        r"\S+: frame \S+ has NaN or inf.*",
    ),
    "blender-size": (
        "blender",
        picture("images/005.png", (40, 30), "RGBA"),
        r"\S+/005\.png has 40 × 30 px, but its .*",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_data_are_refused_in_one_sentence_by_training_and_doctor_alike(
    case: str, captures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    layout, spoil, sentence = CASES[case]
    data = Path(shutil.copytree(captures / layout, tmp_path / layout))
    spoil(data)
    config = configure(tmp_path / "out", parser_of(data))
    with pytest.raises(InputError) as refused:
        config.save_config()  # what ns-train does first
    assert re.fullmatch(sentence, str(refused.value)), str(refused.value)
    assert "\n" not in str(refused.value)
    with pytest.raises(ValueError, match=re.escape(str(refused.value))):
        set_up(config)  # what a program does
    assert not (tmp_path / "out").exists()
    monkeypatch.setattr(doctor, "check_machine", lambda: [])
    capsys.readouterr()
    assert doctor.main([str(data)]) == 1
    assert f"error: {refused.value}" in capsys.readouterr().out


@pytest.mark.parametrize("layout", ["colmap", "nerfstudio", "blender"])
def test_good_data_have_no_error_and_no_warning(layout: str, captures: Path):
    assert [finding for finding in checks.check_data(captures / layout) if finding.severity != "note"] == []


def test_several_problems_of_one_kind_are_one_finding_and_other_kinds_are_counted(captures: Path, tmp_path: Path):
    data = Path(shutil.copytree(captures / "nerfstudio", tmp_path / "nerfstudio"))
    for index in (2, 5, 7):
        (data / f"images/00{index}.png").write_bytes(b"")
    (data / "images/003.png").unlink()
    findings = checks.check_data(data)
    assert len([finding for finding in findings if finding.severity == "error"]) == 2
    with pytest.raises(
        InputError, match=r"002\.png \(and 2 more\) has 0 bytes: .*\(`sadgs-doctor .*` shows 1 more\.\)"
    ):
        checks.refuse(findings, data)


# --- what looks bad and is not ---


def test_a_jpeg_with_bytes_after_its_end_is_good_and_one_cut_off_is_not(captures: Path, tmp_path: Path):
    data = Path(shutil.copytree(captures / "nerfstudio", tmp_path / "nerfstudio"))
    path = data / FIRST  # the name does not matter to Pillow
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)).save(path, "JPEG")
    content = path.read_bytes()
    path.write_bytes(content + b"trailing data of a phone's camera")
    assert [finding for finding in checks.check_data(data) if finding.severity == "error"] == []
    path.write_bytes(content[:-20])
    (finding,) = [finding for finding in checks.check_data(data) if finding.severity == "error"]
    assert "000.png cannot be read as an image (image file is truncated" in finding.sentence


def test_a_png_that_lacks_only_its_last_chunk_is_good_as_it_is_to_nerfstudio(captures: Path, tmp_path: Path):
    data = Path(shutil.copytree(captures / "nerfstudio", tmp_path / "nerfstudio"))
    content = (data / FIRST).read_bytes()
    (data / FIRST).write_bytes(content[:-12])
    assert [finding for finding in checks.check_data(data) if finding.severity == "error"] == []


def test_images_without_poses_beside_others_are_a_warning(captures: Path, tmp_path: Path):
    data = Path(shutil.copytree(captures / "colmap", tmp_path / "colmap"))
    model(lambda cameras, images, points: (images.pop(3), images.pop(5)))(data)
    (finding,) = checks.check_data(data)
    assert finding.severity == "warning"
    assert re.fullmatch(r"\S+/002\.png \(and 1 more\) has no pose in \S+ and is not used: .*\.", finding.sentence)


def test_cameras_of_several_models_and_sizes_train_together(captures: Path, tmp_path: Path):
    data = Path(shutil.copytree(captures / "colmap", tmp_path / "colmap"))

    def second_camera(cameras: dict, images: dict, points: dict) -> None:
        params = np.array([30.0, 20.0, 15.0, 0.01])
        cameras[2] = colmap_parsing_utils.Camera(2, "SIMPLE_RADIAL", 40, 30, params)
        for index in (2, 4, 6):
            images[index] = images[index]._replace(camera_id=2)
            with Image.open(data / "images" / images[index].name) as image:
                smaller = image.resize((40, 30))
            smaller.save(data / "images" / images[index].name)

    model(second_camera)(data)
    assert checks.check_data(data) == []
    config = configure(tmp_path / "out", parser_of(data), iterations=8)
    config.pipeline.views_per_iteration = 2
    trainer = train(config)
    sizes = {tuple(data["image"].shape[:2]) for data in trainer.pipeline.datamanager.cached_train}
    assert len(sizes) >= 2  # undistortion crops the second camera's
    assert is_finite(trainer.pipeline.model)


@pytest.mark.parametrize(("layout", "views", "training"), [("nerfstudio", 2, 2), ("colmap", 2, 1)])
def test_one_or_two_training_views_train_with_a_warning(
    layout: str, views: int, training: int, captures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    data = Path(shutil.copytree(captures / layout, tmp_path / layout))
    if layout == "colmap":
        model(lambda cameras, images, points: [images.pop(index) for index in range(views + 1, 11)])(data)
    else:
        meta(keep(views))(data)
    trainer = train(configure(tmp_path / "out", parser_of(data), iterations=4))
    assert len(trainer.pipeline.datamanager.train_dataset) == training
    assert is_finite(trainer.pipeline.model)
    printed = " ".join(capsys.readouterr().out.split())
    assert f"leaves {training} training view{'s' * (training > 1)}: so few fix no shape; take 20 or more." in printed


# --- what the checks assume of others ---


def test_colmap_s_camera_models_are_those_that_nerfstudio_knows():
    theirs = {i: (m.model_name, m.num_params) for i, m in colmap_parsing_utils.CAMERA_MODEL_IDS.items()}
    assert dict(enumerate(colmap.CAMERA_PARAMETERS.items())) == theirs


def test_colmap_s_text_and_binary_models_read_alike_and_as_nerfstudio_reads_them(captures: Path, tmp_path: Path):
    data = Path(shutil.copytree(captures / "colmap", tmp_path / "colmap"))
    binary = data / SPARSE_FOLDER
    theirs = colmap_parsing_utils.read_model(str(binary), ".bin")
    assert theirs is not None
    text = tmp_path / "text"
    text.mkdir()
    colmap_parsing_utils.write_model(*theirs, str(text), ".txt")
    for folder, ext in ((binary, "bin"), (text, "txt")):
        (camera,) = colmap.read_cameras(folder / f"cameras.{ext}").values()
        assert (camera.model, camera.width, camera.height) == ("PINHOLE", WIDTH, HEIGHT)
        assert camera.params == tuple(theirs[0][1].params)
        for (name, camera_id, pose), image in zip(
            colmap.read_poses(folder / f"images.{ext}"), theirs[1].values(), strict=True
        ):
            assert (name, camera_id) == (image.name, 1)
            assert pose == pytest.approx(np.concatenate([image.qvec, image.tvec]), abs=1e-12)
            rotation = colmap_parsing_utils.qvec2rotmat(image.qvec)
            assert colmap.camera_centre(pose) == pytest.approx(-rotation.T @ image.tvec)
        points = np.array(list(colmap.read_points(folder / f"points3D.{ext}")))
        assert points == pytest.approx(np.array([point.xyz for point in theirs[2].values()]), abs=1e-12)


@pytest.mark.parametrize("factor", [2, 3])
def test_scaled_down_images_are_compared_with_scaled_down_cameras(factor: int, captures: Path, tmp_path: Path):
    data = Path(shutil.copytree(captures / "nerfstudio", tmp_path / "nerfstudio"))
    meta(lambda m: [frame.update(w=47, h=35) for frame in m["frames"]])(data)
    (data / f"images_{factor}").mkdir()
    for path in (data / "images").iterdir():
        Image.new("RGB", (47 // factor, 35 // factor)).save(data / f"images_{factor}" / path.name)
    findings = checks.check_nerfstudio(data, downscale_factor=factor)
    assert [finding for finding in findings if finding.severity == "error"] == []
    parser = NerfstudioDataParserConfig(data=data, load_3D_points=True, downscale_factor=factor)
    train(configure(tmp_path / "out", parser, iterations=1))  # nerfstudio agrees
    (wrong,) = [finding for finding in checks.check_data(data) if finding.severity == "error"]
    assert "has 48 × 36 px, but its camera" in wrong.sentence


def test_two_hundred_photographs_are_not_decoded_and_take_under_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    rng = np.random.default_rng(0)
    data = tmp_path / "photographs"
    (data / "images").mkdir(parents=True)
    image = Image.fromarray(rng.integers(0, 255, (1080, 1920, 3), np.uint8))
    image.save(data / "images/0.jpg", quality=95)
    pose = np.eye(4).tolist()
    frame = {"fl_x": 900, "fl_y": 900, "cx": 960, "cy": 540, "w": 1920, "h": 1080}
    frames = []
    for index in range(200):
        if index:
            os.link(data / "images/0.jpg", data / f"images/{index}.jpg")
        pose[0][3] = index
        frames.append({**frame, "file_path": f"images/{index}.jpg", "transform_matrix": [row[:] for row in pose]})
    (data / "transforms.json").write_text(json.dumps({"frames": frames}))

    def decode(image: Image.Image) -> None:
        raise AssertionError("an image was decoded")

    monkeypatch.setattr(ImageFile.ImageFile, "load", decode)
    start = time.perf_counter()
    findings = checks.check_data(data)
    seconds = time.perf_counter() - start
    assert [finding for finding in findings if finding.severity != "note"] == []
    assert seconds < 1


# --- the command line ---


def test_uncaught_errors_print_one_sentence_and_exit_with_1(tmp_path: Path):
    for kind in ("InputError", "RunError"):
        code = f"from sadgs_ns.errors import {kind}; raise {kind}('Nothing: do something.')"
        result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
        assert (result.returncode, result.stderr) == (1, "error: Nothing: do something.\n")
    for kind, ordinary in ((InputError, ValueError), (RunError, RuntimeError)):
        assert issubclass(kind, ordinary) and str(kind("Nothing.")) == "Nothing."


def test_ns_train_on_bad_data_ends_with_the_sentence_alone(captures: Path, tmp_path: Path):
    data = Path(shutil.copytree(captures / "colmap", tmp_path / "colmap"))
    (data / FIRST).write_bytes(b"")
    command = [str(Path(sys.executable).with_name("ns-train")), "sadgs", "--output-dir", str(tmp_path / "out")]
    command += ["--data", str(data), "--vis", "tensorboard", "colmap", "--colmap-path", SPARSE]
    result = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert result.returncode == 1
    assert "Traceback" not in result.stdout + result.stderr
    assert result.stderr.splitlines()[-1].startswith(f"error: {data / FIRST} has 0 bytes: copy it again, or leave it")
    assert not (tmp_path / "out").exists()


def test_a_preset_with_an_unknown_key_ends_nerfstudio_s_commands_with_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "p.yaml").write_text("description: A preset.\noptimizers: {}\nmax_iterations: 3\n")
    monkeypatch.setattr(presets, "_configs", lambda: tmp_path)
    with pytest.raises(InputError) as refused:
        presets._registered("p")
    assert re.fullmatch(
        rf"{re.escape(str(tmp_path))}/p\.yaml has a mistake: p\.yaml: unknown key 'max_iterations'; known are .*\.",
        str(refused.value),
    )


# --- output ---


def fill_disk(partial: Path) -> None:
    """Let what is written under this temporary name meet a full disk."""
    if not Path("/dev/full").exists():
        pytest.skip("only Linux has /dev/full")
    partial.symlink_to("/dev/full")


@pytest.fixture
def config(captures: Path, tmp_path: Path) -> SadgsTrainerConfig:
    return configure(tmp_path / "out", parser_of(captures / "colmap"), iterations=6)


def test_an_output_folder_that_cannot_be_made_is_named_before_anything_is_written(
    config: SadgsTrainerConfig, tmp_path: Path
):
    (tmp_path / "file").write_text("in the way")
    config.output_dir = tmp_path / "file" / "out"
    with pytest.raises(InputError, match=r"/file/out/\S+/config\.yml could not be written \(Not a directory; .*name "):
        config.save_config()
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_read_only_output_folder_is_named(config: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch):
    def denied(path: Path, *args: Any, **kwargs: Any) -> None:
        raise PermissionError(13, "Permission denied", str(path))  # root, as in containers, may write everywhere

    monkeypatch.setattr(Path, "mkdir", denied)
    with pytest.raises(InputError, match=r"config\.yml could not be written \(Permission denied; .*can be written;"):
        config.save_config()


def test_a_full_disk_leaves_the_previous_checkpoint_and_ends_training_with_one_sentence(config: SadgsTrainerConfig):
    trainer = set_up(config)
    trainer.save_checkpoint(1)
    before = checkpoint(trainer, 1)
    partial = trainer.checkpoint_dir.with_name("nerfstudio_models.partial")
    fill_disk(partial)
    with pytest.raises(
        WriteError, match=r"step-000000002\.ckpt could not be written \(.+ GB free there\): make room or"
    ):
        trainer.save_checkpoint(2)
    fill_disk(partial)
    with pytest.raises(
        RunError, match=r"^\S+/step-000000005\.ckpt could not be written \(.+\): make room or [^\n]+\.$"
    ):
        trainer.train()
    assert [path.name for path in trainer.checkpoint_dir.iterdir()] == ["step-000000001.ckpt"]
    assert differences(checkpoint(trainer, 1), before) == []
    assert list(config.output_dir.rglob("*.partial")) == []


def test_a_logger_s_full_disk_is_one_sentence_and_other_errors_of_reading_are_themselves(config: SadgsTrainerConfig):
    def failing(error: OSError) -> SadgsTrainer:
        trainer = set_up(config)

        def fail(step: int) -> None:
            raise error

        trainer.pipeline.get_train_loss_dict = fail  # type: ignore[assignment]
        return trainer

    with pytest.raises(RunError, match=r"^/x/events could not be written \(No space left on device; [^\n]+\.$"):
        failing(OSError(28, "No space left on device", "/x/events")).train()
    with pytest.raises(OSError, match=r"^broken data stream$"):
        failing(OSError("broken data stream")).train()


def test_a_full_disk_leaves_the_previous_export(tmp_path: Path):
    def write(count: int) -> None:
        parts: dict[str, Any] = {name: torch.zeros(count, 3) for name in ("means", "scales", "features_dc")}
        write_ply(
            tmp_path / "splat.ply",
            **parts,
            quats=torch.ones(count, 4),
            opacities=torch.zeros(count, 1),
            features_rest=torch.zeros(count, 0, 3),
        )

    write(10)
    before = (tmp_path / "splat.ply").read_bytes()
    fill_disk(tmp_path / f".splat.{os.getpid()}.partial.ply")
    with pytest.raises(WriteError, match=r"splat\.ply could not be written \(.+ GB free there\): make room or "):
        write(10_000)
    assert [path.name for path in tmp_path.iterdir()] == ["splat.ply"]
    assert (tmp_path / "splat.ply").read_bytes() == before


# --- checkpoints ---


@pytest.fixture(scope="module")
def saved(captures: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint after a few iterations."""
    output = tmp_path_factory.mktemp("saved")
    trainer = train(configure(output, parser_of(captures / "colmap")))
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
    "other-file": (
        lambda path: path.with_name("notes.txt").write_text("mine"),
        r"\S+/notes\.txt lies among the checkpoints and is none: move it elsewhere\.",
    ),
    "empty-folder": (lambda path: path.unlink(), r"\S+ holds no checkpoint: give --load-dir the folder .*\."),
}


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


def test_a_step_or_file_without_a_checkpoint_is_named(saved: Path, tmp_path: Path):
    with pytest.raises(InputError, match=r"no checkpoint of step 3: give --load-step one of 5\."):
        checks.checkpoint_path(saved.parent, 3, None)
    with pytest.raises(InputError, match=r"\S+/none\.ckpt does not exist: give --load-checkpoint a file"):
        checks.checkpoint_path(None, None, tmp_path / "none.ckpt")
    assert checks.checkpoint_path(saved.parent, None, None) == checks.checkpoint_path(saved.parent, 5, None) == saved
    assert checks.checkpoint_path(None, None, None) is None


# --- the GPU's memory ---

FULL = torch.cuda.OutOfMemoryError(
    "CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has a total capacity of 8 GiB of which 1 MiB is free."
)


def fail_at(trainer: SadgsTrainer, step: int) -> None:
    """Let the memory be full in the forward pass of this iteration."""
    get_loss = trainer.pipeline.get_train_loss_dict

    def full(step_: int | None = None, **kwargs: Any) -> Any:
        number = kwargs.get("step", step_)
        if number == step:
            raise FULL
        return get_loss(number)

    trainer.pipeline.get_train_loss_dict = full  # type: ignore[method-assign]


def test_full_memory_saves_what_was_trained_and_says_what_helps(config: SadgsTrainerConfig, tmp_path: Path):
    trainer = set_up(config)
    fail_at(trainer, 4)
    with pytest.raises(RunError) as stopped:
        trainer.train()
    assert re.fullmatch(
        r"The GPU's memory was full at iteration 4 with \d+ Gaussians \(CUDA out of memory\. Tried to allocate 2\.00 "
        r"GiB\): lower --pipeline\.model\.strategy\.max-gaussians, or take smaller images .*; what was trained is "
        r"saved and goes on with --load-dir \S+/nerfstudio_models\.",
        str(stopped.value),
    )
    state = checkpoint(trainer, 3)
    parameters = {name: value.detach() for name, value in trainer.pipeline.model.gauss_params.items()}
    assert all(torch.equal(state["pipeline"][f"_model.gauss_params.{k}"], v) for k, v in parameters.items())
    config.load_dir, config.output_dir = trainer.checkpoint_dir, tmp_path / "resumed"
    resumed = train(config)
    assert checkpoint(resumed, 5)["step"] == 5 and is_finite(resumed.pipeline.model)


def test_full_memory_in_the_middle_of_densification_saves_no_torn_state(config: SadgsTrainerConfig):
    def tear(trainer: SadgsTrainer) -> None:
        if trainer.step == 3:
            means = trainer.pipeline.model.gauss_params["means"]
            means.data = means.data[:-1]
            raise FULL

    with pytest.raises(RunError, match=r"nothing newer than the last checkpoint could be saved\.$"):
        train(config, tear)
    assert list(config.output_dir.rglob("*.ckpt")) == []


def test_full_memory_at_the_start_is_one_sentence(config: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch):
    def full(*args: Any, **kwargs: Any) -> None:
        raise FULL

    monkeypatch.setattr(Trainer, "setup", full)
    with pytest.raises(
        RunError, match=r"^The GPU's memory is too small to start \(CUDA out of memory\. .*GiB\): lower"
    ):
        set_up(config)
