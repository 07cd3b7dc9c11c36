"""Commands that the documents show are understood by the programs that they name, and run by a test or marked.

Commands in blocks that no other test runs are run here as they stand, one after the other, on a small drawn scene. A
comment `# needs a GPU` in a block marks those that it precedes, or whose line it ends.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import inspect
import os
import re
import shlex
import sys
from argparse import ArgumentParser
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, entry_points, requires
from pathlib import Path
from typing import Any

import pytest
import tyro
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from test_commands import PYPROJECT, SCRIPTS
from test_docs import CHECKOUT, names_in, without_code

from benchmarks import protocol
from examples.drawn_scene.scene import write_scene
from helpers import forked_python
from helpers.small_scenes import HEIGHT, POINTS, WIDTH
from sadgs_ns.programs import put_ffmpeg_into_path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

DOCUMENTS = [CHECKOUT / "README.md", *sorted((CHECKOUT / "docs").glob("*.md"))]
OTHER_LANGUAGES = {"dockerfile", "python", "text", "yaml", "{button-link}"}
"""Of fenced blocks that hold no commands."""
FOREIGN = ("git", "cd", "cp", ".", "python3 -m venv", "pip install", "ns-install-cli", "docker run")
"""Commands of others that no change of this package breaks; what `pip` is given of the checkout must be there."""
RUN_BY = {
    "make test": ".ci/run",
    "make test-slow": ".ci/run",
    "make test-portable": ".ci/run",
    "make lint": ".ci/run",
    "make gate": ".ci/run",
    "make docs": ".ci/run",
    "make turn": "tests/drawn_scene/test_turn.py::test_a_picture_shows_the_splat_and_beside_it_the_shrunk_gaussians",
    ".ci/run": ".github/workflows/tests.yml",
    "sadgs": "tests/cli/test_sadgs.py::test_a_run_interrupted_in_each_stage_goes_on_to_a_splat_and_then_does_nothing",
    "sadgs photos": "tests/cli/test_sadgs.py::"
    "test_photos_that_are_added_are_registered_and_the_splat_is_trained_anew_where_it_was",
    "sadgs-process": "tests/placing/test_process.py::test_photos_are_registered_where_they_were_taken",
    "sadgs-export RUN/config.yml -o splat.html": "tests/cli/test_export.py::"
    "test_a_page_opens_at_the_training_camera_in_the_middle_and_has_the_capture_s_name",
    "sadgs-export outputs/demo/sadgs/run/config.yml --output room.mesh.ply": "tests/cli/test_export_mesh.py::"
    "test_the_mesh_lies_on_the_room_s_surfaces_in_both_frames",
    "sadgs-export outputs/demo/sadgs/run/config.yml --output splat.ply --crop": "tests/cli/test_export.py::"
    "test_what_is_taken_away_is_told_and_not_in_the_file",
    "python -m benchmarks PROTOCOL.yaml": "Makefile",
    "python -m benchmarks table": "tests/benchmarks/test_table.py::test_the_command_prints_the_table_and_draws_a_plot",
    "python -m benchmarks captures": "tests/benchmarks/test_captures.py::test_what_matches_is_told_to_match",
    "python -m benchmarks chain": "tests/benchmarks/test_chain.py::test_the_protocol_names_eight_captures",
    "python -m benchmarks cameras": "tests/benchmarks/test_cameras.py::"
    "test_a_capture_has_a_row_for_each_variant_with_numbers_for_each_seed",
    "python -m benchmarks seconds": "tests/benchmarks/test_seconds.py::test_the_parts_of_a_command_are_measured_once",
    "python -m benchmarks kernels": "tests/benchmarks/test_kernel_table.py::"
    "test_the_command_writes_a_row_for_each_kernel",
    "python -m benchmarks startup": "tests/benchmarks/test_startup_table.py::"
    "test_each_way_has_a_first_run_with_caches_of_its_own_and_later_ones",
    "python -m benchmarks documents": "tests/repository/test_docs.py::test_tables_are_what_their_rows_give",
}
"""Tests that run commands which begin so, or files that do; the longest beginning counts."""
SHORTER = {
    "ns-train sadgs": "--max-num-iterations 2 --vis tensorboard",
    "python -m examples.drawn_scene": "--width 40 --height 30 --views 9 --max-num-iterations 30 --max-gaussians 800",
}
"""Options with which commands that begin so are run here, beside those that they have and in place of these."""


@dataclass(frozen=True)
class Command:
    """One command of a block."""

    document: str
    words: tuple[str, ...]
    remark: str
    """The comments that tell of it."""

    def __str__(self) -> str:
        return f"{self.document}: {' '.join(self.words)}"

    @property
    def needs_gpu(self) -> bool:
        return re.search(r"needs (a GPU|two GPUs)", self.remark) is not None

    @property
    def run_by(self) -> str | None:
        starts = [start for start in RUN_BY if f"{' '.join(self.words)} ".startswith(f"{start} ")]
        return RUN_BY[max(starts, key=len)] if starts else None

    @property
    def is_foreign(self) -> bool:
        return f"{' '.join(self.words)} ".startswith(tuple(f"{start} " for start in FOREIGN))


def blocks(text: str) -> Iterator[list[str]]:
    """The lines of a document's blocks of commands, and of what these print."""
    fence = r"^```(\S*).*?\n(.*?)^```$"
    for language, body in re.findall(fence, text, re.MULTILINE | re.DOTALL):
        assert language in {"bash", *OTHER_LANGUAGES}, f"is ```{language} a block of commands?"
        if language == "bash":
            yield body.splitlines()
    rest = re.sub(fence, "", text, flags=re.MULTILINE | re.DOTALL)
    for block in re.findall(r"(?:^    .*\n|^\n(?=    ))+", rest, re.MULTILINE):
        yield [line[4:] for line in block.splitlines()]


def in_blocks(path: Path) -> Iterator[Command]:
    """The commands of a document's blocks: lines after a prompt, or all lines where there is no prompt."""
    for lines in blocks(path.read_text("utf8")):
        prompted = [line[2:] for line in lines if line.startswith("$ ")]
        without = [line for line in lines if re.match(r"(sadgs|ns)-\w+ ", line)]
        assert not (prompted and without), f"a prompt is missing before {without}"
        told = ""
        for line in prompted or lines:
            code, _, comment = line.partition("#")
            if not code.strip():
                told += comment
            for part in code.split("&&"):
                if part.strip():
                    yield Command(path.name, tuple(shlex.split(part)), told + comment)


COMMANDS = list(dict.fromkeys(command for path in DOCUMENTS for command in in_blocks(path)))


class Parsed(BaseException):
    """What a program understood, raised in place of running it."""


def program(words: Sequence[str]) -> tuple[Callable[[], Any], list[str]]:
    """The function that a command calls, and the `sys.argv` that it reads."""
    if words[0] == "torchrun":
        given = importlib.import_module("torch.distributed.run").parse_args(list(words[1:]))
        words = ["python", "-m", given.training_script, *given.training_script_args]
    if words[0] == "python":
        is_package = (CHECKOUT / words[2].replace(".", "/")).is_dir()
        module = importlib.import_module(f"{words[2]}.__main__" if is_package else words[2])
        return getattr(module, "entrypoint", None) or module.main, [words[2], *words[3:]]
    (script,) = entry_points(group="console_scripts", name=words[0])
    return script.load(), list(words)


def understood(words: Sequence[str], lenient: bool = False) -> Any:
    """What the program's own parser makes of a command, without running it.

    Args:
        lenient: Whether arguments that argparse requires may be missing.

    Raises:
        SystemExit: If it is not understood; what is wrong has been printed.
    """
    parse_args = ArgumentParser.parse_args
    cli = tyro.cli

    def parse(parser: ArgumentParser, *arguments: Any) -> None:
        for action in parser._actions:
            action.required &= not lenient
        raise Parsed(parse_args(parser, *arguments))

    def parse_type(kind: Any, *arguments: Any, **options: Any) -> None:
        # tyro would call a function, and takes its signature from what is called in its place.
        asked = functools.wraps(kind)(lambda *_, **__: None) if inspect.isfunction(kind) else kind
        raise Parsed(cli(asked, *arguments, **options))

    main, argv = program(words)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(Parsed) as parsed:
        patch.setattr("sys.argv", argv)
        patch.setattr(ArgumentParser, "parse_args", parse)
        patch.setattr(tyro, "cli", parse_type)
        main()
    return parsed.value.args[0]


def brought_by(package: str, found: set[str]) -> set[str]:
    """Add to `found` the installed packages that a package requires, directly or not, and return it."""
    for text in requires(package) or []:
        requirement = Requirement(text)
        name = canonicalize_name(requirement.name)
        is_needed = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        if name in found or not is_needed:
            continue
        found.add(name)
        with contextlib.suppress(PackageNotFoundError):  # Nothing here needed it.
            brought_by(name, found)
    return found


def test_installing_beside_nerfstudio_names_each_requirement_that_nerfstudio_does_not_bring():
    named = set()
    for command in COMMANDS:
        if command.document == "install.md" and command.words[:2] == ("pip", "install"):
            packages = [word for word in command.words[2:] if re.match("[a-z]", word) and not word.endswith(".txt")]
            named |= {canonicalize_name(Requirement(package).name) for package in packages}
    project = tomllib.loads(PYPROJECT.read_text("utf8"))["project"]
    required = {canonicalize_name(Requirement(text).name) for text in project["dependencies"]}
    assert required - brought_by("nerfstudio", {"nerfstudio"}) <= named


@pytest.mark.parametrize("command", COMMANDS, ids=str)
def test_a_command_in_a_block_is_understood_and_the_test_that_runs_it_is_there(command: Command):
    first = command.words[0]
    words = list(command.words)
    if first == "make":
        assert re.search(rf"^{words[1]}:", (CHECKOUT / "Makefile").read_text("utf8"), re.MULTILINE)
    elif first == "pip":
        files = [word for word in words[2:] if re.fullmatch(r"\.|.*\.txt", word)]
        known = PYPROJECT.read_text("utf8") + (CHECKOUT / "constraints.txt").read_text("utf8")
        assert all((CHECKOUT / file).exists() for file in files)
        assert all(word in known for word in words[2:] if word not in files and not word.startswith("-"))
    elif not command.is_foreign and first != ".ci/run":
        given = understood(words)
        if "--" in words:
            understood(["ns-train", "sadgs", *words[words.index("--") + 1 :]])
        if words[:3] == ["python", "-m", "benchmarks"] and words[3].startswith("configs/"):
            jobs = protocol.load(CHECKOUT / given.protocol).jobs()
            labels = [
                job.row.label for job in jobs if re.search(given.only, f"{job.scene.name}/{job.row.label}/{job.seed}")
            ]
            assert labels
            assert given.reference in (None, *labels)

    file, _, name = (command.run_by or "").partition("::")
    if name:
        assert name in names_in(file)[0]
    elif file:
        shown = words[1] if first == "make" else first
        assert shown in (CHECKOUT / file).read_text("utf8")


def test_a_command_is_understood_without_being_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    understood(["python", "-m", "examples.drawn_scene.scene", "demo", "--width", "40"])
    assert not list(tmp_path.iterdir())


def test_the_protocol_that_is_shown_is_one():
    (shown,) = re.findall(r"^```yaml\n(.*?)^```$", (CHECKOUT / "docs/develop.md").read_text("utf8"), re.M | re.S)
    assert len(protocol.parse(yaml.safe_load(shown)).jobs()) == 12


RUN_HERE = [command for command in COMMANDS if not (command.run_by or command.needs_gpu or command.is_foreign)]
RUN_ALL = """
import os, sys
from nerfstudio.viewer.viewer import Viewer
from test_documented_commands import program
os.chdir({!r})
Viewer.update_scene = lambda *_, **__: sys.exit(0)  # By then `ns-viewer` shows the run, and would wait for ever.
commands = {}
for main, argv in [program(words) for words in commands]:  # All have imported what they need before the first one runs.
    print("$", *argv, flush=True)
    child = os.fork()
    if child == 0:
        sys.argv[:] = argv
        sys.exit(main())
    if os.waitpid(child, 0)[1] != 0:
        sys.exit(1)
"""
"""A program that runs commands in a folder, each in a process of its own, until one fails."""


def shortened(command: Command) -> str:
    """A command as it is run here: on files that are there, and no longer than it must be."""
    line = " ".join(command.words).replace("make demo", "python -m examples.drawn_scene")
    line = re.sub(r"outputs/…\S*|(?<=--load-config )…", "outputs/scene/sadgs/run/config.yml", line)
    line = re.sub(r"(?<=--max-num-iterations )\d+", "2", line)
    start = max((start for start in SHORTER if f"{line} ".startswith(f"{start} ")), key=len, default="")
    if start.startswith("ns-train"):  # whose options come before those of the data's parser
        return line.replace(start, f"{start} {SHORTER[start]} --timestamp {COMMANDS.index(command)}")
    return f"{line} {SHORTER.get(start, '')}".strip()


@pytest.mark.slow
def test_commands_that_no_other_test_runs_work_in_the_order_of_the_documents(tmp_path: Path):
    """They find `scene` and what those before them made."""
    write_scene(tmp_path / "scene", WIDTH, HEIGHT, 16, POINTS)
    (tmp_path / "ROOT").mkdir()
    for name, target in (("ROOT/scene", "../scene"), ("DATA", "scene")):
        (tmp_path / name).symlink_to(target)
    put_ffmpeg_into_path()
    lines = [shortened(command) for command in RUN_HERE]
    commands = [shlex.split(line) for line in dict.fromkeys(lines)]
    # Where nothing listens, LPIPS, whose weights are a download, is left out at once.
    nowhere = dict.fromkeys(("http_proxy", "https_proxy"), "http://127.0.0.1:9")
    environment = {**os.environ, **nowhere, "TORCH_HOME": str(tmp_path)}
    run = forked_python.python(RUN_ALL.format(str(tmp_path), commands), environment)
    assert run.returncode == 0, run.stdout + run.stderr
    assert (tmp_path / "outputs/scene/sadgs/run/inspect").is_dir()
    assert (tmp_path / "splat.ply").is_file()


def with_options() -> list[str]:
    """What sentences show of options: the words of a command, or options alone."""
    texts = [path.read_text("utf8") for path in DOCUMENTS]
    spans = {" ".join(span.split()) for text in texts for span in re.findall(r"`([^`]+)`", without_code(text))}
    return sorted(span for span in spans if re.match(r"--[a-z]|((sadgs|ns)(-[a-z]+)?|python -m) .*--[a-z]", span))


REQUIRED = {
    "sadgs": ["photos"],
    "sadgs-process": ["photos", "scene"],
    "sadgs-export": ["run", "--output", "splat.ply"],
    "sadgs-inspect": ["run"],
}
"""Arguments without which a command understands nothing, and which sentences on its options leave out."""


@pytest.mark.parametrize("shown", with_options())
def test_options_that_sentences_show_are_known(shown: str, capsys: pytest.CaptureFixture[str]):
    def is_known(command: str) -> bool:
        name, *words = [word for word in command.replace("METHOD", "sadgs").split() if word != "…"]
        for required, wrong in ((REQUIRED.get(name, []), "unrecognized"), ([], "unrecognized|missing|required")):
            try:
                understood([name, *required, *words], lenient=True)
                return True
            except SystemExit:  # A value may be missing, or be one that stands for others, such as K.
                if not re.search(wrong, "".join(capsys.readouterr()).lower()):
                    return True
        return False

    programs = [
        *SCRIPTS,
        "python -m benchmarks",
        "ns-train sadgs",
        "ns-train sadgs nerfstudio-data",
        "ns-render dataset",
    ]
    commands = [f"{name} {shown}" for name in programs] if shown.startswith("--") else [shown]
    assert shown in ("--no-deps", "--pipeline.") or any(map(is_known, commands))
