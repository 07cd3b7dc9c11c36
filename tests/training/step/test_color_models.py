"""Whole runs on photos whose exposures are known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from torch import Tensor

from benchmarks import exposures
from benchmarks.evaluate import quality
from examples.drawn_scene.scene import write_scene
from helpers.kill_and_resume import parser_of
from helpers.short_runs import configure, train
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.run.trainer import SadgsTrainer
from sadgs_ns.training.step.color_matrices import anchored

WIDTH = 64
HEIGHT = 48
VIEWS = 14
POINTS = 1500
"""Of the room; fewer points, or smaller photos, tell too little of their exposure."""
SPREAD = 6.0
WHITE_BALANCE = 0.1
MEAN = 0.37
GREY = 0.4
"""Value of sRGB at which matrices are compared with gains."""


@pytest.fixture(scope="module")
def exposed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drawn room; its training photos differ in exposure and white balance."""
    folder = tmp_path_factory.mktemp("exposed")
    write_scene(folder / "room", WIDTH, HEIGHT, VIEWS, POINTS)
    exposures.write_scene(folder / "room", folder / "exposed", SPREAD, WHITE_BALANCE, MEAN, seed=0)
    return folder / "exposed"


def run_of(scene: Path, output: Path, color_model: Any, iterations: int) -> SadgsTrainerConfig:
    config = configure(output, parser_of(scene), iterations)
    config.machine.device_type = "cpu"
    config.pipeline.views_per_iteration = 1
    config.pipeline.model.color_model = color_model
    config.pipeline.model.exposure = "off"
    config.pipeline.model.starts_per_pixel = 0.0  # All points: few tell too little of the exposures.
    config.pipeline.model.color_corrected_metrics = True
    config.optimizers["color_matrices"]["optimizer"].lr = 0.01  # Each photo is seen a dozen times.
    return config


def without_densification(config: SadgsTrainerConfig) -> SadgsTrainerConfig:
    config.pipeline.model.strategy.refine_stop_iter = 0
    return config


def measured(trainer: SadgsTrainer) -> dict[str, Any]:
    """Quality of the held-out views, as they are and with fitted colours."""
    trainer.pipeline.eval()
    return quality(trainer.pipeline.model, trainer.pipeline.datamanager.fixed_indices_eval_dataloader)


@pytest.mark.slow
def test_a_run_learns_the_known_gains_and_held_out_views_gain_without_a_fit_of_their_colours(
    exposed: Path, tmp_path: Path
):
    trainers = {
        model: train(without_densification(run_of(exposed, tmp_path / model, model, 150)))
        for model in ("none", "affine")
    }
    none, affine = (measured(trainer) for trainer in trainers.values())
    assert affine["psnr"] > none["psnr"] + 0.3
    assert affine["cc_psnr"] > none["cc_psnr"] + 0.3
    assert none["cc_psnr"] > none["psnr"]

    trainer = trainers["affine"]
    photos = exposures.json.loads((exposed / exposures.FILE).read_text())
    files = trainer.pipeline.datamanager.train_dataset.image_filenames
    gains = np.array([photos[path.name]["gain"] * np.array(photos[path.name]["channels"]) for path in files]) / MEAN
    expected = gains ** (1 / 2.4) * (GREY + 0.055) - 0.055  # sRGB's values of what is grey at the mean exposure
    matrices = trainer.pipeline.model.color_matrices
    assert matrices is not None
    learned = anchored(matrices.detach(), torch.arange(len(files)))
    shown = (GREY * learned[..., :3].sum(dim=-1) + learned[..., 3]).numpy()
    stops = np.log2(shown.mean(axis=1))
    known = np.log2(expected.mean(axis=1))
    assert np.corrcoef(stops, known)[0, 1] > 0.98
    assert_allclose(stops, known, atol=0.25)
    assert np.std(known) > 0.3


def state(trainer: SadgsTrainer) -> dict[str, Tensor]:
    """Parameters and moments at the end of a run."""
    values = {name: value for name, value in trainer.pipeline.model.trained_params.items()}
    for name, optimizer in trainer.optimizers.optimizers.items():
        for moments in optimizer.state.values():
            values |= {f"{name}.{key}": value for key, value in moments.items()}
    return {name: value.detach().clone() for name, value in values.items()}


def test_a_resumed_run_goes_on_with_its_matrices_as_if_it_had_never_stopped(exposed: Path, tmp_path: Path):
    whole = run_of(exposed, tmp_path / "whole", "affine", 12)
    whole.steps_per_save = 6
    whole.save_only_latest_checkpoint = False
    expected = state(train(whole))
    assert not torch.equal(expected["color_matrices"][0], expected["color_matrices"][1])
    resumed = run_of(exposed, tmp_path / "resumed", "affine", 12)
    resumed.load_dir = whole.get_checkpoint_dir()
    resumed.load_step = 6
    found = state(train(resumed))
    assert expected.keys() == found.keys()
    actual = [name for name in expected if not torch.equal(expected[name], found[name])]
    assert actual == []
