"""What one view shows and the others deny, on a drawn wall that five cameras see."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor
from torch.testing import assert_close

from helpers.generators import seeded
from sadgs_ns.geometry import moved
from sadgs_ns.geometry.moved import (
    SmallView,
    Spread,
    excesses,
    grouped,
    regions,
    spread,
    surface_points,
    working_size,
)

HEIGHT, WIDTH = 40, 60
WALL = 4.0
"""Depth of the wall."""
THING = (slice(12, 24), slice(20, 32))
"""Rows and columns of what one photo shows."""
LIMITS = Spread(0.0, 0.005)


def view_at(x: float, differing: Tensor | None = None, depth: float = WALL, valid: Tensor | None = None) -> SmallView:
    """A camera at x that looks at the wall, and differs from its photo in some pixels, bool [h, w]."""
    viewmat = torch.eye(4)
    viewmat[0, 3] = -x
    K = torch.tensor([[40.0, 0.0, WIDTH / 2], [0.0, 40.0, HEIGHT / 2], [0.0, 0.0, 1.0]])
    values = torch.zeros(HEIGHT, WIDTH)
    if differing is not None:
        values[differing] = 0.3
    if valid is None:
        valid = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    return SmallView(values, values.clone(), torch.full((HEIGHT, WIDTH), depth), valid, viewmat, K)


def excess(view: SmallView, others: list[SmallView]) -> Tensor:
    """The excess of a view beyond others."""
    neighbours = [list(range(1, len(others) + 1)), *[[] for _ in others]]
    return excesses(grouped([view, *others]), neighbours)[0]


def region(view: SmallView, values: Tensor, limits: Spread) -> NDArray[np.bool_] | None:
    """Where something moved in a view, given its excess."""
    return regions(grouped([view]), [values], limits).get(0)


def difference(photo: Tensor, drawn: Tensor, valid: Tensor) -> Tensor:
    return moved.difference(photo[None], drawn[None], valid[None])[0]


def structure(photo: Tensor, drawn: Tensor, valid: Tensor) -> Tensor:
    return moved.structure(photo[None], drawn[None], valid[None])[0]


def pixels(rows: slice, columns: slice) -> Tensor:
    chosen = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    chosen[rows, columns] = True
    return chosen


def thing_on_the_wall(x: float) -> Tensor:
    """Pixels in which a camera at x sees the place of the wall that the camera at 0 sees behind the thing."""
    rows, columns = THING
    shift = round(-40 * x / WALL)
    return pixels(rows, slice(columns.start + shift, columns.stop + shift))


def test_large_photos_are_reduced_and_small_ones_stay():
    assert working_size((1200, 1600)) == (300, 400)
    assert working_size((90, 120)) == (90, 120)
    assert working_size((1, 5000)) == (1, 400)


def test_an_edge_a_pixel_beside_its_place_is_no_difference_and_another_colour_is_one():
    photo = torch.zeros(3, HEIGHT, WIDTH)
    photo[:, :, 30:] = 1.0
    drawn = torch.zeros(3, HEIGHT, WIDTH)
    drawn[:, :, 31:] = 1.0
    everywhere = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    assert float(difference(photo, drawn, everywhere).max()) < 1e-6
    other = difference(photo, 1 - photo, everywhere)
    actual = other[20, 5]
    expected = torch.tensor(1.0)
    assert_close(actual, expected)


def test_hidden_pixels_do_not_differ_and_do_not_reach_those_beside_them():
    photo = torch.zeros(3, HEIGHT, WIDTH)
    hidden = pixels(*THING)
    photo[:, hidden] = 1.0
    found = difference(photo, torch.zeros_like(photo), ~hidden)
    assert float(found.max()) < 1e-6


def test_what_one_view_shows_alone_is_in_its_excess():
    views = [view_at(0.0, pixels(*THING)), view_at(-0.4), view_at(0.4), view_at(0.8)]
    found = excess(views[0], views[1:])
    inside = pixels(*THING)
    expected = torch.full((144,), 0.3)
    assert_close(found[inside], expected)
    assert float(found[~inside & found.isfinite()].abs().max()) == 0.0


def test_what_no_view_has_learned_yet_is_not():
    views = [view_at(x, thing_on_the_wall(x)) for x in (0.0, -0.4, 0.4, 0.8)]
    found = excess(views[0], views[1:])
    assert float(found.nan_to_num(-1.0).max()) <= 0.0


def test_views_in_which_something_nearer_stands_before_the_point_deny_nothing():
    views = [view_at(0.0, pixels(*THING)), view_at(-0.4, depth=1.0), view_at(0.4, depth=1.0), view_at(0.8)]
    assert bool(excess(views[0], views[1:]).isnan().all())


def test_views_that_look_through_a_point_at_what_is_behind_deny_it():
    thing = pixels(*THING)
    near = view_at(0.0, thing)
    near.depth[thing] = 3.0
    found = excess(near, [view_at(-0.4), view_at(0.4), view_at(0.8)])
    expected = torch.full((144,), 0.3)
    assert_close(found[thing], expected)


def test_too_few_views_and_hidden_pixels_are_no_evidence():
    hidden = pixels(slice(0, HEIGHT), slice(0, 30))
    masked = view_at(0.0, pixels(*THING), valid=~hidden)
    found = excess(masked, [view_at(-0.4), view_at(0.4), view_at(0.8)])
    assert bool(found[hidden].isnan().all())
    assert bool(excess(view_at(0.0), [view_at(0.4)]).isnan().all())
    blind = view_at(0.4, valid=torch.zeros(HEIGHT, WIDTH, dtype=torch.bool))
    assert bool(excess(view_at(0.0), [blind, view_at(-0.4)]).isnan().all())


def cropped(view: SmallView, height: int, width: int) -> SmallView:
    """The left upper part of a view."""
    part = (slice(0, height), slice(0, width))
    return SmallView(
        view.difference[part], view.structure[part], view.depth[part], view.valid[part], view.viewmat, view.K
    )


def test_views_of_several_sizes_are_judged_together_as_each_is_alone(monkeypatch: pytest.MonkeyPatch):
    positions = (-0.8, -0.4, 0.0, 0.4, 0.8)
    views = [view_at(x, thing_on_the_wall(x)) for x in positions[:4]]
    views.append(view_at(positions[4], pixels(*THING)))
    for index in (1, 3):
        views[index] = cropped(views[index], HEIGHT - 8, WIDTH - 12)
    neighbours = [[other for other in range(5) if other != index] for index in range(5)]
    neighbours[0] = []
    together = excesses(grouped(views), neighbours)
    monkeypatch.setattr(moved, "_PIXELS_TOGETHER", 1)
    one_by_one = excesses(grouped(views), neighbours)
    for index in range(5):
        alone = excess(views[index], [views[other] for other in neighbours[index]])
        assert_close(together[index], alone, equal_nan=True, rtol=0, atol=0)
        assert_close(one_by_one[index], alone, equal_nan=True, rtol=0, atol=0)
    assert together[0].isnan().all()
    assert float(together[4][pixels(*THING)].nan_to_num(0.0).max()) == pytest.approx(0.3)


def test_the_spread_is_that_of_most_pixels_whatever_a_few_are():
    generator = seeded(0)
    values = 0.01 * torch.randn((100, 100), generator=generator)
    values[:10] = 5.0
    values[10] = math.nan
    limits = spread([values])
    assert limits.deviation == pytest.approx(0.01, rel=0.2) and abs(limits.median) < 0.005
    assert limits.strong == pytest.approx(limits.median + moved.STRONG * limits.deviation)
    actual = spread([torch.full((4, 4), math.nan)])
    assert actual == Spread(0.0, 0.0)


def test_small_excesses_are_no_reason_however_alike_all_others_are():
    limits = Spread(0.0, 0.0)
    assert limits.strong == moved.LEAST_EXCESS and 0 < limits.weak < limits.strong


def test_a_region_covers_what_moved_and_fills_its_holes():
    values = torch.zeros(HEIGHT, WIDTH)
    thing = pixels(*THING)
    values[thing] = 0.3
    values[16:19, 24:27] = 0.0
    found = region(view_at(0.0, thing), values, LIMITS)
    assert found is not None
    assert found[thing.numpy()].all()
    assert found.sum() <= (12 + 2 * moved.DILATION) ** 2


def test_single_pixels_and_weak_regions_are_none():
    values = torch.zeros(HEIGHT, WIDTH)
    values[::7, ::7] = 0.5
    everywhere = view_at(0.0, torch.ones(HEIGHT, WIDTH, dtype=torch.bool))
    assert region(everywhere, values, LIMITS) is None
    values = torch.zeros(HEIGHT, WIDTH)
    values[THING] = 0.5 * (LIMITS.weak + LIMITS.strong)
    assert region(everywhere, values, LIMITS) is None


def test_another_light_is_no_thing():
    thing = pixels(*THING)
    values = torch.zeros(HEIGHT, WIDTH)
    values[thing] = 0.3
    view = view_at(0.0, thing)
    assert region(view, values, LIMITS) is not None
    view.structure[thing] = 0.05
    assert region(view, values, LIMITS) is None


def test_structure_is_what_does_not_change_slowly():
    everywhere = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    photo = torch.rand((3, HEIGHT, WIDTH), generator=seeded(0))
    light = torch.linspace(0, 0.3, WIDTH).expand(3, HEIGHT, WIDTH)
    inner = slice(moved.WIDE // 2, -(moved.WIDE // 2))
    assert float(structure(photo + light, photo, everywhere)[:, inner].max()) < 0.02
    assert float(difference(photo + light, photo, everywhere)[:, inner].max()) > 0.1
    thing = photo.clone()
    rows, columns = THING
    thing[:, rows, columns] = 1.0
    assert float(structure(thing, photo, everywhere)[THING].mean()) > 0.1


def test_a_region_goes_on_where_the_excess_is_unknown_if_the_pixels_differ_much():
    thing = pixels(*THING)
    values = torch.zeros(HEIGHT, WIDTH)
    values[thing] = 0.3
    values[:18] = math.nan  # Sky, which the upper half of the thing stands before
    upper = thing & values.isnan()
    found = region(view_at(0.0, thing), values, LIMITS)
    assert found is not None and found[upper.numpy()].all()
    alike = view_at(0.0, thing)
    alike.difference[upper] = 0.0
    found = region(alike, values, LIMITS)
    assert found is not None and found[upper.numpy()].mean() < 0.5


def slow_region(view: SmallView, values: Tensor, limits: Spread) -> NDArray[np.bool_]:
    """What `region` finds, one component after another by scipy; all False if nothing moved. [h, w]"""
    cross = ndimage.generate_binary_structure(2, 1)
    known = values.isfinite().numpy()
    excess = np.where(known, values.numpy(), -np.inf)
    differing = view.difference.numpy() > float(view.difference.median() + limits.strong)
    strong = excess > limits.strong
    structural = strong & (view.structure.numpy() > moved.LEAST_EXCESS)
    opened: Any = ndimage.binary_opening(np.where(known, excess > limits.weak, differing), cross)
    components: Any = ndimage.label(opened, cross)
    labels, number = components
    found = np.zeros_like(known)
    for label in range(1, number + 1):
        component = labels == label
        enough = max(moved.SMALLEST_SHARE * known.size, 4)
        num_strong = int((component & strong).sum())
        num_structural = int((component & structural).sum())
        if num_strong >= enough and num_structural >= moved.STRUCTURAL_SHARE * num_strong:
            found |= component
    dilated: Any = ndimage.binary_dilation(found, cross, moved.DILATION)
    filled: Any = ndimage.binary_fill_holes(dilated, cross)
    return filled


@pytest.mark.parametrize("seed", range(8))
def test_regions_of_noise_are_those_of_scipy(seed: int):
    random = seeded(seed)

    def noise() -> Tensor:
        """Squares of noise, of which each has another strength."""
        coarse = torch.rand(HEIGHT // 10, WIDTH // 10, generator=random)
        fine = torch.rand(HEIGHT, WIDTH, generator=random)
        return 0.5 * coarse.repeat_interleave(10, 0).repeat_interleave(10, 1) * fine

    view = view_at(0.0)
    view = SmallView(noise(), noise(), view.depth, view.valid, view.viewmat, view.K)
    values = noise()
    values[: 2 * seed] = math.nan
    values[noise() > 0.4] = math.nan
    limits = Spread(0.02, 0.01)
    expected = slow_region(view, values, limits)
    found = region(view, values, limits)
    assert expected.any()
    assert found is not None
    np.testing.assert_array_equal(found, expected)


def test_only_views_with_enough_strong_pixels_have_regions():
    thing = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    thing[10:12, 10:14] = True  # A region has at least .3 % of 2,400 pixels, and opening takes the corners.
    thing[9:13, 11:13] = True
    few = torch.where(thing, 0.1, 0.0)
    few[10, 10:14] = 0.3
    enough = torch.where(thing, 0.3, 0.0)
    unknown = torch.full((HEIGHT, WIDTH), math.nan)
    views = [view_at(0.0, thing), view_at(0.0, thing), view_at(0.0)]
    found = regions(grouped(views), [few, enough, unknown], LIMITS)
    assert list(found) == [1]
    assert regions([], [], LIMITS) == {}


def test_regions_of_many_views_are_those_of_each_alone(monkeypatch: pytest.MonkeyPatch):
    thing = pixels(*THING)
    views = [
        view_at(0.0, thing),
        cropped(view_at(0.0, thing), HEIGHT - 8, WIDTH - 12),
        view_at(0.0),
        view_at(0.0, thing),
    ]
    values = [view.difference for view in views]
    together = regions(grouped(views), values, LIMITS, threads=2)
    monkeypatch.setattr(moved, "_MARKED_TOGETHER", 1)
    one_by_one = regions(grouped(views), values, LIMITS)
    assert list(together) == [0, 1, 3] and list(one_by_one) == [0, 1, 3]
    for index in together:
        alone = region(views[index], values[index], LIMITS)
        assert alone is not None
        np.testing.assert_array_equal(together[index], alone)
        np.testing.assert_array_equal(one_by_one[index], alone)


def test_points_lie_on_what_is_drawn():
    nothing = view_at(0.4, depth=0.0)
    points = surface_points(grouped([view_at(0.0), nothing]))
    assert len(points) > 500
    actual = points[:, 2]
    expected = torch.full((len(points),), WALL, dtype=torch.float64)
    assert_close(actual, expected)
