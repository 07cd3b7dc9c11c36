"""What enters a hash of tensors, and what does not."""

from __future__ import annotations

from typing import Any

import torch

from benchmarks.hashes import DIGITS, groups_of, hash_tensors, tensors_in


def tensors() -> dict[str, torch.Tensor]:
    return {"means": torch.arange(6.0).view(2, 3), "counts": torch.tensor([1, 2])}


def test_the_order_of_names_does_not_matter():
    given = tensors()
    assert hash_tensors(given) == hash_tensors(dict(reversed(given.items())))
    assert len(hash_tensors(given)) == DIGITS


def test_a_bit_a_name_a_shape_a_type_and_a_missing_tensor_matter():
    one_bit = tensors()
    one_bit["means"].view(torch.int32)[0, 0] ^= 1
    renamed = tensors()
    renamed["centres"] = renamed.pop("means")
    reshaped = tensors()
    reshaped["means"] = reshaped["means"].view(3, 2)
    other_type = tensors()
    other_type["counts"] = other_type["counts"].int()
    missing = tensors()
    del missing["counts"]
    changed = [tensors(), one_bit, renamed, reshaped, other_type, missing]
    assert len({hash_tensors(values) for values in changed}) == len(changed)


def test_a_view_has_the_hash_of_its_values():
    transposed = torch.arange(6.0).view(2, 3).T
    actual = hash_tensors({"means": transposed})
    assert actual == hash_tensors({"means": transposed.clone()})


def test_tensors_are_found_in_nested_values_and_others_are_left_out():
    found = tensors_in({"a": [torch.ones(1), {"b": torch.zeros(2)}], "rate": 0.1, "name": "c"})
    actual = {name: value.tolist() for name, value in found.items()}
    expected = {"a.0": [1.0], "a.1.b": [0.0, 0.0]}
    assert actual == expected


def test_a_checkpoint_s_plan_and_options_do_not_enter_its_hashes():
    def checkpoint(option: str) -> dict[str, Any]:
        model = {"strategy_state": {"n_total": torch.ones(2), "scene_scale": 1.0}, "average": {"means": {}}}
        pipeline = {
            "_model.gauss_params.means": torch.zeros(2, 3),
            "_model._extra_state": model,
            "_extra_state": {"torch": torch.ones(4), "plan": {option: 1}},
        }
        return {"step": 3, "pipeline": pipeline, "optimizers": {"means": {"state": {0: {"exp_avg": torch.ones(1)}}}}}

    def hashes_of(option: str) -> dict[str, str]:
        return {name: hash_tensors(tensors) for name, tensors in groups_of(checkpoint(option)).items()}

    one = hashes_of("old")
    other = hashes_of("new")
    assert one == other
    actual = set(groups_of(checkpoint("old"))["strategy"])
    assert actual == {"n_total"}
