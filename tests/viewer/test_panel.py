"""What the viewer's panel tells of a run; what it draws is tested with `sadgs-inspect`, tests/cli/test_inspect.py."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from helpers.kill_and_resume import set_up
from sadgs_ns.method.ops import update_param_with_optimizer
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.pipeline import SadgsPipeline
from sadgs_ns.viewer import structure_panel as panel_module
from sadgs_ns.viewer.structure_panel import ROWS, StructurePanel, describe


def structure_step(iteration: int, before: int, after: int) -> dict[str, int]:
    return {"iteration": iteration, "before": before, "violating": 7, "low": 3, "split": 5, "pruned": 1, "after": after}


@pytest.mark.hard_case(
    "the panel's table and its header",
    "agree: changes by AbsGS and pruning between structure steps, and since, have rows",
)
def test_the_table_leaves_out_no_change_of_the_number_of_gaussians():
    """What AbsGS added between the structure steps, and since, has a row; where there was no change there is none."""
    steps = [structure_step(500, 1000, 2000), structure_step(1000, 2600, 4000), structure_step(1500, 4000, 5000)]
    text = describe(StructureAwareStrategy(max_gaussians=9000), 4800, {"structure_steps": steps})
    expected = [
        "**4,800 Gaussians** (cap 9,000)",
        "",
        "| iteration | step | violate | low | Gaussians |",
        "| --- | --- | --- | --- | --- |",
        "| 500 | structure | 7 | 3 | 1,000 → 2,000 |",
        "| to 1000 | AbsGS, pruning | | | 2,000 → 2,600 |",
        "| 1000 | structure | 7 | 3 | 2,600 → 4,000 |",
        "| 1500 | structure | 7 | 3 | 4,000 → 5,000 |",
        "| since 1500 | AbsGS, pruning | | | 5,000 → 4,800 |",
    ]
    assert text.splitlines() == expected


def test_the_table_shows_the_last_steps():
    steps = [structure_step(i, i, i + 1) for i in range(1, 30)]
    rows = describe(StructureAwareStrategy(), 30, {"structure_steps": steps}).splitlines()[4:]
    assert len(rows) == ROWS
    assert rows[-1].startswith("| 29 ")


class Handle:
    """Stands in for an element in a browser; it keeps everything that was shown there."""

    def __init__(self) -> None:
        self.shown: list[Any] = []

    def __setattr__(self, name: str, value: Any) -> None:
        if name in ("content", "disabled"):
            self.shown.append(value)
        super().__setattr__(name, value)


@pytest.fixture
def pipeline(config: SadgsTrainerConfig) -> SadgsPipeline:
    pipeline: SadgsPipeline = set_up(config).pipeline
    pipeline.structure.table.gui_handle = handle = Handle()
    pipeline.structure.table.refresh()
    handle.shown.clear()
    pipeline.structure.observe.gui_handle = Handle()  # type: ignore[assignment]
    return pipeline


def told(panel: StructurePanel) -> list[str]:
    """What stood above the table, one text after another."""
    return [text.partition("\n")[0] for text in panel.table.gui_handle.shown]


def was_disabled(panel: StructurePanel) -> list[bool]:
    """Whether the button could not be pressed, each time that this changed."""
    return panel.observe.gui_handle.shown  # type: ignore[attr-defined]


@pytest.mark.hard_case(
    "*Observe all training views* in the viewer",
    "says above the table which view it is at, then what it found and what shows it; the button is off meanwhile",
)
def test_observing_all_training_views_tells_how_far_it_is_and_what_was_seen(
    pipeline: SadgsPipeline, monkeypatch: pytest.MonkeyPatch
):
    clock = iter(range(1000))
    monkeypatch.setattr(panel_module.time, "monotonic", lambda: next(clock))
    panel = pipeline.structure
    views = len(pipeline.views)
    panel.observe.cb_hook(panel.observe)
    statistics = panel.statistics()
    assert statistics is not None
    seen = int((statistics["n_total"] > 0).sum())
    expected = [
        "Reading the training photos and their texture …",
        *(f"Observing training view {view + 1} of {views} …" for view in range(views)),
        f"Observed {views} training views, which see {seen:,} Gaussians: “η”, “children” and “low” show what was "
        "found.",
    ]
    assert told(panel) == expected
    assert was_disabled(panel) == [True, False], "the button cannot be pressed meanwhile"
    panel.choice.value = "wavelength of the nearest photo"
    panel.choice.cb_hook(panel.choice)
    assert "Observed" not in panel.table.gui_handle.shown[-1], "it is not said for ever"


def test_what_was_observed_does_not_count_once_densification_replaced_gaussians_by_as_many(pipeline: SadgsPipeline):
    panel = pipeline.structure
    panel.observe.cb_hook(panel.observe)
    assert panel.statistics() is not None

    def flipped(_: str, value: torch.Tensor) -> torch.Tensor:
        return value.flip(0)

    update_param_with_optimizer(flipped, flipped, pipeline.model.gauss_params, {})
    assert panel.statistics() is None


@pytest.mark.hard_case("the panel fails, as with full memory", "told in the panel as well as in the terminal")
def test_what_goes_wrong_is_told_in_the_panel_too(
    pipeline: SadgsPipeline, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def full(*_: Any) -> None:
        raise RuntimeError("CUDA out of memory.\nOf no interest.")

    monkeypatch.setattr(pipeline.model, "render", full)
    panel = pipeline.structure
    panel.observe.cb_hook(panel.observe)
    assert told(panel)[-1] == "The viewer's panel stays as it was: CUDA out of memory"
    printed = capsys.readouterr().out
    assert "CUDA out of memory" in printed
    assert was_disabled(panel) == [True, False]
