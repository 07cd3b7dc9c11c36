"""Photos of the corner of a drawn room, whose poses are known, for tests that find cameras."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from PIL import Image

VIEWS, WIDTH, HEIGHT = 10, 160, 120
WALLS = np.array(  # corners of the floor and two walls of a room, in the order of their textures' corners [3, 4, 3]
    [
        [(0, 0, 0), (3, 0, 0), (3, 3, 0), (0, 3, 0)],
        [(0, 0, 3), (3, 0, 3), (3, 0, 0), (0, 0, 0)],
        [(0, 3, 3), (0, 0, 3), (0, 0, 0), (0, 3, 0)],
    ],
    float,
)


def camera_centres() -> np.ndarray:
    """Where the photos of the room are taken. [VIEWS, 3]"""
    angles = np.linspace(0.35, 1.2, VIEWS)
    return np.stack([4.5 * np.cos(angles), 4.5 * np.sin(angles), 2 + 0.6 * np.sin(5 * angles)], 1)


def draw_photos() -> Iterator[Image.Image]:
    """Photos of a corner of a room whose walls carry noise, which has many features and takes milliseconds to draw."""
    random, side = np.random.default_rng(0), 256
    noise = [cv2.GaussianBlur(random.integers(0, 256, (side, side, 3), np.uint8), (0, 0), 2) for _ in WALLS]
    textures = [np.clip((texture - 127.0) * 5 + 127, 0, 255).astype(np.uint8) for texture in noise]
    corners = np.array([(0, 0), (side, 0), (side, side), (0, side)], np.float32)
    intrinsics = np.array([[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1]])
    for centre in camera_centres():
        forward = 0.8 - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        photo = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        for wall, texture in zip(WALLS, textures, strict=True):
            projected = (wall - centre) @ rotation.T @ intrinsics.T
            homography = cv2.getPerspectiveTransform(corners, (projected[:, :2] / projected[:, 2:]).astype(np.float32))
            cv2.warpPerspective(texture, homography, (WIDTH, HEIGHT), photo, borderMode=cv2.BORDER_TRANSPARENT)
        yield Image.fromarray(photo)
