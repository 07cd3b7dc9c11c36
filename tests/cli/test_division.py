"""Which views `sadgs` trains on and which `--measure` holds out, of new and of given cameras."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from helpers.captures import write_capture
from helpers.json_files import read_json, write_json
from helpers.refusals import refusal
from helpers.short_runs import blender_data
from sadgs_ns.cli.added_photos import choose_run
from sadgs_ns.cli.division import divide
from sadgs_ns.cli.photos_to_splat import PhotosToSplat
from sadgs_ns.cli.sadgs_folder import SadgsFolder, Settings
from sadgs_ns.cli.sadgs_options import Sadgs
from sadgs_ns.cli.sadgs_stages import _train_command
from sadgs_ns.data.own_parsers import OWN
from sadgs_ns.training.run.train_options import read_options

VIEWS = [f"images/{i:02d}.png" for i in range(20)]
PANORAMAS = [f"images/{i:02d}.jpg/{view}.jpg" for i in range(10) for view in range(8)]


def test_all_views_are_trained_on_unless_they_shall_be_measured():
    divided = divide(VIEWS, measure=False)
    assert divided == {"train_filenames": VIEWS, "val_filenames": [], "test_filenames": []}
    assert divide(VIEWS, False, VIEWS[:10], VIEWS[:2]) == divided, "also if some were held out before"


def test_every_eighth_view_is_held_out_to_be_measured():
    divided = divide(VIEWS, measure=True)
    assert divided["val_filenames"] == divided["test_filenames"] == [VIEWS[0], VIEWS[8], VIEWS[16]]
    assert divided["train_filenames"] == [name for name in VIEWS if name not in divided["test_filenames"]]


def test_held_out_views_stay_so_when_photos_are_added():
    before = divide(VIEWS[:10], measure=True)["test_filenames"]
    after = divide(VIEWS, True, VIEWS[:10], before)
    assert after["test_filenames"] == [VIEWS[0], VIEWS[8], VIEWS[17]]
    assert len(after["train_filenames"]) == 17
    assert divide(VIEWS[:11], True, VIEWS[:10], before)["test_filenames"] == before
    between = [*VIEWS[:3], "images/02-b.png", *VIEWS[3:10]]
    assert divide(between, True, VIEWS[:10], before)["test_filenames"] == before


@pytest.mark.hard_case("`sadgs PANORAMAS --measure`", "every eighth panorama is held out with all its views")
def test_panoramas_are_held_out_whole():
    views = ["images/a.png", *PANORAMAS]
    divided = divide(views, measure=True)
    assert divided["test_filenames"] == ["images/a.png", *PANORAMAS[7 * 8 : 8 * 8]]
    assert len(divided["train_filenames"]) == len(views) - 9
    later = [name.replace("images/", "images/later/") for name in PANORAMAS]
    grown = divide([*views, *later], True, views, [*divided["test_filenames"], later[0]])
    expected = [*divided["test_filenames"], *later[7 * 8 : 8 * 8]]
    assert grown["test_filenames"] == expected
    few = divide(PANORAMAS[: 4 * 8], measure=True)
    assert few["test_filenames"] == PANORAMAS[: 4 * 8 : 8], "of few panoramas single views are"
    in_folder = [f"images/room.1/{i}.jpg" for i in range(8)]
    assert divide(in_folder, measure=True)["test_filenames"] == in_folder[:1], "this folder is no panorama"


def write_scene(folder: SadgsFolder, views: Sequence[str]) -> None:
    folder.scene.mkdir(parents=True, exist_ok=True)
    content = json.dumps({"frames": [{"file_path": name} for name in views]})
    (folder.scene / "transforms.json").write_text(content)


def test_until_something_is_trained_the_division_may_be_another_one(tmp_path: Path):
    folder = SadgsFolder(tmp_path)
    write_scene(folder, VIEWS)
    for measure, held_out in ((False, 0), (True, 3), (False, 0)):
        folder.settings.measure = measure
        choose_run(folder, [])
        described = read_json(folder.scene / "transforms.json")
        assert len(described["test_filenames"]) == held_out
        assert len(described["train_filenames"]) == 20 - held_out


@pytest.mark.hard_case(
    "photos are added to a folder of `sadgs`, which gets another `--effort` in the same command",
    "the held-out photos and the coordinates stay, and the earlier splat is kept",
)
def test_held_out_views_and_frame_stay_when_photos_and_options_change_at_once(tmp_path: Path):
    folder = SadgsFolder(tmp_path)
    write_scene(folder, VIEWS[:10])
    folder.settings.measure = True
    choose_run(folder, [])
    held_out = read_json(folder.scene / "transforms.json")["test_filenames"]
    moved = {"transform": [[1, 0, 0, 2], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 0.5}
    checkpoints = folder.run / "nerfstudio_models"
    checkpoints.mkdir(parents=True)
    (checkpoints / "step-000000007.ckpt").touch()
    write_json(folder.run / "dataparser_transforms.json", moved)
    folder.splat("ply").touch()

    folder.begin_another_run()  # Its options differ, and it has saved nothing when the photos are placed.
    run = folder.run
    described = read_json(folder.scene / "transforms.json")
    write_json(folder.scene / "transforms.json", described | {"frames": [{"file_path": name} for name in VIEWS]})
    choose_run(folder, [])
    grown = read_json(folder.scene / "transforms.json")
    assert held_out == [VIEWS[0], VIEWS[8]]
    assert grown["test_filenames"] == [*held_out, VIEWS[17]]
    assert grown["dataparser_transform"] == moved["transform"]
    assert grown["dataparser_scale"] == moved["scale"]
    assert folder.run == run, "the run that was begun goes on"
    assert (tmp_path / "earlier/run/splat.ply").is_file()


@pytest.mark.hard_case(
    "photos are added to a folder of `sadgs` whose scene was deleted and found anew before",
    "the frame of the deleted scene is not kept",
)
def test_the_frame_of_a_scene_that_was_deleted_is_not_kept(tmp_path: Path):
    folder = SadgsFolder(tmp_path)
    checkpoints = folder.run / "nerfstudio_models"
    checkpoints.mkdir(parents=True)
    (checkpoints / "step-000000007.ckpt").touch()
    write_json(folder.run / "dataparser_transforms.json", {"transform": [[1, 0, 0, 2]], "scale": 0.5})
    folder.settings.run = folder.new_run_name(5)  # As after somebody deleted the scene; it has saved nothing yet.
    folder.settings.measure = False
    write_scene(folder, VIEWS[:10])
    choose_run(folder, [])
    write_scene(folder, VIEWS)
    choose_run(folder, [])
    assert "dataparser_transform" not in read_json(folder.scene / "transforms.json")


def test_a_run_with_as_many_views_as_an_earlier_one_has_a_folder_of_its_own(tmp_path: Path):
    folder = SadgsFolder(tmp_path)
    folder.settings.measure = False
    moved = {"transform": [[1, 0, 0, 2]], "scale": 0.5}
    runs = []
    for views in (VIEWS[:10], VIEWS[1:11], VIEWS[2:12]):  # One is taken out, and another one added.
        write_scene(folder, views)
        choose_run(folder, [])
        checkpoints = folder.run / "nerfstudio_models"
        checkpoints.mkdir(parents=True)
        (checkpoints / "step-000000007.ckpt").touch()
        write_json(folder.run / "dataparser_transforms.json", moved)
        runs.append(folder.run.name)
    assert runs == ["run", "run-10", "run-11"]


def test_another_run_on_the_same_views_divides_them_alike_and_finds_its_own_frame(tmp_path: Path):
    folder = SadgsFolder(tmp_path)
    write_scene(folder, VIEWS)
    folder.settings.measure = True
    choose_run(folder, [])
    first = read_json(folder.scene / "transforms.json")
    checkpoints = folder.run / "nerfstudio_models"
    checkpoints.mkdir(parents=True)
    (checkpoints / "step-000000007.ckpt").touch()
    folder.begin_another_run()
    choose_run(folder, [])
    assert read_json(folder.scene / "transforms.json") == first


def test_options_of_ns_train_that_divide_the_views_do_it(tmp_path: Path):
    folder = SadgsFolder(tmp_path)
    write_scene(folder, VIEWS)
    folder.settings.measure = True
    choose_run(folder, ["nerfstudio-data", "--train-split-fraction", "0.5"])
    actual = read_json(folder.scene / "transforms.json").keys()
    assert actual == {"frames"}


def train_command(source: Path, output: Path, measure: bool, options: Sequence[str] = ()) -> list[str]:
    """The command that `sadgs` would train with on given cameras."""
    work = PhotosToSplat(Sadgs(source, output, formats="ply", measure=measure), list(options), Console(quiet=True))
    return _train_command(work, is_resumed=False)


@pytest.fixture
def given(scene: Path, tmp_path: Path) -> Path:
    """A capture with a `transforms.json` that has no lists of images."""
    capture = write_capture("transforms.json", tmp_path / "capture", scene)
    shutil.rmtree(capture.mask.parent)
    described = read_json(capture.cameras)
    for frame in described["frames"]:
        del frame["mask_path"]
    write_json(capture.cameras, described)
    return capture.folder


@pytest.mark.hard_case(
    "`sadgs FOLDER` with a `transforms.json` without lists of images",
    "all images are trained on; `--measure` holds every eighth out; the file stays as it is",
)
@pytest.mark.parametrize("options", [[], ["nerfstudio-data", "--downscale-factor", "1"]])
def test_given_cameras_without_lists_are_divided_as_others(given: Path, tmp_path: Path, options: list[str]):
    content = (given / "transforms.json").read_bytes()
    count = len(json.loads(content)["frames"])
    for measure, held_out in ((False, []), (True, [*range(0, count, 8)])):
        command = train_command(given, tmp_path / "out", measure, options)
        manager: Any = read_options(command[2:]).pipeline.datamanager
        config = manager.dataparser
        config.data = given
        config.downscale_factor = 1  # Otherwise nerfstudio opens an image and leaves it open.
        parser = OWN[config._target](config)
        images = {split: parser.get_dataparser_outputs(split).image_filenames for split in ("train", "val", "test")}
        every = sorted(images["train"] + images["test"])
        assert len(every) == count
        assert images["val"] == images["test"] == [every[i] for i in held_out]
    assert (given / "transforms.json").read_bytes() == content


@pytest.mark.parametrize("layout", ["sparse/0", "beside", "lists", "blender"])
def test_a_division_that_is_given_stays(layout: str, scene: Path, given: Path, tmp_path: Path):
    source = given
    if layout == "lists":
        described = read_json(given / "transforms.json")
        names = [frame["file_path"] for frame in described["frames"]]
        described |= {"train_filenames": names[3:], "val_filenames": names[:3], "test_filenames": names[:3]}
        write_json(given / "transforms.json", described)
    elif layout == "blender":
        source = tmp_path / "blender"
        blender_data(source, None)
    else:
        source = write_capture(layout, tmp_path / "model", scene).folder
    for measure in (False, True):
        command = train_command(source, tmp_path / "out", measure)
        assert command[-2:] == ["--pipeline.effort", "1"]


@pytest.mark.parametrize(
    "options", [["nerfstudio-data", "--eval-mode", "all"], ["colmap"], ["instant-ngp-data", "--data", "x"]]
)
def test_options_that_divide_given_cameras_or_name_another_parser_stay(
    given: Path, tmp_path: Path, options: list[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("sadgs_ns.cli.photos_to_splat.check_options", lambda *others: None)
    assert train_command(given, tmp_path / "out", True, options)[-len(options) :] == options


@pytest.mark.hard_case(
    "`sadgs FOLDER --measure` with a division that holds no image out", "refused before anything is done"
)
def test_given_lists_that_hold_nothing_out_cannot_be_measured(given: Path, tmp_path: Path):
    described = read_json(given / "transforms.json")
    described["train_filenames"] = [frame["file_path"] for frame in described["frames"]]
    described |= {"val_filenames": [], "test_filenames": []}
    write_json(given / "transforms.json", described)
    with refusal(r"the lists in \S+/transforms\.json hold out none: name some as test_file"):
        train_command(given, tmp_path / "out", True)
    assert train_command(given, tmp_path / "out", False)[-2:] == ["--pipeline.effort", "1"]
    blender = tmp_path / "blender"
    blender_data(blender, None)
    (blender / "transforms_test.json").unlink()
    with refusal(r"held out, and \S+/transforms_test\.json does not exist: leave it out; or"):
        train_command(blender, tmp_path / "out", True)


@pytest.mark.hard_case(
    "a folder that an earlier version of `sadgs` began on given cameras", "its views stay divided as they are"
)
def test_given_cameras_on_which_an_earlier_version_trained_stay_divided(given: Path, tmp_path: Path):
    out = tmp_path / "out"
    work = PhotosToSplat(Sadgs(given, out, formats="ply"), [], Console(quiet=True))
    assert work.given is not None
    settings = Settings(str(given.resolve()), work.given.describe(), 1600, 1.0, [], files=work.given.stamp_images())
    checkpoints = out / "training/sadgs/run/nerfstudio_models"
    checkpoints.mkdir(parents=True)
    settings.write(out / "settings.json")
    assert train_command(given, out, False)[-1] == "1", "nothing is trained yet"
    (checkpoints / "step-000000007.ckpt").touch()
    for measure in (False, True):
        assert train_command(given, out, measure)[-2:] == ["--pipeline.effort", "1"]
