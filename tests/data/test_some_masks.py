"""Masks for some images only: nothing is hidden in the others, which are counted in a warning."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

import pytest
import tyro
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from PIL import Image

from examples.drawn_scene.scene import SPARSE_FOLDER
from helpers.json_files import read_json, write_json
from helpers.kill_and_resume import set_up
from helpers.refusals import refusal
from helpers.short_runs import configure, nerfstudio_data, train
from helpers.small_scenes import HEIGHT, VIEWS, WIDTH
from sadgs_ns.data.checks import check_data
from sadgs_ns.data.checks.capture import check_capture
from sadgs_ns.training.config import SadgsDatamanagerConfig


def write_mask(path: Path, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    """Write a mask that hides 12 pixels."""
    path.parent.mkdir(exist_ok=True)
    mask = Image.new("L", size, 255)
    mask.paste(0, (0, 0, 4, 3))
    mask.save(path)


def colmap_data(scene: Path, data: Path, factor: int = 1) -> DataParserConfig:
    """A COLMAP model of which two images, the third and the fourth, have masks."""
    shutil.copytree(scene, data)
    size = (WIDTH // factor, HEIGHT // factor)
    for name in ("002.png", "003.png"):
        write_mask(data / "masks" / name)
        write_mask(data / f"masks_{factor}" / name, size)
    if factor > 1:
        for image in sorted((data / "images").iterdir()):
            (data / f"images_{factor}").mkdir(exist_ok=True)
            Image.open(image).resize(size).save(data / f"images_{factor}" / image.name)
    return ColmapDataParserConfig(
        data=data, colmap_path=SPARSE_FOLDER, masks_path=Path("masks"), downscale_factor=factor, eval_mode="all"
    )


def json_data(data: Path) -> DataParserConfig:
    """A transforms.json of which two frames have masks."""
    parser = nerfstudio_data(data)
    path = data / "transforms.json"
    meta = read_json(path)
    for frame in meta["frames"][2:4]:
        frame["mask_path"] = frame["file_path"].replace("images", "masks")
        write_mask(data / frame["mask_path"])
    write_json(path, meta)
    parser.eval_mode = "all"
    return parser


@pytest.mark.hard_case(
    "masks for some images only, of a COLMAP model, its smaller copies or a `transforms.json`",
    "trains; a warning counts them, and nothing is hidden in the others",
)
@pytest.mark.parametrize("layout", ["colmap", "copies", "json"])
def test_nothing_is_hidden_in_images_without_mask(layout: str, scene: Path, tmp_path: Path):
    if layout == "json":
        parser = json_data(tmp_path / "data")
    else:
        parser = colmap_data(scene, tmp_path / "data", 2 if layout == "copies" else 1)
    told = [f for f in check_capture(SadgsDatamanagerConfig(dataparser=parser)) if f.severity == "warning"]
    (said,) = [finding.sentence for finding in told if "masks" in finding.sentence]
    assert f" has masks for 2 of {VIEWS} images: nothing is hidden in the others, such as " in said
    config = configure(tmp_path / "out", parser, iterations=3)
    config.pipeline.datamanager.cache_images = "cpu"
    trainer = train(config)
    manager = trainer.pipeline.datamanager
    hidden = [int((~view["mask"]).sum()) if "mask" in view else 0 for view in manager.cached_train]
    assert hidden == [0, 0, 12, 12, *[0] * (VIEWS - 4)]
    for index, number in enumerate(hidden):  # As `ns-render dataset` reads them
        mask = manager.train_dataset.get_data(index)["mask"]
        expected = manager.train_dataset.get_data(index)["image"].shape[:2]
        assert mask.shape[:2] == expected
        actual = int((~mask.bool()).sum())
        assert actual == number


def test_the_options_that_the_doctor_advises_are_taken(scene: Path, tmp_path: Path):
    data = tmp_path / "data"
    colmap_data(scene, data)
    (said,) = [f.sentence for f in check_data(data) if f.severity == "warning" and "--masks-path" in f.sentence]
    words = shlex.split(said.split("`")[1])
    assert words[0] == "colmap"
    parser = tyro.cli(ColmapDataParserConfig, args=words[1:])
    parser.data = data
    parser.downscale_factor = 1
    findings = check_capture(SadgsDatamanagerConfig(dataparser=parser))
    assert any("has masks for 2 of" in finding.sentence for finding in findings)
    set_up(configure(tmp_path / "out", parser, iterations=1))


@pytest.mark.parametrize("name", ["004.PNG", "camera/004.png", "004.jpg"])
def test_a_mask_that_is_nearly_there_is_named(name: str, scene: Path, tmp_path: Path):
    parser = colmap_data(scene, tmp_path / "data")
    mask = tmp_path / "data/masks" / name
    write_mask(mask)
    with refusal(rf"/masks/004\.png does not exist, but {mask} does: correct the name, or save"):
        check_capture(SadgsDatamanagerConfig(dataparser=parser))


def test_a_folder_without_any_mask_is_refused(scene: Path, tmp_path: Path):
    parser = colmap_data(scene, tmp_path / "data")
    shutil.rmtree(tmp_path / "data/masks")
    with refusal(r"/masks has no mask of any image, such as \S+/000\.png: put masks there, or"):
        check_capture(SadgsDatamanagerConfig(dataparser=parser))


def test_a_mask_that_a_frame_names_must_be_there(tmp_path: Path):
    parser = json_data(tmp_path / "data")
    (tmp_path / "data/masks/002.png").unlink()
    with refusal(r"/masks/002\.png does not exist: put it there"):
        check_capture(SadgsDatamanagerConfig(dataparser=parser))
