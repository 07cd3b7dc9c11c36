"""Verification of matches by COLMAP's own estimation, in threads, so that it can begin while other pairs are matched.

COLMAP's command for all pairs of a database can begin only when all are matched. It gives the same geometries.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache

import numpy as np
import pycolmap

_KEPT_PHOTOS = 2000  # Photos whose keypoints stay in memory, at 64 kB each


class Verifier:
    """Verifies matches between images of an open database in the threads of a pool.

    Args:
        opened: COLMAP's database; only the thread that calls `submit` reads it.
        options: With a seed, by which equal matches have equal geometries, whatever the order.
        pool: The threads. The estimation releases Python's lock.
    """

    def __init__(
        self, opened: pycolmap.Database, options: pycolmap.TwoViewGeometryOptions, pool: ThreadPoolExecutor
    ) -> None:
        self._options = options
        self._pool = pool
        self._cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        self._camera_ids = {image.image_id: image.camera_id for image in opened.read_all_images()}

        @lru_cache(_KEPT_PHOTOS)
        def points(image_id: int) -> np.ndarray:
            return np.ascontiguousarray(opened.read_keypoints(image_id)[:, :2])

        self._points = points  # float32 [N, 2], px

    def submit(self, first: int, second: int, matches: np.ndarray) -> Future[pycolmap.TwoViewGeometry]:
        """Begin to verify the matches of two images, the one with the lower number first.

        COLMAP's samples depend on which is the first. Indices of keypoints in both, uint32 [K, 2]
        """
        images = (first, second)
        cameras = [self._cameras[self._camera_ids[image_id]] for image_id in images]
        points = [self._points(image_id) for image_id in images]
        return self._pool.submit(_verify, cameras, points, matches, self._options)


def _verify(
    cameras: Sequence[pycolmap.Camera],
    points: Sequence[np.ndarray],
    matches: np.ndarray,
    options: pycolmap.TwoViewGeometryOptions,
) -> pycolmap.TwoViewGeometry:
    """Return the geometry of two images, which is empty if too few matches fit one."""
    geometry = pycolmap.estimate_two_view_geometry(
        cameras[0], points[0].astype(float), cameras[1], points[1].astype(float), matches, options
    )
    if len(geometry.inlier_matches) < options.min_num_inliers:
        return pycolmap.TwoViewGeometry(config=pycolmap.TwoViewGeometryConfiguration.DEGENERATE)
    return geometry
