"""The captures of the tables are described, and a folder that differs from one is told what differs."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import pytest
import yaml
from PIL import Image

from benchmarks import __main__ as benchmarks
from benchmarks import captures, chain, protocol
from benchmarks.capture_digests import measure_model, measure_photos
from helpers.json_files import write_json

CONFIGS = Path(__file__).parents[2] / "configs/bench"
CAMERAS = ["1 PINHOLE 8 6 10 10 4 3", "2 SIMPLE_RADIAL 8 6 9 4 3 0.01"]
IMAGES = ["1 1 0 0 0 0 0 1 1 a.png", "2 0.8 0.6 0 0 0.1 0 1 2 b.png", "3 0.6 0 0.8 0 0.2 0 1 1 c.png"]
POINTS = ["1 0.1 0.2 3 255 0 0 0.5", "2 0.4 0.1 2.5 0 255 0 0.5"]


def write_model(scene: Path, images: list[str] = IMAGES, points: list[str] = POINTS) -> None:
    model = scene / "sparse/0"
    model.mkdir(parents=True, exist_ok=True)
    (model / "cameras.txt").write_text("\n".join(CAMERAS) + "\n")
    (model / "images.txt").write_text("".join(f"{image}\n\n" for image in images))
    (model / "points3D.txt").write_text("\n".join(points) + "\n")


def write_photo(path: Path, size: tuple[int, int] = (8, 6), grey: int = 100) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("L", size, grey).save(path)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    folder = tmp_path / "kitchen"
    for name in "abc":
        write_photo(folder / "images" / f"{name}.png")
    write_model(folder)
    return folder


@pytest.fixture
def described(scene: Path) -> Path:
    """A file that describes the scene, and its photos as another capture."""
    photos = asdict(measure_photos(scene / "images"))
    model = measure_model(scene)
    assert model is not None
    texts = {
        "shows": "a kitchen",
        "source": {"name": "a data set", "page": "https://example.org", "licence": "CC0"},
        "prepared": "as they are",
        "split": "every 8th",
        "repeat": "repeat NAME",
    }
    photos["sizes"] = list(photos["sizes"])
    content = {
        "scenes": {"kitchen": {**texts, "photos": photos, "model": asdict(model)}},
        "photos": {"images": {**texts, "photos": photos}},
    }
    path = scene.parent / "captures.yaml"
    path.write_text(yaml.safe_dump(content), "utf8")
    return path


def run(*words: object) -> int:
    return benchmarks.main(["captures", *map(str, words)])


def test_the_order_of_a_model_and_the_signs_of_its_quaternions_do_not_matter(scene: Path, tmp_path: Path):
    turned = [IMAGES[2], IMAGES[1].replace("0.8 0.6 0 0", "-0.8 -0.6 -0 -0"), IMAGES[0]]
    write_model(tmp_path / "other", turned, POINTS[::-1])
    assert measure_model(tmp_path / "other") == measure_model(scene)


def test_a_binary_model_has_the_digests_of_the_text(scene: Path, tmp_path: Path):
    import pycolmap

    binary = tmp_path / "binary/sparse/0"
    binary.mkdir(parents=True)
    pycolmap.Reconstruction(str(scene / "sparse/0")).write_binary(str(binary))
    assert (binary / "images.bin").exists() and not (binary / "images.txt").exists()
    assert measure_model(tmp_path / "binary") == measure_model(scene)


def test_the_order_of_frames_in_a_transforms_file_does_not_matter_and_their_lists_do(tmp_path: Path):
    frames = [{"file_path": f"images/{name}.png", "transform_matrix": [[1.0, 0.1]]} for name in "ab"]
    content = {"fl_x": 10.0, "train_filenames": ["images/a.png"], "val_filenames": ["images/b.png"]}
    models = []
    for change in ({"frames": frames}, {"frames": frames[::-1]}, {"frames": frames, "val_filenames": ["images/a.png"]}):
        write_json(tmp_path / "transforms.json", {**content, **change})
        models.append(measure_model(tmp_path))
    assert models[0] == models[1] != models[2]


def test_what_matches_is_told_to_match(scene: Path, described: Path, capsys: pytest.CaptureFixture[str]):
    status = run("--captures", described, "--check", scene.parent, "--check-photos", scene)
    assert status == 0
    printed = capsys.readouterr().out
    assert printed == "kitchen: matches\nimages: matches\n"


def move_points(scene: Path) -> None:
    write_model(scene, points=[POINTS[0].replace("0.1 ", "0.15 "), POINTS[1]])


CHANGES: dict[str, Callable[[Path], object]] = {
    "2 photos instead of 3": lambda scene: (scene / "images/a.png").unlink(),
    "the photos have 8×6 and 4×3 px instead of 8×6": lambda scene: write_photo(scene / "images/a.png", (4, 3)),
    "match, but not their names": lambda scene: shutil.move(scene / "images/a.png", scene / "images/z.png"),
    "resized or compressed otherwise": lambda scene: write_photo(scene / "images/a.png", grey=101),
    "has neither sparse/0 nor transforms.json": lambda scene: shutil.rmtree(scene / "sparse"),
    "but 2 of them have a camera instead of 3": lambda scene: write_model(scene, IMAGES[:2]),
    "their cameras differ": lambda scene: write_model(scene, [IMAGES[0].replace(" 1 1 a", " 2 1 a"), *IMAGES[1:]]),
    "there are 1 points instead of 2": lambda scene: write_model(scene, points=POINTS[:1]),
    "but the points lie elsewhere": move_points,
}


@pytest.mark.parametrize("sentence", CHANGES)
def test_what_differs_is_told_in_a_sentence(
    sentence: str, scene: Path, described: Path, capsys: pytest.CaptureFixture[str]
):
    CHANGES[sentence](scene)
    status = run("--captures", described, "--check", scene.parent)
    assert status == 1
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("kitchen: ") and sentence in line and line.endswith(".")


def test_a_capture_that_is_asked_for_by_name_must_be_there(
    scene: Path, described: Path, capsys: pytest.CaptureFixture[str]
):
    content = yaml.safe_load(described.read_text("utf8"))
    content["scenes"]["garden"] = content["scenes"]["kitchen"]
    described.write_text(yaml.safe_dump(content), "utf8")
    checked = ("--captures", described, "--check", scene.parent)
    assert run(*checked) == 0
    status = run("kitchen", "garden", *checked)
    assert status == 1
    printed = capsys.readouterr().out
    assert printed == 2 * f"kitchen: matches\nNot in {scene.parent}: garden\n"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["garden"], "there is no capture 'garden'; the captures are kitchen, images."),
        (["--check", "ROOT/kitchen"], "holds no folder kitchen; give the folder that holds the captures."),
        (["images", "--check", "ROOT"], "images is not among what ROOT is compared with."),
    ],
)
def test_a_wrong_name_or_folder_is_refused(
    words: list[str], sentence: str, scene: Path, described: Path, capsys: pytest.CaptureFixture[str]
):
    root = str(scene.parent)
    status = run(*(word.replace("ROOT", root) for word in words), "--captures", described)
    assert status == 2
    errors = capsys.readouterr().err
    assert sentence.replace("ROOT", root) in errors


@pytest.mark.parametrize("text", ["scenes: {}", "- fox", "scenes: {fox: {}}\nphotos: {}", "{", "scenes: {fox: 3}"])
def test_a_file_that_describes_no_captures_is_refused(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "captures.yaml").write_text(text)
    status = run("--captures", tmp_path / "captures.yaml")
    assert status == 2
    errors = capsys.readouterr().err
    assert "must be YAML with scenes and photos: " in errors


def test_every_capture_is_described_with_source_licence_and_a_command(capsys: pytest.CaptureFixture[str]):
    assert run() == 0
    paragraphs = capsys.readouterr().out.split("\n\n")
    scenes, photos = captures.load()
    assert len(paragraphs) == len(scenes) + len(photos)
    for paragraph in paragraphs:
        name = paragraph.partition(":")[0]
        for field in ("from", "licence", "prepared", "held out", "digests", "repeat"):
            assert re.search(rf"^  {field}  +\S", paragraph, re.MULTILINE), (name, field)
        assert "NAME" not in paragraph


def test_the_protocols_of_the_tables_run_described_captures_alone():
    scenes, photos = captures.load()
    ours = protocol.load(CONFIGS / "ours.yaml")
    assert set(ours.scenes) <= {*scenes, *photos}
    assert set(chain.load(CONFIGS / "chain.yaml").captures) <= {*photos, "fox"}


def test_each_command_that_repeats_a_capture_runs_it_alone():
    scenes, photos = captures.load()
    for name, capture in scenes.items():
        words = shlex.split(capture.repeat.replace("NAME", name))
        only = words[words.index("--only") + 1]
        path = CONFIGS / Path(words[3]).name
        jobs = [
            job for job in protocol.load(path).jobs() if re.search(only, f"{job.scene.name}/{job.row.label}/{job.seed}")
        ]
        actual = {job.scene.name for job in jobs}
        assert actual == {name}
        assert "sadgs" in {job.row.method for job in jobs}
    for name, capture in photos.items():
        words = shlex.split(capture.repeat.replace("NAME", name))
        assert words[words.index("--only") + 1] in chain.load(CONFIGS / Path(words[4]).name).captures
