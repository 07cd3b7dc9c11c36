"""Parameters and moments are changed together."""

from __future__ import annotations

import pytest
import torch
from gsplat.strategy import ops as gsplats

from helpers.small_scenes import adam, random_params
from sadgs_ns.method.ops import update_param_with_optimizer

N = 5


@pytest.mark.parametrize("names", [None, ["scales"]])
def test_it_changes_what_gsplats_own_changes(names: list[str] | None):
    def shorter(name: str, p: torch.Tensor) -> torch.nn.Parameter:
        return torch.nn.Parameter(p[: N - 2], requires_grad=p.requires_grad)

    changed = []
    for function in (update_param_with_optimizer, gsplats._update_param_with_optimizer):
        params = random_params(N)
        optimizers = adam(params)
        function(shorter, lambda key, moment: 2 * moment[: N - 2], params, optimizers, names)
        changed.append((params, optimizers))
    (params, optimizers), (expected, others) = changed
    for name, parameter in params.items():
        assert torch.equal(parameter, expected[name])
        assert optimizers[name].param_groups[0]["params"][0] is parameter
        state = optimizers[name].state[parameter]
        other = others[name].state[expected[name]]
        assert state.keys() == other.keys()
        assert all(torch.equal(state[key], other[key]) for key in state)


def test_a_parameter_that_is_not_trained_needs_no_optimizer():
    params = {"means": torch.nn.Parameter(torch.zeros(N, 3), requires_grad=False)}
    update_param_with_optimizer(lambda name, p: torch.nn.Parameter(p[1:]), lambda key, v: v, params, {})
    assert len(params["means"]) == N - 1


def test_an_optimizer_whose_moments_were_being_changed_has_no_state():
    def fail(key: str, moment: torch.Tensor) -> torch.Tensor:
        raise MemoryError

    params = {"means": torch.nn.Parameter(torch.zeros(N, 3))}
    optimizers: dict[str, torch.optim.Optimizer] = {"means": torch.optim.Adam(params.values())}
    params["means"].sum().backward()
    optimizers["means"].step()
    assert optimizers["means"].state
    with pytest.raises(MemoryError):
        update_param_with_optimizer(lambda name, p: torch.nn.Parameter(p), fail, params, optimizers)
    assert not optimizers["means"].state
