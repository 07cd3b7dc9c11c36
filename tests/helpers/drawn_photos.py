"""Photos of the corner of a drawn room and panoramas of a hall, whose poses are known, for tests that find cameras."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import cv2
import numpy as np
from PIL import Image, ImageCms

VIEWS = 10
WIDTH = 160
HEIGHT = 120
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


def walk_centres() -> np.ndarray:
    """Where photos are taken on a walk into the corner of the room, swaying a little. [VIEWS, 3]"""
    ahead = np.linspace(3.0, 2.2, VIEWS)[:, None]
    sway = 0.02 * np.sin(2 * np.arange(VIEWS))[:, None]
    return 0.8 + ahead * np.array([0.69, 0.66, 0.3]) + sway * np.array([-0.7, 0.7, 0.2])


def draw_photos(centres: np.ndarray | None = None, focal_length: float = WIDTH) -> Iterator[Image.Image]:
    """Photos of a corner of a room whose walls carry noise, which has many features and takes milliseconds to draw.

    They are taken from `camera_centres`, or from others [N, 3], with a focal length in px.
    """
    random = np.random.default_rng(0)
    side = 256
    noise = [cv2.GaussianBlur(random.integers(0, 256, (side, side, 3), np.uint8), (0, 0), 2) for _ in WALLS]
    textures = [np.clip((texture - 127.0) * 5 + 127, 0, 255).astype(np.uint8) for texture in noise]
    corners = np.array([(0, 0), (side, 0), (side, side), (0, side)], np.float32)
    intrinsics = np.array([[focal_length, 0, WIDTH / 2], [0, focal_length, HEIGHT / 2], [0, 0, 1]])
    for centre in camera_centres() if centres is None else centres:
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


HALL = np.array([6.0, 4.0, 3.0])
"""Width, depth and height of a hall that is closed all around."""


def panorama_centres(count: int) -> np.ndarray:
    """Where the panoramas of the hall are taken, on an arc at the height of a head. [count, 3]"""
    angles = np.linspace(0, 4, count)
    return np.stack([3 + 1.4 * np.cos(angles), 2 + np.sin(angles), 1.5 + 0.1 * np.sin(3 * angles)], 1)


@functools.cache
def hall_textures() -> list[np.ndarray]:
    """Noise of a texel of 1 cm for the two walls across each axis: dark and bright spots of 10 cm, and finer ones."""
    random = np.random.default_rng(1)
    textures = []
    for axis in (0, 0, 1, 1, 2, 2):
        across, up = np.delete(HALL, axis) * 100
        texture = np.full((int(up), int(across), 3), 127.0)
        for sigma, strength in ((24, 40), (6, 9)):
            noise = random.normal(0, 60, texture.shape)
            texture += strength / 2 * cv2.GaussianBlur(noise, (0, 0), sigma)
        textures.append(np.clip(texture, 0, 255).astype(np.uint8))
    return textures


def draw_hall(centre: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Colours of the hall that are seen from a centre along rays in its axes (z up). [H, W, 3] → uint8 [H, W, 3]"""
    with np.errstate(divide="ignore"):
        distance = np.where(rays > 0, HALL - centre, -centre) / rays
    axis = distance.argmin(-1)
    hits = centre + rays * distance.min(-1, keepdims=True)
    colours = np.zeros(rays.shape, np.uint8)
    for wall, texture in enumerate(hall_textures()):
        seen = (axis == wall // 2) & (np.take_along_axis(rays, axis[..., None], -1)[..., 0] * (wall % 2 - 0.5) > 0)
        across, up = (100 * np.delete(hits, wall // 2, -1) - 0.5).astype(np.float32).transpose(2, 0, 1)
        colours[seen] = cv2.remap(texture, across, up, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[seen]
    return colours


def draw_panorama(centre: np.ndarray, height: int, yaw: float = 0.0) -> np.ndarray:
    """A panorama of the hall, whose middle looks along y turned by an angle in rad. uint8 [height, 2 · height, 3]"""
    longitude = (np.arange(2 * height) + 0.5) / height * np.pi - np.pi + yaw
    latitude = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    longitude, latitude = np.meshgrid(longitude, latitude)
    level = np.cos(latitude)
    rays = np.stack([level * np.sin(longitude), level * np.cos(longitude), np.sin(latitude)], -1)
    return draw_hall(centre, rays)


def draw_photo(centre: np.ndarray, rotation: np.ndarray, side: int, yaw: float = 0.0) -> np.ndarray:
    """A photo of 90° of the hall, turned by a rotation to the axes of the panorama there. uint8 [side, side, 3]"""
    across = (np.arange(side) + 0.5) / side * 2 - 1
    rays = np.stack([*np.meshgrid(across, across), np.ones((side, side))], -1)
    x, down, ahead = np.moveaxis(rays @ rotation.T, -1, 0)
    cosine = np.cos(yaw)
    sine = np.sin(yaw)
    return draw_hall(centre, np.stack([cosine * x + sine * ahead, cosine * ahead - sine * x, -down], -1))


def color_profile(swapped: bool) -> bytes:
    """The colour profile of sRGB, or one whose red is sRGB's green, and the other way round."""
    content = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for old, new in [("rXYZ", "----"), ("gXYZ", "rXYZ"), ("----", "gXYZ")] if swapped else ():
        content = content.replace(old.encode(), new.encode())
    return content.replace("sRGB".encode("utf-16-be"), "mine".encode("utf-16-be")) if swapped else content
