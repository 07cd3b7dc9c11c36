"""Functions for several formats: an order in space, quaternions by their three smallest components, codebooks."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

_BITS = 21  # Bits of each coordinate in a Morton code of 63 bits
_LEVELS = 256  # Levels of a codebook, as many as a byte tells apart
_BINS = 256  # Bins of the histogram from which a codebook begins
_SAMPLE = 1 << 18  # Values that a codebook is made of
_ROUNDS = 20  # Rounds in which a codebook's levels move to the means of their values
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""The other three components, for each component of a quaternion. [4, 3]"""


def morton_order(means: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the order [N] of positions [N, 3] along a curve that keeps neighbours together."""
    low = means.min(axis=0)
    high = means.max(axis=0)
    span = np.maximum(high - low, 1e-30).astype(np.float64)
    shares = (means - low) / span
    most = (1 << _BITS) - 1
    coordinates = (shares * most).astype(np.int64).T  # [3, N]
    codes = np.zeros(len(means), np.int64)
    for bit in range(_BITS):
        for axis, values in enumerate(coordinates):
            bits = values >> bit & 1
            codes |= bits << (3 * bit + axis)
    return np.argsort(codes, kind="stable")


def smallest_three(quats: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the index of each unit quaternion's largest component, and its three other components.

    Where the largest component is negative, the others have the opposite sign, as q and −q are the same rotation.
    [N, 4] → [N], [N, 3] in ±√½
    """
    largest = np.abs(quats).argmax(axis=1)
    rows = np.arange(len(quats))
    signs = np.where(quats[rows, largest] < 0, np.float32(-1), np.float32(1))
    columns = _OTHERS[largest]  # [N, 3]
    others = quats[rows[:, None], columns]
    return largest, others * signs[:, None]


def codebook(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return ascending levels that quantise one value or more with little mean square error. [...] → [256]

    The first levels follow a density. Four fifths of it are the cube root of the values' density, which is best for
    many levels. One fifth is even, so that no rare value is far from a level. Lloyd's algorithm improves these levels.
    """
    counts, edges = np.histogram(values, _BINS)
    density = np.cbrt(counts)
    even = 0.25 * density.mean()
    cumulative = np.concatenate([[0.0], np.cumsum(density + even)])
    step = math.ceil(values.size / _SAMPLE)
    sample = values.flatten()[::step]
    quantiles = (np.arange(_LEVELS) + 0.5) / _LEVELS
    levels = np.interp(quantiles * cumulative[-1], cumulative, edges)
    for _ in range(_ROUNDS):
        labels = nearest_level(sample, levels)
        sizes = np.bincount(labels, minlength=_LEVELS)
        sums = np.bincount(labels, weights=sample, minlength=_LEVELS)
        means = sums / np.maximum(sizes, 1)
        levels = np.where(sizes > 0, means, levels)
    return levels.astype(np.float32)


def nearest_level(values: NDArray[np.floating], levels: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return the index of the nearest level, of at most 256 ascending ones. [...] → [...]"""
    borders = (levels[1:] + levels[:-1]) / 2
    return np.searchsorted(borders, values).astype(np.uint8)


def to_bytes(values: NDArray[np.number]) -> NDArray[np.uint8]:
    """Round values to 0 … 255; those beyond become the ends. [...] → [...]"""
    return np.rint(values).clip(0, 255).astype(np.uint8)


def sigmoid(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return opacities in [0, 1], also of huge logits. [...] → [...]"""
    return np.float32(0.5) + np.float32(0.5) * np.tanh(np.float32(0.5) * logits)
