"""How much of what a run found to have moved is right, and the pictures of its evidence."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal
from PIL import Image

from benchmarks import __main__ as bench
from benchmarks import moved
from benchmarks.results import Result
from benchmarks.table import markdown
from helpers.kill_and_resume import configure
from sadgs_ns.training.step.moved_regions import MovedRegions

SIZE = (40, 60)


def pipeline_of(photos: list[Path], found: dict[int, torch.Tensor], finds: bool = True) -> SimpleNamespace:
    """As much of a pipeline as is measured."""
    regions = MovedRegions()
    regions.replace(found)
    views = SimpleNamespace(sizes=[SIZE] * len(photos), moved=regions)
    dataset = SimpleNamespace(image_filenames=photos)
    config = SimpleNamespace(find_moved=finds)
    return SimpleNamespace(config=config, views=views, datamanager=SimpleNamespace(train_dataset=dataset))


def write_truth(copy: Path, name: str) -> Path:
    """Let the left half of a photo of a copy be disturbed; return the photo's path."""
    mask = np.full(SIZE, 255, np.uint8)
    mask[:, : SIZE[1] // 2] = 0
    path = copy / "true_masks" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(mask).save(path.with_suffix(".png"))
    return copy / "disturbed" / name


def columns(start: int, stop: int) -> torch.Tensor:
    region = torch.zeros(SIZE, dtype=torch.uint8)
    region[:, start:stop] = 1
    return region


def test_overlap_and_what_is_left_out_wrongly_are_those_of_regions_and_true_masks(tmp_path: Path):
    photos = [write_truth(tmp_path, "0.jpg"), tmp_path / "disturbed/1.jpg", write_truth(tmp_path, "2.jpg")]
    measured = moved.measures(pipeline_of(photos, {0: columns(0, 45), 1: columns(0, 6)}))
    assert measured["moved_iou"] == pytest.approx((30 / 45 + 0) / 2)
    assert measured["moved_share"] == pytest.approx((45 + 6) / 180)
    assert measured["moved_wrong"] == pytest.approx((15 + 6) / 180)


def test_all_that_is_found_in_the_scene_s_own_photos_is_wrong(tmp_path: Path):
    write_truth(tmp_path, "0.jpg")
    measured = moved.measures(pipeline_of([tmp_path / "images/0.jpg"], {0: columns(0, 6)}))
    assert measured["moved_iou"] is None
    assert measured["moved_share"] == measured["moved_wrong"] == pytest.approx(0.1)


def test_a_run_that_was_not_to_find_anything_has_no_such_fields(tmp_path: Path):
    actual = moved.measures(pipeline_of([tmp_path / "images/0.jpg"], {}, finds=False))
    assert actual == {}
    actual = moved.measures(SimpleNamespace(config=SimpleNamespace()))
    assert actual == {}


def result(label: str, **fields: float) -> Result:
    row = {"key": label, "scene": "castle", "label": label, "seed": 0, "status": "ok", "loop_seconds": 1.0}
    return {**row, **fields}  # type: ignore[return-value]


def test_the_table_has_the_columns_if_a_row_does():
    found = result("finding", moved_iou=0.625, moved_share=0.03, moved_wrong=0.001)
    table = markdown([result("clean"), found])
    assert "| Moved, overlap | Left out | Wrongly left out |" in table
    assert "| .62 | .0300 | .0010 |" in table
    assert "Left out" not in markdown([result("clean")])


def test_evidence_of_a_run_is_drawn(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    config = configure(scene, tmp_path / "runs", 4, save_every=0)
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.train()
    arguments = ["evidence", str(trainer.base_dir / "config.yml"), "--output", str(tmp_path / "evidence")]
    status = bench.main([*arguments, "--only", "001,003"])
    assert status == 0
    drawn = sorted((tmp_path / "evidence").iterdir())
    names = [path.name for path in drawn]
    assert names == ["001.png", "003.png"]
    with Image.open(drawn[0]) as picture, Image.open(scene / "images/001.png") as photo:
        assert picture.size == (3 * photo.width, 2 * photo.height)
        corner = picture.convert("RGB").crop((0, 0, photo.width, photo.height))
        actual = np.asarray(corner)
        expected = np.asarray(photo.convert("RGB"))
        assert_array_equal(actual, expected)
    output = capsys.readouterr().out
    assert "deviation" in output and "001.png: 0.0% found" in output
