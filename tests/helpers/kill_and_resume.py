"""Kill training runs with SIGKILL and resume them, until one ends; compare it with a run that nothing disturbed.

    PYTHONPATH=. python tests/helpers/kill_and_resume.py FOLDER [--kills 10] [--iterations 300] [--seed 0]

Every attempt is a process of its own, forked before torch has computed anything. The places of the kills are drawn from
the seed: within a step, after a step, right after a structure split, with half a checkpoint written, and between a
checkpoint's renaming and the deletion of the one before it; every sixth kill comes from outside, after a random time.
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import io
import multiprocessing
import os
import random
import shutil
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    # Importing our presets asks torch for a GPU, after which CUDA fails in forks. All runs here are on the CPU.
    os.environ["CUDA_VISIBLE_DEVICES"] = ""

import numpy as np
import torch
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.utils.rich_utils import CONSOLE

from examples.drawn_scene.demonstration import fit_densification
from examples.drawn_scene.scene import EVAL_INTERVAL, SPARSE_FOLDER, write_scene
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.presets import sadgs
from sadgs_ns.training.run.trainer import SadgsTrainer
from sadgs_ns.training.step.optimizers import AdamUpdate

PLACES = ("within a step", "after a split", "saving", "after renaming", "after a step", "from outside")


@dataclass(frozen=True)
class Kill:
    """Where an attempt ends."""

    place: str
    step: int
    """The iteration; for the two places of saving, the first save at or after it. Ignored "from outside"."""
    seconds: float = 0.0
    """Time after the first iteration, "from outside"."""


def parser_of(scene: Path) -> ColmapDataParserConfig:
    """For a drawn scene."""
    return ColmapDataParserConfig(
        data=scene,
        colmap_path=SPARSE_FOLDER,
        downscale_factor=1,
        eval_mode="interval",
        eval_interval=EVAL_INTERVAL,
    )


def configure(scene: Path, output: Path, iterations: int, save_every: int, seed: int = 42) -> SadgsTrainerConfig:
    """The demo's settings, with checkpoints on the way and all attempts in one folder."""
    config: SadgsTrainerConfig = copy.deepcopy(sadgs.config)  # type: ignore[assignment]
    config.output_dir = output
    config.experiment_name = "test"
    config.timestamp = "run"
    config.vis = "tensorboard"
    config.machine.device_type = "cpu"
    config.machine.seed = seed
    config.max_num_iterations = iterations
    config.steps_per_save = save_every
    config.steps_per_eval_image = 0
    config.share_always = True
    config.logging.local_writer.enable = False
    config.logging.profiler = "none"
    config.pipeline.datamanager.dataparser = parser_of(scene)
    config.pipeline.model.strategy = dataclasses.replace(config.pipeline.model.strategy)
    fit_densification(config.pipeline.model.strategy, max_gaussians=2000)
    return config


def _die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _arm(trainer: SadgsTrainer, kill: Kill) -> None:
    """Have the process kill itself at the place."""
    if kill.place in ("after a step", "after a split"):
        location = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
        trainer.callbacks.append(TrainingCallback(location, lambda step: _die() if step == kill.step else None))
    elif kill.place == "within a step":
        launch = AdamUpdate.launch

        def launch_half(update: AdamUpdate, *args: Any) -> None:
            if trainer.step == kill.step:
                some = dict(list(update._optimizers.items())[: len(update._optimizers) // 2])
                launch(AdamUpdate(some), *args)
                _die()
            launch(update, *args)

        AdamUpdate.launch = launch_half  # type: ignore[method-assign]
    elif kill.place == "saving":
        save = torch.save

        def save_half(state: Any, path: Path) -> None:
            if state["step"] < kill.step:
                return save(state, path)
            buffer = io.BytesIO()
            save(state, buffer)
            Path(path).write_bytes(buffer.getvalue()[: len(buffer.getvalue()) // 2])
            _die()

        torch.save = save_half
    elif kill.place == "after renaming":
        replace = os.replace

        def replace_and_die(source: Any, target: Any) -> None:
            replace(source, target)
            if trainer.step >= kill.step:
                _die()

        os.replace = replace_and_die


def set_up(config: SadgsTrainerConfig) -> SadgsTrainer:
    """The trainer, seeded as `ns-train` does it, before its first iteration."""
    random.seed(config.machine.seed)
    np.random.seed(config.machine.seed)
    torch.manual_seed(config.machine.seed)
    trainer: SadgsTrainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer


def attempt(config: SadgsTrainerConfig, kill: Kill | None, started: Any) -> None:
    """One process: train, from the latest checkpoint if there is one, until the end or the kill."""
    CONSOLE.quiet = True
    folder = config.get_checkpoint_dir()
    if folder.is_dir() and any(folder.iterdir()):
        config.load_dir = folder
    trainer = set_up(config)
    if kill is not None:
        _arm(trainer, kill)
    location = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
    trainer.callbacks.append(TrainingCallback(location, lambda step: started.set()))
    trainer.train()


def run(config: SadgsTrainerConfig, kill: Kill | None = None) -> int:
    """Run one attempt in a fork; its exit code, negative for a signal."""
    context = multiprocessing.get_context("fork")
    started = context.Event()
    process = context.Process(target=attempt, args=(copy.deepcopy(config), kill, started))
    process.start()
    if kill is not None and kill.place == "from outside":
        started.wait(120)
        process.join(kill.seconds)
        process.kill()
    process.join(600)
    if process.is_alive():
        process.kill()
        raise TimeoutError(f"an attempt did not end ({kill}).")
    assert process.exitcode is not None
    return process.exitcode


def latest(folder: Path) -> int:
    """Step of the latest checkpoint, −1 without one."""
    return max((int(path.stem.removeprefix("step-")) for path in folder.glob("*.ckpt")), default=-1)


def plan(kills: int, iterations: int, structure_every: int, save_every: int, seed: int) -> Callable[[int, int], Kill]:
    """Draws the kill of each attempt: its number from 0, and the step of the checkpoint it starts from."""
    rng = random.Random(seed)

    def draw(number: int, resumed_at: int) -> Kill:
        # Not so far that the later kills have no iterations left.
        last = resumed_at + max((iterations - 2 - resumed_at) // (kills - number + 1), 1)
        place = PLACES[number % len(PLACES)]
        step = rng.randint(resumed_at + 1, max(last, resumed_at + 1))
        if place == "after a split":
            splits = range(structure_every, int(iterations * 19 / 30), structure_every)
            step = next((split for split in splits if split > resumed_at), step)
        if place in ("saving", "after renaming"):
            step = (step // save_every + 1) * save_every
        return Kill(place, min(step, iterations - 1), rng.uniform(0.0, 0.4))

    return draw


def differences(a: Any, b: Any, where: str = "") -> list[str]:
    """Places where two nested checkpoints are not bitwise equal."""
    if isinstance(a, dict) and isinstance(b, dict) and a.keys() == b.keys():
        return [place for key in a for place in differences(a[key], b[key], f"{where}/{key}")]
    if isinstance(a, list | tuple) and type(a) is type(b) and len(a) == len(b):
        return [place for i, pair in enumerate(zip(a, b, strict=True)) for place in differences(*pair, f"{where}/{i}")]
    if isinstance(a, torch.Tensor):
        return [] if isinstance(b, torch.Tensor) and torch.equal(a, b) else [where]
    return [] if type(a) is type(b) and a == b else [where]


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns the exit status: 0 if the disturbed run ended bitwise equal to the undisturbed one."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", type=Path, help="new folder for the scene and the runs")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--save-every", type=int, default=20, help="iterations between checkpoints")
    parser.add_argument("--width", type=int, default=80)
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0, help="of the kills")
    given = parser.parse_args(arguments)
    warnings.filterwarnings("ignore")
    torch.set_num_threads(1)  # results depend on their number
    scene = given.folder / "scene"
    write_scene(scene, given.width, given.width * 3 // 4, given.views)

    def configured(name: str, seed: int = 42) -> SadgsTrainerConfig:
        shutil.rmtree(given.folder / name, ignore_errors=True)
        return configure(scene, given.folder / name, given.iterations, given.save_every, seed)

    undisturbed = configured("undisturbed")
    disturbed = configured("disturbed")
    for config in (undisturbed, configured("other seed", 43)):
        assert run(config) == 0
    structure_every = disturbed.pipeline.model.strategy.windows.structure_every
    draw = plan(given.kills, given.iterations, structure_every, given.save_every, given.seed)
    folder = disturbed.get_checkpoint_dir()
    for number in range(given.kills):
        at = latest(folder)
        kill = draw(number, at)
        code = run(disturbed, kill)
        left = sorted(path.name for path in folder.parent.rglob("*") if path.suffix in (".ckpt", ".partial"))
        where = f"{kill.seconds:.2f} s after its first" if kill.place == "from outside" else kill.step
        print(f"kill {number + 1}: started after step {at}, {kill.place}, iteration {where}: exit {code}, left {left}")
        if code != -signal.SIGKILL:
            print("the run was not killed")
            return 1
    assert run(disturbed) == 0
    name = f"step-{given.iterations - 1:09d}.ckpt"
    ends = [
        torch.load(given.folder / run_name / "test/sadgs/run/nerfstudio_models" / name, weights_only=True)
        for run_name in ("undisturbed", "disturbed", "other seed")
    ]
    counts = [len(end["pipeline"]["_model.gauss_params.means"]) for end in ends]
    leftovers = [path.name for path in folder.parent.rglob("*.partial")] + [p.name for p in folder.glob("*")][1:]
    different = differences(ends[0], ends[1])
    print(f"Gaussians: undisturbed {counts[0]}, killed {given.kills} times {counts[1]}, another seed {counts[2]}")
    print(f"different entries of the final checkpoint: {different or 'none, bitwise equal'}; left over: {leftovers}")
    return int(bool(different or leftovers or not differences(ends[0], ends[2])))


if __name__ == "__main__":
    sys.exit(main())
