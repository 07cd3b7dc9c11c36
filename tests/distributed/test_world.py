"""What processes that hold one splat together decide and exchange equals what one process does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from helpers.generators import seeded
from helpers.gloo_ranks import run_ranks
from sadgs_ns.distributed.ranking import limit_growth
from sadgs_ns.distributed.world import World
from sadgs_ns.errors import InputError
from sadgs_ns.method.ops import rebalance
from sadgs_ns.method.strategy import StructureAwareStrategy

BUDGETS = (0, 1, 5, 37, 120, 2000, float("inf"), -3)


def growths() -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Growth and priorities of 90 Gaussians: with ties, with infinities and zeros, and with one that outgrows all."""
    generator = seeded(0)
    growth = torch.randint(0, 9, (90,), generator=generator)
    ties = torch.randint(0, 6, (90,), generator=generator).float()
    spread = torch.exp(20 * torch.randn(90, generator=generator))
    spread[7] = float("inf")
    spread[50] = 0.0
    outgrown = growth.clone()
    outgrown[spread.argmax()] = 511
    return [(growth, ties), (growth, spread), (outgrown, spread), (torch.ones_like(growth), ties), (0 * growth, ties)]


def limit_together(world: World) -> list[torch.Tensor]:
    part = world.take_even_part(90)
    return [limit_growth(world, g[part], p[part], budget) for g, p in growths() for budget in BUDGETS]


def test_the_budget_goes_to_the_same_gaussians(tmp_path: Path):
    results = run_ranks(limit_together, 3, tmp_path)
    alone = World()
    expected = [limit_growth(alone, growth, priority, budget) for growth, priority in growths() for budget in BUDGETS]
    for i, chosen in enumerate(expected):
        assert torch.equal(torch.cat([result[i] for result in results]), chosen), i


def test_a_world_of_one_process_asks_nobody():
    world = World()
    values = torch.tensor([3, 4])
    assert world.is_single
    assert world.rank == 0
    assert world.take_even_part(5) == slice(0, 5)
    assert world.total == 5
    assert world.sum(values) is values
    actual = world.sums(3, 4)
    assert actual == [3, 4]
    assert world.gather(values).tolist() == [[3, 4]]
    assert values.data_ptr() == world.gather(values).data_ptr()
    world.broadcast(values, 0)
    assert values.tolist() == [3, 4]
    assert world.least(2.5) == 2.5
    assert world.all(True)
    assert not world.all(False)
    torch.manual_seed(4)
    drawn = world.rand(torch.empty((2, 22, 2)))
    torch.manual_seed(4)
    assert torch.equal(drawn, torch.rand((2, 22, 2)))


def exchange_rows(world: World) -> dict[str, Any]:
    sizes = [5, 0, 17]
    rows = torch.arange(22.0).view(22, 1) + torch.tensor([0.0, 0.5])
    start = sum(sizes[: world.rank])
    mine = rows[start : start + sizes[world.rank]]
    world.count(len(mine))
    uneven = world.is_uneven()
    gathered = world.gather_rows(mine)
    evened = world.rebalance(mine)
    world.rebalance(mine[:, :0])  # Coefficients of harmonics have no numbers where the degree is 0.
    world.count(len(evened))
    torch.manual_seed(4)
    drawn = world.rand(torch.empty((2, len(evened), 2)))
    after = torch.rand(1)
    return {
        "sizes": world.sizes, "uneven": uneven, "even": not world.is_uneven(), "gathered": gathered,
        "evened": evened, "drawn": drawn, "after": after, "least": world.least(3.0 - world.rank),
        "all": (world.all(True), world.all(world.rank > 0)),
    }  # fmt: skip


def test_rows_are_gathered_and_evened_out_in_the_order_of_the_ranks(tmp_path: Path):
    results = run_ranks(exchange_rows, 3, tmp_path)
    rows = torch.arange(22.0).view(22, 1) + torch.tensor([0.0, 0.5])
    assert torch.equal(results[0]["gathered"], rows)
    assert torch.equal(torch.cat([result["evened"] for result in results]), rows)
    torch.manual_seed(4)
    assert torch.equal(torch.cat([result["drawn"] for result in results], dim=1), torch.rand((2, 22, 2)))
    after = torch.rand(1)
    for result in results:
        assert result["sizes"] == [7, 7, 8]
        assert result["uneven"]  # 8 is more than 1.1 times 7.
        assert not result["even"]
        assert torch.equal(result["after"], after)
        assert result["least"] == 1.0
        assert result["all"] == (True, False)


def prune_together(world: World) -> list[int]:
    """Numbers of Gaussians of this process after each of two prunings, and after the shards were evened out."""
    strategy = StructureAwareStrategy().for_run(3000, world)
    means = torch.arange(12.0).view(4, 3) + 12 * world.rank
    params = {"means": torch.nn.Parameter(means), "opacities": torch.nn.Parameter(torch.ones(4))}
    optimizers = {name: torch.optim.Adam([parameter]) for name, parameter in params.items()}
    faint = torch.ones(4, dtype=torch.bool)
    faint[3:] = world.rank == 0
    numbers = []
    for mask in (faint, faint if world.rank == 0 else ~faint):
        strategy._prune(params, optimizers, {}, 0.0, mask)
        numbers.append(len(params["means"]))
    rebalance(world, params, optimizers, {})
    return [*numbers, len(params["means"])]


@pytest.mark.hard_case(
    "a prune that would leave fewer than one Gaussian for each process", "is left out, training goes on"
)
def test_each_process_keeps_a_gaussian(tmp_path: Path):
    """Two processes cannot train the one Gaussian that the first pruning would leave them."""
    expected = [[4, 0, 1], [4, 3, 2]]
    assert run_ranks(prune_together, 2, tmp_path) == expected


def share_out_too_few(world: World) -> str:
    with pytest.raises(InputError) as error:
        world.take_even_part(1)
    return str(error.value)


@pytest.mark.hard_case("fewer Gaussians than processes", "refused in one sentence")
def test_fewer_gaussians_than_processes_are_refused(tmp_path: Path):
    for message in run_ranks(share_out_too_few, 2, tmp_path):
        assert message == "2 processes cannot share out 1 Gaussians: start fewer processes."
