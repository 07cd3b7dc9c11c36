"""From photos to a scene, on drawn photos whose poses are known.

Tried by hand: a downloaded vocabulary tree that is damaged (wrong SHA-256) counts as none, and the sentence says that
it does not match. SIGKILL of the command ends COLMAP's process, too. If COLMAP's process is killed for want of memory,
one sentence names the stage and the remedy. In both cases the same command resumes. CMYK, palette, grey, 16-bit PNG and
TIFF, LZW TIFF and BMP become 8-bit RGB in the scene.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import errno
import itertools
import os
import resource
import shutil
import signal
import sqlite3
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pycolmap
import pytest
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image, ImageFilter
from PIL.TiffImagePlugin import IFDRational
from rich.progress import Progress

from helpers.drawn_photos import HEIGHT, VIEWS, WIDTH, camera_centres, color_profile, draw_photos, walk_centres
from helpers.json_files import read_json, write_json
from helpers.refusals import refusal
from sadgs_ns.cli import process as program
from sadgs_ns.cli.process import Process, main, process
from sadgs_ns.data.checks.transforms import check_nerfstudio
from sadgs_ns.data.layouts import ParserOptions
from sadgs_ns.errors import RunError
from sadgs_ns.placing import features, place, reconstruct
from sadgs_ns.placing.adjustment import adjust_robustly
from sadgs_ns.placing.colmap import make_model, start_colmap
from sadgs_ns.placing.conversion import convert_photos, write_masks
from sadgs_ns.placing.folder import find_source, find_videos, look_into
from sadgs_ns.placing.model_files import check_written
from sadgs_ns.placing.options import PlacingOptions
from sadgs_ns.placing.photos import Photo, photos_by_camera, read_photos
from sadgs_ns.placing.place import Placed, place_photos
from sadgs_ns.placing.plan import EXHAUSTIVE_LIMIT, Matching, Summary, choose_matching
from sadgs_ns.placing.publishing import publish
from sadgs_ns.placing.reconstruct import match, sequential_pairs
from sadgs_ns.placing.scene import Scene
from sadgs_ns.placing.video import count_frames, sharpest_frames, video_frames
from sadgs_ns.training.config import SadgsDatamanagerConfig
from sadgs_ns.worker import Worker


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The room's photos, and one that shows nothing."""
    folder = tmp_path_factory.mktemp("photos")
    for i, photo in enumerate(draw_photos()):
        photo.save(folder / f"{i:02d}.png")
    Image.new("RGB", (WIDTH, HEIGHT), (90, 90, 90)).save(folder / "fog.png")
    return folder


def spy_on_stages(patched: pytest.MonkeyPatch, spy: Callable[[str], None]) -> None:
    """Call a function with the name of each stage of a run when it begins."""

    def reporter(progress: Progress) -> Callable[[str, int, int], None]:
        begun: set[str] = set()

        def report(stage: str, done: int, total: int) -> None:
            if stage not in begun:
                begun.add(stage)
                spy(stage)

        return report

    patched.setattr(program, "_reporter", reporter)


@dataclasses.dataclass
class Run:
    """A run of the room's photos that was interrupted and went on."""

    out: Path
    summary: Summary
    stages: list[str]
    """Of the second run."""
    exit_code: int
    """Of the first run."""
    printed: str
    """By the first run, about its end."""
    left: set[str]
    """Files in the work folder after the first run."""
    matches: list[int]
    """In the database after the first run, and before the second run ended."""


@pytest.fixture(scope="module")
def run(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    out = tmp_path_factory.mktemp("out") / "a scene"
    stages: list[str] = []
    matches: list[int] = []

    def count_matches() -> None:
        database = sqlite3.connect(f"file:{out / 'work' / 'database.db'}?mode=ro", uri=True, timeout=60)
        with contextlib.closing(database):  # COLMAP may be reading it, too.
            matches.append(database.execute("SELECT sum(rows) FROM matches").fetchone()[0])
            assert database.execute("SELECT count(*) FROM cameras").fetchone()[0] == 1

    def interrupt(stage: str) -> None:
        if stage == "cameras":
            os.kill(os.getpid(), signal.SIGTERM)

    def record(stage: str) -> None:
        stages.append(stage)
        if stage == "undistorted photos":
            count_matches()

    printed = tmp_path_factory.mktemp("printed") / "stderr"
    with pytest.MonkeyPatch.context() as patched, printed.open("w") as stderr:
        patched.setattr(sys, "stderr", stderr)
        spy_on_stages(patched, interrupt)
        exit_code = main([str(photos), str(out)])
    left = {path.name for path in (out / "work").iterdir()}
    count_matches()
    with pytest.MonkeyPatch.context() as patched:
        spy_on_stages(patched, record)
        summary = process(Process(photos, out))
    return Run(out, summary, stages, exit_code, printed.read_text(), left, matches)


@pytest.mark.hard_case(
    "how much work `sadgs-process` has", "every stage has a bar with its total, undistortion and frames, too"
)
@pytest.mark.hard_case(
    "SIGTERM, SIGHUP or Ctrl-C in `sadgs-process`",
    'ends in 0.5 s with "stopped; run the same command again to resume.", exit code 143, 129 or 130; half-written '
    "folders are removed, COLMAP's process is gone",
)
def test_an_interrupted_run_ends_in_a_sentence_and_goes_on(run: Run):
    assert run.exit_code == 143
    assert run.printed == "sadgs-process: stopped; run the same command again to resume.\n"
    assert run.left - {"database.db-shm", "database.db-wal"} == {"settings.json", "database.db", "alpha"}
    # Few points of such small photos hold them together, so they are placed a second time.
    placing = ["cameras", "cameras (checked)"]
    assert run.stages == ["photos", "features", "matches (exhaustive)", *placing, "undistorted photos"]
    assert run.matches[0] == run.matches[1] > 0


def test_photos_are_registered_where_they_were_taken(run: Run):
    summary = run.summary
    assert summary.photos == VIEWS + 1
    assert summary.registered == VIEWS
    assert summary.points > 200
    assert summary.reprojection_error < 0.5
    assert list(summary.left_out) == ["fog.png"]
    assert "features" in summary.left_out["fog.png"]
    errors = errors_of_centres(run.out, camera_centres())
    assert np.median(errors) < 0.03
    assert errors.max() < 0.05


def test_all_points_and_cameras_are_adjusted_at_the_end(run: Run):
    model = pycolmap.Reconstruction(run.out / "work/model")
    error = model.compute_mean_reprojection_error()
    adjust_robustly(model)
    assert error == pytest.approx(model.compute_mean_reprojection_error(), rel=3e-4)


def test_points_have_the_mean_colour_of_the_photos_that_show_them(run: Run, photos: Path):
    model = pycolmap.Reconstruction(run.out / "work/model")
    pixels = {path.name: np.asarray(Image.open(path).convert("RGB"), np.float32) for path in photos.iterdir()}
    errors = []
    for point in model.points3D.values():
        images = [(model.images[element.image_id], element.point2D_idx) for element in point.track.elements]
        seen = [cv2.getRectSubPix(pixels[image.name], (1, 1), image.points2D[i].xy - 0.5) for image, i in images]
        errors.append(np.abs(point.color - np.mean(seen, axis=0)).max())
    assert np.max(errors) <= 1


def errors_of_centres(out: Path, expected: np.ndarray) -> np.ndarray:
    """Distances of cameras from where they are [VIEWS, 3], as shares of the largest from their centre. [VIEWS]"""
    model = pycolmap.Reconstruction(out / "sparse/0")
    by_name = {image.name: image.projection_center() for image in model.images.values()}
    found = np.stack([by_name[name] for name in sorted(by_name)])
    # Umeyama's similarity between the two sets of centres.
    found = found - found.mean(0)
    expected = expected - expected.mean(0)
    u, s, vt = np.linalg.svd(expected.T @ found)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    aligned = (found @ (u @ sign @ vt).T) * (s * np.diag(sign)).sum() / (found**2).sum()
    return np.linalg.norm(aligned - expected, axis=1) / np.linalg.norm(expected, axis=1).max()


@pytest.mark.hard_case(
    "photos of a walk straight ahead, of which hardly any register with COLMAP's own limits",
    "all register, and their cameras are within 2 % of the walk",
)
def test_photos_of_a_walk_straight_ahead_register(tmp_path: Path, capsys):
    (tmp_path / "photos").mkdir()
    for i, photo in enumerate(draw_photos(walk_centres())):
        photo.save(tmp_path / "photos" / f"{i:02d}.png")
    status = main([str(tmp_path / "photos"), str(tmp_path / "out")])
    assert status == 0
    printed = capsys.readouterr().out
    assert "10 of 10 photos registered" in printed
    assert errors_of_centres(tmp_path / "out", walk_centres()).max() < 0.02


@pytest.mark.hard_case(
    "all photos register, with focal lengths in x and y that differ as no lens's do, so that cameras are wrong",
    "a second attempt; the model with focal lengths that fit is kept",
)
@pytest.mark.hard_case("fewer than 90 % of the photos register at both attempts", "the model with more is kept")
@pytest.mark.parametrize(("registered", "stretch"), [(VIEWS, 1.2), (VIEWS - 2, 1.0)])
def test_a_doubtful_model_is_tried_again_and_the_better_one_kept(
    run: Run, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, registered: int, stretch: float
):
    shutil.copy(run.out / "work/database.db", tmp_path)
    mapping = pycolmap.incremental_mapping
    angles = []

    def note_the_angle(*arguments: Any, **callbacks: Any) -> Any:
        angles.append(arguments[3].mapper.init_min_tri_angle)
        return mapping(*arguments, **callbacks)

    def spoil_the_first(model: pycolmap.Reconstruction, *fixed: Any) -> None:
        adjust_robustly(model, *fixed)
        if len(angles) == 1:
            for frame in list(model.frames)[registered:]:
                model.deregister_frame(frame)
            for camera in model.cameras.values():
                camera.focal_length_x *= stretch

    monkeypatch.setattr(pycolmap, "incremental_mapping", note_the_angle)
    monkeypatch.setattr(reconstruct, "adjust_robustly", spoil_the_first)
    monkeypatch.setattr(reconstruct, "is_firm", lambda model: True)
    names = sorted(photo.name for photo in photos.iterdir())
    reconstruct.place_cameras(photos, names, tmp_path / "database.db", tmp_path / "model", None)
    made = pycolmap.Reconstruction(tmp_path / "model")
    (camera,) = made.cameras.values()
    assert angles == [8, 4]
    assert made.num_reg_images() == VIEWS
    assert camera.focal_length_x == pytest.approx(camera.focal_length_y, rel=0.05)
    told = (tmp_path / "model/attempts.txt").read_text()
    assert told == f"A first attempt registered {registered}, one with relaxed limits {VIEWS}."


@pytest.mark.hard_case(
    "a photo that is added to many does not register at the first attempt",
    "a second attempt with relaxed limits, as for a new scene; if it fails, too, another output folder is advised",
)
def test_photos_that_are_added_are_tried_again_however_many_there_are(
    run: Run, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    shutil.copy(run.out / "work/database.db", tmp_path)
    base = tmp_path / "base"
    base.mkdir()
    earlier = pycolmap.Reconstruction(run.out / "work/model")
    earlier.deregister_frame(max(earlier.reg_frame_ids()))
    earlier.write(base)
    assert earlier.num_reg_images() == VIEWS - 1 >= 0.9 * VIEWS
    mapping = pycolmap.incremental_mapping
    angles: list[float] = []
    failing = 1

    def fail_at_first(*arguments: Any, **callbacks: Any) -> Any:
        angles.append(arguments[3].mapper.init_min_tri_angle)
        if len(angles) <= failing:
            return {0: pycolmap.Reconstruction(base)}
        return mapping(*arguments, **callbacks)

    monkeypatch.setattr(pycolmap, "incremental_mapping", fail_at_first)
    names = sorted(photo.name for photo in photos.iterdir())
    reconstruct.place_cameras(photos, names, tmp_path / "database.db", tmp_path / "model", base)
    assert angles == [8, 4]
    assert pycolmap.Reconstruction(tmp_path / "model").num_reg_images() == VIEWS
    told = (tmp_path / "model/attempts.txt").read_text()
    assert told == f"A first attempt registered {VIEWS - 1}, one with relaxed limits {VIEWS}."

    failing = 4
    with refusal("related to the others: give another output folder, for which all photos"):
        reconstruct.place_cameras(photos, names, tmp_path / "database.db", tmp_path / "other", base)
    assert angles == [8, 4, 8, 4]
    assert not (tmp_path / "other").exists()


@pytest.mark.hard_case(
    "all photos register with an angle of view that no lens has",
    "a second attempt; a model that can be right is kept, even with fewer photos",
)
def test_a_wrong_model_ranks_below_one_with_fewer_photos(
    run: Run, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    shutil.copy(run.out / "work/database.db", tmp_path)
    attempts: list[int] = []

    def spoil(model: pycolmap.Reconstruction, *fixed: Any) -> None:
        adjust_robustly(model, *fixed)
        attempts.append(model.num_reg_images())
        if len(attempts) == 1:
            for camera in model.cameras.values():
                camera.params = [78934, 78934, *camera.params[2:]]
        else:
            for frame in list(model.frames)[VIEWS - 3 :]:
                model.deregister_frame(frame)

    monkeypatch.setattr(reconstruct, "adjust_robustly", spoil)
    monkeypatch.setattr(reconstruct, "is_firm", lambda model: True)
    names = sorted(photo.name for photo in photos.iterdir())
    reconstruct.place_cameras(photos, names, tmp_path / "database.db", tmp_path / "model", None)
    made = pycolmap.Reconstruction(tmp_path / "model")
    assert attempts == [VIEWS, VIEWS]
    assert made.num_reg_images() == VIEWS - 3
    assert all(camera.mean_focal_length() < 1000 for camera in made.cameras.values())


@pytest.mark.hard_case("photos of which COLMAP makes cameras without points", "refused, as where none are related")
def test_cameras_without_points_are_none(run: Run, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    shutil.copy(run.out / "work/database.db", tmp_path)
    model = pycolmap.Reconstruction(run.out / "work/model")
    for point in list(model.points3D):
        model.delete_point3D(point)
    monkeypatch.setattr(pycolmap, "incremental_mapping", lambda *others, **callbacks: {0: model})
    names = sorted(photo.name for photo in photos.iterdir())
    with refusal(r"could be related to each other .*; take more of them, from different places"):
        reconstruct.place_cameras(photos, names, tmp_path / "database.db", tmp_path / "model", None)
    assert not (tmp_path / "model").exists()


def test_the_summary_has_the_reasons_that_speak_against_a_model(run: Run, photos: Path):
    assert run.summary.doubts == run.summary.faults == []
    assert not run.summary.is_poor
    model = pycolmap.Reconstruction(run.out / "work/model")
    for camera in model.cameras.values():
        camera.params = [33, 45, *camera.params[2:]]
    names = sorted(photo.name for photo in photos.iterdir())
    summary = reconstruct.summarize(names, model, run.out / "work/database.db", "exhaustive", "")
    assert summary.is_poor
    assert summary.registered == VIEWS
    assert summary.faults[0].startswith("they would see 135° across, more than a lens does: ")
    assert summary.doubts[0].startswith("their focal lengths across and down would differ by a factor of 1.4: ")


@pytest.mark.hard_case("photos of two scenes in one folder", "those of the smaller one are said to share nothing")
def test_photos_of_another_scene_share_nothing_with_those_that_registered(
    run: Run, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(reconstruct, "FEW_FEATURES", 1)
    model = pycolmap.Reconstruction(run.out / "work/model")
    names = sorted(photo.name for photo in photos.iterdir())
    placed, alone, other = names[:3]
    for image in list(model.images.values()):
        if image.name != placed:
            model.deregister_frame(image.frame_id)
    database = Path(shutil.copy(run.out / "work/database.db", tmp_path))
    with pycolmap.Database.open(database) as opened:
        identities = {image.name: image.image_id for image in opened.read_all_images()}
        opened.clear_two_view_geometries()
        for one, two in ((placed, other), (alone, names[3])):
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = np.stack([np.arange(40, dtype=np.uint32)] * 2, axis=1)
            opened.write_two_view_geometry(identities[one], identities[two], geometry)
    left_out = reconstruct.summarize(names[:4], model, database, "exhaustive", "").left_out
    assert left_out[other] == "matches other photos, but its pose stayed ambiguous"
    share_nothing = "matches none of the registered photos, only others that are left out: another scene?"
    assert left_out[alone] == left_out[names[3]] == share_nothing


# nerfstudio opens the first photo to learn its size and does not close it.
OPEN = pytest.mark.filterwarnings("ignore:Exception ignored in. <_io.FileIO:pytest.PytestUnraisableExceptionWarning")


@OPEN
def test_nerfstudio_reads_the_scene_without_options(run: Run, open3d: None):
    parsed = NerfstudioDataParserConfig(data=run.out, load_3D_points=True).setup().get_dataparser_outputs("train")
    assert 0 < len(parsed.image_filenames) < VIEWS
    for path in parsed.image_filenames:
        assert path.exists()
    sizes = torch.cat([parsed.cameras.width, parsed.cameras.height], dim=-1)
    assert len(sizes.unique(dim=0)) == 1
    assert parsed.cameras.distortion_params is None or not parsed.cameras.distortion_params.any()
    assert len(parsed.metadata["points3D_xyz"]) > 200


@OPEN
def test_training_reads_the_scene_without_options(run: Run):
    parser = NerfstudioDataParserConfig(data=run.out, load_3D_points=True)
    dataset = SadgsDatamanagerConfig(dataparser=parser).setup(device="cpu").train_dataset
    assert 0 < len(dataset) < VIEWS
    assert len(dataset.metadata["points3D_xyz"]) > 200


@pytest.mark.hard_case(
    "`work/` of a finished scene",
    "holds what photos can be added to: settings, features with matches, and the model; the same command says "
    "that the scene is finished and changes nothing",
)
@pytest.mark.hard_case("a scene is finished", "`sadgs-doctor` and `ns-train` are named as next, quoted for the shell")
def test_a_finished_scene_keeps_what_photos_are_added_to_and_is_known_again(run: Run, photos: Path, capsys):
    actual = {path.name for path in (run.out / "work").iterdir()}
    assert actual == {"settings.json", "database.db", "model"}
    before = {path: path.stat().st_mtime_ns for path in run.out.rglob("*")}
    status = main([str(photos), str(run.out)])
    assert status == 0
    printed = capsys.readouterr().out
    assert "a scene is finished; delete it to make it again." in printed
    assert f"{VIEWS} of {VIEWS + 1} photos registered" in printed
    assert "sadgs-doctor '" in printed
    assert f"ns-train sadgs --data '{run.out}'" in printed
    expected = {path: path.stat().st_mtime_ns for path in run.out.rglob("*")}
    assert before == expected
    status = main([str(photos), str(run.out), "--max-size", "80"])
    assert status == 2
    errors = capsys.readouterr().err
    assert "(--max-size was 1600, is 80); give another folder" in errors


def test_a_film_gives_its_sharpest_frames(scene: Path, tmp_path: Path):
    frames = [cv2.imread(str(path)) for path in sorted((scene / "images").iterdir())[:6]]
    height, width, _ = frames[0].shape
    writer = cv2.VideoWriter(str(tmp_path / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (width, height))
    for frame in frames:
        for sigma in (4, 0, 4):  # sharp in the middle of each stretch
            writer.write(cv2.GaussianBlur(frame, (0, 0), sigma) if sigma else frame)
    writer.release()
    chosen = list(sharpest_frames(tmp_path / "film.avi", 6, 18))
    assert [number for number, _ in chosen] == list(range(6))
    for (_, actual), expected in zip(chosen, frames, strict=True):
        assert np.abs(actual.astype(float) - expected).mean() < 8


def test_sequential_pairs_are_neighbours_and_ever_fewer_farther_on():
    names = [f"{i:03d}" for i in range(40)]
    pairs = sequential_pairs(names, overlap=3)
    steps = {int(b) - int(a) for a, b in pairs}
    assert steps == {1, 2, 3, 16, 32}
    assert len(pairs) == len(set(pairs)) == 39 + 38 + 37 + 24 + 8
    assert len(pairs) < len(list(itertools.combinations(names, 2))) / 5


def test_photos_of_one_size_and_lens_share_a_camera(tmp_path: Path):
    for name, size, focal in (("a", 8, None), ("b", 8, None), ("c", 9, None), ("d", 8, 50.0), ("e", 8, 35.0)):
        image = Image.new("RGB", (size, 8))
        exif = Image.Exif()
        if focal is not None:
            exif.get_ifd(0x8769)[0x920A] = focal
        image.save(tmp_path / f"{name}.jpg", exif=exif)
    groups = photos_by_camera(read_photos(tmp_path, [f"{name}.jpg" for name in "abcde"], lambda *step: None))
    assert groups == [["a.jpg", "b.jpg"], ["c.jpg"], ["d.jpg"], ["e.jpg"]]


@pytest.mark.hard_case("the photos' folder or the video is a loop of links", "one sentence")
@pytest.mark.parametrize(
    ("prepare", "sentence"),
    [
        (lambda folder: None, "photos does not exist; give a folder of photos or of videos, or a video."),
        (lambda folder: folder.mkdir(), "photos holds 0 photos; a reconstruction needs at least 3"),
        (
            lambda folder: heic(folder),
            "as images that are not read (make them .jpg or .png files): 4, such as IMG_0.HEIC.",
        ),
        (lambda folder: folder.write_text("x"), "photos cannot be read as a video (Invalid data found when processing"),
        (lambda folder: broken(folder), "1 of the 3 photos in "),
        (lambda folder: broken(folder), "whole image: 2.png (no image that Pillow knows); copy it again or remove it."),
        (lambda folder: link(folder), "photos does not exist; give a folder of photos or of videos, or a video."),
    ],
)
def test_bad_photos_are_told_in_a_sentence(tmp_path: Path, prepare, sentence: str, capsys):
    prepare(tmp_path / "photos")
    status = main([str(tmp_path / "photos"), str(tmp_path / "out")])
    assert status == 2
    printed = capsys.readouterr().err
    assert sentence in printed
    assert printed.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.hard_case("a ZIP or tar of photos, or a folder with one, instead of photos", "refused: unpack it")
@pytest.mark.parametrize("kind", ["zip", "tar", "gztar"])
def test_an_archive_of_photos_is_no_video(kind: str, tmp_path: Path, capsys):
    """FFmpeg takes an archive in which JPEGs are stored for a video of these."""
    (tmp_path / "photos").mkdir()
    for i, photo in enumerate(itertools.islice(draw_photos(), 5)):
        photo.save(tmp_path / "photos" / f"{i}.jpg")
    archive = Path(shutil.make_archive(str(tmp_path / "archives/photos"), kind, tmp_path / "photos"))
    status = main([str(archive), str(tmp_path / "out")])
    assert status == 2
    sentence = f"{archive} is an archive: unpack it, and give the folder of its photos or videos."
    errors = capsys.readouterr().err
    assert errors == f"sadgs-process: {sentence}\n"
    status = main([str(archive.parent), str(tmp_path / "out")])
    assert status == 2
    errors = capsys.readouterr().err
    assert errors.endswith(f"It holds archives (1, such as {archive.name}): unpack them.\n")
    assert not (tmp_path / "out").exists()


@pytest.mark.hard_case(
    "`.insp`, `.insv` and `.360`, as 360° cameras store photos and videos", "left out with a count, or refused: stitch"
)
@pytest.mark.parametrize("suffix", [".insp", ".INSV", ".360"])
def test_files_of_360_degree_cameras_must_be_stitched(suffix: str, tmp_path: Path, capsys):
    folder = tmp_path / "photos"
    folder.mkdir()
    for i in range(3):
        Image.new("RGB", (64, 32)).save(folder / f"{i}{suffix}", "JPEG")
    status = main([str(folder), str(tmp_path / "out")])
    assert status == 2
    stitch = "(stitch them to panoramas or films of 2:1 with the camera's program): 3, such as 0"
    sentence = f"better 30 or more. Left out as files of 360° cameras {stitch}{suffix}.\n"
    errors = capsys.readouterr().err
    assert sentence in errors
    status = main([str(folder / f"0{suffix}"), str(tmp_path / "out")])
    assert status == 2
    errors = capsys.readouterr().err
    assert "stitch it to a panorama or film of 2:1 with the camera's program." in errors


@pytest.mark.hard_case("videos of camcorders (`.mts`, `.mxf`, `.mpeg`) in a folder", "read as others")
def test_videos_of_camcorders_are_videos(tmp_path: Path):
    names = ["a.MTS", "b.mxf", "c.mpeg"]
    for name in names:
        (tmp_path / name).touch()
    assert find_videos(tmp_path) == names


@pytest.mark.hard_case("a single photo, or a text, instead of photos", "refused")
def test_what_ffmpeg_alone_takes_for_a_video_is_none(tmp_path: Path):
    photo = next(iter(draw_photos()))
    (tmp_path / "a.txt").write_text("a letter\n" * 1000)
    for name, problem in (("a.jpg", "is a single image"), ("a.png", "is a single image"), ("a.txt", "it is a text")):
        if not (tmp_path / name).exists():
            photo.save(tmp_path / name)
        with refusal(problem):
            count_frames(tmp_path / name)


def heic(folder: Path) -> None:
    folder.mkdir()
    for i in range(4):
        (folder / f"IMG_{i}.{'jpg' if i == 3 else 'HEIC'}").write_bytes(b"\0\0\0\x18ftypheic")


@pytest.mark.hard_case(
    "images that are not read: damaged HEIC, also named `.jpg`, raw files, JPEG XL, GIF, and JPEG of an unknown suffix",
    "counted in a line; the others are used",
)
def test_photos_that_are_not_read_are_told_beside_those_that_are(
    tmp_path: Path, registered: Callable[[int], None], capsys
):
    folder = tmp_path / "photos"
    heic(folder)
    black(folder, "a.png", "b.png", "c.png", "d.gif", "e.jpg")
    (folder / "e.jpg").rename(folder / "e.jpg_large")
    Image.new("RGB", (8, 8)).save(folder / "f.NEF", "TIFF")
    (folder / "g.jxl").write_bytes(b"\xff\x0a")
    (folder / "notes.txt").write_text("no image")
    registered(9)
    status = main([str(folder), str(tmp_path / "out")])
    assert status == 0
    printed = capsys.readouterr().out
    assert "9 of 12 photos registered" in printed
    assert "as images that are not read (make them .jpg or .png files): 8, such as IMG_0.HEIC.\n" in printed


def broken(folder: Path) -> None:
    folder.mkdir()
    black(folder, "0.png", "1.png")
    (folder / "2.png").write_bytes(b"no image")


def link(path: Path) -> None:
    path.symlink_to(path)


@pytest.mark.hard_case(
    "photos cut at 60 % (JPEG, PNG, WebP, TIFF), empty ones, files that are no images, links to themselves, "
    "more than 179 million pixels",
    "refused before any work; all are named (20 at most, and how many more)",
)
def test_all_photos_that_are_not_whole_are_named(tmp_path: Path, capsys):
    """COLMAP reads the missing part of a photo as black."""
    photo = next(draw_photos())
    for name in ("a.jpg", "b.jpg", "c.png", "d.webp", "e.tif", "f.png"):
        photo.save(tmp_path / name)
    for name in ("b.jpg", "c.png", "d.webp", "e.tif"):
        content = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(content[: len(content) * 6 // 10])
    for name in ("g.jpg", "h.jpg"):
        (tmp_path / name).write_bytes(b"")
    link(tmp_path / "i.png")
    status = main([str(tmp_path), str(tmp_path / "out")])
    assert status == 2
    printed = capsys.readouterr().err
    assert "7 of the 9 photos in" in printed
    assert printed.count("\n") == 1
    assert not (tmp_path / "out").exists()
    assert all(f"{name} (" in printed for name in ("b.jpg", "c.png", "d.webp", "e.tif", "i.png"))
    assert "g.jpg (0 bytes), h.jpg (0 bytes)" in printed
    assert "copy them again or remove them" in printed
    with refusal(r"0\.jpg \(.*, 19\.jpg \(.*\), 5 more; copy"):
        read_photos(tmp_path, [f"{i}.jpg" for i in range(25)], lambda *step: None)


@pytest.mark.hard_case(
    "macOS's `._photo.jpg`, `.thumbnails/`, a folder named `x.png`, a link to the photos' own folder", "no photos"
)
@pytest.mark.hard_case("names that are no Unicode, or with line breaks", "refused by name: rename it")
@pytest.mark.hard_case("names with the narrow space of macOS's screenshots, or joined emoji", "work")
def test_hidden_files_and_folders_named_as_photos_are_no_photos(tmp_path: Path):
    black(tmp_path, "a.png", "b.png", "c.png", "._a.png", ".thumbnails/a.png", "folder.png/d.png")
    (tmp_path / "around").symlink_to(tmp_path)
    names = ["a.png", "b.png", "c.png", "folder.png/d.png"]
    actual = find_source(tmp_path, tmp_path / "out")
    assert actual == (names, False, {}, [])
    names.append("shot at 3.04\u202fPM \N{FAMILY}\u200d.png")
    black(tmp_path, names[-1])
    assert find_source(tmp_path, tmp_path / "out")[0] == names
    black(tmp_path, "line\nbreak.png")
    with refusal(r"unprintable characters in its name, 'line.nbreak.png': rename it"):
        find_source(tmp_path, tmp_path / "out")


@pytest.mark.hard_case(
    "folders of photos that are links to others elsewhere, also in circles, to `/` or to each other",
    "each photo is read once, and a scene there is none of them",
)
@pytest.mark.hard_case("a folder among the photos that may not be entered", "left out, with a line")
def test_linked_folders_are_followed_and_no_photo_is_read_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    photos = tmp_path / "photos"
    elsewhere = tmp_path / "elsewhere"
    black(photos, "a.png", "sub/b.png")
    black(elsewhere, "c.png", "sub/d.png", "scene/images/e.png")
    (elsewhere / "scene/work").mkdir()
    (elsewhere / "scene" / "work/settings.json").write_text("{}")
    for link, target in {
        photos / "a link": photos / "sub", photos / "day": elsewhere, photos / "sub/root": Path("/"),
        elsewhere / "sub/circle": elsewhere, elsewhere / "back": photos / "sub", photos / "gone": tmp_path / "no",
    }.items():  # fmt: skip
        link.symlink_to(target)
    (photos / "locked").mkdir()
    scandir = os.scandir

    def without_rights(folder: str) -> Any:
        if os.path.basename(folder) == "locked":
            raise PermissionError(errno.EACCES, "Permission denied", folder)
        return scandir(folder)

    monkeypatch.setattr(os, "scandir", without_rights)
    names = ["a.png", "day/c.png", "day/sub/d.png", "sub/b.png"]
    left_out = ["Left out as folders that cannot be read: 1, such as locked."]
    for source in (photos, Path(os.path.relpath(photos))):
        actual = find_source(source, tmp_path / "out")
        assert actual == (names, False, {}, left_out)


@pytest.mark.hard_case("the output folder is a loop of links", "one sentence")
def test_an_output_folder_that_is_a_loop_of_links_is_named(photos: Path, tmp_path: Path, capsys):
    link(tmp_path / "out")
    status = main([str(photos), str(tmp_path / "out")])
    assert status == 1
    printed = capsys.readouterr().err
    assert "out" in printed
    assert printed.count("\n") == 1


@pytest.mark.hard_case("`--max-size 5`, 63, −5", "refused: at least 64, or 0")
@pytest.mark.parametrize("size", ["-5", "5", "63"])
def test_a_size_without_structure_is_refused(tmp_path: Path, size: str, capsys):
    status = main([str(tmp_path), str(tmp_path / "out"), "--max-size", size])
    assert status == 2
    errors = capsys.readouterr().err
    assert "--max-size must be at least 64 px, or 0 to keep the photos' size" in errors


@pytest.mark.hard_case(
    "`a.webp` beside `a.webp.jpg`", "refused, because the first would become the second: rename one; neither is touched"
)
def test_a_converted_photo_never_replaces_another_one(tmp_path: Path, capsys):
    for name, grey in (("a.webp", 90), ("a.webp.jpg", 160), ("b.png", 200)):
        Image.new("RGB", (320, 240), (grey,) * 3).save(tmp_path / name)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    status = main([str(tmp_path), str(tmp_path / "scene")])
    assert status == 2
    errors = capsys.readouterr().err
    assert "converted, two photos would be called a.webp.jpg; rename one" in errors
    actual = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
    assert actual == before


@pytest.mark.hard_case("transparent photos", "alpha is kept: the scene's images are RGBA, a line says how many")
@pytest.mark.hard_case("a folder of WebP (COLMAP reads none), or a mixed one", "converted")
@pytest.mark.hard_case(
    "WebP and AVIF named `.jpg`, JPEG named `.jfif` and `.HEIC`, PNG named `.jpg` that is transparent",
    "read by what they hold",
)
@pytest.mark.hard_case("names with spaces, quotes, umlauts, Chinese; suffixes in capitals; folders in folders", "work")
def test_names_with_spaces_and_webp_and_transparent_photos(tmp_path: Path, capsys):
    """COLMAP reads neither WebP nor AVIF and leaves out alpha, all without a word."""
    kinds = [("webp", "WEBP"), ("jpg", "PNG"), ("webp", "WEBP"), ("jpg", "WEBP"), ("jfif", "JPEG"), ("HEIC", "JPEG")]
    if "AVIF" in Image.SAVE:  # since Pillow 11.3
        kinds[4:] = [("JPG", "AVIF"), ("HEIC", "JPEG")]
    (tmp_path / "photos").mkdir()
    for i, photo in enumerate(itertools.islice(draw_photos(), 6)):
        alpha = Image.new("L", photo.size, 255)
        alpha.paste(0, (0, 0, WIDTH // 4, HEIGHT))
        if i in (1, 2):
            photo.putalpha(alpha)
        suffix, kind = kinds[i]
        photo.save(tmp_path / "photos" / f"my photo {i}.{suffix}", kind, lossless=kind == "WEBP", quality=98)
    summary = process(Process(tmp_path / "photos", tmp_path / "out", max_size=80))
    printed = capsys.readouterr().out
    assert "2 photos are partly transparent" in printed
    assert summary.registered == 6
    assert not summary.left_out
    frames = read_json(tmp_path / "out/transforms.json")["frames"]
    assert len(frames) == 6
    transparent = []
    for frame in frames:
        with Image.open(tmp_path / "out" / frame["file_path"]) as image:
            assert max(image.size) == 80
            if image.mode == "RGBA":
                transparent.append(Path(frame["file_path"]).name)
                opacity = np.asarray(image.getchannel("A"))
                assert not opacity[:, :15].any()
                assert (opacity[10:-10, 25:-10] == 255).all()
    assert sorted(transparent) == ["my photo 1.jpg.png", "my photo 2.webp.png"]


TURNS = {  # EXIF's orientation: how Pillow undoes what it tells
    2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180, 6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE, 8: Image.Transpose.ROTATE_270,
}  # fmt: skip


def lying(photo: Image.Image, orientation: int, path: Path) -> None:
    """Store a photo turned or mirrored, as EXIF then tells."""
    exif = Image.Exif()
    exif[0x112] = orientation
    photo.transpose(TURNS[orientation]).save(path, exif=exif, quality=97)


@pytest.mark.hard_case(
    "masks of photos: `masks/NAME.png`, COLMAP's `masks/NAME.jpg.png`, `NAME_mask.png`, of half the size, of 0 and 1, "
    "or of a photo that lies on its side",
    "no features where they are black; the scene has them, and white ones for the other photos",
)
@pytest.mark.hard_case(
    "EXIF orientations of 6, 8, 3, and mirrored (2, 7), in JPEG and PNG, beside upright photos",
    "the scene's images are upright and without the tag, all of one camera",
)
def test_photos_that_lie_on_their_side_by_exif_become_upright(tmp_path: Path):
    (tmp_path / "photos").mkdir()
    drawn = dict(enumerate(draw_photos()))
    for i, photo in drawn.items():
        path = tmp_path / "photos" / f"{i:02d}.{'jpg' if i % 2 else 'png'}"
        lying(photo, [*TURNS][i], path) if i < len(TURNS) else photo.save(path, quality=97)
    black(tmp_path / "photos", "masks/none.png")
    mask = Image.new("L", (WIDTH // 2, HEIGHT // 2), 255)
    mask.paste(0, (0, 0, WIDTH // 8, HEIGHT))  # a quarter, on the left
    mask.save(tmp_path / "photos/masks/00.png")
    mask.transpose(TURNS[6]).save(tmp_path / "photos/masks/02.png.png")  # as that photo is stored
    mask.point([value // 255 for value in range(256)]).save(tmp_path / "photos/05_mask.png")
    summary = process(Process(tmp_path / "photos", tmp_path / "out"))
    assert summary.registered == VIEWS
    assert errors_of_centres(tmp_path / "out", camera_centres()).max() < 0.05
    described = read_json(tmp_path / "out/transforms.json")
    assert described["w"] > described["h"]
    for name in (frame["file_path"] for frame in described["frames"]):
        with Image.open(tmp_path / "out" / name) as image:
            assert image.getexif().get(0x112, 1) == 1
            photo = drawn[int(name[-6:-4])]
            actual = np.ravel(np.asarray(image.convert("L").resize((32, 24))))
            expected = np.ravel(np.asarray(photo.convert("L").resize((32, 24))))
        assert np.corrcoef(actual, expected)[0, 1] > 0.9
        with Image.open(tmp_path / "out/masks" / f"{Path(name).name}.png") as mask:
            columns = np.asarray(mask)
            masked = name[-6:-4] in ("00", "02", "05")
        assert (columns[:, :35] == 255 * (not masked)).all()
        assert (columns[:, 45:-5] == 255).all()
    assert [frame["mask_path"] for frame in described["frames"] if frame["file_path"] == "images/02.png"]
    with pycolmap.Database.open(tmp_path / "out" / "work/database.db") as opened:
        keypoints = [opened.read_keypoints(image.image_id) for image in opened.read_all_images()]
    assert sorted(found[:, 0].min() > WIDTH / 4 - 1 for found in keypoints) == [False] * 7 + [True] * 3
    found = check_nerfstudio(tmp_path / "out", ParserOptions())
    assert {finding.severity for finding in found} == {"note"}, found
    assert "with 10 masks" in found[-2].sentence, found


@pytest.mark.hard_case(
    "photos with masks, added to a scene", "where it has masks, all of them get one; where it has none, a line says so"
)
@pytest.mark.parametrize("has_masks", [False, True])
def test_photos_that_are_added_are_turned_and_get_masks_if_the_scene_has_some(
    has_masks: bool, tmp_path: Path, registered: Callable[[int], None], monkeypatch: pytest.MonkeyPatch, capsys
):
    source = tmp_path / "photos"
    out = tmp_path / "out"
    photo, other = itertools.islice(draw_photos(), 2)
    source.mkdir()
    for name, orientation in (("a.jpg", 6), ("b.jpg", 8), ("c.jpg", 3)):
        lying(photo, orientation, source / name)
    registered(9)
    process(Process(source, out))
    (out / "transforms.json").write_text("{}")
    lying(other, 6, source / "d.jpg")
    (source / "masks").mkdir()
    Image.new("L", photo.size).save(source / "masks/d.png")
    if has_masks:
        (out / "masks").mkdir()
    made: dict[str, tuple[int, int]] = {}
    masks: dict[str, Any] = {}

    def look(colmap: Worker, photos: Path, groups: list[list[str]], *others: object, **named: object) -> None:
        assert groups == [["a.jpg", "b.jpg", "c.jpg", "d.jpg"]]
        for name in itertools.chain(*groups):
            with Image.open(photos / name) as image:
                made[name] = image.size
        masks.update((path.name, Image.open(path).getextrema()) for path in (out / "work").glob("masks/*"))
        raise KeyboardInterrupt

    monkeypatch.setattr("sadgs_ns.placing.place.make_model", look)
    status = main([str(source), str(out)])
    assert status == 130
    assert made == dict.fromkeys(("a.jpg", "b.jpg", "c.jpg", "d.jpg"), photo.size)
    white = dict.fromkeys(("a.jpg.png", "b.jpg.png", "c.jpg.png"), (255, 255))
    assert masks == (white | {"d.jpg.png": (0, 0)} if has_masks else {})
    printed = capsys.readouterr().out
    assert f"Masks of 1 photos are {'used' if has_masks else 'not used'}" in printed


@pytest.mark.hard_case(
    "in the photos' folder: thumbnails and trash of a NAS (`@eaDir`, `#recycle`), `__MACOSX`, `images_2`, `images_4`, "
    "copies such as `a (1).jpg`, the same photo as WebP, an iPhone's edited `IMG_E1.jpg`, a mask of no photo, depth "
    "and confidence maps as scanners of phones keep them, an earlier scene",
    "left out, with a line; photos of a rig's cameras, which have equal names, are not",
)
def test_what_is_no_photo_becomes_none(tmp_path: Path):
    """Photos that the scene was begun with stay photos."""
    views = [photo.filter(ImageFilter.GaussianBlur(3)) for photo in itertools.islice(draw_photos(), 7)]
    files = {
        "images/a.jpg": views[0], "images/b.jpg": views[1], "images/IMG_1.jpg": views[2], "rig/a.jpg": views[3],
        "rig/b.jpg": views[4].resize((80, 60)), "masks/carnival.jpg": views[5], "masks/b.jpg": views[6],
    }  # fmt: skip
    left = {
        "images_2/a.jpg": views[0].resize((80, 60)), "images_4/b.png": views[1].resize((40, 30)),
        "images/b.webp": views[1], "images/IMG_E1.jpg": views[2].point(lambda value: 0.7 * value + 50),
        "@eaDir/a.jpg/SYNOFILE_THUMB_M.jpg": views[0].resize((80, 60)), "#recycle/old.jpg": views[0].rotate(9),
        "__MACOSX/x.jpg": views[0].rotate(20), "masks/none.png": Image.new("L", (WIDTH, HEIGHT)),
        "images/a_mask.png": Image.new("L", (WIDTH, HEIGHT), 255), "depth/a.png": Image.new("I;16", (WIDTH, HEIGHT), 9),
        "images/b.depth.png": Image.new("I;16", (WIDTH, HEIGHT), 8), "Confidence/b.png": Image.new("L", (WIDTH, 9), 7),
    }  # fmt: skip
    for name, image in (files | left).items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        image.save(tmp_path / name, quality=90)
    shutil.copy(tmp_path / "images/a.jpg", tmp_path / "images/a (1).jpg")
    black(tmp_path / "earlier", "images/c.png")
    (tmp_path / "earlier/work").mkdir()
    (tmp_path / "earlier" / "work/settings.json").write_text("{}")
    found, masks, told = look_into(tmp_path, tmp_path / "out")
    assert found == sorted(files)
    assert masks == {"images/a.jpg": "images/a_mask.png"}
    assert told == [
        "Left out as thumbnails or trash: 3, such as #recycle/old.jpg.",
        "Left out as depth or other maps: 3, such as Confidence/b.png.",
        "Left out as copies of others: 5, such as images_2/a.jpg.",
        "Left out as masks of no photo: 1, such as masks/none.png.",
    ]
    (tmp_path / "out/work").mkdir(parents=True)
    write_json(tmp_path / "out" / "work/settings.json", {"photos": [*left, "images/b.jpg"]})
    actual = look_into(tmp_path, tmp_path / "out")[0]
    expected = sorted({*left, *files} - {"images/a.jpg", "images/IMG_1.jpg"})
    assert actual == expected


@pytest.mark.hard_case(
    "photos `room (1).jpg`, `room (2).jpg`, as Windows renames them, that look alike, and their masks",
    "are no copies of each other, and each has its own mask",
)
def test_photos_that_windows_numbered_are_no_copies_and_have_their_own_masks(tmp_path: Path):
    (tmp_path / "masks").mkdir()
    view = next(draw_photos()).filter(ImageFilter.GaussianBlur(3))
    for i in range(1, 4):
        view.rotate(0.1 * i).resize((160 + 40 * i, 120 + 30 * i)).save(tmp_path / f"room ({i}).jpg")
        Image.new("L", view.size, 255).save(tmp_path / "masks" / f"room ({i}).png")
    shutil.copy(tmp_path / "room (1).jpg", tmp_path / "room (9).jpg")
    names = [f"room ({i}).jpg" for i in range(1, 4)]
    masks = {name: f"masks/{Path(name).stem}.png" for name in names}
    told = ["Left out as copies of others: 1, such as room (9).jpg."]
    actual = look_into(tmp_path, tmp_path / "out")
    assert actual == (names, masks, told)


def test_a_mistake_of_ours_is_not_taken_for_a_damaged_photo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    next(draw_photos()).save(tmp_path / "a.jpg")
    next(draw_photos()).resize((120, 90)).save(tmp_path / "a.png")
    assert look_into(tmp_path, tmp_path / "out")[0] == ["a.jpg"]

    def mistaken(*others: Any, **named: Any) -> None:
        raise KeyError("a mistake")

    with monkeypatch.context() as patched, pytest.raises(KeyError, match="a mistake"):
        patched.setattr(np, "corrcoef", mistaken)
        look_into(tmp_path, tmp_path / "out")
    (tmp_path / "masks").mkdir()
    Image.radial_gradient("L").save(tmp_path / "masks/a.png")
    with monkeypatch.context() as patched, pytest.raises(KeyError, match="a mistake"):
        patched.setattr(np, "ptp", mistaken)
        look_into(tmp_path, tmp_path / "out")


@pytest.mark.hard_case(
    "a photo and another one of its name, one cut off or of bytes alone", "no copies; it is named when photos are read"
)
@pytest.mark.parametrize("size", [0.5, 0.05, 0])
def test_damaged_photos_are_copies_of_none(tmp_path: Path, size: float):
    view = next(draw_photos())
    view.save(tmp_path / "a.jpg")
    view.resize((120, 90)).save(tmp_path / "a.png")
    view.resize((100, 75)).save(tmp_path / "a_mask.png")
    for name in ("a.png", "a_mask.png"):
        content = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(content[: int(size * len(content))] + name.encode())
    found, masks, _ = look_into(tmp_path, tmp_path / "out")
    assert found == ["a.jpg", "a.png", "a_mask.png"]
    assert masks == {}


@pytest.mark.hard_case("a phone's panorama of a part of the view among the photos", "left out, with a line")
def test_panoramas_of_a_part_of_the_view_are_left_out(tmp_path: Path):
    exif = Image.Exif()
    view = next(draw_photos())
    exif[0x8769] = {0xA401: 6}  # Apple's number of a panorama
    google = b'<rdf:Description GPano:ProjectionType="cylindrical"/>'
    photos: list[tuple[str, tuple[int, int], dict[str, Any]]] = [
        ("apple.jpg", (300, 80), {"exif": exif}),
        ("google.jpg", (300, 90), {"xmp": google}),
        ("whole.jpg", (200, 100), {"xmp": google}),
        ("wide.jpg", (300, 70), {}),
        ("photo.jpg", (160, 120), {}),
    ]
    for name, size, more in photos:
        view.resize(size).save(tmp_path / name, **more)
    found, _, told = look_into(tmp_path, tmp_path / "out")
    assert found == ["photo.jpg", "whole.jpg", "wide.jpg"]
    assert told == ["Left out as panoramas of a part of the view: 2, such as apple.jpg."]


@pytest.mark.hard_case("masks of two colours, such as black and red, or of 0 and 128", "the brighter one is white")
@pytest.mark.parametrize("bright", [(255, 255, 255), (128, 128, 128), (200, 0, 0), (1, 1, 1)])
def test_the_brighter_colour_of_a_mask_is_white(bright: tuple[int, int, int], tmp_path: Path):
    photos = {f"{i}.png": photo for i, photo in enumerate(itertools.islice(draw_photos(), 3))}
    (tmp_path / "masks").mkdir()
    for i, (name, photo) in enumerate(photos.items()):
        photo.save(tmp_path / name)
        mask = Image.new("RGB", photo.size, bright)
        mask.paste((0, 0, 0), (0, 0, 40 + i, HEIGHT))
        mask.save(tmp_path / "masks" / name)
    found, masks, told = look_into(tmp_path, tmp_path / "out")
    assert found == [*photos]
    assert masks == {name: f"masks/{name}" for name in photos}
    assert not told
    read = read_photos(tmp_path, found, lambda *step: None)
    write_masks(tmp_path, masks, read, read, tmp_path / "written")
    for i, name in enumerate(photos):
        white = np.asarray(Image.open(tmp_path / "written" / f"{name}.png"))
        assert not white[:, : 40 + i].any()
        assert (white[:, 40 + i :] == 255).all()


@pytest.mark.hard_case("photos' masks in which black is 16, in 8 or 16 bits", "black is hidden")
@pytest.mark.parametrize(("kind", "unit"), [(np.uint8, 1), (np.uint16, 256)])
def test_a_mask_s_black_need_not_be_0(kind: type, unit: int, tmp_path: Path):
    values = np.full((HEIGHT, WIDTH), 235 * unit, kind)
    values[:, :40] = 16 * unit
    Image.fromarray(values).save(tmp_path / "mask.png")
    photo = Photo("a.png", (WIDTH, HEIGHT), (), False)
    for name, num_hiding in (("mask.png", 1), ("white.png", 0)):
        Image.new("L", photo.size, 255).save(tmp_path / "white.png")
        actual = write_masks(tmp_path, {"a.png": name}, [photo], [photo], tmp_path / name[:4])
        assert actual == num_hiding
    with Image.open(tmp_path / "mask/a.png.png") as mask:
        assert (np.asarray(mask) == np.where(values > 128 * unit, 255, 0)).all()


@pytest.mark.hard_case("photos with names of 248 bytes and more", "refused by name before any work")
def test_a_name_that_leaves_no_room_for_a_suffix_is_refused(tmp_path: Path, capsys):
    """A conversion and its mask have the suffixes .jpg.png more, and the file system ends at 255 bytes."""
    for length, name in ((247, "a" * 243 + ".png"), (248, "é" * 122 + ".png")):
        photos = tmp_path / str(length)
        black(photos, name, "b.png", "c.png")
        assert len(os.fsencode(name)) == length
        if length == 247:
            assert name in find_source(photos, tmp_path / "out")[0]
        else:
            status = main([str(photos), str(tmp_path / "out")])
            assert status == 2
            sentence = f"{photos} holds a photo with a name of more than 247 bytes, {name}: rename it, since its mask"
            errors = capsys.readouterr().err
            assert f"sadgs-process: {sentence} and its copies have longer names.\n" == errors
    assert not (tmp_path / "out").exists()


@pytest.mark.hard_case("a mask of a panorama", "is cut into masks of its views")
def test_a_mask_of_a_panorama_is_cut_as_it_is(tmp_path: Path):
    for name, height in (("pano.png", 0), ("mask.png", 64)):
        image = Image.new("L", (256, 128), 255)
        image.paste(0, (0, 128 - height, 256, 128))  # what is below the horizon
        image.save(tmp_path / name)
    panorama = Photo("pano.png", (256, 128), (), False, is_panorama=True)
    write_masks(tmp_path, {"pano.png": "mask.png"}, [panorama], panorama.views, tmp_path / "masks")
    white = [np.asarray(Image.open(tmp_path / "masks" / f"{view.name}.png")).mean() / 255 for view in panorama.views]
    assert min(white[:4]) > 0.6
    assert max(white[4:]) < 0.4
    assert len(white) == 8


@pytest.mark.hard_case("a mask of another shape than its photo", "refused: make it of the whole photo")
def test_a_mask_of_another_shape_is_refused(tmp_path: Path, taken: list[list[str]], capsys):
    photos = black(tmp_path / "photos", "a.png", "b.png", "c.png", "masks/b.png")
    with Image.open(photos / "masks/b.png") as mask:
        mask.resize((8, 6)).save(photos / "masks/b.png")
    status = main([str(photos), str(tmp_path / "out")])
    assert status == 2
    told = "masks/b.png has another shape than b.png, whose mask it is by its name: make it of the whole photo, or take"
    errors = capsys.readouterr().err
    assert told in errors
    (photos / "masks/b.png").unlink()
    status = main([str(photos), str(tmp_path / "out")])
    assert status == 130
    assert taken == [["a.png", "b.png", "c.png"]]


@pytest.mark.hard_case(
    "masks with soft edges, in black of 16 and white of 235, or as JPEG", "masks as others, and no photos"
)
def test_masks_of_any_greys_are_masks_if_a_photo_has_their_name(tmp_path: Path):
    hard = Image.new("L", (WIDTH, HEIGHT), 235)
    hard.paste(16, (40, 30, 120, 90))
    soft = hard.filter(ImageFilter.GaussianBlur(15))
    (tmp_path / "masks").mkdir()
    for name, view in zip(("a.jpg", "b.jpg", "c.jpg", "flask_mask.jpg"), draw_photos(), strict=False):
        view.save(tmp_path / name)
    soft.save(tmp_path / "masks/a.png")
    soft.convert("RGB").save(tmp_path / "masks/b.jpg")
    hard.filter(ImageFilter.GaussianBlur(1)).save(tmp_path / "c_mask.png")
    photos, masks, _ = look_into(tmp_path, tmp_path / "out")
    assert masks == {"a.jpg": "masks/a.png", "b.jpg": "masks/b.jpg", "c.jpg": "c_mask.png"}
    assert photos[-1] == "flask_mask.jpg", "a photo of something, which no other photo has the name of"
    soft.save(tmp_path / "masks/statue.png")
    assert "masks/statue.png" in look_into(tmp_path, tmp_path / "out")[0], "it may be a black and white photo"


@pytest.mark.hard_case("a mask with transparent parts", "refused: save it without transparency")
@pytest.mark.parametrize("mode", ["RGBA", "LA", "P"])
def test_a_mask_with_transparent_parts_is_refused(tmp_path: Path, mode: str, capsys):
    photos = black(tmp_path / "photos", "a.png", "b.png", "c.png")
    (photos / "masks").mkdir()
    with Image.open(photos / "b.png") as photo:
        mask = Image.new("RGBA", photo.size, "white")
    mask.putpixel((1, 1), (255, 255, 255, 0))
    mask.convert(mode).save(photos / "masks/b.png")
    status = main([str(photos), str(tmp_path / "out")])
    assert status == 2
    told = "masks/b.png is a mask whose white has transparent parts: save it without transparency, black where b.png is"
    assert told in capsys.readouterr().err


def test_a_mask_may_be_transparent_where_it_is_black(tmp_path: Path):
    mask = Image.new("RGBA", (32, 24), "white")
    mask.paste((0, 0, 0, 0), (0, 0, 16, 24))
    mask.save(tmp_path / "mask.png")
    photo = Photo("photo.png", (32, 24), (), False, is_panorama=False)
    write_masks(tmp_path, {"photo.png": "mask.png"}, [photo], [photo], tmp_path / "masks")
    with Image.open(tmp_path / "masks/photo.png.png") as written:
        assert np.asarray(written).mean() == 127.5


@pytest.mark.hard_case("photos whose names hold spaces or begin with #, on a CPU", "matched as others")
def test_names_that_colmap_would_not_read_in_a_list_are_matched_as_others_also_after_an_interruption(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """In a list of pairs it takes lines that begin with # for comments, and spaces to end names."""
    names = ["#1 2.png", "#3.png", "a 1.png", "b c/a 2.png"]
    database = tmp_path / "database.db"
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        noise = np.random.default_rng(0).integers(0, 255, (128, 128, 3), np.uint8)
        Image.fromarray(noise).resize((512, 512)).save(tmp_path / name)
    features.extract(tmp_path, [names], database)

    def names_in_database() -> list[str]:
        with pycolmap.Database.open(database) as opened:
            return sorted(image.name for image in opened.read_all_images())

    def stop(*_: object, **options: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(pycolmap, "match_image_pairs", stop)
        with pytest.raises(KeyboardInterrupt):
            match(names, database, "exhaustive", None)
    features.extract(tmp_path, [names], database)
    assert names_in_database() == names
    match(names, database, "exhaustive", None)
    assert names_in_database() == names
    with pycolmap.Database.open(database) as opened:
        assert opened.num_matched_image_pairs() == 6
        assert opened.num_verified_image_pairs() == 6


@pytest.mark.hard_case(
    "`--matching sequential` with photo 9 and photo 10",
    "in the order of their numbers",
)
def test_numbered_photos_are_neighbours_in_the_order_of_their_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(pycolmap, "match_image_pairs", lambda database, **options: None)
    names = [f"{i}.png" for i in sorted(range(13), key=str)]
    match(names, tmp_path / "db", "sequential", None)
    assert "9.png 10.png\n" in (tmp_path / "pairs.txt").read_text()


@pytest.mark.hard_case(
    "many photos, in any order and without a network", "each is matched with those that look most alike"
)
@pytest.mark.parametrize(
    ("asked", "photos", "is_video", "chosen"),
    [
        ("auto", EXHAUSTIVE_LIMIT, False, "exhaustive"),
        ("auto", EXHAUSTIVE_LIMIT + 1, False, "similar"),
        ("auto", EXHAUSTIVE_LIMIT + 1, True, "sequential"),
        ("exhaustive", 300, False, "exhaustive"),
        ("similar", 3, False, "similar"),
    ],
)
def test_pairs_of_photos_are_chosen_by_their_number(asked: Matching, photos: int, is_video: bool, chosen: str):
    assert choose_matching(asked, photos, is_video) == chosen


@pytest.mark.hard_case(
    "EXIF with a focal length or a GPS position of 0/0, and without one",
    "count as unknown: the photos are of one camera",
)
@pytest.mark.parametrize("focal", [IFDRational(0, 0), IFDRational(5, 0), IFDRational(0, 1), None])
def test_a_focal_length_that_is_no_number_is_none(focal: Any, tmp_path: Path):
    for i in range(3):
        exif = Image.Exif()
        exif[0x8769] = {} if focal is None else {0x920A: focal}
        unknown = IFDRational(0, 0)
        exif[0x8825] = {1: "N", 2: (48.0, unknown, 1.0), 3: "E", 4: (11.0, 0.0, 0.0), 6: 500.0 if i else unknown}
        Image.new("RGB", (8, 8)).save(tmp_path / f"{i}.jpg", exif=exif)
    names = [f"{i}.jpg" for i in range(3)]
    read = read_photos(tmp_path, names, lambda *step: None)
    assert photos_by_camera(read) == [names]


@pytest.mark.hard_case(
    "EXIF whose focal-plane resolution is 0/0 or huge, or whose focal length for 35 mm film is 0, 1 or 65,535",
    "COLMAP's NaN, or a focal length of .03 or 2,000 photos' widths, counts as unknown; a plausible one stays",
)
@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({0xA20E: IFDRational(0, 0), 0xA20F: IFDRational(0, 0), 0xA210: 2}, 1.2),
        ({0xA20E: IFDRational(2**32 - 1, 1), 0xA20F: IFDRational(2**32 - 1, 1), 0xA210: 2}, 1.2),
        ({0xA405: 0}, 1.2),
        ({0xA405: 1}, 1.2),
        ({0xA405: 65535}, 1.2),
        ({0xA405: 36}, 36 / 43.2666 * 1.25),
    ],
)
def test_a_focal_length_that_no_lens_has_is_unknown(tags: dict[int, Any], expected: float, tmp_path: Path):
    exif = Image.Exif()
    exif[0x8769] = {0x920A: IFDRational(24, 1)} | tags
    Image.new("RGB", (64, 48)).save(tmp_path / "0.jpg", exif=exif)
    features.extract(tmp_path, [["0.jpg"]], tmp_path / "database.db")
    with pycolmap.Database.open(tmp_path / "database.db") as opened:
        (camera,) = opened.read_all_cameras()
    assert camera.mean_focal_length() / 64 == pytest.approx(expected, rel=1e-3)
    assert camera.has_prior_focal_length == (expected != 1.2)


@pytest.mark.hard_case("a phone's photos with and without digital zoom, of one lens", "have a camera each")
@pytest.mark.parametrize("tags", [{0xA405: 52}, {0xA404: IFDRational(2, 1)}, {0xA405: 52, 0xA404: IFDRational(2, 1)}])
def test_digital_zoom_is_another_camera(tags: dict[int, Any], tmp_path: Path):
    for i in range(4):
        exif = Image.Exif()
        exif[0x8769] = {0x920A: IFDRational(42, 10), 0xA405: 26, 0xA404: IFDRational(1, 1)} | (tags if i > 1 else {})
        Image.new("RGB", (8, 8)).save(tmp_path / f"{i}.jpg", exif=exif)
    read = read_photos(tmp_path, [f"{i}.jpg" for i in range(4)], lambda *step: None)
    assert photos_by_camera(read) == [["0.jpg", "1.jpg"], ["2.jpg", "3.jpg"]]


@pytest.mark.hard_case("photos as TIFF in CMYK", "become RGB, which training reads")
def test_photos_in_cmyk_become_rgb(tmp_path: Path):
    next(draw_photos()).convert("CMYK").save(tmp_path / "a.tif")
    folder, _ = convert_photos(tmp_path, read_photos(tmp_path, ["a.tif"], lambda *step: None), tmp_path / "converted")
    with Image.open(folder / "a.tif") as image:
        assert image.mode == "RGB"


@pytest.mark.hard_case(
    "photos with a profile of other colours, as phones have (Display P3)", "become sRGB, as viewers show"
)
@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_photos_with_a_profile_of_other_colors_become_srgb(suffix: str, tmp_path: Path):
    srgb = color_profile(swapped=False)
    swapped = color_profile(swapped=True)
    profiles = {"srgb": srgb, "other": swapped, "grey": swapped, "damaged": b"none"}
    names = [f"{name}.{suffix}" for name in profiles]
    for name, content in zip(names, profiles.values(), strict=True):
        image = Image.new("RGB", (16, 16), (200, 40, 10)).convert("L" if name.startswith("grey") else "RGB")
        image.save(tmp_path / name, icc_profile=content)
    folder, _ = convert_photos(tmp_path, read_photos(tmp_path, names, lambda *step: None), tmp_path / "converted")
    actual = [(folder / name).is_symlink() for name in names]
    assert actual == [True, False, True, True]
    with Image.open(folder / names[1]) as image:
        assert np.abs(np.array(image)[8, 8].astype(int) - [40, 200, 10]).max() <= 6
        assert image.info.get("icc_profile") != swapped


HEIC = base64.b85decode(  # 64 × 48 px, the left half blue and the right one red, to be turned by EXIF's orientation 6
    "0000SW^{RQXk}?*00000ZE0pPXk}?*ZE0a<0005VZDn*}000000000XXk=`10000000000aA{+700000000000000000000G-+&a"
    "V*mgE07O6l0ssL300001>;M4(00000004FX0ssI200LqF0RR9100000HUIzsIB98aW&i*H00062000$fZf0cy000000RRAKc4ILB"
    "0000LX>Mj^0ssI300IC2MR;ju000004sdC7Z2$lO00031009SSaB^?}008D`aAR)(004Gqc4I>U18@KU0FVFx0000U@BsY%`1k+-"
    "4+CHT0RR|40Sp2E{{wIU00RJ!0009300RIXx&lC90096hLID8-Z~y=U0FVFx0{{R603M(qfd!W8<fgf}2xu@M00096AOHXZ03l)k"
    "0RRR>0l{;?i2wiq6Ju{|a&BX6cmM$a4FCp!0000KX>)L8000000000$0000$0000eV{Bn?0000$000010000m000010000000002"
    "|NsB+000020000GaA|mH000000|*ER00009X>xCL0{{R38EJ5BVE_OC000000RRC8fdT^sgoXeB02*m>Wo7^X0000001jhhb7KGk"
    "009620002AZDe6|0001TC;_hqIEgNNFZcsr_5azmfB*S*BAM#@Tu1-?oQ=)@V}vIEz)slsX9538)AVvY_sH_`Vx`7ho&ZGTx8Fij"
    "L)n*5{8*JZVDok(UpTRccRPbU8;W?op#_oUNM-6NAA!;v)4S9g+KhP??dzvO9KZko00u>PX=VTbO-%qQ0000800IFJ00IC200sa6"
    "044zv00RI30096700000002;EZ*FA("
)


@pytest.mark.hard_case("a phone's HEIC", "is read upright, and becomes JPEG")
def test_heic_is_read_as_a_phone_means_it(tmp_path: Path):
    (tmp_path / "IMG_1.HEIC").write_bytes(HEIC)
    names, masks, told = look_into(tmp_path, tmp_path / "out")
    assert names == ["IMG_1.HEIC"]
    assert not masks
    assert not told
    (photo,) = read_photos(tmp_path, names, lambda *step: None)
    assert photo.size == (48, 64)
    assert not photo.is_turned
    assert "Phone" in photo.camera
    folder, (converted,) = convert_photos(tmp_path, [photo], tmp_path / "converted")
    assert converted.name == "IMG_1.HEIC.jpg"
    with Image.open(folder / converted.name) as image:
        assert image.format == "JPEG"
        assert image.size == (48, 64)
        actual = image.getexif().get(0x112, 1)
        assert actual == 1
        for place, color in {(24, 10): (20, 60, 220), (24, 54): (200, 40, 10)}.items():
            assert np.abs(np.array(image)[place[::-1]].astype(int) - color).max() <= 8


@pytest.mark.hard_case("HEIC, without the library that reads it, as in an older environment", "a line counts the files")
def test_heic_is_left_out_without_its_library(tmp_path: Path):
    (tmp_path / "IMG_1.HEIC").write_bytes(HEIC)
    code = "import sys; sys.modules['pi_heif'] = None; from sadgs_ns.placing.folder import look_into as look; "
    code += "from pathlib import Path; print(look(Path(sys.argv[1]), Path('out')))"
    told = subprocess.run([sys.executable, "-c", code, tmp_path], capture_output=True, text=True, check=True).stdout
    assert told.startswith("([], {}, ['Left out as images that are not read ")
    assert "1, such as IMG_1.HEIC" in told


@pytest.mark.hard_case("COLMAP aborts", "one sentence with the stage and COLMAP's own words")
def test_an_abort_of_colmap_is_an_error_like_others(tmp_path: Path):
    """The folder of its database does not exist."""
    steps: list[str] = []
    model = tmp_path / "none/model"
    with pytest.raises(RunError, match=r"^COLMAP failed while it worked on features \(.+\); run the same com"):
        arguments = tmp_path, [["a.png"]], "exhaustive", 0, model, None, []
        with start_colmap() as colmap:
            make_model(colmap, *arguments, folder=tmp_path, report=lambda stage, *others: steps.append(stage))
    assert steps == ["features"]
    assert not list(tmp_path.iterdir())


@pytest.mark.hard_case(
    "the disk is full while features are found or matched",
    "one sentence names the folder and the free space; the same command resumes",
)
def test_a_full_disk_is_told_in_a_sentence_that_names_the_folder(photos: Path, tmp_path: Path, capsys):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, hard))  # of a file's bytes; COLMAP's process inherits it
    try:
        status = main([str(photos), str(tmp_path / "out")])
        assert status == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    printed = capsys.readouterr().err
    assert f"{tmp_path / 'out' / 'work'} could not be written while COLMAP worked on features (" in printed
    assert "free there): make room, and run the same command again to resume." in printed
    assert printed.count("\n") == 1


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Has COLMAP register so many of 12 photos at once, instead of running it; fields of the summary may follow."""

    def register(count: int, **fields: Any) -> None:
        def stand_in(colmap: Worker, *arguments: Any, folder: Path, report: object) -> dict[str, Any]:
            (folder / "model").mkdir()
            (folder / "database.db").write_bytes(b"features")
            return dataclasses.asdict(Summary(12, count, 100, 0.5, {}, arguments[2], **fields))

        monkeypatch.setattr("sadgs_ns.placing.place.make_model", stand_in)
        monkeypatch.setattr(place, "publish", lambda *others: None)

    return register


@pytest.mark.hard_case(
    "3 of 12 photos register", "a warning with what to do, exit code 1; the features stay for another way of matching"
)
def test_a_scene_of_few_of_the_photos_is_warned_of(
    tmp_path: Path, registered: Callable[[int], None], monkeypatch: pytest.MonkeyPatch, capsys: Any
):
    photos = black(tmp_path / "photos", "a.png", "b.png", "c.png")
    registered(3)
    status = main([str(photos), str(tmp_path / "out"), "--matching", "sequential"])
    assert status == 1
    printed = capsys.readouterr()
    assert "ns-train" not in printed.out
    assert "3 of 12 photos registered" in printed.out
    told = "out shows only what 3 of 12 photos saw. Try the same command with --matching exhaustive, which uses the "
    assert printed.err.startswith("warning: ")
    assert told in printed.err
    assert f"trains on what is there: ns-train sadgs --data {tmp_path / 'out'}\n" in printed.err
    actual = {path.name for path in (tmp_path / "out/work").iterdir()}
    assert actual == {"settings.json", "database.db", "alpha"}
    status = main([str(photos), str(tmp_path / "out"), "--matching", "exhaustive"])
    assert status == 1
    remedy = "photos saw. Try another folder with the photos in their original size, since these are "
    errors = capsys.readouterr().err
    assert remedy in errors, "photos of a few px"
    monkeypatch.setattr("sadgs_ns.placing.plan.SMALL_PHOTO", 8)
    status = main([str(photos), str(tmp_path / "out"), "--matching", "exhaustive"])
    assert status == 1
    errors = capsys.readouterr().err
    assert "photos saw. Try another folder with more photos between" in errors
    registered(6)
    status = main([str(photos), str(tmp_path / "out"), "--matching", "exhaustive"])
    assert status == 0
    printed = capsys.readouterr().out
    assert f"Train:  ns-train sadgs --data {tmp_path / 'out'}\n" in printed


def test_wrong_cameras_are_warned_of_and_their_scene_is_not_finished(
    tmp_path: Path, registered: Callable[..., None], capsys: pytest.CaptureFixture[str]
):
    photos = black(tmp_path / "photos", "a.png", "b.png", "c.png")
    command = [str(photos), str(tmp_path / "out"), "--matching", "sequential"]
    registered(12, faults=["they see too much: zoom in", "they are flat: move"], doubts=["there are few: take more"])
    assert main(command) == 1
    printed = capsys.readouterr()
    assert "12 of 12 photos registered" in printed.out
    assert "sadgs-doctor" not in printed.out
    assert "warning: the cameras may be wrong, because there are few: take more.\n" in printed.out
    told = "out are wrong, because they see too much: zoom in; and they are flat: move. Try the same command with "
    assert printed.err.startswith("warning: the cameras in ")
    assert told in printed.err
    assert f"trains on what is there: ns-train sadgs --data {tmp_path / 'out'}\n" in printed.err
    actual = {path.name for path in (tmp_path / "out/work").iterdir()}
    assert actual == {"settings.json", "database.db", "alpha"}
    registered(12, doubts=["there are few: take more"])
    assert main(command) == 0
    printed = capsys.readouterr()
    assert "may be wrong, because there are few: take more." in printed.out
    assert "sadgs-doctor" in printed.out


def test_the_library_tells_its_caller_and_prints_nothing(
    tmp_path: Path, registered: Callable[[int], None], capsys: pytest.CaptureFixture[str]
):
    photos = black(tmp_path / "photos", "a.png", "b.png", "c.png")
    (photos / "a.HEIC").write_bytes(b"a")
    options = PlacingOptions(photos, tmp_path / "out")
    steps = list[tuple[str, int, int]]()
    events = list[str]()

    def place_again() -> Placed:
        return place_photos(options, lambda *step: steps.append(step), lambda event, sentence: events.append(event))

    registered(9)
    placed = place_again()
    assert placed.summary.registered == 9
    assert placed.unused[0].endswith(": 1, such as a.HEIC.")
    assert steps == [("photos", i, 3) for i in (1, 2, 3)]
    assert events == []
    (tmp_path / "out/transforms.json").write_text("{}")
    assert place_again() == placed
    assert events == ["unchanged"]
    assert len(steps) == 3
    for wrong, told in (({"frames": 2}, "--frames must be at least 3"), ({"max_size": 63}, "--max-size must be at l")):
        with refusal(told):
            place_photos(dataclasses.replace(options, **wrong), print, print)
    printed = capsys.readouterr().out
    assert printed == ""


@pytest.mark.hard_case(
    "the disk is full while photos are undistorted", "one sentence; nothing of the scene is replaced"
)
def test_photos_that_colmap_could_not_write_are_told(tmp_path: Path):
    """COLMAP says nothing where the disk is full."""
    folder = black(tmp_path / "undistorted", "images/a.png", "images/b.png")
    write_json(folder / "transforms.json", {"frames": [{"file_path": f"images/{n}.png"} for n in "ab"]})
    (folder / "images/b.png").write_bytes((folder / "images/b.png").read_bytes()[:30])
    with pytest.raises(OSError, match=r"images could not be written \(the disk is full; .* free there"):
        publish(folder, tmp_path, grown=False)


@pytest.mark.hard_case("two runs in one folder at a time", "the second is refused")
def test_two_runs_do_not_disturb_each_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    command = [str(black(tmp_path / "photos", "a.png", "b.png", "c.png")), str(tmp_path / "out")]

    def run_another(colmap: Worker, *arguments: object, folder: Path, **others: object) -> None:
        (folder / "models").mkdir()
        assert main(command) == 2
        assert (folder / "models").is_dir()
        raise KeyboardInterrupt

    monkeypatch.setattr("sadgs_ns.placing.place.make_model", run_another)
    assert main(command) == 130
    assert not (tmp_path / "out" / "work/models").exists()
    errors = capsys.readouterr().err
    assert f"another sadgs-process works on {tmp_path / 'out'}; wait for it, or stop it." in errors


@pytest.mark.hard_case(
    "the disk is full while cameras are written",
    "the model is read again before it counts; one sentence; the same command resumes",
)
@pytest.mark.parametrize("name", ["points3D.bin", "images.bin"])
def test_a_model_that_colmap_could_not_write_is_told(run: Run, tmp_path: Path, name: str):
    """COLMAP says nothing here either."""
    model = pycolmap.Reconstruction(run.out / "sparse/0")
    model.write(tmp_path)
    check_written(tmp_path, model)
    written = (tmp_path / name).read_bytes()
    for kept in (500, -1):
        (tmp_path / name).write_bytes(written[:kept])
        with pytest.raises(OSError, match="not written completely"):
            check_written(tmp_path, model)


@pytest.mark.hard_case(
    "the disk is full or the folder read-only at the start", "one sentence; the same command resumes"
)
def test_a_folder_in_which_no_settings_could_be_noted_can_be_used(tmp_path: Path, taken: list[list[str]]):
    (tmp_path / "out/work").mkdir(parents=True)
    photos = black(tmp_path / "photos", "a.png", "b.png", "c.png")
    status = main([str(photos), str(tmp_path / "out")])
    assert status == 130
    assert len(taken) == 1


@pytest.mark.hard_case("a damaged `work/settings.json`", "one sentence names it: delete the folder and begin again")
@pytest.mark.parametrize("content", ['{"source": ', "[1, 2]", "null"])
def test_damaged_settings_are_told_in_a_sentence(content: str, tmp_path: Path, capsys):
    photos = black(tmp_path / "photos", "a.png", "b.png", "c.png")
    (tmp_path / "out/work").mkdir(parents=True)
    (tmp_path / "out" / "work/settings.json").write_text(content)
    status = main([str(photos), str(tmp_path / "out")])
    assert status == 2
    printed = capsys.readouterr().err
    assert "settings.json is damaged (" in printed
    assert printed.count("\n") == 1


def imported_by(statement: str) -> set[str]:
    """Names of the modules that a new process has imported after a statement."""
    code = f"import sys; {statement}; print(*sys.modules)"
    process = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return set(process.stdout.split())


@pytest.mark.hard_case(
    'Pillow writes a PNG after pycolmap was imported ("double free")',
    "does not happen: COLMAP's process alone imports pycolmap",
)
def test_the_command_starts_without_slow_or_harmful_imports():
    """pycolmap replaces Pillow's zlib, which crashes Pillow where it is loaded later and writes a PNG."""
    assert not {"pycolmap", "scipy", "torch"} & imported_by("from sadgs_ns.cli import process")


def test_features_are_found_while_torch_is_imported():
    assert "torch" not in imported_by("from sadgs_ns.placing import reconstruct")


def test_a_gpu_s_matches_are_verified_with_the_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The device is the CPU here, which goes the GPU's way."""
    calls: list[tuple] = []

    def noting(
        database: Path,
        pairs: list[tuple[str, str]],
        device: torch.device,
        stage: str,
        options: pycolmap.TwoViewGeometryOptions,
        *ahead: Any,
    ) -> None:
        calls.append((*pairs, device, options.ransac.random_seed))

    monkeypatch.setattr("sadgs_ns.placing.matching.write_matches", noting)
    device = torch.device("cpu")
    match(["a 1.png", "a 2.png"], tmp_path / "db", "exhaustive", device, seed=5)
    assert calls == [(("a 1.png", "a 2.png"), device, 5)]


@pytest.mark.hard_case(
    "photos without texture",
    "one sentence: no two photos could be related, and how many photos have few features",
)
def test_photos_without_texture_are_told_in_a_sentence(tmp_path: Path, capsys):
    (tmp_path / "photos").mkdir()
    for i in range(3):
        Image.new("RGB", (64, 64), (i, i, i)).save(tmp_path / "photos" / f"{i}.png")
    status = main([str(tmp_path / "photos"), str(tmp_path / "out")])
    assert status == 2
    errors = capsys.readouterr().err
    assert "no two photos could be related to each other (3 of 3 have fewer than 500" in errors
    assert not (tmp_path / "out/transforms.json").exists()


@pytest.mark.hard_case("an output folder that is the photos' folder", "refused in a sentence")
def test_other_folders_and_settings_are_left_alone(run: Run, photos: Path, tmp_path: Path, capsys):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/file").write_text("x")
    status = main([str(photos), str(tmp_path / "mine")])
    assert status == 2
    errors = capsys.readouterr().err
    assert "is not a scene that sadgs-process began" in errors
    status = main([str(photos), str(run.out), "--camera-per-photo"])
    assert status == 2
    errors = capsys.readouterr().err
    assert "was begun with other photos or settings" in errors


class Pipe:
    """What cannot go back, as a browser writes its recording, so that no length comes into its header."""

    def __init__(self) -> None:
        self.content = bytearray()

    def write(self, content: Any) -> int:
        self.content += content
        return len(content)


def record(path: Path, codec: str, kind: str, levels: Sequence[int], options: dict[str, str] | None = None) -> Path:
    """Write a video of 48 × 32 px with a frame of each of these levels of grey, red in the upper left."""
    pipe = Pipe()
    with av.open(pipe, "w", format=kind, options=options or {}) as container:
        stream: Any = container.add_stream(codec, rate=10)
        stream.width = 48
        stream.height = 32
        stream.pix_fmt = "yuv420p"
        for level in levels:
            pixels = np.full((32, 48, 3), level, np.uint8)
            pixels[:16, :24] = (200, 0, 0)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())
    path.write_bytes(pipe.content)
    return path


@pytest.mark.hard_case("WebM and MKV without a length in the header, as browsers record them", "frames are counted")
@pytest.mark.hard_case("AV1; fragmented MP4; MPEG-TS, as camcorders write it, also named without a suffix", "read")
@pytest.mark.parametrize(
    ("name", "codec", "kind", "options"),
    [
        ("live.webm", "libvpx", "webm", {}),
        ("live.mkv", "libx264", "matroska", {}),
        ("av1.mp4", "libsvtav1", "mp4", {"movflags": "frag_keyframe+empty_moov"}),
        ("live.mp4", "libx264", "mp4", {"movflags": "frag_keyframe+empty_moov"}),
        ("00001.MTS", "libx264", "mpegts", {}),
        ("film", "libx264", "mpegts", {}),
    ],
)
def test_a_film_gives_its_frames_whatever_its_header_says(name, codec, kind, options, tmp_path: Path):
    film = record(tmp_path / name, codec, kind, range(0, 240, 20), options)
    frames = list(video_frames(film, [], 6))
    actual = [name for name, _ in frames]
    assert actual == [f"{i:05d}.jpg" for i in range(6)]
    for i, (_, frame) in enumerate(frames):
        assert frame.shape == (32, 48, 3)
        assert min(abs(frame[24:, 24:].mean() - level) for level in (40 * i, 40 * i + 20)) < 6


@pytest.mark.hard_case("a phone's video held upright", "its frames are turned as a player turns them")
@pytest.mark.parametrize(("matrix", "corner"), [((0, 1, -1, 0), (0, 1)), ((-1, 0, 0, -1), (1, 1))])
def test_frames_are_turned_as_players_show_them(matrix: tuple[int, ...], corner: tuple[int, int], tmp_path: Path):
    film = record(tmp_path / "film.mp4", "libx264", "mp4", [90] * 3, {"movflags": "frag_keyframe+empty_moov"})

    def header(a: int, b: int, c: int, d: int) -> bytes:
        return struct.pack(">9i", a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)

    content = film.read_bytes()
    unturned = header(1, 0, 0, 1)
    start = content.index(unturned, content.index(b"tkhd"))
    film.write_bytes(content[:start] + header(*matrix) + content[start + len(unturned) :])
    (_, frame), *_ = video_frames(film, [], 3)
    height, width = (48, 32) if matrix[0] == 0 else (32, 48)
    assert frame.shape == (height, width, 3)
    redness = frame[:, :, 2].astype(int) - frame[:, :, 1]
    quarters = [redness[: height // 2], redness[height // 2 :]]
    red = [[half[:, : width // 2].mean(), half[:, width // 2 :].mean()] for half in quarters]
    actual = np.unravel_index(np.argmax(red), (2, 2))
    assert actual == corner


@pytest.mark.hard_case("interlaced videos, as camcorders record them", "frames have no edges like combs")
def test_frames_of_an_interlaced_film_are_no_combs(tmp_path: Path):
    with av.open(str(tmp_path / "film.mts"), "w", format="mpegts") as container:
        stream: Any = container.add_stream("libx264", rate=25, options={"x264opts": "interlaced=1:tff=1"})
        stream.width = 128
        stream.height = 64
        stream.pix_fmt = "yuv420p"
        for i in range(8):
            pixels = np.full((64, 128, 3), 40, np.uint8)
            pixels[::2, 10 * i : 10 * i + 40] = pixels[1::2, 10 * i + 5 : 10 * i + 45] = 220  # half a frame later
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())
    frames = [frame[:, :, 1].astype(int) for _, frame in video_frames(tmp_path / "film.mts", [], 4)]
    assert len(frames) == 4
    for frame in frames[1:-1]:  # The filter looks at both neighbours.
        assert np.abs(frame[1:-1] - (frame[:-2] + frame[2:]) / 2).mean() < 3


@pytest.mark.hard_case("HDR videos (HLG, PQ), as phones record them", "frames have the colours of sRGB, not pale ones")
@pytest.mark.parametrize(("transfer", "white"), [(18, 0.75), (16, 0.58)])  # HLG and PQ, and their signal for white
def test_frames_of_a_film_in_hdr_are_not_pale(transfer: int, white: float, tmp_path: Path):
    pixels = np.zeros((32, 48), np.uint16)
    pixels[:, 24:] = round(white * 65535)
    with av.open(str(tmp_path / "film.mp4"), "w") as container:
        stream: Any = container.add_stream("libx264", rate=10)
        stream.width = 48
        stream.height = 32
        stream.pix_fmt = "yuv420p10le"
        context = stream.codec_context
        context.color_primaries = context.colorspace = 9  # BT.2020
        context.color_trc = transfer
        context.color_range = 1
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="gray16le")))
        container.mux(stream.encode())
    frames = [frame for _, frame in video_frames(tmp_path / "film.mp4", [], 3)]
    assert len(frames) == 3
    for frame in frames:
        assert frame.shape == (32, 48, 3)
        assert frame[:, :20].max() < 12
        assert frame[:, 28:].min() > 240


@pytest.mark.hard_case(
    "a folder of videos, of which one is short; the same name with two suffixes",
    "each gives a share of the frames by its length and has a camera of its own; photos beside them are told of",
)
def test_a_folder_of_films_gives_frames_of_each(tmp_path: Path, taken: list[list[str]], capsys):
    folder = tmp_path / "films"
    black(folder, "still.png", "._a.webm/x.png")
    for name, length in (("a.mkv", 12), ("a.webm", 6), ("day/b.webm", 1)):
        (folder / name).parent.mkdir(exist_ok=True)
        record(folder / name, "libvpx", "matroska", range(0, 10 * length, 10))
    command = [str(folder), str(tmp_path / "out"), "--frames", "9"]
    assert main(command) == main(command) == 130
    assert taken[0] == taken[1]
    expected = (
        [f"a.mkv/{i:05d}.jpg" for i in range(5)] + ["a.webm/00000.jpg", "a.webm/00001.jpg"] + ["day/b.webm/00000.jpg"]
    )
    assert taken[0] == expected
    told = ["Its photos (1, such as still.png) are not used: fewer than 3."]
    assert find_source(folder, tmp_path / "out")[3] == told
    printed = capsys.readouterr().out
    assert "Frames of 3 videos are taken, each with a camera of its own" in printed
    record(folder / "c.webm", "libvpx", "webm", [0])
    assert main(command) == 2
    errors = capsys.readouterr().err
    assert "settings (videos added: 1, such as c.webm); give another folder or delete" in errors


@pytest.mark.hard_case("videos beside the photos of a folder, as iPhones keep them", "left out, and told of")
def test_films_beside_photos_are_told_of(tmp_path: Path, registered: Callable[[int], None], capsys):
    photos = black(tmp_path / "photos", "a.png", "b.png", "c.png")
    (photos / "a.MOV").write_bytes(b"a film")
    registered(9)
    status = main([str(photos), str(tmp_path / "out")])
    assert status == 0
    printed = capsys.readouterr().out
    assert "Its videos (1, such as a.MOV) are not used: give them in a folder of" in printed


@pytest.mark.hard_case(
    "photos beside another program's poses", "computed anew, after a line with the command for those"
)
def test_poses_of_other_programs_are_told_of(tmp_path: Path, registered: Callable[[int], None], capsys):
    photos = black(tmp_path / "photos", "a.png", "b.png", "c.png")
    (photos / "poses.csv").write_text("#name,x,y,alt\n")
    (photos / "others.csv").mkdir()
    registered(9)
    status = main([str(photos), str(tmp_path / "out")])
    assert status == 0
    printed = capsys.readouterr().out
    assert printed.startswith(f"Poses are computed anew. {photos}/poses.csv has poses: `ns-")


@pytest.mark.hard_case("a cut video, one of two frames, a photo as the video", "refused in a sentence")
def test_a_film_that_is_none_is_told_in_a_sentence(tmp_path: Path, capsys):
    (tmp_path / "film.mp4").write_bytes(b"no film")
    status = main([str(tmp_path / "film.mp4"), str(tmp_path / "out")])
    assert status == 2
    errors = capsys.readouterr().err
    assert "film.mp4 cannot be read as a video (Invalid data found" in errors
    film(tmp_path / "short.avi", 2)
    status = main([str(tmp_path / "short.avi"), str(tmp_path / "out")])
    assert status == 2
    errors = capsys.readouterr().err
    assert "short.avi gives 2 frames; a reconstruction needs at least 3" in errors
    assert not (tmp_path / "out").exists()


def film(path: Path, frames: int) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (32, 24))
    for i in range(frames):
        writer.write(np.full((24, 32, 3), 20 * i, np.uint8))
    writer.release()
    return path


def black(folder: Path, *names: str) -> Path:
    """A folder with these photos in it, which are nearly black, each of a colour of its own."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (8, 8), f"#{zlib.crc32(name.encode()) & 0x0F0F0F:06x}").save(folder / name)
    return folder


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The photos of every run, each of which is interrupted before it looks for features in them."""
    runs: list[list[str]] = []

    def stop(colmap: Worker, photos: Path, groups: list[list[str]], *others: object, **named: object) -> None:
        for name in itertools.chain(*groups):
            assert (photos / name).is_file()
        runs.append(sorted(itertools.chain(*groups)))
        raise KeyboardInterrupt

    monkeypatch.setattr("sadgs_ns.placing.place.make_model", stop)
    return runs


def test_a_film_whose_frames_were_being_written_goes_on(tmp_path: Path, monkeypatch, taken: list[list[str]]):
    command = [str(film(tmp_path / "film.avi", 6)), str(tmp_path / "out"), "--frames", "6"]

    def interrupted(video: Path, count: int, total: int):
        yield from itertools.islice(sharpest_frames(video, count, total), 4)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("sadgs_ns.placing.video.sharpest_frames", interrupted)
        assert main(command) == 130
        assert not list((tmp_path / "out").rglob("*.jpg"))
    assert main(command) == 130
    assert taken == [[f"{i:05d}.jpg" for i in range(6)]]
    monkeypatch.setattr(place, "video_frames", None)  # a third run reads none again
    assert main(command) == 130
    assert taken[0] == taken[1]


@pytest.mark.hard_case(
    "the disk is full while frames of a video are written", "one sentence names the frame; it is made again"
)
def test_a_frame_that_could_not_be_written_is_told_and_made_again(tmp_path: Path, monkeypatch, taken: list, capsys):
    command = [str(film(tmp_path / "film.avi", 6)), str(tmp_path / "out"), "--frames", "6"]

    def full(path: Path, content: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_bytes", full)
        assert main(command) == 1
    told = capsys.readouterr().err
    assert "00000.jpg could not be written (No space left on device; " in told
    assert told.count("\n") == 1
    assert main(command) == 130
    assert len(taken[0]) == 6


@pytest.mark.hard_case("a video that was replaced by another of its name", "refused, as a photo is")
def test_another_number_of_frames_or_another_film_is_another_scene(tmp_path: Path, taken: list[list[str]], capsys):
    command = [str(film(tmp_path / "film.avi", 8)), str(tmp_path / "out"), "--frames"]
    status = main([*command, "4"])
    assert status == 130
    assert len(taken[0]) == 4
    status = main([*command, "8"])
    assert status == 2
    assert len(taken) == 1
    printed = capsys.readouterr().err
    assert "with other photos or settings (--frames was 4, is 8); give another folder or delete it." in printed
    status = main([*command, "4"])
    assert status == 130
    assert taken[0] == taken[1]
    film(tmp_path / "film.avi", 9)
    status = main([*command, "4"])
    assert status == 2
    assert len(taken) == 2
    errors = capsys.readouterr().err
    assert "settings (videos changed: 1, such as film.avi); put these videos back, give" in errors


def test_photos_added_or_removed_while_it_is_not_finished_make_another_scene(
    tmp_path: Path, taken: list[list[str]], capsys
):
    photos = black(tmp_path / "photos", "a.png", "b.png", "c.png", "day/a.png")
    command = [str(photos), str(tmp_path / "out")]
    assert main(command) == main(command) == 130
    assert taken == [["a.png", "b.png", "c.png", "day/a.png"]] * 2
    (photos / "b.png").unlink()
    black(photos, "day/c.png", "day/b.png")
    capsys.readouterr()
    assert main(command) == 2
    assert len(taken) == 2
    changes = "photos added: 2, such as day/b.png; photos removed: 1, such as b.png"
    errors = capsys.readouterr().err
    assert f"settings ({changes}); put these photos back, give another folder or delete it." in errors
    other = black(tmp_path / "other", "a.png", "b.png", "c.png")
    status = main([str(other), str(tmp_path / "out")])
    assert status == 2
    errors = capsys.readouterr().err
    assert f"(source was {photos.resolve()}, is {other.resolve()})" in errors


LATER = [f"{i:02d}.png" for i in (0, 4, 9)]


@pytest.fixture(scope="module")
def seven(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for `grown`, and in `before` what it begins with: photos and their scene, without three of them."""
    folder = tmp_path_factory.mktemp("grown")
    source = folder / "now/photos"
    out = folder / "now/out"
    source.mkdir(parents=True)
    for path in photos.glob("[0-9]*.png"):
        if path.name not in LATER:
            shutil.copy2(path, source)
    process(Process(source, out, max_size=120))
    (folder / "now").rename(folder / "before")
    return folder


@pytest.fixture
def grown(photos: Path, seven: Path) -> Iterator[tuple[Path, Path, dict[str, Any]]]:
    """A folder of photos to which three were added, its scene of the others, and that scene's transforms.json."""
    now = seven / "now"
    shutil.copytree(seven / "before", now, symlinks=True)
    for name in LATER:
        shutil.copy2(photos / name, now / "photos")
    yield now / "photos", now / "out", read_json(now / "out/transforms.json")
    shutil.rmtree(now)


@pytest.mark.hard_case(
    "photos added to a finished scene",
    "their cameras are found, the others stay to the bit; it goes on after an interruption, and the scene "
    "stays as it was until then",
)
def test_added_photos_leave_the_cameras_that_are_there(grown: tuple[Path, Path, dict[str, Any]], capsys):
    source, out, before = grown
    before |= {"dataparser_scale": 2.0, "test_filenames": ["images/01.png"]}  # A run may have noted these.
    write_json(out / "transforms.json", before)
    model = out / "work/model"
    images = {path.name: path.stat() for path in (out / "images").iterdir()}
    old = pycolmap.Reconstruction(model)
    stages: list[str] = []

    def stop(stage: str) -> None:
        stages.append(stage)
        if stage == "cameras" and stages.count(stage) == 1:
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.MonkeyPatch.context() as patched:
        spy_on_stages(patched, stop)
        status = main([str(source), str(out), "--max-size", "120"])
        assert status == 143
        assert read_json(out / "transforms.json") == before
        assert model.is_dir()
        status = main([str(source), str(out), "--max-size", "120"])
        assert status == 0
    printed = capsys.readouterr().out
    assert "3 photos added to 7.\n" in printed
    assert f"{VIEWS} of {VIEWS} photos registered" in printed
    described = read_json(out / "transforms.json")
    frames = {frame["file_path"]: frame for frame in described["frames"]}
    assert len(frames) == VIEWS
    for frame in before["frames"]:
        assert frames[frame["file_path"]] == frame
    assert described | {"frames": before["frames"]} == before
    new = pycolmap.Reconstruction(out / "work/model-10")
    for identity, image in old.images.items():
        assert (new.images[identity].cam_from_world().matrix() == image.cam_from_world().matrix()).all()
        now = (out / "images" / image.name).stat()
        assert now.st_ino == images[image.name].st_ino
        assert now.st_mtime_ns == images[image.name].st_mtime_ns
    assert (new.cameras[1].params == old.cameras[1].params).all()
    assert len(new.cameras) == 1
    assert new.num_points3D() > old.num_points3D()
    assert errors_of_centres(out, camera_centres()).max() < 0.05
    actual = {path.name for path in (out / "work").iterdir()}
    assert actual == {"settings.json", "database.db", "model-10"}
    assert Scene(Process(source, out, max_size=120)).added == 0


@pytest.mark.hard_case("an added photo of another size", "has a camera of its own")
def test_an_added_photo_of_another_size_has_a_camera_of_its_own(grown: tuple[Path, Path, dict[str, Any]]):
    source, out, before = grown
    for name in ("00.png", "04.png"):
        (source / name).unlink()
    with Image.open(source / "09.png") as photo:
        photo.resize((120, 90)).save(source / "09.png")
    assert process(Process(source, out, max_size=120)).registered == 8
    described = read_json(out / "transforms.json")
    widths = {frame["file_path"]: frame["w"] for frame in described["frames"]}
    # Without distortion, an image can be a column narrower than its photo.
    assert "w" not in described
    assert widths.pop("images/09.png") in (119, 120)
    actual = set(widths.values())
    assert actual == {before["w"]}


@pytest.mark.hard_case(
    "added photos that match none of the others",
    "one sentence; the scene stays as it was, also when they are taken out again",
)
def test_added_photos_that_match_none_are_told_of_and_may_be_taken_out_again(
    grown: tuple[Path, Path, dict[str, Any]], photos: Path, capsys
):
    source, out, before = grown
    for name in ("00.png", "04.png", "09.png"):
        (source / name).unlink()
    shutil.copy2(photos / "fog.png", source)
    status = main([str(source), str(out), "--max-size", "120"])
    assert status == 2
    errors = capsys.readouterr().err
    assert "sadgs-process: none of the photos that were added could be related to the" in errors
    (source / "fog.png").unlink()
    status = main([str(source), str(out), "--max-size", "120"])
    assert status == 0
    printed = capsys.readouterr().out
    assert "7 of 7 photos registered" in printed
    assert read_json(out / "transforms.json") == before


@pytest.mark.hard_case(
    "photos of a finished scene changed or removed; the same bytes at another time",
    "refused, with their number and one name; the same bytes are no change",
)
def test_photos_are_added_only_where_the_others_are_as_they_were(grown: tuple[Path, Path, dict[str, Any]], capsys):
    source, out, before = grown
    (source / "05.png").touch()  # The same bytes at another time are no change.
    shutil.copy(source / "02.png", source / "01.png")
    (source / "06.png").unlink()
    command = [str(source), str(out), "--max-size", "120"]
    assert main(command) == 2
    told = "(photos changed: 1, such as 01.png; photos removed: 1, such as 06.png); put these photos back, give another"
    errors = capsys.readouterr().err
    assert told in errors
    assert read_json(out / "transforms.json") == before


@pytest.mark.hard_case(
    "a mask of a finished scene replaced by one of its name and size, added or removed; the same mask at another time",
    "refused, as a photo is; the same bytes are no change; photos may be added with their masks",
)
def test_other_masks_make_another_scene(tmp_path: Path, registered: Callable[[int], None], capsys):
    photos = black(tmp_path / "photos", "a.png", "b.png", "c.png", "masks/a.png")
    mask = photos / "masks/a.png"
    command = [str(photos), str(tmp_path / "out")]
    registered(9)
    assert main(command) == 0
    (tmp_path / "out/transforms.json").write_text("{}")
    (tmp_path / "out/masks").mkdir()
    content = mask.read_bytes()
    os.utime(mask, (0, 0))
    assert main(command) == 0
    mask.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    capsys.readouterr()
    assert main(command) == 2
    errors = capsys.readouterr().err
    assert "(photos or masks changed: 1, such as masks/a.png); put these photos or masks back, give another" in errors
    mask.rename(mask.with_name("b.png"))
    assert main(command) == 2
    changes = "photos or masks added: 1, such as masks/b.png; photos or masks removed: 1, such as masks/a.png"
    errors = capsys.readouterr().err
    assert f"({changes}); put these photos or masks back, give another" in errors
    mask.with_name("b.png").unlink()
    mask.write_bytes(content)
    black(photos, "d.png", "masks/d.png")
    assert Scene(Process(photos, tmp_path / "out")).added == 1


@pytest.mark.hard_case(
    "masks changed before the cameras are found, after features were", "refused, because features lie in the old masks"
)
def test_masks_of_an_unfinished_scene_stay(tmp_path: Path, taken: list[list[str]], capsys):
    photos = black(tmp_path / "photos", "a.png", "b.png", "c.png", "masks/a.png")
    command = [str(photos), str(tmp_path / "out")]
    assert main(command) == 130
    assert main(command) == 130
    capsys.readouterr()
    black(photos, "masks/b.png")
    assert main(command) == 2
    told = "(photos or masks added: 1, such as masks/b.png); give another folder or delete it."
    assert told in capsys.readouterr().err
    assert len(taken) == 2


@pytest.mark.hard_case(
    "an added photo's mask, in a scene without masks, is taken away again", "goes on: it was not used"
)
def test_a_mask_that_was_not_used_may_go(grown: tuple[Path, Path, dict[str, Any]], capsys):
    source, out, _ = grown
    mask = source / "09_mask.png"
    Image.new("L", (WIDTH, HEIGHT), 255).save(mask)
    command = [str(source), str(out), "--max-size", "120"]
    assert main(command) == 0
    assert "not used, because the scene has none" in capsys.readouterr().out
    assert main(command) == 0, "it may also stay"
    mask.unlink()
    assert main(command) == 0
    Image.new("L", (WIDTH, HEIGHT), 255).save(source / "01_mask.png")
    capsys.readouterr()
    assert main(command) == 2, "that of a photo whose cameras were found without it"
    assert "(photos or masks added: 1, such as 01_mask.png)" in capsys.readouterr().err


@pytest.mark.hard_case("photos put beside the videos of a scene", "refused: move them to a folder of their own")
def test_photos_beside_the_videos_of_a_scene_are_told(tmp_path: Path, taken: list[list[str]], capsys):
    source = tmp_path / "videos"
    source.mkdir()
    film(source / "film.avi", 6)
    command = [str(source), str(tmp_path / "out"), "--frames", "6"]
    assert main(command) == 130
    black(source, "a.png", "b.png", "c.png")
    assert main(command) == 2
    told = "was begun with videos, beside which there are photos now: move the photos to a folder of their own."
    assert told in capsys.readouterr().err


@pytest.mark.hard_case(
    "photos in several folders have equal names, and masks are for some", "each mask is that of the photo it names"
)
def test_masks_belong_to_the_photos_that_their_paths_name(tmp_path: Path):
    views = [photo.filter(ImageFilter.GaussianBlur(3)) for photo in itertools.islice(draw_photos(), 5)]
    names = ["IMG_1.jpg", "100CANON/IMG_1.JPG", "a.jpg", "a.png", "b/img5.jpg"]
    for name, view in zip(names, views, strict=True):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        view.rotate(90 * (name == "a.png")).save(tmp_path / name)
    expected = {
        "IMG_1.jpg": "masks/IMG_1.png",
        "100CANON/IMG_1.JPG": "masks/100CANON/IMG_1.jpg.png",
        "a.jpg": "masks/a.jpg.png",
        "a.png": "masks/a.png.png",
        "b/img5.jpg": "b/img5_mask.png",
    }
    for name in [*expected.values(), "masks/img5.png"]:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (WIDTH, HEIGHT), 255).save(tmp_path / name)
    photos, masks, told = look_into(tmp_path, tmp_path / "out")
    assert photos == sorted(names)
    assert masks == expected
    assert told == ["Left out as further masks of a photo: 1, such as masks/img5.png."]


@pytest.mark.hard_case(
    "photos added to a scene of whose `transforms.json` a photo was taken out", "they are added, and it stays out"
)
def test_a_photo_that_was_taken_out_stays_out_where_others_are_added(grown: tuple[Path, Path, dict[str, Any]]):
    source, out, before = grown
    gone = before["frames"].pop()["file_path"]
    write_json(out / "transforms.json", before)
    assert process(Process(source, out, max_size=120)).registered == VIEWS
    names = {frame["file_path"] for frame in read_json(out / "transforms.json")["frames"]}
    assert gone not in names
    assert len(names) == VIEWS - 1


@pytest.mark.hard_case(
    "photos added to a scene without its `database.db` or of an earlier version; another `--max-size` for a "
    "finished scene",
    "refused: give another folder",
)
def test_photos_cannot_be_added_to_a_scene_whose_features_are_not_there(
    grown: tuple[Path, Path, dict[str, Any]], capsys
):
    source, out, _ = grown
    (out / "work/database.db").unlink()
    status = main([str(source), str(out), "--max-size", "120"])
    assert status == 2
    errors = capsys.readouterr().err
    assert "no longer holds the features and the model that photos could be added to" in errors


def test_an_unreadable_photo_can_be_removed(tmp_path: Path, taken: list[list[str]]):
    photos = black(tmp_path / "photos", "a.png", "b.png", "c.png")
    (photos / "d.png").write_bytes(b"no image")
    command = [str(photos), str(tmp_path / "out")]
    assert main(command) == 2
    (photos / "d.png").unlink()
    assert main(command) == 130
    assert taken == [["a.png", "b.png", "c.png"]]


def test_a_scene_among_its_photos_is_none_of_them(tmp_path: Path, monkeypatch, taken: list[list[str]]):
    black(tmp_path, "a.png", "b.png", "scenery/c.png")
    monkeypatch.chdir(tmp_path)
    status = main([".", "scene"])
    assert status == 130
    black(tmp_path / "scene", "images/a.png", "work/undistorted/images/a.png")
    status = main([".", "scene"])
    assert status == 130
    assert taken == [["a.png", "b.png", "scenery/c.png"]] * 2


@pytest.mark.hard_case(
    "a folder of photos that also holds git repositories, results and runs", "their pictures are left out, and named"
)
def test_pictures_of_nested_repositories_and_results_are_no_photos(tmp_path: Path):
    own = ["a.png", "day 2/b.png", "day 2/c.png"]
    black(tmp_path, *own)
    black(tmp_path / "code/docs", "logo.png")
    (tmp_path / "code/.git").mkdir()
    black(tmp_path / "library", "icon.png")
    (tmp_path / "library/.git").write_text("gitdir: ../.git/modules/library")
    black(tmp_path / "room-splat/scene/images", "a.jpg")
    (tmp_path / "room-splat/log").mkdir()
    (tmp_path / "room-splat/settings.json").write_text("{}")
    black(tmp_path / "outputs/run/renders", "0.png")
    (tmp_path / "outputs/run/nerfstudio_models").mkdir()
    (tmp_path / ".git").mkdir()  # of the photos themselves
    for scene, number in ((tmp_path / "out", 4), (tmp_path / "room-splat/scene", 3)):
        photos, masks, others = look_into(tmp_path, scene)
        assert photos == sorted(own)
        assert not masks
        assert others == [f"Left out as repositories or results of other work: {number}, such as code."]
