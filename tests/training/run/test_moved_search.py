"""Runs find what a few photos show and the others deny, leave it out, and change nothing where nothing moved."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from examples.drawn_scene.scene import write_scene
from helpers.gloo_ranks import run_ranks
from helpers.kill_and_resume import configure, differences, set_up
from helpers.sharded_training import set_up_together
from helpers.short_runs import nerfstudio_data
from sadgs_ns.data.images import valid_pixels
from sadgs_ns.distributed.world import World
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.run.moved_search import MovedSearch, judged_steps
from sadgs_ns.training.run.trainer import SadgsTrainer

WIDTH, HEIGHT, VIEWS, POINTS = 64, 48, 20, 500
ITERATIONS = 160
FINE = 0.5
"""Overlap of found and true regions that is asked for."""


def write_disturbed(folder: Path) -> dict[str, NDArray[np.bool_]]:
    """Paste a striped thing into a third of the photos; return where, by the photos' names. bool [H, W]"""
    generator = np.random.default_rng(0)
    truth = {}
    for path in sorted((folder / "images").iterdir())[1::3]:
        x = generator.uniform(0.3, 0.7) * WIDTH
        y = generator.uniform(0.4, 0.7) * HEIGHT
        color = tuple(generator.integers(0, 256, 3).tolist())
        other = tuple(255 - value for value in color)
        with Image.open(path) as file:
            photo = file.convert("RGB")
        outline = Image.new("L", photo.size, 0)
        ImageDraw.Draw(photo).ellipse((x - 8, y - 11, x + 8, y + 11), fill=color)
        ImageDraw.Draw(outline).ellipse((x - 8, y - 11, x + 8, y + 11), fill=255)
        ImageDraw.Draw(photo).rectangle((x - 8, y - 3, x + 8, y + 3), fill=other)
        ImageDraw.Draw(outline).rectangle((x - 8, y - 3, x + 8, y + 3), fill=255)
        path.unlink()
        photo.save(path)
        truth[path.name] = np.asarray(outline) > 0
    return truth


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clean") / "scene"
    write_scene(folder, WIDTH, HEIGHT, VIEWS, POINTS)
    return folder


@pytest.fixture(scope="module")
def disturbed(clean: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, NDArray[np.bool_]]]:
    folder = tmp_path_factory.mktemp("disturbed") / "scene"
    shutil.copytree(clean, folder)
    return folder, write_disturbed(folder)


def finding(scene: Path, output: Path, iterations: int = ITERATIONS, finds: bool = True) -> SadgsTrainerConfig:
    config = configure(scene, output, iterations, save_every=0)
    config.pipeline.find_moved = finds
    return config


@pytest.fixture(scope="module")
def found(disturbed: tuple[Path, Any], tmp_path_factory: pytest.TempPathFactory) -> SadgsTrainer:
    """A finished run on the disturbed photos."""
    trainer = set_up(finding(disturbed[0], tmp_path_factory.mktemp("found")))
    trainer.train()
    return trainer


def overlap(found: NDArray[np.bool_], true: NDArray[np.bool_]) -> float:
    return float((found & true).sum() / max((found | true).sum(), 1))


def names_of(trainer: SadgsTrainer) -> list[str]:
    return [path.name for path in trainer.pipeline.datamanager.train_dataset.image_filenames]


def hidden_pixels(trainer: SadgsTrainer, view: int) -> NDArray[np.bool_]:
    data = trainer.pipeline.views.cached(view)
    if "mask" not in data:
        return np.zeros(data["image"].shape[:2], np.bool_)
    return ~data["mask"][..., 0].numpy()


def test_judging_comes_before_what_changes_the_gaussians_and_ends_before_the_run():
    steps = sorted(judged_steps(3000, 1600))
    # Iterations are counted from 1.
    actual = [step + 2 for step in steps]
    assert actual == [400, 800, 1600, 2200]
    assert sorted(judged_steps(3000, 0)) == steps
    assert all(step < 9 for step in judged_steps(10, 9))


def test_a_run_finds_what_was_pasted_and_little_else(
    found: SadgsTrainer, disturbed: tuple[Path, dict[str, NDArray[np.bool_]]]
):
    truth = disturbed[1]
    overlaps = []
    wrong = []
    for view, name in enumerate(names_of(found)):
        hidden = hidden_pixels(found, view)
        if name in truth:
            overlaps.append(overlap(hidden, truth[name]))
        else:
            wrong.append(hidden.mean())
    assert np.mean(overlaps) >= FINE, overlaps
    assert np.mean(wrong) < 0.005


def test_the_run_keeps_a_mask_of_each_photo_in_which_something_moved(found: SadgsTrainer):
    names = names_of(found)
    views = found.pipeline.views.moved.views
    written = sorted((found.base_dir / "masks").iterdir())
    actual = [path.name for path in written]
    assert actual == [names[view] for view in views]
    for view, path in zip(views, written, strict=True):
        with Image.open(path) as mask:
            assert np.array_equal(~valid_pixels(mask), hidden_pixels(found, view))


def test_moved_pixels_have_no_structure_tensor(found: SadgsTrainer):
    cache = found.pipeline.structure_cache
    view = found.pipeline.views.moved.views[0]
    unobserved = cache[view][..., 1].numpy() == 255
    assert unobserved.any() and np.array_equal(unobserved, hidden_pixels(found, view))


def test_nothing_is_found_where_nothing_moved(clean: Path, tmp_path: Path):
    trainer = set_up(finding(clean, tmp_path / "on"))
    trainer.train()
    assert len(trainer.pipeline.views.moved) == 0
    assert not (trainer.base_dir / "masks").exists()


def test_a_run_that_finds_nothing_is_the_same_to_the_bit(clean: Path, tmp_path: Path):
    trainer = set_up(finding(clean, tmp_path / "on", iterations=24))
    trainer.train()
    off = set_up(finding(clean, tmp_path / "off", iterations=24, finds=False))
    off.train()
    assert len(trainer.pipeline.views.moved) == 0
    assert not differences(trainer.pipeline.state_dict(), off.pipeline.state_dict())


def test_without_the_option_nothing_is_judged(disturbed: tuple[Path, Any], tmp_path: Path, monkeypatch):
    trainer = set_up(finding(disturbed[0], tmp_path, iterations=20, finds=False))
    monkeypatch.setattr(trainer.pipeline.moved_search, "judge", lambda: pytest.fail("It was judged."))
    trainer.train()


def put_region(trainer: SadgsTrainer) -> None:
    """Let the upper left quarter of the first photo be found."""
    region = torch.zeros((HEIGHT, WIDTH), dtype=torch.uint8)
    region[: HEIGHT // 2, : WIDTH // 2] = 1
    changed = trainer.pipeline.views.moved.replace({0: region})
    trainer.pipeline.structure_cache.forget(changed)


def test_a_verdict_is_taken_back(clean: Path, tmp_path: Path):
    trainer = set_up(finding(clean, tmp_path, iterations=30))
    put_region(trainer)
    assert hidden_pixels(trainer, 0).mean() == 0.25
    trainer.train()
    assert not hidden_pixels(trainer, 0).any()
    assert not (trainer.pipeline.structure_cache[0][..., 1] == 255).any()


def test_structure_tensors_of_several_views_are_computed_anew(clean: Path, tmp_path: Path):
    """One view has gained a region, one has lost it, and one stays; each has what it would have alone."""
    trainer = set_up(finding(clean, tmp_path, iterations=4))
    cache = trainer.pipeline.structure_cache
    before = [cache[index].clone() for index in range(3)]
    put_region(trainer)
    region = torch.zeros((HEIGHT, WIDTH), dtype=torch.uint8)
    region[:, WIDTH // 2 :] = 1
    cache.forget(trainer.pipeline.views.moved.replace({1: region}))
    alone = next(cache.quantized([cache.views.cached(1)]))
    assert torch.equal(cache[0], before[0])
    assert torch.equal(cache[1], alone)
    assert torch.equal(cache[2], before[2])
    assert not torch.equal(cache[1], before[1])


@pytest.mark.hard_case("a GPU's memory that is full while a run looks for what moved", "trains on, with a warning")
def test_full_memory_ends_no_run(clean: Path, tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str]):
    def fill(self: MovedSearch) -> None:
        raise torch.cuda.OutOfMemoryError("full")

    monkeypatch.setattr(MovedSearch, "_small_views", fill)
    trainer = set_up(finding(clean, tmp_path, iterations=4))
    put_region(trainer)
    trainer.train()
    assert trainer.pipeline.views.moved.views == [0]
    printed = capsys.readouterr().out
    assert "memory is too full to find what moved" in printed


@pytest.mark.hard_case("things that moved before photos of several sizes", "judged at each photo's own size")
def test_photos_of_several_sizes_are_judged(tmp_path: Path):
    parser = nerfstudio_data(tmp_path / "data", [(WIDTH, HEIGHT), (40, 30)], masks=True)
    config = finding(parser.data, tmp_path / "run", iterations=4)
    config.pipeline.datamanager.dataparser = parser
    config.pipeline.model.num_random = POINTS
    trainer = set_up(config)
    verdict = trainer.pipeline.moved_search.evidence()
    sizes = trainer.pipeline.views.sizes
    assert [verdict.view(index).size for index in range(len(sizes))] == sizes
    assert len({*sizes}) == 2
    for index in range(len(sizes)):
        view = verdict.view(index)
        assert not view.valid[:, : view.valid.shape[1] // 2].any() and view.valid[:, -1].all()


@pytest.mark.parametrize("storage", ["gpu", "cpu", "compressed"])
def test_steps_leave_a_region_out_wherever_photos_are_kept(storage: Any, clean: Path, tmp_path: Path):
    config = finding(clean, tmp_path, iterations=4)
    config.pipeline.datamanager.cache_images = storage
    trainer = set_up(config)
    put_region(trainer)
    views = trainer.pipeline.views
    for index, data in views.draw(len(views)):
        if index == 0:
            assert not data["mask"][0, 0] and data["mask"][-1, -1]
        else:
            assert "mask" not in data
    unobserved = trainer.pipeline.structure_cache[0][..., 1] == 255
    assert unobserved[0, 0] and not unobserved[-1, -1]
    trainer.train()


def test_a_resumed_run_leaves_out_what_was_found(disturbed: tuple[Path, Any], found: SadgsTrainer, tmp_path: Path):
    config = finding(disturbed[0], tmp_path, ITERATIONS + 2)
    config.load_dir = found.checkpoint_dir
    resumed = set_up(config)
    assert resumed.pipeline.views.moved.views == found.pipeline.views.moved.views
    for view in found.pipeline.views.moved.views:
        assert np.array_equal(hidden_pixels(resumed, view), hidden_pixels(found, view))
    off = finding(disturbed[0], tmp_path, ITERATIONS + 2, finds=False)
    off.load_dir = found.checkpoint_dir
    assert len(set_up(off).pipeline.views.moved) == 0


def regions_together(world: World, config: SadgsTrainerConfig) -> dict[int, Any]:
    trainer = set_up_together(world, config)
    trainer.pipeline.moved_search.judge()
    moved = trainer.pipeline.views.moved
    return {view: hidden_pixels(trainer, view) for view in moved.views}


def test_several_processes_find_what_one_finds(disturbed: tuple[Path, Any], found: SadgsTrainer, tmp_path: Path):
    config = finding(disturbed[0], tmp_path / "together", ITERATIONS + 2)
    config.load_dir = found.checkpoint_dir
    alone = set_up(finding(disturbed[0], tmp_path / "alone", ITERATIONS + 2))
    alone.pipeline.load_pipeline(torch.load(next(found.checkpoint_dir.iterdir()))["pipeline"], ITERATIONS - 1)
    alone.pipeline.moved_search.judge()
    expected = {view: hidden_pixels(alone, view) for view in alone.pipeline.views.moved.views}
    assert expected
    for result in run_ranks(regions_together, 2, tmp_path / "meet", config):
        assert result.keys() == expected.keys()
        assert all(overlap(result[view], expected[view]) > 0.95 for view in expected)
