"""One training run, measured, in a process of its own: `python -m sadgs_ns.bench.run --spec JSON --out FILE`.

The spec is a `protocol.Job` as a dict, with "root", the folder that holds all scenes. Nothing heavy is imported before
the clock runs.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import datetime
import importlib.metadata
import json
import subprocess
import tempfile
import time
import traceback
import urllib.error
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sadgs_ns.bench.protocol import Job, Row, Scene, set_dotted

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

TRAIN_VIEWS = 4
"""Training views whose PSNR is measured, to tell overfitting from underfitting."""


def build_config(scene: Scene, row: Row, seed: int, root: Path, work: Path) -> TrainerConfig:
    """The nerfstudio config of a run.

    Args:
        root: Folder that holds all scenes.
        work: Folder for what nerfstudio writes.

    Raises:
        ValueError: Unknown method, dataparser or setting, or no data; one sentence that names it.
    """
    import torch
    from nerfstudio.configs.dataparser_configs import all_dataparsers
    from nerfstudio.configs.method_configs import all_methods
    from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
    from nerfstudio.engine.trainer import TrainerConfig

    config = copy.deepcopy(all_methods.get(row.method))
    if not isinstance(config, TrainerConfig):
        raise ValueError(f"row {row.label!r}: nerfstudio has no method {row.method!r}; install its package.")
    datamanager = config.pipeline.datamanager
    if not isinstance(datamanager, FullImageDatamanagerConfig):
        raise ValueError(f"row {row.label!r}: {row.method!r} trains on rays; give a Gaussian splatting method.")
    name = "blender-data" if scene.dataparser == "blender" else scene.dataparser
    if name not in all_dataparsers:
        known = ", ".join(sorted(all_dataparsers))
        raise ValueError(f"scene {scene.name!r}: nerfstudio has no dataparser {name!r}; give one of {known}.")
    if not (root / scene.data).exists():
        raise ValueError(f"scene {scene.name!r}: {root / scene.data} does not exist; check --scenes.")
    dataparser = copy.deepcopy(all_dataparsers[name])
    for path, value in scene.options.items():
        set_dotted(dataparser, path, value)
    datamanager.dataparser = dataparser
    datamanager.data = root / scene.data
    for path, value in row.overrides.items():
        set_dotted(config, path, value)

    # The trainer compares `vis` with the names of viewers and event writers: any other value means no viewer (which
    # would take GPU time and wait at the end), no event files and, without those, no evaluation within the loop.
    config.vis = "none"  # type: ignore[assignment]
    config.logging.local_writer.enable = False
    config.logging.profiler = "none"
    config.steps_per_save = 0
    config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = 0
    config.output_dir = work
    config.machine.seed = seed
    datamanager.train_cameras_sampling_seed = seed  # nerfstudio's own generator: the seed above leaves it alone
    if not torch.cuda.is_available():
        config.machine.device_type = "cpu"
        datamanager.cache_images = "gpu"  # "the model's device"; "cpu" pins memory, which needs CUDA
    config.set_timestamp()
    return config


class LoopTimer:
    """Times the training loop, and nothing else, from two of the trainer's callbacks.

    The GPU is waited for at the first and at the last iteration only.
    """

    def __init__(self) -> None:
        self.seconds: float | None = None
        self.peak_gb: float | None = None
        """Largest memory that tensors took in the loop, in 10⁹ bytes; None without a GPU."""
        self._start = 0.0

    def attach(self, trainer: Any) -> None:
        """Register with a nerfstudio Trainer that is set up."""
        from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

        last = trainer.config.max_num_iterations - 1
        before, after = TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, TrainingCallbackLocation.AFTER_TRAIN_ITERATION
        trainer.callbacks.insert(0, TrainingCallback([before], self._begin, iters=(0,)))
        trainer.callbacks.append(TrainingCallback([after], self._end, iters=(last,)))

    def _begin(self, step: int) -> None:
        import torch

        from sadgs_ns.bench.evaluate import now

        if torch.cuda.is_available():
            torch.cuda.reset_peak_memory_stats()
        self._start = now()

    def _end(self, step: int) -> None:
        import torch

        from sadgs_ns.bench.evaluate import now

        self.seconds = now() - self._start
        if torch.cuda.is_available():
            self.peak_gb = torch.cuda.max_memory_allocated() / 1e9


def run_row(scene: Scene, row: Row, seed: int, root: Path, work: Path) -> dict[str, Any]:
    """Train once and measure.

    Args:
        root: Folder that holds all scenes.
        work: Folder for what nerfstudio writes; the caller deletes it.

    Returns:
        JSON-ready: `loop_seconds` and the other times in s (`wall_seconds`: all of them, from the first import to the
        saved checkpoint), `psnr`, `ssim`, `lpips` (None without weights) over the held-out views, `train_psnr`, `fps`,
        `gaussians`, `peak_gb`, and what the machine and the software were.

    Raises:
        ValueError: As `build_config`.
        RuntimeError: The training loop stopped early, or whatever the method raises.
    """
    seconds: dict[str, float] = {}
    start = time.perf_counter()
    import torch

    # ns-train's own module: importing it also sets cuDNN as in a user's run.
    from nerfstudio.scripts.train import _set_random_seed

    from sadgs_ns.bench import evaluate

    seconds["import_seconds"] = time.perf_counter() - start

    @contextlib.contextmanager
    def timed(name: str) -> Iterator[None]:
        begin = evaluate.now()
        yield
        seconds[f"{name}_seconds"] = evaluate.now() - begin

    with timed("setup"):
        config = build_config(scene, row, seed, root, work)
        _set_random_seed(seed)
        trainer: Any = config.setup(local_rank=0, world_size=1)
        trainer.setup(test_mode="test")  # "val" would evaluate on blender's validation views
    pipeline, datamanager, model = trainer.pipeline, trainer.pipeline.datamanager, trainer.pipeline.model
    with timed("load"):  # else the first iteration decodes all images
        train_images, _ = datamanager.cached_train, datamanager.cached_eval
    with timed("warmup"):  # gsplat's, Triton's and torch.compile's kernels build at the first call, once per machine
        camera = datamanager.train_dataset.cameras[:1].to(trainer.device)
        pipeline.eval()
        outputs = model.get_outputs(camera)
        losses = model.get_loss_dict(outputs, train_images[0]).values()
        torch.stack(list(losses)).sum().backward()  # the first step forgets the gradients
        with torch.no_grad():
            model.get_outputs(camera)
        pipeline.train()
    # Looked up on the class: on the instance hasattr would already compute it.
    if hasattr(type(pipeline), "structure_tensors"):
        with timed("structure_tensor"):
            _ = pipeline.structure_tensors

    timer = LoopTimer()
    timer.attach(trainer)
    with timed("train"):  # the loop and the checkpoint after it
        trainer.train()
    wall = time.perf_counter() - start
    if timer.seconds is None:
        raise RuntimeError("the training loop stopped before its last iteration.")

    pipeline.eval()
    views = datamanager.fixed_indices_eval_dataloader
    with timed("evaluation"):
        held_out = evaluate.quality(model, views, evaluate.load_lpips(trainer.device))
        indices = torch.linspace(0, len(train_images) - 1, TRAIN_VIEWS).long().unique().tolist()
        train_cameras = datamanager.train_dataset.cameras
        train_views = [(train_cameras[i : i + 1].to(trainer.device), train_images[i]) for i in indices]
        train_psnr = evaluate.quality(model, train_views, None)["psnr"]
        fps = evaluate.frames_per_second(model, [camera for camera, _ in views])
    return {
        "iterations": config.max_num_iterations,
        "loop_seconds": timer.seconds,
        **seconds,
        "wall_seconds": wall,
        **held_out,
        "train_psnr": train_psnr,
        "fps": fps,
        "gaussians": int(model.num_points),
        "peak_gb": timer.peak_gb,
        "train_views": len(train_images),
        "eval_views": len(views),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def software() -> dict[str, str | None]:
    """Installed versions, and the git commit if this package runs from a checkout."""
    versions: dict[str, str | None] = {}
    for name in ("torch", "gsplat", "nerfstudio", "sadgs_ns"):
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = None
    return {**versions, "commit": _commit(Path(__file__).resolve().parents[2])}


def _commit(checkout: Path) -> str | None:
    def git(*arguments: str) -> str:
        command = ["git", "-C", str(checkout), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        # Not the commit of some repository that happens to hold a virtual environment.
        if Path(git("rev-parse", "--show-toplevel")) != checkout:
            return None
        return git("describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    except (OSError, subprocess.CalledProcessError):
        return None


def describe(error: Exception) -> str:
    """One sentence for a run that failed."""
    if isinstance(error, (urllib.error.URLError, ConnectionError, TimeoutError)):
        return (
            "nerfstudio could not download the LPIPS weights; set TORCH_HOME to a folder that holds "
            "hub/checkpoints/alexnet-owt-7be5be79.pth."
        )
    lines = str(error).strip().splitlines()
    message = lines[0] if lines else "no message"
    return message if isinstance(error, ValueError) else f"{type(error).__name__}: {message}"


def main() -> None:
    """Run a spec and write its result, also that of a run that fails."""
    parser = argparse.ArgumentParser(prog="python -m sadgs_ns.bench.run", description="Measure one training run.")
    parser.add_argument("--spec", required=True, help="JSON of a job, with the root of the scenes")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    arguments = parser.parse_args()
    spec = json.loads(arguments.spec)
    job = Job(Scene(**spec["scene"]), Row(**spec["row"]), spec["seed"])
    record = {
        "status": "ok",
        "error": None,
        "date": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        "versions": software(),
    }
    with tempfile.TemporaryDirectory(dir=arguments.out.parent) as work:
        try:
            record |= run_row(job.scene, job.row, job.seed, Path(spec["root"]), Path(work))
        except Exception as error:
            traceback.print_exc()
            record |= {"status": "failed", "error": describe(error)}
    arguments.out.write_text(json.dumps(record))


if __name__ == "__main__":
    main()
