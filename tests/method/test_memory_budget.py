"""The cap that the device's memory gives at the start, with a device whose memory is made up."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import torch
from kill_and_resume import configure, set_up

from sadgs_ns.demo.scene import write_scene
from sadgs_ns.errors import InputError
from sadgs_ns.method import memory
from sadgs_ns.method import strategy as strategy_module
from sadgs_ns.method.strategy import StructureAwareStrategy

DEFAULT = StructureAwareStrategy.max_gaussians
WIDTH, HEIGHT, VIEWS = 48, 36, 10


def params(n: int = 10) -> dict[str, torch.nn.Parameter]:
    """As splatfacto's of degree 3: 59 numbers."""
    shapes: dict[str, tuple[int, ...]] = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (1,)}
    shapes |= {"features_dc": (3,), "features_rest": (15, 3)}
    return {name: torch.nn.Parameter(torch.zeros(n, *shape)) for name, shape in shapes.items()}


BYTES = 4 * 4 * 59 + 4 * (3 + 3 + 3 + 1 + 3) + 4000 + 4 * 45
"""Of a Gaussian: parameter, gradient, two moments; three statistics an axis, a count, three of AbsGS; a step's working
memory; and the widest parameter once more."""


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch):
    """Sets a card's free and total memory in GB."""

    def set_memory(free: float, total: float) -> None:
        monkeypatch.setattr(strategy_module, "available_bytes", lambda device: (1e9 * free, 1e9 * total))

    return set_memory


def fit(other: float = 0.0, n: int = 10, **changes: Any) -> tuple[int, str]:
    """The cap, and what the user is told."""
    strategy = StructureAwareStrategy(**changes)
    line = strategy.fit_to_memory(params(n), other)
    assert line is not None
    return strategy.max_gaussians, line


def test_what_a_gaussian_takes_is_what_a_split_asks_for():
    state = StructureAwareStrategy._empty_state(0, torch.device("cpu"))
    assert memory.gaussian_bytes(params(), state) == BYTES
    grown = memory.affordable_growth(params(10), state, free=10 * (4000 + 180) + 7 * BYTES)
    assert grown == 7


@pytest.mark.parametrize("free", [30.0, 80.0, 139.0])
def test_a_large_card_keeps_the_default(free: float, card: Any):
    card(free, 140)
    cap, line = fit(other=1e9)
    assert cap == DEFAULT == 4_000_000
    assert line == f"At most 4,000,000 Gaussians: {1 + 4e-3 * BYTES:.1f} GB of the card's 140.0 GB."


def test_a_small_card_gets_a_cap_that_takes_four_fifths_of_what_is_free(card: Any):
    card(7.5, 8)
    cap, line = fit(other=1e9)
    assert cap == int((0.8 * 7.5e9 - 1e9) // BYTES) < DEFAULT
    assert 1e9 + cap * BYTES <= 0.8 * 7.5e9 < 1e9 + (cap + 1) * BYTES
    assert line == f"At most {cap:,} Gaussians: 6.0 GB of the card's 8.0 GB; 7.5 GB are free."


def test_a_budget_bounds_it_and_never_raises_max_gaussians(card: Any):
    card(139, 140)
    cap, line = fit(other=1e9, memory_budget_gb=4.0)
    assert cap == int(3e9 // BYTES)
    assert line == f"At most {cap:,} Gaussians: 4.0 GB of the card's 140.0 GB; memory_budget_gb is 4."
    assert fit(memory_budget_gb=100.0)[0] == DEFAULT
    assert fit(memory_budget_gb=100.0, max_gaussians=1000)[0] == 1000
    assert fit(memory_budget_gb=4.0, max_gaussians=1000)[0] == 1000
    assert fit(memory_budget_gb=4.0, max_gaussians=3_000_000)[0] == int(4e9 // BYTES)
    card(2, 8)  # more than is free is not there to be taken
    assert fit(memory_budget_gb=4.0)[0] == int(2e9 // BYTES)


def test_a_cap_that_the_user_chose_stays_without_a_budget(card: Any):
    card(2, 8)
    cap, line = fit(max_gaussians=1_000_000)
    assert cap == 1_000_000 and line.startswith("At most 1,000,000 Gaussians: 5.2 GB of the card's 8.0 GB.")


def test_a_full_card_still_starts_and_a_budget_for_nothing_is_refused(card: Any):
    card(0.5, 8)
    cap, line = fit(other=1e9)
    assert cap == 1 and line.endswith("which holds no more than the 10 at the start: none will be added.")
    with pytest.raises(ValueError) as error:
        fit(other=1e9, memory_budget_gb=0.5)
    assert str(error.value) == (
        "strategy.memory_budget_gb is 0.5 and leaves no room for Gaussians: images and rendering take 1.0 GB, and 0.5 "
        "GB are free; raise it, take fewer or smaller images, or lower pipeline.views-per-iteration."
    )


def test_without_cuda_nothing_changes():
    strategy = StructureAwareStrategy(memory_budget_gb=0.1)
    assert strategy.fit_to_memory(params(), 1e9) is None and strategy.max_gaussians == DEFAULT


def test_what_is_free_counts_what_this_process_holds_as_its_own(monkeypatch: pytest.MonkeyPatch):
    """So that a resumed run, whose Gaussians are there already, gets the cap that it had."""
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (50, 100))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: 30)
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda device: 10)
    device = torch.device("cuda")
    assert memory.available_bytes(device) == (80, 100) and memory.free_bytes(device) == 70


def test_ns_train_says_the_cap_at_the_start_and_keeps_it(
    card: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    write_scene(tmp_path / "scene", WIDTH, HEIGHT, VIEWS, points=100)
    config = configure(tmp_path / "scene", tmp_path, iterations=24, save_every=0)
    config.pipeline.model.bounding_box_points = False
    strategy = config.pipeline.model.strategy
    strategy.max_gaussians, strategy.clone_grad2d, strategy.refine_start_iter = DEFAULT, 0.0, 1
    strategy.final_prune_opacity = strategy.min_opacity = strategy.prune_opacity = 0.0
    images = VIEWS * WIDTH * HEIGHT * 3 + 8 * WIDTH * HEIGHT * 3 + WIDTH * HEIGHT * 300
    unbounded = copy.deepcopy(config)
    card((images + 120.5 * BYTES) / 0.8e9, 8)
    trainer = set_up(config)
    model = trainer.pipeline.model
    assert model.num_points < 120
    assert "At most 120 Gaussians: 0.0 GB of the card's 8.0 GB; " in capsys.readouterr().out
    trainer.train()
    assert model.num_points == model.strategy.max_gaussians == 120
    assert config.pipeline.model.strategy.max_gaussians == DEFAULT, "config.yml tells what was asked for"
    card(139, 140)
    trainer = set_up(unbounded)
    assert trainer.pipeline.model.strategy.max_gaussians == DEFAULT


def test_a_budget_for_nothing_ends_ns_train_with_one_sentence(card: Any, tmp_path: Path):
    write_scene(tmp_path / "scene", WIDTH, HEIGHT, VIEWS, points=100)
    config = configure(tmp_path / "scene", tmp_path, iterations=24, save_every=0)
    config.pipeline.model.strategy.memory_budget_gb = 1e-6
    card(8, 8)
    with pytest.raises(InputError, match=r"^pipeline\.model\.strategy\.memory_budget_gb is 1e-06 and leaves no room"):
        set_up(config)
