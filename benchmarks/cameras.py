"""`python -m benchmarks cameras PROTOCOL.yaml --photos ROOT --output rows.jsonl --label NAME`: the accuracy of cameras.

Nobody knows where photos were taken. So each capture is placed with several seeds of COLMAP's random samples, and the
models are compared with each other: what one sees elsewhere than another is an error of at least one of them. Each
model is adjusted in the end by several losses (`VARIANTS`), from the same state. The protocol may also hold captures
that are drawn, whose cameras are known (`camera_truth.py`).

Features and matches are found once for all seeds of a capture; their verification and all that follows is done anew by
each. Every capture has a process of its own, because COLMAP may end it.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks import results
from benchmarks.camera_table import markdown, markdown_of_truths
from benchmarks.chain import now
from benchmarks.photo_captures import PhotoCommand, exit_status, load_protocol, photos_of
from benchmarks.side_by_side import environment_of
from sadgs_ns.errors import InputError
from sadgs_ns.placing.conversion import convert_photos
from sadgs_ns.placing.photos import photos_by_camera, photos_by_camera_and_folder, read_photos


@dataclass(frozen=True)
class Loss:
    """A loss of the last adjustment."""

    name: str  # Of COLMAP's LossFunctionType
    scale: float  # Residual in px from which it grows more slowly than the square
    tolerance: float  # Relative change of the cost at which the adjustment ends
    filters_first: bool = False  # Whether observations that do not fit are left out before it, not only after it


VARIANTS: dict[str, Loss | None] = {
    "released": None,
    "squared": Loss("TRIVIAL", 1.0, 1e-5, filters_first=True),
    "cauchy-0.5": Loss("CAUCHY", 0.5, 1e-3),
    "soft-l1": Loss("SOFT_L1", 1.0, 1e-3),
}
"""Losses of the last adjustment. None is the package's own, and "squared" COLMAP's own: its mapper filters, too."""


@dataclass(frozen=True)
class Protocol:
    """What a benchmark of cameras runs."""

    captures: dict[str, str]  # Folders of photos below a root, by the captures' names
    seeds: list[int]  # Seeds of COLMAP's random samples
    truths: dict[str, dict[str, float]] = field(default_factory=dict)  # Fields of `camera_truth.Truth`, by name


@dataclass(frozen=True)
class Job:
    """One capture, or a drawn one, with all seeds and variants."""

    name: str
    label: str
    seeds: list[int]
    variants: list[str]
    folder: str = ""  # Of the photos; none of a drawn capture
    truth: dict[str, float] = field(default_factory=dict)

    def key(self, variant: str) -> str:
        """Name of a variant's row among the rows of a file."""
        return f"{self.name}/{self.label}/{variant}"

    def row(self, variant: str, date: str, **measured: Any) -> dict[str, Any]:
        """Return a variant's row; it stands for all seeds."""
        identity = {"key": self.key(variant), "scene": self.name, "label": self.label, "variant": variant}
        return {**identity, "seed": None, "seeds": self.seeds, "date": date, **measured}

    def failed(self, date: str, error: str) -> list[dict[str, Any]]:
        """Return the rows of a capture that could not be measured."""
        return [self.row(variant, date, status="failed", error=error) for variant in self.variants]


@dataclass(frozen=True)
class Photos:
    """The photos of a capture, as `sadgs_ns.placing.reconstruct` takes them."""

    folder: Path
    groups: list[list[str]]  # Names of the photos of each camera
    alike: list[list[str]]  # Names of photos whose cameras may be one
    rigs: list[list[str]]  # Names of the views of each panorama

    @property
    def names(self) -> list[str]:
        """Names of all photos and views."""
        return sorted(name for group in [*self.groups, *self.rigs] for name in group)


def load(path: Path) -> Protocol:
    """Read a protocol. Raises ValueError, one sentence, if it is not as `Protocol` says."""
    return load_protocol(path, Protocol, "captures")


def prepare(folder: Path, work: Path) -> Photos:
    """Read the photos of a folder, convert those that COLMAP does not read, and group them as `place_photos` does."""
    photos = read_photos(folder, photos_of(folder), lambda stage, done, total: None)
    folder, views = convert_photos(folder, photos, work / "photos")
    single = [view for view in views if view.camera]  # Views of panoramas have none.
    rigs = [[view.name for view in photo.views] for photo in photos if photo.is_panorama]
    return Photos(folder, photos_by_camera_and_folder(single), photos_by_camera(single), rigs)


@dataclass
class Command(PhotoCommand):
    """Measure how accurately cameras are placed, or what is left of it."""

    seeds: tuple[int, ...] = ()
    """seeds of COLMAP's random samples; the default is the protocol's"""
    only: tuple[str, ...] = ()
    """captures to measure; the default is all"""
    variant: tuple[str, ...] = ()
    """losses of the last adjustment: released, squared, cauchy-0.5, soft-l1; the default is all"""

    def jobs(self) -> list[Job]:
        """Return what is asked for; raise ValueError if there is no such capture, variant or folder."""
        protocol = load(self.protocol)
        seeds = list(self.seeds) or protocol.seeds
        variants = list(self.variant) or list(VARIANTS)
        names = list(self.only) or [*protocol.captures, *protocol.truths]
        unknown = [name for name in variants if name not in VARIANTS]
        if unknown:
            raise ValueError(f"--variant names {unknown[0]!r}; there are {', '.join(VARIANTS)}.")
        jobs = []
        for name in names:
            if name in protocol.truths:
                jobs.append(Job(name, self.label, seeds, variants, truth=protocol.truths[name]))
            elif name in protocol.captures:
                folder = self.folder_of(protocol.captures[name])
                jobs.append(Job(name, self.label, seeds, variants, folder=str(folder)))
            else:
                known = ", ".join([*protocol.captures, *protocol.truths])
                raise ValueError(f"--only names {name!r}; the protocol has {known}.")
        return jobs

    def __call__(self) -> int:
        """Run them; return 0, 1 if one failed, or 130 after an interrupt."""
        jobs = self.jobs()
        todo = [job for job in jobs if not is_done(job, results.read(self.output, missing_ok=True))]

        def ended(job: Job, code: int, work: Path) -> None:
            for row in written_rows(job, code, work):
                results.append(self.output, row)
                print(line(row), flush=True)

        if not self.run(todo, _start, ended):
            return 130
        rows = results.read(self.output)
        for table in (markdown(rows), markdown_of_truths(rows)):
            if table:
                print(f"\n{table}")
        return exit_status(rows, {job.key(variant) for job in jobs for variant in job.variants})


def is_done(job: Job, rows: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether rows have all variants of a job, with its seeds."""
    done = {row["key"] for row in rows if row["status"] == "ok" and row["seeds"] == job.seeds}
    return all(job.key(variant) in done for variant in job.variants)


def _start(job: Job, gpu: str | None, work: Path) -> subprocess.Popen[bytes]:
    """Start the process of a capture in a session of its own."""
    command = [sys.executable, "-m", "benchmarks.cameras", json.dumps(vars(job)), str(work)]
    return subprocess.Popen(command, env=environment_of(gpu), start_new_session=True)


def written_rows(job: Job, code: int, work: Path) -> list[dict[str, Any]]:
    """Return the rows that the process of a capture wrote, or those that say that it ended without."""
    written = work / "rows.json"
    if written.exists():
        return json.loads(written.read_text("utf8"))
    return job.failed(now(), f"the process ended with code {code} and no rows; it said why.")


def line(row: Mapping[str, Any]) -> str:
    """Return a row in one line."""
    if row["status"] != "ok":
        return f"{row['key']}: failed: {row['error']}"
    if "centres" in row:
        return f"{row['key']}: centres {row['centres']} %, rotations {row['rotations']}°"
    moved = [f"{pair['mean']:.4f}" for pair in row["pairs"]]
    left_out = [f"{errors['median']:.4f}" for errors in row["left_out"]]
    return f"{row['key']}: between seeds {', '.join(moved)} px; left out {', '.join(left_out)} px"


def machine() -> dict[str, Any]:
    """Return the name of the processor and the number of its cores that this process may use."""
    name = platform.processor()
    described = Path("/proc/cpuinfo")
    if described.exists():
        models = [text.partition(":")[2].strip() for text in described.read_text().splitlines() if "model name" in text]
        name = next(iter(models), name)
    cores = os.cpu_count()
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    return {"cpu": name, "cores": cores}


def rows_of(job: Job, work: Path) -> list[dict[str, Any]]:
    """Measure a capture in this process, and return a row for each variant."""
    date = now()
    try:
        photos = None
        if job.folder:
            photos = prepare(Path(job.folder), work)
        from benchmarks import camera_run  # Pillow may not write PNGs once pycolmap is imported.

        if photos is None:
            measured = camera_run.measure_truth(job)
        else:
            measured = camera_run.measure_capture(job, photos, work)
    except (InputError, ValueError) as error:
        return job.failed(date, str(error))
    about = {**machine(), **camera_run.about()}
    return [job.row(variant, date, status="ok", error=None, **measured[variant], **about) for variant in job.variants]


def main() -> None:
    """Measure one capture and write its rows; `_start` calls it."""
    described, folder = sys.argv[1:]
    work = Path(folder)
    rows = rows_of(Job(**json.loads(described)), work)
    (work / "rows.json").write_text(json.dumps(rows), "utf8")


if __name__ == "__main__":
    main()
