"""Killed and resumed: what SIGKILL, SIGINT and SIGTERM leave, and what a run goes on from."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import tyro
from kill_and_resume import configure, differences, set_up
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer
from nerfstudio.scripts.train import main as resume
from scenes import ITERATIONS

from sadgs_ns.demo.scene import SPARSE_FOLDER
from sadgs_ns.plugin.interrupts import resume_command
from sadgs_ns.plugin.trainer import SadgsTrainer, SadgsTrainerConfig

SCRIPT = Path(__file__).parents[1] / "kill_and_resume.py"


def after(trainer: SadgsTrainer, at: int, act: Callable[[], None]) -> None:
    """Do something at the end of an iteration, after densification."""
    location = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
    trainer.callbacks.append(TrainingCallback(location, lambda step: act() if step == at else None))


def send(number: int) -> None:
    os.kill(os.getpid(), number)


def checkpoints(trainer: SadgsTrainer) -> list[str]:
    return sorted(path.name for path in trainer.checkpoint_dir.glob("*"))


def one_line(text: str, start: str) -> str:
    """The only line that begins so."""
    (line,) = (line for line in text.splitlines() if line.startswith(start))
    return line


def kill_and_resume(*arguments: object) -> str:
    """Run the script; its output."""
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=1800)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


# --- killed ---


def test_a_run_killed_in_four_places_ends_bitwise_equal_to_one_that_nothing_disturbed(tmp_path: Path):
    sizes = ("--kills", 4, "--iterations", 36, "--save-every", 6, "--width", 48, "--views", 10)
    printed = kill_and_resume(tmp_path, *sizes)
    assert re.findall(r"kill \d: .*, (.*), iteration .*: exit -9", printed) == [
        "within a step",
        "after a split",
        "saving",
        "after renaming",
    ]
    assert "bitwise equal; left over: []" in printed


@pytest.mark.slow
def test_a_run_killed_ten_times_ends_bitwise_equal_to_one_that_nothing_disturbed(tmp_path: Path):
    printed = kill_and_resume(tmp_path, "--kills", 10)
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
        monkeypatch.setattr("sadgs_ns.plugin.trainer.time", SimpleNamespace(monotonic=lambda: self.now))


def test_the_clock_makes_checkpoints_that_change_nothing_and_resume_to_the_same_model(
    scene: Path, config: SadgsTrainerConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    assert (config.steps_per_save, config.seconds_per_save) == (0, 60)
    config.save_only_latest_checkpoint = False
    trainer = set_up(config)
    with monkeypatch.context() as patched:
        (clock := Clock()).attach(trainer, patched)
        trainer.train()
    # Due after 60 s, and then after 200 s, since a checkpoint takes 2 s.
    assert clock.saved == [2, 10, ITERATIONS - 1]
    assert checkpoints(trainer) == [f"step-{step:09d}.ckpt" for step in clock.saved]

    without = set_up(configure(scene, tmp_path / "without", ITERATIONS, save_every=0))
    without.train()
    resumed_config = configure(scene, tmp_path / "resumed", ITERATIONS, save_every=0)
    resumed_config.load_dir, resumed_config.load_step = trainer.checkpoint_dir, 2
    resumed = set_up(resumed_config)
    resumed.train()
    assert checkpoints(without) == checkpoints(resumed) == [f"step-{ITERATIONS - 1:09d}.ckpt"]
    ends = [
        torch.load(t.checkpoint_dir / checkpoints(without)[0], weights_only=True) for t in (trainer, without, resumed)
    ]
    assert differences(ends[0], ends[1]) == differences(ends[0], ends[2]) == []


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
    (clock := Clock()).attach(trainer, monkeypatch, seconds)
    trainer.train()
    assert clock.saved == saved


# --- interrupted ---


def test_ctrl_c_on_ns_train_prints_the_command_that_resumes_it(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    program = str(Path(sys.executable).with_name("ns-train"))
    iterations = 150
    command = [program, "sadgs", "--output-dir", str(tmp_path), "--experiment-name", "a run", "--timestamp", "first"]
    command += ["--max-num-iterations", str(iterations), "--steps-per-save", "5", "--vis", "tensorboard"]
    command += ["--pipeline.model.strategy.refine-stop-iter", "0", "--machine.device-type", "cpu"]
    command += ["colmap", "--data", str(scene), "--colmap-path", str(SPARSE_FOLDER), "--downscale-factor", "1"]
    folder = tmp_path / "a run" / "sadgs" / "first" / "nerfstudio_models"
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        deadline = time.monotonic() + 100
        while not list(folder.glob("*.ckpt")) and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        printed, _ = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130, printed
    assert "Traceback" not in printed
    line = one_line(printed, "SIGINT")
    (path,) = folder.iterdir()
    done = torch.load(path, weights_only=True)["step"] + 1
    assert 5 < done < iterations
    assert line.startswith(f"SIGINT: stopped and saved after {done} of {iterations} iterations; resume with: ns-train ")
    words = shlex.split(line.partition("resume with: ")[2])
    assert words[:4] == ["ns-train", "sadgs", "--load-dir", str(folder)]
    resume(tyro.cli(AnnotatedBaseConfigUnion, args=words[1:]))  # in this process, which has imported everything
    assert f"Resuming after step {done - 1} of {path}" in capsys.readouterr().out
    assert [p.name for p in folder.iterdir()] == [f"step-{iterations - 1:09d}.ckpt"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_within_a_step_waits_for_its_end_and_resumes_to_the_same_model(
    number: signal.Signals, scene: Path, config: SadgsTrainerConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    whole = set_up(configure(scene, tmp_path / "whole", ITERATIONS, save_every=0))
    whole.train()

    trainer = set_up(config)
    get_loss = trainer.pipeline.get_train_loss_dict

    def interrupted(step: int) -> Any:
        if step == 4:  # ends with a structure split
            send(number)
        return get_loss(step)

    trainer.pipeline.get_train_loss_dict = interrupted  # type: ignore[method-assign]
    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(SystemExit) as stopped:
        trainer.train()
    assert stopped.value.code == 128 + number
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == handlers
    assert checkpoints(trainer) == ["step-000000004.ckpt"]
    line = one_line(capsys.readouterr().out, number.name)
    assert line == (
        f"{number.name}: stopped and saved after 5 of {ITERATIONS} iterations; "
        f"resume with: load_dir = {str(trainer.checkpoint_dir)!r}"
    )

    config.load_dir = trainer.checkpoint_dir
    resumed = set_up(config)
    resumed.train()
    name = f"step-{ITERATIONS - 1:09d}.ckpt"
    ends = [torch.load(t.checkpoint_dir / name, weights_only=True) for t in (whole, resumed)]
    assert differences(*ends) == []


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
    assert "before an iteration was done; the same command starts again" in capsys.readouterr().out
    assert checkpoints(trainer) == []


@pytest.mark.parametrize("moment", ["final save", "waiting for the viewer's user"])
def test_an_interrupt_after_the_last_iteration_ends_a_finished_run_without_an_error(
    moment: str, config: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    trainer = set_up(config)
    owner, name = (torch, "save") if moment == "final save" else (Trainer, "_train_complete_viewer")
    original, calls = getattr(owner, name), []

    def interrupted(*arguments: Any) -> Any:
        calls.append(arguments)
        if len(calls) == 1:
            send(signal.SIGINT)
        return original(*arguments)

    monkeypatch.setattr(owner, name, interrupted)
    trainer.train()
    assert calls and checkpoints(trainer) == [f"step-{ITERATIONS - 1:09d}.ckpt"]
    assert "SIGINT" not in capsys.readouterr().out


def test_a_second_interrupt_stops_at_once_as_without_us(config: SadgsTrainerConfig):
    trainer = set_up(config)
    for _ in range(2):
        after(trainer, 3, lambda: send(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt) as stopped:
        trainer.train()
    assert type(stopped.value) is KeyboardInterrupt
    assert checkpoints(trainer) == []


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


@pytest.mark.parametrize(
    ("argv", "command"),
    [
        ("/bin/ns-train sadgs --data d", "ns-train sadgs --load-dir 'a b' --data d"),
        ("ns-train sadgs --vis viewer colmap --data d", "ns-train sadgs --load-dir 'a b' --vis viewer colmap --data d"),
        ("ns-train sadgs --load-dir old --load-step 3 --data d", "ns-train sadgs --load-dir 'a b' --data d"),
        ("ns-train sadgs --load_dir=old --data d", "ns-train sadgs --load-dir 'a b' --data d"),
        ("ns-train sadgs --load-checkpoint c.ckpt --data d", "ns-train sadgs --load-dir 'a b' --data d"),
        ("ns-train sadgs --load-config c.yml", "load_dir = 'a b'"),
        ("ns-train splatfacto --data d", "load_dir = 'a b'"),
        ("python -m something", "load_dir = 'a b'"),
    ],
)
def test_the_resume_command_keeps_every_other_option(argv: str, command: str):
    assert resume_command(argv.split(), "sadgs", Path("a b")) == command


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


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_named_and_the_one_before_it_taken(
    damage: str, two_checkpoints: tuple[SadgsTrainerConfig, Path], capsys: pytest.CaptureFixture[str]
):
    config, folder = two_checkpoints
    DAMAGES[damage](folder / "step-000000002.ckpt")
    assert set_up(config)._start_step == 2
    line = one_line(capsys.readouterr().out, str(folder / "step-000000002.ckpt"))
    assert line.endswith(f"Going on from {folder / 'step-000000001.ckpt'} instead.")


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
    assert message.startswith(str(folder / "step-000000002.ckpt")) and message.endswith("or train from scratch.")
    assert "\n" not in message and "Going on" not in capsys.readouterr().out


@pytest.mark.parametrize("which", ["load_step", "load_checkpoint"])
def test_a_damaged_checkpoint_that_was_asked_for_is_not_replaced_by_another(
    which: str, two_checkpoints: tuple[SadgsTrainerConfig, Path]
):
    config, folder = two_checkpoints
    truncate(folder / "step-000000002.ckpt")
    if which == "load_step":
        config.load_step = 2
    else:
        config.load_dir, config.load_checkpoint = None, folder / "step-000000002.ckpt"
    with pytest.raises(ValueError, match=r"step-000000002\.ckpt is cut off, damaged or"):
        set_up(config)


def test_a_folder_without_checkpoints_and_a_missing_step_are_one_sentence_each(
    two_checkpoints: tuple[SadgsTrainerConfig, Path], tmp_path: Path
):
    config, _ = two_checkpoints
    config.load_step = 3
    with pytest.raises(ValueError, match=r"holds no checkpoint of step 3: give --load-step one of 1, 2\."):
        set_up(config)
    config.load_dir, config.load_step = tmp_path / "none", None
    with pytest.raises(ValueError, match=r"none holds no checkpoint: give --load-dir the folder"):
        set_up(config)
