"""Contributions to training views, and the removal of Gaussians without any."""

from __future__ import annotations

import pytest
import torch
from scenes import adam, camera, random_params, splat

from sadgs_ns.contribution import most_pixels
from sadgs_ns.strategy import StructureAwareStrategy

WIDTH, HEIGHT = 64, 48


def test_contributions_are_what_single_gaussians_add_to_the_renderings():
    """Colours enter linearly: a rendering in which one Gaussian is white and the others are black is its weight."""
    params = random_params(6)
    viewmats, Ks = camera(WIDTH, HEIGHT)
    viewmats = viewmats.repeat(2, 1, 1)
    viewmats[1, 0, 3] = 2.0
    expected = torch.zeros(2, 6)
    for i in range(6):
        white = torch.zeros(6, 3)
        white[i] = 1.0
        params["features_dc"] = torch.nn.Parameter(white)
        renders, _, _ = splat(params, viewmats, Ks.repeat(2, 1, 1), WIDTH, HEIGHT)
        expected[:, i] = renders[..., 0].sum(dim=(1, 2)).detach()
    assert (expected.argmax(dim=0) == 0).any() and (expected.argmax(dim=0) == 1).any()
    together = [(viewmats, Ks.repeat(2, 1, 1), WIDTH, HEIGHT)]
    apart = [(viewmat[None], Ks, WIDTH, HEIGHT) for viewmat in viewmats]
    for views in (together, apart):
        torch.testing.assert_close(most_pixels(params, views), expected.amax(dim=0), rtol=1e-4, atol=1e-4)
    assert all(parameter.grad is None for parameter in params.values())


def test_what_is_hidden_or_unseen_contributes_nothing():
    params = random_params(3)
    with torch.no_grad():
        params["means"].copy_(torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 4.0], [0.0, 0.0, -4.0]]))
        params["scales"].copy_(torch.log(torch.tensor([[4.0, 4.0, 0.01], [0.05, 0.05, 0.01], [1.0, 1.0, 1.0]])))
        params["quats"].copy_(torch.tensor([1.0, 0.0, 0.0, 0.0]))
        params["opacities"].fill_(20.0)
    pixels = most_pixels(params, [(*camera(WIDTH, HEIGHT), WIDTH, HEIGHT)])
    assert pixels[0] > 0.9 * WIDTH * HEIGHT and pixels[1] < 0.1 and pixels[2] == 0


@pytest.mark.parametrize(
    ("options", "due"),
    [
        ({}, [1000, 1900]),
        ({"needless_every": 0}, []),
        ({"needless_every": 950}, [950, 1900]),
        ({"needless_every": 5000}, [1900]),
        ({"refine_start_iter": 1500}, [1900]),
        ({"refine_stop_iter": 4000}, [1000, 2000, 3000, 4000]),
    ],
)
def test_the_needless_are_removed_in_the_window_and_at_its_end(options: dict[str, int], due: list[int]):
    strategy = StructureAwareStrategy(**options)  # type: ignore[arg-type]
    assert [step + 1 for step in range(7000) if strategy.removes_needless(step)] == due


def test_removal_keeps_the_order_and_the_optimizers_and_never_takes_all(capsys: pytest.CaptureFixture[str]):
    params = random_params(5)
    optimizers = adam(params)
    strategy = StructureAwareStrategy(needless_pixels=2.0, verbose=True)
    state = strategy.initialize_state()
    state["seen"] = torch.arange(5)
    means = params["means"].detach().clone()
    pixels = torch.tensor([0.0, 3.0, 1.9, 2.0, 50.0])
    assert strategy.remove_needless(params, optimizers, state, pixels) == 2
    torch.testing.assert_close(params["means"].detach(), means[[1, 3, 4]])
    assert state["seen"].tolist() == [1, 3, 4]
    assert "2 needless Gaussians removed. Now having 3." in capsys.readouterr().out
    for name, parameter in params.items():
        (group,) = optimizers[name].param_groups
        assert group["params"][0] is parameter and len(optimizers[name].state[parameter]["exp_avg"]) == 3
    assert strategy.remove_needless(params, optimizers, state, torch.zeros(3)) == 0
    assert len(params["means"]) == 3
