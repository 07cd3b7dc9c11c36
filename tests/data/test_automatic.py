"""The parser that is chosen where none is named: by what the folder holds, and for good in the run's config.yml."""

from __future__ import annotations

import copy
import re
import shlex
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pycolmap
import pytest
import tyro
import yaml
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image

from examples.drawn_scene.scene import SPARSE_FOLDER, write_scene
from helpers.json_files import read_json, write_json
from helpers.refusals import refusal
from helpers.short_runs import blender_data, configure, nerfstudio_data, train
from helpers.small_scenes import HEIGHT, VIEWS, WIDTH
from sadgs_ns.data import colmap
from sadgs_ns.data.checks import check_data
from sadgs_ns.data.checks.capture import check_capture
from sadgs_ns.data.layouts import find_reconstructions
from sadgs_ns.data.own_parsers import ColmapParser
from sadgs_ns.data.parsers import AutomaticDataParserConfig, choose_parser
from sadgs_ns.errors import InputError
from sadgs_ns.training.config import SadgsDatamanagerConfig


def colmap_in(folder: str) -> Callable[[Path, Path], None]:
    """Lay a drawn scene out with its reconstruction in a folder."""

    def lay_out(scene: Path, data: Path) -> None:
        shutil.copytree(scene / "images", data / "images")
        shutil.copytree(scene / SPARSE_FOLDER, data / folder)

    return lay_out


def beside_a_reconstruction(scene: Path, data: Path) -> None:
    nerfstudio_data(data)
    model = data / "colmap/sparse/0"
    shutil.copytree(scene / SPARSE_FOLDER, model, ignore=shutil.ignore_patterns("points3D.*"))
    points = [f"{i} 0.5 0.5 {-0.5 + 0.01 * i} 90 90 90 0\n" for i in range(1, 5)]
    (model / "points3D.txt").write_text("".join(points))  # The scene's points are not of these photos.


def named_with_folder(scene: Path, data: Path) -> None:
    """Lay a drawn scene out with a model whose names of images begin with their folder, as some programs write it."""
    colmap_in("sparse/1")(scene, data)
    model = pycolmap.Reconstruction(data / "sparse/1")
    for image in model.images.values():
        image.name = f"images/{image.name}"
    model.write(data / "sparse/1")


def colmap_layout(model: str, images: str, lay_out: Callable[[Path, Path], None] | None = None) -> Any:
    """A layout with its reconstruction and its images in other folders than the usual ones."""

    def lay_out_there(scene: Path, data: Path) -> None:
        shutil.copytree(scene / "images", data / images)
        shutil.copytree(scene / SPARSE_FOLDER, data / model, dirs_exist_ok=True)

    def expected(data: Path) -> DataParserConfig:
        return ColmapDataParserConfig(data=data, colmap_path=Path(model), images_path=Path(images), downscale_factor=1)

    return lay_out or lay_out_there, expected


LAYOUTS: dict[str, tuple[Callable[[Path, Path], Any], Callable[[Path], DataParserConfig]]] = {
    **{
        folder: (
            colmap_in(folder),
            lambda data, folder=folder: ColmapDataParserConfig(data=data, colmap_path=Path(folder), downscale_factor=1),
        )
        for folder in ("sparse/0", "colmap/sparse/0", "sparse")
    },
    "beside the images": colmap_layout("", "images"),
    "among the images": colmap_layout("", ""),
    "among the images in their folder": colmap_layout("images", "images"),
    "sparse/1": colmap_layout("sparse/1", "images"),
    "images named with their folder": colmap_layout("sparse/1", "", named_with_folder),
    "images in a folder of another name": colmap_layout("sparse/0", "my photos"),
    "images beside the model": colmap_layout("colmap/sparse/0", "colmap/images"),
    "transforms.json": (
        lambda scene, data: nerfstudio_data(data),
        lambda data: NerfstudioDataParserConfig(data=data, load_3D_points=True),
    ),
    "both": (beside_a_reconstruction, lambda data: NerfstudioDataParserConfig(data=data, load_3D_points=True)),
    "blender": (lambda scene, data: blender_data(data, "white"), lambda data: BlenderDataParserConfig(data=data)),
}


@pytest.mark.hard_case(
    "`ns-train sadgs --data FOLDER` and `sadgs-doctor FOLDER` on `sparse/0`, `colmap/sparse/0`, `sparse`, "
    "`transforms.json`, Blender",
    "trains",
)
@pytest.mark.hard_case(
    "a COLMAP model beside its images or among them, in `sparse/1` alone; images in a folder of another name; names of "
    "images that begin with that folder's",
    "trains: model and images are found",
)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_parser_is_chosen_by_what_the_folder_holds(layout: str, scene: Path, tmp_path: Path):
    data = tmp_path / "capture"
    lay_out, expected = LAYOUTS[layout]
    lay_out(scene, data)
    config = SadgsDatamanagerConfig(data=data)
    actual = [finding for finding in check_data(data) if finding.severity != "note"]
    assert actual == []
    actual = [finding for finding in check_capture(config) if finding.severity != "note"]
    assert actual == []
    assert config.dataparser == expected(data)
    if isinstance(config.dataparser, ColmapDataParserConfig):
        parsed = config.dataparser.setup().get_dataparser_outputs()
        assert len(parsed.image_filenames) == 8
        for path in parsed.image_filenames:
            assert path.is_file()


@pytest.mark.hard_case(
    "a COLMAP model whose points are in `points3D.ply` alone, as programs for splats write it",
    "trains from these points; it was refused as without any",
)
def test_the_points_of_a_model_may_be_in_a_ply(scene: Path, tmp_path: Path):
    colmap_in("sparse/0")(scene, tmp_path)
    binary = tmp_path / "sparse/0/points3D.bin"
    pycolmap.Reconstruction(binary.parent).export_PLY(binary.with_suffix(".ply"))
    positions, colors = colmap.read_points(binary)
    binary.unlink()
    config = SadgsDatamanagerConfig(data=tmp_path)
    assert [finding for finding in check_capture(config) if finding.severity != "note"] == []
    config.dataparser._target = ColmapParser
    metadata = config.dataparser.setup().get_dataparser_outputs().metadata
    actual = {*map(tuple, metadata["points3D_rgb"].tolist())}
    expected = {*map(tuple, colors.tolist())}
    assert actual == expected
    assert len(metadata["points3D_xyz"]) == len(positions)


@pytest.mark.hard_case(
    "a parser named without the folders of model and images, where these lie elsewhere",
    "refused: says which options to add, with which it trains",
)
@pytest.mark.parametrize("layout", [name for name, (_, expected) in LAYOUTS.items() if "images" in name])
def test_the_options_that_a_named_parser_lacks_are_told(layout: str, scene: Path, tmp_path: Path):
    data = tmp_path / "capture"
    lay_out, expected = LAYOUTS[layout]
    lay_out(scene, data)
    with refusal(r": add `.*` after `colmap`\.$") as refused:
        check_capture(SadgsDatamanagerConfig(dataparser=ColmapDataParserConfig(data=data)))
    config = parsed("colmap", *shlex.split(str(refused.value).split("`")[1]))
    config.data = data
    actual = [finding for finding in check_capture(config) if finding.severity != "note"]
    assert actual == []
    expected_parser = expected(data)
    assert isinstance(config.dataparser, ColmapDataParserConfig)
    assert isinstance(expected_parser, ColmapDataParserConfig)
    assert config.dataparser.colmap_path == expected_parser.colmap_path
    assert config.dataparser.images_path == expected_parser.images_path


@pytest.mark.hard_case(
    "models of as many images in `sparse` and `sparse/0`, as after undistorting in place; a copy of one model",
    "a warning: names the options that train on the other; none",
)
def test_another_model_of_as_many_images_is_told(scene: Path, tmp_path: Path):
    colmap_in("sparse/0")(scene, tmp_path)
    for file in (tmp_path / "sparse/0").iterdir():
        shutil.copy(file, tmp_path / "sparse")
    actual = [finding for finding in check_data(tmp_path) if finding.severity != "note"]
    assert actual == []
    model = pycolmap.Reconstruction(tmp_path / "sparse")
    model.transform(pycolmap.Sim3d(2.0, pycolmap.Rotation3d(), [5.0, 0.0, 0.0]))
    model.write(tmp_path / "sparse")
    (told,) = [finding.sentence for finding in check_data(tmp_path) if finding.severity == "warning"]
    assert told == (
        f"{tmp_path}/sparse/0/images.bin has {VIEWS} images, {tmp_path}/sparse has {VIEWS}: end the command with "
        "`colmap --colmap-path sparse` to train on those."
    )


@pytest.mark.hard_case("`sparse/1` has more images than `sparse/0`", "a warning: names the options that train on it")
def test_a_larger_model_is_told(scene: Path, tmp_path: Path):
    colmap_in("sparse/1")(scene, tmp_path)
    smaller = pycolmap.Reconstruction(tmp_path / "sparse/1")
    smaller.deregister_frame(next(iter(smaller.frames)))
    (tmp_path / "sparse/0").mkdir()
    smaller.write(tmp_path / "sparse/0")
    sentences = [finding.sentence for finding in check_data(tmp_path) if finding.severity == "warning"]
    model = tmp_path / "sparse"
    assert (
        f"{model}/0/images.bin has {VIEWS - 1} images, {model}/1 has {VIEWS}: end the command with `colmap "
        "--colmap-path sparse/1` to train on those."
    ) in sentences
    config = parsed("colmap", "--colmap-path", "sparse/1")
    config.data = tmp_path
    actual = [finding for finding in check_capture(config) if finding.severity != "note"]
    assert actual == []


@pytest.mark.hard_case(
    "masks of a COLMAP model called `NAME.png`, `NAME.jpg.png` (COLMAP), `NAME_mask.png`, `NAME.mask.png`", "are read"
)
@pytest.mark.parametrize("called", ["{stem}.png", "{stem}.png.png", "{stem}_mask.png", "{stem}.mask.png"])
def test_masks_are_read_by_the_names_in_use(called: str, scene: Path, tmp_path: Path):
    data = Path(shutil.copytree(scene, tmp_path / "capture"))
    (data / "masks").mkdir()
    for index, image in enumerate(sorted((data / "images").iterdir())):
        mask = Image.new("L", (WIDTH, HEIGHT), 255)
        mask.paste(0, (0, 0, index + 1, 1))
        mask.save(data / "masks" / called.format(stem=image.stem))
    (warning,) = [finding.sentence for finding in check_data(data) if finding.severity == "warning"]
    words = re.findall("`(.*)`", warning)[0].split()
    assert words[-2:] == ["--masks-path", "masks"]
    config = parsed(*words, "--downscale-factor", "1")  # nerfstudio leaves open what it measures without it.
    config.data = data
    notes = [finding.sentence for finding in check_capture(config)]
    assert any(f"with {VIEWS} masks" in note for note in notes)
    loaded = config.setup(device="cpu").cached_train
    actual = [int((~view["mask"]).sum()) for view in loaded]
    expected = [2, 3, 4, 5, 6, 7, 8, 10]
    assert actual == expected


@pytest.mark.hard_case(
    "`--data` is a part of a capture (`images`, `sparse/0`), the folder above one, a file, or a video",
    "refused: says which folder to give, or which command makes one",
)
def test_a_folder_above_or_below_a_capture_is_told_where_that_is(scene: Path, tmp_path: Path):
    data = tmp_path / "above/capture"
    shutil.copytree(scene, data)
    (data / "photo.png").write_bytes((data / "images/000.png").read_bytes())
    (data / "other").mkdir()
    (data / "a clip.MP4").touch()
    makes = f"`sadgs-process '{data}/a clip.MP4' FOLDER` makes a capture of it, and `sadgs` makes a splat."
    for folder, sentence in (
        (data / "images", f"{data}/images is a part of the capture {data}: give --data that folder."),
        (data / SPARSE_FOLDER, f"{data}/sparse/0 is a part of the capture {data}: give --data that folder."),
        (data.parent, f"{data.parent} is no capture, but {data} in it is one: give --data that folder."),
        (data / "a clip.MP4", f"{data}/a clip.MP4 is a video and no capture: {makes}"),
        (data / "photo.png", f"{data}/photo.png is a file: give --data the folder of a capture."),
    ):
        (finding,) = check_data(folder)
        assert finding.sentence == sentence
        with pytest.raises(InputError) as refused:
            check_capture(SadgsDatamanagerConfig(data=folder))
        assert str(refused.value) == sentence
    (finding,) = check_data(data / "other")
    assert "other holds neither transforms.json nor a COLMAP reconstruction" in finding.sentence


def test_a_broken_reconstruction_in_another_folder_does_not_hide_the_capture(scene: Path, tmp_path: Path):
    data = tmp_path / "above/capture"
    shutil.copytree(scene, data)
    broken = data.parent / "broken"
    broken.mkdir()
    shutil.copy(scene / SPARSE_FOLDER / "cameras.bin", broken)
    (broken / "images.bin").write_bytes(b"\1")
    with refusal(r"broken/images\.bin is cut off or corrupt"):
        find_reconstructions(broken)
    (finding,) = check_data(data.parent)
    assert finding.sentence == f"{data.parent} is no capture, but {data} in it is one: give --data that folder."
    photos = broken / "images"
    photos.mkdir()
    (finding,) = check_data(photos)
    assert "images holds neither transforms.json nor a COLMAP reconstruction" in finding.sentence


@pytest.mark.hard_case("a folder that may not be entered, names too long", "refused: cannot be read")
def test_a_folder_that_cannot_be_read_is_named(tmp_path: Path):
    data = tmp_path / ("a" * 300)
    sentence = f"{data} cannot be read (File name too long): correct its name or rights."
    sentences = [finding.sentence for finding in check_data(data)]
    assert sentences == [sentence]
    with pytest.raises(InputError) as refused:
        check_capture(SadgsDatamanagerConfig(data=data))
    assert str(refused.value) == sentence


def parsed(*words: str) -> SadgsDatamanagerConfig:
    """The settings of `ns-train sadgs …`."""
    return tyro.cli(AnnotatedBaseConfigUnion, args=["sadgs", *words]).pipeline.datamanager


@pytest.mark.hard_case("a parser that was named", "stays as named; `nerfstudio-data` on a COLMAP folder: leave it out")
def test_the_command_line_tells_a_parser_that_was_named_from_none(scene: Path, capsys: pytest.CaptureFixture[str]):
    config = parsed()
    assert config.dataparser == AutomaticDataParserConfig()
    for words, expected in (
        (["nerfstudio-data"], NerfstudioDataParserConfig(load_3D_points=True)),
        (["nerfstudio-data", "--eval-mode", "all"], NerfstudioDataParserConfig(load_3D_points=True, eval_mode="all")),
        (["colmap"], ColmapDataParserConfig()),
    ):
        config = parsed(*words)
        config.data = scene
        before = copy.deepcopy(config)
        choose_parser(config)
        assert config == before, words
        assert config.dataparser == expected, words
        with refusal(r"leave `nerfstudio-data` out|add `--colmap-path sparse/0` after `colmap`"):
            check_capture(config)


@pytest.mark.hard_case("a run whose parser was chosen by its folder", "`config.yml` names nerfstudio's own parser")
def test_a_run_s_config_names_the_parser_and_serves_other_commands_and_more_training(scene: Path, tmp_path: Path):
    config = configure(tmp_path, AutomaticDataParserConfig(), iterations=2)
    config.data = config.pipeline.datamanager.data = scene  # as ns-train sets both
    config.save_config()
    path = config.get_base_dir() / "config.yml"
    saved = yaml.load(path.read_text(), Loader=yaml.Loader)
    assert saved.pipeline.datamanager.dataparser == LAYOUTS["sparse/0"][1](scene)
    trainer = train(config)
    _, pipeline, _, step = eval_setup(path)
    assert step == 1
    assert pipeline.datamanager.eval_dataset is not None
    assert len(pipeline.datamanager.eval_dataset) == 2
    again = configure(tmp_path, AutomaticDataParserConfig(), iterations=3)
    again.pipeline.datamanager.data = scene
    again.load_dir = trainer.checkpoint_dir
    assert train(again)._start_step == 2


@pytest.fixture
def large(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A capture whose images are larger than nerfstudio takes without a question."""
    monkeypatch.setattr("sadgs_ns.data.images.MAX_AUTO_RESOLUTION", 20)
    return Path(shutil.copytree(scene, tmp_path / "large"))


@pytest.mark.hard_case(
    "images of more than 1600 px without smaller copies, no parser named",
    "trained on as they are, or as the copies that exist",
)
def test_large_images_are_taken_as_they_are_and_smaller_copies_where_they_exist(large: Path):
    for factor, copies in ((1, 4), (2, 2), (4, 4)):  # of factor 4 alone none is taken, for nerfstudio asks for each
        smaller = large / f"images_{copies}"
        smaller.mkdir(exist_ok=True)
        for path in (large / "images").iterdir():
            with Image.open(path) as image:
                image.resize((image.width // copies, image.height // copies)).save(smaller / path.name)
        config = SadgsDatamanagerConfig(data=large)
        check_capture(config)
        assert isinstance(config.dataparser, ColmapDataParserConfig)
        assert config.dataparser.downscale_factor == factor
        (note,) = [finding.sentence for finding in check_data(large) if " images of " in finding.sentence]
        assert note.endswith("PNG RGB, without masks.") == (factor == 4)
        if factor == 1:
            shutil.rmtree(smaller)


@pytest.mark.hard_case(
    "smaller copies whose sides were rounded to the nearest or up, as Mip-NeRF 360's",
    "**train** where no parser is named; they were refused as of another size",
)
@pytest.mark.parametrize("rounding", ["floor", "round", "ceil"])
def test_smaller_copies_are_read_as_they_were_rounded(rounding: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sadgs_ns.data.images.MAX_AUTO_RESOLUTION", 20)
    write_scene(tmp_path / "scene", 49, 38, 10, 60)  # A fourth is 12.25 and 9.5 px.
    size = {"floor": (12, 9), "round": (12, 10), "ceil": (13, 10)}[rounding]
    for folder, copy_size in (("images_2", (24, 19)), ("images_4", size)):
        (tmp_path / "scene" / folder).mkdir()
        for path in (tmp_path / "scene/images").iterdir():
            with Image.open(path) as image:
                image.resize(copy_size).save(tmp_path / "scene" / folder / path.name)
    assert [finding for finding in check_data(tmp_path / "scene") if finding.severity != "note"] == []
    config = SadgsDatamanagerConfig(data=tmp_path / "scene")
    datamanager = config.setup(device="cpu")
    actual = {tuple(data["image"].shape[1::-1]) for data in datamanager.cached_train}
    assert actual == {size}
    cameras = datamanager.train_dataset.cameras
    actual = {(int(w), int(h)) for w, h in zip(cameras.width, cameras.height, strict=True)}
    assert actual == {size}


@pytest.mark.hard_case(
    "images of more than 1600 px without smaller copies, with `colmap` named, which asks a question",
    "at a terminal a warning, then the question; without a terminal refused: `--downscale-factor 1`",
)
def test_a_question_that_a_named_parser_would_ask_nobody_is_an_error(large: Path, monkeypatch: pytest.MonkeyPatch):
    config = SadgsDatamanagerConfig(dataparser=ColmapDataParserConfig(data=large, colmap_path=SPARSE_FOLDER))
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False)
    with refusal(r"more than 20 px and there is no \S+/images_4: add `--downscale-factor 1` "):
        check_capture(config)
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    (warning,) = [finding for finding in check_capture(config) if finding.severity == "warning"]
    assert "nerfstudio will ask whether to make it with ffmpeg; say yes, or add `--down" in warning.sentence


def in_a_fourth(data: Path, kind: str = "images") -> None:
    """Put copies of a fourth of the size beside images or masks."""
    (data / f"{kind}_4").mkdir()
    for path in (data / kind).iterdir():
        with Image.open(path) as image:
            image.resize((image.width // 4, image.height // 4)).save(data / f"{kind}_4" / path.name)


@pytest.mark.hard_case(
    "images of a fourth of the size alone, as `images_4` of DL3DV or Mip-NeRF 360 without `images`",
    "refused: `--downscale-factor 4`, with which it trains; with a COLMAP model that was refused, too",
)
@pytest.mark.parametrize("layout", ["colmap", "transforms.json"])
def test_smaller_copies_without_the_images_are_read_by_the_option_that_is_told(
    layout: str, scene: Path, tmp_path: Path
):
    data = tmp_path / "capture"
    nerfstudio_data(data) if layout == "transforms.json" else colmap_in("sparse/0")(scene, data)
    in_a_fourth(data)
    shutil.rmtree(data / "images")
    with pytest.raises(InputError) as refused:
        check_capture(SadgsDatamanagerConfig(data=data))
    options = {
        "colmap": "`colmap --colmap-path sparse/0 --images-path FOLDER`, or --downscale-factor 4 for images_4.",
        "transforms.json": "`nerfstudio-data --downscale-factor 4`.",
    }
    assert str(refused.value).endswith(f" end the command with {options[layout]}")
    words = ["colmap", "--colmap-path", "sparse/0"] if layout == "colmap" else ["nerfstudio-data"]
    config = parsed(*words, "--downscale-factor", "4")
    config.data = config.dataparser.data = data
    actual = [finding for finding in check_capture(config) if finding.severity != "note"]
    assert actual == []
    names = config.dataparser.setup().get_dataparser_outputs().image_filenames
    for name in names:
        assert name.is_file()
        assert name.parent.name == "images_4"


@pytest.mark.hard_case(
    "smaller copies of images, as ns-process-data makes them, and masks without such copies",
    "refused: make them, or `--downscale-factor 1`, with which it trains",
)
def test_masks_without_smaller_copies_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sadgs_ns.data.images.MAX_AUTO_RESOLUTION", 20)
    nerfstudio_data(tmp_path, masks=True)
    for factor in (2, 4):
        (tmp_path / f"images_{factor}").mkdir()
        for path in (tmp_path / "images").iterdir():
            with Image.open(path) as image:
                image.resize((WIDTH // factor, HEIGHT // factor)).save(tmp_path / f"images_{factor}" / path.name)
    with refusal(r"/masks_4 does not exist, .*: make it, or end the command with `") as refused:
        check_capture(SadgsDatamanagerConfig(data=tmp_path))
    config = parsed(*str(refused.value).split("`")[1].split())
    config.data = tmp_path
    severities = {finding.severity for finding in check_capture(config)}
    assert severities == {"note"}


@pytest.mark.hard_case(
    "`--downscale-factor 8` on small images or without copies; `--downscale-factor 0`",
    "refused: leave that option out, and use `--pipeline.datamanager.camera-res-scale-factor 0.125`; refused by name",
)
def test_a_factor_without_copies_and_one_that_makes_nothing_smaller_are_named(scene: Path, tmp_path: Path):
    named: list[tuple[Any, str]] = [
        (
            ColmapDataParserConfig(data=scene, colmap_path=SPARSE_FOLDER),
            "`--downscale-factor 8`: leave that option out, and put "
            "`--pipeline.datamanager.camera-res-scale-factor 0.125` before the parser's name.",
        ),
        (
            nerfstudio_data(tmp_path / "data"),
            "8: make it, or end the command with `--pipeline.datamanager.camera-res-scale-factor 0.125 nerfstudio-data "
            "--downscale-factor 1`.",
        ),
    ]
    for parser, told in named:
        parser.downscale_factor = 8
        with pytest.raises(InputError) as refused:
            check_capture(SadgsDatamanagerConfig(dataparser=parser))
        folder = parser.data / "images_8"
        assert str(refused.value) == (f"{folder} does not exist, which should hold the images scaled down by {told}")
        parser.downscale_factor = 0
        with refusal(r"^downscale-factor must be at least 1, got 0\.$"):
            check_capture(SadgsDatamanagerConfig(dataparser=parser))


@pytest.mark.hard_case(
    "`--eval-mode filename` with a name that holds neither train nor eval",
    "refused: rename it, or leave the option out",
)
def test_images_that_are_to_be_divided_by_their_names_need_such_names(tmp_path: Path):
    parser = nerfstudio_data(tmp_path)
    parser.eval_mode = "filename"
    with refusal(r"^images/000\.png has neither train nor eval in its name, by which `--eval-"):
        check_capture(SadgsDatamanagerConfig(dataparser=parser))
    path = tmp_path / "transforms.json"
    names = {"000": "eval0", "001": "eval1"}
    for image in (tmp_path / "images").iterdir():
        name = names.get(image.stem, f"train{image.stem}")
        image.rename(image.with_stem(name))
        path.write_text(path.read_text().replace(f"images/{image.stem}.", f"images/{name}."))
    findings = check_capture(SadgsDatamanagerConfig(dataparser=parser))
    actual = [finding for finding in findings if finding.severity != "note"]
    assert actual == []


@pytest.mark.hard_case(
    "`test_filenames` missing or empty; test images that are trained on", "a warning: shows nothing about new views"
)
def test_lists_without_test_images_and_with_training_images_among_them_are_warned_of(tmp_path: Path):
    nerfstudio_data(tmp_path)
    path = tmp_path / "transforms.json"
    content = read_json(path)
    names = [frame["file_path"] for frame in content["frames"]]
    content |= {"train_filenames": names[2:], "val_filenames": names[:2]}

    def warning() -> str:
        write_json(path, content)
        (finding,) = [finding for finding in check_data(tmp_path) if finding.severity != "note"]
        assert finding.severity == "warning"
        return finding.sentence.removeprefix(f"{path}: test_filenames ")

    assert warning() == "is missing: `ns-eval` will have nothing to measure; name some images."
    content["test_filenames"] = []
    assert warning() == "is empty: `ns-eval` will have nothing to measure; name some images."
    content |= {"train_filenames": names, "val_filenames": []}
    write_json(path, content)
    assert not [finding for finding in check_data(tmp_path) if finding.severity != "note"], "all shall be trained on"
    content |= {"train_filenames": names[2:], "val_filenames": names[:2]}
    content["test_filenames"] = [f"./{names[0]}", names[2], names[3]]
    assert warning() == (
        "names 2 of the 8 training images: what `ns-eval` measures of them shows nothing about new views."
    )
    content["test_filenames"] = names[:2]
    write_json(path, content)
    actual = [finding for finding in check_data(tmp_path) if finding.severity != "note"]
    assert actual == []
