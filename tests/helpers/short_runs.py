"""Short runs on the drawn scene, as configurations, data in other formats, and what is compared of them."""

from __future__ import annotations

import copy
import dataclasses
import json
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from PIL import Image

from examples.drawn_scene.drawing import render
from examples.drawn_scene.scene import arc_views, room_surfaces
from helpers.json_files import write_json
from helpers.kill_and_resume import set_up
from helpers.small_scenes import HEIGHT, POINTS, VIEWS, WIDTH
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.model import SadgsModel
from sadgs_ns.training.presets import sadgs
from sadgs_ns.training.run.trainer import SadgsTrainer

TRAIN_VIEWS = 8
"""Of 10, the parser holds out the first and the ninth."""
ITERATIONS = 24
SCHEDULE = {
    "structure_every": 6,
    "absgs_every": 3,
    "refine_start_iter": 1,
    "refine_stop_iter": 15,
    "eta_every": 1,
    "split_min_opacity": 0.0,
    "min_observations": 1,
    "reset_every": 0,
}
"""Densification for the few iterations of these tests."""


def configure(output: Path, parser: DataParserConfig, iterations: int = 6, **strategy: Any) -> SadgsTrainerConfig:
    """The preset on other data, with the tests' schedule, without viewer and evaluation."""
    config: SadgsTrainerConfig = copy.deepcopy(sadgs.config)  # type: ignore[assignment]
    config.output_dir = output
    config.experiment_name = "test"
    config.timestamp = "run"
    config.vis = "tensorboard"
    config.max_num_iterations = iterations
    config.steps_per_save = config.steps_per_eval_image = 0
    config.logging.local_writer.enable = False
    config.pipeline.datamanager.dataparser = parser
    config.pipeline.model.bounding_box_points = False
    config.pipeline.model.num_random = POINTS
    config.pipeline.model.strategy = dataclasses.replace(config.pipeline.model.strategy, **{**SCHEDULE, **strategy})
    return config


def in_the_viewer(function: Callable[[], Any]) -> Any:
    """Call it as the viewer's rendering thread does."""
    result: list[Any] = []

    class Thread(RenderStateMachine):
        def __init__(self) -> None:
            threading.Thread.__init__(self)

        def run(self) -> None:
            result.append(function())

    thread = Thread()
    thread.start()
    thread.join()
    return result[0]


def train(config: SadgsTrainerConfig, after_step: Callable[[SadgsTrainer], None] | None = None) -> SadgsTrainer:
    """Train to the end, calling `after_step` after each iteration's densification."""
    trainer = set_up(config)
    if after_step is not None:
        location = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
        trainer.callbacks.append(TrainingCallback(location, lambda step: after_step(trainer)))
    trainer.train()
    return trainer


def checkpoint(trainer: SadgsTrainer, step: int) -> dict[str, Any]:
    """A checkpoint, read as torch reads files that it does not trust."""
    return torch.load(trainer.checkpoint_dir / f"step-{step:09d}.ckpt", weights_only=True)


def is_finite(model: SadgsModel) -> bool:
    return all(bool(value.isfinite().all()) for value in model.gauss_params.values())


def frames(
    folder: Path, sizes: Sequence[tuple[int, int]], alpha: bool = False, masks: bool = False
) -> list[dict[str, Any]]:
    """Draw views of the room, the i-th of size i modulo `sizes` (width, height), and describe them to nerfstudio.

    With `alpha` the left half of every image is transparent; with `masks` the left half is masked out.
    """
    (folder / "images").mkdir(parents=True)
    described = []
    for index, view in enumerate(arc_views(VIEWS, WIDTH, HEIGHT)):
        width, height = sizes[index % len(sizes)]
        view = dataclasses.replace(view, width=width, height=height)
        right_half = np.where(np.arange(width) < width // 2, 0, 255).astype(np.uint8)[None].repeat(height, 0)
        image = render(room_surfaces(), view, supersampling=1)
        if alpha:
            image = np.dstack([image, right_half])
        Image.fromarray(image).save(folder / "images" / view.name)
        pose = np.eye(4)
        pose[:3, :3] = view.rotation.T * [1, -1, -1]  # OpenCV's camera axes to OpenGL's
        pose[:3, 3] = view.position
        frame = {"file_path": f"images/{view.name}", "transform_matrix": pose.tolist(), "w": width, "h": height}
        frame |= {"fl_x": view.focal, "fl_y": view.focal, "cx": width / 2, "cy": height / 2}
        if masks:
            Image.fromarray(right_half).save(folder / "images" / f"mask_{view.name}")
            frame["mask_path"] = f"images/mask_{view.name}"
        described.append(frame)
    return described


def nerfstudio_data(
    folder: Path, sizes: Sequence[tuple[int, int]] = ((WIDTH, HEIGHT),), **options: bool
) -> NerfstudioDataParserConfig:
    """A dataset as ns-process-data writes it, without SfM points."""
    described = frames(folder, sizes, **options)
    write_json(folder / "transforms.json", {"camera_model": "OPENCV", "frames": described})
    return NerfstudioDataParserConfig(data=folder, load_3D_points=True, downscale_factor=1)


def blender_data(folder: Path, alpha_color: str | None) -> BlenderDataParserConfig:
    """A synthetic dataset as NeRF's, with transparent images."""
    described = [
        {"file_path": f"./{frame['file_path'].removesuffix('.png')}", "transform_matrix": frame["transform_matrix"]}
        for frame in frames(folder, [(WIDTH, HEIGHT)], alpha=True)
    ]
    angle = 2 * np.arctan(0.5 / 0.8)  # the room's focal length is 0.8 of the width
    for split, part in (("train", described[2:]), ("val", described[:2]), ("test", described[:2])):
        text = json.dumps({"camera_angle_x": angle, "frames": part})
        (folder / f"transforms_{split}.json").write_text(text)
    return BlenderDataParserConfig(data=folder, alpha_color=alpha_color)


# --- the command line ---
