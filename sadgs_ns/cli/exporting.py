"""The export of `sadgs`: all formats in one process, which imports what they need while training runs."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

import scipy.cluster.vq  # noqa: F401 - for pages; `export` itself imports it, and what is below, when it is called

from sadgs_ns.cli.export import Export, export
from sadgs_ns.events import report
from sadgs_ns.training.run.deferred_imports import import_nerfstudio

import_nerfstudio()  # It precedes what imports nerfstudio.

from sadgs_ns.data import parsers, run_cameras  # noqa: E402, F401
from sadgs_ns.geometry import cleaning  # noqa: E402, F401
from sadgs_ns.training.run import checkpoints  # noqa: E402, F401


def export_all(jobs: Sequence[Export]) -> None:
    """Export as `export` does, print the command that would, and report each file before and after it is made."""
    for job in jobs:
        words = ["sadgs-export", str(job.run), "--output", str(job.output), "--data", str(job.data)]
        if job.title is not None:
            words += ["--title", job.title]
        print("$", shlex.join(words))
        report("export begins", output=str(job.output))
        export(job)
        report("export ends", output=str(job.output))
