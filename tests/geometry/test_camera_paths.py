"""Haze along the cameras' paths: what floats there is found, and real surfaces are not."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from helpers.generators import seeded
from sadgs_ns.geometry.camera_paths import HAZE_LENGTH, REACH, SUPPORT, CameraPaths
from sadgs_ns.method.running_strategy import empty_state
from sadgs_ns.method.strategy import StructureAwareStrategy

NEAR = 2.0
"""The near plane: space is empty up to 3 from the paths."""


def row_of_cameras(number: int = 6, spacing: float = 2.0) -> Tensor:
    """Viewmats of cameras in a row along x that look along z. [number, 4, 4]"""
    viewmats = torch.eye(4).repeat(number, 1, 1)
    viewmats[:, 0, 3] = -spacing * torch.arange(number)
    return viewmats


def wall(depth: float) -> Tensor:
    """Points on a plane across the axes of the cameras. [P, 3]"""
    x, y = torch.meshgrid(torch.linspace(-10, 20, 121), torch.linspace(-10, 10, 81), indexing="ij")
    return torch.stack([x, y, torch.full_like(x, depth)], dim=-1).view(-1, 3)


def haze(paths: CameraPaths, *places: tuple[float, float, float], scale: float = 0.5) -> list[bool]:
    return paths.haze(torch.tensor(places), torch.full((len(places), 3), scale)).tolist()


def reference(paths: CameraPaths, points: Tensor, means: Tensor, scales: Tensor) -> Tensor:
    """`CameraPaths.haze` in float64, Gaussian by Gaussian and path by path."""
    found = []
    points = points.double()
    starts = paths.starts.double()
    ways = paths.ends.double() - starts
    for mean, axes in zip(means.double(), scales.double(), strict=True):
        length = float(axes.max())
        along = ((mean - starts) * ways).sum(dim=1) / ways.square().sum(dim=1).clamp_min(1e-300)
        distance = float((mean - starts - along.clamp(0, 1)[:, None] * ways).norm(dim=1).min())
        is_alone = float((points - mean).norm(dim=1).min()) > SUPPORT * distance
        found.append(distance < paths.reach and length > HAZE_LENGTH * distance and is_alone)
    return torch.tensor(found)


@pytest.mark.hard_case(
    "faint Gaussians between the cameras, which viewers of exported files draw",
    "pruned while the run densifies",
)
def test_what_floats_on_the_cameras_paths_is_haze_and_nothing_else_is():
    paths = CameraPaths.of(row_of_cameras(), NEAR, wall(8.0))
    assert paths.reach == REACH * NEAR
    floating = [(x, y, z) for x in (-0.5, 3.0, 10.5) for y in (0.0, 1.5) for z in (-2.0, 0.1, 2.0)]
    assert all(haze(paths, *floating))
    assert not any(haze(paths, *floating[3:6], scale=0.1)), "they look small from each camera and each place between"
    actual = haze(paths, (3.0, 0.0, 0.5), scale=0.1)
    assert actual == [True]
    others = [(3.0, 0.0, 3.1), (3.0, 3.1, 0.0), (-3.1, 0.0, 0.0), (3.0, 0.0, 8.0), (3.0, 0.0, 300.0)]
    assert not any(haze(paths, *others, (float("nan"), 0.0, 0.0), (float("inf"), 0.0, 0.0)))


@pytest.mark.hard_case(
    "a wall between two rooms with cameras on both sides, and a wall beside the camera",
    "their Gaussians stay, because points to start from lie near them, but for those right where a path leads through",
)
def test_gaussians_of_surfaces_stay_however_near_the_path_leads_them():
    viewmats = torch.eye(4).repeat(2, 1, 1)
    viewmats[1, 2, 3] = -6.0
    paths = CameraPaths.of(viewmats, NEAR, wall(3.0))  # The path leads through the wall.
    actual = haze(paths, (1.0, 1.0, 3.1), (1.0, 1.0, 2.7), (1.0, 1.0, 1.0))
    assert actual == [False, False, True]
    assert haze(paths, (0.1, 0.1, 3.1)) == [True]
    beside = wall(0.0)[:, [0, 2, 1]] + torch.tensor([0.0, -1.0, 0.0])
    paths = CameraPaths.of(row_of_cameras(), NEAR, beside)
    actual = haze(paths, (3.0, -1.1, 0.5), (3.0, 1.1, 0.5), scale=0.4)
    assert actual == [False, True]


@pytest.mark.hard_case(
    "needles among leaves that reach the leaves' SfM points",
    "pruned: the points lie no nearer to them than they do to the camera",
)
def test_haze_near_surfaces_is_found():
    paths = CameraPaths.of(row_of_cameras(), NEAR, torch.tensor([[3.0, 0.0, 1.5]]))
    means = torch.tensor([[3.0, 0.0, 1.0], [3.0, 0.0, 1.4]])
    scales = torch.tensor([[0.02, 0.1, 0.8], [0.02, 0.1, 0.8]])
    assert paths.haze(means, scales).tolist() == [True, False]


@pytest.mark.parametrize(("views", "width", "near"), [(8, 9.0, NEAR), (500, 6.0, NEAR / REACH)])
def test_random_gaussians_are_found_as_a_loop_in_float64_finds_them(
    views: int, width: float, near: float, monkeypatch: pytest.MonkeyPatch
):
    generator = seeded(0)
    viewmats = row_of_cameras(views)
    viewmats[:, 1:3, 3] = torch.rand((views, 2), generator=generator)
    size = torch.tensor([2 * views + 6.0, width, width])
    points = torch.rand((300, 3), generator=generator) * torch.tensor([2 * views + 14.0, 30.0, 30.0])
    points -= torch.tensor([8.0, 15.0, 15.0])
    means = (torch.rand((3000, 3), generator=generator) - 0.5) * size + torch.tensor([views - 1.0, 0.0, 0.0])
    scales = 10 ** (2 * torch.rand((3000, 3), generator=generator) - 1.5)
    paths = CameraPaths.of(viewmats, near, points)
    numbers = []
    addcmul = torch.addcmul
    monkeypatch.setattr(torch, "addcmul", lambda a, *b, **c: (numbers.append(a.numel()), addcmul(a, *b, **c))[1])
    found = paths.haze(means, scales)
    expected = reference(paths, points, means, scales)
    assert torch.equal(found, expected)
    assert 300 < int(expected.sum()) < 1500
    if views > 100:
        assert sum(numbers) < 0.1 * 3 * len(means) * len(paths.starts), "runs of thousands of views would wait for it"


@pytest.mark.parametrize("factor", [1e-3, 1e4])
def test_a_scene_in_other_units_has_the_same_haze(factor: float):
    generator = seeded(1)
    viewmats = row_of_cameras()
    points = wall(4.0)
    means = 12 * torch.rand((500, 3), generator=generator) - torch.tensor([1.0, 6.0, 6.0])
    scales = torch.rand((500, 3), generator=generator)
    expected = CameraPaths.of(viewmats, NEAR, points).haze(means, scales)
    viewmats[:, :3, 3] *= factor
    assert torch.equal(
        CameraPaths.of(viewmats, factor * NEAR, factor * points).haze(factor * means, factor * scales), expected
    )


def cameras_at(places: Tensor) -> Tensor:
    """Viewmats of cameras at places [C, 3] that look along z. [C, 4, 4]"""
    viewmats = torch.eye(4, dtype=torch.float64).repeat(len(places), 1, 1)
    viewmats[:, :3, 3] = -places
    return viewmats


def pairs_of(paths: CameraPaths, places: Tensor) -> set[tuple[int, int]]:
    """Which places [C, 3] have a path from one to another."""
    starts = torch.cdist(paths.starts.double(), places.double()).argmin(1)
    ends = torch.cdist(paths.ends.double(), places.double()).argmin(1)
    return {(int(i), int(j)) for i, j in zip(starts, ends, strict=True) if i != j}


@pytest.mark.parametrize("number", [2, 3, 40])
def test_two_cameras_have_a_path_if_no_third_one_is_nearer_to_both(number: int):
    places = torch.rand((number, 3), generator=seeded(2), dtype=torch.float64)
    expected = set()
    for i in range(number):
        for j in range(i + 1, number):
            length = (places[i] - places[j]).norm()
            farther = torch.maximum((places - places[i]).norm(dim=1), (places - places[j]).norm(dim=1))
            if not (farther < length).any():
                expected.add((i, j))
    paths = CameraPaths.of(cameras_at(places), 0.1, wall(8.0))
    assert pairs_of(paths, places) == expected
    assert len(paths.starts) == number + len(expected), "each camera is a path of its own"


def test_a_grid_of_cameras_has_paths_along_its_rows_and_columns():
    x, y = torch.meshgrid(torch.arange(7.0), torch.arange(5.0), indexing="ij")
    places = torch.stack([x, y, torch.zeros_like(x)], dim=-1).view(-1, 3)
    paths = CameraPaths.of(cameras_at(places), NEAR, wall(8.0))
    lengths = (paths.ends - paths.starts).norm(dim=1)
    assert len(lengths) == 35 + 6 * 5 + 7 * 4
    assert lengths.unique().tolist() == [0, 1]


@pytest.mark.hard_case("panoramas in parts, several cameras in one place", "paths lead to the other places")
def test_paths_lead_from_cameras_in_one_place_to_those_in_others():
    viewmats = row_of_cameras(2, spacing=8.0).repeat_interleave(6, dim=0)
    actual = haze(CameraPaths.of(viewmats, NEAR, wall(8.0)), (4.0, 0.0, 0.5))
    assert actual == [True]


@pytest.mark.hard_case(
    "two groups of photos far apart, with plain walls between them that have no SfM points", "no path leads through"
)
@pytest.mark.parametrize(("distance", "between"), [(30.0, True), (60.0, False)])
def test_no_path_leads_to_cameras_that_are_far_away(distance: float, between: bool):
    viewmats = row_of_cameras(3).repeat(2, 1, 1)
    viewmats[3:, 2, 3] = -distance
    actual = haze(CameraPaths.of(viewmats, NEAR, wall(-8.0)), (2.0, 0.0, distance / 2))
    assert actual == [between]
    apart = row_of_cameras(3, spacing=distance)  # Cameras that all stand far apart are neighbours.
    actual = haze(CameraPaths.of(apart, NEAR, wall(-8.0)), (distance / 2, 0.0, 0.5))
    assert actual == [True]


@pytest.mark.parametrize("points", [0, 3])
def test_a_single_camera_or_two_in_one_place_have_a_space_all_the_same(points: int):
    for number in (1, 2):
        paths = CameraPaths.of(row_of_cameras(number, spacing=0.0), NEAR, wall(8.0)[:points])
        actual = haze(paths, (0.0, 0.0, 1.0), (0.0, 0.0, 4.0))
        assert actual == [True, False]
        actual = len(paths.haze(torch.zeros(0, 3), torch.zeros(0, 3)))
        assert actual == 0


@pytest.mark.parametrize("iteration", [300, 500, 1600], ids=["AbsGS", "structure", "last"])
def test_densification_steps_prune_haze_and_the_last_one_keeps_the_paths_for_a_run_that_goes_on(iteration: int):
    strategy = StructureAwareStrategy(reset_every=0, absgs_every=100, structure_every=500)
    means = torch.tensor([[3.0, 0.0, 1.0], [3.0, 0.0, 8.0], [0.0, 0.0, 12.0]])
    params = torch.nn.ParameterDict(
        {"means": means, "scales": torch.zeros(3, 3), "quats": torch.eye(4)[:3], "opacities": torch.full((3,), 2.0)}
    )
    optimizers: dict[str, torch.optim.Optimizer] = {name: torch.optim.Adam([params[name]]) for name in params}
    state: dict[str, Any] = strategy.initialize_state() | {
        "camera_paths": CameraPaths.of(row_of_cameras(), NEAR, wall(8.0))
    }
    state.update(empty_state(3, torch.device("cpu")))
    strategy.step_post_backward(params, optimizers, state, iteration - 1, [])
    assert params["means"].tolist() == means[1:].tolist()
    assert "camera_paths" in state
    for step in state.get("structure_steps", []):
        assert step["before"] == 3
        assert step["pruned"] == 1
        assert step["after"] == 2
    params["means"].data[0] = means[0]  # Haze that arises later
    strategy.for_run(3000).prune_haze(params, optimizers, state)
    assert params["means"].tolist() == means[2:].tolist()
    actual = {len(p) for p in params.values()}
    assert actual == {1}
