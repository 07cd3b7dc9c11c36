"""Files that are nearly there are named in the error, and formats that are not read are called by their names."""

from __future__ import annotations

import re
import shutil
import unicodedata
from collections.abc import Callable
from pathlib import Path

import pycolmap
import pytest
from PIL import Image

from examples.drawn_scene.scene import SPARSE_FOLDER
from helpers.json_files import read_json, write_json
from helpers.short_runs import blender_data, nerfstudio_data
from helpers.small_scenes import HEIGHT, WIDTH
from sadgs_ns.data.checks import check_data
from sadgs_ns.data.checks.colmap import check_colmap
from sadgs_ns.data.checks.findings import Finding
from sadgs_ns.data.checks.transforms import check_nerfstudio
from sadgs_ns.data.images import read_header
from sadgs_ns.data.layouts import ParserOptions
from sadgs_ns.data.nearby import NearbyFiles

COMPOSED = unicodedata.normalize("NFC", "é")
DECOMPOSED = unicodedata.normalize("NFD", "é")


@pytest.fixture
def data(scene: Path, tmp_path: Path) -> Path:
    """A COLMAP model in `sparse/0` and its ten images in `images`."""
    return Path(shutil.copytree(scene, tmp_path / "data"))


def name_images(data: Path, called: Callable[[str], str]) -> None:
    """Give the images of the COLMAP model other names."""
    model = pycolmap.Reconstruction(data / SPARSE_FOLDER)
    for image in model.images.values():
        image.name = called(image.name)
    model.write(data / SPARSE_FOLDER)


def put_in_folder(images: Path, *names: str) -> None:
    """Move the images of a folder into folders in it, in turn."""
    for index, image in enumerate(sorted(images.glob("*.png"))):
        folder = images / names[index % len(names)]
        folder.mkdir(exist_ok=True)
        image.rename(folder / image.name)


def errors(findings: list[Finding]) -> list[str]:
    return [finding.sentence for finding in findings if finding.severity == "error"]


@pytest.mark.hard_case("flat names in a COLMAP model, whose images lie in one folder in `images`", "trains on them")
def test_images_in_a_folder_of_images_are_found(data: Path):
    put_in_folder(data / "images", "camera")
    assert errors(check_data(data)) == []
    (said,) = errors(check_colmap(data, ParserOptions(colmap_path=SPARSE_FOLDER, downscale_factor=1)))
    assert re.search(r"is not in \S+/images, but in \S+/images/camera: add `.* --images-path images/camera", said)


@pytest.mark.hard_case(
    "flat names in a COLMAP model, whose images lie in several folders, and the reverse",
    "refused: names the file that is meant",
)
def test_images_in_other_folders_than_in_the_model_are_named(data: Path):
    put_in_folder(data / "images", "a", "b")
    (said,) = errors(check_data(data))
    images = data / "images"
    assert said == (
        f"{images}/000.png (and 9 more) does not exist, but {images}/a/000.png does: correct the name, or save that as "
        "this."
    )


def test_flat_images_of_names_with_folders_are_named(data: Path):
    name_images(data, lambda name: f"camera/{name}")
    (said,) = errors(check_data(data))
    images = data / "images"
    assert said.startswith(f"{images}/camera/000.png (and 9 more) does not exist, but {images}/000.png does: correct")


@pytest.mark.hard_case("a name in Unicode's NFD on disk and in NFC in the poses, and the reverse", "refused: says so")
@pytest.mark.parametrize(("there", "named", "form"), [(DECOMPOSED, COMPOSED, "NFD"), (COMPOSED, DECOMPOSED, "NFC")])
def test_another_normal_form_is_named(there: str, named: str, form: str, data: Path):
    image = data / "images" / f"{there}.png"
    (data / "images/000.png").rename(image)
    name_images(data, lambda name: name.replace("000", named))
    (said,) = errors(check_data(data))
    assert said == (
        f"{data}/images/{named}.png does not exist, but {image} does, whose name is written in another way "
        f"(Unicode's {form}): rename it."
    )


def test_names_of_a_transforms_file_are_looked_for_too(tmp_path: Path):
    nerfstudio_data(tmp_path)
    (tmp_path / "images/000.png").rename(tmp_path / "images/000.HEIC")
    (said,) = errors(check_data(tmp_path))
    assert re.search(
        r"/000\.png does not exist, but \S+/000\.HEIC does, in a format that is not read: convert it", said
    )


def test_images_of_a_blender_scene_are_looked_for_too(tmp_path: Path):
    blender_data(tmp_path, "white")
    (tmp_path / "images/005.png").rename(tmp_path / f"images/{'005'}.PNG")
    (said,) = errors(check_data(tmp_path))
    assert "/images/005.PNG does: correct the name" in said


def test_a_list_of_images_names_the_one_that_is_meant(tmp_path: Path):
    nerfstudio_data(tmp_path)
    path = tmp_path / "transforms.json"
    meta = read_json(path)
    names = [frame["file_path"] for frame in meta["frames"]]
    lists = {"train_filenames": ["000.PNG", *names[1:]], "val_filenames": [], "test_filenames": []}
    write_json(path, meta | lists)
    (said,) = errors(check_data(tmp_path))
    assert said.endswith(f"names '000.PNG', which is no image with a pose: {names[0]!r} may be meant; correct it.")


STARTS = {
    "HEIC": b"\x00\x00\x00\x18ftypheic",
    "JPEG XL": b"\xff\x0a\xfa\x1f",
    "OpenEXR": b"\x76\x2f\x31\x01\x02",
    "Radiance": b"#?RADIANCE\n",
    "raw": b"\x00\x00\x00\x18ftypcrx ",
}


@pytest.mark.hard_case("EXR, HDR, HEIC, JPEG XL and raw files with poses", "refused: the format, and how to convert")
@pytest.mark.parametrize("kind", STARTS)
def test_formats_that_are_not_read_are_named(kind: str, data: Path):
    image = data / "images/000.png"
    image.write_bytes(STARTS[kind] + bytes(100))
    (said,) = errors(check_data(data))
    assert said.startswith(f"{image} is a file in the format {kind}, which is not read: convert it, as ImageMagick's `")
    Image.new("RGB", (WIDTH, HEIGHT), "red").save(image, "PNG")  # As the remedy says
    assert errors(check_data(data)) == []


def test_the_preview_in_a_raw_file_is_not_taken_for_the_photo(tmp_path: Path):
    preview = tmp_path / "photo.dng"
    Image.new("RGB", (8, 6)).save(preview, "TIFF")
    assert read_header(preview).problem.startswith("is a file in the format raw, which is not read")
    Image.new("RGB", (8, 6)).save(preview, "JPEG")
    assert read_header(preview).problem == ""


@pytest.mark.hard_case("smaller copies in the folders of their images", "refused: names the copy")
@pytest.mark.parametrize("layout", ["json", "colmap"])
def test_copies_in_other_folders_are_named(layout: str, data: Path, tmp_path: Path):
    if layout == "json":
        data = tmp_path / "json"
        nerfstudio_data(data)
    copies = data / "images_4"
    shutil.copytree(data / "images", copies)
    if layout == "json":
        put_in_folder(copies, "a", "b")
        (said,) = errors(check_nerfstudio(data, ParserOptions(downscale_factor=4)))
        missing = "000.png"
        there = "a/000.png"
    else:
        put_in_folder(data / "images", "camera")
        name_images(data, lambda name: f"camera/{name}")
        (said,) = errors(check_colmap(data, ParserOptions(colmap_path=SPARSE_FOLDER, downscale_factor=4)))
        missing = "camera/000.png"
        there = "000.png"
    assert re.match(rf"{copies / missing}.* does not exist, but {copies / there} does: ", said)


def test_copies_of_equal_names_are_refused(tmp_path: Path):
    nerfstudio_data(tmp_path)
    shutil.copytree(tmp_path / "images", tmp_path / "images_2")
    path = tmp_path / "transforms.json"
    meta = read_json(path)
    meta["frames"][1]["file_path"] = "other/000.png"
    write_json(path, meta)
    (said,) = errors(check_nerfstudio(tmp_path, ParserOptions(downscale_factor=2)))
    assert "images_2/000.png would be the copy of both images/000.png and other/000.png, whose folders" in said


def test_files_of_others_and_of_another_kind_are_not_meant(tmp_path: Path):
    for name in ("images/a/0.png", "masks/0.png", "images_2/0.png", ".cache/0.png"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).touch()
    missing = tmp_path / "images/b/0.png"
    actual = NearbyFiles(tmp_path).find(missing)
    assert actual == [tmp_path / "images/a/0.png"]
    assert NearbyFiles(tmp_path, [tmp_path / "images/a/0.png"]).sentence(missing) is None
    actual = NearbyFiles(tmp_path).find(tmp_path / "masks/b/0.JPG")
    assert actual == [tmp_path / "masks/0.png"]
