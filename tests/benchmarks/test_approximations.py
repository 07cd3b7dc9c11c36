"""The benchmark of the approximations: its references, its errors, and what it prints and writes."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks import approximations, eta_errors, tensor_errors
from benchmarks.approximations import TABLES, Workload, find_device, main, markdown, measure, read_image
from benchmarks.eta_errors import (
    INTERVALS,
    SAMPLES,
    Footprints,
    demo_training_set,
    exact_average,
    footprint_rows,
    interval_errors,
    observe_run,
    random_footprints,
    sampled_average,
    split_errors,
)
from benchmarks.tensor_errors import (
    TRUNCATIONS,
    ConvolutionPrecision,
    batch,
    map_errors,
    perturbations,
    relative_change,
    spread,
    structure_tensor_rows,
    timed,
)
from examples.drawn_scene.drawing import render
from examples.drawn_scene.scene import describe_scene
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor

CPU = torch.device("cpu")


def texture(height: int = 60, width: int = 80) -> Tensor:
    """A chirp over noise, float32 in [0, 1]. [1, height, width, 3]"""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    image = (0.5 + 0.3 * torch.sin(x * (0.4 + x / 150)) * torch.cos(y / 4))[..., None].repeat(1, 1, 3)
    noise = torch.rand(image.shape, generator=torch.Generator().manual_seed(0))
    return (image + 0.1 * noise).clamp(0, 1)[None]


@pytest.fixture(scope="module")
def tensor_rows() -> dict[str, dict[str, Any]]:
    return {row["variant"]: row for row in structure_tensor_rows(texture(), repeats=1)}


@pytest.fixture(scope="module")
def training() -> eta_errors.TrainingSet:
    scene = describe_scene(64, 48, 9, 150)
    return demo_training_set(scene, batch([render(scene.surfaces, view) for view in scene.views], CPU), CPU)


# Measuring


def test_time_is_the_median_after_a_first_call():
    calls = []

    def function() -> int:
        calls.append(None)
        return len(calls)

    result, ms = timed(function, CPU, repeats=3)
    assert result == 1 and len(calls) == 4 and ms >= 0


def test_time_on_a_cpu_is_the_processor_s():
    _, asleep = timed(lambda: time.sleep(0.05), CPU, repeats=1)
    _, awake = timed(lambda: sum(range(1_000_000)), CPU, repeats=1)
    assert asleep < 10 and awake > 1


def test_spread_are_numpy_s_percentiles():
    errors = torch.rand(10, 41, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = np.percentile(errors.numpy(), [50, 95, 100], method="nearest")
    np.testing.assert_allclose(list(spread(errors).values()), expected, atol=0.01)


def test_errors_are_those_that_were_planted():
    """Frequencies 10 % too high: Λ 1 − 1/1.1 too short, S̄ 21 % too large, and 3.15 px crosses the 3 px axis alone."""
    reference = torch.zeros(1, 4, 5, 3)
    reference[..., 0] = 1 / 3.15**2
    errors = map_errors(1.21 * reference, reference)
    assert errors["median"] == pytest.approx(1 - 1 / 1.1, rel=1e-3) == errors["max"]
    assert errors["change"] == pytest.approx(0.21, rel=1e-5)
    assert errors["flips"] == 1 / len(tensor_errors.AXIS_LENGTHS)
    assert set(map_errors(reference, reference).values()) == {0.0}


# S̄


def test_the_reference_has_no_error_against_itself(tensor_rows: dict[str, dict[str, Any]]):
    row = tensor_rows["reference: float64, kernels to 8σ"]
    assert [row[name] for name in ("change", "median", "p95", "max", "flips")] == [0.0] * 5


def test_errors_decrease_with_the_kernels_width(tensor_rows: dict[str, dict[str, Any]]):
    rows = [tensor_rows[f"float32, kernels to {truncation:g}σ"] for truncation in TRUNCATIONS]
    for name in ("median", "p95"):
        errors = [row[name] for row in rows[:-1]]  # from 5σ on float32 rounding is what is left
        assert errors == sorted(errors, reverse=True) and errors[0] > 100 * errors[-1]
    assert rows[-1]["max"] < 1e-5


def test_coarser_numbers_cost_accuracy(tensor_rows: dict[str, dict[str, Any]]):
    def median(variant: str) -> float:
        return tensor_rows[variant]["median"]

    precisions = [f"precision alone: {name}" for name in ("float32", "float16 convolutions", "bfloat16 convolutions")]
    storages = [f"storage alone: {name}" for name in ("float32", "float16", "8 bits")]
    for variants in (precisions, storages):
        assert median(variants[0]) < median(variants[1]) < median(variants[2]) < 0.02
    assert [tensor_rows[name]["bytes"] for name in storages] == [12, 6, 3]
    assert tensor_rows["precision alone: TF32 convolutions"]["median"] is None, "there is no TF32 on a CPU"


@pytest.mark.parametrize(
    ("planted", "variant"),
    [
        ({"truncation": 4.0}, "float32, kernels to 4σ"),
    ],
)
def test_a_wrong_variant_is_detected(
    planted: dict[str, Any], variant: str, tensor_rows: dict[str, dict[str, Any]], monkeypatch: pytest.MonkeyPatch
):
    """One variant computed with another c shows in its own row and in no other."""

    def wrong(images: Tensor, **options: Any) -> Tensor:
        factor = 1.1 if all(options.get(name) == value for name, value in planted.items()) else 1.0
        return factor**2 * multiscale_structure_tensor(images, **options)

    monkeypatch.setattr(tensor_errors, "multiscale_structure_tensor", wrong)
    rows = {row["variant"]: row for row in structure_tensor_rows(texture(), repeats=1)}
    assert rows[variant]["median"] > 0.08 > 10 * tensor_rows[variant]["median"]
    untouched = "float32, kernels to 5σ"
    assert rows[untouched]["median"] == tensor_rows[untouched]["median"]


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_convolutions_are_rounded_only_inside_the_context(dtype: torch.dtype):
    generator = torch.Generator().manual_seed(0)
    image, weight = torch.rand(1, 1, 8, 8, generator=generator), torch.rand(1, 1, 3, 3, generator=generator)
    plain = torch.conv2d(image, weight)
    with ConvolutionPrecision(dtype):
        rounded = torch.conv2d(image, weight)
        assert torch.equal(image * weight.sum(), torch.mul(image, weight.sum()))
    assert rounded.dtype == torch.float32 and torch.equal(rounded, rounded.to(dtype).float())
    assert 0 < (rounded / plain - 1).abs().max() < 2 * torch.finfo(dtype).eps
    assert torch.equal(torch.conv2d(image, weight), plain)


# η: samples


def test_exact_average_is_the_brute_force_mean_of_the_ellipse_s_pixels():
    tensors = multiscale_structure_tensor(texture(96, 120))
    axes = torch.tensor([[[7.0, 3.0], [-1.5, 3.5]], [[9.0, 0.0], [0.0, 4.0]]])
    means2d = torch.tensor([[60.0, 44.0], [3.0, 90.0]])  # the second hangs out of the image
    footprints = Footprints(torch.zeros(2, dtype=torch.long), means2d, axes)
    actual, seen = exact_average(tensors, footprints, points=20_000)
    y, x = torch.meshgrid(torch.arange(96) + 0.5, torch.arange(120) + 0.5, indexing="ij")
    for i in range(2):
        offset = torch.stack([x, y], -1) - means2d[i]
        inside = ((offset @ torch.linalg.inv(axes[i])) ** 2).sum(-1) <= 4
        assert inside.sum() > 100
        torch.testing.assert_close(actual[i], tensors[0][inside].mean(0), rtol=0.01, atol=2e-4)
    default, _ = exact_average(tensors, footprints)
    torch.testing.assert_close(default, actual, rtol=0.01, atol=2e-4)
    assert seen.all()
    outside = Footprints(footprints.image_ids, means2d + 500, axes)
    assert not exact_average(tensors, outside)[1].any()


def test_many_samples_become_the_exact_average():
    tensors = multiscale_structure_tensor(texture())
    footprints = random_footprints(50, tensors)
    exact, seen = exact_average(tensors, footprints)
    generator = torch.Generator().manual_seed(0)
    sampled, _ = sampled_average(tensors, footprints, footprints.conics, 2000, generator)
    assert relative_change(sampled[seen], exact[seen]) < 0.01


def test_errors_decrease_with_samples():
    tensors = multiscale_structure_tensor(texture())
    rows = list(footprint_rows(tensors, random_footprints(4000, tensors), repeats=1))
    assert len(rows) == 1 + len(SAMPLES)
    assert [rows[0][name] for name in ("median", "p95", "max", "flips")] == [0.0] * 4
    for name in ("median", "p95", "flips"):
        errors = [row[name] for row in rows[1:]]
        assert errors == sorted(errors, reverse=True) and errors[0] > 2 * errors[-1]


def test_samples_that_do_not_spread_are_detected(monkeypatch: pytest.MonkeyPatch):
    """If every sample fell on the centre, more of them would not help."""
    tensors = multiscale_structure_tensor(texture())
    footprints = random_footprints(400, tensors)
    right = list(footprint_rows(tensors, footprints, repeats=1))[-1]
    monkeypatch.setattr(eta_errors, "sample_footprint", lambda means2d, conics, jitter: means2d)
    wrong = list(footprint_rows(tensors, footprints, repeats=1))[-1]
    assert wrong["p95"] > 2 * right["p95"]


# η: intervals


def test_an_interval_sees_its_share_of_the_same_observations(training: eta_errors.TrainingSet):
    totals = observe_run(training, 40, (1, 2, 40), seed=0)
    assert (totals[1]["n_total"] >= totals[2]["n_total"]).all()
    assert (totals[1]["eta_max"] >= totals[2]["eta_max"]).all() and (totals[1]["n_high"] >= totals[2]["n_high"]).all()
    assert 0.4 < float(totals[2]["n_total"].sum() / totals[1]["n_total"].sum()) < 0.6
    assert totals[40]["n_total"].max() == 1, "only the first iteration"
    again = observe_run(training, 40, (1,), seed=0)[1]
    assert all(torch.equal(again[name], totals[1][name]) for name in again)


def test_rare_observations_cost_accuracy(training: eta_errors.TrainingSet):
    every_kth, chance = interval_errors(training, 200)
    rows = list(every_kth.values())
    assert list(every_kth) == list(INTERVALS) and set(rows[0].values()) == {0.0}
    errors = [row["mean"] for row in rows]
    assert 0 < chance["mean"] < errors[-1]
    assert errors == sorted(errors) and errors[-1] > 2 * errors[1] > 0
    assert rows[-1]["splits"] > rows[1]["splits"] > 0, "the scene must have Gaussians near the threshold"


def test_wrong_decisions_are_counted():
    reference = {
        "n_high": torch.tensor([[10.0, 0, 0], [10, 10, 10], [0, 0, 0], [9, 9, 9]]),
        "n_total": torch.tensor([10.0, 10, 10, 0]),  # the last was never observed and counts nowhere
        "eta_max": torch.tensor([[4.0, 0.5, 0.5], [9, 9, 9], [0.5, 0.5, 0.5], [9, 9, 9]]),
    }
    wrong = {**reference, "n_high": torch.zeros(4, 3)}
    errors = split_errors(wrong, reference)
    assert errors["mean"] == pytest.approx(4 / 9) and errors["flips"] == pytest.approx(4 / 9)
    assert errors["splits"] == pytest.approx(2 / 3)
    assert errors["growth"] == pytest.approx(3 / (2 + 27 + 1) - 1)


# Robustness


def test_perturbations_do_what_they_say():
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    maps: dict[str, Callable[[Any], Any]] = {name: function for name, (function, _) in perturbations().items()}
    np.testing.assert_array_equal(maps["exposure ×0.5"](image), image / 2)
    assert maps["exposure ×1.5, not clipped"](image).max() > 255
    assert maps["exposure ×1.5, clipped to 8 bits"](image).max() == 255
    noise = maps["Gaussian noise of one grey level"](image) - image
    assert abs(noise.std() - 1) < 0.05 and abs(noise.mean()) < 0.1
    smooth = np.full((20, 30, 3), 90, np.uint8)
    smooth[:, 15:] = 110
    for name, step in (("sharpened ×1.5", 1.5), ("sharpened ×3", 3.0)):
        # Beside an edge the 3×3 blur takes 3/13 of the step away; sharpening by f adds (f − 1) times that.
        overshoot = 110 + (step - 1) * 20 * 3 / 13
        assert abs(int(maps[name](smooth)[10, 15, 0]) - overshoot) <= 2
        assert maps[name](smooth)[10, 5, 0] == 90
    jpeg = maps["JPEG, quality 80"](smooth)
    assert jpeg.shape == smooth.shape and jpeg.dtype == np.uint8
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 0] = 200
    assert abs(maps["JPEG, quality 80"](red).astype(int) - red).max() < 10, "channels must not be swapped"


# The command


def test_every_row_is_printed_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(approximations, "Workload", partial(Workload, views=9, iterations=40))
    image, output = tmp_path / "photo.png", tmp_path / "folder" / "rows.jsonl"
    cv2.imwrite(str(image), (255 * texture()[0]).byte().numpy())
    arguments = ["--image", str(image), "--longest-side", "48", "--gaussians", "60", "--repeats", "1"]
    assert main([*arguments, "--output", str(output)]) == 0
    printed = capsys.readouterr().out
    rows = [json.loads(line) for line in output.read_text().splitlines()]
    counts = {name: sum(row["table"] == name for row in rows) for name in TABLES}
    assert counts == {
        "structure_tensor": 1 + len(TRUNCATIONS) + 1 + 4 + 3,
        "footprint": 1 + len(SAMPLES),
        "interval": len(INTERVALS) + 1,
        "robustness": 8,
    }
    assert len({row["key"] for row in rows}) == len(rows)
    for row in rows:
        assert f"| {row['variant']} |" in printed and row["input"] == "photo.png"
        assert TABLES[row["table"]].columns.keys() <= row.keys()
        assert all(math.isfinite(value) for value in row.values() if isinstance(value, float))
    assert sum(line.startswith("### ") for line in printed.splitlines()) == len(TABLES)


def test_the_demo_stands_in_for_a_photo():
    first = next(measure(CPU, None, Workload(repeats=1, longest_side=32, gaussians=10, views=9, analysed_views=1)))
    assert len(first) == 15 and first[1]["median"] > 0


def test_markdown_shows_what_is_missing():
    numbers = {"median": 0.0123, "p95": 12.0, "max": 0.0, "flips": None, "ms": 5}
    row = {"table": "footprint", "variant": "1 sample", **numbers}
    assert markdown([row]).splitlines()[-1] == "| 1 sample | 1.2 % | 1,200 % | 0 % | – | 5 |"


def test_a_larger_photo_is_reduced(tmp_path: Path):
    path = tmp_path / "red.png"
    cv2.imwrite(str(path), np.tile(np.array([0, 0, 200], np.uint8), (30, 60, 1)))  # BGR
    assert read_image(path, 1600).shape == (30, 60, 3)
    reduced = read_image(path, 20)
    assert reduced.shape == (10, 20, 3) and (reduced == [200, 0, 0]).all()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--image", "missing.png"], "--image missing.png cannot be read as an image; give a JPEG or PNG file."),
        (["--image", "broken.png"], "--image broken.png cannot be read as an image; give a JPEG or PNG file."),
        (["--image", "empty.png"], "--image empty.png cannot be read as an image; give a JPEG or PNG file."),
        (["--device", "gpu"], "--device 'gpu' cannot be used ("),
        (["--device", "meta"], "--device 'meta' cannot be used (only cpu and cuda compute in float64); give cpu,"),
        (["--device", "cuda:99"], "--device 'cuda:99' cannot be used ("),
        (["--repeats", "0"], "--repeats is 0; give at least 1."),
        (["--longest-side", "3"], "--longest-side is 3; give at least 32."),
        (["--output", "folder"], "--output folder is a folder; name a file."),
    ],
)
def test_wrong_input_gets_one_sentence(
    arguments: list[str],
    sentence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(approximations, "measure", partial(pytest.fail, "nothing may be measured"))
    (tmp_path / "broken.png").write_bytes(b"no image")
    (tmp_path / "empty.png").touch()
    (tmp_path / "folder").mkdir()
    assert main([*arguments, "--output", "rows.jsonl"] if "--output" not in arguments else arguments) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith(f"python -m benchmarks kernels: {sentence}") and printed.err.count("\n") == 1
    assert printed.out == "" and not (tmp_path / "rows.jsonl").exists()


def test_the_cpu_is_found():
    assert find_device("cpu") == CPU
