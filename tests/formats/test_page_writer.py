"""What writes pages is installed once, as its lock file says, and only if the user wants a page."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from helpers.fake_node import put_node_into_path
from helpers.json_files import read_json
from sadgs_ns.cli.sadgs_options import choose_formats
from sadgs_ns.formats import page_writer

NPM = f"""
echo "$@" >> ran.txt
grep -q integrity package-lock.json && mkdir -p {page_writer.PROGRAM.parent} && touch {page_writer.PROGRAM}
"""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache without the program, and an npm that needs no network."""
    put_node_into_path(tmp_path / "programs", "", NPM, monkeypatch)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache/sadgs_ns"


def test_the_lock_file_pins_every_package_by_its_hash_and_names_no_server():
    lock = read_json(page_writer.PACKAGES / "package-lock.json")
    packages = {name: package for name, package in lock["packages"].items() if name}
    wanted = read_json(page_writer.PACKAGES / "package.json")["dependencies"]
    assert lock["packages"][""]["dependencies"] == wanted
    assert str(page_writer.PROGRAM).split("/bin/")[0] in packages
    for package in packages.values():
        assert package["integrity"].startswith("sha512-")
    for package in packages.values():
        assert "resolved" not in package


def test_the_program_is_installed_once_without_running_scripts_of_its_packages(cache: Path):
    assert not page_writer.is_installed()
    page_writer.install()
    page_writer.install()
    assert page_writer.is_installed()
    actual = list(cache.iterdir())
    assert actual == [page_writer.folder()]
    assert page_writer.folder().stat().st_mode & 0o777 == 0o755, "other users may use it, too"
    ran = (page_writer.folder() / "ran.txt").read_text().splitlines()
    assert len(ran) == 1
    assert ran[0].startswith("ci ")
    assert "--ignore-scripts" in ran[0]


def test_a_program_that_another_process_installed_meanwhile_is_taken(cache: Path, monkeypatch: pytest.MonkeyPatch):
    run = subprocess.run

    def run_while_another_installs(command: Any, **options: Any) -> Any:
        program = page_writer.folder() / page_writer.PROGRAM
        program.parent.mkdir(parents=True)
        program.touch()
        return run(command, **options)

    monkeypatch.setattr(page_writer.subprocess, "run", run_while_another_installs)
    page_writer.install()
    actual = list(cache.iterdir())
    assert actual == [page_writer.folder()]


@pytest.mark.hard_case(
    "`sadgs photos` where what writes pages was never downloaded, without a terminal",
    "nothing is downloaded: the PLY is made, and a line says how to have the page, too",
)
@pytest.mark.parametrize(("answer", "expected"), [(None, ["ply"]), ("n", ["ply"]), ("", ["ply", "html"])])
def test_a_page_is_made_by_default_if_its_program_is_there_or_the_user_lets_it_be_downloaded(
    answer: str | None, expected: list[str], cache: Path, monkeypatch: pytest.MonkeyPatch
):
    console = Console(file=io.StringIO(), force_terminal=answer is not None, width=200)
    monkeypatch.setattr(sys.stdin, "isatty", lambda: answer is not None, raising=False)
    questions: list[str] = []

    def reply(question: str) -> str | None:
        questions.append(question)
        return answer

    monkeypatch.setattr(console, "input", reply)
    assert choose_formats(None, False, console) == expected
    printed: Any = console.file
    assert ("--formats html,ply does that once" in printed.getvalue()) == (expected == ["ply"])
    actual = [page_writer.DOWNLOAD in question for question in questions]
    assert actual == [True] * (answer is not None)
    assert choose_formats("html,ply", False, console) == ["ply", "html"], "who names the format wants the download"
    page_writer.install()
    questions.clear()
    actual = choose_formats(None, False, console)
    assert actual == ["ply", "html"]
    assert questions == []
