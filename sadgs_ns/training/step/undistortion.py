"""Undistortion of images that are loaded for training, without losing their finest detail.

nerfstudio chooses the cameras of the undistorted images, and undistorts masks. Its images are interpolated bilinearly,
which keeps 55 to 70 % of the energy of waves of 3 and 4 px. Those here are bicubic, which keeps 91 to 102 %. Lanczos'
interpolation keeps 96 to 99 %, and takes four times as long as bicubic, for images that may be decoded at each step.
"""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import cv2
import numpy as np
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image
from numpy.typing import NDArray
from torch import Tensor

_OURS = (CameraType.PERSPECTIVE.value, CameraType.FISHEYE.value)  # Other cameras' images are nerfstudio's.


class Warp(NamedTuple):
    """Where each pixel of an undistorted image lies in the distorted one, counted from the centres of pixels."""

    x: NDArray[np.float32]  # px [H, W]
    y: NDArray[np.float32]  # px [H, W]
    outside: NDArray[np.bool_] | None  # Pixels that lie outside the distorted image, None if none does [H, W]


class Undistortion:
    """Undistorts the images of a camera.

    Attributes:
        K: The intrinsics of the undistorted images in px. float32 [3, 3]
        width, height: Their size in px.
    """

    def __init__(self, camera: Cameras) -> None:
        """Take over a camera without batch dimension, as it is now."""
        assert camera.distortion_params is not None
        self._camera = copy.deepcopy(camera)
        self._distortion: NDArray[np.float32] = camera.distortion_params.numpy()
        self._size = (int(camera.width), int(camera.height))
        width, height = self._size
        # The intrinsics do not depend on the pixels.
        self.K, undistorted, _ = self._by_nerfstudio({}, np.zeros((height, width), np.uint8))
        self.height, self.width = undistorted.shape

    def _by_nerfstudio(
        self, data: dict[str, Any], image: NDArray[Any]
    ) -> tuple[NDArray[np.float32], NDArray[Any], Tensor | None]:
        """Return intrinsics, image and perhaps mask as nerfstudio undistorts them. image [H, W(, C)]"""
        K = self._camera.get_intrinsics_matrices().numpy()
        return _undistort_image(self._camera, self._distortion, data, image, K.copy())

    def warp(self) -> Warp | None:
        """Return where the pixels of undistorted images lie; None for cameras that are left to nerfstudio."""
        kind = self._camera.camera_type.item()
        if kind not in _OURS:
            return None
        K = _from_pixel_centres(self._camera.get_intrinsics_matrices().numpy())
        new_K = _from_pixel_centres(self.K)
        size = (self.width, self.height)
        if kind == CameraType.FISHEYE.value:
            distortion = self._distortion[:4]
            x, y = cv2.fisheye.initUndistortRectifyMap(K, distortion, np.eye(3), new_K, size, cv2.CV_32FC1)
        else:
            k1, k2, k3, _, p1, p2 = self._distortion
            distortion = np.array([k1, k2, p1, p2, k3])  # OpenCV's order
            x, y = cv2.initUndistortRectifyMap(K, distortion, np.eye(3), new_K, size, cv2.CV_32FC1)
        width, height = self._size
        x = np.asarray(x, np.float32)
        y = np.asarray(y, np.float32)
        outside = (x < -0.5) | (x > width - 0.5) | (y < -0.5) | (y > height - 0.5)
        if outside.any():
            return Warp(x, y, outside)
        return Warp(x, y, None)

    def __call__(
        self, data: dict[str, Any], image: NDArray[np.uint8], warp: Warp | None
    ) -> tuple[NDArray[np.uint8], Tensor | None]:
        """Undistort an image, and the mask in its data if there is one.

        Args:
            data: nerfstudio's data of the image. Its depths are cropped to the undistorted image.
            image: uint8 [H, W(, C)]
            warp: That of `warp`.

        Returns:
            The image, uint8 [H', W'(, C)], and perhaps the mask, bool [H', W', 1].
        """
        if warp is None:
            _, undistorted, mask = self._by_nerfstudio(data, image)
            return undistorted, mask
        mask = None
        if "mask" in data or "depth_image" in data:
            _, _, mask = self._by_nerfstudio(data, np.zeros(image.shape[:2], np.uint8))
        return apply_warp(image, warp), mask


def apply_warp(image: NDArray[np.uint8], warp: Warp) -> NDArray[np.uint8]:
    """Warp an image bicubically, and its opacity bilinearly; what lies outside is black. [H, W(, C)]"""
    warped = cv2.remap(image, warp.x, warp.y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
    if image.ndim == 3 and image.shape[2] == 4:
        opacity = np.ascontiguousarray(image[..., 3])
        warped[..., 3] = cv2.remap(opacity, warp.x, warp.y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    if warp.outside is not None:
        warped[warp.outside] = 0
    return np.asarray(warped, np.uint8)


def _from_pixel_centres(K: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return intrinsics as OpenCV counts pixels, from the centre of the first, instead of its corner. [3, 3]"""
    shifted = K.astype(np.float64)
    shifted[:2, 2] -= 0.5
    return shifted
