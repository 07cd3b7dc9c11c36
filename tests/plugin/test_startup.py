"""What `ns-train` does not import: every run waits for it."""

from __future__ import annotations

import subprocess
import sys

LATER = ("sadgs_ns.cli.export", "pycolmap", "torchmetrics", "matplotlib.figure", "open3d", "jinja2.sandbox", "sklearn")


def test_the_methods_import_nothing_that_training_does_not_need():
    start = "import sys, torch, sadgs_ns.plugin.presets, sadgs_ns.plugin.model"
    start += "; from sadgs_ns.method.initialization import neighbour_scales; neighbour_scales(torch.rand(9, 3))"
    code = f"{start}; print([name for name in {LATER} if name in sys.modules])"
    run = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"
