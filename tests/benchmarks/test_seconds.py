"""The benchmark of what a user waits for: parts of all processes of a command, as a table and a picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from PIL import Image

from benchmarks import results, seconds, seconds_plot, seconds_table
from benchmarks.seconds_table import Part
from helpers.drawn_photos import VIEWS, draw_photos

CONFIG = Path(seconds.__file__).parents[1] / "configs/bench/seconds.yaml"
START = 1000.0


def event(process: int, time: float, event: str, **fields: Any) -> str:
    return json.dumps({"process": process, "time": START + time, "event": event, **fields})


def span(process: int, begin: float, end: float, name: str, **fields: Any) -> str:
    return event(process, end, "span", name=name, begin=START + begin, **fields)


def test_parts_are_named_after_their_process_and_last_until_the_next_mark():
    lines = [
        span(2, 0.5, 2.0, "imports", function="sadgs_ns.training.run.start:train"),
        event(2, 2.0, "imported"),
        span(1, 0.25, 3.0, "cameras"),
        event(2, 5.0, "training begins", iterations=3000),
        event(2, 5.5, "progress", stage="compiling kernels", done=1, total=2),
        event(2, 6.0, "loop begins"),
        event(2, 9.0, "loop ends"),
        event(2, 9.5, "training ends", gaussians=5),
    ]
    actual = seconds.parts_of(lines, "sadgs", START)
    expected = [
        Part("sadgs", "cameras", 0.25, 3.0),
        Part("training", "imports", 0.5, 2.0),
        Part("training", "data and model", 2.0, 5.0),
        Part("training", "kernels and start", 5.0, 6.0),
        Part("training", "iterations", 6.0, 9.0),
        Part("training", "saving", 9.0, 9.5),
    ]
    assert actual == expected


def row(number: int, total: float, parts: list[list[Any]], **fields: Any) -> dict[str, Any]:
    identity = {"key": f"fox/new/{number}", "scene": "fox", "label": "new", "seed": number, "status": "ok"}
    return {**identity, "seconds": total, "cpu_seconds": 3 * total, "photos": 50, "parts": parts, **fields}


def test_the_table_has_medians_of_the_parts_that_all_runs_have():
    rows = [
        row(0, 9.0, [["COLMAP", "features", 1.0, 4.0], ["COLMAP", "placing", 4.0, 8.0], ["COLMAP", "late", 8.0, 9.0]]),
        row(1, 5.0, [["COLMAP", "features", 1.0, 2.0], ["COLMAP", "placing", 2.0, 3.0], ["COLMAP", "placing", 4, 5.0]]),
        row(2, 6.0, [["COLMAP", "placing", 3.0, 6.0], ["COLMAP", "features", 1.5, 3.0]]),
    ]
    expected = [Part("COLMAP", "features", 1.0, 3.0), Part("COLMAP", "placing", 3.0, 6)]
    assert seconds_table.median_parts(rows) == expected
    assert seconds_table.markdown(rows).splitlines()[2:] == [
        "| fox | new | COLMAP | features | 1.00 | 3.00 | 2.00 |",
        "| fox | new | COLMAP | placing | 3.00 | 6.00 | 3.00 |",
        "| fox | new | all | 3 runs, 18.0 s on all cores | 0.00 | 6.00 | 6.00 |",
    ]


def test_the_picture_has_a_bar_for_each_part_that_is_not_too_short():
    parts = [["sadgs", "cameras", 1.0, 4.0], ["COLMAP", "features", 1.5, 3.0], ["COLMAP", "choice", 3.0, 3.01]]
    ((name, figure),) = seconds_plot.figures([row(0, 10.0, parts)])
    (axes,) = figure.axes
    bars = []
    for bar in axes.patches:
        corners = bar.get_path().get_extents(bar.get_patch_transform())
        bars.append((corners.x0, corners.width))
    assert name == "fox-new"
    assert bars == [(1.0, 3.0), (1.5, 1.5)]
    actual = [label.get_text() for label in axes.get_yticklabels()]
    assert actual == ["sadgs: cameras", "COLMAP: features"]


def test_the_protocol_names_three_captures_of_which_one_is_thinned():
    protocol = seconds.load(CONFIG)
    assert list(protocol.captures) == ["fox", "plush", "room"]
    assert protocol.every == {"room": 3}


def command(folder: Path, **options: Any) -> seconds.Command:
    (folder / "seconds.yaml").write_text(yaml.dump({"captures": {"corner": "corner"}, "every": {"corner": 2}}))
    return seconds.Command(folder / "seconds.yaml", folder, folder / "rows.jsonl", "new", **options)


def test_the_parts_of_a_command_are_measured_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "corner").mkdir()
    for i, photo in enumerate(draw_photos()):
        photo.save(tmp_path / "corner" / f"{i}.png")
    measure = command(tmp_path, runs=1, cameras=True, cold=True, plots=tmp_path / "plots")
    assert measure() == 0, capsys.readouterr().err
    (measured,) = results.read(tmp_path / "rows.jsonl")
    names = [(process, name) for process, name, _, _ in measured["parts"]]
    assert measured["photos"] == VIEWS // 2
    assert measured["cpu_seconds"] > 0.5
    assert names[0] == ("sadgs-process", "photos")
    assert names[-1] == ("sadgs-process", "publishing")
    assert {name for process, name in names if process == "COLMAP"} >= {"imports", "features", "placing"}
    for _, _, begin, end in measured["parts"]:
        assert 0 <= begin <= end <= measured["seconds"]
    assert (tmp_path / "plots/corner-new.png").exists()
    written = (tmp_path / "rows.jsonl").read_bytes()
    assert measure() == 0  # There is nothing left to do.
    assert (tmp_path / "rows.jsonl").read_bytes() == written
    printed = capsys.readouterr().out
    assert "| corner | new | COLMAP | features |" in printed


def test_a_command_that_fails_has_a_row_and_its_output_a_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "corner").mkdir()
    for i in range(8):
        Image.new("RGB", (64, 64), (9 * i, 0, 0)).save(tmp_path / "corner" / f"{i}.png")
    assert command(tmp_path, runs=1, cameras=True)() == 1
    (failed,) = results.read(tmp_path / "rows.jsonl")
    assert failed["status"] == "failed"
    assert "sadgs-process ended with code" in failed["error"]
    assert "no two photos could be related" in (tmp_path / "rows.log").read_text()


def test_a_capture_that_is_not_there_is_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="holds no photos"):
        command(tmp_path)()
    with pytest.raises(ValueError, match="the protocol has corner"):
        command(tmp_path, only=("cellar",))()
