"""`python -m benchmarks kernels PROTOCOL.yaml --scenes ROOT --output kernels.jsonl`: what each Triton kernel brings.

Each kernel is replaced by its twin, one at a time, in steps of the same run (kernel_loops.py). `ratio` is the time of a
run's steps with the twin, relative to that with all kernels: 1.01 says that the kernel brings 1 %. Kernels that compute
structure tensors run once, before the first step; their twins' additional seconds are added to the steps'. Launches are
those of a step whose kernels are launched one by one.

On two devices, `python -m torch.distributed.run --standalone --nproc-per-node 2 -m benchmarks kernels …` measures what
the kernel that packs what they send each other brings, and nothing else.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tyro.conf import Positional

from benchmarks import kernel_table, protocol, results
from benchmarks.kernel_loops import REFERENCE, Measured, Phase, Rounds, phases_of, run_to, time_images
from benchmarks.kernel_twins import ALL, REFINED, TWINS, Twin
from benchmarks.protocol import Job

WITHOUT = "no kernel"
"""Name of the steps in which all kernels are replaced."""
DISTRIBUTED = "exchange"
"""The kernel that only several devices launch."""


@dataclass(frozen=True)
class Part:
    """Kernels that are replaced in the steps of one run."""

    job: Job
    twins: dict[str, Twin | None]
    once: dict[str, Twin]  # Those of kernels that no step launches
    is_short: bool  # Whether steps after densification are left out


@dataclass(frozen=True)
class Loop:
    """What was measured in a run."""

    phases: list[Phase]
    measured: dict[str, Measured]
    images: dict[str, float]  # Seconds of all structure tensors, with all kernels and with twins
    about: dict[str, Any]  # What rows say of the run


def parts_of(job: Job, devices: int, kernels: Sequence[str], with_options: bool) -> list[Part]:
    """Return the runs that are needed to replace some kernels, or all for an empty list, on a scene."""

    def run(twins: Mapping[str, Twin], once: Mapping[str, Twin], settings: dict[str, Any], is_short: bool) -> Part:
        row = dataclasses.replace(job.row, overrides={**job.row.overrides, **settings})
        chosen: dict[str, Twin | None] = {REFERENCE: None, **twins}
        return Part(dataclasses.replace(job, row=row), chosen, dict(once), is_short)

    wanted = {name: twin for name, twin in {**TWINS, WITHOUT: ALL}.items() if not kernels or name in kernels}
    exchange = wanted.pop(DISTRIBUTED, None)
    if devices > 1:
        if exchange is None:
            return []
        return [run({DISTRIBUTED: exchange}, {}, {"share_always": True}, is_short=False)]
    once = {name: twin for name, twin in wanted.items() if twin.is_once}
    plain = {name: twin for name, twin in wanted.items() if not twin.is_once and not twin.settings}
    optional = {name: twin for name, twin in wanted.items() if twin.settings}
    parts = []
    if plain or once:
        parts.append(run(plain, once, {}, is_short=False))
    if optional and with_options:
        parts.append(run(optional, {}, REFINED, is_short=True))
    return parts


def measure(part: Part, root: Path, devices: int, rounds: int, limit: float) -> Loop:
    """Train to the steps that are timed, and time them; raise as `benchmarks.run.set_up`.

    `limit` is in seconds, of all rounds; several devices do all rounds, because their clocks would differ.
    """
    import nerfstudio.scripts.train  # noqa: F401 - it sets cuDNN as in a user's run

    from benchmarks.run import set_up

    if devices > 1:
        limit = math.inf
    names = [*part.twins]
    measured = {name: Measured() for name in names}
    with tempfile.TemporaryDirectory() as work:
        trainer = set_up(part.job, root, Path(work), devices, {})
        pipeline = trainer.pipeline
        model = pipeline.model
        pipeline.structure_cache.fill()
        pipeline.train()
        images = {}
        if part.once:
            images = {REFERENCE: time_images(trainer, None)}
            images |= {name: time_images(trainer, twin) for name, twin in part.once.items()}
        plan = model.plan
        phases = phases_of(model.strategy.windows, plan.iterations)
        if part.is_short:
            phases = phases[:1]
        timing = Rounds(trainer, part.twins, measured)
        done = 0
        gaussians = {}
        for phase in phases:
            run_to(trainer, done, phase.begin)
            done = phase.begin
            gaussians[phase.name] = model.num_gaussians
            timing.run(phase, rounds, limit / len(phases))
        pipeline.views.close()
    gpu = None
    if torch.cuda.is_available():
        gpu = torch.cuda.get_device_name()
    about = {"iterations": plan.iterations, "views_per_iteration": plan.views_per_iteration, "gaussians": gaussians}
    return Loop(phases, measured, images, {**about, "devices": devices, "gpu": gpu})


def rows_of(part: Part, loop: Loop) -> list[dict[str, Any]]:
    """Return a row for each twin, and for the reference if the run is that of one device without options."""
    reference = loop.measured[REFERENCE]
    rows = []
    for name, twin in part.twins.items():
        if twin is None and (part.is_short or loop.about["devices"] > 1):
            continue
        rows.append({**_identity(part.job, name, twin), **_of_steps(loop, loop.measured[name], twin), **loop.about})
    for name, twin in part.once.items():
        more = loop.images[name] - loop.images[REFERENCE]
        seconds = {"images_seconds": loop.images[name], "images_seconds_of_kernel": loop.images[REFERENCE]}
        measured = {"status": "failed", "error": reference.error, **seconds}
        if not reference.error:
            of_steps = seconds_of(loop.phases, reference)
            ratio = (of_steps + more) / of_steps
            measured |= {"status": "ok", "error": None, "ratio": ratio, "steps_seconds": of_steps}
        rows.append({**_identity(part.job, name, twin), **measured, **loop.about})
    return rows


def _identity(job: Job, name: str, twin: Twin | None) -> dict[str, Any]:
    """Return the part of a row that says what was measured."""
    by = ""
    settings = {}
    if twin is not None:
        by = twin.by
        settings = twin.settings
    key = f"{job.scene.name}/{name}/{job.seed}"
    return {"key": key, "scene": job.scene.name, "label": name, "seed": job.seed, "by": by, "settings": settings}


def _of_steps(loop: Loop, measured: Measured, twin: Twin | None) -> dict[str, Any]:
    """Return the part of a row that was measured in steps."""
    reference = loop.measured[REFERENCE]
    error = reference.error or measured.error
    if error:
        return {"status": "failed", "error": error}
    ratios = [
        seconds_of(loop.phases, measured, number) / seconds_of(loop.phases, reference, number)
        for number in range(_rounds_of(loop.phases, measured))
    ]
    milliseconds = {}
    for phase in loop.phases:
        milliseconds[phase.name] = statistics.median(measured.seconds[phase.name]) / phase.steps * 1e3
    with_kernel = None
    if twin is not None:
        with_kernel = _launches(loop.phases, reference)
    graphs = measured.failure
    if twin is not None and twin.waits:
        graphs = "the host waits for the device in its place, so that no step can be a CUDA graph"
    return {
        "status": "ok",
        "error": None,
        "ratio": statistics.median(ratios),
        "low": min(ratios),
        "high": max(ratios),
        "rounds": len(ratios),
        "steps_seconds": seconds_of(loop.phases, measured),
        "ms": milliseconds,
        "launches": _launches(loop.phases, measured),
        "launches_with_kernel": with_kernel,
        "launches_of_phases": measured.launches,
        "replayed": measured.replayed,
        "no_graphs": graphs,
    }


def _launches(phases: Sequence[Phase], measured: Measured) -> float | None:
    """Return how many kernels a step of the run launches, or None where that was not counted."""
    if not measured.launches:
        return None
    launches = 0.0
    for phase in phases:
        launches += phase.weight * measured.launches[phase.name]
    return launches / sum(phase.weight for phase in phases)


def _rounds_of(phases: Sequence[Phase], measured: Measured) -> int:
    """Return in how many rounds all phases were timed."""
    return min(len(measured.seconds[phase.name]) for phase in phases)


def seconds_of(phases: Sequence[Phase], measured: Measured, number: int | None = None) -> float:
    """Return the seconds of all steps of a run, if those of each phase take as long as in a round, or as the median."""
    seconds = 0.0
    for phase in phases:
        of_rounds = measured.seconds[phase.name]
        if number is None:
            of_phase = statistics.median(of_rounds)
        else:
            of_phase = of_rounds[number]
        seconds += phase.weight * of_phase / phase.steps
    return seconds


def line(row: Mapping[str, Any]) -> str:
    """Return a row in one line."""
    if row["status"] != "ok":
        return f"{row['scene']} {row['label']}: failed: {row['error']}"
    text = f"{row['scene']} {row['label']}: {row['steps_seconds']:.2f} s, ratio {row['ratio']:.4f}"
    if row.get("launches") is not None:
        text = f"{text}, {row['launches']:.1f} launches"
    return text


@dataclass
class Command:
    """Measure what each Triton kernel brings, by training steps with its twin in its place."""

    protocol: Positional[Path]
    """YAML file with the scenes, and the row whose run is measured"""
    scenes: Path
    """folder that holds the scenes"""
    output: Path
    """JSON-lines file that the rows are added to"""
    only: tuple[str, ...] = ("bonsai", "site")
    """scenes; the kernels of poses and colours, which need options, are measured on the first one"""
    row: str = "sadgs"
    """label of the row whose run is measured"""
    kernels: tuple[str, ...] = ()
    """names of kernels, such as tiles; the default is all"""
    rounds: int = 5
    """how often each twin's steps are timed, if the limit allows it"""
    limit: float = 50.0
    """seconds of all rounds of a run after which no further one begins"""

    def jobs(self) -> list[Job]:
        """Return the run of each scene; raise ValueError if the protocol has none, or a kernel is unknown."""
        known = [*TWINS, WITHOUT]
        for name in self.kernels:
            if name not in known:
                raise ValueError(f"--kernels names {name!r}; give some of {', '.join(known)}.")
        jobs = []
        every = protocol.load(self.protocol).jobs()
        for scene in self.only:
            found = [job for job in every if job.row.label == self.row and job.scene.name == scene]
            if not found:
                raise ValueError(f"{self.protocol} has no row {self.row!r} of the scene {scene!r}.")
            row = dataclasses.replace(found[0].row, curve_every=None)
            jobs.append(dataclasses.replace(found[0], row=row))
        return jobs

    def __call__(self) -> int:
        """Measure; return 0, or 1 if a kernel's twin failed."""
        from benchmarks.run import software
        from sadgs_ns.training.run import processes

        devices = processes.number_of_processes()
        rows = []
        for number, job in enumerate(self.jobs()):
            for part in parts_of(job, devices, self.kernels, with_options=number == 0):
                loop = measure(part, self.scenes.resolve(), devices, self.rounds, self.limit)
                if not processes.is_rank_zero():
                    continue
                for row in rows_of(part, loop):
                    row["versions"] = software()
                    results.append(self.output, row)
                    print(line(row), flush=True)
                    rows.append(row)
        processes.leave()
        if rows:
            print(f"\n{kernel_table.markdown(rows)}")
        return int(any(row["status"] != "ok" for row in rows))
