"""Copies of scenes with things before some photos, and the masks of them."""

from __future__ import annotations

import filecmp
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from numpy.testing import assert_array_equal
from PIL import Image, ImageDraw

from benchmarks import __main__ as bench
from benchmarks import chain, protocol
from benchmarks.chain import held_out
from benchmarks.cut_outs import OUTLINES, CutOut, Outline, Pixels, all_cut_outs, cut_out, draw_car, draw_person
from benchmarks.datasets import image_names
from benchmarks.disturbed import FILE, choose, disturb, generator_of, pose
from benchmarks.photo_captures import photos_of
from benchmarks.run import build_config
from benchmarks.validation import SPARSE
from examples.drawn_scene.scene import write_scene
from helpers.json_files import read_json
from sadgs_ns.data.images import NO_MASK
from sadgs_ns.data.own_parsers import OWN

CONFIGS = Path(__file__).parents[2] / "configs/bench"


def write_copy(scene: Path, out: Path, *options: str) -> Path:
    status = bench.main(["disturbed", str(scene.parent), str(out), *options])
    assert status == 0
    return out / scene.name


@pytest.fixture(scope="module")
def copy(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The copy of the drawn scene, to be read only."""
    return write_copy(scene, tmp_path_factory.mktemp("copies"))


def pixels(path: Path) -> Pixels:
    with Image.open(path) as image:
        return np.asarray(image)


def disturbed_photos(copy: Path) -> dict[str, dict[str, Any]]:
    return read_json(copy / FILE)["photos"]


def names_in_list(copy: Path, split: str) -> list[str]:
    return (copy / f"{split}_list.txt").read_text().splitlines()


def names_of(scene: Path) -> list[str]:
    return image_names(ColmapDataParserConfig(colmap_path=SPARSE, downscale_factor=1), scene)


# Which photos


@pytest.mark.parametrize(("training", "expected"), [(100, 30), (43, 13), (7, 2), (1, 1)])
def test_thirty_percent_of_the_training_photos_are_chosen_and_at_least_one(training: int, expected: int):
    names = [f"{i:03}.jpg" for i in range(training)]
    clean = names[5::7]
    chosen = choose(names, clean, generator_of(0, "scene"))
    assert len(chosen) == len({*chosen}) == expected
    assert chosen == sorted(chosen)
    assert not {*chosen} & {*clean}


def test_a_copy_disturbs_as_many_photos_as_it_has_to_and_only_those_of_training(scene: Path, copy: Path):
    training = names_in_list(copy, "train")
    assert len(disturbed_photos(copy)) == round(0.3 * len(training)) == 2
    assert {*disturbed_photos(copy)} < {*training}
    assert names_in_list(copy, "test") == names_in_list(copy, "val") == names_of(scene)[4::8]


@pytest.mark.parametrize("fold", [0, 1, 4])
def test_photos_that_are_held_out_are_the_scene_s_byte_by_byte(fold: int, scene: Path, tmp_path: Path):
    copy = write_copy(scene, tmp_path, "--fold", str(fold))
    names = names_of(scene)
    assert names_in_list(copy, "test") == names[fold::8]
    assert {*disturbed_photos(copy)} < {name for i, name in enumerate(names) if i % 8 not in (0, fold)}
    for name in names:
        same = filecmp.cmp(scene / "images" / name, copy / "disturbed" / name, shallow=False)
        assert same == (name not in disturbed_photos(copy))
        assert filecmp.cmp(scene / "images" / name, copy / "images" / name, shallow=False)


def test_photos_that_a_chain_holds_out_are_clean_whatever_the_order_of_the_model(tmp_path: Path):
    from nerfstudio.data.utils import colmap_parsing_utils as colmap

    scene = tmp_path / "scenes/turned"
    write_scene(scene, 48, 36, 24, 300)
    views = colmap.read_images_binary(scene / SPARSE / "images.bin")
    for index, other in zip(sorted(views), sorted(views, reverse=True), strict=True):
        os.rename(scene / "images" / views[index].name, scene / "images" / f"new-{views[other].name}")
    turned = {}
    for index, other in zip(sorted(views), sorted(views, reverse=True), strict=True):
        turned[index] = views[index]._replace(name=f"new-{views[other].name}")
    colmap.write_images_binary(turned, scene / SPARSE / "images.bin")
    assert names_of(scene) != sorted(names_of(scene))
    for seed in range(4):
        copy = write_copy(scene, tmp_path / "copies", "--seed", str(seed))
        disturbed = {*disturbed_photos(copy)}
        assert not disturbed & {*held_out(photos_of(copy / "disturbed"))}
        assert not disturbed & {*names_in_list(copy, "test")}


# What is pasted


def test_masks_are_white_exactly_where_a_photo_is_as_it_was(scene: Path, copy: Path):
    masks = sorted(path.relative_to(copy / "true_masks") for path in (copy / "true_masks").rglob("*.png"))
    assert masks == sorted(Path(name).with_suffix(".png") for name in disturbed_photos(copy))
    for name, photo in disturbed_photos(copy).items():
        differs = (pixels(scene / "images" / name) != pixels(copy / "disturbed" / name)).any(axis=-1)
        mask = pixels((copy / "true_masks" / name).with_suffix(".png"))
        expected = np.where(differs, 0, 255)
        assert_array_equal(mask, expected)
        assert 0.03 <= differs.mean() <= 0.15
        assert photo["share"] == pytest.approx(differs.mean(), abs=1e-4)
        assert 1 <= len(photo["things"]) <= 3


def test_each_photo_has_one_to_three_things_that_cover_3_to_15_percent_of_it():
    photo = np.full((80, 120, 3), 90, np.uint8)
    things = all_cut_outs(None)
    numbers = set()
    shares = []
    for seed in range(60):
        result, covered, names = disturb(photo, things, np.random.default_rng(seed))
        expected = (result != photo).any(axis=-1)
        assert_array_equal(covered, expected)
        numbers.add(len(names))
        shares.append(covered.mean())
    assert numbers == {1, 2, 3}
    assert 0.03 <= min(shares) < 0.05
    assert 0.11 < max(shares) <= 0.15


@pytest.mark.parametrize("level", [0, 255])
def test_a_thing_of_the_photo_s_own_colour_still_makes_a_difference(level: int):
    photo = np.full((60, 60, 3), level, np.uint8)
    thing = CutOut("plain", np.dstack([np.full((20, 20, 3), level, np.uint8), np.full((20, 20), 255, np.uint8)]))
    result, covered, _ = disturb(photo, [thing], np.random.default_rng(0))
    difference = np.abs(result.astype(int) - photo).sum(axis=-1)
    expected = covered.astype(int)
    assert_array_equal(difference, expected)


def test_a_thing_keeps_its_colour_and_fades_at_its_edge_alone():
    square = np.dstack([np.full((40, 40, 3), 200, np.uint8), np.full((40, 40), 255, np.uint8)])
    posed = pose(CutOut("square", square), 900.0, np.random.default_rng(1))
    opacity = posed[..., 3]
    assert np.count_nonzero(opacity) == pytest.approx(900, rel=0.1)
    assert np.abs(posed[opacity > 0, :3].astype(int) - 200).max() <= 2
    faded = (opacity > 0) & (opacity < 255)
    # An edge of one pixel around a square of 30 px
    assert 80 < np.count_nonzero(faded) < 200


def test_a_photo_into_which_nothing_fits_is_named(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    small = tmp_path / "scenes/small"
    (small / "images").mkdir(parents=True)
    (small / "sparse").symlink_to(scene / "sparse")
    for name in names_of(scene):
        Image.new("RGB", (2, 2)).save(small / "images" / name)
    status = bench.main(["disturbed", str(small.parent), str(tmp_path / "copies")])
    assert status == 2
    error = capsys.readouterr().err
    assert "do not fit into 2 × 2 px" in error
    assert str(small / "images") in error
    assert error.count("\n") == 1
    assert not [*(tmp_path / "copies").iterdir()]


# Seeds


def test_the_same_seed_writes_the_same_copy_and_another_one_another(scene: Path, copy: Path, tmp_path: Path):
    again = write_copy(scene, tmp_path / "again")
    other = write_copy(scene, tmp_path / "other", "--seed", "1")
    written = sorted(path.relative_to(copy) for path in copy.rglob("*") if path.is_file())
    expected = sorted(path.relative_to(again) for path in again.rglob("*") if path.is_file())
    assert written == expected
    for name in written:
        assert (copy / name).read_bytes() == (again / name).read_bytes()
    assert disturbed_photos(other) != disturbed_photos(copy)


def test_a_copy_does_not_depend_on_the_other_scenes_and_replaces_an_earlier_one(
    scene: Path, copy: Path, tmp_path: Path
):
    root = tmp_path / "scenes"
    root.mkdir()
    for name in ("another", scene.name):
        (root / name).symlink_to(scene)
    out = tmp_path / "copies"
    status = bench.main(["disturbed", str(root), str(out), "--seed", "1"])
    assert status == 0
    status = bench.main(["disturbed", str(root), str(out)])
    assert status == 0
    actual = sorted(path.name for path in out.iterdir())
    expected = sorted(["another", scene.name])
    assert actual == expected
    assert disturbed_photos(out / scene.name) == disturbed_photos(copy) != disturbed_photos(out / "another")
    status = bench.main(["disturbed", str(root), str(tmp_path / "one"), "--only", "another"])
    assert status == 0
    names = [path.name for path in (tmp_path / "one").iterdir()]
    assert names == ["another"]


# Cut-outs


def test_an_outline_is_moved_to_the_edge_of_the_thing(tmp_path: Path):
    noise = np.random.default_rng(0).integers(-5, 6, (200, 240, 3))
    image = Image.new("RGB", (240, 200), (190, 190, 180))
    ImageDraw.Draw(image).rectangle((80, 60, 159, 139), (40, 60, 130))
    Image.fromarray(np.uint8(np.asarray(image) + noise)).save(tmp_path / "photo.png")
    outline = Outline("photo.png", ((77, 57), (163, 56), (162, 143), (84, 144)))
    thing = cut_out(tmp_path, outline)
    assert thing.pixels.shape == (80, 80, 4)
    assert thing.area == 80 * 80
    assert thing.pixels[..., 2].min() > 100  # The square is blue, and its surroundings are cut away.
    assert thing.pixels[..., 0].max() < 100


def test_photos_to_cut_out_are_read_only_if_they_are_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    actual = {thing.name.split()[1] for thing in all_cut_outs(None)}
    assert actual == {"person", "car"}
    for thing, is_high in ((draw_person("#b03030", "#28324a"), True), (draw_car("#2d5fa8"), False)):
        height, width = thing.pixels.shape[:2]
        assert (height > width) == is_high
        assert {*np.unique(thing.pixels[..., 3])} == {0, 255}
        assert thing.area > height * width / 3
    (tmp_path / "plush").mkdir()
    with pytest.raises(ValueError, match=r"plush/0007\.jpg cannot be read; give the folder that holds plush and mouse"):
        all_cut_outs(tmp_path)
    Image.new("RGB", (100, 100)).save(tmp_path / OUTLINES[0].photo)
    with pytest.raises(ValueError, match=r"0007\.jpg is smaller than the outline"):
        all_cut_outs(tmp_path)


# Reading a copy


def parser_of(label: str, copy: Path, work: Path) -> Any:
    """The parser of a row of the protocol, for a copy in the place of fox."""
    rows = protocol.load(CONFIGS / "disturbed.yaml")
    jobs = {(job.scene.name, job.row.label, job.seed): job for job in rows.jobs()}
    job = jobs["fox", label, 0]
    root = work / "copies"
    root.mkdir()
    (root / "fox").symlink_to(copy)
    config: Any = build_config(job.scene, job.row, job.seed, root, work / "run")
    parser = config.pipeline.datamanager.dataparser
    parser.data = config.pipeline.datamanager.data
    parser._target = OWN[parser._target]  # as a run does
    return parser.setup()


@pytest.mark.parametrize(
    ("label", "folder", "has_masks"),
    [
        ("clean", "images", False),
        ("disturbed", "disturbed", False),
        ("true masks", "disturbed", True),
        ("finding", "disturbed", False),
        ("finding, clean", "images", False),
        ("finding, true masks", "disturbed", True),
    ],
)
def test_rows_of_the_protocol_read_the_photos_and_masks_that_they_name(
    label: str, folder: str, has_masks: bool, copy: Path, tmp_path: Path
):
    parser = parser_of(label, copy, tmp_path)
    for split in ("train", "test"):
        outputs = parser.get_dataparser_outputs(split)
        names = [path.name for path in outputs.image_filenames]
        assert names == names_in_list(copy, split)
        actual = {path.parent.name for path in outputs.image_filenames}
        assert actual == {folder}
        masked = {path.name for path in outputs.mask_filenames or [] if path != NO_MASK}
        expected = {Path(name).with_suffix(".png").name for name in disturbed_photos(copy)}
        assert masked == (expected if has_masks and split == "train" else set())


def test_the_protocol_of_cameras_has_clean_and_disturbed_photos_of_the_same_scenes():
    captures = chain.load(CONFIGS / "disturbed-cameras.yaml").captures
    scenes = [*protocol.load(CONFIGS / "disturbed.yaml").scenes]
    expected = {}
    for scene in scenes:
        expected |= {scene: f"{scene}/images", f"{scene}-disturbed": f"{scene}/disturbed"}
    assert captures == expected
    assert len(scenes) == 5


# Wrong input


def test_wrong_input_is_one_sentence_and_leaves_all_as_it_was(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "copies"
    (out / scene.name).mkdir(parents=True)
    (out / scene.name / "kept").touch()
    root = str(scene.parent)
    new = str(tmp_path / "new")
    for arguments, sentence in (
        ([str(tmp_path / "none"), new], "holds no folder with images and sparse/0; give"),
        ([root, str(out)], f"holds no {FILE}, so it is no earlier copy; give another folder"),
        ([root, root], f"holds no {FILE}, so it is no earlier copy; give another folder"),
        ([root, new, "--fold", "8"], "--fold must be from 0 to 7, not 8"),
        ([root, new, "--seed", "-1"], "--seed must be 0 or more, not -1"),
        ([root, new, "--only", "kitchen"], "--only names 'kitchen'"),
        ([root, new, "--photos", str(tmp_path)], "cannot be read; give the folder"),
    ):
        status = bench.main(["disturbed", *arguments])
        assert status == 2
        error = capsys.readouterr().err
        assert sentence in error
        assert error.count("\n") == 1
    assert (out / scene.name / "kept").exists()
    assert (scene / "images").is_dir()
    assert not Path(new).exists()
