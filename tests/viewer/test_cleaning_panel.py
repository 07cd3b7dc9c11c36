"""The viewer's panel for cleaning: what it says, what it draws, and that it takes nothing away."""

from __future__ import annotations

import copy
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer_elements import ViewerElement

from helpers.kill_and_resume import set_up
from helpers.short_runs import in_the_viewer
from sadgs_ns.geometry.cleaning import Cleaning, choose_remaining, measure_visibility
from sadgs_ns.method.ops import update_param_with_optimizer
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.pipeline import SadgsPipeline
from sadgs_ns.viewer.cleaning_panel import GOES, OUTPUT, STAYS, CleaningPanel, command_line_options
from sadgs_ns.viewer.cleaning_text import removal_sentences


@pytest.fixture
def pipeline(config: SadgsTrainerConfig) -> SadgsPipeline:
    pipeline: SadgsPipeline = set_up(config).pipeline
    pipeline.eval()
    pipeline.cleaning.text.gui_handle = SimpleNamespace(content="")
    return pipeline


def shown(pipeline: SadgsPipeline) -> tuple[torch.Tensor, torch.Tensor]:
    """The model's own picture and the panel's, in the viewer."""
    camera = pipeline.datamanager.train_dataset.cameras[:1]
    outputs = in_the_viewer(lambda: pipeline.model.get_outputs_for_camera(camera))
    return outputs["rgb"], outputs[OUTPUT]


def set_to(panel: CleaningPanel, **values: Any) -> str:
    """Move the elements as a user does; what the panel then says."""
    for name, value in values.items():
        element = getattr(panel, name)
        element.value = value
        element.cb_hook(element)
    return panel.text.gui_handle.content


def test_the_viewer_finds_the_elements(pipeline: SadgsPipeline):
    found = [path for path, _ in parse_object(pipeline, ViewerElement, "Custom Elements")]
    names = [path.removeprefix("Custom Elements/cleaning/") for path in found if "/cleaning/" in path]
    assert names == ["choice", "crop_from", "crop_to", "dust", "max_extent", "min_views", "text"]
    assert not [name for name in pipeline.state_dict() if "cleaning" in name]


@torch.no_grad()
def test_the_preview_draws_what_stays_and_what_goes_and_takes_nothing(pipeline: SadgsPipeline):
    panel = pipeline.cleaning
    model = pipeline.model
    before = {name: value.clone() for name, value in model.gauss_params.items()}
    rgb, picture = shown(pipeline)
    assert torch.equal(rgb, picture), "off"
    middle = float(model.means[:, 0].median())
    said = set_to(panel, crop_from=(middle, -100.0, -100.0), choice=STAYS)
    stays = model.means[:, 0] >= torch.tensor(middle)
    assert f"{int((~stays).sum()):,} Gaussians outside the box are taken away." in said
    assert f"{int(stays.sum()):,} of {len(stays):,} Gaussians would stay." in said
    assert f"`sadgs-export RUN --output splat.ply --crop {middle:g} -100 -100 100 100 100` does this." in said
    rgb, kept = shown(pipeline)
    set_to(panel, choice=GOES)
    _, gone = shown(pipeline)
    assert not torch.equal(rgb, kept)
    assert not torch.equal(rgb, gone)
    assert not torch.equal(kept, gone)
    for name, value in before.items():
        assert torch.equal(value, model.gauss_params[name])
        model.gauss_params[name].data = value[stays]
    again, picture = shown(pipeline)
    assert torch.equal(again, kept), "a model of these alone draws the same"
    assert torch.equal(again, picture), "of other Gaussians than were looked at, nothing is hidden"


@torch.no_grad()
def test_nothing_is_hidden_once_densification_replaced_gaussians_by_as_many(pipeline: SadgsPipeline):
    model = pipeline.model
    middle = float(model.means[:, 0].median())
    set_to(pipeline.cleaning, crop_from=(middle, -100.0, -100.0), choice=STAYS)
    rgb, picture = shown(pipeline)
    assert not torch.equal(rgb, picture)

    def flipped(_: str, value: torch.Tensor) -> torch.Tensor:
        return value.flip(0)

    update_param_with_optimizer(flipped, flipped, model.gauss_params, {})
    rgb, picture = shown(pipeline)
    assert torch.equal(rgb, picture)


def test_what_views_see_is_measured_once_and_again_when_training_went_on(
    pipeline: SadgsPipeline, monkeypatch: pytest.MonkeyPatch
):
    panel = pipeline.cleaning
    model = pipeline.model
    looks: list[Any] = []

    def look(params: Any, cameras: Any, drawing: Any) -> Any:
        looks.append(cameras)
        return measure_visibility(params, cameras, drawing)

    monkeypatch.setattr("sadgs_ns.viewer.cleaning_panel.measure_visibility", look)
    said = set_to(panel, min_views=3)
    set_to(panel, dust=0.5)
    views = len(pipeline.views)
    actual = [len(cameras) for cameras in looks]
    assert actual == [views]
    params = dict(model.gauss_params.items())
    seen = measure_visibility(params, looks[0], model.drawing)
    cleaning = Cleaning(min_views=3)
    sentences = removal_sentences(cleaning, choose_remaining(params, cleaning, seen))
    assert said.startswith(sentences[0])
    model.step += 1
    set_to(panel, dust=0.6)
    actual = [len(cameras) for cameras in looks]
    assert actual == [views, views]


def test_a_reversed_box_is_told_and_changes_nothing(pipeline: SadgsPipeline, capsys: pytest.CaptureFixture[str]):
    panel = pipeline.cleaning
    set_to(panel, choice=STAYS)
    _, before = shown(pipeline)
    said = set_to(panel, crop_to=(-200.0, 100.0, 100.0))
    assert said.startswith("The picture stays as it was: --crop -100 -100 -100 -200 100 100 is no box: give ")
    printed = " ".join(capsys.readouterr().out.split())
    assert "is no box" in printed
    assert torch.equal(shown(pipeline)[1], before)


@torch.no_grad()
def test_a_camera_that_is_no_pinhole_leaves_the_preview_empty_and_the_viewer_drawing(pipeline: SadgsPipeline):
    set_to(pipeline.cleaning, choice=STAYS)
    camera = copy.deepcopy(pipeline.datamanager.train_dataset.cameras[:1])
    camera.camera_type = torch.full_like(camera.camera_type, CameraType.EQUIRECTANGULAR.value)
    outputs = in_the_viewer(lambda: pipeline.model.get_outputs_for_camera(camera))
    assert torch.equal(outputs[OUTPUT], outputs["rgb"])
    assert not outputs["accumulation"].any()


def test_evaluation_gets_no_picture_of_the_panel(pipeline: SadgsPipeline):
    camera = pipeline.datamanager.train_dataset.cameras[:1]
    assert OUTPUT not in pipeline.model.get_outputs_for_camera(camera)


def test_the_options_are_those_of_the_command():
    assert command_line_options(Cleaning()) == ""
    cleaning = Cleaning(min_views=2, max_extent=0.5, crop=(-1, -2, -3, 1, 2, 3.5), dust=0.1)
    assert command_line_options(cleaning) == "--min-views 2 --max-extent 0.5 --crop -1 -2 -3 1 2 3.5 --dust 0.1"
