"""Bad input: one sentence that names file and remedy, in training as in `sadgs-doctor`, and nothing left over.

`sadgs-doctor FOLDER` prints the same sentences as `ns-train`. Parsers other than nerfstudio's, COLMAP's and Blender's
are not checked, nor is a JPEG damaged in its middle, which decodes to wrong pixels without an error.
"""

from __future__ import annotations

import functools
import os
import re
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.utils import colmap_parsing_utils
from nerfstudio.scripts.train import entrypoint
from PIL import Image, ImageFile
from torch import Tensor
from torch.testing import assert_close

from examples.drawn_scene.scene import SPARSE_FOLDER, write_scene
from helpers.drawn_photos import color_profile
from helpers.forked_python import HANGS
from helpers.json_files import read_json, write_json
from helpers.kill_and_resume import set_up
from helpers.refusals import refusal
from helpers.short_runs import blender_data, configure, is_finite, nerfstudio_data, train
from helpers.small_scenes import HEIGHT, POINTS, WIDTH
from sadgs_ns.cli import doctor
from sadgs_ns.data import colmap
from sadgs_ns.data.checks import capture, check_data
from sadgs_ns.data.checks.findings import Finding, check_findings
from sadgs_ns.data.checks.transforms import check_blender, check_nerfstudio
from sadgs_ns.data.layouts import ParserOptions
from sadgs_ns.errors import InputError, RunError

CHECKOUT = Path(__file__).parents[2]
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


@pytest.fixture
def copied(captures: Path, tmp_path: Path) -> Callable[[str], Path]:
    """Copies the capture of a layout."""
    return lambda layout: Path(shutil.copytree(captures / layout, tmp_path / layout))


def errors(data: Path) -> list[str]:
    return [finding.sentence for finding in check_data(data) if finding.severity == "error"]


def remarks(data: Path) -> list[Finding]:
    """The findings that are more than a count of images or points."""
    counts = re.compile(r"\S+ has [\d,]+ (images of|points\.)")
    return [finding for finding in check_data(data) if not counts.match(finding.sentence)]


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


def picture(
    name: str, size: tuple[int, int] = (WIDTH, HEIGHT), mode: str = "RGB", color: Any = 0
) -> Callable[[Path], None]:
    return lambda data: Image.new(mode, size, color).save(data / name)


def meta(change: Callable[[dict[str, Any]], Any], name: str = "transforms.json") -> Callable[[Path], None]:
    """Change a transforms.json."""

    def spoil(data: Path) -> None:
        content = read_json(data / name)
        change(content)
        write_json(data / name, content)

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


def move_points(change: Callable[[np.ndarray], np.ndarray], ext: str = ".bin") -> Callable[[Path], None]:
    """Change the positions [P, 3] of a COLMAP model's points."""

    def move(cameras: dict, images: dict, points: dict) -> None:
        positions = change(np.array([point.xyz for point in points.values()]))
        for (index, point), xyz in zip(list(points.items()), positions, strict=True):
            points[index] = point._replace(xyz=xyz)

    return model(move, ext)


def move_cameras(change: Callable[[np.ndarray], np.ndarray], ext: str = ".bin") -> Callable[[Path], None]:
    """Change the centres [V, 3] of a COLMAP model's cameras."""

    def move(cameras: dict, images: dict, points: dict) -> None:
        rotations = [colmap_parsing_utils.qvec2rotmat(image.qvec) for image in images.values()]
        centres = [-rotation.T @ image.tvec for rotation, image in zip(rotations, images.values(), strict=True)]
        for (index, image), rotation, centre in zip(
            list(images.items()), rotations, change(np.array(centres)), strict=True
        ):
            images[index] = image._replace(tvec=-rotation @ centre)

    return model(move, ext)


def set_camera(kind: str, *params: float, ext: str = ".bin") -> Callable[[Path], None]:
    """Give a COLMAP model this camera."""
    camera = colmap_parsing_utils.Camera(1, kind, WIDTH, HEIGHT, np.array(params))
    return model(lambda cameras, images, points: cameras.update({1: camera}), ext)


def change_poses(*frames: int, name: str = "transforms.json", times: np.ndarray) -> Callable[[Path], None]:
    """Multiply the poses of some frames with a matrix [4, 4] from the right."""

    def change(content: dict[str, Any]) -> None:
        for frame in frames:
            pose = np.array(content["frames"][frame]["transform_matrix"]) @ times
            content["frames"][frame]["transform_matrix"] = pose.tolist()

    return meta(change, name)


def with_points(positions: list[list[float]]) -> Callable[[Path], None]:
    """Give a transforms.json a PLY file of points."""

    def spoil(data: Path) -> None:
        lines = "".join("{} {} {}\n".format(*position) for position in positions)
        (data / "p.ply").write_text(PLY.format(len(positions)) + lines)
        meta(lambda m: m.update(ply_file_path="p.ply"))(data)

    return spoil


def one_moved_by(distance: float) -> Callable[[np.ndarray], np.ndarray]:
    """Move the fourth of some positions [N, 3] along an axis."""
    return lambda positions: positions + distance * (np.arange(len(positions)) == 3)[:, None] * [1, 0, 0]


def repaint(mode: str, color: Any) -> Callable[[Path], Any]:
    """Give all images one colour."""
    return lambda data: [picture(f"images/{path.name}", mode=mode, color=color)(data) for path in images(data)]


def store_turned(size: tuple[int, int], orientation: int) -> Callable[[Path], None]:
    """Give all images a size and an orientation by EXIF."""

    def spoil(data: Path) -> None:
        exif = Image.Exif()
        exif[0x112] = orientation
        for path in images(data):
            with Image.open(path) as image:
                image.resize(size).save(path, exif=exif)

    return spoil


def store_profile(data: Path) -> None:
    """Give all images a colour profile that is not sRGB's."""
    for path in images(data):
        with Image.open(path) as image:
            image.save(path, icc_profile=color_profile(swapped=True))


def images(data: Path) -> list[Path]:
    return sorted((data / "images").glob("*.png"))


def mask(mode: str, color: Any) -> Callable[[Path], None]:
    """Give all frames of a transforms.json one mask."""

    def spoil(data: Path) -> None:
        picture("mask.png", mode=mode, color=color)(data)
        meta(lambda m: [frame.update(mask_path="mask.png") for frame in m["frames"]])(data)

    return spoil


def link_to_itself(name: str) -> Callable[[Path], None]:
    def spoil(data: Path) -> None:
        if (data / name).exists():
            remove(name)(data)
        (data / name).symlink_to(Path(name).name)

    return spoil


def lists(**names: Any) -> Callable[[Path], None]:
    """Give a transforms.json lists of the training images and of those held out."""
    return meta(lambda m: m.update({f"{split}_filenames": listed for split, listed in names.items()}))


MIRROR = np.diag([-1.0, 1, 1, 1])
SPARSE = str(SPARSE_FOLDER)
FIRST = "images/000.png"

COLMAP = {
    # images
    "image-missing": (remove(FIRST), r"\S+/000\.png does not exist: put it there, or leave it out of .*\."),
    "image-empty": (overwrite(FIRST, ""), r"\S+/000\.png has 0 bytes: copy it again, or leave .*\."),
    "image-truncated": (cut(FIRST, 0.6), r"\S+/000\.png cannot be read as an image \(.+\): copy it again.*\."),
    "image-corrupt": (flip_middle_byte(FIRST), r"\S+/000\.png cannot be read as an image \(.+\): copy it.*\."),
    "image-not-one": (overwrite(FIRST, "hello"), r"\S+/000\.png is no image that Pillow knows: copy it.*\."),
    "image-size": (
        picture(FIRST, (40, 30)),
        r"\S+/000\.png has 40 × 30 px, but its camera in \S+/images\.bin 48 × 36: use the images that .*\.",
    ),
    "image-orientation": (
        store_turned((36, 48), 6),
        r"\S+/000\.png \(and 9 more\) has EXIF orientation 6 and is read as 36 × 48 px, but "
        r"its camera in \S+/images\.bin 48 × 36: turn their pixels as those .*\.",
    ),
    "image-mode": (picture(FIRST, mode="P"), r"\S+/000\.png has pixels of Pillow's mode P: convert it .*\."),
    "image-loop": (
        link_to_itself(FIRST),
        r"\S+/000\.png cannot be read as an image \(Too many levels of symbolic links\): copy it again, .*\.",
    ),
    "images-black": (
        repaint("RGB", 0),
        r"\S+/images\.bin has 10 images that show a single colour and nothing else, such as \S+/000\.png: export .*\.",
    ),
    "images-loop": (link_to_itself("images"), r"\S+ has poses of 10 images, but there is no folder \S+/images: .*"),
    "image-line": (
        lambda data: picture(FIRST, (1, 36))(data),
        r"\S+/000\.png has 1 × 36 px: leave it out of the reconstruction\.",
    ),
    # lists of images
    "list-unknown": (
        lambda data: [
            overwrite(f"{split}_list.txt", f"{name}.png\n")(data)
            for split, name in (("train", "001"), ("val", "000"), ("test", "no"))
        ],
        r"\S+/test_list\.txt names 'no\.png', which is no image with a pose: correct it\.",
    ),
    "list-missing": (
        overwrite("train_list.txt", "001.png\n002.png\n"),
        r"\S+/val_list\.txt is missing beside other lists of images: add it, or remove the others\.",
    ),
    "list-mark": (
        overwrite("train_list.txt", "\ufeff001.png\n"),
        r"\S+/train_list\.txt starts with a byte order mark, which nerfstudio cannot read: .*\.",
    ),
    "list-latin": (
        overwrite("train_list.txt", b"\xe9.png\n"),
        r"\S+/train_list\.txt is not text in UTF-8: save it in that encoding\.",
    ),
    # poses
    "model-loop": (
        link_to_itself(SPARSE),
        r"\S+ holds 10 images but no camera poses: `sadgs .*\.",
    ),
    "poses-loop": (
        link_to_itself(f"{SPARSE}/images.bin"),
        r"\S+/images\.bin cannot be read \(Too many levels of symbolic links\): copy the whole reconstruction\.",
    ),
    "no-poses": (
        remove("sparse"),
        r"\S+ holds 10 images but no camera poses: `sadgs \S+/images` makes a splat of them, and "
        r"`sadgs-process \S+/images FOLDER` computes the poses alone; "
        r"photos of \d+ px show few features, so give them in their original size\.",
    ),
    "no-images": (
        model(lambda cameras, images, points: images.clear()),
        r"\S+/images\.bin holds no pose, so there is no image to train on: run COLMAP's mapper again\.",
    ),
    "no-image-folder": (remove("images"), r"\S+ has poses of 10 images, but there is no folder \S+/images: .*"),
    "nan-pose": (patch(f"{SPARSE}/images.bin", 12, "<d", np.nan), r"\S+: image 000\.png has NaN or .* pose.*"),
    "no-rotation": (
        model(lambda cameras, images, points: images.update({1: images[1]._replace(qvec=np.zeros(4))})),
        r"\S+: image 000\.png has a rotation that is no unit quaternion: run COLMAP's mapper again\.",
    ),
    "camera-unknown": (
        model(lambda cameras, images, points: images.update({1: images[1]._replace(camera_id=7)})),
        r"\S+: image 000\.png has camera 7, which \S+/cameras\.bin lacks: .*\.",
    ),
    "cameras-mixed-fisheye": (model(fisheye), r"\S+/cameras\.bin mixes fisheye and other cameras, .*\."),
    "camera-unsupported": (
        model(lambda cameras, images, points: cameras.update({1: cameras[1]._replace(model="FOV", params=np.ones(5))})),
        r"\S+: camera 1 has the model FOV, which nerfstudio cannot read: undistort the images with .*\.",
    ),
    "camera-focal": (
        patch(f"{SPARSE}/cameras.bin", 32, "<d", -5.0),
        r"\S+: camera 1 has focal length x = -5\.0, which must be positive: correct it\.",
    ),
    "quaternion-length": (
        model(lambda cameras, images, points: images.update({1: images[1]._replace(qvec=2 * images[1].qvec)}), ".txt"),
        r"\S+: image 000\.png has a rotation that is no unit quaternion: run COLMAP's mapper again\.",
    ),
    "camera-center": (
        set_camera("PINHOLE", 40, 40, 1e6, 18),
        r"\S+: camera 1 has its principal point at \(1e\+06, 18\) px, outside its image of 48 × 36 px: correct .*\.",
    ),
    "camera-k1": (
        set_camera("OPENCV", 40, 40, 24, 18, 50, 0, 0, 0, ext=".txt"),
        r"\S+/cameras\.txt: camera 1 has the radial distortion 50, 0, which cannot be undone: calibrate .*\.",
    ),
    "camera-folds": (
        set_camera("SIMPLE_RADIAL", 40, 24, 18, -3),
        r"\S+: camera 1 has the radial distortion -3, which cannot be undone: calibrate the camera again, or .*\.",
    ),
    "camera-fisheye-0": (
        set_camera("OPENCV_FISHEYE", 40, 40, 24, 18, 0, 0, 0, 0),
        r"\S+: camera 1 is a fisheye with all distortion coefficients 0, and nerfstudio undistorts no such image: .*",
    ),
    "camera-p1": (
        set_camera("OPENCV", 40, 40, 24, 18, 0, 0, 9, 0),
        r"\S+: camera 1 has p1, p2 = 9, 0, which no lens has: calibrate the camera again\.",
    ),
    "poses-twice": (
        model(lambda cameras, images, points: images.update({1: images[1]._replace(name="001.png")})),
        r"\S+/images\.bin has more than one pose of \S+/images/001\.png: keep one, or give each an image of its own\.",
    ),
    "pose-far": (
        move_cameras(one_moved_by(1e6), ".txt"),
        r"\S+: image 003\.png has its camera \S+ times as far from the other cameras as those are .*: remove .*\.",
    ),
    "points-behind": (
        move_points(lambda positions: positions + np.array([50, 50, 20])),
        r"\S+/points3D\.bin has points that no camera can see in front of it: take points and poses of one .*\.",
    ),
    "points-too-far": (
        move_points(lambda positions: 1e6 * positions, ".txt"),
        r"\S+/points3D\.txt has its points \S+ times as far away as the cameras are apart, so that all images .*\.",
    ),
    "one-view": (
        model(lambda cameras, images, points: [images.pop(i) for i in range(2, 11)]),
        r"\S+ has 1 view, which shows no depth: take at least 2 images, .*\.",
    ),
    # files
    "cameras-truncated": (cut(f"{SPARSE}/cameras.bin", 0.5), r"\S+/cameras\.bin is cut off or corrupt \(.*"),
    "cameras-empty": (overwrite(f"{SPARSE}/cameras.bin", ""), r"\S+/cameras\.bin is cut off or corrupt \(.*"),
    "cameras-corrupt": (
        patch(f"{SPARSE}/cameras.bin", 12, "<i", 99),
        r"\S+/cameras\.bin: camera 1 has COLMAP's model 99, which nerfstudio does not know: undistort the images .*\.",
    ),
    "images-missing": (remove(f"{SPARSE}/images.bin"), r"\S+/images\.bin cannot be read \(No such file.*"),
    "images-truncated": (cut(f"{SPARSE}/images.bin", 0.5), r"\S+/images\.bin is cut off or corrupt \(.*"),
    # keypoints of the first image: an exabyte
    "images-corrupt-count": (
        patch(f"{SPARSE}/images.bin", 8 + 64 + 8, "<Q", 2**60),
        r"\S+/images\.bin is cut off or corrupt \(it ends after \d+ bytes, .*\): copy it again, or .*\.",
    ),
    "points-missing": (
        remove(f"{SPARSE}/points3D.bin"),
        r"\S+ has no points3D file: .*random points\.",
    ),
    "points-empty": (
        model(lambda cameras, images, points: points.clear()),
        r"\S+/points3D\.bin holds no SfM point: .*--load-3D-points False.*\.",
    ),
    "points-truncated": (cut(f"{SPARSE}/points3D.bin", 0.9), r"\S+/points3D\.bin is cut off or corrupt \(.*"),
    "points-nan": (
        model(lambda cameras, images, points: points.update({1: points[1]._replace(xyz=np.full(3, np.nan))})),
        r"\S+/points3D\.bin has NaN or infinity in a point: .*\.",
    ),
    "text-colour": (
        lambda data: (
            model(lambda *parts: None, ".txt")(data),
            overwrite(f"{SPARSE}/points3D.txt", "1 0 0 0 256 0 0 1 1 0\n")(data),
        ),
        r"\S+/points3D\.txt is not COLMAP's text \(a colour is not in 0 … 255\): copy it again, .*",
    ),
    "text-space": (
        lambda data: (
            model(lambda cameras, images, points: images.update({1: images[1]._replace(name="a b.png")}), ".txt")(data),
            (data / FIRST).rename(data / "images/a b.png"),
        ),
        r"\S+/images\.txt: image 'a b\.png' has a space in its name, where nerfstudio takes the name to end: .*\.",
    ),
    "text-twice": (
        lambda data: (
            model(lambda *parts: None, ".txt")(data),
            overwrite(f"{SPARSE}/images.txt", "1 1 0 0 0 0 0 0 1 000.png\n\n1 1 0 0 0 0 0 1 1 001.png\n\n")(data),
        ),
        r"\S+/images\.txt is not COLMAP's text \(two lines have the number 1\): copy it again, or run .*",
    ),
    "text-corrupt": (
        lambda data: (
            model(lambda *parts: None, ".txt")(data),
            overwrite(f"{SPARSE}/images.txt", "1 0.1 zero 0 0 0 0 0 1 000.png\n\n")(data),
        ),
        r"\S+/images\.txt is not COLMAP's text \(.*'zero'.*\): copy it again, or run COLMAP's mapper again\.",
    ),
}
NERFSTUDIO = {
    "folder-missing": (shutil.rmtree, r"\S+ does not exist: give --data the folder .*"),
    "json-missing": (remove("transforms.json"), r"\S+ holds 10 images but no camera poses: .*"),
    "json-corrupt": (cut("transforms.json", 0.5), r"\S+/transforms\.json is not readable JSON \(.*line.*\): .*"),
    "json-list": (overwrite("transforms.json", "[]"), r"\S+ holds a list instead of an object with .*\."),
    "json-no-frames": (meta(lambda m: m.update(frames=[])), r"\S+ lists no frames, so there is no image .*"),
    "json-nan-pose": (meta(set_pose(3, 0, 0, np.nan)), r"\S+: frame images/003\.png has NaN or infinity.*"),
    "json-short-pose": (
        meta(lambda m: m["frames"][2].update(transform_matrix=[[1, 0, 0, 0]])),
        r"\S+: frame images/002\.png has no pose of 4 × 4 numbers: .*\.",
    ),
    "json-image-twice": (
        meta(lambda m: m["frames"].append(dict(m["frames"][3], file_path="./images/003.png"))),
        r"\S+/transforms\.json has more than one pose of \S+/images/003\.png: keep one, or give each an image of .*\.",
    ),
    "json-no-focal": (meta(lambda m: m["frames"][1].pop("fl_x")), r"\S+: frame images/001\.png has no fl_x: .*"),
    "json-camera-model": (meta(lambda m: m.update(camera_model="LENS")), r"\S+ has the camera model 'LENS'.*"),
    "json-one-place": (meta(in_one_place), r"\S+ has all 10 cameras in one place, which shows no depth: .*"),
    "json-one-view": (meta(keep(1)), r"\S+ has 1 view, which shows no depth: take at least 2 images, .*\."),
    "json-size": (picture(FIRST, (36, 48)), r"\S+/000\.png has 36 × 48 px, but its camera in \S+ 48 × 36: .*"),
    "json-image-missing": (remove("images/004.png"), r"\S+/images/004\.png does not exist: .*"),
    "json-mask-size": (
        lambda data: (
            picture("mask.png", (10, 10), "L")(data),
            meta(lambda m: [frame.update(mask_path="mask.png") for frame in m["frames"]])(data),
        ),
        r"\S+/mask\.png \(and 9 more\) is a mask of another size than \S+/000\.png: resize it\.",
    ),
    "json-mask-colour": (
        mask("RGB", "white"),
        r"\S+/mask\.png \(and 9 more\) is a mask of Pillow's mode RGB: convert it to 8-bit grey\.",
    ),
    "json-masks-black": (
        mask("L", 0),
        r"\S+ has 10 masks that are all black, such as \S+/mask\.png, which leaves no pixel to train on: make .*\.",
    ),
    "json-some-depths": (
        meta(lambda m: m["frames"][0].update(depth_file_path="depth.png")),
        r"\S+ names depths for 1 of 10 frames: give all of them one, or none\.",
    ),
    "json-transparent": (
        repaint("RGBA", (255, 0, 0, 0)),
        r"\S+/transforms\.json has 10 images that show a single colour and nothing else, such as \S+/000\.png: .*",
    ),
    "json-loop": (
        link_to_itself("transforms.json"),
        r"\S+ holds 10 images but no camera poses: `sadgs .*\.",
    ),
    "json-mask-loop": (
        lambda data: (mask("L", 255)(data), link_to_itself("mask.png")(data)),
        r"\S+/mask\.png \(and 9 more\) cannot be read as an image \(Too many levels of symbolic links\): .*",
    ),
    "json-utf16": (
        lambda data: overwrite("transforms.json", (data / "transforms.json").read_text().encode("utf16"))(data),
        r"\S+/transforms\.json is not text in UTF-8: save it in that encoding\.",
    ),
    "json-test-names": (
        lists(train=["images/001.png"], val=["images/000.png"], test=["images/no.png", "images/nor.png"]),
        r"\S+: test_filenames names 'images/no\.png' \(and 1 more\), which is no image with a pose: correct it\.",
    ),
    "json-val-names": (
        lists(train=["images/001.png"], val=["no.png"], test=[]),
        r"\S+: val_filenames names 'no\.png', which is no image with a pose: correct it\.",
    ),
    "json-train-names": (
        lists(train=["no.png"], val=[], test=[]),
        r"\S+: train_filenames names 'no\.png', which is no image with a pose: correct it\.",
    ),
    "json-names-missing": (
        lists(test=["images/000.png"]),
        r"\S+: train_filenames is missing beside other lists of images: add it, or remove the others\.",
    ),
    "json-names-no-list": (
        lists(train=[1], val=[], test=[]),
        r"\S+: train_filenames is no list of images' names: correct it, or remove all such lists\.",
    ),
    "json-no-training": (lists(train=[], val=[], test=[]), r"\S+ leaves no view for training: hold out fewer images\."),
    "json-applied-transform": (
        meta(lambda m: m.update(applied_transform=[[1, 0], [0, 1]])),
        r"\S+ has an applied_transform that is not 3 × 4 finite numbers: correct or remove it\.",
    ),
    "json-applied-scale": (
        meta(lambda m: m.update(applied_scale=3)),
        r"\S+ has applied_scale = 3, by which nerfstudio moves points and no cameras: remove it\.",
    ),
    "json-orientation": (
        meta(lambda m: m.update(orientation_override="upside down")),
        r"\S+ has orientation_override = 'upside down': give one of pca, up, vertical, none\.",
    ),
    "json-fisheye624-0": (
        meta(lambda m: m.update(camera_model="FISHEYE624")),
        r"\S+: frame images/000\.png is a fisheye with all distortion coefficients 0, and nerfstudio undistorts .*",
    ),
    "json-mirrored": (
        change_poses(4, 5, times=MIRROR),
        r"\S+: frame images/004\.png \(and 1 more\) has a mirrored pose \(determinant −1\): negate one column .*\.",
    ),
    "json-stretched": (
        change_poses(2, times=np.diag([2.0, 2, 2, 1])),
        r"\S+: frame images/002\.png has a pose whose rotation is stretched, skewed or 0: remove what scales .*\.",
    ),
    "json-transposed": (
        meta(lambda m: [f.update(transform_matrix=np.transpose(f["transform_matrix"]).tolist()) for f in m["frames"]]),
        r"\S+: frame images/000\.png has a last row in its pose that is not 0 0 0 1: transpose it, or correct it\.",
    ),
    "json-width": (
        meta(lambda m: [frame.update(w=48.5) for frame in m["frames"]]),
        r"\S+: frame images/000\.png has w = 48\.5, which is no whole number of pixels: correct it\.",
    ),
    "json-center": (
        meta(lambda m: m["frames"][1].update(cy=-1e6)),
        r"\S+: frame images/001\.png has its principal point at \(24, -1e\+06\) px, outside its image of .*",
    ),
    "json-k1": (
        meta(lambda m: m.update(k1=50)),
        r"\S+: frame images/000\.png has the radial distortion 50, 0, 0, which cannot be undone: calibrate .*\.",
    ),
    "json-fisheye-0": (
        meta(lambda m: m.update(camera_model="OPENCV_FISHEYE")),
        r"\S+: frame images/000\.png is a fisheye with all distortion coefficients 0, and nerfstudio undistorts .*",
    ),
    "json-k1-nan": (
        meta(lambda m: m["frames"][6].update(distortion_params=[float("nan"), 0, 0, 0, 0, 0])),
        r"\S+: frame images/006\.png has k1 = nan, which is no finite number: correct it\.",
    ),
    "json-focal-wide": (
        meta(lambda m: [frame.update(fl_x=0.4, fl_y=0.4) for frame in m["frames"]]),
        r"\S+: frame images/000\.png has the focal length 0\.4 px, with which 48 × 36 px span an angle .*",
    ),
    "json-focal-narrow": (
        meta(lambda m: [frame.update(fl_x=1e9, fl_y=1e9) for frame in m["frames"]]),
        r"\S+: frame images/000\.png has the focal length 1e\+09 px, with which 48 × 36 px span an angle of .*°: .*",
    ),
    "json-few-coefficients": (
        meta(lambda m: m.update(distortion_params=[0.1])),
        r"\S+: frame \S+ has distortion_params that are no list of 6 numbers \(k1, k2, k3, k4, p1, p2\): correct or .*",
    ),
    "json-last-row": (
        meta(set_pose(5, 3, 3, 2)),
        r"\S+: frame images/005\.png has a last row in its pose that is not 0 0 0 1: transpose it, or correct it\.",
    ),
    "json-crop": (
        meta(lambda m: m.update(fisheye_crop_radius="wide")),
        r"\S+ has fisheye_crop_radius = 'wide', which is no finite number: correct it\.",
    ),
    "json-null-depth": (
        meta(lambda m: [frame.update(depth_file_path=None) for frame in m["frames"]]),
        r"\S+: frame 0 has a depth_file_path that no file can have: correct or remove it\.",
    ),
    "json-zero-byte": (
        meta(lambda m: m["frames"][1].update(mask_path="a\0b")),
        r"\S+: frame 1 has a mask_path that no file can have: correct or remove it\.",
    ),
    "json-k4": (
        meta(lambda m: m.update(k4=0.1)),
        r"\S+: frame images/000\.png has k4 = 0\.1, which nerfstudio cannot undo: undistort the images yourself\.",
    ),
    "json-huge": (
        meta(lambda m: m["frames"][0].update(fl_x=10**400)),
        r"\S+: frame images/000\.png has fl_x = .*, which is no finite number: correct it\.",
    ),
    "json-far": (
        meta(set_pose(3, 1, 3, 1e6)),
        r"\S+: frame images/003\.png has its camera \S+ times as far from the other cameras as those are .*\.",
    ),
    "ply-too-far": (
        with_points([[1e6, 0, 0], [1e6, 1, 0], [1e6, 0, 1], [1e6, 1, 1]]),
        r"\S+/p\.ply has its points \S+ times as far away as the cameras are apart, so that all images .*",
    ),
    "ply-nan": (
        with_points([[0, 0, 0], [1, float("nan"), 0]]),
        r"\S+/p\.ply has NaN or infinity in a point: restore it, or remove .*\.",
    ),
    "ply-missing": (
        meta(lambda m: m.update(ply_file_path="points.ply")),
        r"\S+/points\.ply should hold the SfM points but cannot be read \(No such file .*\): .*random points\.",
    ),
    "ply-empty": (
        lambda data: (
            overwrite("p.ply", PLY.format(0))(data),
            meta(lambda m: m.update(ply_file_path="p.ply"))(data),
        ),
        r"\S+/p\.ply holds no SfM point: .*\.",
    ),
    "ply-truncated": (
        lambda data: (
            overwrite("p.ply", PLY.format(3) + "0 0 0\n1 1 1\n")(data),
            meta(lambda m: m.update(ply_file_path="p.ply"))(data),
        ),
        r"\S+/p\.ply should hold the SfM points but is cut off: its header promises 3 points: .*\.",
    ),
    "ply-not-one": (
        meta(lambda m: m.update(ply_file_path=FIRST)),
        r"\S+/000\.png should hold the SfM points but is not a PLY file of points \(.+\): .*\.",
    ),
}
BLENDER = {
    "blender-no-val": (
        lambda data: [remove(f"transforms_{split}.json")(data) for split in ("val", "test")],
        r"\S+/transforms_val\.json does not exist, nor a transforms_test\.json: rename .*\.",
    ),
    "blender-nan": (meta(set_pose(0, 1, 3, np.inf), "transforms_train.json"), r"\S+: frame \S+ has NaN or inf.*"),
    "blender-mirrored": (
        change_poses(1, name="transforms_test.json", times=MIRROR),
        r"\S+/transforms_test\.json: frame \S+ has a mirrored pose \(determinant −1\): negate one column .*\.",
    ),
    "blender-degrees": (
        meta(lambda m: m.update(camera_angle_x=40), "transforms_train.json"),
        r"\S+/transforms_train\.json has camera_angle_x = 40, which is no angle of view in radians: correct it\.",
    ),
    "blender-size": (picture("images/005.png", (40, 30), "RGBA"), r"\S+/005\.png has 40 × 30 px, but its .*"),
}
CASES = {
    **{name: ("colmap", *case) for name, case in COLMAP.items()},
    **{name: ("nerfstudio", *case) for name, case in NERFSTUDIO.items()},
    **{name: ("blender", *case) for name, case in BLENDER.items()},
}
"""A layout, how to spoil it, and the sentence that says so."""


@pytest.mark.hard_case("the folder is missing", "refused: does not exist", "folder-missing")
@pytest.mark.hard_case("no images: an empty reconstruction, no frames", "refused", "no-images", "json-no-frames")
@pytest.mark.hard_case(
    "images without any pose",
    "refused: counts them, gives the commands `sadgs` and `sadgs-process` with their folder, and tells small photos",
    "no-poses",
    "json-missing",
)
@pytest.mark.hard_case(
    "poses without images: one file, the whole folder",
    "refused",
    "image-missing",
    "json-image-missing",
    "no-image-folder",
)
@pytest.mark.hard_case("an image of 0 bytes", "refused", "image-empty")
@pytest.mark.hard_case("a truncated PNG", "refused", "image-truncated")
@pytest.mark.hard_case("a corrupt PNG", "refused (its checksums)", "image-corrupt")
@pytest.mark.hard_case("a file that is no image", "refused", "image-not-one")
@pytest.mark.hard_case(
    "palette, CMYK or 16-bit images (nerfstudio would read wrong colours)",
    "refused: convert to 8-bit RGB",
    "image-mode",
)
@pytest.mark.hard_case(
    "an image of another size than its camera", "refused: both sizes", "image-size", "json-size", "blender-size"
)
@pytest.mark.hard_case("masks of another size", "refused", "json-mask-size")
@pytest.mark.hard_case(
    "NaN or infinity in a pose", "refused: names the image", "nan-pose", "json-nan-pose", "blender-nan"
)
@pytest.mark.hard_case("a pose that is no rotation, or no 4 × 4 matrix", "refused", "no-rotation", "json-short-pose")
@pytest.mark.hard_case(
    "a mirrored pose (determinant −1)", "refused: negate one column", "json-mirrored", "blender-mirrored"
)
@pytest.mark.hard_case(
    "a stretched, skewed or transposed pose; a quaternion of another length",
    "refused",
    "json-stretched",
    "json-transposed",
    "quaternion-length",
)
@pytest.mark.hard_case(
    "one camera about 8,400 times as far from the others as these are from each other",
    "refused: remove the image, or compute the poses again",
    "pose-far",
    "json-far",
)
@pytest.mark.hard_case("intrinsics missing or not positive", "refused", "json-no-focal", "camera-focal")
@pytest.mark.hard_case(
    "a principal point more than 10 image sizes from the middle of its image", "refused", "camera-center", "json-center"
)
@pytest.mark.hard_case(
    "distortion that cannot be undone (k1 = 50, k1 = −3, p1 = 9)",
    "refused",
    "camera-k1",
    "camera-folds",
    "camera-p1",
    "json-k1",
)
@pytest.mark.hard_case(
    "k4 of a perspective camera, coefficients that are no finite number",
    "refused: names frame and coefficient",
    "json-k4",
    "json-k1-nan",
)
@pytest.mark.hard_case(
    "a fisheye whose coefficients are all 0, FISHEYE624 too",
    "refused, by `sadgs-doctor` too; nothing is left",
    "camera-fisheye-0",
    "json-fisheye-0",
    "json-fisheye624-0",
)
@pytest.mark.hard_case(
    "a width of 160.5 px, numbers beyond float64, Blender's angle of view in degrees",
    "refused",
    "json-width",
    "json-huge",
    "blender-degrees",
)
@pytest.mark.hard_case(
    "a camera model that nerfstudio cannot read; fisheye mixed with others; a camera that is missing",
    "refused",
    "camera-unsupported",
    "json-camera-model",
    "cameras-mixed-fisheye",
    "camera-unknown",
)
@pytest.mark.hard_case(
    "1 view in all; all cameras in one place", "refused: shows no depth", "one-view", "json-one-view", "json-one-place"
)
@pytest.mark.hard_case(
    "`points3D` missing, empty, or with NaN",
    "refused: `--load-3D-points False` starts from random points",
    "points-missing",
    "points-empty",
    "points-nan",
)
@pytest.mark.hard_case(
    "the PLY of points missing, empty, cut off, with NaN, or no PLY",
    "refused: restore it, or remove `ply_file_path`",
    "ply-nan",
    "ply-missing",
    "ply-empty",
    "ply-truncated",
    "ply-not-one",
)
@pytest.mark.hard_case("points that no camera has in front of it", "refused", "points-behind")
@pytest.mark.hard_case(
    "points more than 10⁵ times as far away as the cameras are apart", "refused", "points-too-far", "ply-too-far"
)
@pytest.mark.hard_case(
    "one point 10⁵ to 10²⁰⁰ units away, in `sadgs-doctor`", "a note", "point-wild", "point-beyond-bounds"
)
@pytest.mark.hard_case(
    "a corrupt COLMAP binary: cut off, empty, an unknown camera model, a count of 2⁶⁰",
    "refused: where it ends; models that are newer than nerfstudio are not called corrupt",
    "cameras-truncated",
    "cameras-empty",
    "cameras-corrupt",
    "images-missing",
    "images-truncated",
    "images-corrupt-count",
    "points-truncated",
)
@pytest.mark.hard_case("corrupt COLMAP text", "refused", "text-corrupt", "text-colour")
@pytest.mark.hard_case(
    "COLMAP's text with two images or cameras of one number, of which nerfstudio reads the last",
    "refused",
    "text-twice",
)
@pytest.mark.hard_case(
    "`transforms.json` cut off or of another kind; one of Blender's missing",
    "refused",
    "json-corrupt",
    "json-list",
    "blender-no-val",
)
@pytest.mark.hard_case(
    "masks of three channels (RGB, RGBA), grey with alpha, palette",
    "refused: convert it to 8-bit grey",
    "json-mask-colour",
)
@pytest.mark.hard_case(
    "an image or a mask that is a link to itself",
    "refused: cannot be read as an image (Too many levels of symbolic links)",
    "image-loop",
    "json-mask-loop",
)
@pytest.mark.hard_case(
    "`transforms.json`, the reconstruction's folder or its cameras are a link to itself",
    "refused: images without poses",
    "json-loop",
    "model-loop",
)
@pytest.mark.hard_case(
    "`images.bin` or the folder of images is a link to itself", "refused", "poses-loop", "images-loop"
)
@pytest.mark.hard_case(
    "all images black, white or of one colour", "refused: they show a single colour and nothing else", "images-black"
)
@pytest.mark.hard_case(
    "all images transparent", "refused: they show nothing; colour under alpha 0 does not count", "json-transparent"
)
@pytest.mark.hard_case(
    "all masks black", "refused: no pixel is left; make white what is to be trained on", "json-masks-black"
)
@pytest.mark.hard_case("names in `test_filenames` that do not exist", "refused: names the first", "json-test-names")
@pytest.mark.hard_case(
    "names in `val_filenames` or `train_filenames` that do not exist; lists that are no lists",
    "refused",
    "json-val-names",
    "json-train-names",
    "json-names-no-list",
)
@pytest.mark.hard_case(
    "one of the lists `train_filenames` and `val_filenames` is missing", "refused", "json-names-missing"
)
@pytest.mark.hard_case(
    "COLMAP's `train_list.txt`, `val_list.txt`, `test_list.txt`: an unknown name, a missing list, a byte order "
    "mark, not UTF-8",
    "refused",
    "list-unknown",
    "list-missing",
    "list-mark",
    "list-latin",
)
@pytest.mark.hard_case("UTF-16", "refused: save it in UTF-8", "json-utf16")
@pytest.mark.hard_case(
    "a `masks` folder beside a COLMAP reconstruction",
    "a warning: `colmap --colmap-path … --masks-path masks`",
    "masks-unused",
)
@pytest.mark.hard_case(
    "a focal length in millimetres (an angle of view over 170°); one of 10⁹ px",
    "refused: correct it, in pixels",
    "json-focal-wide",
    "json-focal-narrow",
)
@pytest.mark.hard_case("fx and fy that differ by more than 2 times", "a warning", "camera-stretched")
@pytest.mark.hard_case("an image 1 px wide", "refused", "image-line")
@pytest.mark.hard_case(
    "an image with two poses",
    "refused: keep one; it counted twice, and a held-out view was trained on",
    "json-image-twice",
    "poses-twice",
)
@pytest.mark.hard_case(
    "EXIF orientation 6, and poses of the upright images", "refused by that tag", "image-orientation"
)
@pytest.mark.hard_case(
    "`applied_transform` of another shape; `applied_scale` that is not 1, which moves points away; an unknown "
    "`orientation_override`; `fisheye_crop_radius` of text",
    "refused by name",
    "json-applied-transform",
    "json-applied-scale",
    "json-orientation",
    "json-crop",
)
@pytest.mark.hard_case("depths for some frames", "refused: all or none", "json-some-depths")
@pytest.mark.hard_case("`distortion_params` that is no list of 6 numbers", "refused", "json-few-coefficients")
@pytest.mark.hard_case("a pose whose last row is 0 0 0 2 (nerfstudio ignores it)", "refused", "json-last-row")
@pytest.mark.hard_case(
    "a zero byte in a file's name; null in its place", "refused", "json-zero-byte", "json-null-depth"
)
@pytest.mark.hard_case("a name with a space in COLMAP's text", "refused: write the model in binary", "text-space")
@pytest.mark.parametrize("case", CASES)
def test_bad_data_are_refused_in_one_sentence_by_training_and_doctor_alike(
    case: str,
    copied: Callable[[str], Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    layout, spoil, sentence = CASES[case]
    data = copied(layout)
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
    status = doctor.main([str(data)])
    assert status == 1
    printed = capsys.readouterr().out
    assert f"error: {refused.value}" in printed


@pytest.mark.parametrize("layout", ["colmap", "nerfstudio", "blender"])
def test_good_data_have_no_error_and_no_warning(layout: str, captures: Path):
    actual = [finding for finding in check_data(captures / layout) if finding.severity != "note"]
    assert actual == []


@pytest.mark.hard_case("views from a tripod, in one place but for rounding, and one beside it", "no warning")
def test_views_from_a_tripod_are_as_good_as_others(copied: Callable[[str], Path]):
    data = copied("nerfstudio")

    def move(content: dict[str, Any]) -> None:
        in_one_place(content)
        for index, frame in enumerate(content["frames"]):
            frame["transform_matrix"][0][3] += 1e-15 * index + 0.3 * (index == 5)

    meta(move)(data)
    with_points([[0.5, 0.5, 0.5 + 0.01 * i] for i in range(4)])(data)
    actual = [finding for finding in check_data(data) if finding.severity != "note"]
    assert actual == []


def test_a_run_checks_its_data_once_and_other_ways_to_a_pipeline_check_them_too(
    captures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    checked: list[Path] = []
    check_colmap = capture.CHECKS[ColmapDataParserConfig]

    def check(data: Path, *options: Any) -> list[Finding]:
        checked.append(data)
        return check_colmap(data, *options)

    monkeypatch.setitem(capture.CHECKS, ColmapDataParserConfig, check)
    first = Path(shutil.copytree(captures / "colmap", tmp_path / "first"))
    second = Path(shutil.copytree(captures / "colmap", tmp_path / "second"))
    config = configure(tmp_path / "out", parser_of(first))
    config.save_config()
    set_up(config)
    assert checked == [first]  # ns-train
    set_up(config)
    assert checked == [first, first]  # a program, ns-eval, python -m benchmarks
    config.save_config()
    config.save_config()
    assert "findings" not in (config.get_base_dir() / "config.yml").read_text()
    config.pipeline.datamanager.data = second
    (second / FIRST).unlink()
    with refusal("does not exist"):
        set_up(config)  # other settings than were checked
    config.pipeline.datamanager.data = None
    (first / FIRST).unlink()
    with refusal("does not exist"):
        config.save_config()
    with refusal("does not exist"):
        set_up(config)  # what was good before does not count


@pytest.mark.hard_case("square images with an EXIF orientation, or turned as their cameras are", "a warning, or none")
def test_an_orientation_that_a_size_tells_of_is_no_warning(copied: Callable[[str], Path]):
    data = copied("nerfstudio")
    for side, told in ((HEIGHT, 1), (HEIGHT - 2, 0)):
        store_turned((side, HEIGHT), 8)(data)
        meta(lambda m, side=side: [frame.update(w=side, cx=side / 2) for frame in [*m["frames"], m]])(data)
        actual = sum("EXIF orientation" in finding.sentence for finding in remarks(data))
        assert actual == told


@pytest.mark.hard_case("masks that hide nothing in any image", "a warning")
@pytest.mark.parametrize("color", [255, 1])
def test_masks_that_hide_nothing_are_told(color: int, copied: Callable[[str], Path]):
    data = copied("nerfstudio")
    mask("L", color)(data)
    (finding,) = [finding for finding in check_data(data) if finding.severity != "note"]
    assert finding.severity == "warning"
    problem = f"{data}/transforms.json has 10 masks that hide nothing, such as {data}/mask.png"
    assert finding.sentence.startswith(f"{problem}: make black what is to be hidden")
    with Image.open(data / "mask.png") as image:
        image.putpixel((3, 3), 0)
        image.save(data / "mask.png")
    actual = [finding for finding in check_data(data) if finding.severity != "note"]
    assert actual == []


@pytest.mark.hard_case("several bad images", "one sentence for each kind: the first, and how many more")
def test_several_problems_of_one_kind_are_one_finding_and_other_kinds_are_counted(copied: Callable[[str], Path]):
    data = copied("nerfstudio")
    for index in (2, 5, 7):
        (data / f"images/00{index}.png").write_bytes(b"")
    (data / "images/003.png").unlink()
    findings = check_data(data)
    assert len([finding for finding in findings if finding.severity == "error"]) == 2
    with refusal(r"002\.png \(and 2 more\) has 0 bytes: .*\(`sadgs-doctor .*` shows 1 more\.\)"):
        check_findings(findings, data)


# --- what is unlikely ---

UNLIKELY = {
    "image-orientation": (
        store_turned((WIDTH, HEIGHT), 3),
        "warning",
        r"\S+/000\.png \(and 9 more\) has an EXIF orientation that would turn it, which training ignores, as .*\.",
    ),
    "image-colors": (
        store_profile,
        "warning",
        r"\S+/000\.png \(and 9 more\) has a colour profile, which training takes for sRGB, so that viewers .*\.",
    ),
    "camera-center": (
        set_camera("PINHOLE", 40, 40, 60, 18),
        "warning",
        r"\S+: camera 1 has its principal point at \(60, 18\) px, outside its image of 48 × 36 px: correct .*\.",
    ),
    "masks-unused": (
        lambda data: ((data / "masks").mkdir(), picture("masks/000.png", mode="L")(data)),
        "warning",
        r"\S+/masks holds masks that are not used: end the command with `colmap --colmap-path sparse/0 --masks-path .*",
    ),
    "camera-shares": (
        set_camera("PINHOLE", 40, 40, 0.5, 0.5),
        "warning",
        r"\S+: camera 1 has its principal point at \(0\.5, 0\.5\) px, in a corner of its image of 48 × 36 px: .*\.",
    ),
    "camera-stretched": (
        set_camera("PINHOLE", 40, 100, 24, 18),
        "warning",
        r"\S+: camera 1 has the focal lengths 40 and 100 px, which differ as no lens's do: correct them, in pixels\.",
    ),
    "camera-corners": (
        set_camera("SIMPLE_RADIAL", 40, 24, 18, -0.4),
        "warning",
        r"\S+: camera 1 has the radial distortion -0\.4, which cannot be undone in the image's corners: .*\.",
    ),
    "pose-far": (
        move_cameras(one_moved_by(100)),
        "warning",
        r"\S+: image 003\.png has its camera \S+ times as far from the other cameras as those are .*: remove .*\.",
    ),
    "points-far": (
        move_points(lambda positions: 1e4 * positions),
        "warning",
        r"\S+/points3D\.bin has its points \S+ times as far away as the cameras are apart, so that all images .*\.",
    ),
    "point-wild": (
        move_points(one_moved_by(1e5), ".txt"),
        "note",
        r"\S+/points3D\.txt has 1 of 60 points more than 30 times as far out as 99% of them: training leaves .*\.",
    ),
    "point-beyond-bounds": (
        move_points(one_moved_by(-1e30)),
        "note",
        r"\S+/points3D\.bin has 1 of 60 points more than 30 times as far out as 99% of them: training leaves .*\.",
    ),
}


@pytest.mark.hard_case(
    "one camera more than 30 times as far out as 90 % of them; a principal point just outside the image, or given "
    "as shares of it or as 0; "
    "distortion that cannot be undone in the corners alone; points more than 10³ times as far away as the "
    "cameras are apart",
    "trains, with a warning",
)
@pytest.mark.hard_case("EXIF orientation 3 in a reconstruction", "trains, with a warning", "image-orientation")
@pytest.mark.parametrize("case", UNLIKELY)
def test_unlikely_data_are_told_of_in_one_sentence(case: str, copied: Callable[[str], Path]):
    spoil, severity, sentence = UNLIKELY[case]
    data = copied("colmap")
    spoil(data)
    (finding,) = remarks(data)
    assert finding.severity == severity, finding
    assert re.fullmatch(sentence, finding.sentence), finding


@pytest.mark.hard_case("an angle of view under 0.5°", "a warning")
def test_a_lens_of_a_telescope_is_a_warning(copied: Callable[[str], Path]):
    data = copied("nerfstudio")
    meta(lambda m: [frame.update(fl_x=1e4, fl_y=1e4) for frame in m["frames"]])(data)
    (finding,) = [finding for finding in check_data(data) if finding.severity != "note"]
    assert finding.severity == "warning"
    text = (
        r"\S+: frame images/000\.png has the focal length 10000 px, with which 48 × 36 px span an angle of 0\.28°: .*\."
    )
    assert re.fullmatch(text, finding.sentence)


@pytest.mark.hard_case("points that fewer than half of the cameras see", "a warning")
def test_points_behind_some_cameras_are_a_warning(copied: Callable[[str], Path]):
    data = copied("nerfstudio")
    with_points([[0.5, 0.5, 0.5 + 0.01 * i] for i in range(4)])(data)
    actual = [finding for finding in check_data(data) if finding.severity != "note"]
    assert actual == []
    change_poses(*range(6), times=np.diag([1.0, -1, -1, 1]))(data)  # OpenCV's axes instead of OpenGL's
    (finding,) = [finding for finding in check_data(data) if finding.severity != "note"]
    assert finding.severity == "warning"
    assert re.fullmatch(r"\S+/p\.ply has points that only 40% of the cameras can see .*\.", finding.sentence)


@pytest.mark.hard_case("two SfM points, or 40 in one place", "a warning, and the run starts as without points")
@pytest.mark.parametrize("layout", ["nerfstudio", "colmap", "blender"])
@pytest.mark.parametrize("number", [2, 40])
def test_points_that_span_no_space_are_told_and_not_started_from(
    number: int, layout: str, copied: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    data = copied(layout)
    places = [[0.5, 0.5, 0.5]] * (number - 1) + [[0.5, 0.5, 0.6]]
    if layout == "colmap":

        def keep_some(cameras: Any, images: Any, points: Any) -> None:
            for index in list(points)[number:]:
                del points[index]
            for index, place in zip(list(points), places, strict=True):
                points[index] = points[index]._replace(xyz=np.array(place))

        model(keep_some)(data)
    elif layout == "nerfstudio":
        with_points(places)(data)
    parser: Any = parser_of(data)
    if layout == "blender":
        lines = "".join("{} {} {}\n".format(*place) for place in places)
        (data / "p.ply").write_text(PLY.format(len(places)) + lines)
        parser.ply_path = Path("p.ply")
    config = configure(tmp_path / "out", parser, iterations=2)
    pipeline = set_up(config).pipeline
    assert pipeline.model.seed_points is None
    assert POINTS / 2 < pipeline.model.num_gaussians <= POINTS  # Those near the cameras' paths are left out.
    printed = " ".join(capsys.readouterr().out.split())
    assert "has SfM points in fewer than 3 places, which say too little about the scene: training starts as" in printed
    assert "The data has no SfM points: starting from" in printed


@pytest.mark.hard_case("points beside a Blender scene (`--ply-path`)", "checked as those of other data")
def test_points_beside_a_blender_scene_are_checked(copied: Callable[[str], Path]):
    data = copied("blender")

    def check(*positions: list[float]) -> list[str]:
        lines = "".join("{} {} {}\n".format(*position) for position in positions)
        (data / "p.ply").write_text(PLY.format(len(positions)) + lines)
        findings = check_blender(data, ParserOptions(ply_path=Path("p.ply")))
        return [finding.sentence for finding in findings if finding.severity == "error"]

    actual = check([0.5, 0.5, 0.5], [1, 1, 1])
    assert actual == []
    (sentence,) = check([50, 50, 20], [51, 50, 20])
    assert re.fullmatch(r"\S+/p\.ply has points that no camera can see in front of it: .*\.", sentence)
    (sentence,) = check()
    assert re.fullmatch(r"\S+/p\.ply holds no SfM point: restore it, or leave .*\.", sentence)


@pytest.mark.hard_case(
    "a Blender scene far from the origin, in mm or in km, where its poses stay and random points are 10 units wide",
    "a warning: rename the file to `transforms.json`, whose cameras are centred and scaled",
)
@pytest.mark.parametrize(("scale", "offset"), [(1.0, 60.0), (100.0, 0.0), (0.01, 0.0)])
def test_a_blender_scene_whose_random_points_no_camera_sees_is_told(
    scale: float, offset: float, copied: Callable[[str], Path]
):
    data = copied("blender")

    def told() -> list[str]:
        return [finding.sentence for finding in check_data(data) if finding.severity == "warning"]

    def move(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] = scale * row[3] + offset

    assert told() == []
    meta(move, "transforms_train.json")(data)
    (sentence,) = told()
    assert re.fullmatch(
        r"\S+/transforms_train\.json has cameras \S+ units from the origin, about which random points fill a cube of "
        r"side 10 as training starts: rename it to transforms\.json, whose cameras are centred and scaled\.",
        sentence,
    )
    (data / "transforms_train.json").rename(data / "transforms.json")
    assert errors(data) == []


@pytest.mark.hard_case("one point 10⁵ to 10²⁰⁰ units away", "trains as without it; the run says how many it leaves out")
@pytest.mark.parametrize("far", [1e5, 1e30, 1e200])
def test_a_wild_point_does_not_change_what_training_starts_from(
    far: float, copied: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    def start(data: Path) -> dict[str, Tensor]:
        config = configure(tmp_path / "out", parser_of(data), iterations=1)
        config.pipeline.model.bounding_box_points = True
        config.pipeline.model.starts_per_pixel = 0.0  # All points on the box, as with larger images
        config.pipeline.model.stereo_points = 0  # They would come last on a GPU.
        model = set_up(config).pipeline.model
        return {name: model.gauss_params[name].detach() for name in ("means", "scales", "opacities")}

    data = copied("colmap")
    move_points(lambda positions: positions[[0, 1, 2, 4, *range(4, 60)]])(data)  # the fourth, twice the fifth
    sound = start(data)
    printed = capsys.readouterr().out
    assert "Leaving out" not in printed
    move_points(one_moved_by(far))(data)
    wild = start(data)
    printed = " ".join(capsys.readouterr().out.split())
    assert "Leaving out 1 of 60 SfM points, which are not finite or more than 30 times" in printed
    for name, value in sound.items():
        assert len(wild[name]) == len(value) - 1
        assert wild[name].isfinite().all()
    actual = wild["means"][3:]
    expected = sound["means"][4:]
    assert_close(actual, expected)
    faces = slice(-200, None)
    actual = wild["scales"][faces]
    expected = sound["scales"][faces]
    assert_close(actual, expected)


# --- what looks bad and is not ---


@pytest.mark.hard_case("a truncated JPEG, and one with bytes after its end", "refused; trains, as nerfstudio reads it")
def test_a_jpeg_with_bytes_after_its_end_is_good_and_one_cut_off_is_not(copied: Callable[[str], Path]):
    data = copied("nerfstudio")
    path = data / FIRST  # the name does not matter to Pillow
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)).save(path, "JPEG")
    content = path.read_bytes()
    path.write_bytes(content + b"trailing data of a phone's camera")
    assert errors(data) == []
    path.write_bytes(content[:-20])
    (sentence,) = errors(data)
    assert "000.png cannot be read as an image (image file is truncated" in sentence


@pytest.mark.hard_case("a PNG without its last chunk", "trains, as nerfstudio reads it")
def test_a_png_that_lacks_only_its_last_chunk_is_good_as_it_is_to_nerfstudio(copied: Callable[[str], Path]):
    data = copied("nerfstudio")
    content = (data / FIRST).read_bytes()
    (data / FIRST).write_bytes(content[:-12])
    assert errors(data) == []


@pytest.mark.hard_case(
    "images without poses beside others; an unused image that is a link to itself", "trains; a warning names the first"
)
def test_images_without_poses_beside_others_are_a_warning(copied: Callable[[str], Path]):
    data = copied("colmap")
    model(lambda cameras, images, points: (images.pop(3), images.pop(5)))(data)
    (finding,) = remarks(data)
    assert finding.severity == "warning"
    assert re.fullmatch(r"\S+/002\.png \(and 1 more\) has no pose in \S+ and is not used: .*\.", finding.sentence)


@pytest.mark.hard_case("mixed cameras and sizes", "**trains**")
def test_cameras_of_several_models_and_sizes_train_together(copied: Callable[[str], Path], tmp_path: Path):
    data = copied("colmap")

    def second_camera(cameras: dict, images: dict, points: dict) -> None:
        params = np.array([30.0, 20.0, 15.0, 0.01])
        cameras[2] = colmap_parsing_utils.Camera(2, "SIMPLE_RADIAL", 40, 30, params)
        for index in (2, 4, 6):
            images[index] = images[index]._replace(camera_id=2)
            with Image.open(data / "images" / images[index].name) as image:
                smaller = image.resize((40, 30))
            smaller.save(data / "images" / images[index].name)

    model(second_camera)(data)
    assert remarks(data) == []
    config = configure(tmp_path / "out", parser_of(data), iterations=8)
    config.pipeline.views_per_iteration = 2
    trainer = train(config)
    sizes = {tuple(data["image"].shape[:2]) for data in trainer.pipeline.datamanager.cached_train}
    assert len(sizes) >= 2  # undistortion crops the second camera's
    assert is_finite(trainer.pipeline.model)


@pytest.mark.hard_case(
    "masks of 1, 8 or 16 bits; grey images, or with alpha, among RGB; one mask black; one pixel unmasked; 4 points",
    "trains, finite",
)
def test_images_and_masks_of_several_kinds_and_few_points_train(copied: Callable[[str], Path], tmp_path: Path):
    data = copied("nerfstudio")
    for name, mode in (("001", "RGBA"), ("002", "L")):
        with Image.open(data / f"images/{name}.png") as image:
            image.convert(mode).save(data / f"images/{name}.png")
    for index, mode in enumerate(("L", "1", "I;16", "L", "L")):
        picture(f"mask{index}.png", mode=mode, color=int(index < 4))(data)  # the last one is black
    with Image.open(data / "mask4.png") as image:
        image.putpixel((20, 20), 255)
        image.save(data / "mask3.png")  # of a single pixel
    meta(lambda m: [frame.update(mask_path=f"mask{k % 5}.png") for k, frame in enumerate(m["frames"])])(data)
    with_points([[0, 0, 0.01 * i] for i in range(4)])(data)
    actual = [finding for finding in check_data(data) if finding.severity != "note"]
    assert actual == []
    config = configure(tmp_path / "out", parser_of(data), iterations=8)
    config.pipeline.views_per_iteration = 2
    assert is_finite(train(config).pipeline.model)


@pytest.mark.hard_case("1 or 2 training views of 2", "trains, finite, with a warning")
@pytest.mark.parametrize(("layout", "views", "training"), [("nerfstudio", 2, 2), ("colmap", 2, 1)])
def test_one_or_two_training_views_train_with_a_warning(
    layout: str,
    views: int,
    training: int,
    copied: Callable[[str], Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    data = copied(layout)
    if layout == "colmap":
        model(lambda cameras, images, points: [images.pop(index) for index in range(views + 1, 11)])(data)
    else:
        meta(keep(views))(data)
    trainer = train(configure(tmp_path / "out", parser_of(data), iterations=4))
    assert len(trainer.pipeline.datamanager.train_dataset) == training
    assert is_finite(trainer.pipeline.model)
    printed = " ".join(capsys.readouterr().out.split())
    assert f"leaves {training} training view{'s' * (training > 1)}: so few fix no shape; take 20 or more." in printed


@pytest.mark.hard_case(
    "an images.txt without its second lines, as other programs write it, or with a line too few or too many",
    "refused: each image needs a line of keypoints, which may be empty",
)
def test_an_images_txt_without_lines_of_keypoints_is_refused(tmp_path: Path):
    images = [f"{i} 1 0 0 0 0 0 {i} 1 00{i}.png\n" for i in range(4)]
    path = tmp_path / "images.txt"
    for text in ("".join(images), images[0] + "\n" + images[1] + images[2], images[0] + "\n3 4\n"):
        path.write_text(text)
        told = (
            r"images\.txt: the line after image '00[01]\.png' does not hold its keypoints: each image needs such a line"
        )
        if text.endswith("3 4\n"):
            told = "is not COLMAP's text"
        with refusal(told):
            colmap.read_poses(path)
    path.write_text("# comments\n" + "\n".join(images) + "1.5 2.5 -1 3.5 4.5 7")
    actual = [name for name, _, _ in colmap.read_poses(path)]
    assert actual == ["000.png", "001.png", "002.png", "003.png"]


@pytest.mark.hard_case(
    "a COLMAP model in text with Windows' line ends, tabs, comments between images, empty lines at the end, no end of "
    "the last line, or without tracks",
    "read",
)
@pytest.mark.parametrize("edit", ["crlf", "tabs", "comments", "blank lines", "no end", "no tracks"])
def test_texts_of_other_programs_are_read(edit: str, tmp_path: Path):
    camera = "1 SIMPLE_PINHOLE 64 48 50 32 24\n"
    points = "1 0 0 1 9 8 7 .5 1 0\n2 0 1 1 9 8 7 .5 1 1\n"
    images = "# IMAGE_ID, …\n" + "".join(f"{i} 1 0 0 0 0 0 {i} 1 00{i}.png\n1.5 2.5 -1\n" for i in range(3))
    texts = {"cameras.txt": camera, "images.txt": images, "points3D.txt": points}
    edits: dict[str, Callable[[str], str]] = {
        "crlf": lambda text: text.replace("\n", "\r\n"),
        "tabs": lambda text: text.replace(" ", "\t"),
        "comments": lambda text: "# by me\n" + text.replace("-1\n", "-1\n# next\n") + "# end\n",
        "blank lines": lambda text: "\n" + text + "\n \n\n",
        "no end": str.rstrip,
        "no tracks": lambda text: re.sub(r"(?m) 1 \d$", "", text),
    }
    for name, text in texts.items():
        (tmp_path / name).write_bytes(edits[edit](text).encode())
    actual = [name for name, _, _ in colmap.read_poses(tmp_path / "images.txt")]
    assert actual == ["000.png", "001.png", "002.png"]
    assert colmap.read_cameras(tmp_path / "cameras.txt")[1].params == (50, 32, 24)
    actual = colmap.read_points(tmp_path / "points3D.txt")[0].tolist()
    expected = [[0, 0, 1], [0, 1, 1]]
    assert actual == expected


@pytest.mark.hard_case("an images.txt that is not in UTF-8, even on a line of keypoints", "refused, not a traceback")
def test_an_images_txt_in_another_encoding_is_refused(tmp_path: Path):
    path = tmp_path / "images.txt"
    for keypoints in (b"", b"1 2 \xe9", b"1.5 2.5 -1 " * 2000):
        path.write_bytes(b"1 1 0 0 0 0 0 0 1 000.png\n" + keypoints + b"\n2 1 0 0 0 0 0 0 1 caf\xe9.png\n\n")
        with refusal(r"images\.txt is not COLMAP's text \('utf-8' codec can't decode .*\): copy"):
            colmap.read_poses(path)


# --- what the checks assume of others ---


def test_colmap_s_camera_models_are_those_that_nerfstudio_knows():
    theirs = {i: (m.model_name, m.num_params) for i, m in colmap_parsing_utils.CAMERA_MODEL_IDS.items()}
    actual = dict(enumerate(colmap.CAMERA_PARAMETERS.items()))
    assert actual == theirs


def test_colmap_s_text_and_binary_models_read_alike_and_as_nerfstudio_reads_them(
    copied: Callable[[str], Path], tmp_path: Path
):
    data = copied("colmap")
    binary = data / SPARSE_FOLDER
    theirs = colmap_parsing_utils.read_model(str(binary), ".bin")
    assert theirs is not None
    text = tmp_path / "text"
    text.mkdir()
    colmap_parsing_utils.write_model(*theirs, str(text), ".txt")
    for folder, ext in ((binary, "bin"), (text, "txt")):
        (camera,) = colmap.read_cameras(folder / f"cameras.{ext}").values()
        assert camera.model == "PINHOLE"
        assert camera.width == WIDTH
        assert camera.height == HEIGHT
        assert camera.params == tuple(theirs[0][1].params)
        for (name, camera_id, pose), image in zip(
            colmap.read_poses(folder / f"images.{ext}"), theirs[1].values(), strict=True
        ):
            assert name == image.name
            assert camera_id == 1
            expected = pytest.approx(np.concatenate([image.qvec, image.tvec]), abs=1e-12)
            assert pose == expected
        positions, colors = colmap.read_points(folder / f"points3D.{ext}")
        expected = pytest.approx(np.array([point.xyz for point in theirs[2].values()]), abs=1e-12)
        assert positions == expected
        assert (colors == np.array([point.rgb for point in theirs[2].values()])).all()


@pytest.mark.hard_case(
    "images scaled down with the cameras", "trains; sizes are compared after scaling, with nerfstudio's rounding"
)
@pytest.mark.parametrize("factor", [2, 3])
def test_scaled_down_images_are_compared_with_scaled_down_cameras(
    factor: int, copied: Callable[[str], Path], tmp_path: Path
):
    data = copied("nerfstudio")
    meta(lambda m: [frame.update(w=47, h=35) for frame in m["frames"]])(data)
    (data / f"images_{factor}").mkdir()
    for path in (data / "images").iterdir():
        Image.effect_noise((47 // factor, 35 // factor), 50).save(data / f"images_{factor}" / path.name)
    findings = check_nerfstudio(data, ParserOptions(downscale_factor=factor))
    actual = [finding for finding in findings if finding.severity == "error"]
    assert actual == []
    parser = NerfstudioDataParserConfig(data=data, load_3D_points=True, downscale_factor=factor)
    train(configure(tmp_path / "out", parser, iterations=1))  # nerfstudio agrees
    (sentence,) = errors(data)
    assert "has 48 × 36 px, but its camera" in sentence


@pytest.mark.hard_case(
    "200 photographs of 2 megapixels", "one is decoded to see whether it shows something (.02 s as JPEG, .3 s as PNG)"
)
def test_of_two_hundred_photographs_one_is_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
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
    write_json(data / "transforms.json", {"frames": frames})

    decoded: set[int] = set()
    load = ImageFile.ImageFile.load

    def note(image: ImageFile.ImageFile) -> Any:
        decoded.add(id(image.fp))
        return load(image)

    monkeypatch.setattr(ImageFile.ImageFile, "load", note)
    findings = check_data(data)
    actual = [finding for finding in findings if finding.severity != "note"]
    assert actual == []
    assert len(decoded) == 1  # to see whether it shows something


# --- the command line ---


@pytest.mark.hard_case(
    "an error of input, run or writing",
    "one sentence on stderr, `error: FILE …: REMEDY.`, exit code 1 and no traceback; from Python an ordinary "
    "`ValueError` (`InputError`), `RuntimeError` (`RunError`) or `OSError` (`WriteError`), never a `SystemExit`",
)
def test_uncaught_errors_print_one_sentence_and_exit_with_1():
    for kind, ordinary in ((InputError, ValueError), (RunError, RuntimeError)):
        code = (
            f"import sadgs_ns.training; from sadgs_ns.errors import *; raise {kind.__name__}('Nothing: do something.')"
        )
        result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=HANGS)
        assert result.returncode == 1
        assert result.stderr == "error: Nothing: do something.\n"
        assert kind.__bases__ == (ordinary,)
    code = "import sadgs_ns.training; raise ValueError('somebody else')"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=HANGS)
    assert result.returncode == 1
    assert result.stderr.startswith("Traceback")
    assert "somebody else" in result.stderr


@pytest.mark.hard_case(
    "options that cannot work",
    "refused before anything is written; a run whose checkpoint cannot be read, or is of another capture, "
    "leaves its `config.yml`",
)
@pytest.mark.parametrize(
    ("option", "value", "sentence"),
    [
        ("max_num_iterations", 0, "max_num_iterations must be at least 1, got 0."),
        ("use_grad_scaler", True, "use_grad_scaler must be False, since sadgs trains in float32, got True."),
        ("mixed_precision", True, "mixed_precision must be False, since sadgs trains in float32, got True."),
        ("load_dir", Path("nowhere"), "nowhere holds no checkpoint: give --load-dir the folder"),
        ("load_checkpoint", Path("no.ckpt"), "no.ckpt is no file: give --load-checkpoint one"),
        ("pipeline.views_per_iteration", 0, "pipeline.views_per_iteration must be at least 1, got 0."),
        ("pipeline.frequency_constant", -1.0, "pipeline.frequency_constant must be in (0, 4], got -1."),
        ("pipeline.model.ssim_lambda", 7.0, "pipeline.model.ssim_lambda must be in [0, 1], got 7."),
        ("pipeline.model.initial_opacity", 1.0, "pipeline.model.initial_opacity must be in (0, 1), got 1."),
        ("pipeline.model.opacity_reg", -1.0, "pipeline.model.opacity_reg must be in [0, 100], got -1."),
        ("pipeline.model.strategy.tau_split", 1.5, "pipeline.model.strategy.tau_split must be in [0, 1], got 1.5."),
        (
            "pipeline.model.strategy.max_gaussians",
            0,
            "pipeline.model.strategy.max_gaussians must be at least 1, got 0.",
        ),
    ],
)
def test_options_that_cannot_work_are_refused_in_one_sentence_before_anything_is_written(
    option: str, value: Any, sentence: str, copied: Callable[[str], Path], tmp_path: Path
):
    config = configure(tmp_path / "out", parser_of(copied("colmap")))
    *owners, name = option.split(".")
    setattr(functools.reduce(getattr, owners, config), name, value)
    with pytest.raises(InputError) as refused:
        config.save_config()
    assert str(refused.value).startswith(sentence)
    assert "\n" not in str(refused.value)
    with refusal(re.escape(sentence)):
        set_up(config)
    assert not (tmp_path / "out").exists()


@pytest.mark.hard_case("`ns-train` on bad data", "the sentence alone")
def test_ns_train_on_bad_data_ends_with_the_sentence_alone(
    copied: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    data = copied("colmap")
    (data / FIRST).write_bytes(b"")
    command = ["ns-train", "sadgs", "--output-dir", str(tmp_path / "out")]
    command += ["--data", str(data), "--vis", "tensorboard", "colmap", "--colmap-path", SPARSE]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(InputError) as refused:
        entrypoint()  # here, since importing nerfstudio in another process takes ten seconds
    sys.excepthook(refused.type, refused.value, refused.tb)  # which Python calls for an error that nobody catches
    printed = capsys.readouterr()
    assert "Traceback" not in printed.out + printed.err
    assert printed.err.splitlines()[-1].startswith(f"error: {data / FIRST} has 0 bytes: copy it again, or leave it")
    assert "Config" not in printed.out
    # nerfstudio repeats --data.
    assert len(printed.out.splitlines()) < 5
    assert not (tmp_path / "out").exists()
