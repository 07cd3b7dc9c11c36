"""Triton's compiler in a process of its own, without the interpreter that the other tests run kernels in."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path


def run_with_the_compiler(cache: Path, *code: str) -> subprocess.CompletedProcess[str]:
    """Run code and its arguments outside the interpreter of these tests, with a cache of Triton's own."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    environment["TRITON_CACHE_DIR"] = str(cache)
    return subprocess.run([sys.executable, "-c", *code], env=environment, capture_output=True, text=True)
