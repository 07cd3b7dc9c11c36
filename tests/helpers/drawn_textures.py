"""Photos of drawn textures, as a lens and a sensor show them, and how much of their detail an image keeps."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

SAMPLES = 4
"""Samples along a pixel's side, whose mean is its colour, as a sensor measures it."""


def texture(rays: NDArray[np.float64], period: float) -> NDArray[np.float64]:
    """Waves in many directions over the plane of rays [..., 2], down to a period in the rays' units. [..., 3]"""
    generator = np.random.default_rng(0)
    value = np.zeros((*rays.shape[:-1], 3))
    for _ in range(24):
        angle, phase = generator.uniform(0, 2 * np.pi, 2)
        frequency = 2 * np.pi / (period * generator.uniform(1.0, 4.0))
        wave = np.sin(frequency * (rays @ [np.cos(angle), np.sin(angle)]) + phase)
        value += wave[..., None] * generator.uniform(-1, 1, 3)
    return 127.5 + 30 * value


def photograph(camera: pycolmap.Camera, period: float) -> NDArray[np.uint8]:
    """Draw the texture as a camera sees it. [H, W, 3]"""
    x = (np.arange(camera.width * SAMPLES) + 0.5) / SAMPLES
    y = (np.arange(camera.height * SAMPLES) + 0.5) / SAMPLES
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = np.asarray(camera.cam_from_img(pixels))[:, :2]
    values = texture(rays, period).reshape(camera.height, SAMPLES, camera.width, SAMPLES, 3)
    return np.rint(values.mean(axis=(1, 3)).clip(0, 255)).astype(np.uint8)


def energy(image: NDArray[np.uint8]) -> float:
    """Return the energy of the finest detail."""
    inside = image[8:-8, 8:-8].astype(np.float32)
    return float(np.square(cv2.Laplacian(inside, cv2.CV_32F)).mean())


def psnr(image: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
    difference = image[8:-8, 8:-8].astype(np.float64) - truth[8:-8, 8:-8]
    return float(10 * np.log10(255**2 / np.square(difference).mean()))
