"""Pictures as pure functions: what is drawn follows from tensors that are known."""

from __future__ import annotations

import base64
import io
import math
import re
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from helpers.closeness import assert_within_share
from helpers.generators import seeded
from helpers.small_scenes import camera, random_params
from sadgs_ns.method.structure_tensor import FREQUENCY_CONSTANT, multiscale_structure_tensor
from sadgs_ns.render.blending import blend
from sadgs_ns.render.types import Cameras
from sadgs_ns.viewer import color_scales, maps
from sadgs_ns.viewer.color_scales import CHILDREN, ETA, LOW, PERIOD, Panel

WIDTH = 128
HEIGHT = 96


def grating(period: float, angle: float = 0.0) -> torch.Tensor:
    """A grey sine along `angle`. [H, W, 3]"""
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    wave = 0.5 + 0.4 * torch.sin(2 * torch.pi / period * (x * math.cos(angle) + y * math.sin(angle)))
    return wave[..., None].repeat(1, 1, 3)


def structure_tensor(image: torch.Tensor, constant: float = FREQUENCY_CONSTANT) -> torch.Tensor:
    return multiscale_structure_tensor(image[None], frequency_constant=constant)[0]


def wall(depth: float = 4.0) -> dict[str, torch.Tensor]:
    """Two opaque flat Gaussians, left and right of the axis of `scenes.camera`."""
    return {
        "means": torch.tensor([[-1.0, 0, depth], [1.0, 0, depth]]),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        "scales": torch.tensor([[0.4, 0.4, 0.01]]).log().repeat(2, 1),
        "opacities": torch.full((2, 1), 6.0),
    }


def view(width: int = 64, height: int = 48) -> Cameras:
    return Cameras(*camera(width, height), width, height)


@pytest.mark.parametrize("constant", [0.2, 0.4])
@pytest.mark.parametrize(("period", "read_off"), [(8.0, 1.13), (12.0, 1.27), (24.0, 1.11)])
def test_the_wavelength_map_of_a_grating_has_the_color_of_its_period(period: float, read_off: float, constant: float):
    """Up to what S̄ itself reads off a grating: docs/results.md#gratings."""
    found = maps.texture_period(structure_tensor(grating(period), constant), constant)[32:64, 32:96]
    assert float(found.median()) == pytest.approx(read_off * period, rel=0.05)
    position = math.log(read_off * period / 3) / math.log(60 / 3)
    expected = np.asarray(matplotlib.colormaps["viridis"](position)[:3]) * 255
    assert np.abs(PERIOD(found).reshape(-1, 3).mean(axis=0) - expected).max() < 8


def test_without_texture_there_is_no_wavelength_and_no_ellipse():
    flat = torch.full((HEIGHT, WIDTH, 3), 0.5)
    period = maps.texture_period(structure_tensor(flat))
    assert period.isnan().all()
    assert (PERIOD(period) == PERIOD(period)[0, 0]).all()
    assert PERIOD(period)[0, 0].tolist() == [0, 0, 0]
    assert len(maps.structure_ellipses(structure_tensor(flat)).centers) == 0
    drawn = maps.draw_ellipses(color_scales.to_picture(flat), structure_tensor(flat), 0.75, (HEIGHT, WIDTH))
    assert len(np.unique(drawn)) == 1


def test_masked_pixels_are_drawn_as_those_without_texture():
    """The left half is masked: it is black in the map of periods and has no ellipses; the right half has both."""
    image = grating(8.0)
    mask = torch.ones((1, HEIGHT, WIDTH), dtype=torch.bool)
    mask[:, :, : WIDTH // 2] = False
    tensor = multiscale_structure_tensor(image[None], mask)[0]
    shown = PERIOD(maps.texture_period(tensor))
    assert not shown[:, : WIDTH // 2].any()
    assert shown[:, WIDTH // 2 :].any(axis=-1).all()
    ellipses = maps.structure_ellipses(tensor)
    assert len(ellipses.centers) > 0
    assert ellipses.centers[:, 0].min() > WIDTH / 2
    assert len(maps.structure_ellipses(torch.full_like(tensor, torch.nan)).centers) == 0
    maps.draw_ellipses(color_scales.to_picture(image), tensor, 0.75, (HEIGHT, WIDTH))


@pytest.mark.parametrize("degrees", [0, 30, 90, 135])
def test_ellipses_are_short_across_the_stripes_and_long_along_them(degrees: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(maps, "ELLIPSES_ACROSS", HEIGHT / 16)
    ellipses = maps.structure_ellipses(structure_tensor(grating(8.0, math.radians(degrees))))
    assert len(ellipses.centers) == (HEIGHT // 16) * (WIDTH // 16)
    off = torch.remainder(ellipses.angles - math.radians(degrees) + math.pi / 2, math.pi) - math.pi / 2
    assert off.abs().max() < math.radians(5)
    inside = (ellipses.centers[:, 0] - WIDTH / 2).abs() < 40
    assert (ellipses.axes[inside, 1] > 2 * ellipses.axes[inside, 0]).all()
    assert (ellipses.axes <= ellipses.longest).all()


def test_ellipses_are_drawn_where_and_as_they_lie(monkeypatch: pytest.MonkeyPatch):
    """Of vertical stripes each ellipse is a tall one: coloured pixels reach further up and down than to the sides."""
    tensor = torch.zeros(40, 40, 3)
    tensor[20, 20] = torch.tensor([0.4**2, 0.0, 0.4**2 / 25])  # axes of 2.5 and 12.5 px
    with monkeypatch.context() as patched:
        patched.setattr(maps, "ELLIPSES_ACROSS", 1)
        ellipses = maps.structure_ellipses(tensor, 0.4)
    assert ellipses.centers.tolist() == [[20.0, 20.0]]
    expected = torch.tensor([[2.5, 12.5]], dtype=torch.float64)
    assert_within_share(ellipses.axes, expected, 1e-3)
    tensor[:] = tensor[20, 20]
    drawn = maps.draw_ellipses(np.zeros((40, 40, 3), np.uint8), tensor, 0.4, size=(1120, 1120))
    cell = drawn[520:560, 520:560]  # 28 ellipses across: cells of 40 px
    rows, columns = np.nonzero(cell.sum(axis=-1))
    assert np.ptp(rows) == 39, "as long as the cell"
    assert 8 <= np.ptp(columns) <= 16, "a fifth of that, the line's width of 3 px and its soft edges"


@pytest.mark.parametrize("size", [(1, 1), (3, 200), (45, 30)])
def test_images_of_any_size_can_be_drawn(size: tuple[int, int]):
    image = torch.rand((*size, 3), generator=seeded(0))
    tensor = structure_tensor(image)
    actual = maps.draw_ellipses(color_scales.to_picture(image), tensor, 0.75, size).shape
    assert actual == (*size, 3)
    assert PERIOD(maps.texture_period(tensor)).shape == (*size, 3)


def test_eta_is_colored_around_one():
    violet, white, orange = ETA(torch.tensor([[0.1, 1.0, 10.0]]))[0].astype(int)
    assert violet[2] > violet[1]
    assert orange[0] > orange[2]
    assert white.min() > 240
    actual = ETA(torch.tensor([[1e-9, 1e9]])).tolist()
    expected = ETA(torch.tensor([[ETA.low, ETA.high]])).tolist()
    assert actual == expected


@pytest.mark.parametrize("scale", [PERIOD, ETA, CHILDREN, LOW], ids=lambda scale: scale.colors)
def test_nothing_has_another_color_than_every_value(scale: color_scales.Scale):
    values = scale.norm.inverse(np.linspace(0, 1, 200))
    colors = scale(torch.from_numpy(values)[None])[0].astype(int)
    nothing = scale(torch.full((1, 1), torch.nan))[0, 0].astype(int)
    assert np.abs(colors - nothing).max(axis=1).min() > 64


def test_each_gaussian_has_its_own_eta_and_unobserved_ones_none():
    statistics = {"eta_max": torch.tensor([[0.1, 4.0, 1.0], [0.2, 0.1, 0.1]]), "n_total": torch.tensor([5.0, 3.0])}
    seen = maps.eta_map(wall(), statistics, view())
    assert float(seen[24, 17]) == pytest.approx(4.0, rel=1e-3)
    assert float(seen[24, 47]) == pytest.approx(0.2, rel=1e-3)
    assert seen[1, 32].isnan()
    statistics["n_total"][1] = 0
    assert maps.eta_map(wall(), statistics, view())[24, 47].isnan()


def test_children_and_low_gaussians_are_seen_where_they_are():
    counts = torch.tensor([[2, 3, 1], [1, 1, 1]])
    children = maps.children_map(wall(), counts, view())
    assert float(children[24, 17]) == pytest.approx(6.0, rel=1e-3)
    assert float(children[24, 47]) == pytest.approx(1.0)
    low = maps.mean_map(wall(), torch.tensor([0.0, 1.0]), view())
    assert float(low[24, 17]) == pytest.approx(0.0)
    assert float(low[24, 47]) == pytest.approx(1.0)
    assert CHILDREN(children).shape == LOW(low).shape == (48, 64, 3)


def test_only_children_get_new_colors():
    generator = seeded(0)
    colors = maps.random_colors(4, generator)
    assert (colors.amax(dim=1) >= 0.5).all()
    assert len(colors.unique(dim=0)) == 4
    origins = torch.tensor([0, 3, 1, 1, 1])  # 2 was pruned, 1 split in three
    after = maps.recolor(colors, origins, generator)
    assert torch.equal(after[:2], colors[[0, 3]])
    assert not (after[2:, None] == colors[None]).all(dim=-1).any()
    assert len(after.unique(dim=0)) == 5


def pixels_of(scale: color_scales.Scale) -> np.ndarray:
    with Image.open(io.BytesIO(color_scales.bar(scale))) as shown:
        return np.asarray(shown)[..., :3]


def test_a_legend_has_the_scale_s_colours_and_numbers_as_an_image_in_its_text():
    assert color_scales.legend("No observations yet.") == "No observations yet."
    text, _, image = color_scales.legend("largest η", ETA).partition("\n\n")
    assert text == "largest η"
    (encoded,) = re.findall(r"^!\[largest η\]\(data:image/png;base64,(\S+)\)$", image)
    assert base64.b64decode(encoded) == color_scales.bar(ETA)
    pixels = pixels_of(ETA)
    for value in (ETA.low, 1.0, ETA.high):
        apart = np.abs(pixels.astype(int) - ETA(torch.full((1, 1), value))[0, 0]).max(axis=-1)
        assert apart.min() <= 3, "the bar has the colours of its ends and its middle"
    below = pixels[2 * len(pixels) // 3 :]
    assert (below == 255).all(axis=-1).sum() > 100, "the numbers stand below the colours"
    for scale in (PERIOD, ETA, CHILDREN, LOW):
        assert (pixels_of(scale)[:, [0, -1]].max(axis=-1) <= 20).all(), "no number is cut off"


def test_figures_are_written_whole_with_all_panels(tmp_path: Path):
    panels = [Panel("a", np.zeros((20, 30, 3), np.uint8), PERIOD), Panel("b", np.zeros((20, 30, 3), np.uint8))] * 2
    color_scales.draw(tmp_path / "new/four.png", panels, columns=2)
    color_scales.draw(tmp_path / "one.png", panels[:1], columns=1)
    names = [path.name for path in (tmp_path / "new").iterdir()]
    assert names == ["four.png"]
    with Image.open(tmp_path / "new/four.png") as four, Image.open(tmp_path / "one.png") as one:
        assert four.height > one.height > 0


def test_blending_agrees_with_the_splatter_s_colors():
    params = {name: value.detach() for name, value in random_params(50).items()}
    colors = torch.rand((50, 3), generator=seeded(1))
    render, cover = blend(params, colors, view())
    ones, _ = blend(params, torch.ones(50, 3), view())
    expected = cover.expand(-1, -1, 3)
    assert_close(ones, expected)
    assert render.shape == (48, 64, 3)
    assert (render <= ones + 1e-6).all()
