"""The table and the plots of a results file, from made-up results."""

from __future__ import annotations

import itertools
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.text import Annotation
from PIL import Image

from benchmarks import __main__ as bench
from benchmarks import plots, table


def result(scene: str = "fox", label: str = "ours", seed: int = 0, **changes: Any) -> dict[str, Any]:
    return {
        "key": f"{scene}/{label}/{seed}", "scene": scene, "label": label, "method": "sadgs", "seed": seed,
        "overrides": {"max_num_iterations": 3000}, "status": "ok", "error": None, "date": "2026-11-21T05:17:12+00:00",
        "versions": {"torch": "2.11.0", "commit": "0123456789abcdef"}, "iterations": 3000, "gpu": "NVIDIA H200",
        "loop_seconds": 20.0 + seed, "import_seconds": 12.0, "setup_seconds": 0.5, "load_seconds": 0.4,
        "psnr": 30.0 + seed, "ssim": 0.9, "lpips": 0.1, "gaussians": 400_000, "peak_gb": 2.0, "jobs_per_gpu": 1,
        **changes,
    }  # fmt: skip


def write_lines(path: Path, rows: list[dict[str, Any]]) -> str:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return str(path)


def test_the_command_prints_the_table_and_draws_a_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    curve = [{"step": s, "seconds": s / 150, "psnr": 20 + s / 300, "ssim": 0.8, "lpips": None} for s in (0, 1500, 3000)]
    rows = [
        result(label="a", curve=curve), result(label="a", seed=1, curve=curve), result(label="b", loop_seconds=200.0),
        result(scene="south & west", label="<b>$x_1$</b>"), result(scene="south & west", label="_hidden", psnr=24.0),
        result(scene="south & west", label="broken", status="failed", error="RuntimeError: out of <memory>."),
    ]  # fmt: skip
    lines = write_lines(tmp_path / "r.jsonl", rows)
    status = bench.main(["table", lines, "--reference", "b", "--plots", str(tmp_path / "out")])
    assert status == 0
    printed = capsys.readouterr().out
    assert "| fox | a | 20.0, 21.0 | 0.102 | – | 30.00, 31.00 | – | – |" in printed
    assert "| _hidden |" in printed
    assert "- south & west, broken, seed 0 failed: RuntimeError: out of <memory>.\n" in printed
    with Image.open(tmp_path / "out/quality-time.png") as image:
        assert image.format == "PNG"
        assert image.width == round(7.2 * 200)


def measured(seed: int, *points: tuple[float, float, float], label: str = "ours", scene: str = "fox") -> dict[str, Any]:
    """A run with a curve of seconds, PSNR and LPIPS, of which the last are the run's."""
    curve = [{"step": 500 * i, "seconds": s, "psnr": p, "ssim": 0.9, "lpips": q} for i, (s, p, q) in enumerate(points)]
    seconds, psnr, lpips = points[-1]
    return result(scene, label, seed, curve=curve, loop_seconds=seconds, psnr=psnr, lpips=lpips)


THEIRS = [
    measured(0, (10.0, 29.0, 0.3), (20.0, 31.0, 0.2), (30.0, 30.0, 0.2), label="theirs"),
    measured(1, (10.0, 29.0, 0.3), (20.0, 30.0, 0.2), (30.0, 30.4, 0.1), label="theirs"),
    measured(2, (10.0, 29.0, 0.3), (22.0, 31.0, 0.1), (30.0, 30.2, 0.15), label="theirs"),
]


def test_a_run_matches_when_all_three_measures_first_do_and_a_run_of_the_reference_its_own():
    """The reference ends with means of 30.2 dB and .15; its second run is at its best at the end alone."""
    ours = [
        measured(0, (1.0, 30.1, 0.1), (2.0, 30.3, 0.16), (3.0, 30.3, 0.15), (4.0, 30.0, 0.2)),
        measured(1, (1.5, 30.2, 0.14)),
        measured(2, (1.0, 33.0, 0.2)),
    ]
    never = [measured(0, (1.0, 33.0, 0.2))]
    elsewhere = result(loop_seconds=None)
    assert table.Run("fox", "ours", [ours], [THEIRS]).matched() == "3.0"
    actual = table.Run("fox", "ours, one of another host", [[*ours, elsewhere]], [THEIRS]).matched()
    assert actual == "3.0"
    actual = table.Run("fox", "of another host", [[elsewhere]], [THEIRS]).matched()
    assert actual == "–"
    assert table.Run("fox", "theirs", [THEIRS], [THEIRS]).matched() == "22.0"
    assert table.Run("fox", "never", [never], [THEIRS]).matched() == "never"
    assert table.Run("fox", "alone", [ours]).matched() == "–"
    actual = table.Run("fox", "no curve", [[*ours, result()]], [THEIRS]).matched()
    assert actual == "–"
    assert table.Run("fox", "no reference here", [ours], [[]]).matched() == "–"
    without_lpips = []
    for run in ours:
        curve = [{**point, "lpips": None} for point in run["curve"]]
        without_lpips.append({**run, "curve": curve})
    assert table.Run("fox", "without LPIPS on its way", [without_lpips], [THEIRS]).matched() == "–"
    theirs = [{name: value for name, value in run.items() if name != "lpips"} for run in THEIRS]
    assert table.Run("fox", "to a reference without LPIPS", [without_lpips], [theirs]).matched() == "1.5"


def test_the_spread_is_the_standard_deviation_pooled_over_folds_and_needs_three_seeds():
    folds = [[result(psnr=p) for p in (30.0, 31.0)], [result(psnr=p) for p in (20.0, 23.0)]]
    expected = pytest.approx(((0.5 + 4.5) / 2) ** 0.5)
    assert table.deviation(folds, "psnr") == expected
    actual = table.deviation([[result(psnr=p) for p in (1.0, 2.0, 3.0)]], "psnr")
    assert actual == pytest.approx(1.0)
    assert table.deviation(folds[:1], "psnr") is None
    assert table.deviation([[result()], [result()]], "psnr") is None
    assert table.Run("castle", "ours", folds).spread("psnr", 2) == "26.00 ± 1.58"
    assert table.Run("castle", "ours", folds[:1]).spread("psnr", 2) == "30.00, 31.00"
    assert table.Run("castle", "ours", folds).seeds() == "2 × 2"


def test_single_views_of_all_folds_are_in_the_median_and_in_the_worst():
    folds = [
        [result(view_psnr=[30.0, 10.0]), result(view_psnr=[32.0, 20.0])],
        [result(view_psnr=[25.0]), result(view_psnr=[26.0])],
    ]
    run = table.Run("castle", "ours", folds)
    assert run.median_view() == "25.50"
    assert run.worst_view() == "10.00"
    with pytest.raises(ValueError, match="has no view_psnr"):
        table.Run("castle", "ours", [[result()]]).worst_view()


def test_the_printed_table_pools_the_seeds_of_all_scenes(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    rows = [result(scene, seed=seed) for scene in ("fox", "south") for seed in (0, 1)]
    status = bench.main(["table", write_lines(tmp_path / "r.jsonl", rows)])
    assert status == 0
    told = "- ours: pooled standard deviation .71 / .0000 / .0000 of PSNR, SSIM and LPIPS over 2 scenes.\n"
    printed = capsys.readouterr().out
    assert told in printed


def test_old_results_without_new_fields(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """No curve, phases, versions; then also hardly any metric."""
    bare = {"key": "k", "scene": "fox", "label": "bare", "seed": 0, "status": "ok", "loop_seconds": 10.0, "psnr": 20.0}
    least = {name: bare[name] for name in ("key", "scene", "label", "seed", "status")}
    for rows in ([result(lpips=None, gpu=None, peak_gb=None), bare], [least]):
        lines = write_lines(tmp_path / "r.jsonl", rows)
        status = bench.main(["table", lines, "--plots", str(tmp_path / "out")])
        assert status == 0
        printed = capsys.readouterr().out
        assert "| bare | " in printed


@pytest.mark.parametrize(
    ("content", "options", "sentence"),
    [
        (None, [], r"results\.jsonl is not a file; give one that python -m benchmarks wrote\."),
        ("", [], r"has no successful run among its 0\."),
        (b"\xff\xfe", [], r"results\.jsonl is not text; give a file that python -m benchmarks wrote\."),
        ([result(status="failed", error="no data.")], [], r"has no successful run among its 1\."),
        ([result()], ["--reference", "base"], r"--reference 'base' is no label of these: ours\."),
    ],
)
def test_wrong_input_is_one_sentence_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: Any, options: list[str], sentence: str
):
    lines = tmp_path / "results.jsonl"
    if isinstance(content, list):
        write_lines(lines, content)
    elif content is not None:
        lines.write_bytes(content if isinstance(content, bytes) else content.encode())
    status = bench.main(["table", str(lines), "--plots", str(tmp_path / "out"), *options])
    assert status == 2
    error = capsys.readouterr().err
    assert re.search(sentence, error)
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_labels_are_told_apart_without_colour():
    looks = list(plots.styles(f"label {i}" for i in range(12)).values())
    assert len({look["marker"] for look in looks}) == 12
    for a, b in itertools.pairwise(looks):
        assert a["color"] != b["color"]


def test_a_label_looks_the_same_in_all_panels_and_in_the_legend():
    groups = table.groups([result(label="a"), result(label="b"), result(scene="south", label="b")])
    looks = plots.styles(label for _, label in groups)
    figure = plots.quality(groups.items())
    markers = [{str(line.get_marker()) for line in axes.lines} for axes in figure.axes]
    expected = [{looks["a"]["marker"], looks["b"]["marker"]}] * 3
    assert markers[:3] == expected
    assert markers[3:] == [{looks["b"]["marker"]}] * 3
    legend = figure.legends[0]
    shown = [
        (text.get_text(), line.get_marker()) for text, line in zip(legend.get_texts(), legend.get_lines(), strict=True)
    ]
    expected = [("a", looks["a"]["marker"]), ("b", looks["b"]["marker"])]
    assert shown == expected


def test_curves_are_means_over_seeds_that_end_with_the_run():
    def curve(offset: float, pace: float) -> list[dict[str, Any]]:
        psnr = {1: 20.0, 2: 27.0, 3: 29.5}
        return [{"step": s, "seconds": pace * s, "psnr": offset + psnr[s], "ssim": 0.8, "lpips": None} for s in psnr]

    groups = table.groups([result(curve=curve(0, 3.0)), result(seed=1, curve=curve(2, 5.0))])
    lines = plots.quality(groups.items()).axes[0].lines
    mean = max(lines, key=lambda line: line.get_linewidth() if line.get_linestyle() != "None" else 0)
    points = np.asarray(mean.get_xydata()).tolist()
    assert points == [[8.0, 28.0], [12.0, 30.5]], "21 dB is far worse than the end and left out"


@pytest.mark.parametrize("shared", [1, 4])
def test_times_of_runs_that_shared_a_gpu_are_marked(shared: int):
    groups = table.groups([result(jobs_per_gpu=shared)])
    title = plots.quality(groups.items()).get_supxlabel()
    assert ("not comparable" in title) == (shared > 1)


def test_text_is_readable_and_legends_do_not_reach_beyond_the_figure():
    groups = table.groups([result(label=f"method number {i} with a long name") for i in range(20)])
    figure = plots.quality(groups.items())
    figure.draw_without_rendering()
    box = figure.legends[0].get_window_extent()
    panel = figure.axes[0].get_window_extent()
    assert box.x0 >= 0
    assert box.x1 <= figure.bbox.width
    assert box.y1 <= figure.bbox.height
    assert box.y0 >= panel.y1, "the legend must not eat the panels"
    assert panel.height > 1.2 * figure.dpi, "the legend must not eat the panels"
    texts: Any = [*figure.legends[0].get_texts(), *figure.axes[0].get_xticklabels(), figure.axes[0].yaxis.label]
    assert min(text.get_fontsize() for text in texts) >= 8


def test_names_of_points_stand_inside_beside_their_points_and_apart():
    points = [
        ("theirs 30k", True, 300, 30.0, 0.2),
        ("theirs, faster", True, 12, 31.8, 0.196),
        ("ours", False, 11, 31.9, 0.185),
        ("ours, earlier", True, 30, 31.9, 0.19),
    ]
    figure = plots.peers(points)
    assert [axes.get_ylabel()[:4] for axes in figure.axes] == ["PSNR", "LPIP"]
    for axes in figure.axes:
        texts = [text for text in axes.texts if isinstance(text, Annotation)]
        assert [text.get_text() for text in texts] == [name for name, *_ in points]
        boxes = [text.get_window_extent() for text in texts]
        centres = axes.transData.transform([text.xy for text in texts])
        for number, box in enumerate(boxes):
            assert axes.bbox.containsx(box.x0)
            assert axes.bbox.containsx(box.x1)
            for centre in centres:
                assert not box.contains(*centre)
            for other in boxes[:number]:
                assert not box.overlaps(other)
            assert np.abs(np.clip(centres[number], box.min, box.max) - centres[number]).max() < 20
    lines = figure.axes[0].lines
    assert [line.get_fillstyle() for line in lines] == ["full", "full", "none", "full"]
    assert lines[0].get_marker() == lines[1].get_marker() != lines[2].get_marker() == lines[3].get_marker()
