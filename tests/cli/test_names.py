"""Folders whose names are not in UTF-8, which libraries crash on, are refused by every command before any work."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

from helpers.refusals import refusal
from helpers.short_runs import configure
from sadgs_ns.cli import doctor, export, inspect, process, sadgs
from sadgs_ns.files import check_encoding

NAME = os.fsdecode(b"caf\xe9")  # As an archive of Latin-1 unpacks it
Main = Callable[[Sequence[str]], int]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder whose name is not in UTF-8."""
    path = tmp_path / NAME
    try:
        path.mkdir()
    except OSError:
        pytest.skip("this file system has names in UTF-8 only")
    return path


@pytest.mark.hard_case(
    "a folder whose name is not in UTF-8, given to our commands or to `ns-train`, or around them",
    "refused by name before any work",
)
@pytest.mark.parametrize(
    ("main", "arguments"),
    [
        (sadgs.main, ["{}", "--output", "{}/out"]),
        (process.main, ["{}", "{}/out"]),
        (export.main, ["{}", "--output", "{}/splat.ply"]),
        (inspect.main, ["{}/config.yml"]),
        (doctor.main, ["{}"]),
    ],
    ids=["sadgs", "sadgs-process", "sadgs-export", "sadgs-inspect", "sadgs-doctor"],
)
def test_a_folder_that_is_not_in_utf8_is_refused(
    main: Main, arguments: list[str], folder: Path, scene: Path, capsys: pytest.CaptureFixture[str]
):
    for image in (scene / "images").iterdir():
        (folder / image.name).symlink_to(image)
    before = sorted(folder.iterdir())
    assert main([argument.format(folder) for argument in arguments]) in (1, 2)
    printed = "".join(capsys.readouterr())
    problem = f"{str(folder)!a}"[:-1]
    assert problem in printed
    assert "is not in UTF-8, which COLMAP, FFmpeg and torch need: rename its folder or file." in printed or (
        "has unprintable characters in its name: rename it." in printed
    )
    assert sorted(folder.iterdir()) == before


def test_a_run_in_a_folder_that_is_not_in_utf8_is_refused(colmap: ColmapDataParserConfig, folder: Path):
    config = configure(folder, colmap)
    with refusal(r"caf.udce9.* is not in UTF-8"):
        config.save_config()
    assert list(folder.iterdir()) == []


@pytest.mark.skipif(sys.platform == "darwin", reason="macOS has no such names")
def test_the_working_directory_counts(folder: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(folder)
    with refusal(r"^'/.*/caf.udce9/photos' is not in UTF-8"):
        check_encoding(Path("photos"))
