"""The benchmark of what a user waits for at the start of training, with and without the code for a quick start."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks import __main__ as bench
from benchmarks import results, startup
from benchmarks.startup import WAYS, markdown


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Runs that were started, of which none trains: each writes the trainer's events."""
    runs: list[dict[str, Any]] = []

    def run(words: list[str], *, env: dict[str, str], **_: Any) -> None:
        runs.append({"code": words[2], "words": words[3:], "cache": env["TRITON_CACHE_DIR"]})
        if words[5].endswith("fails"):
            raise subprocess.CalledProcessError(1, words)
        start = startup.time.time()
        events = [("loop begins", 2.0), ("loop ends", 5.0)]
        text = [json.dumps({"event": event, "time": start + seconds}) for event, seconds in events]
        Path(env[startup.TRACE]).write_text("\n".join(text))

    monkeypatch.setattr(startup.subprocess, "run", run)
    monkeypatch.setattr(startup, "about", dict)  # It asks git.
    return runs


def test_each_way_has_a_first_run_with_caches_of_its_own_and_later_ones(
    started: list[dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "room").mkdir()
    output = tmp_path / "rows.jsonl"
    given = ["startup", "--data", str(tmp_path / "room"), "--output", str(output), "--later", "1", "--iterations", "9"]
    status = bench.main(given)
    assert status == 0
    rows = results.read(output)
    actual = [(row["label"], row["first"]) for row in rows]
    expected = [(way, first) for first in (True, False) for way in WAYS]
    assert actual == expected
    for row in rows:
        assert row["wait"] == pytest.approx(2, abs=0.5)
        assert row["trained"] > row["wait"]
    measured = started[1:]  # The first run is not measured.
    caches = [run["cache"] for run in measured]
    assert len({*caches}) == len(WAYS)
    assert caches[: len(WAYS)] == caches[len(WAYS) :]
    assert started[0]["cache"] not in caches
    for run in started:
        assert "--max-num-iterations 9" in " ".join(run["words"])
    printed = capsys.readouterr().out
    assert "| sadgs without compile_ahead | " in printed


def test_a_run_that_fails_has_a_row_that_says_so(started: list[dict[str, Any]], tmp_path: Path):
    (tmp_path / "fails").mkdir()
    output = tmp_path / "rows.jsonl"
    given = ["startup", "--data", str(tmp_path / "fails"), "--output", str(output), "--ways", "sadgs", "--later", "0"]
    status = bench.main(given)
    assert status == 1
    (row,) = results.read(output)
    assert row["status"] == "failed"
    assert row["error"].startswith("CalledProcessError")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--data", "nowhere"], "--data nowhere does not exist; give a capture with cameras."),
        (["--data", ".", "--ways", "slowly"], "--ways names 'slowly'; give some of 'sadgs', "),
    ],
)
def test_wrong_names_are_refused_in_a_sentence(
    words: list[str], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    status = bench.main(["startup", "--output", "rows.jsonl", *words])
    assert status == 2
    errors = capsys.readouterr().err
    assert f"python -m benchmarks startup: {sentence}" in errors
    assert list(tmp_path.iterdir()) == []


def test_the_table_compares_each_way_with_the_one_that_has_more():
    def row(label: str, number: int, wait: float, seconds: float) -> dict[str, Any]:
        return {"status": "ok", "label": label, "first": number == 0, "wait": wait, "seconds": seconds}

    rows = [row("sadgs", 0, 10, 15), row("sadgs", 1, 4, 9), row("sadgs", 2, 6, 9)]
    rows += [row("sadgs without deferred_imports", 0, 12.5, 18), row("sadgs without deferred_imports", 1, 4, 8.5)]
    assert markdown(rows).splitlines()[2:] == [
        "| sadgs | 10.0 | 15.0 | 5.0 | 9.0 |",
        "| sadgs without deferred_imports | 12.5 (+2.5) | 18.0 (+3.0) | 4.0 (-1.0) | 8.5 (-0.5) |",
    ]


def test_without_a_part_of_the_code_a_process_does_not_run_it():
    checks = {
        "deferred_imports": "from sadgs_ns.training.run.deferred_imports import import_nerfstudio; "
        "import_nerfstudio(); import sys; assert not any(name.startswith('nerfstudio') for name in sys.modules)",
        "compile_ahead": "from sadgs_ns.training.kernels_ahead import compile_ahead; import subprocess, pathlib; "
        "subprocess.Popen = None; compile_ahead._marker = lambda: pathlib.Path('nowhere'); compile_ahead.begin()",
    }
    assert checks.keys() == {way.without for way in WAYS.values()} - {""}
    for without, check in checks.items():
        way = startup.Way(check, without)
        done = subprocess.run([sys.executable, "-W", "ignore", "-c", way.code], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
