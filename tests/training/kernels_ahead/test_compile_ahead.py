"""Kernels are compiled before the data is known, in processes that end with the run."""

from __future__ import annotations

import select
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.triton_compiler import run_with_the_compiler
from sadgs_ns.training.kernels_ahead import compile_ahead

IDLE_DRIVER = '''
import os, sys
os.setsid()
os.dup2(os.pipe()[0], 0)  # the run's end of which stays open
import torch, triton
from triton.backends.compiler import GPUTarget
from triton.backends.nvidia.compiler import CUDABackend
from triton.backends.nvidia.driver import CudaDriver
from sadgs_ns.training.kernels_ahead import compile_ahead

class IdleDriver(CudaDriver):  # It drives an H100 that does nothing.
    def __init__(self): self.utils = self
    def get_current_device(self): return 0
    def get_current_stream(self, device): return 0
    def get_current_target(self): return GPUTarget("cuda", 90, 32)
    def get_device_properties(self, device): return {"max_shared_mem": 2**20}
    def load_binary(self, *of_kernel): return None, 1, 0, 0, 1024
    def launcher_cls(self, source, metadata): return lambda *arguments: None

def add_stages(backend, stages, options, *_):
    """Compile to nothing: test_kernels_compile.py compiles, and here the keys of the cache count alone."""
    stages["ttir"] = lambda module, metadata: module
    stages["cubin"] = lambda module, metadata: metadata.update(name="kernel", shared=0, tmem_size=0) or b""

CUDABackend.add_stages = add_stages
triton.runtime.driver.set_active(IdleDriver())
'''
AHEAD = f"""{IDLE_DRIVER}
os.sched_getaffinity = lambda process: range(9)
compile_ahead.main()
"""
RUN = f"""{IDLE_DRIVER}
compile_ahead.find_kernels()  # with stand-ins for what would be computed

from dataclasses import replace
from triton import knobs
from sadgs_ns.kernels import triton_switched
from sadgs_ns.training.kernels_ahead.probes import KernelChoice, Stages

found, missing = [], []
def listen(*, src, cache_hit, **_):
    (found if cache_hit else missing).append(src.name)
def launch(choice):
    stages = Stages(choice)
    with triton_switched(True):
        stages.project()
        for stage in (stages.after_projection() | stages.without_projection()).values():
            stage()

knobs.runtime.jit_cache_hook, knobs.compilation.listener = None, listen
choice = KernelChoice(torch.device("cpu"))
launch(choice)
launch(replace(choice, views=1))
launch(replace(choice, views=4, size=(1600, 1200)))
print(len(found), missing)
missing.clear()
launch(replace(choice, has_color_matrices=True))
print(sorted(missing))
missing.clear()
launch(replace(choice, has_gains=True))
print(sorted(missing))
"""


def test_a_run_launches_nothing_that_was_not_compiled_ahead(tmp_path: Path):
    pytest.importorskip("triton", reason="Triton is not installed")
    ahead = run_with_the_compiler(tmp_path, AHEAD, str(tmp_path / "marker"))
    assert ahead.returncode == 0, ahead.stderr[-3000:]
    told = ahead.stdout.splitlines()
    assert len(told) > 20
    assert told == [f"{done} of {len(told)}" for done in range(1, len(told) + 1)]
    assert (tmp_path / "marker").exists()
    run = run_with_the_compiler(tmp_path, RUN)
    assert run.returncode == 0, run.stderr[-3000:]
    default, colors, gains = run.stdout.splitlines()
    assert default == f"{len(told)} []"
    assert colors == str(["_composite_backward"] * 2), "they are an option"
    assert gains == str(["_gradient", "_gradient", "_similarity", "_similarity"]), "and so are gains"


@pytest.mark.parametrize("lacking", ["nothing", "card", "cores", "kernels"])
def test_it_begins_once_on_a_machine_that_has_what_it_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lacking: str
):
    pytest.importorskip("triton", reason="Triton is not installed")
    begun: list[str] = []
    cards = tmp_path / "0000:01:00.0"
    cards.mkdir()
    if lacking != "card":
        (cards / "information").write_text("Model: \t\t NVIDIA H100\nIRQ: 16\n")
    monkeypatch.setattr(compile_ahead, "_CARDS", tmp_path)
    monkeypatch.setattr(compile_ahead.os, "sched_getaffinity", lambda _: range(2 if lacking == "cores" else 3))
    monkeypatch.setattr(compile_ahead.subprocess, "Popen", lambda words, **_: begun.append(words[-1]))
    monkeypatch.setenv("SADGS_TRITON", "0" if lacking == "kernels" else "1")
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    compile_ahead.begin()
    assert len(begun) == (lacking == "nothing")
    for marker in begun:
        assert Path(marker).parent == tmp_path
        Path(marker).touch()
    compile_ahead.begin()
    assert len(begun) <= 1
    (cards / "information").write_text("Model: \t\t NVIDIA A100\nIRQ: 16\n")
    compile_ahead.begin()
    assert len(begun) == 2 * (lacking == "nothing") + (lacking == "card"), "another card"


def test_where_a_kernel_does_not_compile_the_next_run_tries_again(tmp_path: Path):
    pytest.importorskip("triton", reason="Triton is not installed")
    fail = "compile_ahead.find_kernels = lambda: compile_ahead._found.append((None, None, {}))\n"
    run = run_with_the_compiler(tmp_path, f"{IDLE_DRIVER}{fail}compile_ahead.main()", str(tmp_path / "marker"))
    assert run.returncode != 0
    assert not (tmp_path / "marker").exists()


SLOW = """
import os, sys, time
from sadgs_ns.training.kernels_ahead import compile_ahead

def compile_kernel(index):
    os.write(2, b"x")
    time.sleep(600)

compile_ahead.find_kernels = lambda: compile_ahead._found.extend([None] * 2)
compile_ahead.compile_kernel, os.sched_getaffinity = compile_kernel, lambda process: range(3)
compile_ahead.main()
"""


@pytest.mark.hard_case("a run that ends while its kernels are compiled", "leaves no process behind")
@pytest.mark.parametrize("first_is_killed", [False, True])
def test_no_process_outlives_the_run(tmp_path: Path, first_is_killed: bool):
    """It ends as the run's end of a pipe closes, even where the process that forked the others is gone."""
    compiler = subprocess.Popen(
        [sys.executable, "-c", SLOW, str(tmp_path / "marker")],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    with compiler:
        assert compiler.stdin
        assert compiler.stdout
        assert compiler.stderr
        assert compiler.stderr.read(2) == b"xx", "both are at work"
        if first_is_killed:
            compiler.kill()
            assert select.select([compiler.stdout], [], [], 60)[0], "the run knows it"
            assert not compiler.stdout.read(), "the run knows it"
        compiler.stdin.close()
        assert compiler.wait(60) == -signal.SIGKILL
        assert not compiler.stderr.read(), "this ends when nobody holds the other end any more"
    assert not (tmp_path / "marker").exists()
