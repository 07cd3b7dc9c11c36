"""`python -m benchmarks chain PROTOCOL.yaml --photos ROOT --output rows.jsonl --label NAME`: from photos to the file.

Other benchmarks compare renderings of a run with images that were undistorted before. This one starts from photos as
they were taken, and compares the exported file with the original photos: it measures what a user gets.

A chain is four commands of the package, in processes of their own: `sadgs-process` places the cameras of all photos,
`ns-train sadgs` trains on all but every eighth photo, and `sadgs-export` writes the file; then `chain_score` draws the
file and compares it with the photos that were held out. With `--site`, the commands are those of another version of
the package, while the score is always this checkout's. Poses come from all photos, held-out ones included, as is usual.
"""

from __future__ import annotations

import dataclasses
import datetime
import json
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import results
from benchmarks.chain_table import markdown
from benchmarks.photo_captures import PhotoCommand, exit_status, load_protocol, photos_of, write_row, written_row
from benchmarks.side_by_side import append_output, environment_of, run_program

INTERVAL = 8  # Every so many photos, from the first in the order of their names, one is held out.
LOADER = (
    "import sys; from importlib.metadata import entry_points; name = sys.argv[1]; sys.argv = sys.argv[1:]; "
    "(script,) = {s for s in entry_points(group='console_scripts') if s.name == name}; sys.exit(script.load()())"
)
"""A program that runs one of the package's commands, which need not be on the PATH."""
_SCORER = "import sys; sys.argv = sys.argv[1:]; from benchmarks.chain_score import main; main()"
"""A program that writes the score of a file."""
_GAINS = "import sys; sys.argv = sys.argv[1:]; from benchmarks.held_out_gains import main; main()"
"""A program that writes the gains of a run's held-out photos."""


@dataclass(frozen=True)
class Protocol:
    """What a chain benchmark runs."""

    captures: dict[str, str]  # Folders of photos below a root, by the captures' names
    seeds: list[int]  # Seeds of training
    max_size: int = 1600  # Longest side of images in px, in training and in the comparison
    effort: float = 1.0
    gains: bool = False
    """Whether training uses gains of exposure where it varies; a second score then has each photo's gain."""


@dataclass(frozen=True)
class Chain:
    """One way from photos to a score."""

    capture: str
    photos: Path
    seed: int
    label: str
    max_size: int
    effort: float
    gains: bool = False

    @property
    def key(self) -> str:
        """Name of this chain among the rows of a file."""
        return f"{self.capture}/{self.label}/{self.seed}"


def load(path: Path) -> Protocol:
    """Read a protocol. Raises ValueError, one sentence, if it is not as `Protocol` says."""
    return load_protocol(path, Protocol, "a chain")


def held_out(names: Sequence[str]) -> list[str]:
    """Return the photos that training does not see."""
    return list(names[::INTERVAL])


def photo_of(image: str, photos: Sequence[str]) -> str | None:
    """Return the photo of a scene's image, whose name is the photo's, or that and another suffix."""
    if image in photos:
        return image
    without = image.rpartition(".")[0]
    if without in photos:
        return without
    return None


def hold_out(scene: Path, photos: Sequence[str]) -> int:
    """Write into a scene's `transforms.json` which images are held out, and return the number of the others."""
    file = scene / "transforms.json"
    described = json.loads(file.read_text("utf8"))
    names = [frame["file_path"] for frame in described["frames"]]
    held = [name for name in names if photo_of(name.removeprefix("images/"), photos) is not None]
    described["train_filenames"] = [name for name in names if name not in held]
    described["val_filenames"] = held
    described["test_filenames"] = held
    file.write_text(json.dumps(described, indent=4), "utf8")
    return len(names) - len(held)


def run_chain(chain: Chain, work: Path, site: Path | None) -> dict[str, Any]:
    """Run a chain in a folder and return its row.

    Raises subprocess.CalledProcessError if a command fails; its output is in `work/log`.
    """
    environment = environment_of(None, site)
    seconds: dict[str, float] = {}

    def call(stage: str, *words: str) -> None:
        begin = time.perf_counter()
        run_program(LOADER, words, work, environment)
        seconds[stage] = round(time.perf_counter() - begin, 2)

    scene = work / "scene"
    call("cameras", "sadgs-process", str(chain.photos), str(scene), "--max-size", str(chain.max_size))
    tests = held_out(photos_of(chain.photos))
    train_views = hold_out(scene, tests)
    run = work / "out" / "chain" / "sadgs" / "run"
    options = ["--output-dir", str(work / "out"), "--experiment-name", "chain", "--timestamp", "run", "--vis", "none"]
    options += ["--machine.seed", str(chain.seed), "--pipeline.effort", f"{chain.effort:g}", "--data", str(scene)]
    if chain.gains:
        options += ["--pipeline.model.exposure", "auto"]
    call("training", "ns-train", "sadgs", *options)
    splat = work / "splat.ply"
    call("export", "sadgs-export", str(run), "--output", str(splat), "--frame", "colmap")
    score = work / "score.json"
    words = ["chain_score", str(scene), str(chain.photos), str(splat), str(score), "--max-size", str(chain.max_size)]
    if chain.gains:
        gains = work / "gains.json"
        run_program(_GAINS, ["held_out_gains", str(run / "config.yml"), str(gains)], work, environment)
        words += ["--gains", str(gains)]
    run_program(_SCORER, words, work, environment_of(None))
    return {"seconds": seconds, "train_views": train_views, **json.loads(score.read_text())}


def row_of(chain: Chain, work: Path, site: Path | None, log: Path) -> dict[str, Any]:
    """Run a chain, and return its row; if a command fails, the chain's output is added to a log."""
    date = now()
    try:
        measured = run_chain(chain, work, site)
    except subprocess.CalledProcessError as error:
        append_output(chain.key, work, log)
        name = error.cmd[3]  # It follows Python, "-c" and the code.
        return failed(chain, date, f"{name} ended with code {error.returncode}; see {log}.")
    return {**identity(chain, date), "status": "ok", "error": None, **measured}


def failed(chain: Chain, date: str, error: str) -> dict[str, Any]:
    """Return the row of a chain that has no score."""
    return {**identity(chain, date), "status": "failed", "error": error}


def identity(chain: Chain, date: str) -> dict[str, Any]:
    """Return what a row begins with."""
    return {"key": chain.key, "scene": chain.capture, "label": chain.label, "seed": chain.seed, "date": date}


def now() -> str:
    """Return the time in UTC."""
    return datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")


@dataclass
class Command(PhotoCommand):
    """Measure the way from photos to the exported file, or what is left of it."""

    site: Path | None = None
    """folder with another version of the package, whose commands run; the default is this checkout"""
    only: str = ""
    """captures to run, with commas between; the default is all"""
    gpus: str | None = None
    """such as 0,1: one chain at a time on each (default: one, on the first visible one)"""

    def chains(self) -> list[Chain]:
        """Return the chains that are asked for; raise ValueError if a capture is not there."""
        protocol = load(self.protocol)
        names = list(protocol.captures)
        if self.only:
            names = self.only.split(",")
        folders = {}
        for name in names:
            if name not in protocol.captures:
                raise ValueError(f"--only names {name!r}; the protocol has {', '.join(protocol.captures)}.")
            folders[name] = self.folder_of(protocol.captures[name])
        chains = []
        for seed in protocol.seeds:
            for name in names:
                folder = folders[name]
                chain = Chain(name, folder, seed, self.label, protocol.max_size, protocol.effort, protocol.gains)
                chains.append(chain)
        return chains

    def __call__(self) -> int:
        """Run them; return 0, 1 if one failed, or 130 after an interrupt."""
        chains = self.chains()
        done = self.done_keys()
        log = self.output.with_suffix(".log").resolve()
        todo = [chain for chain in chains if chain.key not in done]
        gpus: Sequence[str | None] = (None,)
        if self.gpus:
            gpus = self.gpus.split(",")

        def launch(chain: Chain, gpu: str | None, work: Path) -> subprocess.Popen[bytes]:
            return _start(chain, gpu, work, self.site, log)

        def ended(chain: Chain, code: int, work: Path) -> None:
            problem = f"the chain ended with code {code} and no row; its process said why."
            row = written_row(work, lambda: failed(chain, now(), problem))
            results.append(self.output, row)
            print(f"{chain.key}: {line(row)}", flush=True)

        if not self.run(todo, launch, ended, gpus):
            return 130
        rows = results.read(self.output)
        print(markdown(rows))
        return exit_status(rows, {chain.key for chain in chains})


def _start(chain: Chain, gpu: str | None, work: Path, site: Path | None, log: Path) -> subprocess.Popen[bytes]:
    """Start a chain in a session of its own, so that the commands that it runs can be ended with it."""
    spec = json.dumps({**dataclasses.asdict(chain), "photos": str(chain.photos)})
    installed = ""
    if site is not None:
        installed = str(site.resolve())
    command = [sys.executable, "-m", "benchmarks.chain", spec, str(work), installed, str(log)]
    return subprocess.Popen(command, env=environment_of(gpu), start_new_session=True)


def line(row: Mapping[str, Any]) -> str:
    """Return a finished chain in one line."""
    if row["status"] != "ok":
        return f"failed: {row['error']}"
    stages = ", ".join(f"{stage} {value:.1f}" for stage, value in row["seconds"].items())
    quality = f"PSNR {row['psnr']:.2f}, SSIM {row['ssim']:.4f}"
    if row["lpips"] is not None:
        quality = f"{quality}, LPIPS {row['lpips']:.4f}"
    registered = f"{row['registered']} of {row['photos']} photos"
    return f"{quality}; {registered}; seconds: {stages}"


def main() -> None:
    """Run one chain in this process and write its row; `_start` calls it."""
    spec, work, installed, log = sys.argv[1:]
    fields = json.loads(spec)
    chain = Chain(**{**fields, "photos": Path(fields["photos"])})
    site = None
    if installed:
        site = Path(installed)
    row = row_of(chain, Path(work), site, Path(log))
    write_row(Path(work), row)


if __name__ == "__main__":
    main()
