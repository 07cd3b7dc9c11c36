"""How near to each other two tensors or arrays must be."""

from __future__ import annotations

from typing import Any

from torch import Tensor
from torch.testing import assert_close


def assert_within(actual: Any, expected: Any, error: float) -> None:
    """Assert that no value is further from the expected one than an absolute error, however large both are."""
    assert_close(actual, expected, rtol=0, atol=error)


def assert_within_share(actual: Any, expected: Any, share: float) -> None:
    """Assert that no value is further from the expected one than a share of that one, however small both are."""
    assert_close(actual, expected, rtol=share, atol=0)


def assert_within_peak(actual: Tensor, expected: Tensor, share: float) -> None:
    """Assert that no value is further from the expected one than a share of the largest expected one."""
    peak = float(expected.abs().max())
    assert_within(actual, expected, share * peak)
