"""The benchmark of the approximations: its references, its errors, and what it prints and writes."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks import __main__ as bench
from benchmarks import approximations
from benchmarks.approximations import (
    AXIS_LENGTHS,
    SAMPLES,
    Footprints,
    average,
    footprint_rows,
    map_errors,
    quadrature,
    random_footprints,
    read_photo,
    spread,
    structure_tensor_rows,
    timed,
)
from benchmarks.table import APPROXIMATIONS, of_approximations
from sadgs_ns.method.eta import sample_footprint
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor


def texture(height: int = 60, width: int = 80) -> Tensor:
    """A chirp over noise, float32 in [0, 1]. [1, height, width, 3]"""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    image = (0.5 + 0.3 * torch.sin(x * (0.4 + x / 150)) * torch.cos(y / 4))[..., None].repeat(1, 1, 3)
    noise = torch.rand(image.shape, generator=torch.Generator().manual_seed(0))
    return (image + 0.1 * noise).clamp(0, 1)[None]


@pytest.fixture(scope="module")
def tensor_rows() -> dict[str, dict[str, Any]]:
    return {row["variant"]: row for row in structure_tensor_rows(texture(), repeats=1)}


# Measuring


def test_time_is_the_median_after_a_first_call():
    calls = []

    def function() -> int:
        calls.append(None)
        return len(calls)

    result, ms = timed(function, repeats=3)
    assert result == 1
    assert len(calls) == 4
    assert ms >= 0


def test_time_on_a_cpu_is_the_processor_s():
    _, asleep = timed(lambda: time.sleep(0.05), repeats=1)
    _, awake = timed(lambda: sum(range(1_000_000)), repeats=1)
    assert asleep < 10
    assert awake > 1


def test_spread_are_numpy_s_percentiles():
    errors = torch.rand(10, 41, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = np.percentile(errors.numpy(), [50, 95, 100], method="nearest")
    actual = list(spread(errors).values())
    np.testing.assert_allclose(actual, expected, atol=0.01)


def test_errors_are_those_that_were_planted():
    """Frequencies 10 % too high: Λ 1 − 1/1.1 too short, S̄ 21 % too large, and 3.15 px crosses the 3 px axis alone."""
    reference = torch.zeros(1, 4, 5, 3)
    reference[..., 0] = 1 / 3.15**2
    errors = map_errors(1.21 * reference, reference)
    assert errors["median"] == pytest.approx(1 - 1 / 1.1, rel=1e-3) == errors["max"]
    assert errors["flips"] == 1 / len(AXIS_LENGTHS)
    assert set(map_errors(reference, reference).values()) == {0.0}


# S̄


def test_the_reference_has_no_error_against_itself(tensor_rows: dict[str, dict[str, Any]]):
    row = tensor_rows["reference: float64"]
    actual = [row[name] for name in ("median", "p95", "max", "flips")]
    assert actual == [0.0] * 4


def test_coarser_numbers_cost_accuracy(tensor_rows: dict[str, dict[str, Any]]):
    names = ["precision alone: float32", "storage alone: float16", "storage alone: 8 bits"]
    medians = [tensor_rows[name]["median"] for name in names]
    assert 0 < medians[0] < medians[1] < medians[2] < 0.02
    assert [tensor_rows[name]["bytes"] for name in names] == [12, 6, 3]


def test_a_wrong_variant_is_detected(tensor_rows: dict[str, dict[str, Any]], monkeypatch: pytest.MonkeyPatch):
    """One variant computed with another c shows in its own row and in no other."""

    def wrong(images: Tensor) -> Tensor:
        factor = 1.1 if images.dtype == torch.float32 else 1.0
        return factor**2 * multiscale_structure_tensor(images)

    monkeypatch.setattr(approximations, "multiscale_structure_tensor", wrong)
    rows = {row["variant"]: row for row in structure_tensor_rows(texture(), repeats=1)}
    variant = "precision alone: float32"
    untouched = "storage alone: 8 bits"
    assert rows[variant]["median"] > 0.08 > 10 * tensor_rows[variant]["median"]
    assert rows[untouched]["median"] == tensor_rows[untouched]["median"]


# η: samples


def test_exact_average_is_the_brute_force_mean_of_the_ellipse_s_pixels(monkeypatch: pytest.MonkeyPatch):
    tensors = multiscale_structure_tensor(texture(96, 120))
    axes = torch.tensor([[[7.0, 3.0], [-1.5, 3.5]], [[9.0, 0.0], [0.0, 4.0]]])
    means2d = torch.tensor([[60.0, 44.0], [3.0, 90.0]])  # the second hangs out of the image
    footprints = Footprints(torch.zeros(2, dtype=torch.long), means2d, axes)
    monkeypatch.setattr(approximations, "QUADRATURE_POINTS", 20_000)
    actual, seen = average(tensors, footprints, quadrature(footprints))
    monkeypatch.undo()
    y, x = torch.meshgrid(torch.arange(96) + 0.5, torch.arange(120) + 0.5, indexing="ij")
    for i in range(2):
        offset = torch.stack([x, y], -1) - means2d[i]
        inside = ((offset @ torch.linalg.inv(axes[i])) ** 2).sum(-1) <= 4
        assert inside.sum() > 100
        expected = tensors[0][inside].mean(0)
        torch.testing.assert_close(actual[i], expected, rtol=0.01, atol=2e-4)
    default, _ = average(tensors, footprints, quadrature(footprints))
    torch.testing.assert_close(default, actual, rtol=0.01, atol=2e-4)
    assert seen.all()
    outside = Footprints(footprints.image_ids, means2d + 500, axes)
    assert not average(tensors, outside, quadrature(outside))[1].any()


def test_many_samples_become_the_exact_average():
    tensors = multiscale_structure_tensor(texture())
    footprints = random_footprints(50, tensors)
    exact, seen = average(tensors, footprints, quadrature(footprints))
    generator = torch.Generator().manual_seed(0)
    means2d = footprints.means2d
    jitters = (torch.rand(means2d.shape, generator=generator) for _ in range(2000))
    samples = (sample_footprint(means2d, footprints.conics, jitter) for jitter in jitters)
    sampled, _ = average(tensors, footprints, samples)
    assert (sampled[seen] - exact[seen]).norm(dim=-1).mean() < 0.01 * exact[seen].norm(dim=-1).mean()


def test_errors_decrease_with_samples():
    tensors = multiscale_structure_tensor(texture())
    rows = list(footprint_rows(tensors, random_footprints(4000, tensors), repeats=1))
    assert len(rows) == 1 + len(SAMPLES)
    actual = [rows[0][name] for name in ("median", "p95", "max", "flips")]
    assert actual == [0.0] * 4
    for name in ("median", "p95", "flips"):
        errors = [row[name] for row in rows[1:]]
        assert errors == sorted(errors, reverse=True)
        assert errors[0] > 2 * errors[-1]


def test_samples_that_do_not_spread_are_detected(monkeypatch: pytest.MonkeyPatch):
    """If every sample fell on the centre, more of them would not help."""
    tensors = multiscale_structure_tensor(texture())
    footprints = random_footprints(400, tensors)
    right = list(footprint_rows(tensors, footprints, repeats=1))[-1]
    monkeypatch.setattr(approximations, "sample_footprint", lambda means2d, conics, jitter: means2d)
    wrong = list(footprint_rows(tensors, footprints, repeats=1))[-1]
    assert wrong["p95"] > 2 * right["p95"]


# The command


def test_every_row_is_printed_and_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    image = tmp_path / "photo.png"
    output = tmp_path / "folder" / "rows.jsonl"
    cv2.imwrite(str(image), (255 * texture()[0]).byte().numpy())
    monkeypatch.setattr(approximations, "FOOTPRINTS", 60)
    arguments = ["approximations", "--image", str(image), "--repeats", "1"]
    assert bench.main([*arguments, "--output", str(output)]) == 0
    printed = capsys.readouterr().out
    rows = [json.loads(line) for line in output.read_text().splitlines()]
    counts = {name: sum(row["table"] == name for row in rows) for name in ("structure_tensor", "footprint")}
    assert counts == {"structure_tensor": 5, "footprint": 1 + len(SAMPLES)}
    assert len({row["key"] for row in rows}) == len(rows) == sum(counts.values())
    for row in rows:
        assert f"| {row['variant']} |" in printed
        assert row["input"] == "photo.png"
        assert APPROXIMATIONS[row["table"]].keys() <= row.keys()
        assert all(math.isfinite(value) for value in row.values() if isinstance(value, float))


def test_what_is_missing_is_a_dash():
    numbers = {"median": 0.0123, "p95": 12.0, "max": 0.0, "flips": None, "ms": 5}
    row = {"table": "footprint", "variant": "1 sample", **numbers}
    assert of_approximations([row]).splitlines()[-1] == "| 1 sample | 1.2 % | 1,200 % | 0 % | – | 5 |"


def test_a_larger_photo_is_reduced(tmp_path: Path):
    path = tmp_path / "red.png"
    cv2.imwrite(str(path), np.tile(np.array([0, 0, 200], np.uint8), (30, 3200, 1)))  # BGR
    reduced = read_photo(path)
    assert reduced.shape == (1, 15, 1600, 3)
    assert bool((255 * reduced == torch.tensor([200, 0, 0])).all())


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--image", "missing.png"], "--image missing.png cannot be read as an image; give a JPEG or PNG file."),
        (["--image", "broken.png"], "--image broken.png cannot be read as an image; give a JPEG or PNG file."),
        (["--image", "empty.png"], "--image empty.png cannot be read as an image; give a JPEG or PNG file."),
        (["--image", "missing.png", "--repeats", "0"], "--repeats is 0; give at least 1."),
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
    (tmp_path / "broken.png").write_bytes(b"no image")
    (tmp_path / "empty.png").touch()
    assert bench.main(["approximations", *arguments, "--output", "rows.jsonl"]) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith(f"python -m benchmarks approximations: {sentence}")
    assert printed.err.count("\n") == 1
    assert printed.out == ""
    assert not (tmp_path / "rows.jsonl").exists()
