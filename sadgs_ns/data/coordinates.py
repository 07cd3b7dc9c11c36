"""Similarities between world frames, which move positions, shapes and spherical harmonics."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.errors import InputError, reason

Array = NDArray[np.float64]

TRANSFORMS_NAME = "dataparser_transforms.json"  # In this file nerfstudio's trainer writes how it moved the capture.
FRAME_KEYS = ("dataparser_transform", "dataparser_scale")
"""Keys of a `transforms.json` that fix how its data is moved, so that adding photos leaves the frame of training."""
_TOLERANCE = 1e-4  # Largest deviation from a similarity of a transform in float32, relative to its scale


@dataclass(frozen=True)
class Similarity:
    """The map x ↦ scale · orthogonal · x + translation from one world frame to another."""

    scale: float  # Factor by which lengths grow; it is positive
    orthogonal: Array  # A rotation, or a rotation times −1, which is a reflection. [3, 3]
    translation: Array  # Translation in units of the frame that results. [3]

    @staticmethod
    def of(transform: Array) -> Similarity:
        """Return a matrix [3, 4] as a similarity; raise ValueError if it is none, even up to rounding."""
        error = ValueError("it is no rotation, scale and translation")
        if not np.isfinite(transform).all():
            raise error
        linear = np.asarray(transform[:, :3], dtype=np.float64)
        scale = abs(np.linalg.det(linear)) ** (1 / 3)
        if not scale > 0:
            raise error
        left, _, right = np.linalg.svd(linear)
        # This orthogonal matrix is the nearest one, and keeps the determinant's sign.
        orthogonal = np.asarray(left @ right, dtype=np.float64)
        deviation = np.abs(linear - scale * orthogonal).max()
        if not deviation < _TOLERANCE * scale:  # It may be NaN.
            raise error
        translation = np.asarray(transform[:, 3], dtype=np.float64)
        return Similarity(scale, orthogonal, translation)

    def inverse(self) -> Similarity:
        """Return the map back."""
        back = self.orthogonal.T
        translation = -back @ self.translation / self.scale
        return Similarity(1 / self.scale, back, translation)

    def positions(self, means: Array) -> Array:
        """Return positions in the new frame. [N, 3] → [N, 3]"""
        turned = means @ self.orthogonal.T  # [N, 3]
        return self.scale * turned + self.translation

    def poses(self, poses: Array) -> Array:
        """Return camera-to-world poses in the new frame. [C, 3, 4] → [C, 3, 4]"""
        rotations = self.orthogonal @ poses[:, :, :3]  # [C, 3, 3]
        positions = self.positions(poses[:, :, 3])  # [C, 3]
        columns = [rotations, positions[:, :, None]]
        return np.concatenate(columns, axis=2)

    def log_scales(self, scales: Array) -> Array:
        """Return logarithms of standard deviations in the new frame. [N, 3] → [N, 3]"""
        return scales + math.log(self.scale)

    def rotations(self, quats: Array) -> Array:
        """Return rotations of Gaussians, wxyz, in the new frame, of unit length; a zero stays as it is. [N, 4]

        A reflection is no rotation, but a Gaussian is its own point reflection.
        """
        from scipy.spatial.transform import Rotation  # It takes half a second to import.

        determinant = np.linalg.det(self.orthogonal)  # 1, or −1 of a reflection
        turn = Rotation.from_matrix(np.sign(determinant) * self.orthogonal)
        lengths = np.linalg.norm(quats, axis=1)  # [N]
        is_sound = (lengths > 0) & np.isfinite(lengths)  # Scipy refuses the others.
        before = Rotation.from_quat(quats[is_sound][:, [1, 2, 3, 0]])  # Scipy's quaternions are xyzw.
        after = (turn * before).as_quat()  # [S, 4]
        turned = quats.copy()
        turned[is_sound] = after[:, [3, 0, 1, 2]]
        return turned

    def harmonics(self, degree: int) -> Array:
        """Return the matrix D with which colours' coefficients c of degree 0 … 3 become D c in the new frame.

        Turned harmonics are sums of harmonics, so that a few directions determine D. [(degree + 1)², (degree + 1)²]
        """
        generator = np.random.default_rng(0)
        directions = generator.normal(size=(64, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        before = spherical_harmonics(directions @ self.orthogonal, degree)
        after = spherical_harmonics(directions, degree)
        solution, *_ = np.linalg.lstsq(after, before, rcond=None)
        return solution


def spherical_harmonics(directions: Array, degree: int) -> Array:
    """Return real, orthonormal harmonics of unit vectors to degree ≤ 3, as in 3DGS. [..., 3] → [..., (degree + 1)²]"""
    x, y, z = np.moveaxis(np.asarray(directions, dtype=np.float64), -1, 0)

    def root(numerator: float, denominator: float) -> float:
        return math.sqrt(numerator / (denominator * math.pi))

    degree_0 = [np.full_like(x, root(1, 4))]
    degree_1 = [
        -root(3, 4) * y,
        root(3, 4) * z,
        -root(3, 4) * x,
    ]
    degree_2 = [
        root(15, 4) * x * y,
        -root(15, 4) * y * z,
        root(5, 16) * (3 * z * z - 1),
        -root(15, 4) * x * z,
        root(15, 16) * (x * x - y * y),
    ]
    degree_3 = [
        -root(35, 32) * y * (3 * x * x - y * y),
        root(105, 4) * x * y * z,
        -root(21, 32) * y * (5 * z * z - 1),
        root(7, 16) * z * (5 * z * z - 3),
        -root(21, 32) * x * (5 * z * z - 1),
        root(105, 16) * z * (x * x - y * y),
        -root(35, 32) * x * (x * x - 3 * y * y),
    ]
    basis = degree_0 + degree_1 + degree_2 + degree_3
    number = (degree + 1) ** 2
    return np.stack(basis[:number], axis=-1)


def from_data(path: Path) -> Similarity:
    """Return the map from the data's world to nerfstudio's from a run's file; raise InputError if it has none."""
    try:
        content = json.loads(path.read_bytes())
        return _similarity_of(content["transform"], content["scale"])
    except (OSError, KeyError, TypeError, ValueError) as error:
        problem = f"{path} does not tell how to return to the data's frame ({reason(error)})"
        raise InputError(f"{problem}: copy it from the run again, or export in nerfstudio's frame.") from error


def fixed_frame(meta: Mapping[str, Any], path: Path) -> Similarity | None:
    """Return the map to nerfstudio's world that `meta` fixes, or None; raise InputError if it is no similarity."""
    if not any(name in meta for name in FRAME_KEYS):
        return None
    try:
        transform, scale = (meta[name] for name in FRAME_KEYS)
        return _similarity_of(transform, scale)
    except (KeyError, TypeError, ValueError) as error:
        problem = f"{path} does not tell with {' and '.join(FRAME_KEYS)} how its data is to be moved ({reason(error)})"
        remedy = "remove both, or copy them from the dataparser_transforms.json of a run"
        raise InputError(f"{problem}: {remedy}.") from error


def _similarity_of(transform: Any, scale: Any) -> Similarity:
    """Return the map of values of JSON, a transform [3, 4] and a scale after it; raise ValueError if it is none."""
    matrix = np.array(transform, dtype=np.float64)
    factor = float(scale)
    if matrix.shape != (3, 4) or not factor > 0:
        raise ValueError("it has no transform of 3 rows and 4 columns and a scale above 0")
    return Similarity.of(factor * matrix)
