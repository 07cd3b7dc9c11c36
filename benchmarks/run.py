"""One training run, measured, in a process of its own: `python -m benchmarks.run --spec JSON --out FILE`.

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
import math
import os
import subprocess
import sys
import tempfile
import time
import traceback
import urllib.error
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.protocol import Job, Row, Scene, set_dotted

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

    from benchmarks.curve import Curve, LoopTimer


def build_config(scene: Scene, row: Row, seed: int, root: Path, work: Path) -> TrainerConfig:
    """The nerfstudio config of a run on a scene below `root`, which writes to `work`.

    Raises ValueError, which names it, if there is no such method, dataparser, setting or data.
    """
    import torch
    from nerfstudio.configs.method_configs import all_methods
    from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
    from nerfstudio.engine.trainer import TrainerConfig

    from sadgs_ns.training.config import SadgsTrainerConfig

    config = copy.deepcopy(all_methods.get(row.method))
    if not isinstance(config, TrainerConfig):
        raise ValueError(f"row {row.label!r}: nerfstudio has no method {row.method!r}; install its package.")
    datamanager = config.pipeline.datamanager
    if not isinstance(datamanager, FullImageDatamanagerConfig):
        raise ValueError(f"row {row.label!r}: {row.method!r} trains on rays; give a Gaussian splatting method.")
    if not (root / scene.data).exists():
        raise ValueError(f"scene {scene.name!r}: {root / scene.data} does not exist; check --scenes.")
    datamanager.dataparser = _dataparser_of(scene, config)
    datamanager.data = root / scene.data
    for path, value in row.overrides.items():
        set_dotted(config, path, value)

    # The trainer compares `vis` with the names of viewers and event writers: any other value means no viewer (which
    # would take GPU time and wait at the end), no event files and, without those, no evaluation within the loop.
    config.vis = "none"  # type: ignore[assignment]
    config.logging.local_writer.enable = False
    config.logging.profiler = "none"
    config.steps_per_save = 0
    if isinstance(config, SadgsTrainerConfig):
        config.seconds_per_save = 0
    else:
        # Of nerfstudio's own generator, which `machine.seed` leaves alone.
        datamanager.train_cameras_sampling_seed = seed
    config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = 0
    config.output_dir = work
    config.machine.seed = seed
    if not torch.cuda.is_available():
        config.machine.device_type = "cpu"
        datamanager.cache_images = "gpu"  # "the model's device"; "cpu" pins memory, which needs CUDA
    config.set_timestamp()
    base = config.get_base_dir()
    written = (config.get_checkpoint_dir(), base / config.logging.relative_log_dir)
    for path in (*written, base / config.viewer.relative_log_filename):
        if not path.resolve().is_relative_to(work.resolve()):
            raise ValueError(f"row {row.label!r} on {scene.name!r}: it would write {path}, outside the run's folder.")
    return config


def _dataparser_of(scene: Scene, config: TrainerConfig) -> Any:
    """Return the config of a scene's dataparser for a method, with the scene's options.

    As `ns-train METHOD PARSER` does, it begins with the method's own config of the dataparser if that is the method's
    default one, for example because it reads SfM points. Otherwise it begins with the registered config of this name.
    Raises ValueError if there is no such dataparser or setting.
    """
    from nerfstudio.configs.dataparser_configs import all_dataparsers

    from sadgs_ns.data.parsers import PARSERS
    from sadgs_ns.training.config import SadgsTrainerConfig

    name = scene.dataparser
    if name == "blender":
        name = "blender-data"
    if name not in all_dataparsers:
        known = ", ".join(sorted(all_dataparsers))
        raise ValueError(f"scene {scene.name!r}: nerfstudio has no dataparser {name!r}; give one of {known}.")
    registered = all_dataparsers[name]
    if isinstance(config, SadgsTrainerConfig):
        registered = PARSERS[name]
    own = config.pipeline.datamanager.dataparser  # type: ignore[attr-defined]
    if type(own) is type(registered):
        registered = own
    dataparser = copy.deepcopy(registered)
    for path, value in scene.options.items():
        set_dotted(dataparser, path, value)
    return dataparser


def run_row(job: Job, root: Path, work: Path) -> dict[str, Any]:
    """Train once on a scene below `root` and measure; nerfstudio writes to `work`, which the caller deletes.

    Returns:
        JSON-ready. Seconds: `import_seconds`, `setup_seconds` (parsing the data and all else that nerfstudio builds),
        `initialization_seconds` (the model from the points), `load_seconds`, `warmup_seconds` and, where the method has
        them, `structure_tensor_seconds`, one after the other before the loop; `loop_seconds`, of the training loop
        alone. Over the held-out views what `evaluate.quality` measures, and of each `ply_view_psnr` (as other programs'
        viewers draw) and what `angles_of_views` tells. `differing_pixels` is what `viewpoints.pixels_that_differ`
        tells. What `moved.measures` tells is there if the run found what moved. `curve`, if the job asks for it, has
        the points of `curve.Curve`, the last one being the finished run; no
        time contains its evaluations.
        Where torchrun started several processes, which train one splat on `devices` of them, the first measures all
        but `curve`: its checkpoint is evaluated on one device, S̄ is computed in the loop, and
        `peak_gb` is the first device's. The others return nothing.

    Raises as `build_config`, RuntimeError if the training loop stopped early, or whatever the method raises.
    """
    start = time.perf_counter()
    # ns-train's own module: importing it also sets cuDNN as in a user's run.
    import nerfstudio.scripts.train  # noqa: F401

    from benchmarks.curve import point
    from sadgs_ns.training.run import processes

    devices = processes.number_of_processes()
    seconds = {"import_seconds": time.perf_counter() - start}

    trainer, timer, curve = train(job, root, work, devices, seconds)
    if devices > 1:
        if not processes.is_rank_zero():
            return {}
        trainer = load_in_one_process(job, root, work, trainer.checkpoint_dir)
    record = {"devices": devices, **measure(trainer, timer, seconds, job.row.aligned)}
    if curve is not None:
        end = point(record["iterations"], timer.seconds, record, record["gaussians"])
        record["curve"] = [*curve.points, end]
    return record


@contextlib.contextmanager
def timed(name: str, seconds: dict[str, float]) -> Iterator[None]:
    """Time the block, or the function that this decorates, and add `NAME_seconds` to `seconds`."""
    from benchmarks import evaluate

    begin = evaluate.now()
    yield
    seconds[f"{name}_seconds"] = evaluate.now() - begin


def set_up(job: Job, root: Path, work: Path, devices: int, seconds: dict[str, float]) -> Any:
    """Return the job's nerfstudio trainer, set up to train on so many devices; add the setup's times to `seconds`.

    Raises as `build_config`, and ValueError if several devices were to train, and one would.
    """
    from nerfstudio.scripts.train import _set_random_seed

    with timed("setup", seconds):
        config = build_config(job.scene, job.row, job.seed, root, work)
        _set_random_seed(job.seed)
        trainer: Any = config.setup(local_rank=int(os.environ.get("LOCAL_RANK", "0")), world_size=devices)
        model_class: Any = config.pipeline.model._target
        populate = model_class.populate_modules
        model_class.populate_modules = timed("initialization", seconds)(populate)
        try:
            trainer.setup(test_mode="test")  # "val" would evaluate on blender's validation views
        finally:
            model_class.populate_modules = populate
    seconds["setup_seconds"] -= seconds["initialization_seconds"]
    world = getattr(trainer, "world", None)
    if devices > 1 and (world is None or world.is_single):
        raise ValueError(
            f"row {job.row.label!r} on {job.scene.name!r} trains on one device, since its steps have few pixels or its "
            "method knows one only: measure it with one GPU, or set share_always to true."
        )
    return trainer


def train(
    job: Job, root: Path, work: Path, devices: int, seconds: dict[str, float]
) -> tuple[Any, LoopTimer, Curve | None]:
    """Train as the job says, and add the times of all that comes before the loop to `seconds`.

    Returns:
        The trainer, the loop's timer, and the curve if the job asks for one and one device trains.

    Raises as `set_up`, and RuntimeError if the training loop stopped early.
    """
    import torch

    from benchmarks.curve import Curve, LoopTimer

    trainer = set_up(job, root, work, devices, seconds)
    pipeline = trainer.pipeline
    datamanager = pipeline.datamanager
    model = pipeline.model
    with timed("load", seconds):  # else the first iteration decodes all images
        train_images = datamanager.cached_train
        _ = datamanager.cached_eval
    if devices == 1:  # A model that several processes share draws nothing alone, and compiles in the setup.
        # gsplat's, Triton's and torch.compile's kernels build at the first call, once per machine.
        with timed("warmup", seconds):
            camera = datamanager.train_dataset.cameras[:1].to(trainer.device)
            pipeline.eval()
            outputs = model.get_outputs(camera)
            losses = model.get_loss_dict(outputs, train_images[0]).values()
            torch.stack(list(losses)).sum().backward()
            pipeline.zero_grad()
            with torch.no_grad():
                model.get_outputs(camera)
            pipeline.train()
        if hasattr(pipeline, "structure_cache"):  # splatfacto's pipeline has none
            with timed("structure_tensor", seconds):
                pipeline.structure_cache.fill()

    timer = LoopTimer()
    curve = None
    if job.row.curve_every is not None and devices == 1:
        curve = Curve(job.row.curve_every, timer)
        curve.attach(trainer)
    timer.attach(trainer)
    trainer.train()
    if not timer.finished:
        raise RuntimeError("the training loop stopped before its last iteration.")
    return trainer, timer, curve


def measure(trainer: Any, timer: LoopTimer, seconds: dict[str, float], aligned: bool = False) -> dict[str, Any]:
    """Evaluate a trained model on the held-out views; return all of `run_row` but `devices` and `curve`."""
    import torch

    from benchmarks import evaluate, moved, viewpoints

    pipeline = trainer.pipeline
    datamanager = pipeline.datamanager
    model = pipeline.model
    pipeline.eval()
    views = datamanager.fixed_indices_eval_dataloader
    network = evaluate.load_lpips()
    held_out = evaluate.quality(model, views, network)
    held_out["ply_view_psnr"] = evaluate.view_psnr_in_viewers(model, views, held_out["view_psnr"])
    if aligned:
        from benchmarks.alignment import aligned_quality

        held_out |= aligned_quality(model, views, network)
    differing = viewpoints.pixels_that_differ(model, datamanager.train_dataset.cameras)
    views_per_iteration = 1
    if hasattr(model, "plan"):
        views_per_iteration = model.plan.views_per_iteration
    gpu = None
    if torch.cuda.is_available():
        gpu = torch.cuda.get_device_name()
    return {
        "iterations": trainer.config.max_num_iterations,
        "views_per_iteration": views_per_iteration,
        "loop_seconds": timer.seconds,
        **seconds,
        **held_out,
        **angles_of_views(datamanager, model),
        **moved.measures(pipeline),
        "differing_pixels": differing,
        "gaussians": int(model.num_points),
        "peak_gb": timer.peak_gb,
        "train_views": len(datamanager.train_dataset),
        "eval_views": len(views),
        "gpu": gpu,
    }


def angles_of_views(datamanager: Any, model: Any) -> dict[str, list[Any]]:
    """Tell how far the held-out views are from the training views, in the order in which they are evaluated.

    Without SfM points, the centres of the model's Gaussians are the points. The images must be loaded, because that
    takes the distortion from the cameras.

    Returns:
        The images' names without suffix, and the angles to the nearest training view in degrees; None in place of NaN.
    """
    from benchmarks.coverage import Views, nearest_angles

    training = datamanager.train_dataset
    held_out = datamanager.eval_dataset
    points = training.metadata.get("points3D_xyz")
    if points is None or not len(points):
        points = model.means.detach()
    there = Views.of(held_out.cameras.to(model.device))
    known = Views.of(training.cameras.to(model.device))
    angles: list[float | None] = []
    for angle in nearest_angles(there, known, points.to(model.device)).tolist():
        if math.isnan(angle):
            angles.append(None)
        else:
            angles.append(round(angle, 1))
    return {"view_names": [Path(path).stem for path in held_out.image_filenames], "view_angles": angles}


def load_in_one_process(job: Job, root: Path, work: Path, checkpoint: Path) -> Any:
    """Return a trainer in which this process has all that several trained and wrote to a folder of checkpoints."""
    for name in list(os.environ):
        if name in ("RANK", "WORLD_SIZE") or name.startswith(("LOCAL_", "GROUP_")):
            del os.environ[name]
    config = build_config(job.scene, job.row, job.seed, root, work)
    config.load_dir = checkpoint
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup(test_mode="test")
    return trainer


def software() -> dict[str, str | None]:
    """Return the versions of the packages and the commit of this checkout; None for a version that is unknown.

    Without git there is no "commit".
    """
    versions: dict[str, str | None] = {}
    for name in ("torch", "gsplat", "nerfstudio", "sadgs_ns"):
        # The imported module comes first: with two installations in a folder, metadata may be those of the other one.
        version = getattr(sys.modules.get(name), "__version__", None)
        if not version:
            with contextlib.suppress(importlib.metadata.PackageNotFoundError):
                version = importlib.metadata.version(name)
        versions[name] = version
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    with contextlib.suppress(OSError):  # there is no git
        described = subprocess.run(command, capture_output=True, text=True)
        versions["commit"] = described.stdout.strip() or None
    return versions


def describe(error: Exception) -> str:
    """One sentence for a run that failed."""
    message = (str(error).strip().splitlines() or ["no message"])[0]
    if isinstance(error, (urllib.error.URLError, ConnectionError, TimeoutError)):
        file = "hub/checkpoints/alexnet-owt-7be5be79.pth"
        return f"nerfstudio could not download the LPIPS weights; set TORCH_HOME to a folder that holds {file}."
    if isinstance(error, ValueError):
        return message
    return f"{type(error).__name__}: {message}"


def main() -> None:
    """Run a spec and write its result, also that of a run that fails."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.run", description="Measure one training run.")
    parser.add_argument("--spec", required=True, help="JSON of a job, with the root of the scenes")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    arguments = parser.parse_args()
    rank = os.environ.get("RANK", "0")
    spec = json.loads(arguments.spec)
    job = Job(Scene(**spec["scene"]), Row(**spec["row"]), spec["seed"])
    date = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
    record: dict[str, Any] = {"status": "ok", "error": None, "date": date}
    with tempfile.TemporaryDirectory(dir=arguments.out.parent) as work:
        try:
            record |= run_row(job, Path(spec["root"]), Path(work))
        except Exception as error:
            traceback.print_exc()
            record |= {"status": "failed", "error": describe(error)}
    record["versions"] = software()
    if rank == "0":
        arguments.out.write_text(json.dumps(record))
    if record["status"] == "failed" and "WORLD_SIZE" in os.environ:
        raise SystemExit(1)  # The other processes would wait for this one.


if __name__ == "__main__":
    main()
