"""Train the run beside this file, with the package of the commit that the folder is named after (README.md)."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import warnings
from pathlib import Path
from typing import Any

import torch
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.scripts.train import main as ns_train

from examples.drawn_scene.scene import write_scene
from sadgs_ns.training.model import SadgsModel
from sadgs_ns.training.pipeline import SadgsPipeline

STOP_AFTER = 20
"""Iterations that are done when the run is interrupted: densification goes on until 25, and the run until 40."""
RUN = Path("outputs/drawn/sadgs/first")
FILES = ("config.yml", "plan.yml", "dataparser_transforms.json", f"nerfstudio_models/step-{STOP_AFTER - 1:09d}.ckpt")
"""What is kept of the run's folder; the log of the losses is not."""
START = [
    "sadgs",
    # Paths are relative to the working directory, so that config.yml names no folder of this machine.
    *("--data", "scene", "--output-dir", "outputs", "--experiment-name", "drawn", "--timestamp", "first"),
    *("--max-num-iterations", "40", "--steps-per-eval-image", "0", "--vis", "tensorboard"),
    *("--machine.device-type", "cpu"),
    # With these the checkpoint has colour matrices, poses, and their optimizers.
    *("--pipeline.views-per-iteration", "2", "--pipeline.model.color-model", "affine"),
    *("--pipeline.model.camera-optimizer.mode", "SO3xR3"),
    # The checkpoint stays small, and the first split comes after it, by the statistics that it holds.
    *("--pipeline.model.bounding-box-points", "False", "--pipeline.model.strategy.max-gaussians", "400"),
    *("--pipeline.model.strategy.structure-every", "8", "--pipeline.model.strategy.absgs-every", "3"),
    *("--pipeline.model.strategy.refine-start-iter", "1", "--pipeline.model.strategy.refine-stop-iter", "25"),
    *("--pipeline.model.strategy.min-observations", "1", "--pipeline.model.strategy.split-min-opacity", "0.16"),
    *("--pipeline.model.strategy.clone-grad2d", "0.02", "--pipeline.model.strategy.split-absgrad2d", "0.08"),
]
"""The command that starts the run, after `ns-train`."""
RESUME = ["sadgs", "--load-config", str(RUN / "config.yml")]
"""The command that resumes it."""


def train_until_interrupted() -> None:
    """Start the run and interrupt it by Ctrl+C, after which the trainer saves a checkpoint."""
    next_views = SadgsPipeline.next_views

    def interrupt_and_draw(pipeline: SadgsPipeline, step: int) -> Any:
        if step == STOP_AFTER - 1:
            os.kill(os.getpid(), signal.SIGINT)  # The trainer ends the iteration first.
        return next_views(pipeline, step)

    SadgsPipeline.next_views = interrupt_and_draw  # type: ignore[method-assign]
    try:
        ns_train(tyro.cli(AnnotatedBaseConfigUnion, args=START))
    except SystemExit as stopped:
        assert stopped.code == 128 + signal.SIGINT, stopped.code
    finally:
        SadgsPipeline.next_views = next_views  # type: ignore[method-assign]


def measure() -> dict[str, float]:
    """Measure the held-out views of the run as it is now."""
    results = Path("results.json")
    ComputePSNR(RUN / "config.yml", results).main()
    measured = json.loads(results.read_text())["results"]
    return {name: measured[name] for name in ("psnr", "ssim")}


def main() -> None:
    """Draw the scene, train, and write what is kept to `run` and `measured.json`, all in the working directory."""
    warnings.filterwarnings("ignore")
    torch.set_num_threads(1)  # The numbers depend on it.
    SadgsModel.lpips = lambda *_: float("nan")  # type: ignore[method-assign]  # Its weights would be downloaded.
    write_scene(Path("scene"), width=48, height=36, views=10, points=300)
    train_until_interrupted()
    for name in FILES:
        target = Path("run", name)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(RUN / name, target)
    interrupted = measure()
    ns_train(tyro.cli(AnnotatedBaseConfigUnion, args=RESUME))
    measured = {"interrupted": interrupted, "finished": measure()}
    Path("measured.json").write_text(json.dumps(measured, indent=2) + "\n")


if __name__ == "__main__":
    sys.exit(main())
