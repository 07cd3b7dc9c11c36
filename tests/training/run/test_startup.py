"""How a run starts: what `ns-train` does not import, since every run would wait for it, and what it says it will do."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from helpers import forked_python
from helpers.kill_and_resume import set_up
from helpers.small_scenes import HEIGHT, ITERATIONS, WIDTH
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.run.trainer import SadgsTrainer

LATER = (
    "sadgs_ns.cli", "benchmarks", "examples.drawn_scene", "pycolmap", "torchmetrics", "matplotlib.figure", "open3d",
    "jinja2.sandbox", "sklearn", "skimage", "pandas", "plyfile", "wandb", "comet_ml",
)  # fmt: skip


def test_the_methods_import_nothing_that_training_does_not_need():
    start = f"import sys, torch, {', '.join(forked_python.IMPORTED)}"
    start += "; from sadgs_ns.geometry.initialization import neighbour_scales; neighbour_scales(torch.rand(9, 3))"
    code = f"{start}; print([name for name in {LATER} if name in sys.modules])"
    run = forked_python.python(code)
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == "[]", run.stderr


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

    trainer.save_checkpoint(4)
    config.load_dir = trainer.checkpoint_dir
    config.output_dir = tmp_path / "resumed"
    assert f": {ITERATIONS} iterations of 4 views, of which 5 are done, so that each" in says(config)[1]


def test_the_number_of_views_and_the_effort_decide_what_is_not_set_by_hand(
    config: SadgsTrainerConfig, says: Callable[[SadgsTrainerConfig], tuple[SadgsTrainer, str]]
):
    config.max_num_iterations = None
    config.pipeline.effort = 0.5
    trainer, printed = says(config)
    pipeline = trainer.pipeline
    plan = trainer.pipeline.model.plan
    visits = 0.5 * (2000 + 50 * len(pipeline.datamanager.train_dataset))
    assert plan.iterations == math.ceil(visits)
    assert plan.views_per_iteration == 1
    assert trainer.config.max_num_iterations == plan.iterations
    assert pipeline.model.strategy == config.pipeline.model.strategy.for_run(plan.iterations)
    assert f": {plan.iterations:,} iterations of 1 view, so that each view is rendered about" in printed
    assert (
        "\nThe number of views and --pipeline.effort 0.5 decide this: 0.5 is a draft, and 2 resolves more." in printed
    )
    assert config.max_num_iterations is None, "config.yml says what was asked for"

    config.max_num_iterations = 5
    assert "decide this" not in says(config)[1]


def test_rates_follow_the_views_of_a_step(config: SadgsTrainerConfig):
    def rates(views: int) -> tuple[dict[str, float], dict[str, float]]:
        config.pipeline.views_per_iteration = views
        schedulers = set_up(config).optimizers.schedulers
        first = {name: scheduler.get_last_lr()[0] for name, scheduler in schedulers.items()}
        factors = {name: scheduler.lr_lambdas[0](ITERATIONS) for name, scheduler in schedulers.items()}
        return first, {name: factor * schedulers[name].base_lrs[0] for name, factor in factors.items()}

    constant = {"features_dc": 2.5e-3, "features_rest": 2.5e-4, "opacities": 0.0375}
    assert rates(1)[0].keys() == {"means", *constant}
    first, last = rates(4)
    extent = set_up(config).pipeline.model.strategy_state["scene_scale"]
    expected = pytest.approx({"means": 4.8e-4 * extent, "scales": 0.045, "quats": 0.0045} | constant)
    assert first == expected
    expected = pytest.approx({"means": 4.8e-6 * extent, "scales": 0.0075, "quats": 0.00075} | constant)
    assert last == expected
    config.rates_follow_views = False
    assert rates(4) == rates(1)


def test_late_rates_that_are_constant_by_hand_stay_so_with_any_number_of_views(config: SadgsTrainerConfig):
    config.optimizers["opacities"]["scheduler"].final_factor = 1.0
    del config.optimizers["features_dc"]["scheduler"]  # as in the config.yml of a run before rates fell late
    for views in (1, 2, 4):
        config.pipeline.views_per_iteration = views
        schedulers = set_up(config).optimizers.schedulers
        actual = schedulers["opacities"].lr_lambdas[0](ITERATIONS)
        assert actual == pytest.approx(1.0)
        assert "features_dc" not in schedulers


@pytest.mark.hard_case(
    "more views an iteration than there are, such as 50 of 10", "trains with all of them, with a warning at the start"
)
def test_a_run_says_where_there_are_fewer_views_than_a_step_should_take(
    config: SadgsTrainerConfig,
    says: Callable[[SadgsTrainerConfig], tuple[SadgsTrainer, str]],
):
    config.pipeline.views_per_iteration = 50
    trainer, printed = says(config)
    views = len(trainer.pipeline.datamanager.train_dataset)
    assert (
        f"pipeline.views_per_iteration is 50, but there are {views} training views: all are taken each time." in printed
    )
