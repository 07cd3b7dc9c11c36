"""How a run starts: what `ns-train` does not import, since every run would wait for it, and what it says it will do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import processes
import pytest
from kill_and_resume import set_up
from scenes import HEIGHT, ITERATIONS, WIDTH

from sadgs_ns.plugin.trainer import SadgsTrainer, SadgsTrainerConfig

LATER = ("sadgs_ns.cli.export", "pycolmap", "torchmetrics", "matplotlib.figure", "open3d", "jinja2.sandbox", "sklearn")


def test_the_methods_import_nothing_that_training_does_not_need():
    start = f"import sys, torch, {', '.join(processes.IMPORTED)}"
    start += "; from sadgs_ns.method.initialization import neighbour_scales; neighbour_scales(torch.rand(9, 3))"
    code = f"{start}; print([name for name in {LATER} if name in sys.modules])"
    run = processes.python(code)
    assert (run.returncode, run.stdout.strip()) == (0, "[]"), run.stderr


@pytest.fixture
def says(capsys: pytest.CaptureFixture[str]) -> Callable[[SadgsTrainerConfig], tuple[SadgsTrainer, str]]:
    """A run that is set up, and what it printed."""

    def start(config: SadgsTrainerConfig) -> tuple[SadgsTrainer, str]:
        capsys.readouterr()
        return set_up(config), capsys.readouterr().out

    return start


def test_a_run_says_in_two_lines_what_it_chose(
    config: SadgsTrainerConfig, says: Callable[[SadgsTrainerConfig], tuple[SadgsTrainer, str]], tmp_path: Path
):
    config.pipeline.views_per_iteration = 4
    trainer, printed = says(config)
    views = len(trainer.pipeline.datamanager.train_dataset)
    size = f"{views} training views of {WIDTH * HEIGHT / 1e6:.2g} megapixels"
    times = f"so that each view is rendered about {round(ITERATIONS * 4 / views)} times."
    assert f"sadgs on {size}: {ITERATIONS} iterations of 4 views, {times}\n" in printed
    assert "At most 2,000 Gaussians: this device's memory is not planned with, so this is max_gaussians.\n" in printed
    assert "Consider" not in printed

    trainer.save_checkpoint(4)
    config.load_dir, config.output_dir = trainer.checkpoint_dir, tmp_path / "resumed"
    assert f": {ITERATIONS} iterations of 4 views, of which 5 are done, so that each" in says(config)[1]


def test_a_run_says_where_its_preset_does_not_suit_the_data(
    config: SadgsTrainerConfig,
    says: Callable[[SadgsTrainerConfig], tuple[SadgsTrainer, str]],
    monkeypatch: pytest.MonkeyPatch,
):
    config.method_name, config.pipeline.views_per_iteration = "sadgs-indoor", 50
    trainer, printed = says(config)
    views = len(trainer.pipeline.datamanager.train_dataset)
    assert (
        f"pipeline.views_per_iteration is 50, but there are {views} training views: all are taken each time." in printed
    )

    monkeypatch.setattr("sadgs_ns.plugin.trainer._MEASURED_MEGAPIXELS", WIDTH * HEIGHT / 2e6)
    assert (
        "several views an iteration was measured on images of up to 0.7 megapixels; outdoors, on images of 1.9, it "
        "took twice as long as sadgs and was worse. Consider sadgs, or smaller images.\n"
    ) in says(config)[1]
    config.pipeline.views_per_iteration = 1
    assert "Consider" not in says(config)[1]
