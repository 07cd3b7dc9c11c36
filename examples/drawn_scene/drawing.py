"""Surfaces whose textures have a known wavelength, pinhole views, and images of these by tracing rays.

The wavelength of each texture is known in world units, so geometry alone gives the wavelength at each pixel of a view
(`expected_wavelength_map`). The world is z-up, cameras follow OpenCV (x right, y down, z forward), pixel centres lie at
half-integers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rectangle:
    """A textured rectangle, two-sided."""

    name: str
    """Unique in the scene."""
    corner: Array
    """World position of one corner. [3]"""
    edge_u: Array
    edge_v: Array
    """From the corner along its two sides, which are orthogonal. [3] each"""
    dark: tuple[float, float, float]
    bright: tuple[float, float, float]
    """Colours of the texture's troughs and crests, in [0, 1]."""
    texture: Literal["grating", "checker", "plain"] = "plain"
    """A sine along one direction, hard-edged squares, or the mean colour."""
    wavelength: float = float("nan")
    """Period of the sine, or of the checker's fundamental (√2 times a square's side), in world units."""
    angle: float = 0.0
    """Of the grating's direction, or a row of squares, from `edge_u` towards `edge_v`, in rad."""

    @property
    def normal(self) -> Array:
        """Unit normal. [3]"""
        normal = np.cross(self.edge_u, self.edge_v)
        return normal / np.linalg.norm(normal)

    @property
    def area(self) -> float:
        """World units²."""
        return float(np.linalg.norm(self.edge_u) * np.linalg.norm(self.edge_v))

    @property
    def _directions(self) -> tuple[Array, Array]:
        """The texture's own orthonormal axes in the plane. [3] each"""
        u = self.edge_u / np.linalg.norm(self.edge_u)
        v = self.edge_v / np.linalg.norm(self.edge_v)
        cosine = np.cos(self.angle)
        sine = np.sin(self.angle)
        along = cosine * u + sine * v
        across = cosine * v - sine * u
        return along, across

    @property
    def frequencies(self) -> Array:
        """The texture's fundamental waves as vectors in the plane, cycles per world unit. [F, 3], F = 0 if plain."""
        a, b = self._directions
        if self.texture == "grating":
            return a[None] / self.wavelength
        if self.texture == "checker":
            return np.stack([a + b, a - b]) / (np.sqrt(2.0) * self.wavelength)
        return np.zeros((0, 3))

    def depth(self, origin: Array, directions: Array) -> Array:
        """Ray parameter of the hit, inf where there is none. origin [3], directions [R, 3] → [R]"""
        with np.errstate(divide="ignore", invalid="ignore"):
            t = self.normal @ (self.corner - origin) / (directions @ self.normal)  # [R]
            local = origin + t[:, None] * directions - self.corner  # [R, 3]
            u = local @ self.edge_u / (self.edge_u @ self.edge_u)
            v = local @ self.edge_v / (self.edge_v @ self.edge_v)
            in_u = (u >= 0) & (u <= 1)
            in_v = (v >= 0) & (v <= 1)
            hit = (t > 0) & in_u & in_v
        return np.where(hit, t, np.inf)

    def colour(self, points: Array) -> Array:
        """Colour in [0, 1] at points on the surface. [P, 3] → [P, 3]"""
        along, across = self._directions
        local = points - self.corner
        a = local @ along  # [P]
        b = local @ across  # [P]
        wave = np.zeros(len(points))
        if self.texture == "grating":
            wave = np.sin(2 * np.pi * a / self.wavelength)
        elif self.texture == "checker":
            side = self.wavelength / np.sqrt(2.0)
            square = np.floor(a / side) + np.floor(b / side)
            wave = np.where(square % 2 == 0, 1.0, -1.0)
        dark = np.array(self.dark)
        bright = np.array(self.bright)
        contrast = bright - dark
        share = 0.5 + 0.5 * wave
        return dark + contrast * share[:, None]

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Uniform points on the surface. [count, 3]"""
        u, v = rng.random((2, count, 1))
        return self.corner + u * self.edge_u + v * self.edge_v


@dataclass(frozen=True)
class Sphere:
    """An untextured sphere with fixed, view-independent shading from above."""

    name: str
    """Unique in the scene."""
    centre: Array
    """World position. [3]"""
    radius: float
    """World units."""
    albedo: tuple[float, float, float]
    """Colour where light falls from above, in [0, 1]."""

    @property
    def area(self) -> float:
        """World units²."""
        return 4 * np.pi * self.radius**2

    def depth(self, origin: Array, directions: Array) -> Array:
        """Ray parameter of the nearest hit, inf where there is none. origin [3], directions [R, 3] → [R]"""
        offset = origin - self.centre
        a = (directions**2).sum(1)  # [R]
        b = directions @ offset  # [R]
        discriminant = b**2 - a * (offset @ offset - self.radius**2)
        t = (-b - np.sqrt(np.maximum(discriminant, 0))) / a
        return np.where((discriminant > 0) & (t > 0), t, np.inf)

    def colour(self, points: Array) -> Array:
        """Colour in [0, 1] at points on the surface. [P, 3] → [P, 3]"""
        upward = (points - self.centre)[:, 2:] / self.radius  # [P, 1]
        return np.array(self.albedo) * (0.7 + 0.3 * upward)

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Uniform points on the surface. [count, 3]"""
        directions = rng.normal(size=(count, 3))
        return self.centre + self.radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


Surface = Rectangle | Sphere


@dataclass(frozen=True)
class View:
    """One posed pinhole image."""

    name: str
    """File name in the folder `images`."""
    rotation: Array
    translation: Array
    """From world to camera. [3, 3] and [3]"""
    focal: float
    """px, the same for x and y."""
    width: int
    height: int

    @property
    def position(self) -> Array:
        """Camera centre in the world. [3]"""
        return -self.rotation.T @ self.translation

    def rays(self, supersampling: int = 1) -> Array:
        """Ray directions of s² samples a pixel, row by row, whose ray parameter is the depth. [H·s·W·s, 3]"""
        columns = np.arange(self.width * supersampling) + 0.5
        rows = np.arange(self.height * supersampling) + 0.5
        x = columns / supersampling - 0.5 * self.width
        y = rows / supersampling - 0.5 * self.height
        x, y = np.meshgrid(x / self.focal, y / self.focal)
        in_camera = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], -1)
        return in_camera @ self.rotation

    def project(self, points: Array) -> tuple[Array, Array]:
        """World points → pixel positions [P, 2] and depths [P]."""
        camera = points @ self.rotation.T + self.translation  # [P, 3]
        middle = 0.5 * np.array([self.width, self.height])
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = self.focal * camera[:, :2] / camera[:, 2:] + middle
        return pixels, camera[:, 2]


def trace(surfaces: Sequence[Surface], origin: Array, directions: Array) -> tuple[NDArray[np.intp], Array]:
    """Index of the first surface that each ray meets, −1 for none [R], and the ray parameter, inf for none [R].

    The rays have one origin [3] and directions [R, 3].
    """
    nearest = np.full(len(directions), np.inf)
    index = np.full(len(directions), -1)
    for i, surface in enumerate(surfaces):
        depth = surface.depth(origin, directions)
        index = np.where(depth < nearest, i, index)
        nearest = np.minimum(depth, nearest)
    return index, nearest


def render(surfaces: Sequence[Surface], view: View, supersampling: int = 4) -> NDArray[np.uint8]:
    """Antialiased image of one view, black where nothing is. [H, W, 3]"""
    directions = view.rays(supersampling)
    index, depth = trace(surfaces, view.position, directions)
    samples = np.zeros((len(directions), 3))
    for i, surface in enumerate(surfaces):
        on = index == i
        hits = view.position + depth[on, None] * directions[on]
        samples[on] = surface.colour(hits)
    samples = samples.reshape(view.height, supersampling, view.width, supersampling, 3)
    return np.rint(255 * samples.mean(axis=(1, 3))).astype(np.uint8)


def expected_wavelength_map(surfaces: Sequence[Surface], view: View) -> NDArray[np.float32]:
    """The wavelength that the view shows at each pixel, from geometry alone.

    A texture's phase is φ(X) = f·X with X = o + t(p) d(p) on the surface, and t = nᵀ(q − o) / nᵀd. Its gradient over
    the pixel, t (fᵀd' − fᵀd · nᵀd' / nᵀd), is the frequency in cycles per px: world wavelength times focal length over
    depth, foreshortened along the grating. Of a checker's two waves the shorter counts. It is in px, NaN where there is
    no texture. [H, W]
    """
    directions = view.rays()
    index, depth = trace(surfaces, view.position, directions)
    per_pixel = view.rotation[:2] / view.focal  # derivative of the direction over x and over y. [2, 3]
    frequency = np.zeros(len(directions))
    for i, surface in enumerate(surfaces):
        if not isinstance(surface, Rectangle):
            continue
        on = index == i
        slant = (per_pixel @ surface.normal) / (directions[on] @ surface.normal)[:, None]  # [R, 2]
        for wave in surface.frequencies:  # [3]
            along_rays = (directions[on] @ wave)[:, None]  # [R, 1]
            gradient = depth[on, None] * (per_pixel @ wave - along_rays * slant)  # [R, 2]
            steepness = np.hypot(gradient[:, 0], gradient[:, 1])  # [R]
            frequency[on] = np.maximum(frequency[on], steepness)
    with np.errstate(divide="ignore"):
        wavelength = np.where(frequency > 0, 1.0 / frequency, np.nan)
    return wavelength.reshape(view.height, view.width).astype(np.float32)


def visible(surfaces: Sequence[Surface], view: View, points: Array) -> NDArray[np.bool_]:
    """Which points [P, 3] on the surfaces the view sees. [P]"""
    pixels, depth = view.project(points)
    size = [view.width, view.height]
    after_start = (pixels >= 0).all(1)
    before_end = (pixels < size).all(1)
    inside = (depth > 0) & after_start & before_end
    _, nearest = trace(surfaces, view.position, points - view.position)
    reached = nearest > 1 - 1e-4  # the ray's parameter is 1 at the point itself
    return inside & reached
