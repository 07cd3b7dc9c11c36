"""Runs that are killed and resumed: what SIGKILL, SIGINT, SIGTERM and SIGHUP leave, and what a run goes on from.

Iterations since the last checkpoint are done again, from the same random states and order of views. So on the CPU with
one thread the final checkpoint is bitwise that of an undisturbed run: Gaussians, Adam's moments, statistics and random
states. On a GPU, which sums in no fixed order, they are as far apart as any two runs. `kill_and_resume.py` kills,
resumes and compares.

Tried by hand: with an option turned on that learns something of each view, a resumed run goes on, and what is new
starts anew.
"""

from __future__ import annotations

import dataclasses
import errno
import os
import re
import shlex
import shutil
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import tyro
import yaml
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer
from nerfstudio.scripts.train import main as resume
from nerfstudio.utils import writer

from examples.drawn_scene.scene import SPARSE_FOLDER
from helpers import forked_python, short_runs
from helpers.kill_and_resume import configure, differences, set_up
from helpers.refusals import refusal
from helpers.small_scenes import ITERATIONS
from sadgs_ns.data.cameras import camera_positions
from sadgs_ns.errors import InputError, WriteError
from sadgs_ns.interrupts import SIGNALS
from sadgs_ns.method.schedule import Schedule, schedule
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.run import planning
from sadgs_ns.training.run.checkpoints import checkpoint_paths
from sadgs_ns.training.run.resume import check_same_capture
from sadgs_ns.training.run.trainer import SadgsTrainer


def after(trainer: SadgsTrainer, at: int, act: Callable[[], None]) -> None:
    """Call `act` at the end of an iteration, after densification."""
    location = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
    trainer.callbacks.append(TrainingCallback(location, lambda step: act() if step == at else None))


def send(number: int) -> None:
    os.kill(os.getpid(), number)


def checkpoints(trainer: SadgsTrainer) -> list[str]:
    return sorted(path.name for path in trainer.checkpoint_dir.glob("*"))


def one_line(text: str, start: str) -> str:
    """Return the only line that begins so."""
    (line,) = (line for line in text.splitlines() if line.startswith(start))
    return line


def kill_and_resume(*arguments: object) -> str:
    """Run the script and return its output."""
    words = [str(word) for word in arguments]
    script = f"import sys; from helpers import kill_and_resume; sys.exit(kill_and_resume.main({words}))"
    result = forked_python.python(script, timeout=1800)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


# --- killed ---


@pytest.mark.hard_case(
    "SIGKILL within a step, right after a split, with half a checkpoint written, between a checkpoint's "
    "renaming and the deletion of the one before it",
    "resumes from the last whole checkpoint; ends bitwise equal to an undisturbed run",
)
def test_a_run_killed_in_four_places_ends_bitwise_equal_to_one_that_nothing_disturbed(tmp_path: Path):
    sizes = ("--kills", 4, "--iterations", 24, "--save-every", 4, "--width", 48, "--views", 10)
    printed = kill_and_resume(tmp_path, *sizes)
    actual = re.findall(r"kill \d: .*, (.*), iteration .*: exit -9", printed)
    assert actual == [
        "within a step",
        "after a split",
        "saving",
        "after renaming",
    ]
    assert "bitwise equal; left over: []" in printed


@pytest.mark.hard_case(
    "ten kills in 90 iterations (slow): two in each of those places, one after a step and one from outside at "
    "a random time",
    "the same; nothing is left over",
)
@pytest.mark.slow
def test_a_run_killed_ten_times_ends_bitwise_equal_to_one_that_nothing_disturbed(tmp_path: Path):
    sizes = ("--kills", 10, "--iterations", 90, "--save-every", 6, "--width", 48, "--views", 10)
    printed = kill_and_resume(tmp_path, *sizes)
    assert printed.count("exit -9") == 10
    assert "bitwise equal; left over: []" in printed


# --- checkpoints by the clock ---


@dataclass
class Clock:
    """Stands in for the trainer's clock: an iteration takes 25 s, a checkpoint 2 s."""

    now: float = 1000.0
    saved: list[int] = field(default_factory=list)

    def attach(self, trainer: SadgsTrainer, monkeypatch: pytest.MonkeyPatch, seconds: float = 25.0) -> None:
        save = torch.save

        def slow_save(state: dict[str, Any], path: Path) -> None:
            save(state, path)
            self.saved.append(state["step"])
            self.now += 2

        def tick(step: int) -> None:
            self.now += seconds

        trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], tick))
        monkeypatch.setattr(torch, "save", slow_save)
        monkeypatch.setattr("sadgs_ns.training.run.trainer.time", SimpleNamespace(monotonic=lambda: self.now))


@pytest.mark.hard_case(
    "SIGKILL of a run without `--steps-per-save`",
    "at most the last 60 s, or 100 times what a checkpoint takes, are lost; checkpoints on the way change no "
    "result, and a run resumed from one ends bitwise equal",
)
def test_the_clock_makes_checkpoints_that_change_nothing_and_resume_to_the_same_model(
    scene: Path, finished: Path, config: SadgsTrainerConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    assert config.steps_per_save == 0
    assert config.seconds_per_save == 60
    config.save_only_latest_checkpoint = False
    trainer = set_up(config)
    with monkeypatch.context() as patched:
        clock = Clock()
        clock.attach(trainer, patched)
        trainer.train()
    # Due after 60 s, and then after 200 s, since a checkpoint takes 2 s.
    assert clock.saved == [2, 10, ITERATIONS - 1]
    assert checkpoints(trainer) == [f"step-{step:09d}.ckpt" for step in clock.saved]

    resumed_config = configure(scene, tmp_path / "resumed", ITERATIONS, save_every=0)
    resumed_config.load_dir = trainer.checkpoint_dir
    resumed_config.load_step = 2
    resumed = set_up(resumed_config)
    resumed.train()
    (last,) = (finished / "nerfstudio_models").iterdir()
    assert [last.name] == checkpoints(resumed) == [f"step-{ITERATIONS - 1:09d}.ckpt"]
    folders = (trainer.checkpoint_dir, last.parent, resumed.checkpoint_dir)
    ends = [torch.load(folder / last.name, weights_only=True) for folder in folders]
    assert differences(ends[0], ends[1]) == differences(ends[0], ends[2]) == []


@pytest.mark.hard_case("checkpoints by the clock where `--steps-per-save` is given, and in a short run", "none")
@pytest.mark.parametrize(
    ("settings", "seconds", "saved"),
    [
        ({}, 4.0, [ITERATIONS - 1]),
        ({"seconds_per_save": 0.0}, 1000.0, [ITERATIONS - 1]),
        ({"steps_per_save": 5}, 1000.0, [5, 10, ITERATIONS - 1]),
        ({"steps_per_save": 5, "seconds_per_save": 1.0}, 1000.0, [5, 10, ITERATIONS - 1]),
    ],
)
def test_the_clock_gives_way_to_steps_and_makes_nothing_in_a_short_run(
    settings: dict[str, Any],
    seconds: float,
    saved: list[int],
    config: SadgsTrainerConfig,
    monkeypatch: pytest.MonkeyPatch,
):
    for name, value in settings.items():
        setattr(config, name, value)
    trainer = set_up(config)
    clock = Clock()
    clock.attach(trainer, monkeypatch, seconds)
    trainer.train()
    assert clock.saved == saved


# --- interrupted ---


@pytest.mark.hard_case(
    "Ctrl-C on `ns-train`",
    "the iteration ends, a checkpoint is saved, one line gives the command that resumes with all options, "
    "`ns-train METHOD --load-config RUN/config.yml`; exit code 130; that command is run and finishes in the "
    "same folder",
)
def test_ctrl_c_on_ns_train_prints_the_command_that_resumes_it(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    iterations = 60
    command = ["ns-train", "sadgs", "--output-dir", str(tmp_path), "--experiment-name", "a run", "--timestamp", "first"]
    command += ["--max-num-iterations", str(iterations), "--steps-per-save", "5", "--vis", "tensorboard"]
    command += ["--pipeline.model.strategy.refine-stop-iter", "0", "--machine.device-type", "cpu"]
    command += ["colmap", "--data", str(scene), "--colmap-path", str(SPARSE_FOLDER), "--downscale-factor", "1"]
    folder = tmp_path / "a run/sadgs/first/nerfstudio_models"
    files = tmp_path / "output", tmp_path / "errors"
    program = forked_python.NS_TRAIN.format(command)  # It does not matter where pip has put the script ns-train.
    process = forked_python.start(forked_python.into_files, files, program, dict(os.environ))
    try:
        deadline = time.monotonic() + forked_python.HANGS
        while not list(folder.glob("*.ckpt")) and process.is_alive() and time.monotonic() < deadline:
            time.sleep(0.01)
        os.kill(process.pid, signal.SIGINT)
        process.join(forked_python.HANGS)
        printed, errors = (file.read_text() for file in files)
        assert process.exitcode == 130, printed + errors
    finally:
        process.kill()
    assert "Traceback" not in printed + errors
    line = one_line(printed, "SIGINT")
    (path,) = folder.iterdir()
    done = torch.load(path, weights_only=True)["step"] + 1
    assert 5 < done < iterations
    assert line.startswith(f"SIGINT: stopped and saved after {done} of {iterations} iterations; resume with: ns-train ")
    words = shlex.split(line.partition("resume with: ")[2])
    assert words == ["ns-train", "sadgs", "--load-config", str(folder.with_name("config.yml"))]
    resume(tyro.cli(AnnotatedBaseConfigUnion, args=words[1:]))  # in this process, which has imported everything
    assert f"Resuming after step {done - 1} of {path}" in capsys.readouterr().out
    names = [p.name for p in folder.iterdir()]
    assert names == [f"step-{iterations - 1:09d}.ckpt"]


@pytest.fixture
def hang_up_by_default() -> Iterator[None]:
    """Where the tests themselves run under nohup, SIGHUP is ignored, and would be by the runs."""
    previous = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, previous)


@pytest.mark.hard_case(
    "SIGINT, SIGTERM or SIGHUP in the middle of a step that splits",
    "waits for the step's end, saves, exits with 130, 143 or 129; resumed, it ends bitwise equal to an undisturbed run",
)
@pytest.mark.usefixtures("hang_up_by_default")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupt_within_a_step_waits_for_its_end_and_resumes_to_the_same_model(
    number: signal.Signals, finished: Path, config: SadgsTrainerConfig, capsys: pytest.CaptureFixture[str]
):
    trainer = set_up(config)
    next_views = trainer.pipeline.next_views

    def interrupted(step: int) -> Any:
        if step == 4:  # ends with a structure split
            send(number)
        return next_views(step)

    trainer.pipeline.next_views = interrupted  # type: ignore[method-assign]
    handlers = [signal.getsignal(n) for n in SIGNALS]
    with pytest.raises(SystemExit) as stopped:
        trainer.train()
    assert stopped.value.code == 128 + number
    actual = [signal.getsignal(n) for n in SIGNALS]
    assert actual == handlers
    assert checkpoints(trainer) == ["step-000000004.ckpt"]
    line = one_line(capsys.readouterr().out, number.name)
    assert line == (
        f"{number.name}: stopped and saved after 5 of {ITERATIONS} iterations; "
        f"resume with: ns-train sadgs --load-config {trainer.base_dir / 'config.yml'}"
    )

    resumed = set_up(yaml.load((trainer.base_dir / "config.yml").read_text(), Loader=yaml.Loader))
    resumed.train()
    (whole,) = (finished / "nerfstudio_models").iterdir()
    ends = [torch.load(path, weights_only=True) for path in (whole, resumed.checkpoint_dir / whole.name)]
    assert differences(*ends) == []


@pytest.mark.hard_case("a second SIGHUP while the run saves", "what was trained is saved")
@pytest.mark.usefixtures("hang_up_by_default")
def test_a_second_hang_up_does_not_stop_the_saving(config: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch):
    """Where ssh is cut off, the shell sends one, and the kernel another when the shell ends."""
    trainer = set_up(config)
    for _ in range(2):
        after(trainer, 3, lambda: send(signal.SIGHUP))
    save = torch.save

    def hung_up(*arguments: Any) -> None:
        send(signal.SIGHUP)
        save(*arguments)

    monkeypatch.setattr(torch, "save", hung_up)
    with pytest.raises(SystemExit) as stopped:
        trainer.train()
    assert stopped.value.code == 128 + signal.SIGHUP
    assert checkpoints(trainer) == ["step-000000003.ckpt"]
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_DFL


@pytest.mark.hard_case("a write to the terminal fails before SIGHUP comes", "what was trained is saved, SIGHUP or not")
@pytest.mark.usefixtures("hang_up_by_default")
def test_a_hang_up_that_follows_a_failed_write_does_not_stop_the_saving(
    config: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch
):
    trainer = set_up(config)
    save = torch.save
    update = trainer._update_viewer_state

    def lost(step: int) -> None:
        update(step)
        if step == 3:
            raise OSError(errno.EIO, "Input/output error")

    def hung_up(*arguments: Any) -> None:
        assert signal.getsignal(signal.SIGHUP) != signal.SIG_DFL, "it would end this process"
        send(signal.SIGHUP)
        save(*arguments)

    monkeypatch.setattr(trainer, "_update_viewer_state", lost)
    monkeypatch.setattr(torch, "save", hung_up)
    with pytest.raises(WriteError, match=r"could not be written \(Input/output error; "):
        trainer.train()
    assert checkpoints(trainer) == ["step-000000003.ckpt"]


def in_terminal_under_nohup(*arguments: Any) -> None:
    """Force what the tests' processes inherit where pytest runs under nohup; for `forked_python.start`."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    forked_python.in_terminal(*arguments)


def printing_run(scene: Path, output: Path, iterations: int) -> str:
    """A program that trains and prints a row of the table of progress every tenth iteration."""
    return (
        "import sys; from pathlib import Path; from helpers.kill_and_resume import configure, set_up\n"
        f"config = configure(Path({str(scene)!r}), Path({str(output)!r}), {iterations}, save_every=0)\n"
        "config.logging.local_writer.enable, config.pipeline.model.strategy.refine_stop_iter = True, 0\n"
        "trainer = set_up(config); trainer.train()\n"
    )


@pytest.mark.hard_case(
    "the terminal is gone (a dropped ssh; SIGHUP), also while the table is drawn",
    "what was trained is saved; exit code 129",
)
def test_a_terminal_that_is_gone_costs_nothing_that_was_trained(scene: Path, tmp_path: Path):
    """As where ssh is cut off: the run loses the terminal that it prints to, and is sent SIGHUP."""
    ours, theirs = os.openpty()
    script = printing_run(scene, tmp_path, 5000)
    process = forked_python.start(in_terminal_under_nohup, os.ttyname(theirs), script, dict(os.environ))
    try:
        printed = b""
        while b"10 (0.20%)" not in printed:  # a line of the table of progress
            printed += os.read(ours, 4096)
        os.close(theirs)
        os.close(ours)
        process.join(forked_python.HANGS)
        assert process.exitcode == 128 + signal.SIGHUP, printed.decode()
    finally:
        process.kill()
    (path,) = tmp_path.rglob("*.ckpt")
    assert torch.load(path, weights_only=True)["step"] > 0


@pytest.mark.hard_case("the terminal goes while the run saves", "what was trained is saved")
def test_a_terminal_that_goes_while_the_hung_up_run_saves_hides_nothing(scene: Path, tmp_path: Path):
    """As where the system sends SIGHUP before it takes the terminal away."""
    ours, theirs = os.openpty()
    saving = tmp_path / "saving"
    gone = tmp_path / "gone"
    script = "import time, torch; save = torch.save\n"
    script += f"from pathlib import Path; saving, gone = Path({str(saving)!r}), Path({str(gone)!r})\n"
    script += "def wait_and_save(*arguments):\n"
    script += "    saving.touch()\n    while not gone.exists(): time.sleep(0.01)\n    save(*arguments)\n"
    script += "torch.save = wait_and_save\n" + printing_run(scene, tmp_path, 5000)
    process = forked_python.start(in_terminal_under_nohup, os.ttyname(theirs), script, dict(os.environ))
    try:
        printed = b""
        while b"10 (0.20%)" not in printed:
            printed += os.read(ours, 4096)
        os.kill(process.pid, signal.SIGHUP)
        deadline = time.monotonic() + forked_python.HANGS
        while not saving.exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        os.close(theirs)
        os.close(ours)
        gone.touch()
        process.join(forked_python.HANGS)
        assert process.exitcode == 128 + signal.SIGHUP, printed.decode()
    finally:
        process.kill()
    (path,) = tmp_path.rglob("*.ckpt")
    config = yaml.load(path.parent.with_name("config.yml").read_text(), Loader=yaml.Loader)
    assert config.load_dir == path.parent


@pytest.mark.hard_case(
    "the reader of the output ends: `| head`, or `| tee log` with `tee` killed",
    "the run trains on and ends with exit code 0; it prints where errors go, or nowhere if they went to the "
    "same reader",
)
@pytest.mark.parametrize("errors", ["elsewhere", "to the same reader", "closed"])
def test_a_run_whose_output_nobody_reads_any_more_trains_on(errors: str, scene: Path, tmp_path: Path):
    """As with `| head`, or with `| tee log` where tee is killed."""
    output = tmp_path / "output"
    iterations = 40
    files = output, output if errors == "to the same reader" else tmp_path / "errors"
    os.mkfifo(output)
    script = "import os, sys; os.close(2); sys.stderr = None\n" if errors == "closed" else ""
    script += printing_run(scene, tmp_path, iterations)
    process = forked_python.start(forked_python.into_files, files, script, dict(os.environ))
    try:
        read = read_until("10 (25.00%)", output)
        process.join(forked_python.HANGS)
        assert process.exitcode == 0, read
    finally:
        process.kill()
    (path,) = tmp_path.rglob("*.ckpt")
    assert torch.load(path, weights_only=True)["step"] == iterations - 1
    if errors == "elsewhere":
        printed = files[1].read_text()
        rows = re.findall(r"^(\d+) \(\d", printed, re.MULTILINE)
        assert rows
        expected = [str(step) for step in range(40 - 10 * len(rows), 40, 10)]
        assert rows == expected
        assert printed.count("What can be done with these") == 1


@pytest.mark.hard_case(
    "Ctrl-C on `ns-train … | tee log`, which ends `tee`, too",
    "saves, exit code 130; the line that resumes is printed where errors go",
)
def test_ctrl_c_that_ends_tee_as_well_costs_nothing_that_was_trained(scene: Path, tmp_path: Path):
    """`ns-train | tee log`: both get the signal, and tee ends first."""
    files = output, errors = tmp_path / "output", tmp_path / "errors"
    os.mkfifo(output)
    script = printing_run(scene, tmp_path, 5000)
    process = forked_python.start(forked_python.into_files, files, script, dict(os.environ))
    try:
        read = read_until("10 (0.20%)", output)
        os.kill(process.pid, signal.SIGINT)
        process.join(forked_python.HANGS)
        assert process.exitcode == 128 + signal.SIGINT, read
    finally:
        process.kill()
    (path,) = tmp_path.rglob("*.ckpt")
    assert torch.load(path, weights_only=True)["step"] > 0
    assert "resume with: ns-train sadgs" in one_line(errors.read_text(), "SIGINT: stopped and saved after")


def read_until(start: str, pipe: Path) -> str:
    """Read what a process writes to a named pipe until a line begins so, or it ends, and close the pipe."""
    lines: list[str] = []
    with pipe.open() as file:
        for line in file:
            lines.append(line)
            if line.startswith(start):
                break
    return "".join(lines)


@pytest.mark.hard_case("Ctrl-C while the data are loaded", "one line, exit code 130")
def test_ctrl_c_while_the_data_are_loaded_ends_without_a_traceback(
    config: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(SadgsTrainer, "setup_optimizers", lambda _: send(signal.SIGINT))
    with pytest.raises(SystemExit) as stopped:
        set_up(config)
    assert stopped.value.code == 130
    line = one_line(capsys.readouterr().out, "SIGINT")
    assert line == "SIGINT: stopped before an iteration was done; the same command starts again."


@pytest.mark.hard_case(
    "Ctrl-C while paused, before the first iteration", "says that the same command starts again; writes nothing"
)
def test_an_interrupt_while_paused_before_the_first_iteration_leaves_nothing(
    config: SadgsTrainerConfig, capsys: pytest.CaptureFixture[str]
):
    config.start_paused = True
    trainer = set_up(config)
    timer = threading.Timer(0.3, send, [signal.SIGINT])
    timer.start()
    with pytest.raises(SystemExit) as stopped:
        trainer.train()
    timer.join()
    assert stopped.value.code == 130
    printed = capsys.readouterr().out
    assert "before an iteration was done; the same command starts again" in printed
    assert checkpoints(trainer) == []


@pytest.mark.hard_case(
    "Ctrl-C in the final save, or while the viewer waits after it", "the final checkpoint is there; exit code 0"
)
@pytest.mark.parametrize("moment", ["final save", "waiting for the viewer's user"])
def test_an_interrupt_after_the_last_iteration_ends_a_finished_run_without_an_error(
    moment: str, config: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    trainer = set_up(config)
    owner, name = (torch, "save") if moment == "final save" else (Trainer, "_train_complete_viewer")
    original = getattr(owner, name)
    calls = []

    def interrupted(*arguments: Any) -> Any:
        calls.append(arguments)
        if len(calls) == 1:
            send(signal.SIGINT)
        return original(*arguments)

    monkeypatch.setattr(owner, name, interrupted)
    trainer.train()
    assert calls
    assert checkpoints(trainer) == [f"step-{ITERATIONS - 1:09d}.ckpt"]
    printed = capsys.readouterr().out
    assert "SIGINT" not in printed


@pytest.mark.hard_case("a second Ctrl-C", "stops at once, as nerfstudio does; the previous checkpoint stays")
def test_a_second_interrupt_stops_at_once_as_without_us(config: SadgsTrainerConfig):
    trainer = set_up(config)
    for _ in range(2):
        after(trainer, 3, lambda: send(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt) as stopped:
        trainer.train()
    assert type(stopped.value) is KeyboardInterrupt
    assert checkpoints(trainer) == []


@pytest.mark.hard_case("a program that handles SIGTERM itself", "its handler stays")
def test_a_handler_that_the_program_has_for_sigterm_stays(config: SadgsTrainerConfig):
    received: list[int] = []
    previous = signal.signal(signal.SIGTERM, lambda number, _: received.append(number))
    try:
        trainer = set_up(config)
        after(trainer, 3, lambda: send(signal.SIGTERM))
        trainer.train()
    finally:
        signal.signal(signal.SIGTERM, previous)
    assert received == [signal.SIGTERM]
    assert checkpoints(trainer) == [f"step-{ITERATIONS - 1:09d}.ckpt"]


# --- finished runs ---


@pytest.fixture(scope="module")
def finished(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that is finished."""
    trainer = set_up(configure(scene, tmp_path_factory.mktemp("finished"), ITERATIONS, save_every=0))
    trainer.train()
    return trainer.base_dir


@pytest.mark.hard_case(
    "a finished run opened with `--load-dir` or `--load-checkpoint`, with or without the viewer",
    "says how to train on, ends well, changes nothing",
)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of viser and websockets
@pytest.mark.parametrize(("option", "vis"), [("load_dir", "tensorboard"), ("load_checkpoint", "viewer")])
def test_opening_a_finished_run_says_how_to_train_on_and_ends_well(
    option: str,
    vis: str,
    finished: Path,
    config: SadgsTrainerConfig,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    (saved,) = (finished / "nerfstudio_models").iterdir()
    setattr(config, option, finished if option == "load_dir" else saved)
    config.vis = vis  # type: ignore[assignment]
    config.viewer.quit_on_train_completion = True
    config.logging.local_writer.enable = True
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        config.viewer.websocket_port = free.getsockname()[1]  # nerfstudio's own search leaves a socket open
    monkeypatch.delitem(writer.GLOBAL_BUFFER, "step", raising=False)  # as in a process that has not trained
    monkeypatch.setattr(writer, "EVENT_WRITERS", [])
    config.save_config()
    trainer = set_up(config)
    try:
        trainer.train()
    finally:
        trainer.shutdown()
    line = one_line(capsys.readouterr().out, "This run is finished")
    assert line == (
        f"This run is finished after {ITERATIONS} iterations: --max-num-iterations of more than {ITERATIONS} trains on."
    )
    ends = [torch.load(path / saved.name, weights_only=True) for path in (saved.parent, trainer.checkpoint_dir)]
    assert differences(*ends) == []


@pytest.mark.hard_case("`--load-dir RUN` instead of `RUN/nerfstudio_models`", "works as well")
def test_a_run_s_folder_does_as_well_as_its_folder_of_checkpoints(finished: Path, config: SadgsTrainerConfig):
    (saved,) = (finished / "nerfstudio_models").iterdir()
    for folder in (finished, saved.parent):
        for step in (None, ITERATIONS - 1):
            assert checkpoint_paths(folder, step, None) == [saved]
    config.load_dir = finished
    config.save_config()
    assert set_up(config)._start_step == ITERATIONS


@pytest.mark.hard_case(
    "`--timestamp` of a run that has checkpoints; `--load-config` of a killed run",
    "refused, and the checkpoints stay: `--load-dir` goes on from them",
)
def test_checkpoints_of_an_earlier_run_are_not_deleted(finished: Path, config: SadgsTrainerConfig, tmp_path: Path):
    """As where --timestamp names a finished run, or --load-config a run that was killed and so names no checkpoint."""
    (saved,) = (finished / "nerfstudio_models").iterdir()
    config.output_dir = finished.parents[2]
    elsewhere = tmp_path / "elsewhere"
    assert config.get_base_dir() == finished
    elsewhere.mkdir()
    shutil.copy(saved, elsewhere)
    for config.load_dir in (None, elsewhere):
        with pytest.raises(InputError) as refused:
            config.save_config()
        assert str(refused.value) == (
            f"{saved.parent} holds {saved.name} of an earlier run, which this run would delete: go on from it with "
            f"--load-dir {finished} (load_dir in a config.yml), give another --timestamp, or remove it."
        )
    for config.load_dir, config.load_checkpoint in ((finished, None), (saved.parent, None), (None, saved)):
        config.save_config()
    (finished / "config.yml").unlink()


# --- other data than the checkpoint's ---


@pytest.mark.hard_case(
    "another scene's checkpoint; the same data at another scale or orientation",
    "refused: how many of its cameras stand where one of these does",
)
def test_a_checkpoint_of_another_capture_is_refused(finished: Path, tmp_path: Path):
    other = short_runs.configure(tmp_path, short_runs.nerfstudio_data(tmp_path / "data"))
    other.load_dir = finished
    with pytest.raises(InputError) as refused:
        set_up(other)
    assert re.fullmatch(
        rf"{finished}/\S+\.ckpt cannot be continued: It was trained on other data, or with other options of the "
        r"parser: of its 8 cameras \(001\.png, …\) none stand where one of these 9 \(\d+\.png, …\) does; give "
        r"--load-dir the folder of a run of sadgs, or train from scratch\.",
        str(refused.value),
    )


@pytest.mark.hard_case("a checkpoint after views were added or taken away in the same world", "goes on")
@pytest.mark.parametrize(
    ("options", "goes_on"),
    [
        ({"scale_factor": 2.0}, False),
        ({"orientation_method": "none"}, False),
        ({"eval_mode": "all"}, True),
        ({"eval_mode": "fraction", "train_split_fraction": 0.5}, True),
    ],
)
def test_a_checkpoint_goes_on_with_more_or_fewer_views_of_its_world_alone(
    options: dict[str, Any], goes_on: bool, finished: Path, config: SadgsTrainerConfig
):
    parser: Any = config.pipeline.datamanager.dataparser
    config.pipeline.datamanager.dataparser = dataclasses.replace(parser, **options)
    config.load_dir = finished
    if goes_on:
        assert set_up(config)._start_step == ITERATIONS
    else:
        with refusal(r"of its 8 cameras \(001\.png, …\) none stand where one of these 8 \("):
            set_up(config)


def length_of(trainer: SadgsTrainer) -> Schedule:
    plan = trainer.pipeline.model.plan
    return Schedule(plan.iterations, plan.views_per_iteration)


def test_a_resumed_run_keeps_the_length_that_was_derived_unless_another_is_asked_for(
    config: SadgsTrainerConfig, tmp_path: Path
):
    config.max_num_iterations = None
    trainer = set_up(config)
    trainer.save_checkpoint(0)
    derived = length_of(trainer)
    config.load_dir = trainer.checkpoint_dir
    config.output_dir = tmp_path / "resumed"
    parser: Any = config.pipeline.datamanager.dataparser
    config.pipeline.datamanager.dataparser = dataclasses.replace(parser, eval_mode="all")  # It has more views.
    assert length_of(set_up(config)) == derived

    config.pipeline.effort = 2.0
    views = len(set_up(config).pipeline.datamanager.train_dataset)
    assert length_of(set_up(config)) == schedule(views, effort=2.0) != derived
    config.pipeline.effort = 1.0
    config.max_num_iterations = 7
    config.pipeline.views_per_iteration = 3
    actual = length_of(set_up(config))
    assert actual == Schedule(iterations=7, views_per_iteration=3)


@pytest.mark.hard_case(
    "a checkpoint with matrices of colours or poses, resumed without them or with other views",
    "refused: the options, the number of views",
)
def test_what_is_learned_of_each_view_goes_on_with_the_same_views_and_options_alone(
    config: SadgsTrainerConfig, tmp_path: Path
):
    config.pipeline.model.color_model = "affine"
    trainer = set_up(config)
    trainer.save_checkpoint(1)
    config.load_dir = trainer.checkpoint_dir
    config.output_dir = tmp_path / "resumed"
    assert set_up(config)._start_step == 2
    config.pipeline.model.color_model = "none"
    with refusal(r"It optimized color_matrices, too: set pipeline\.model\.color-model "):
        set_up(config)
    config.pipeline.model.color_model = "affine"
    parser: Any = config.pipeline.datamanager.dataparser
    config.pipeline.datamanager.dataparser = dataclasses.replace(parser, eval_mode="all")
    with refusal(r"\S+color_matrices is for 8 training views, and there are 10: set the"):
        set_up(config)


@pytest.mark.hard_case(
    "a checkpoint with matrices of colours, resumed with as many views, of which some are others",
    "refused: each matrix belongs to a photo",
)
def test_what_is_learned_of_each_view_is_not_given_to_another(config: SadgsTrainerConfig, tmp_path: Path):
    config.pipeline.model.color_model = "affine"
    trainer = set_up(config)
    trainer.save_checkpoint(1)
    (checkpoint,) = trainer.checkpoint_dir.iterdir()
    state = torch.load(checkpoint, weights_only=True)
    positions = state["pipeline"]["_extra_state"]["camera_positions"]
    state["pipeline"]["_extra_state"]["camera_positions"] = positions.roll(1, dims=0)
    torch.save(state, checkpoint)
    config.load_dir = trainer.checkpoint_dir
    config.output_dir = tmp_path / "resumed"
    with refusal(r"\S+color_matrices is for other training views, or for these in another order: choose them"):
        set_up(config)


@pytest.mark.hard_case(
    "a run is resumed with another number of views a step, or with other learning rates",
    "it goes on with the rates that its plan names, at its iteration",
)
@pytest.mark.parametrize(("before", "now"), [(4, 1), (1, 4), (2, 2)])
def test_a_resumed_run_has_the_rates_of_its_plan(
    before: int, now: int, config: SadgsTrainerConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    config.pipeline.views_per_iteration = before
    trainer = short_runs.train(config)
    config.load_dir = trainer.checkpoint_dir
    config.output_dir = tmp_path / "resumed"
    config.max_num_iterations = 2 * ITERATIONS
    config.pipeline.views_per_iteration = now
    config.optimizers["features_dc"]["optimizer"].lr = 0.25
    capsys.readouterr()
    resumed = set_up(config)
    printed = " ".join(capsys.readouterr().out.split())
    assert "optimizers.features_dc.optimizer.lr was 0.0025 and is 0.25" in printed
    plan = resumed.pipeline.model.plan
    adams = resumed.optimizers.optimizers
    assert plan.rates["features_dc"].lr == 0.25
    for name, rate in plan.rates.items():
        expected = rate.lr
        if name in resumed.optimizers.schedulers:
            scheduler = resumed.optimizers.schedulers[name]
            assert scheduler.last_epoch == ITERATIONS
            expected *= scheduler.lr_lambdas[0](ITERATIONS)
        assert adams[name].param_groups[0]["lr"] == pytest.approx(expected)
        assert "exp_avg" in adams[name].state[adams[name].param_groups[0]["params"][0]]
    assert ("quats" in resumed.optimizers.schedulers) == (now > 1)


@pytest.mark.hard_case("a checkpoint of the same cameras with images of other names (a rig)", "goes on with a warning")
def test_images_with_other_names_at_the_same_cameras_are_told_of(
    finished: Path, config: SadgsTrainerConfig, capsys: pytest.CaptureFixture[str]
):
    config.load_dir = finished
    trainer = set_up(config)
    pipeline = trainer.pipeline
    known = [path.name for path in pipeline.datamanager.train_dataset.image_filenames]
    positions = camera_positions(pipeline.datamanager.train_dataset.cameras)
    printed = capsys.readouterr().out
    assert "same cameras" not in printed
    files: Any = trainer.pipeline.datamanager.train_dataset.image_filenames
    files[:] = [path.with_name(f"of_another_{path.name}") for path in files]
    check_same_capture(pipeline, known, positions)
    line = one_line(capsys.readouterr().out, "The checkpoint's run")
    assert line.endswith(
        "(001.png and of_another_001.png are the first): the Gaussians fit only if the images were renamed."
    )
    files[:] = [path.with_name(path.name.removeprefix("of_another_")).with_suffix(".jpg") for path in files]
    check_same_capture(pipeline, known, positions)
    printed = capsys.readouterr().out
    assert "same cameras" not in printed


# --- the cap that the device's memory gives ---


@pytest.fixture
def plan(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Lets the memory plan of the next runs allow so many Gaussians, unless they ask for another cap themselves."""

    def allow(cap: int) -> None:
        def fit(asked: int, *_: Any) -> tuple[int, str]:
            return min(cap, asked) if asked == 2000 else asked, ""  # These tests' runs ask for 2000.

        monkeypatch.setattr(planning, "fit_to_memory", fit)

    return allow


@pytest.mark.hard_case(
    "more, or less, of the GPU's memory is free than when the run began",
    "the cap stays as it was, or is what the line on the GPU's memory says",
)
@pytest.mark.parametrize(
    ("now", "asked", "cap", "said"),
    [
        (500, 2000, 500, ""),
        (1500, 2000, 500, "At most 500 Gaussians, as in the checkpoint's run."),
        (300, 2000, 300, ""),
        (1500, 900, 900, "pipeline.model.strategy.max_gaussians was 2000 and is 900."),
    ],
)
def test_a_resumption_keeps_the_cap_where_memory_has_room_for_it(
    now: int,
    asked: int,
    cap: int,
    said: str,
    config: SadgsTrainerConfig,
    plan: Callable[[int], None],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    plan(500)
    trainer = set_up(config)
    trainer.save_checkpoint(1)
    assert trainer.pipeline.model.plan.strategy.max_gaussians == 500
    plan(now)
    config.load_dir = trainer.checkpoint_dir
    config.output_dir = tmp_path / "resumed"
    config.pipeline.model.strategy.max_gaussians = asked
    capsys.readouterr()
    resumed = set_up(config)
    printed = capsys.readouterr().out
    assert resumed.pipeline.model.plan.strategy.max_gaussians == cap
    assert resumed.pipeline.structure.set_max_gaussians.value == cap
    assert said in printed
    assert said or "checkpoint's run" not in printed


def test_a_resumption_with_more_gaussians_than_the_cap_says_that_they_stay(
    config: SadgsTrainerConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    trainer = set_up(config)
    trainer.save_checkpoint(1)
    count = trainer.pipeline.model.num_points
    config.load_dir = trainer.checkpoint_dir
    config.output_dir = tmp_path / "resumed"
    config.pipeline.model.strategy.max_gaussians = count - 1
    capsys.readouterr()
    assert set_up(config).pipeline.model.num_points == count
    printed = " ".join(capsys.readouterr().out.split())
    assert (
        f"The checkpoint has {count:,} Gaussians, more than the {count - 1:,} allowed: none is taken away." in printed
    )


# --- damaged checkpoints ---


@pytest.fixture
def two_checkpoints(config: SadgsTrainerConfig) -> tuple[SadgsTrainerConfig, Path]:
    """A config that resumes from a folder that holds steps 1 and 2."""
    config.save_only_latest_checkpoint = False
    trainer = set_up(config)
    trainer.save_checkpoint(1)
    trainer.save_checkpoint(2)
    config.load_dir = trainer.checkpoint_dir
    return config, trainer.checkpoint_dir


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip_bits(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "cut in half": truncate,
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("no checkpoint\n" * 99),
    "of something else": lambda path: torch.save({"epoch": 3}, path),
    "flipped bits": flip_bits,
}


@pytest.mark.hard_case(
    "the latest checkpoint is truncated, empty, no checkpoint, or has flipped bits",
    "a warning names it, the one before it is taken",
)
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_named_and_the_one_before_it_taken(
    damage: str, two_checkpoints: tuple[SadgsTrainerConfig, Path], capsys: pytest.CaptureFixture[str]
):
    config, folder = two_checkpoints
    DAMAGES[damage](folder / "step-000000002.ckpt")
    assert set_up(config)._start_step == 2
    line = one_line(capsys.readouterr().out, str(folder / "step-000000002.ckpt"))
    assert line.endswith(f"Going on from {folder / 'step-000000001.ckpt'} instead.")


@pytest.mark.hard_case("every checkpoint is damaged", "one sentence")
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_checkpoints_alone_are_one_sentence(
    damage: str, two_checkpoints: tuple[SadgsTrainerConfig, Path], capsys: pytest.CaptureFixture[str]
):
    config, folder = two_checkpoints
    for path in folder.iterdir():
        DAMAGES[damage](path)
    with pytest.raises(ValueError) as error:
        set_up(config)
    message = str(error.value)
    assert message.startswith(str(folder / "step-000000002.ckpt"))
    assert message.endswith("or train from scratch.")
    assert "\n" not in message
    printed = capsys.readouterr().out
    assert "Going on" not in printed


@pytest.mark.hard_case(
    "the damaged one was asked for with `--load-step` or `--load-checkpoint`",
    "one sentence; no other is taken silently",
)
@pytest.mark.parametrize("which", ["load_step", "load_checkpoint"])
def test_a_damaged_checkpoint_that_was_asked_for_is_not_replaced_by_another(
    which: str, two_checkpoints: tuple[SadgsTrainerConfig, Path]
):
    config, folder = two_checkpoints
    truncate(folder / "step-000000002.ckpt")
    if which == "load_step":
        config.load_step = 2
    else:
        config.load_dir = None
        config.load_checkpoint = folder / "step-000000002.ckpt"
    with pytest.raises(ValueError, match=r"step-000000002\.ckpt is cut off, damaged or"):
        set_up(config)


def test_a_folder_without_checkpoints_and_a_missing_step_are_one_sentence_each(
    two_checkpoints: tuple[SadgsTrainerConfig, Path], tmp_path: Path
):
    config, _ = two_checkpoints
    config.load_step = 3
    with pytest.raises(ValueError, match=r"holds no checkpoint of step 3: give --load-step one of 1, 2\."):
        set_up(config)
    config.load_dir = tmp_path / "none"
    config.load_step = None
    with pytest.raises(ValueError, match=r"none holds no checkpoint: give --load-dir the folder"):
        set_up(config)
