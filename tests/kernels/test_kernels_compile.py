"""Every Triton kernel compiles for NVIDIA's GPUs, which the interpreter does not show; no GPU is needed for that."""

from __future__ import annotations

from pathlib import Path

import pytest

from helpers.triton_compiler import run_with_the_compiler

pytest.importorskip("triton", reason="Triton is not installed")

COMPILE = """
import importlib, pkgutil
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
import sadgs_ns.kernels as package

CONSTANTS = {
    "GAUSSIAN": (0.25, 0.5, 0.25), "ROWS": 16, "COLUMNS": 128, "TILE": 8, "LANES": 32,
    "BLOCK": 1024, "BLUR": 0.3, "MARGIN": 0.3, "EPSILON": 1e-5,
    "VERTICAL": False, "MAX": 1e18, "PIXELS": 1024, "HIGHEST": 4.0, "FAR": 1e10,
    "OCTAVES": 12.0, "INVALID": 255, "WIDTHS": (3, 45, 1), "PER_GAUSSIAN": 2, "GAUSSIANS": 16, "STRIDE": 12,
    "ALPHAS": True, "ABSGRAD": True, "PRECISION": "tf32x3", "PENALTY": True, "LEARNED": True, "CULL": True,
    "DEPTHS": True, "PASSED": True, "POSES": True, "EXCUSES": True, "FLAGS": 1, "FEW": 64,
    "PART": 256,
}
INTEGERS = "n row height width taps num_gaussians num_views tile_width tile_height used stride".split()
INTEGERS += "channels weight_stride num_pairs rows view absolute_view absolute_row num_programs num_tiles".split()
INTEGERS += ["rows_per_view", "halvings", "of_pairs", "num_parts", "row2d", "row_conic"]
FLOATS = "exponent frequency beta1 beta2 log_beta1 log_beta2 eps l1_weight ssim_weight l2_weight".split()
FLOATS += "scale_x scale_y ssim_lambda half_width half_height reach_x reach_y penalty top near_plane".split()
FLOATS += ["clipped_from"]
POINTERS = {
    "view_ids": "*i64", "moved": "*u8",
    "radii": "*i32", "counts": "*i64", "order": "*i64", "ends": "*i64", "tiles": "*i16", "ids": "*i32",
    "by_tile": "*i64", "ordered": "*i32", "parts": "*i64", "part_count": "*i64", "overflowed": "*i64",
    "places": "*i64",
    "structure_tensors": "*u8", "starts": "*i32", "last_ids": "*i32",
}
TUPLES = {  # of Adam's kernel; the names mean single tensors elsewhere
    **dict.fromkeys(["parameters", "gradients", "means", "squares"], ("*fp32",) * 3),
    **dict.fromkeys(["rates", "scales"], ("*fp32",) * 3),
    "overflowed": ("*i64",),
}

compiled = []
for module in pkgutil.iter_modules(package.__path__):
    kernels = vars(importlib.import_module(f"sadgs_ns.kernels.{module.name}"))
    for name, kernel in kernels.items():
        # Kernels are launched from Python; the functions that they call return values and are compiled with them.
        if not isinstance(kernel, triton.JITFunction) or "tl.program_id(" not in kernel.src and name != "_write_one":
            continue
        signature, constants = {}, {}
        for i, parameter in enumerate(kernel.params):
            if parameter.is_constexpr:
                signature[parameter.name], constants[(i,)] = "constexpr", CONSTANTS[parameter.name]
            elif name == "_update" and parameter.name in TUPLES:
                signature[parameter.name] = TUPLES[parameter.name]
            elif parameter.name in INTEGERS:
                signature[parameter.name] = "i32"
            elif parameter.name in FLOATS:
                signature[parameter.name] = "fp32"
            else:
                signature[parameter.name] = POINTERS.get(parameter.name, "*fp32")
        others = dict.fromkeys(["_list", "_list_parts", "_order"], {"tiles": "*i32"})
        others |= dict.fromkeys(["_similarity", "_gradient"], {"y": "*u8"})
        signatures = [signature, *([signature | others[name]] if name in others else [])]
        for signature in signatures:
            for capability in (80, 90):  # A100, H200
                triton.compile(ASTSource(kernel, signature, constants), target=GPUTarget("cuda", capability, 32))
        compiled.append(name)
print(" ".join(compiled))
"""


def test_every_kernel_compiles_for_an_a100_and_an_h200(tmp_path):
    run = run_with_the_compiler(tmp_path, COMPILE)
    assert run.returncode == 0, run.stderr[-3000:]
    expected = {"_similarity", "_gradient", "_count", "_list", "_observe"}
    expected |= {"_forward", "_backward", "_update", "_correlate", "_differentiate", "_aggregate", "_write_one"}
    expected |= {"_composite_backward", "_composite_forward", "_accumulate_gradients", "_finish", "_order"}
    expected |= {
        "_list_parts",
        "_pack",
        "_unpack",
        "_activate",
        "_activate_backward",
        "_project_backward",
        "_project_forward",
        "_correct_poses",
        "_correct_poses_backward",
        "_move_rows",
    }
    assert set(run.stdout.split()) == expected


WIDE = """
import re
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from sadgs_ns.kernels.adam import _update

tensors = ["parameters", "gradients", "means", "squares"]
signature, aligned = {}, {}
for i, parameter in enumerate(_update.params):
    name = parameter.name
    if name in tensors:
        signature[name] = ("*fp32",) * 3
        aligned |= {(i, k): [["tt.divisibility", 16]] for k in range(3)}
    elif name in ("rates", "scales"):
        signature[name] = ("*fp32",) * 3
    else:
        others = {"nonfinite_flag": "*fp32", "overflowed": ("*i64",), "rows": "i32"}
        others |= {"beta1": "fp32", "beta2": "fp32", "eps": "fp32"}
        signature[name] = others.get(name, "constexpr")
constants = {"WIDTHS": (3, 45, 1), "FLAGS": 1, "MAX": 1e18, "BLOCK": 1024}
ptx = triton.compile(ASTSource(_update, signature, constants, aligned), target=GPUTarget("cuda", 90, 32)).asm["ptx"]
print(len(re.findall(r"ld\\.global\\.v4", ptx)), len(re.findall(r"st\\.global\\.v4", ptx)))
"""


def test_adam_reads_and_writes_memory_in_wide_words_whichever_parameter_it_is(tmp_path):
    """Each of 128 threads has 8 numbers of a block: two words for each of four tensors, of which three are written."""
    run = run_with_the_compiler(tmp_path, WIDE)
    assert run.stdout.split() == ["8", "6"], run.stderr[-3000:]


TIMED = """
import sys
import time
sys.path.insert(0, sys.argv[1])
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from helpers.compile_timer import CompileTimer
from sadgs_ns.kernels.trial import _write_one

def compile():
    triton.compile(ASTSource(_write_one, {"target": "*fp32"}, {}), target=GPUTarget("cuda", 90, 32))

begin = time.perf_counter()
with (timer := CompileTimer()):
    compile()
assert 0 < timer.seconds <= time.perf_counter() - begin
seconds = timer.seconds
with timer:
    compile()
assert timer.seconds == seconds, "the cache held it"
triton.knobs.cache.dir += "-of-another-machine"
compile()
assert timer.seconds == seconds, "nobody listens"
triton.knobs.cache.dir += "-and-another"
with timer:
    compile()
assert timer.seconds > seconds
print("done")
"""


def test_the_timer_of_the_tests_knows_how_long_triton_compiled(tmp_path):
    run = run_with_the_compiler(tmp_path / "cache", TIMED, str(Path(__file__).parents[1]))
    assert run.stdout.split() == ["done"], run.stderr[-3000:]
