"""Two commands that write to one place: the second is refused at its start, and nothing of the first is lost."""

from __future__ import annotations

import errno
import fcntl
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

from helpers.kill_and_resume import set_up
from helpers.refusals import refusal
from helpers.short_runs import configure
from sadgs_ns.errors import InputError
from sadgs_ns.files import atomic_path, locked
from sadgs_ns.training.config import SadgsTrainerConfig

_HOLD = "import fcntl, os, sys; fcntl.flock(os.open(sys.argv[1], os.O_RDONLY), fcntl.LOCK_EX); print(1); input()"


@pytest.fixture
def config(colmap: ColmapDataParserConfig, tmp_path: Path) -> SadgsTrainerConfig:
    return configure(tmp_path / "out", colmap, iterations=2)


@contextmanager
def used_by_another_process(path: Path) -> Iterator[None]:
    """Let another process hold the lock of a folder or file."""
    command = [sys.executable, "-c", _HOLD, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdout.readline()
        yield
        process.stdin.close()


def without_locks(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    def fail(*_: Any) -> None:
        raise OSError(number, "No locks available")

    monkeypatch.setattr(fcntl, "flock", fail)


@pytest.mark.hard_case(
    "two `ns-train` in one folder, started in the same second or with one `--timestamp`; `--load-dir` of a run that "
    "still trains",
    "the second is refused at its start",
)
def test_a_second_run_in_one_folder_is_refused_at_its_start(config: SadgsTrainerConfig):
    folder = config.get_base_dir()
    folder.mkdir(parents=True)
    with used_by_another_process(folder):
        with pytest.raises(InputError) as refused:
            config.save_config()
        assert str(refused.value) == (
            f"Another run trains in {folder}: wait for it or stop it, or give this one another --timestamp, which is "
            "the second of its start if none is given."
        )
        assert list(folder.iterdir()) == []
    config.save_config()
    names = [path.name for path in folder.iterdir()]
    assert names == ["config.yml"]


def test_the_folder_is_locked_until_training_ends(config: SadgsTrainerConfig):
    folder = config.get_base_dir()
    config.save_config()
    config.save_config()  # This process has the lock already.
    trainer = set_up(config)
    with refusal(r"^taken$"), locked(folder, "taken"):
        pass
    trainer.train()
    with locked(folder, "taken"):
        pass


@pytest.mark.hard_case("two commands write one file, as `sadgs-export` does", "the second is refused")
def test_a_file_that_another_process_writes_is_refused_and_left_alone(tmp_path: Path):
    partial = tmp_path / ".splat.partial.ply"
    partial.write_text("half")
    with (
        used_by_another_process(partial),
        refusal(r"^Another process writes \S+/splat\.ply now: wait until it is done, or name "),
        atomic_path(tmp_path / "splat.ply") as path,
    ):
        path.write_text("other")
    assert partial.read_text() == "half"
    with atomic_path(tmp_path / "splat.ply") as path:
        path.write_text("whole")
    names = [path.name for path in tmp_path.iterdir()]
    assert names == ["splat.ply"]


@pytest.mark.hard_case("a file system without locks, as some network file systems", "a line, and the work is done")
@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EBADF])
def test_a_file_system_without_locks_is_used_without(
    number: int,
    config: SadgsTrainerConfig,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    without_locks(monkeypatch, number)
    with locked(tmp_path, "taken"):
        pass
    line = f"The file system of {tmp_path} has no locks (No locks available): take care that only one command at a time"
    errors = capsys.readouterr().err
    assert errors == f"{line} works there.\n"
    config.save_config()
    assert (config.get_base_dir() / "config.yml").is_file()


def test_another_error_of_a_lock_is_not_taken_for_a_missing_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    without_locks(monkeypatch, errno.EIO)
    with pytest.raises(OSError, match="No locks available"), locked(tmp_path, "taken"):
        pass
