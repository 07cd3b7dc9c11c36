"""All photos are trained on, unless `--measure` holds some out and measures run and file on them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from helpers.drawn_photos import draw_photos
from sadgs_ns.cli.added_photos import divide_views
from sadgs_ns.cli.inspection import load_run
from sadgs_ns.cli.measuring import describe
from sadgs_ns.cli.sadgs import main
from sadgs_ns.errors import InputError

VIEWS = [f"images/{i:02d}.png" for i in range(20)]


def test_all_views_are_trained_on_unless_they_shall_be_measured():
    divided = divide_views({}, VIEWS, measure=False)
    assert divided == {"train_filenames": VIEWS, "val_filenames": [], "test_filenames": []}
    panoramas = {"train_filenames": VIEWS[5:], "val_filenames": VIEWS[:5], "test_filenames": VIEWS[:5]}
    assert divide_views(panoramas, VIEWS, measure=False) == divided


def test_every_eighth_view_is_held_out_to_be_measured():
    divided = divide_views({}, VIEWS, measure=True)
    assert divided["val_filenames"] == divided["test_filenames"] == [VIEWS[0], VIEWS[8], VIEWS[16]]
    assert divided["train_filenames"] == [name for name in VIEWS if name not in divided["test_filenames"]]
    all_trained = divide_views({}, VIEWS, measure=False)
    assert divide_views(all_trained, VIEWS, measure=True) == divided, "nothing was trained yet"


def test_held_out_views_stay_so_when_photos_are_added():
    before = divide_views({}, VIEWS[:10], measure=True)
    after = divide_views(before, VIEWS, measure=True)
    assert after["test_filenames"] == [VIEWS[0], VIEWS[8], VIEWS[17]]
    assert len(after["train_filenames"]) == 17
    one_more = divide_views(before, VIEWS[:11], measure=True)
    assert one_more["test_filenames"] == before["test_filenames"]


def test_whole_panoramas_that_are_held_out_stay_so():
    described = {"train_filenames": VIEWS[8:], "val_filenames": VIEWS[:8], "test_filenames": VIEWS[:8]}
    assert divide_views(described, VIEWS, measure=True) == described


def test_the_sentence_names_the_worst_view_of_the_file_and_leaves_out_what_was_not_measured():
    of_run = [{"psnr": 30.0, "ssim": 0.9, "lpips": 0.1}, {"psnr": 20.0, "ssim": 0.8, "lpips": 0.2}]
    of_file = [{"psnr": 18.0, "ssim": 0.7}, {"psnr": 20.0, "ssim": 0.8}]
    assert describe(["a.jpg", "b.jpg"], of_run, of_file) == (
        "2 photos held out: run PSNR 25.00, SSIM 0.8500, LPIPS 0.1500; file PSNR 19.00, SSIM 0.7500; "
        "worst in the file a.jpg, PSNR 18.00"
    )


# nerfstudio opens the first photo to learn its size and does not close it.
@pytest.mark.filterwarnings("ignore:Exception ignored in. <_io.FileIO:pytest.PytestUnraisableExceptionWarning")
@pytest.mark.hard_case("`sadgs --measure`", "every eighth photo is held out; one line says how well they are shown")
def test_photos_are_held_out_and_measured_or_all_trained_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "no weights"))
    monkeypatch.setenv("HTTPS_PROXY", "http://127.0.0.1:9")  # LPIPS's weights cannot be had.
    photos = tmp_path / "photos"
    photos.mkdir()
    for i, photo in enumerate(draw_photos()):
        photo.save(photos / f"{i:02d}.png")
    names = sorted(f"images/{path.name}" for path in photos.iterdir())
    out = tmp_path / "out"
    options = ["--formats", "ply", "--max-size", "120"]
    training = ["--", "--max-num-iterations", "30", "--pipeline.model.strategy.max-gaussians", "1500"]
    command = [str(photos), "-o", str(out), *options]

    assert main([*command, "--measure", *training]) == 0
    described = json.loads((out / "scene" / "transforms.json").read_text())
    assert described["test_filenames"] == [names[0], names[8]]
    printed = capsys.readouterr().out
    number = r"\d+\.\d+"
    measures = f"PSNR {number}, SSIM {number}"
    sentence = f"2 photos held out: run {measures}; file {measures}; worst in the file 0[08].png, PSNR {number}"
    assert re.search(rf"^measures .*{sentence}$", printed, re.MULTILINE)
    pipeline, _ = load_run(out / "training" / "sadgs" / "run")
    assert len(pipeline.datamanager.train_dataset) == 8 and len(pipeline.datamanager.eval_dataset) == 2
    psnr = pipeline.get_average_eval_image_metrics()["psnr"]
    assert f"run PSNR {psnr:.2f}," in printed, "as ns-eval measures"

    assert main([*command, "--measure", *training]) == 0
    assert re.search(rf"^measures .*{sentence}; done before$", capsys.readouterr().out, re.MULTILINE)
    assert main([*command, *training]) == 2
    assert "(--measure was given, is not given); give another --output or delete it." in capsys.readouterr().err

    other = tmp_path / "other"
    assert main([str(photos), "-o", str(other), *options, *training]) == 0
    printed = capsys.readouterr().out
    assert "measures" not in printed and "ns-eval" not in printed
    pipeline, _ = load_run(other / "training" / "sadgs" / "run")
    assert len(pipeline.datamanager.train_dataset) == 10 and len(pipeline.datamanager.eval_dataset) == 0
    with pytest.raises(InputError, match=r"holds out no view, .* or with `sadgs … --measure`"):
        pipeline.get_average_eval_image_metrics()
