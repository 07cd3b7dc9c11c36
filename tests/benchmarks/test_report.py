"""The plots and the page of a results file, from made-up results and images."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.text import Annotation
from PIL import Image

from benchmarks import plots, report, table, views

SIZE = (160, 240)
"""Height and width of the made-up views."""
PLANTED = (130, 20)
"""Left and top of the square, 96 pixels wide, that method "blurred" misses."""


def result(scene: str = "fox", label: str = "ours", seed: int = 0, **changes: Any) -> dict[str, Any]:
    return {
        "key": f"{scene}/{label}/{seed}", "scene": scene, "label": label, "method": "sadgs", "seed": seed,
        "overrides": {"max_num_iterations": 3000}, "status": "ok", "error": None, "date": "2026-11-21T05:17:12+00:00",
        "versions": {"torch": "2.11.0", "commit": "0123456789abcdef"}, "iterations": 3000, "gpu": "NVIDIA H200",
        "loop_seconds": 20.0 + seed, "import_seconds": 12.0, "setup_seconds": 0.5, "load_seconds": 0.4,
        "psnr": 30.0 + seed, "ssim": 0.9, "lpips": 0.1, "gaussians": 400_000, "peak_gb": 2.0, "jobs_per_gpu": 1,
        **changes,
    }  # fmt: skip


def write_lines(path: Path, rows: list[dict[str, Any]]) -> Path:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def write_views(folder: Path, scene: str = "fox") -> tuple[list[str], list[str]]:
    """A photograph, a faithful and a blurred rendering of two views; the results' paths of the two methods."""
    rng = np.random.default_rng(0)
    left, top = PLANTED
    for view in ("a", "b"):
        truth = rng.integers(0, 256, (*SIZE, 3), np.uint8)
        blurred = truth.copy()
        blurred[top : top + 96, left : left + 96] = 128
        for name, image in {"truth": truth, "faithful-0": truth, "blurred-0": blurred}.items():
            path = folder / scene / name / f"{view}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(image).save(path)
    return tuple([f"{scene}/{name}-0/{view}.png" for view in "ab"] for name in ("faithful", "blurred"))  # type: ignore[return-value]


class Page(HTMLParser):
    """Sources, links and text of a page; opened and closed tags must match."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.links: list[str] = []
        self.text = ""
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if tag == "img":
            assert given["alt"]
            self.sources.append(given["src"] or "")
        if tag == "a":
            self.links.append(given["href"] or "")
        if tag not in ("img", "meta", "br"):
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


# The page


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report of everything there can be: curves, phases, images, seeds, several scenes, a failed run."""
    root = tmp_path_factory.mktemp("report")
    faithful, blurred = write_views(root / "images")
    curve = [{"step": s, "seconds": s / 150, "psnr": 20 + s / 300, "ssim": 0.8, "lpips": None} for s in (0, 1500, 3000)]
    phases = {"rasterize_forward": 1.0, "rasterize_backward": 2.0, "eta": 0.1}
    rows = [
        result(label="faithful", images=faithful, curve=curve, phases=phases),
        result(label="faithful", seed=1, curve=curve, phases=phases),
        result(label="blurred", images=blurred, loop_seconds=200.0),
        result(scene="south & west", label="<b>$x_1$</b>", psnr=25.0, structure_tensor_seconds=3.0),
        result(scene="south & west", label="_hidden", psnr=24.0),
        result(scene="south & west", label="broken", status="failed", error="RuntimeError: out of <memory>."),
    ]
    lines = write_lines(root / "results.jsonl", rows)
    options = ["--images", str(root / "images"), "--reference", "blurred", "--title", "Ours & theirs"]
    assert (
        report.main([str(lines), "--output", str(root / "out"), "--command", "python -m benchmarks a.yaml", *options])
        == 0
    )
    return root / "out"


def test_plots_are_png_and_svg(written: Path):
    for name in ("quality-time", "quality-count", "time-breakdown"):
        with Image.open(written / f"{name}.png") as image:
            image.load()
            assert image.format == "PNG" and image.width == round(7.2 * 200)
        assert ElementTree.parse(written / f"{name}.svg").getroot().tag == "{http://www.w3.org/2000/svg}svg"


def test_page_names_every_label_scene_and_setting(written: Path):
    source = (written / "report.html").read_text()
    page = Page(source)
    for text in (
        "Ours & theirs", "fox", "south & west", "faithful", "blurred", "<b>$x_1$</b>", "_hidden", "NVIDIA H200",
        "0123456789ab", "2.11.0", "2026-11-21", "max_num_iterations = 3000", "python -m benchmarks a.yaml",
        "south & west, broken, seed 0 failed: RuntimeError: out of <memory>.",
    ):  # fmt: skip
        assert text in page.text, text
    assert "<b>" not in source
    assert "20.5 ± 0.5" in page.text and "0.102" in page.text, "mean over seeds, and its ratio to the reference"


def test_page_needs_nothing_but_its_folder(written: Path):
    page = Page((written / "report.html").read_text())
    assert sum(source.startswith("data:image/svg+xml;base64,") for source in page.sources) == 3
    files = [link for link in (*page.sources, *page.links) if not link.startswith(("data:", "#"))]
    assert all((written / file).is_file() for file in files)
    assert {"quality-time.svg", "time-breakdown.png"} <= set(files)
    assert (
        len([file for file in files if file.startswith("views/")]) == 2 * 2 * 3 * 2
    )  # src, href; sizes; methods; views


def test_old_results_without_new_fields(tmp_path: Path):
    """No curve, phases, initialization, images, versions; then also hardly any metric."""
    bare = {"key": "k", "scene": "fox", "label": "bare", "seed": 0, "status": "ok", "loop_seconds": 10.0, "psnr": 20.0}
    lines = write_lines(tmp_path / "r.jsonl", [result(lpips=None, gpu=None, peak_gb=None), bare])
    assert report.main([str(lines), "--output", str(tmp_path / "out")]) == 0
    page = Page((tmp_path / "out" / "report.html").read_text())
    assert "bare" in page.text and len(page.sources) == 3
    lines = write_lines(
        tmp_path / "r.jsonl", [{name: bare[name] for name in ("key", "scene", "label", "seed", "status")}]
    )
    assert report.main([str(lines), "--output", str(tmp_path / "out")]) == 0


def test_many_scenes_are_several_figures_on_the_page_and_one_in_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(report, "SCENES_A_FIGURE", 1)
    monkeypatch.setattr(report, "_FIGURES", report._FIGURES[:1])
    report.write([result(), result(scene="south")], tmp_path)
    assert len(Page((tmp_path / "report.html").read_text()).sources) == 2
    with Image.open(tmp_path / "quality-time.png") as image:
        assert image.height > 2 * 1.9 * 200


def test_a_second_report_replaces_the_first_and_keeps_other_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(report, "_FIGURES", report._FIGURES[:1])
    (tmp_path / "notes.txt").write_text("mine")
    report.write([result(label="older")], tmp_path)
    report.write([result(label="newer")], tmp_path)
    text = Page((tmp_path / "report.html").read_text()).text
    assert "newer" in text and "older" not in text
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("content", "options", "sentence"),
    [
        (None, [], r"results\.jsonl is not a file; give one that python -m benchmarks wrote\."),
        ("", [], r"has no successful run among its 0, so there is nothing to draw\."),
        ([result(status="failed", error="no data.")], [], r"has no successful run among its 1, so"),
        (json.dumps(result()) + '\n{"key": "b", "sta\n', [], r"results\.jsonl:2 is not a benchmark's result; delete"),
        (json.dumps(result()) + '\n{"key": "b"}\n', [], r"results\.jsonl:2 is not a benchmark's result; delete"),
        (
            [result()],
            ["--reference", "base"],
            r"--reference 'base' is no label with a successful run; there are ours\.",
        ),
        ([result()], ["--views", "0"], r"--views must be 1 or more, not 0\."),
        ([result()], ["--images", "nowhere"], r"nowhere holds none of the results' images with its photograph; check"),
    ],
)
def test_wrong_input_is_one_sentence_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: Any, options: list[str], sentence: str
):
    lines = tmp_path / "results.jsonl"
    if isinstance(content, str):
        lines.write_text(content)
    elif content is not None:
        write_lines(lines, content)
    assert report.main([str(lines), "--output", str(tmp_path / "out"), *options]) == 2
    error = capsys.readouterr().err
    assert re.search(sentence, error) and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_output_must_be_a_folder(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=r"file is a file; name a folder\."):
        report.write([result()], tmp_path / "file")


# Plots


def test_pareto_front_of_a_hand_made_case():
    points = [(3.0, 30.0), (1.0, 20.0), (2.0, 30.0), (2.0, 25.0), (4.0, 29.0), (5.0, 31.0), (1.0, 20.0)]
    assert plots.pareto_front(points, higher_is_better=True) == [(1.0, 20.0), (2.0, 30.0), (5.0, 31.0)]
    assert plots.pareto_front([(1, 0.3), (2, 0.2), (3, 0.25)], higher_is_better=False) == [(1, 0.3), (2, 0.2)]
    assert plots.pareto_front([], higher_is_better=True) == []


def test_pareto_front_is_drawn_as_steps_through_the_means():
    groups = table.groups([
        result(label="small", gaussians=100, psnr=20.0),
        result(label="large", gaussians=300, psnr=29.0), result(label="large", seed=1, gaussians=500, psnr=31.0),
        result(label="worse", gaussians=900, psnr=25.0),
    ])  # fmt: skip
    axes = plots.quality_count(groups, plots.styles(label for _, label in groups)).axes[0]
    front = next(line for line in axes.lines if line.get_drawstyle() == "steps-post")
    xs, ys = (np.asarray(front.get_data()[i]).tolist() for i in (0, 1))
    assert list(zip(xs, ys, strict=True))[1:3] == [(100, 20.0), (400, 30.0)]
    assert ys[-1] == 30.0 and xs[-1] == axes.get_xlim()[1]


def test_labels_are_told_apart_without_colour():
    looks = plots.styles(f"label {i}" for i in range(78))
    assert len({(look.marker, look.fill) for look in looks.values()}) == 78
    first = list(looks.values())[:13]
    assert len({look.marker for look in first}) == 13 and {look.fill for look in first} == {"full"}
    neighbours = zip(list(looks.values())[:-1], list(looks.values())[1:], strict=True)
    assert all(a.line != b.line and a.color != b.color for a, b in neighbours)


def test_a_label_looks_the_same_in_all_panels_and_in_the_legend():
    groups = table.groups([result(label="a"), result(label="b"), result(scene="south", label="b")])
    looks = plots.styles(label for _, label in groups)
    figure = plots.quality_time(groups, looks)
    markers = [{str(line.get_marker()) for line in axes.lines} for axes in figure.axes]
    assert markers[:3] == [{looks["a"].marker, looks["b"].marker}] * 3 and markers[3:] == [{looks["b"].marker}] * 3
    legend = figure.legends[0]
    shown = [
        (text.get_text(), line.get_marker()) for text, line in zip(legend.get_texts(), legend.get_lines(), strict=True)
    ]
    assert shown == [("a", looks["a"].marker), ("b", looks["b"].marker)]


def test_stages_are_told_apart_without_colour():
    groups = table.groups([result(initialization_seconds=1.0, structure_tensor_seconds=3.0)])
    figure = plots.time_breakdown(groups)
    patches: Any = figure.subfigs[0].axes[0].patches
    assert len({patch.get_hatch() for patch in patches}) == len(patches) == len(plots.STAGES)
    assert [patch.get_width() for patch in patches] == pytest.approx([12.0, 0.5, 1.0, 0.4, 3.0, 20.0])
    assert [patch.get_x() for patch in patches] == pytest.approx([0.0, 12.0, 12.5, 13.5, 13.9, 16.9])


def test_phases_have_bars_of_their_own():
    groups = table.groups(
        [result(phases={"loss": 1.0, "rest": 3.0}), result(seed=1, phases={"loss": 2.0, "rest": 3.0})]
    )
    figure = plots.time_breakdown(groups)
    assert [patch.get_width() for patch in figure.subfigs[1].axes[0].patches] == [1.5, 3.0]  # type: ignore[attr-defined]


def test_curves_are_means_over_seeds_that_end_with_the_run():
    def curve(offset: float, pace: float) -> list[dict[str, Any]]:
        psnr = {1: 20.0, 2: 27.0}
        return [{"step": s, "seconds": pace * s, "psnr": offset + psnr[s], "ssim": 0.8, "lpips": None} for s in psnr]

    groups = table.groups([result(curve=curve(0, 3.0)), result(seed=1, curve=curve(2, 5.0))])
    lines = plots.quality_time(groups, plots.styles(["ours"])).axes[0].lines
    mean = max(lines, key=lambda line: line.get_linewidth() if line.get_linestyle() != "None" else 0)
    points = np.asarray(mean.get_xydata()).tolist()
    assert points == [[8.0, 28.0], [20.5, 30.5]], "21 dB is far worse than the end and left out"


@pytest.mark.parametrize("shared", [1, 4])
def test_times_of_runs_that_shared_a_gpu_are_marked(shared: int):
    groups = table.groups([result(jobs_per_gpu=shared)])
    title = plots.quality_time(groups, plots.styles(["ours"])).get_supxlabel()
    assert ("not comparable" in title) == (shared > 1)


def test_text_is_readable_and_legends_do_not_reach_beyond_the_figure():
    groups = table.groups([result(label=f"method number {i} with a long name") for i in range(20)])
    figure = plots.quality_time(groups, plots.styles(label for _, label in groups))
    figure.draw_without_rendering()
    box = figure.legends[0].get_window_extent()
    panel = figure.axes[0].get_window_extent()
    assert box.x0 >= 0 and box.x1 <= figure.bbox.width and box.y1 <= figure.bbox.height
    assert box.y0 >= panel.y1 and panel.height > 1.2 * figure.dpi, "the legend must not eat the panels"
    texts: Any = [*figure.legends[0].get_texts(), *figure.axes[0].get_xticklabels(), figure.axes[0].yaxis.label]
    assert min(text.get_fontsize() for text in texts) >= 8


def test_the_same_results_give_the_same_svg():
    groups = table.groups([result(), result(label="b")])
    looks = plots.styles(label for _, label in groups)
    assert plots.svg(plots.quality_count(groups, looks)) == plots.svg(plots.quality_count(groups, looks))


# Views


def test_crop_finds_where_the_methods_differ():
    rng = np.random.default_rng(0)
    truth = rng.random((200, 300, 3), np.float32)
    noisy = [truth + rng.normal(0, 0.05, truth.shape).astype(np.float32) for _ in range(3)]
    for image in noisy:
        image[:60, :60] = 0  # wrong in all: nothing tells the methods apart here
    noisy[1][90:186, 150:246] = 0.5
    left, top, right, bottom = views.crop_window(truth, noisy)
    assert (right - left, bottom - top) == (96, 96)
    assert abs(left - 150) <= 2 and abs(top - 90) <= 2


def test_crop_of_one_method_is_its_largest_error_and_fits_a_small_image():
    truth = np.zeros((50, 300, 3), np.float32)
    image = truth.copy()
    image[:, 200:] = 1
    left, top, right, bottom = views.crop_window(truth, [image])
    assert (top, bottom, right - left) == (0, 50, 96) and left >= 200


def test_crops_are_the_same_window_of_all_methods(tmp_path: Path):
    faithful, blurred = write_views(tmp_path / "images")
    rows = [result(label="faithful", images=faithful), result(label="blurred", images=blurred)]
    shown = views.compare(table.groups(rows), tmp_path / "images", tmp_path / "out", count=1)
    assert [(view.scene, view.name) for view in shown] == [("fox", "a")]
    left, top, right, bottom = shown[0].box
    assert (left, top) == PLANTED and [p.label for p in shown[0].pictures] == [views.TRUTH, "faithful", "blurred"]
    crops = [np.asarray(Image.open(tmp_path / "out" / picture.crop)) for picture in shown[0].pictures]
    photograph = np.asarray(Image.open(tmp_path / "images" / "fox" / "truth" / "a.png"))
    assert np.array_equal(crops[0], photograph[top:bottom, left:right]) and np.array_equal(crops[0], crops[1])
    assert np.all(crops[2] == 128)


def test_a_method_without_an_image_is_left_out_of_the_view(tmp_path: Path):
    faithful, blurred = write_views(tmp_path / "images")
    (tmp_path / "images" / blurred[0]).unlink()
    rows = [result(label="faithful", images=faithful), result(label="blurred", images=blurred), result(label="old")]
    shown = views.compare(table.groups(rows), tmp_path / "images", tmp_path / "out", count=5)
    assert [[p.label for p in view.pictures[1:]] for view in shown] == [["faithful"], ["faithful", "blurred"]]


def test_a_photograph_with_alpha_lies_over_the_renderings_background(tmp_path: Path):
    faithful, _ = write_views(tmp_path)
    rendered = np.full((*SIZE, 3), (250, 240, 230), np.uint8)
    rendered[40:120, 60:180] = (10, 20, 30)
    truth = np.zeros((*SIZE, 4), np.uint8)
    truth[40:120, 60:180] = (10, 20, 30, 255)
    Image.fromarray(rendered).save(tmp_path / faithful[0])
    Image.fromarray(truth).save(tmp_path / "fox" / "truth" / "a.png")
    shown = views.compare(table.groups([result(images=faithful[:1])]), tmp_path, tmp_path / "out", count=1)
    whole, ours = (Image.open(tmp_path / "out" / picture.overview) for picture in shown[0].pictures)
    assert np.array_equal(np.asarray(whole), np.asarray(ours))


def test_images_that_cannot_be_compared_are_named(tmp_path: Path):
    faithful, _ = write_views(tmp_path)
    groups = table.groups([result(images=faithful)])
    Image.new("RGB", (10, 20)).save(tmp_path / faithful[0])
    with pytest.raises(ValueError, match=r"a\.png has 10×20 pixels, but its photograph has 240×160\."):
        views.compare(groups, tmp_path, tmp_path / "out", count=2)
    (tmp_path / faithful[0]).write_text("no image")
    with pytest.raises(ValueError, match=r"a\.png is not an image that can be read"):
        views.compare(groups, tmp_path, tmp_path / "out", count=2)


def test_names_of_points_stand_inside_beside_their_points_and_apart():
    points = [
        plots.Point("theirs 30k", True, 300, 30.0, 0.2),
        plots.Point("theirs, faster", True, 12, 31.8, 0.196),
        plots.Point("ours", False, 11, 31.9, 0.185),
        plots.Point("ours, earlier", True, 30, 31.9, 0.19),
    ]
    figure = plots.peers("loop_seconds", points)
    assert [axes.get_ylabel()[:4] for axes in figure.axes] == ["PSNR", "LPIP"]
    for axes in figure.axes:
        texts = [text for text in axes.texts if isinstance(text, Annotation)]
        assert [text.get_text() for text in texts] == [point.name for point in points]
        boxes = [text.get_window_extent() for text in texts]
        centres = axes.transData.transform([text.xy for text in texts])
        for number, box in enumerate(boxes):
            assert axes.bbox.containsx(box.x0) and axes.bbox.containsx(box.x1)
            assert not any(box.contains(*centre) for centre in centres)
            assert not any(box.overlaps(other) for other in boxes[:number])
            assert np.abs(np.clip(centres[number], box.min, box.max) - centres[number]).max() < 20
    lines = figure.axes[0].lines
    assert [line.get_fillstyle() for line in lines] == ["full", "full", "none", "full"]
    assert lines[0].get_marker() == lines[1].get_marker() != lines[2].get_marker() == lines[3].get_marker()
