"""The mean of parameters over iterations."""

from __future__ import annotations

import torch

from helpers.closeness import assert_within
from helpers.generators import seeded
from sadgs_ns.training.step.parameter_average import RunningMean


def test_the_mean_is_that_of_all_that_was_added_in_float64():
    generator = seeded(0)
    iterates = [torch.randn((5, 3), generator=generator) for _ in range(40)]
    params = {"means": torch.nn.Parameter(iterates[0].clone())}
    average = RunningMean()
    for iterate in iterates:
        params["means"].data.copy_(iterate)
        average.add(params)
    assert average.count == 40
    average.move_to(params)
    expected = torch.stack(iterates).double().mean(0)
    actual = params["means"].detach().double()
    assert_within(actual, expected, 1e-6)
    assert average.count == 0
    assert average.means == {}


def test_what_is_added_later_does_not_change_what_was_added():
    params = {"scales": torch.nn.Parameter(torch.ones(2, 3))}
    average = RunningMean()
    average.add(params)
    params["scales"].data.fill_(7.0)
    assert torch.equal(average.means["scales"], torch.ones(2, 3))
    assert not average.means["scales"].requires_grad


def test_it_goes_on_from_a_checkpoint():
    params = {"means": torch.nn.Parameter(torch.tensor([[1.0]]))}
    whole = RunningMean()
    first = RunningMean()
    second = RunningMean()
    for value in (1.0, 5.0, 9.0):
        params["means"].data.fill_(value)
        whole.add(params)
        if value < 9:
            first.add(params)
    second.load_state_dict(first.state_dict(), torch.device("cpu"))
    second.add(params)
    assert torch.equal(second.means["means"], whole.means["means"])
    assert float(whole.means["means"]) == 5.0


def test_all_parameters_are_averaged_as_each_by_itself():
    generator = seeded(0)
    shapes = {"means": (7, 3), "opacities": (7, 1), "features_rest": (7, 0, 3)}
    average = RunningMean()
    expected: dict[str, torch.Tensor] = {}
    for count in (1, 2, 3):
        params = {name: torch.nn.Parameter(torch.randn(shape, generator=generator)) for name, shape in shapes.items()}
        average.add(params)
        for name, parameter in params.items():
            expected[name] = expected.get(name, parameter.detach()).lerp(parameter.detach(), 1 / count)
    assert all(torch.equal(average.means[name], value) for name, value in expected.items())
