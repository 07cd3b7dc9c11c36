"""The rotations of COLMAP's poses, which the checks of data compute without scipy."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from sadgs_ns.data.colmap_views import _rotations


def test_quaternions_become_the_matrices_that_scipy_makes_of_them():
    quats = np.random.default_rng(0).normal(size=(50, 4))  # wxyz, not of unit length
    expected = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    assert_allclose(_rotations(quats), expected, atol=1e-12)
