"""The wheel holds the whole package, and each of its modules and entry points can be imported from it."""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from importlib.metadata import Distribution
from pathlib import Path

import pytest

from helpers.forked_python import HANGS

CHECKOUT = Path(__file__).parents[2]
PACKAGE = CHECKOUT / "sadgs_ns"
BUILT_FROM = ("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE")
FOLDERS = ("sadgs_ns", "benchmarks", "examples", "tests")
"""The package, and what must not get into its wheel."""
ENTRY_POINTS = ("console_scripts", "nerfstudio.method_configs")


@dataclass
class Wheel:
    file: Path
    installed: Path  # The folder that it was installed into


def run(*command: str | Path, folder: Path, **environment: str) -> str:
    """Run a Python command in a folder, without a GPU; return its output."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", *command],
        cwd=folder,
        env=os.environ | {"CUDA_VISIBLE_DEVICES": ""} | environment,
        capture_output=True,
        text=True,
        timeout=HANGS,
    )
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Wheel:
    """The wheel of a copy of the checkout, so that no build folder is left there, installed into another folder."""
    folder = tmp_path_factory.mktemp("wheel")
    copy = folder / "checkout"
    for name in FOLDERS:
        shutil.copytree(CHECKOUT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in BUILT_FROM:
        shutil.copy(CHECKOUT / name, copy)
    pip = ("-m", "pip", "--quiet", "--disable-pip-version-check")
    alone = ("--no-index", "--no-deps")
    built = folder / "built"
    run(*pip, "wheel", *alone, "--no-build-isolation", "--wheel-dir", built, copy, folder=folder)
    (file,) = built.iterdir()
    installed = folder / "installed"
    run(*pip, "install", *alone, "--no-compile", "--target", installed, file, folder=folder)
    return Wheel(file, installed)


def files_of_the_package() -> set[str]:
    """Files of the checkout's package, by their paths in the checkout."""
    files = (path for path in PACKAGE.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return {path.relative_to(CHECKOUT).as_posix() for path in files}


def modules_of_the_package() -> list[str]:
    """Dotted names of all modules of the checkout's package."""
    paths = (path.relative_to(CHECKOUT).with_suffix("") for path in sorted(PACKAGE.rglob("*.py")))
    return [".".join(path.parts).removesuffix(".__init__") for path in paths]


def functions_of_workers() -> set[str]:
    """Functions that the package's source names in texts, as `sadgs_ns.module:name`, to run them in processes."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf8"))):
            if isinstance(node, ast.Constant) and re.fullmatch(r"sadgs_ns(\.\w+)+:\w+", str(node.value)):
                found.add(str(node.value))
    return found


def test_the_wheel_holds_all_files_of_the_package_and_no_others(wheel: Wheel):
    with zipfile.ZipFile(wheel.file) as archive:
        names = set(archive.namelist())
    described = {name for name in names if name.partition("/")[0].endswith(".dist-info")}
    files = files_of_the_package()
    assert "sadgs_ns/py.typed" in files
    assert "sadgs_ns/__init__.py" in files
    assert names - described == files
    assert os.access(wheel.installed / "sadgs_ns/launchers/ffmpeg", os.X_OK)


IMPORT_ALL = """
import importlib, json, pkgutil, sys, traceback

# Modules of ours begin to import these in threads, or with stand-ins, unless they have been imported.
import nerfstudio.process_data.colmap_utils, nerfstudio.scripts.train

modules, objects = json.loads(sys.argv[1])
failures = {}
for find, names in ((importlib.import_module, modules), (pkgutil.resolve_name, objects)):
    for name in names:
        try:
            find(name)
        except Exception:
            failures[name] = traceback.format_exc()
ours = {
    name: getattr(module, "__file__", None)
    for name, module in sys.modules.items()
    if f"{name}.".startswith("sadgs_ns.")
}
print(json.dumps([failures, ours]))
"""


def test_all_modules_and_entry_points_are_imported_from_the_wheel(wheel: Wheel, tmp_path: Path):
    (metadata,) = wheel.installed.glob("*.dist-info")
    entry_points = Distribution.at(metadata).entry_points
    groups = {entry_point.group for entry_point in entry_points}
    assert groups == {*ENTRY_POINTS}
    workers = functions_of_workers()
    assert len(workers) >= 3, "sadgs runs its stages in processes"
    modules = modules_of_the_package()
    objects = sorted(workers | {entry_point.value for entry_point in entry_points})

    # `sadgs_ns.training.start` would compile kernels in another process if Triton were to be used.
    environment = {"PYTHONPATH": str(wheel.installed), "SADGS_TRITON": "0"}
    printed = run("-c", IMPORT_ALL, json.dumps([modules, objects]), folder=tmp_path, **environment)
    failures, files = json.loads(printed.splitlines()[-1])
    assert not failures, "\n".join(failures.values())
    assert files.keys() >= {*modules}
    elsewhere = {
        name: file for name, file in files.items() if file is None or not Path(file).is_relative_to(wheel.installed)
    }
    assert not elsewhere, "these are missing in the wheel, and an editable installation has them"


def test_the_dockerfile_copies_all_that_the_package_is_built_of():
    lines = (CHECKOUT / "Dockerfile").read_text("utf8").splitlines()
    copied = set()
    for line in lines:
        if line.startswith("COPY "):
            copied |= {*line.split()[1:-1]}
    assert all((CHECKOUT / name).exists() for name in copied)
    assert {*BUILT_FROM, "constraints.txt", "sadgs_ns"} - copied == {"MANIFEST.in"}, "it is for source distributions"
