"""Commands and options that sentences of the package name are understood, and do what the sentence says.

They are collected from the texts in the sources. Each is met by a case below that brings its sentence about, or is
filled in by hand, so that a new one without either fails here.
"""

from __future__ import annotations

import ast
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterator
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
from nerfstudio.configs.dataparser_configs import all_dataparsers
from PIL import Image, ImageCms
from test_commands import SCRIPTS
from test_documented_commands import understood

from examples.drawn_scene.scene import SPARSE_FOLDER, write_scene
from helpers.drawn_photos import color_profile
from helpers.json_files import read_json, write_json
from helpers.short_runs import nerfstudio_data
from helpers.small_scenes import HEIGHT, WIDTH
from sadgs_ns.cli import doctor
from sadgs_ns.data.checks import check_data
from sadgs_ns.data.checks.capture import check_capture
from sadgs_ns.data.checks.colmap import check_colmap
from sadgs_ns.data.checks.findings import Finding
from sadgs_ns.data.checks.transforms import check_nerfstudio
from sadgs_ns.data.layouts import ParserOptions
from sadgs_ns.training.run.train_options import read_options

PACKAGE = Path(__file__).parents[2] / "sadgs_ns"
PARSERS = ("colmap", "nerfstudio-data", "blender-data")
OTHERS = ("colmap", "ffmpeg", "mogrify", "magick", "convert", "opensfm", "aliceVision_exportColmap")
OTHERS_SCRIPTS = ("kapture_import_bundler.py", "kapture_export_colmap.py", "mv", "mkdir", "export")
"""Programs of others. Where one is not installed, nothing of it is tried."""
STARTS = re.compile(
    rf"(?:--|(?:sadgs|ns)(?:-[a-z]+)*(?![\w.-])|(?:{'|'.join(map(re.escape, PARSERS + OTHERS + OTHERS_SCRIPTS))})\b)"
)
GAP = "…"
"""Stands for what a sentence fills in."""


# --- the texts in the sources ---


def text_of(node: ast.AST) -> str:
    """The text of a literal, with gaps for what is filled in; empty for other nodes."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return re.sub(r"\{\w+\}", GAP, node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(text_of(part) or GAP for part in node.values)
    return ""


def texts(path: Path) -> Iterator[str]:
    """The texts of a file, without docstrings."""
    nodes = list(ast.walk(ast.parse(path.read_text("utf8"))))
    parts = {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in node.values}
    parts |= {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    for node in nodes:
        if id(node) not in parts and text_of(node):
            yield text_of(node)


def commands_in(text: str) -> Iterator[str]:
    """The commands and options between backticks, and what follows a colon or stands alone as a whole command."""
    for span in re.findall(r"`([^`]+)`", text):
        if STARTS.match(span):
            yield span
    if "`" in text:
        return
    for found in re.findall(
        r"(?:^|: +)((?:(?:sadgs|ns)-[a-z-]+|sadgs|opensfm|kapture_\w+\.py|aliceVision_\w+) .+)", text
    ):
        if re.search(rf" -|{GAP}| [A-Z]+\b", found):
            yield found.partition("\n")[0]


def named() -> list[str]:
    found = [command for path in sorted(PACKAGE.rglob("*.py")) for text in texts(path) for command in commands_in(text)]
    return list(dict.fromkeys(found))


# --- the cases ---


def photos_alone(data: Path) -> list[Finding]:
    shutil.rmtree(data / "sparse")
    return check_data(data)


def without_pictures(data: Path) -> list[Finding]:
    shutil.rmtree(data / "images")
    return check_data(data)


def video(data: Path) -> list[Finding]:
    clip = data / "clip.mp4"
    clip.touch()
    return check_data(clip)


def run_of_training(data: Path) -> list[Finding]:
    shutil.rmtree(data / "sparse")
    (data / "nerfstudio_models").mkdir()
    (data / "nerfstudio_models/step-000000001.ckpt").touch()
    (data / "config.yml").touch()
    return check_data(data)


def masks_unused(data: Path) -> list[Finding]:
    (data / "masks").mkdir()
    Image.new("L", (WIDTH, HEIGHT), 255).save(data / "masks/003.png")
    return check_data(data)


def larger_model(data: Path) -> list[Finding]:
    from pycolmap import Reconstruction

    shutil.copytree(data / SPARSE_FOLDER, data / "sparse/1")
    model = Reconstruction(data / SPARSE_FOLDER)
    model.deregister_frame(max(model.frames))
    model.write(data / SPARSE_FOLDER)
    return check_data(data)


def no_points(data: Path) -> list[Finding]:
    for path in (data / SPARSE_FOLDER).glob("points3D.*"):
        path.unlink()
    return check_data(data)


def images_elsewhere(data: Path) -> list[Finding]:
    (data / "images").rename(data / "photos")
    return check_colmap(data, ParserOptions(colmap_path=SPARSE_FOLDER, downscale_factor=1))


def model_elsewhere(data: Path) -> list[Finding]:
    return check_colmap(data, ParserOptions(downscale_factor=1))


def no_copies(data: Path) -> list[Finding]:
    return check_colmap(data, ParserOptions(colmap_path=SPARSE_FOLDER, downscale_factor=4))


def wrong_parser(data: Path) -> list[Finding]:
    return check_nerfstudio(data, ParserOptions())


def profiles(data: Path) -> list[Finding]:
    for path in (data / "images").iterdir():
        with Image.open(path) as image:
            image.save(path, icc_profile=color_profile(swapped=True))
    return check_data(data)


def turned(data: Path) -> list[Finding]:
    exif = Image.Exif()
    exif[0x112] = 3
    for path in (data / "images").iterdir():
        with Image.open(path) as image:
            image.save(path, exif=exif)
    return check_data(data)


def raw_image(data: Path) -> list[Finding]:
    (data / "images/000.png").write_bytes(b"\x76\x2f\x31\x01")
    return check_data(data)


def as_json(data: Path) -> Path:
    shutil.rmtree(data)
    data.mkdir()
    nerfstudio_data(data)
    return data


def copies_alone(data: Path) -> list[Finding]:
    (as_json(data) / "images").rename(data / "images_2")
    for path in (data / "images_2").iterdir():
        with Image.open(path) as image:
            image.resize((WIDTH // 2, HEIGHT // 2)).save(path)
    return check_data(data)


def no_json_copies(data: Path) -> list[Finding]:
    return check_nerfstudio(as_json(data), ParserOptions(downscale_factor=4))


def without_test_views(data: Path) -> list[Finding]:
    path = as_json(data) / "transforms.json"
    meta = read_json(path)
    names = [frame["file_path"] for frame in meta["frames"]]
    write_json(path, meta | {"train_filenames": names[1:], "val_filenames": names[:1]})
    return check_data(data)


def elsewhere(file: str, content: str, *folders: str) -> Callable[[Path], list[Finding]]:
    """A folder with the poses of another program."""

    def case(data: Path) -> list[Finding]:
        shutil.rmtree(data / "sparse")
        for folder in folders:
            (data / folder).mkdir(parents=True)
        (data / file).write_text(content)
        return check_data(data)

    return case


CASES: dict[str, Callable[[Path], list[Finding]]] = {
    "photos alone": photos_alone,
    "a video": video,
    "a run": run_of_training,
    "masks unused": masks_unused,
    "a larger model": larger_model,
    "no points": no_points,
    "images elsewhere": images_elsewhere,
    "no images": without_pictures,
    "a model elsewhere": model_elsewhere,
    "no smaller copies": no_copies,
    "the parser of other data": wrong_parser,
    "colour profiles": profiles,
    "turned by EXIF": turned,
    "an image that is not read": raw_image,
    "smaller copies alone": copies_alone,
    "no smaller copies of a transforms.json": no_json_copies,
    "no test views": without_test_views,
    "Metashape": elsewhere("a.xml", "<chunk"),
    "Metashape's project": elsewhere("a.psx", ""),
    "RealityScan": elsewhere("a.csv", "#name,"),
    "RealityScan's XMP": elsewhere("a.xmp", "xcr:Rotation"),
    "ODM": elsewhere("odm_report/shots.geojson", "", "odm_report"),
    "Polycam": elsewhere("keyframes/cameras/0.json", "", "keyframes/cameras"),
    "Record3D": elsewhere("metadata.json", '"poses"'),
    "OpenSfM": elsewhere("reconstruction.json", '"shots"'),
    "AliceVision": elsewhere("a.sfm", '"poses"'),
    "Bundler": elsewhere("bundle.out", "# Bundle"),
    "LLFF": elsewhere("poses_bounds.npy", ""),
}
REMEDIES = (
    "masks unused",
    "a larger model",
    "no points",
    "images elsewhere",
    "a model elsewhere",
    "smaller copies alone",
)
"""Cases whose command makes the data be read as it says, with nothing else to do."""


def spans_of(sentences: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(span for sentence in sentences for span in re.findall(r"`([^`]+)`", sentence) if STARTS.match(span))


@pytest.fixture
def data(tmp_path: Path) -> Path:
    folder = tmp_path / "data of mine"
    write_scene(folder, WIDTH, HEIGHT, 10, 60)
    return folder


def completed(span: str, data: Path) -> list[list[str]]:
    """The commands, one of which a span must be, or be the end of."""
    words = shlex.split(span.replace(GAP, ""))
    start = ["ns-train", "sadgs", "--data", str(data)]
    if words[0] in PARSERS and (words[0] != "colmap" or len(words) == 1 or words[1].startswith("-")):
        return [[*start, *words]]
    if words[0].startswith("--"):
        ends = [["ns-train", "sadgs"], ["sadgs", "photos"], ["sadgs", "photos", "--"], ["ns-render", "dataset"]]
        with_parser = [[*start, parser, *words] for parser in PARSERS]
        return [[*start, *words], *with_parser, *([*end, *words] for end in ends[1:])]
    return [words]


def is_understood(words: list[str]) -> bool:
    """Whether a program's own parser understands a command; True for others' programs that are not installed."""
    if words[0] in (*OTHERS, *OTHERS_SCRIPTS):
        return True
    try:
        if words[:2] == ["ns-train", "sadgs"]:  # Without nerfstudio's other methods, which take seconds.
            read_options(words[2:])
        else:
            understood(words, lenient=True)
    except SystemExit as end:
        return end.code == 0  # As for --help
    except (ImportError, OSError) as error:
        if "libusb" not in str(error):
            raise
    return True


def commands_of(span: str) -> list[str]:
    """The commands that are joined by `&&`."""
    return [part.strip() for part in span.split("&&")]


def check_understood(span: str, data: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Fail unless the commands of a span are understood, and return the last one."""
    words: list[str] = []
    for command in commands_of(span):
        candidates = completed(command, data)
        understood_ones = [candidate for candidate in candidates if is_understood(candidate)]
        assert understood_ones, (command, "".join(capsys.readouterr()))
        words = understood_ones[0]
    return words


@pytest.mark.parametrize("case", CASES)
def test_a_case_s_commands_are_understood(case: str, data: Path, capsys: pytest.CaptureFixture[str]):
    sentences = tuple(finding.sentence for finding in CASES[case](data) if finding.severity != "note")
    assert spans_of(sentences), sentences
    spans = [span for span in spans_of(sentences) if not is_bare(span)]
    commands = [check_understood(span, data, capsys) for span in spans]
    if case in REMEDIES:
        config = read_options(commands[0][2:])
        manager: Any = config.pipeline.datamanager
        manager.data = data
        left = check_capture(manager)
        assert not set(sentences) & {finding.sentence for finding in left}


CONFIG = "--load-config config.yml"
SCALE = "--pipeline.datamanager.camera-res-scale-factor 0.5"
FILLED = {
    "ns-train sadgs --data …": "ns-train sadgs --data scene",
    f"-- {SCALE}": f"-- {SCALE}",
    SCALE: SCALE,
    "sadgs-doctor …": "sadgs-doctor scene",
    "sadgs -- --help": "sadgs -- --help",
    "sadgs …": "sadgs photos",
    "sadgs … --measure": "sadgs photos --measure",
    "sadgs … --output …": "sadgs photos --output splat",
    "sadgs-process PHOTOS FOLDER": "sadgs-process PHOTOS FOLDER",
    "sadgs-export RUN --output room.mesh.ply": "sadgs-export RUN --output room.mesh.ply",
    "sadgs-export RUN --output splat.ply …": "sadgs-export RUN --output splat.ply --min-views 3",
    "--downscale-factor 1": "colmap --downscale-factor 1",
    "--downscale-factor 2": "colmap --downscale-factor 2",
    "--masks-path": "colmap --masks-path masks",
    "--eval-mode filename": "colmap --eval-mode filename",
    "--ply-path": "blender-data --ply-path points.ply",
    "--share-always True": "--share-always True",
    "nerfstudio-data --load-3D-points False": "nerfstudio-data --load-3D-points False",
    "ns-render dataset": f"ns-render dataset {CONFIG}",
    "ns-render spiral": f"ns-render spiral {CONFIG}",
    "ns-render interpolate": f"ns-render interpolate {CONFIG}",
    "ns-render camera-path": f"ns-render camera-path {CONFIG} --camera-path-filename path.json",
    "ns-export pointcloud": f"ns-export pointcloud {CONFIG} --output-dir points",
    "export USER=me": "export USER=me",
    "colmap image_undistorter": "colmap image_undistorter",
    "colmap model_converter --output_type BIN": "colmap model_converter --output_type BIN",
}
"""Commands of sentences that no case brings about here, as a user fills them in."""


def met(command: str, span: str) -> bool:
    """Whether a span is what a sentence makes of a command in the sources."""
    return re.fullmatch(".*".join(map(re.escape, command.split(GAP))), span, re.DOTALL) is not None


def is_bare(command: str) -> bool:
    """Whether a command is the name of a program or parser alone."""
    return command in {*SCRIPTS, *PARSERS, *OTHERS, *all_dataparsers} or bool(
        entry_points(group="console_scripts", name=command)
    )


def test_every_command_in_the_sources_has_a_case(tmp_path: Path):
    spans = []
    for number, case in enumerate(CASES.values()):
        folder = tmp_path / str(number)
        write_scene(folder, WIDTH, HEIGHT, 10, 60)
        for span in spans_of(tuple(finding.sentence for finding in case(folder))):
            spans += [span, span.rpartition("&& ")[2]]
    missing = []
    for command in named():
        is_met = any(met(command, span) for span in spans)
        if not is_met and not is_bare(command) and command not in FILLED:
            missing.append(command)
    assert missing == []
    assert set(FILLED) <= set(named()), "a command that no source has"


def test_a_new_command_is_found(tmp_path: Path):
    source = tmp_path / "new.py"
    source.write_text(
        'def f(x):\n    """Run `sadgs-process NOT THIS`."""\n    return f"call `sadgs-export {x} --new`"\n'
    )
    actual = [command for text in texts(source) for command in commands_in(text)]
    assert actual == ["sadgs-export … --new"]


@pytest.mark.parametrize("command", FILLED)
def test_a_command_that_is_filled_in_is_understood(command: str, data: Path, capsys: pytest.CaptureFixture[str]):
    parts = map(re.escape, command.split(GAP))
    assert re.search(".*".join(parts), FILLED[command])
    check_understood(FILLED[command], data, capsys)


@pytest.mark.parametrize("words", ["sadgs photos --no-such", "colmap --no-such 1", "ns-render dataset --no-such 1"])
def test_a_wrong_command_is_not_understood(words: str, data: Path):
    assert not any(map(is_understood, completed(words, data)))


@pytest.mark.parametrize(
    "command", [command for command in named() if command.startswith(OTHERS) and not is_bare(command)]
)
def test_a_command_of_others_is_understood_where_it_is_installed(command: str, data: Path):
    words = shlex.split(command.replace(GAP, "x"))
    if words[1].startswith("--") and words[0] in PARSERS:
        pytest.skip("these are options of nerfstudio's parser")
    if shutil.which(words[0]) is None:
        pytest.skip(f"{words[0]} is not installed")
    if words[0] == "mogrify":
        profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))
        (data / "sRGB.icc").write_bytes(profile.tobytes())
        subprocess.run([*words, "images/000.png"], cwd=data, check=True, timeout=60)
        return
    shown = subprocess.run([*words[:2], "--help"], capture_output=True, text=True, timeout=60)
    assert shown.returncode == 0
    assert all(word in shown.stdout for word in words if word.startswith("--"))


def test_the_doctor_s_next_command_reads_the_data(
    data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(doctor, "check_machine", lambda: iter([]))
    status = doctor.main([str(data)])
    assert status == 0
    words = shlex.split(capsys.readouterr().out.splitlines()[-1].removeprefix("Next: "))
    config = read_options(words[2:])
    manager: Any = config.pipeline.datamanager
    manager.data = config.data
    actual = [finding for finding in check_capture(manager) if finding.severity != "note"]
    assert actual == []
