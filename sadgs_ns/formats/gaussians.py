"""The Gaussians that files hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.data.coordinates import Similarity

DEGREE_0 = 0.5 / np.sqrt(np.pi)  # The spherical harmonic of degree 0
ROWS = 1 << 16  # Number of Gaussians that are converted at a time, so that this takes little memory

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Start:
    """The camera with which a page opens, in the Gaussians' frame; it stands upright."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]  # A point that it looks at, around which the mouse turns it
    degrees: float  # Angle of view along the longer side of the window


@dataclass(frozen=True)
class Context:
    """What a writer may need beside the Gaussians."""

    up: tuple[float, float, float] = (0.0, 0.0, 1.0)  # Axis of the Gaussians' frame that is up
    start: Start | None = None  # There if the file is a page
    title: str = ""  # Of a page


DEFAULTS = Context()


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians, in the parameters of the original 3D Gaussian splatting code."""

    means: Array  # Positions in the file's frame. [N, 3]
    scales: Array  # Logarithms of the standard deviations in the file's units. [N, 3]
    quats: Array  # Rotations, wxyz, of unit length. [N, 4]
    opacities: Array  # Logits. [N]
    features_dc: Array  # Spherical harmonics of degree 0; the colour is 0.5 + `DEGREE_0` times this. [N, 3]
    features_rest: Array  # The higher degrees, with a K of 0, 3, 8 or 15. [N, K, 3]

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, rows: slice | NDArray[np.generic]) -> Gaussians:
        """Return some of the Gaussians."""
        return Gaussians(**{name: value[rows] for name, value in vars(self).items()})

    @property
    def degree(self) -> int:
        """Highest degree of the harmonics, 0 … 3."""
        num_harmonics = 1 + self.features_rest.shape[1]
        return round(num_harmonics**0.5) - 1

    def finite(self) -> Gaussians:
        """Return those whose numbers all are finite."""
        sound = np.ones(len(self), bool)
        for value in vars(self).values():
            sound &= np.isfinite(value).reshape(len(self), -1).all(axis=1)
        if sound.all():
            return self
        return self[sound]

    def moved(self, similarity: Similarity) -> Gaussians:
        """Return the Gaussians in another frame, with their harmonics turned; some may become infinite there."""
        means = np.empty_like(self.means)
        scales = np.empty_like(self.scales)
        quats = np.empty_like(self.quats)
        features_rest = np.empty_like(self.features_rest)
        turn = similarity.harmonics(self.degree)[1:, 1:]
        with np.errstate(all="ignore"):
            for start in range(0, len(self), ROWS):
                rows = slice(start, start + ROWS)
                means[rows] = similarity.positions(self.means[rows].astype(np.float64))
                scales[rows] = similarity.log_scales(self.scales[rows].astype(np.float64))
                quats[rows] = similarity.rotations(self.quats[rows].astype(np.float64))
                features_rest[rows] = turn @ self.features_rest[rows].astype(np.float64)
        return replace(self, means=means, scales=scales, quats=quats, features_rest=features_rest)


def of_parameters(params: Mapping[str, NDArray[np.floating]]) -> Gaussians:
    """Return the Gaussians of a run's parameters; raise ValueError, which names the array, if a shape does not fit.

    The parameters are `means` [N, 3], `scales` (logarithms) [N, 3], `quats` (wxyz, of any length) [N, 4], `opacities`
    (logits) [N, 1] or [N], `features_dc` [N, 3] and `features_rest` [N, K, 3] with a K of 0, 3, 8 or 15.
    """
    count = len(params["means"])
    rest = params["features_rest"]
    bands = 0
    if rest.ndim == 3:
        bands = rest.shape[1]
    if bands not in (0, 3, 8, 15):
        raise ValueError(f"features_rest must hold the 0, 3, 8 or 15 harmonics of degree 1 to 3, got {bands}")
    arrays = dict(params)
    if arrays["opacities"].shape[1:] == (1,):
        arrays["opacities"] = arrays["opacities"][:, 0]
    shapes = {
        "means": (count, 3),
        "features_dc": (count, 3),
        "scales": (count, 3),
        "features_rest": (count, bands, 3),
        "opacities": (count,),
        "quats": (count, 4),
    }
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise ValueError(f"{name} must have the shape {list(shape)}, got {list(arrays[name].shape)}")
    quats = arrays["quats"]
    with np.errstate(all="ignore"):  # Infinities and NaN are dropped later.
        lengths = np.linalg.norm(quats, axis=1, keepdims=True)  # [N, 1]
        arrays["quats"] = quats / np.maximum(lengths, 1e-12)
    return Gaussians(**{name: np.ascontiguousarray(arrays[name], dtype=np.float32) for name in shapes})
