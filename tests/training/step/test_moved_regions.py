"""Regions of photos that are left out of the loss as masks leave pixels out."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from sadgs_ns.training.step.moved_regions import MovedRegions

REGION = torch.zeros((3, 4), dtype=torch.uint8)
REGION[0, :2] = 1


def photo(**other: Any) -> dict[str, Any]:
    return {"image": torch.zeros((6, 8, 3), dtype=torch.uint8), **other}


def test_a_photo_without_region_stays_as_it_is():
    regions = MovedRegions()
    data = photo()
    assert regions.masked(0, data) is data
    regions.replace({1: REGION})
    assert regions.masked(0, data) is data
    elsewhere: dict[str, Any] = {}  # Another process composites the view.
    assert regions.masked(1, elsewhere) is elsewhere


def test_a_region_is_hidden_at_the_size_of_the_photo():
    regions = MovedRegions()
    regions.replace({1: REGION})
    data = photo()
    mask = regions.masked(1, data)["mask"]
    expected = torch.ones((6, 8, 1), dtype=torch.bool)
    expected[:2, :4] = False
    assert torch.equal(mask, expected)
    assert "mask" not in data
    assert regions.share(1) == pytest.approx(2 / 12) and regions.share(0) == 0.0


def test_what_a_given_mask_hides_stays_hidden():
    regions = MovedRegions()
    regions.replace({1: REGION})
    given = torch.ones((6, 8, 1), dtype=torch.bool)
    given[5] = False
    mask = regions.masked(1, photo(mask=given))["mask"]
    assert not mask[5].any() and not mask[0, 0] and mask[3].all()
    assert given[0].all()


def test_only_photos_whose_region_is_another_change():
    regions = MovedRegions()
    actual = regions.replace({1: REGION, 3: REGION})
    assert actual == [1, 3]
    actual = regions.replace({1: REGION.clone(), 2: REGION})
    assert actual == [2, 3]
    assert regions.views == [1, 2] and len(regions) == 2
    assert regions.replace({}) == [1, 2] and not len(regions)


def test_a_checkpoint_gives_regions_back_by_the_photos_names():
    regions = MovedRegions()
    regions.replace({1: REGION})
    state = regions.state_dict(["a/0.png", "a/1.png"])
    restored = MovedRegions()
    restored.load_state_dict(state, ["a/1.png", "a/2.png"], torch.device("cpu"))
    assert restored.views == [0] and restored.share(0) == regions.share(1)
