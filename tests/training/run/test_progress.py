"""What a run says while it trains and when it is done."""

from __future__ import annotations

import io
import itertools
import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import tyro
from nerfstudio.configs.base_config import LocalWriterConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.scripts.viewer.run_viewer import RunViewer
from nerfstudio.utils import writer
from nerfstudio.utils.writer import EventName
from rich.console import Console

from helpers.kill_and_resume import set_up
from helpers.small_scenes import ITERATIONS
from sadgs_ns.cli import export
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.run import progress
from sadgs_ns.training.run.progress import (
    ProgressTable,
    cpu_notice,
    duration,
    early_time_left,
    remove_tables,
    time_left,
)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time of the tables, which stands still; its one element may be changed."""
    now = [1000.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


@pytest.fixture(autouse=True)
def no_other_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer, "EVENT_WRITERS", [])


@pytest.fixture
def events(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[dict[str, Any]]]:
    """nerfstudio's queue of a run of 100 iterations, with a row every 10."""
    monkeypatch.setattr(writer, "GLOBAL_BUFFER", {"max_iter": 100, "steps_per_log": 10})
    yield writer.EVENT_STORAGE
    writer.EVENT_STORAGE.clear()


def log(table: ProgressTable, events: list[dict[str, Any]], step: int, loss: Any = None) -> None:
    """Hand the table what nerfstudio does after an iteration; the loss and metrics only where a row is due."""
    events[:] = [{"name": EventName.ITER_TRAIN_TIME.value, "event": 0.1, "step": step}]
    if loss is not None:
        metrics = {"psnr": torch.tensor(20.0 + step), "gaussian_count": 1000 * step}
        events += [{"name": "Train Loss", "event": loss}, {"name": "Train Metrics Dict", "event": metrics}]
    table.write_stats_log(step)


class Unread:
    """A value on the device, of which nobody can make a number."""


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.2, "0 s"), (99.4, "99 s"), (99.6, "2 min"), (3600.0, "60 min"), (11_100.0, "3 h 5 min")],
)
def test_durations_have_at_most_two_units(seconds: float, words: str):
    assert duration(seconds) == words


@pytest.mark.hard_case(
    "a row of the table",
    "has loss, PSNR, Gaussians, pace and, late enough to be true, the time that is left; the last row leaves the table",
)
def test_a_row_tells_loss_psnr_gaussians_pace_and_the_time_that_is_left(
    events: list[dict[str, Any]], clock: list[float], capsys: pytest.CaptureFixture[str]
):
    table = ProgressTable(LocalWriterConfig(), ["Viewer at: there"])
    for step, seconds in ((0, 0.0), (10, 4.0), (50, 96.0)):
        clock[0] += seconds
        log(table, events, step, torch.tensor(0.5, requires_grad=True))
    events[:] = [{"name": EventName.TOTAL_TRAIN_TIME.value, "event": 9.0}]
    table.write_stats_log(100)  # after the last iteration: nerfstudio's table would lose its header
    lines = [line.split("  ") for line in capsys.readouterr().out.splitlines()]
    cells = [[cell.strip() for cell in line if cell.strip()] for line in lines]
    expected = [
        ["Viewer at: there"],
        ["Step (% Done)", "Loss", "PSNR", "Gaussians", "Iteration", "Time left"],
        ["-" * 70],
        ["0 (0.00%)", "0.5000", "20.00 dB", "0"],
        ["10 (10.00%)", "0.5000", "30.00 dB", "10,000", "400 ms"],
        ["50 (50.00%)", "0.5000", "70.00 dB", "50,000", "2.0 s", "59 s"],
    ]
    assert cells == expected


def test_where_minutes_are_left_their_bounds_are_told_from_the_second_row_on(
    events: list[dict[str, Any]], clock: list[float], capsys: pytest.CaptureFixture[str]
):
    table = ProgressTable(LocalWriterConfig())
    for step, seconds in ((0, 0.0), (10, 40.0)):
        clock[0] += seconds
        log(table, events, step)
    rows = capsys.readouterr().out.splitlines()[2:]
    actual = [row.split("  ")[-1].strip() for row in rows]
    assert actual == ["0 (0.00%)", "3–12 min"]


def test_bounds_of_the_time_left_have_one_unit():
    assert early_time_left(9, 100, 0.5) == "", "less than a minute"
    assert early_time_left(9, 90, 1.0) == "40–160 s"
    assert early_time_left(9, 1000, 1.0) == "8–33 min"
    assert early_time_left(9, 1000, 10.0) == "1.4–5.5 h"


def test_after_densification_the_time_left_goes_by_the_latest_rows(
    events: list[dict[str, Any]], clock: list[float], capsys: pytest.CaptureFixture[str]
):
    table = ProgressTable(LocalWriterConfig())
    for step, seconds in ((60, 0.0), (70, 10.0), (80, 10.0)):
        clock[0] += seconds
        log(table, events, step)
    actual = capsys.readouterr().out.splitlines()[-1].split()[-4:]
    assert actual == ["1.0", "s", "19", "s"]


@pytest.mark.hard_case(
    "a resumed run", "reports the iteration at which it goes on, and its time left by the iterations since then"
)
def test_the_time_left_of_a_resumed_run_counts_its_own_iterations(
    config: SadgsTrainerConfig,
    tmp_path: Path,
    clock: list[float],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    """It is resumed from iteration 13 of 24, and each takes two seconds of the tests' clock."""
    config.output_dir = tmp_path
    config.max_num_iterations = 24
    config.steps_per_save = 0
    stopped = set_up(config)

    def stop(step: int) -> None:
        if step == 13:
            stopped.stop_training = True

    location = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
    stopped.callbacks.append(TrainingCallback(location, stop))
    stopped.train()
    capsys.readouterr()

    checkpoints = config.get_checkpoint_dir()
    (last,) = checkpoints.glob("step-*.ckpt")
    first = int(last.stem.removeprefix("step-")) + 1
    config.load_dir = checkpoints
    config.logging.local_writer.enable = True
    config.logging.steps_per_log = 4
    reported: list[dict[str, Any]] = []
    monkeypatch.setattr(progress, "report", lambda event, **fields: reported.append({"event": event, **fields}))
    resumed = set_up(config)

    def pass_time(step: int) -> None:
        clock[0] += 2.0

    resumed.callbacks.append(TrainingCallback(location, pass_time))
    resumed.train()
    iterations = [fields for fields in reported if fields["event"] == "iteration"]
    steps = [fields["step"] for fields in iterations]
    assert steps == [first, 16, 20]
    assert iterations[-1]["left"] == "6 s", "three iterations of two seconds"
    shown = re.findall(r"^(\d+) \(.+%\) .*", capsys.readouterr().out, re.MULTILINE)
    assert shown == ["16", "20"]


def test_the_time_left_is_within_30_percent_on_all_captures_whose_times_were_kept():
    results = Path(__file__).parents[3] / "docs/results"
    rows = [
        json.loads(line)
        for name in ("beside-splatfacto", "peers-ours")
        for line in results.joinpath(f"{name}.jsonl").read_text("utf8").splitlines()
    ]
    told: dict[str, int] = {}
    for row in rows:
        if row["method"] != "sadgs" or not row.get("curve"):
            continue
        total = row["iterations"]
        end = row["curve"][-1]["seconds"]
        for before, point in itertools.pairwise([{"step": 0, "seconds": 0.0}, *row["curve"][:-1]]):
            pace = (point["seconds"] - before["seconds"]) / (point["step"] - before["step"])
            left = time_left(-1, point["step"] - 1, total, point["seconds"], before["step"], pace)
            if left is not None:
                off = 0.21 if before["step"] > 0.533 * total else 0.3
                expected = pytest.approx(end - point["seconds"], rel=off)
                assert left == expected, (row["key"], point)
                told[row["scene"]] = told.get(row["scene"], 0) + 1
    assert len(told) == 8
    assert min(told.values()) >= 2
    assert time_left(-1, 99, 1000, 5.0) is None, "too early to tell"
    assert time_left(499, 699, 1000, 5.0) is None, "too early after resuming"


@pytest.mark.hard_case(
    "Gaussians, loss and PSNR while training", "are in every row, and read from the device for rows alone"
)
def test_values_are_read_from_the_device_for_rows_alone(events: list[dict[str, Any]]):
    table = ProgressTable(LocalWriterConfig())
    for step in range(1, 10):
        log(table, events, step, Unread())
    with pytest.raises(RuntimeError, match="Unread"):
        log(table, events, 10, Unread())


@pytest.mark.hard_case("a warning during training, in a terminal", "stands above the table")
def test_in_a_terminal_rows_stay_in_place_and_warnings_above_them(
    events: list[dict[str, Any]], clock: list[float], monkeypatch: pytest.MonkeyPatch
):
    shown = io.StringIO()
    console = Console(file=shown, force_terminal=True, width=120, _environ={"TERM": "xterm"})
    monkeypatch.setattr(progress, "CONSOLE", console)
    table = ProgressTable(LocalWriterConfig(max_log_size=2), ["Viewer at: there"])
    writer.EVENT_WRITERS.append(table)
    for step in range(0, 50, 10):
        log(table, events, step, torch.tensor(0.5))
        clock[0] += 1
    console.print("Iteration 41: the loss was nan", highlight=False)
    print("of nerfstudio")
    log(table, events, 50, torch.tensor(0.5))
    log(table, events, 51)
    assert not shown.getvalue().endswith("\x1b[?25h")
    events[:] = [{"name": EventName.TOTAL_TRAIN_TIME.value, "event": 9.0}]
    table.write_stats_log(100)
    text = shown.getvalue()
    remove_tables()
    assert writer.EVENT_WRITERS == []
    assert shown.getvalue() == text
    assert text.endswith("\x1b[?25h"), "the cursor is shown again"
    # What is printed takes the place of the table, which is drawn anew below it.
    after = text.partition("Iteration 41: the loss was nan\n")[2]
    assert after.index("of nerfstudio\n") < after.index("50 (50.00%)")
    last = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text[text.rindex("Step (% Done)") :]).split()
    assert "30" not in last, "two rows and the banner"
    assert {"40", "50", "Viewer"} <= set(last), "two rows and the banner"


@pytest.mark.hard_case("output to a file", "one line for each row")
@pytest.mark.hard_case("a second run in one process", "has its own table")
@pytest.mark.hard_case(
    "training ends", "the commands ns-viewer, ns-eval and sadgs-export with the run's config.yml, quoted for a shell"
)
def test_a_run_says_its_progress_and_what_can_be_done_with_it(
    config: SadgsTrainerConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    config.output_dir = tmp_path / "my runs"
    config.logging.local_writer.enable = True
    config.logging.steps_per_log = 4
    config.save_config()
    trainer = set_up(config)
    before = trainer.pipeline.model.num_points
    trainer.train()
    printed = capsys.readouterr().out
    rows = re.findall(r"^(\d+) \(.+%\) +\d\.\d{4} +\d+\.\d\d dB +([\d,]+)( .*)?$", printed, re.MULTILINE)
    actual = [int(row[0]) for row in rows]
    expected = list(range(0, ITERATIONS, 4))
    assert actual == expected
    numbers = [int(row[1].replace(",", "")) for row in rows]
    assert numbers[0] == before
    for w in writer.EVENT_WRITERS:
        assert not isinstance(w, ProgressTable), "a later run in this process has a table of its own"
    assert "Train Rays" not in printed
    assert "profiling" not in printed

    gaussians = trainer.pipeline.model.num_points
    box, _, end = printed.partition(f"What can be done with these {gaussians:,} Gaussians:\n")
    assert "Training Finished" in box
    viewer, evaluate, to_ply = [shlex.split(line) for line in end.splitlines()[::2]]
    run = config.get_base_dir()
    assert viewer[0] == "ns-viewer"
    assert tyro.cli(RunViewer, args=viewer[1:]).load_config == run / "config.yml"
    assert evaluate[0] == "ns-eval"
    assert tyro.cli(ComputePSNR, args=evaluate[1:]).load_config == run / "config.yml"
    assert to_ply[0] == "sadgs-export"
    status = export.main(to_ply[1:])
    assert status == 0
    assert (run / "splat.ply").is_file()


def test_the_table_is_there_by_default():
    logging = SadgsTrainerConfig(method_name="sadgs").logging
    assert logging.local_writer.enable
    assert isinstance(logging.local_writer.setup(), ProgressTable)


@pytest.mark.hard_case(
    "a run on the CPU",
    "is warned of at the start: it is slow, and with several threads OMP_NUM_THREADS=1 is quicker beside other work",
)
def test_a_run_on_the_cpu_says_that_it_is_slow_and_what_to_do_beside_other_work(
    config: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    set_up(config)
    printed = capsys.readouterr().out
    assert f"{cpu_notice(2)}\n" in printed
    assert "put OMP_NUM_THREADS=1 before the command" in cpu_notice(2)
    assert "OMP_NUM_THREADS" not in cpu_notice(1)
