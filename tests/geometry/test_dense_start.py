"""Points drawn from depth maps: of a plane, whose depth is exact."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from helpers.closeness import assert_within
from sadgs_ns.geometry.dense_start import SCALE, DensePoints, dense_points
from sadgs_ns.geometry.stereo import DepthMap

HEIGHT = 240
WIDTH = 320
SIZE = torch.tensor([WIDTH, HEIGHT])
K = torch.tensor([[380, 0, 150], [0, 350, 125], [0, 0, 1]]).double()
NORMAL = torch.tensor([0.2, 0.1, 1.0]).double()
"""The plane NORMAL · X = 10 lies before all cameras. Its left half is x < 0."""
COLORS = torch.tensor([[0.1, 0.5, 0.9], [0.3, 0.5, 0.8], [0.5, 0.5, 0.6], [0.7, 0.5, 0.2]])
"""Of the views' images, each of which has one colour."""


class Views:
    """Four cameras in a row that turn a little, whose depth maps are right, and confident everywhere."""

    def __init__(self) -> None:
        self.viewmats = torch.eye(4).double().repeat(4, 1, 1)
        self.maps: list[DepthMap] = []
        self.left: list[Tensor] = []  # Which pixels see the plane's left half. bool [h, w] each
        y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
        for v in range(4):
            rotation = torch.matrix_exp(0.03 * v * torch.tensor([[0, 0, 1], [0, 0, 0], [-1, 0, 0]]).double())
            centre = torch.tensor([0.7 * v - 1, 0.2 * (v % 2), 0.1 * v]).double()
            self.viewmats[v, :3, :3] = rotation
            self.viewmats[v, :3, 3] = -rotation @ centre
            rays = torch.stack([x, y, torch.ones_like(x)], dim=2).double() @ K.inverse().T @ rotation
            depth = (10 - centre @ NORMAL) / (rays @ NORMAL)
            self.maps.append(DepthMap(depth.float(), torch.ones_like(x), K.float()))
            self.left.append(centre[0] + depth * rays[..., 0] < 0)

    def draw(self, wavelengths: list[Tensor] | None = None, number: int = 2000, seed: int = 0) -> DensePoints:
        wavelengths = wavelengths or [torch.full((HEIGHT, WIDTH), 3.0)] * 4
        image = [color.expand(6, 8, 3) for color in COLORS].__getitem__
        return dense_points(self.maps, self.viewmats.float(), image, wavelengths.__getitem__, number, seed)

    def look_at(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Pixels of points in each view [V, Q, 2], their depths, and whether they lie in its picture. Each [V, Q]"""
        local = points.double() @ self.viewmats[:, :3, :3].mT + self.viewmats[:, None, :3, 3]
        pixels = (local @ K.T)[..., :2] / local[..., 2:]
        depths = local[..., 2]
        return pixels, depths, ((pixels >= 0) & (pixels < SIZE)).all(dim=2) & (depths > 0)

    def check_colors(self, drawn: DensePoints, agreeing: Tensor) -> None:
        """Colours are the means over views [V, Q]; points at the border of a picture may be counted otherwise."""
        pixels = self.look_at(drawn.means)[0]
        sure = torch.minimum(pixels.abs(), (pixels - SIZE).abs()).amin(dim=(0, 2)) > 0.01
        assert sure.double().mean() > 0.9
        assert agreeing.sum(dim=0)[sure].min() >= 2
        expected = agreeing.float().T @ COLORS / agreeing.sum(dim=0)[:, None]
        actual = drawn.colors[sure]
        assert_within(actual, expected[sure], 1e-5)


def test_points_lie_on_the_surface_with_the_mean_colour_of_the_views_that_see_them():
    views = Views()
    views.viewmats[3, ::2] *= -1  # The last camera looks the other way, with a map of what nobody else sees.
    drawn = views.draw()
    actual = [tuple(values.shape) for values in drawn]
    expected = [(2000, 3), (2000, 3), (2000,)]
    assert actual == expected
    assert (drawn.means.double() @ NORMAL - 10).abs().max() < 1e-4
    seen = views.look_at(drawn.means)[2]
    assert set(seen.sum(dim=0).tolist()) == {2, 3}
    assert not seen[3].any()
    views.check_colors(drawn, seen)


def test_scales_are_half_a_wavelength_and_at_least_half_a_pixel_of_the_depth_map():
    views = Views()
    wavelengths = torch.tensor([[1.0], [2.0], [3.0], [4.0]])  # px of the depth map
    of_images = [1.0, 4.0, 6.0, 8.0]  # The images are twice as large, and the first wavelength is less than a pixel.
    means, _, scales = views.draw([torch.full((2 * HEIGHT, 2 * WIDTH), length) for length in of_images])
    pixels, depths, _ = views.look_at(means)
    own = ((pixels.frac() - 0.5).abs() < 1e-3).all(dim=2)  # A point lies at the centre of its own view's pixel.
    fits = own & ((scales / (SCALE * wavelengths * depths / K[0, 0]) - 1).abs() < 1e-4)
    assert fits.any(dim=0).all()
    assert fits.any(dim=1).all()


@pytest.mark.parametrize(("length", "ratio"), [(2.0, 4.0), (4.0, 1.0)])
def test_points_are_as_dense_as_the_wavelength_asks_for_however_many_views_see_them(length: float, ratio: float):
    views = Views()
    for v in (0, 3):
        views.maps[v].confidence[views.left[v]] = 0.0
    means = views.draw([torch.where(left, length, 4.0) for left in views.left]).means
    x, y = views.look_at(means)[0][1].unbind(1)  # In the second view, whose inner part all views see.
    points = means[(x > 60) & (x < WIDTH - 60) & (y > 20) & (y < HEIGHT - 20), 0] < 0
    area = views.left[1][20:-20, 60:-60].double().mean()
    share = float(ratio * area / (ratio * area + 1 - area))
    assert len(points) > 500
    assert abs(float(points.double().mean()) - share) < 4 * math.sqrt(share * (1 - share) / len(points))


@pytest.mark.parametrize(
    ("ratio", "sure", "say"), [(0.97, 1, 0), (0.99, 1, 2), (1.03, 1, 0), (1, 0.09, 0), (1, 0.2, 1)]
)
def test_a_view_has_a_say_if_its_depth_fits_and_points_if_it_is_sure_too(ratio: float, sure: float, say: int):
    views = Views()
    views.maps[2].depth.mul_(ratio)
    views.maps[2].confidence.fill_(sure)
    drawn = views.draw()
    pixels, _, seen = views.look_at(drawn.means)
    seen[2] &= say > 0
    views.check_colors(drawn, seen)
    actual = bool(((pixels[2].frac() - 0.5).abs() < 1e-3).all(dim=1).any())
    assert actual == (say > 1), "its own points"


def test_nothing_is_drawn_without_confident_depth_of_two_views_or_from_pixels_without_a_wavelength():
    views = Views()
    half = views.draw([torch.where(left, torch.nan, 3.0) for left in views.left]).means
    assert len(half) == 2000
    assert half[:, 0].min() > -1e-4
    masked = views.draw([torch.full((HEIGHT, WIDTH), torch.nan)] * 4)
    for v in (1, 2, 3):
        views.maps[v].confidence.zero_()
    alone = views.draw()
    views.maps[0].confidence.zero_()
    for empty in (masked, alone, views.draw()):
        actual = [tuple(values.shape) for values in empty]
        expected = [(0, 3), (0, 3), (0,)]
        assert actual == expected


def test_points_depend_on_no_generator_but_their_own_and_are_no_more_than_asked_for():
    views = Views()
    before = torch.random.get_rng_state()
    first = views.draw(seed=1)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert len(first.means.unique(dim=0)) == 2000
    torch.manual_seed(5)
    for a, b in zip(first, views.draw(seed=1), strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(first.means, views.draw(seed=2).means)
    assert 0 < len(views.draw(number=7).means) <= 7
    assert 2000 < len(views.draw(number=10**6).means) < 4 * HEIGHT * WIDTH
