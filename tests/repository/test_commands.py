"""How fast the commands answer, held without a clock, by what they import; and their versions."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from examples.drawn_scene.scene import write_scene

PYPROJECT = Path(__file__).parents[2] / "pyproject.toml"
SCRIPTS = dict(re.findall(r'^(sadgs(?:-\w+)?) = "(.+):main"$', PYPROJECT.read_text("utf8"), re.MULTILINE))
"""The commands that are installed, and the module whose `main` each is."""
SLOW = ("torch", "nerfstudio", "torchvision", "gsplat", "scipy", "matplotlib", "pycolmap")
"""Packages that take between a third of a second and ten seconds to import."""
HELP = [
    *((module, ["--help"]) for module in SCRIPTS.values()),
    ("benchmarks.__main__", ["--help"]),
    ("examples.drawn_scene.__main__", ["--help"]),
]


def imported(module: str, arguments: list[str]) -> set[str]:
    """Modules that are imported when a command has run in a process of its own, which it must end with code 0 or 1."""
    code = f"""
import sys
from {module} import main
try:
    code = main({arguments})
except SystemExit as end:
    code = end.code
print("\\n" + " ".join(sys.modules))
sys.exit(code)
"""
    run = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True)
    assert run.returncode in (0, 1), run.stderr
    return set(run.stdout.splitlines()[-1].split())


@pytest.mark.parametrize(("module", "arguments"), HELP, ids=[" ".join([name, *words]) for name, words in HELP])
def test_help_is_printed_without_slow_imports(module: str, arguments: list[str]):
    assert not imported(module, arguments) & {*SLOW}


def test_the_doctor_imports_torch_and_little_else(tmp_path: Path):
    write_scene(tmp_path / "scene", 32, 24, 9, 20)
    modules = imported(SCRIPTS["sadgs-doctor"], [str(tmp_path / "scene")])
    assert "torch" in modules
    assert not modules & {*SLOW, "torch._dynamo", "torch._inductor"} - {"torch"}


@pytest.mark.parametrize("name", SCRIPTS)
def test_each_command_prints_its_version(name: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit, match=r"^0$"):
        importlib.import_module(SCRIPTS[name]).main(["--version"])
    printed = capsys.readouterr().out
    assert printed == f"{name} {version('sadgs_ns')}\n"
