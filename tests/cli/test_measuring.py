"""All photos are trained on, unless `--measure` holds some out and measures run and file on them."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest
import torch

from helpers.closeness import assert_within
from helpers.drawn_photos import draw_photos
from helpers.json_files import read_json, write_json
from helpers.random_gaussians import random_gaussians
from helpers.refusals import refusal
from sadgs_ns import formats
from sadgs_ns.cli.inspection import load_run
from sadgs_ns.cli.measuring import describe
from sadgs_ns.cli.sadgs import main
from sadgs_ns.cli.splat_file import draw, read_splat
from sadgs_ns.formats import ply
from sadgs_ns.render.rasterization import rasterize
from sadgs_ns.render.types import Cameras, Gaussians, RenderOptions

NUMBER = r"\d+\.\d+"


def test_the_sentences_have_means_and_the_worst_view_of_the_file():
    of_run = [{"psnr": 30.0, "ssim": 0.9, "lpips": 0.1}, {"psnr": 20.0, "ssim": 0.8, "lpips": 0.2}]
    of_file = [{"psnr": 18.0, "ssim": 0.7, "lpips": 0.3}, {"psnr": 20.0, "ssim": 0.8, "lpips": 0.4}]
    actual = describe(["a.jpg", "b.jpg"], of_run, of_file, "splat.ply")
    assert actual == [
        "run: PSNR 25.00, SSIM 0.8500, LPIPS 0.1500",
        "splat.ply: PSNR 19.00, SSIM 0.7500, LPIPS 0.3500",
        "2 views were held out; worst in splat.ply is a.jpg, PSNR 18.00",
    ]


def test_a_sentence_tells_that_lpips_is_missing():
    measures = [{"psnr": 30.0, "ssim": 0.9}]
    actual = describe(["a.jpg"], measures, measures, "splat.ply")
    assert actual == [
        "run: PSNR 30.00, SSIM 0.9000",
        "splat.ply: PSNR 30.00, SSIM 0.9000",
        "LPIPS is left out, because its AlexNet weights could not be loaded",
        "1 view was held out: a.jpg",
    ]


@pytest.mark.parametrize("bands", [0, 15])
def test_a_file_is_drawn_without_the_limits_of_a_run(bands: int, tmp_path: Path):
    """Its Gaussians are drawn in their colours, on a background, also those before a run's near plane."""
    stored = random_gaussians(40, bands)
    stored.means[:, 2] += 2.5  # From just before the camera on
    formats.write(tmp_path / "splat.ply", stored)
    cameras = Cameras(torch.eye(4)[None], torch.tensor([[[20.0, 0, 16], [0, 20, 12], [0, 0, 1]]]), 32, 24)
    values = {name: torch.from_numpy(value) for name, value in vars(stored).items()}
    harmonics = torch.cat([values["features_dc"][:, None], values["features_rest"]], dim=1)
    gaussians = Gaussians(
        values["means"], values["quats"], values["scales"].exp(), values["opacities"].sigmoid(), harmonics
    )
    options = RenderOptions(sh_degree=stored.degree, near_plane=0.01)
    colors, alphas, _ = rasterize(gaussians, cameras, options)
    background = torch.tensor([0.1, 0.2, 0.3])
    expected = (colors + (1 - alphas) * background).clamp(0, 1)
    colors, alphas = draw(read_splat(tmp_path / "splat.ply", torch.device("cpu")), cameras)
    drawn = (colors + (1 - alphas) * background).clamp(0, 1)
    assert_within(drawn, expected, 1e-5)
    assert (drawn - background).abs().max() > 0.1, "something is drawn"


def measures_of(printed: str) -> list[str]:
    """What the lines of the measures say, without their times."""
    return re.findall(r"^measures +\d+:\d\d  (.*)$", printed, re.MULTILINE)


def forget_measures(folder: Path, *others: str) -> None:
    """Take the measures, and other settings, out of the folder's settings."""
    file = folder / "settings.json"
    settings = read_json(file)
    for name in ("measured", *others):
        del settings[name]
    write_json(file, settings)


# nerfstudio opens the first photo to learn its size and does not close it.
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Exception ignored in. <_io.FileIO:pytest.PytestUnraisableExceptionWarning")
@pytest.mark.hard_case(
    "`sadgs --measure`", "every eighth photo is held out; lines say how well run and file show these"
)
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
    options = ["--formats", "spz", "--max-size", "120"]
    training = ["--", "--max-num-iterations", "10", "--pipeline.model.strategy.max-gaussians", "500"]
    command = [str(photos), "-o", str(out), *options]

    assert main([*command, "--measure", *training]) == 0
    described = read_json(out / "scene" / "transforms.json")
    assert described["test_filenames"] == [names[0], names[8]]
    first = measures_of(capsys.readouterr().out)
    for line, pattern in zip(
        first,
        (
            f"run: PSNR {NUMBER}, SSIM {NUMBER}",
            rf"splat\.ply: PSNR {NUMBER}, SSIM {NUMBER}",
            "LPIPS is left out, because its AlexNet weights could not be loaded",
            rf"2 views were held out; worst in splat\.ply is 0[08]\.png, PSNR {NUMBER}",
        ),
        strict=True,
    ):
        assert re.fullmatch(pattern, line), first
    pipeline, _ = load_run(out / "training" / "sadgs" / "run")
    assert len(pipeline.datamanager.train_dataset) == 8
    assert len(pipeline.datamanager.eval_dataset) == 2
    psnr = pipeline.get_average_eval_image_metrics()["psnr"]
    assert first[0].startswith(f"run: PSNR {psnr:.2f},"), "as ns-eval measures"

    assert main([*command, "--measure", *training]) == 0
    printed = capsys.readouterr().out
    assert measures_of(printed) == [*first[:3], f"{first[3]}; done before"]
    assert main([*command, *training]) == 2
    errors = capsys.readouterr().err
    assert "(--measure was given, is not given); give another --output or delete it." in errors

    gaussians = ply.read(out / "splat.ply")
    fainter = dataclasses.replace(gaussians, opacities=gaussians.opacities - 3)
    formats.write(out / "splat.ply", fainter)
    forget_measures(out, "--measure")
    assert main([*command, "--measure", *training]) == 0, "an earlier version began it, and held these out"
    again = measures_of(capsys.readouterr().out)
    assert again[0] == first[0], "the file is measured as it is"
    assert again[1] != first[1], "the file is measured as it is"
    assert main([*command, *training]) == 0
    assert not measures_of(capsys.readouterr().out)
    assert described == read_json(out / "scene" / "transforms.json")

    other = tmp_path / "other"
    status = main([str(photos), "-o", str(other), *options, *training])
    assert status == 0
    printed = capsys.readouterr().out
    assert not measures_of(printed)
    assert not (other / "splat.ply").exists()
    assert "ns-eval" not in (other / "log" / "training.txt").read_text("utf8"), "it would measure nothing"
    pipeline, _ = load_run(other / "training" / "sadgs" / "run")
    assert len(pipeline.datamanager.train_dataset) == 10
    assert len(pipeline.datamanager.eval_dataset) == 0
    with refusal(r"holds out no view, .* with `sadgs … --measure`"):
        pipeline.get_average_eval_image_metrics()
