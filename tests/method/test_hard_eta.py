"""Hard cases of η and projection: nothing that is not finite ever enters the statistics.

Every case runs through the torch code and through the Triton kernel: the counts must be equal, `eta_max` within
5·10⁻⁵, and all statistics finite.

Two things are not covered. gsplat's own CUDA kernels may draw NaN for a Gaussian whose covariance overflows float32; η
does not count it. FISHEYE624 is let through if nerfstudio undistorts it, but was not measured.
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image
from torch import Tensor
from torch.testing import assert_close

from helpers import small_scenes
from helpers.closeness import assert_within_peak, assert_within_share
from helpers.generators import seeded
from helpers.json_files import write_json
from sadgs_ns.data.cameras import check_camera_types, check_undistortion
from sadgs_ns.gsplat_compat import SCREEN_BLUR
from sadgs_ns.kernels import triton_switched
from sadgs_ns.method import losses
from sadgs_ns.method.eta import eta, projected_axes, sample_footprint
from sadgs_ns.method.statistics import empty_statistics, observe
from sadgs_ns.render.rasterization import visible
from sadgs_ns.training.config import SadgsDatamanagerConfig, SadgsPipelineConfig
from sadgs_ns.training.datamanager import SadgsDatamanager
from sadgs_ns.training.model import SadgsModel
from sadgs_ns.training.pipeline import SadgsPipeline
from sadgs_ns.training.step.views import TrainingViews

harmonics = pytest.importorskip("sadgs_ns.kernels.harmonics", reason="Triton is not installed")
photometric = pytest.importorskip("sadgs_ns.kernels.losses", reason="Triton is not installed")
tiles = pytest.importorskip("sadgs_ns.kernels.tiles", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
WIDTH = 64
HEIGHT = 48
NEAR = 0.01
"""The splatter's and gsplat's near plane."""
IDENTITY = (1.0, 0.0, 0.0, 0.0)

reproducible = partial(settings, derandomize=True, deadline=None, database=None)

Gaussian = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float, float]]
"""Mean, log scales and quaternion."""


def parameters(gaussians: list[Gaussian]) -> dict[str, torch.nn.Parameter]:
    means, scales, quats = (torch.tensor(values, dtype=torch.float32) for values in zip(*gaussians, strict=True))
    n = len(gaussians)
    values = {"means": means, "scales": scales, "quats": quats, "opacities": torch.full((n,), 2.0)}
    return {name: torch.nn.Parameter(v) for name, v in (values | {"features_dc": torch.full((n, 3), 0.5)}).items()}


def uniform_map(value: float = 0.05, views: int = 1) -> Tensor:
    return torch.tensor([value, 0.0, 0.5 * value]).expand(views, HEIGHT, WIDTH, 3).contiguous()


def forward(params: dict[str, torch.nn.Parameter], focal: float) -> dict[str, Any]:
    """Info of a forward pass before a uniform S̄."""
    viewmats, Ks = small_scenes.camera(WIDTH, HEIGHT, focal=focal)
    renders, alphas, info = small_scenes.splat(params, viewmats, Ks, WIDTH, HEIGHT)
    assert renders.isfinite().all()
    assert alphas.isfinite().all()
    return {**info, "viewmats": viewmats, "Ks": Ks, "structure_tensors": uniform_map()}


def observed(params: dict[str, torch.nn.Parameter], info: dict[str, Any], rounds: int = 3) -> dict[str, Tensor]:
    """The statistics after some rounds, the same from torch code and kernel, and finite."""
    results = []
    for fused in (False, True):
        state = {key: value.to(DEVICE) for key, value in empty_statistics(len(params["means"]), DEVICE).items()}
        # Triton's interpreter computes with numpy, which would warn of what a GPU computes in silence.
        with triton_switched(fused), np.errstate(all="ignore"):
            for seed in range(rounds):
                generator = torch.Generator(DEVICE).manual_seed(seed)
                copies = {name: torch.nn.Parameter(value.detach().to(DEVICE)) for name, value in params.items()}
                on_device = {}
                for name, value in info.items():
                    if isinstance(value, Tensor):
                        value = value.detach().to(DEVICE)
                    on_device[name] = value
                gradients = torch.rand(info["means2d"].shape, generator=generator, device=DEVICE)
                observe(state, copies, on_device, gradients)
        assert all(value.isfinite().all() for value in state.values()), f"fused={fused}"
        results.append({name: value.cpu() for name, value in state.items()})
    slow, fast = results
    for name in ("n_total", "n_high", "n_low"):
        assert torch.equal(slow[name], fast[name]), name
    assert_close(fast["eta_max"], slow["eta_max"], rtol=5e-5, atol=1e-6)
    return slow


# --- where Gaussians lie ---

INSIDE = True
OUTSIDE = False
SMALL = (-9.0, -9.0, -9.0)


@pytest.mark.hard_case(
    "behind the camera, in it, just before the near plane, off the image, grazing the frustum from outside; "
    "focal lengths of 50 to 50,000 px",
    "no observation",
)
@pytest.mark.hard_case("on the near plane, 10⁹ units away, grazing the frustum from inside", "observed")
@pytest.mark.parametrize("focal", [50.0, 1000.0, 50_000.0])
@pytest.mark.parametrize(
    ("place", "seen"),
    [
        pytest.param((0, 0, -1.0), OUTSIDE, id="behind"),
        pytest.param((0, 0, 0), OUTSIDE, id="in the camera"),
        pytest.param((0, 0, NEAR * (1 - 1e-6)), OUTSIDE, id="before the near plane"),
        pytest.param((0, 0, NEAR * (1 + 1e-6)), INSIDE, id="on the near plane"),
        pytest.param((0, 0, 1e9), INSIDE, id="far away"),
        pytest.param((0.999, 0, 1.0), INSIDE, id="grazing the frustum from inside"),
        pytest.param((1.2, 0, 1.0), OUTSIDE, id="grazing the frustum from outside"),
        pytest.param((1e6, 1e6, 1.0), OUTSIDE, id="off the image"),
        pytest.param((1e30, 0, 1e-30), OUTSIDE, id="where x / z overflows"),
    ],
)
def test_places(place: tuple[float, float, float], seen: bool, focal: float):
    """x and y are in units of the frustum's half-width at z. Only what is drawn and sampled in the image counts."""
    x, y, z = place
    half_width = 0.5 * WIDTH / focal * z
    params = parameters([((x * half_width, y * half_width, z), SMALL, IDENTITY)])
    params["scales"].data += math.log(max(z, 1e-3) / focal)  # 1e-4 px: all samples at the centre
    state = observed(params, forward(params, focal))
    assert state["n_total"].tolist() == [3.0 * seen]


@pytest.mark.hard_case(
    "a Gaussian that contains the camera",
    "observed if its centre lies beyond the near plane; samples beside the image do not count",
)
def test_a_gaussian_that_contains_the_camera_is_seen_only_when_its_centre_is_before_it():
    """Its footprint is several images wide: most samples fall beside the image, η of the others is large."""
    log_scale = math.log(0.1)
    size = (log_scale, log_scale, log_scale)
    params = parameters([((0, 0, -0.1), size, IDENTITY), *[((0, 0, 0.1), size, IDENTITY)] * 300])
    state = observed(params, forward(params, 60.0), rounds=1)
    assert state["n_total"][0] == 0
    assert 0.03 < state["n_total"][1:].mean() < 0.15
    actual = state["eta_max"][:, 0].max()
    expected = pytest.approx(60 * math.sqrt(0.05), rel=1e-3)
    assert actual == expected


# --- how large and how thin they are ---


@pytest.mark.hard_case(
    "log-scales of −30 to +30, focal lengths of 50 to 50,000 px",
    "image, gradients and statistics are finite; the torch splatter culls a Gaussian whose covariance float32 "
    "cannot invert (billions of px)",
)
@pytest.mark.parametrize("focal", [50.0, 1000.0, 50_000.0])
def test_log_scales_from_minus_30_to_30(focal: float):
    """Everything is finite: statistics, image and gradients. What has no float32 covariance is culled."""
    scales = [(-30, -30, -30), (30, 30, 30), (-30, 0, 30), (30, -30, -30), (20, 20, 20), (0, 0, -30), (-3, -16.8, -3)]
    quats = [IDENTITY, (0.5, 0.1, 0.7, -0.3)]
    places = [(0, 0, NEAR), (0, 0, 1), (1e-3, -1e-3, 0.02), (0, 0, 1e6), (0.3, 0.1, 1)]
    params = parameters([(place, scale, quat) for place in places for scale in scales for quat in quats])
    info = forward(params, focal)
    assert info["conics"][visible(info)].isfinite().all()
    state = observed(params, info)
    assert state["n_total"].sum() > 10
    viewmats, Ks = small_scenes.camera(WIDTH, HEIGHT, focal=focal)
    renders, alphas, _ = small_scenes.splat(params, viewmats, Ks, WIDTH, HEIGHT)
    (renders.sum() + alphas.sum()).backward()
    for p in params.values():
        assert p.grad is not None
        assert p.grad.isfinite().all()


@pytest.mark.hard_case("projected axes of 10⁻²² to 10¹⁹ px", "η is right: it squares no length")
def test_eta_spans_the_whole_range_of_scales():
    """v_k of 1e-22 to 1e19 px: η does not square it, so none overflows or vanishes."""
    exponents = torch.arange(-22, 20)
    axes = (10.0**exponents)[:, None, None] * torch.tensor([[3.0, 4.0], [1.0, 0.0], [0.0, 1.0]])
    tensor = torch.tensor([0.04, 0.0, 0.04]).expand(len(axes), 3)  # Λ = 5 px in every direction
    expected = (10.0 ** exponents.double())[:, None] * torch.tensor([1.0, 0.2, 0.2])
    actual = eta(axes, tensor).double()
    assert_within_share(actual, expected, 1e-4)


@pytest.mark.hard_case("depths down to 10⁻³⁰ (near plane 0)", "the Jacobian is right: it squares no depth")
def test_axes_at_depths_whose_square_underflows():
    """fx / z is finite, z² is 0: gsplat with a near plane of 0 draws such Gaussians."""
    viewmats, Ks = small_scenes.camera(WIDTH, HEIGHT, focal=50.0)
    axes = projected_axes(
        torch.tensor([[0.0, 0.0, 1e-30]]), torch.tensor([IDENTITY]), torch.full((1, 3), 1e-30), viewmats, Ks, 64, 48
    )
    expected = torch.tensor([[[50.0, 0.0], [0.0, 50.0], [0.0, 0.0]]])
    assert_close(axes, expected)


@pytest.mark.hard_case("an aspect ratio of 10⁶", "samples stay within 2σ along the axis; η is that of the long axis")
@pytest.mark.parametrize("degrees", [0.0, 30.0, 45.0])
def test_aspect_ratios_of_a_million(degrees: float):
    """10³ px by 10⁻³ px. The blur of 0.3 px² is all its width; the sample stays on the long axis, within 2σ."""
    half = math.radians(degrees / 2)
    params = parameters(
        [((0, 0, 1), (math.log(20), math.log(2e-5), math.log(2e-5)), (math.cos(half), 0, 0, math.sin(half)))]
    )
    info = forward(params, 50.0)
    n = 2000
    points = sample_footprint(
        torch.zeros(n, 2),
        info["conics"][0].detach().expand(n, 3),
        torch.rand((n, 2), generator=seeded(0)),
    )
    along = torch.tensor([math.cos(2 * half), math.sin(2 * half)])
    across = torch.tensor([-along[1], along[0]])
    assert (points @ across).abs().max() < 2.0
    assert float((points @ along).std()) == pytest.approx(1000.0, rel=0.2)
    assert (points @ along).abs().max() < 2400
    copies = {name: torch.nn.Parameter(p.detach().repeat(300, *[1] * (p.dim() - 1))) for name, p in params.items()}
    state = observed(copies, forward(copies, 50.0), rounds=1)
    assert 0.005 < state["n_total"].mean() < 0.1
    actual = float(state["eta_max"].max())
    expected = pytest.approx(1000 * math.sqrt(0.05), rel=1e-3)
    assert actual == expected


@pytest.mark.hard_case(
    "any ellipse up to 10⁹ px (hypothesis)",
    "samples are finite and leave the footprint by no more than 10⁴ px. **Beyond an aspect of some thousand on "
    "the screen float32's conic no longer tells the length**; footprints are then cut to what it tells",
)
@reproducible(max_examples=100)
@given(
    long=st.floats(-1, 9).map(lambda exponent: 10.0**exponent),
    short=st.floats(-9, 3).map(lambda exponent: 10.0**exponent),
    angle=st.floats(0, math.pi),
    jitter=st.tuples(st.floats(0, 0.999), st.floats(0, 0.999)),
)
def test_samples_never_leave_the_footprint(long: float, short: float, angle: float, jitter: tuple[float, float]):
    """Whatever rounding the conic to float32 does: no sample lies further than 2σ of the long axis, or 10⁴ px more."""
    rotation = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]).double()
    covariance = rotation @ torch.diag(torch.tensor([long, short]).double() ** 2) @ rotation.T
    a = covariance[0, 0] + SCREEN_BLUR
    b = covariance[0, 1]
    c = covariance[1, 1] + SCREEN_BLUR
    blurred = torch.tensor([long, short]).double() ** 2 + SCREEN_BLUR
    conic = (torch.stack([c, -b, a]) / blurred.prod()).float()[None]
    point = sample_footprint(torch.zeros(1, 2), conic, torch.tensor([jitter]))
    assert point.isfinite().all()
    assert point.norm() <= 2.01 * max(long, short) + 1e4


@pytest.mark.hard_case(
    "a conic that is 0, singular, indefinite, or 10⁻³⁸ to 10³⁸",
    "samples at the centre, on a line, or beside the image; never NaN",
)
@pytest.mark.parametrize(
    ("conic", "counts"),
    [
        ((0.0, 0.0, 0.0), True),  # of a Gaussian too large for float32: the sample is its centre
        ((1.0, 1.0, 1.0), False),  # singular: a line, of which this sample lies off the image
        ((1.0, 2.0, 1.0), False),  # indefinite by rounding: the same
        ((math.nan, 0.0, 1.0), False),
        ((1.0, math.nan, 1.0), False),
        ((math.inf, 0.0, 1.0), False),
        ((1.0, math.inf, 1.0), False),
        ((1e38, 0.0, 1e38), True),  # narrower than the blur: the sample is its centre
        ((1e-38, 0.0, 1e-38), False),
    ],
)
def test_singular_conics(conic: tuple[float, float, float], counts: bool):
    params = parameters([((0, 0, 1), SMALL, IDENTITY)])
    info = forward(params, 50.0)
    assert visible(info).all()
    info["conics"] = torch.tensor(conic).expand(1, 1, 3)
    state = observed(params, info, rounds=5)
    assert (state["n_total"] == 5).all() if counts else (state["n_total"] < 5).all()


# --- rotations ---


@pytest.mark.hard_case("unnormalised quaternions of lengths 10⁻⁶ to 10¹⁵", "the same rotation")
@pytest.mark.parametrize("length", [1e-6, 1e-3, 1.0, 1e3, 1e6, 1e15])
def test_unnormalised_quaternions_are_the_rotation_that_they_point_at(length: float):
    quat = torch.tensor([0.5, 0.1, 0.7, -0.3])
    scales = (-1.0, -2.0, -3.0)
    unit_quat = quat / quat.norm()
    unit = parameters([((0.1, 0.2, 4), scales, tuple(unit_quat.tolist()))])
    scaled = parameters([((0.1, 0.2, 4), scales, tuple((length * quat / quat.norm()).tolist()))])
    expected = observed(unit, forward(unit, 60.0))
    actual = observed(scaled, forward(scaled, 60.0))
    assert_close(actual["eta_max"], expected["eta_max"], rtol=1e-4, atol=1e-5)


@pytest.mark.hard_case("a zero quaternion, or lengths that float32 cannot square", "the identity")
@pytest.mark.parametrize("quat", [(0.0, 0.0, 0.0, 0.0), (1e-20, 0.0, 1e-20, 0.0), (1e25, 1e25, 0.0, 0.0)])
def test_quaternions_without_direction_are_the_identity(quat: tuple[float, float, float, float]):
    """Zero, or of a length that float32 cannot square."""
    plain = parameters([((0.1, 0.2, 4), (-1, -2, -3), IDENTITY)])
    broken = parameters([((0.1, 0.2, 4), (-1, -2, -3), quat)])
    expected = observed(plain, forward(plain, 60.0))
    actual = observed(broken, forward(broken, 60.0))
    assert_close(actual["eta_max"], expected["eta_max"], rtol=1e-4, atol=1e-5)


# --- what the forward pass and the map may bring ---


@pytest.mark.hard_case(
    "conic, centre, S̄, mean, scale or quaternion NaN or ±inf",
    "no observation of that Gaussian; its neighbour keeps all of its own",
)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", ["means2d", "conics", "structure_tensors", "means", "scales", "quats"])
def test_what_is_not_finite_is_no_observation(where: str, bad: float):
    """Of two drawn Gaussians the one with a broken number has no statistics, and the other has all of them."""
    params = parameters([((-0.2, 0, 1), (-5, -5, -5), IDENTITY), ((0.2, 0, 1), (-5, -5, -5), IDENTITY)])
    info = forward(params, 50.0)
    assert visible(info).all()
    if where in params:
        params[where].data[0] = bad
    elif where == "structure_tensors":
        info[where] = info[where].clone()
        info[where][:, :, : WIDTH // 2] = bad
    else:
        info[where] = info[where].detach().clone()
        info[where][0, 0] = bad
    state = observed(params, info)
    is_number = where == "scales" and bad == -math.inf  # the logarithm of a scale of 0
    assert state["n_total"].tolist() == [3.0 * is_number, 3.0]
    assert (state["eta_max"][1, :2] > 0).all()


@pytest.mark.hard_case("garbage in the projection of culled Gaussians", "is never read")
def test_what_is_culled_may_be_anything():
    """gsplat leaves the projection of culled Gaussians unwritten, also where the parameters themselves are sound."""
    params = parameters([((0, 0, 0), (-5, -5, -5), IDENTITY), ((0, 0, 1), (-5, -5, -5), IDENTITY)])
    info = forward(params, 50.0)
    info |= {name: info[name].detach().clone() for name in ("means2d", "conics")}
    info["means2d"][0, 0] = math.nan
    info["conics"][0, 0] = math.inf
    state = observed(params, info)
    assert state["n_total"].tolist() == [0.0, 3.0]


component = st.floats(-1e6, 1e6, width=32)


@pytest.mark.hard_case("any Gaussians before any camera (hypothesis)", "torch code and kernel agree")
@reproducible(max_examples=40)
@given(
    gaussians=st.lists(
        st.tuples(
            st.tuples(component, component, st.floats(-10, 1e6, width=32)),
            st.tuples(*[st.floats(-30, 30, width=32)] * 3),
            st.tuples(*[component] * 4),
        ),
        min_size=8,
        max_size=8,
    ),
    focal=st.floats(50, 50_000),
)
def test_any_gaussian_before_any_camera(gaussians: list[Gaussian], focal: float):
    """Torch code and kernel agree and stay finite. Half the Gaussians are moved into the picture."""
    params = parameters(gaussians)
    params["means"].data[::2] *= torch.tensor([1e-6 / focal, 1e-6 / focal, 1.0])
    params["means"].data[::2, 2].abs_().add_(NEAR)
    observed(params, forward(params, focal), rounds=1)


# --- the other kernels ---


def extreme_ellipses(n: int = 192) -> dict[str, Tensor]:
    """From 0.03 px to 10⁹ px long, at angles where determinants cancel, up to 10⁹ px off; some broken."""
    generator = seeded(1)

    def random(*shape: int) -> Tensor:
        return torch.rand((1, n, *shape), generator=generator, dtype=torch.float64)

    lengths = 10 ** (10 * random(2) - 1.5)
    angles = math.pi * random()
    angles[:, ::3] = (4 * random()[:, ::3]).round() * math.pi / 4
    rotation = torch.stack([angles.cos(), -angles.sin(), angles.sin(), angles.cos()], -1).reshape(1, n, 2, 2)
    variances = lengths**2 + SCREEN_BLUR
    # Made of its eigenvalues, the inverse exists on every processor; that of the rounded covariance may not.
    inverses = (rotation @ torch.diag_embed(1 / variances) @ rotation.mT).float()
    means2d = (1.4 * random(2) - 0.2) * torch.tensor([WIDTH, HEIGHT])
    means2d[:, 1::4] += ((random(2) - 0.5) * 10 ** (9 * random(1)))[:, 1::4]
    conics = torch.stack([inverses[..., 0, 0], inverses[..., 0, 1], inverses[..., 1, 1]], -1)
    opacities = random()
    means2d[:, 5] = math.nan
    means2d[:, 6, 0] = math.nan
    means2d[:, 7] = math.inf
    means2d[:, 8] = -math.inf
    conics[:, 10] = 0.0
    conics[:, 11] = math.nan
    conics[:, 12] = math.inf
    opacities[:, 13] = math.nan
    radii = (3 * variances.amax(-1).sqrt()).ceil().clamp_max(2**31 - 200).int()
    values = {"means2d": means2d, "depths": random(), "conics": conics, "opacities": opacities}
    return {**{name: value.float() for name, value in values.items()}, "radii": radii}


@pytest.mark.hard_case(
    "tile lists of ellipses of 10⁹ px, 10⁹ px off, with broken conics, centres and opacities",
    "no needed tile is missed, none is invented; NaN and infinite centres are in none",
)
def test_tile_lists_of_extreme_and_broken_gaussians_miss_none_and_invent_none():
    gaussians = extreme_ellipses()
    size = 8
    on_device = {name: value.to(DEVICE) for name, value in gaussians.items()}
    with np.errstate(invalid="ignore"):  # inf − inf, of the broken conics
        starts, ids, _ = tiles.intersect_tiles(**on_device, width=WIDTH, height=HEIGHT, tile_size=size).lists()
    actual = int(starts[0, 0, 0])
    assert actual == 0
    columns = WIDTH // size
    means2d = gaussians["means2d"][0].double()
    radii = gaussians["radii"][0, :, None].double()
    opacities = gaussians["opacities"][0]
    conics = gaussians["conics"][0].double()
    n_listed = 0
    for number, listed in enumerate(ids.cpu().tensor_split(starts.cpu().flatten().tolist()[1:])):
        corner = torch.tensor([number % columns, number // columns])
        y, x = torch.meshgrid(torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij")
        delta = means2d[:, None] - (torch.stack([x, y], -1).reshape(1, -1, 2) + size * corner)
        a, b, c = conics[..., None].unbind(1)
        sigma = (a * delta[..., 0] ** 2 + c * delta[..., 1] ** 2) / 2 + b * delta[..., 0] * delta[..., 1]
        reaches = ((opacities[:, None] * torch.exp(-sigma) >= 1 / 255) & (sigma >= 0)).any(1)
        low = ((means2d - radii) / size).floor()
        high = ((means2d + radii) / size).ceil()
        in_square = ((low <= corner) & (high > corner)).all(1) & (opacities >= 1 / 255)
        have = set(listed.tolist())
        assert len(have) == len(listed)
        assert set((reaches & in_square).nonzero().flatten().tolist()) <= have
        assert have <= set(in_square.nonzero().flatten().tolist())
        n_listed += len(have)
    assert n_listed > 1000


@pytest.mark.hard_case("the loss of renderings up to 10⁴", "equals float64 (10⁻⁵; its gradient 10⁻³ of its maximum)")
@pytest.mark.parametrize("scale", [1.0, 100.0, 1e4])
def test_the_loss_of_an_overexposed_rendering_equals_the_float64_reference(scale: float):
    """Renderings are not clamped; the variance in SSIM cancels at large values, but never to a non-finite gradient."""
    generator = seeded(0)
    target, start = (torch.rand((1, 16, 20, 3), generator=generator) for _ in range(2))
    start[:, :, :10] = 0.777
    results = []
    fused = partial(photometric.photometric_loss, window=losses.WINDOW)
    for function, dtype in ((fused, torch.float32), (losses.photometric_loss, torch.float64)):
        x = (scale * start).to(DEVICE, dtype).requires_grad_()
        loss, _ = function(x, target.to(DEVICE, dtype), ssim_lambda=0.2, l2_lambda=2.0)
        loss.backward()
        assert x.grad is not None
        results.append((loss.detach().double(), x.grad.double()))
    (loss, gradient), (expected, expected_gradient) = results
    assert_within_share(loss, expected, 1e-5)
    assert_within_peak(gradient, expected_gradient, 1e-3)


@pytest.mark.hard_case("NaN or inf in a rendering", "shows in the loss")
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_broken_pixel_shows_in_the_loss(value: float):
    x = torch.rand((1, 16, 16, 3), generator=seeded(0)).to(DEVICE)
    x[0, 3, 4, 1] = value
    with np.errstate(all="ignore"):  # Triton's interpreter computes with numpy
        loss, _ = photometric.photometric_loss(x, torch.zeros_like(x), losses.WINDOW, ssim_lambda=0.2, l2_lambda=2.0)
    assert not loss.isfinite()


@pytest.mark.hard_case(
    "NaN coefficients of harmonics; Gaussians 10²⁵ away or in the camera",
    "NaN shows in the colour; the others are finite",
)
def test_broken_harmonics_show_in_the_colour_and_distant_ones_are_finite():
    means = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1e25], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], device=DEVICE)
    first = torch.ones((4, 3), device=DEVICE)
    rest = torch.ones((4, 15, 3), device=DEVICE)
    first[3, 1] = math.nan
    with np.errstate(over="ignore"):
        colors = harmonics.colors_from_harmonics(
            3,
            means,
            first,
            rest,
            torch.eye(4, device=DEVICE)[None],
            torch.ones((1, 4), dtype=torch.int32, device=DEVICE),
        )
    assert colors[0, :3].isfinite().all(), "too far to be squared, and in the camera: no direction, degree 0 only"
    assert colors[0, 3].isnan().tolist() == [False, True, False]


# --- cameras ---


def cameras(camera_type: CameraType, distortion: list[float] | None) -> Cameras:
    return Cameras(
        camera_to_worlds=torch.eye(4)[None, :3].repeat(2, 1, 1),
        fx=50.0, fy=50.0, cx=32.0, cy=24.0, width=WIDTH, height=HEIGHT,
        camera_type=torch.tensor([[CameraType.PERSPECTIVE.value], [camera_type.value]]),
        distortion_params=None if distortion is None else torch.tensor([[0.0] * 6, distortion]),
    )  # fmt: skip


@pytest.mark.hard_case("perspective cameras, distorted or not", "right")
@pytest.mark.hard_case(
    "orthographic, equirectangular, VR180 and omnidirectional stereo cameras",
    "one sentence naming the type and the remedy",
)
@pytest.mark.parametrize("distortion", [None, [0.0] * 6, [0.1, 0, 0, 0, 0, 0]])
@pytest.mark.parametrize("camera_type", list(CameraType), ids=lambda camera_type: camera_type.name)
def test_cameras_are_pinholes_or_undistorted_or_refused_by_name(
    camera_type: CameraType, distortion: list[float] | None
):
    distorted = distortion is not None and any(distortion)
    if camera_type is CameraType.PERSPECTIVE or ("FISHEYE" in camera_type.name and distorted):
        check_camera_types(cameras(camera_type, distortion))
        return
    remedy = "k1 = 1e-9" if "FISHEYE" in camera_type.name else "Make perspective images of it"
    with pytest.raises(ValueError, match=rf"^Camera 1 is {camera_type.name}\b.*{remedy}"):
        check_camera_types(cameras(camera_type, distortion))


@pytest.mark.hard_case(
    "rendering a camera that is no pinhole (`ns-render camera-path`, the viewer's preview)",
    "ValueError; a viewer's page must then be loaded again",
)
def test_rendering_a_camera_that_is_no_pinhole_is_refused():
    with pytest.raises(ValueError, match=r"^Camera 0 of the path is EQUIRECTANGULAR, which sadgs cannot draw"):
        SadgsModel.get_outputs(None, cameras(CameraType.EQUIRECTANGULAR, None)[1:])  # type: ignore[arg-type]


FISHEYE_FOCAL = 60.0
DIRECTIONS = [(x, y) for x in (-0.4, 0.0, 0.5) for y in (-0.3, 0.0, 0.35)]
"""x / z and y / z of the dots in the fisheye images."""


def fisheye_data(
    folder: Path, k1: float, camera_model: str = "OPENCV_FISHEYE", focal: float = FISHEYE_FOCAL
) -> SadgsDatamanagerConfig:
    """Equidistant images (radius = focal · angle) of dots in known directions, as ns-process-data describes them."""
    (folder / "images").mkdir(parents=True)
    image = np.zeros((96, 128), np.float32)
    y, x = np.mgrid[:96, :128] + 0.5
    for u, v in DIRECTIONS:
        tangent = math.hypot(u, v)
        factor = focal * (math.atan(tangent) / tangent if tangent > 0 else 1.0)
        image += np.exp(-((x - 64 - factor * u) ** 2 + (y - 48 - factor * v) ** 2) / 2)
    described = []
    for index in range(3):
        name = f"images/{index}.png"
        Image.fromarray((255 * image[..., None].repeat(3, -1)).clip(0, 255).astype(np.uint8)).save(folder / name)
        pose = np.eye(4)
        pose[0, 3] = index
        described.append({"file_path": name, "transform_matrix": pose.tolist()})
    text = {"camera_model": camera_model, "fl_x": focal, "fl_y": focal, "cx": 64, "cy": 48}
    text |= {"w": 128, "h": 96, "k1": k1, "k2": 0, "k3": 0, "k4": 0, "frames": described}
    write_json(folder / "transforms.json", text)
    parser = NerfstudioDataParserConfig(data=folder, load_3D_points=False, downscale_factor=1, eval_mode="all")
    return SadgsDatamanagerConfig(dataparser=parser)


@pytest.mark.hard_case("a fisheye with distortion coefficients", "nerfstudio undistorts it: right within 0.3 px")
def test_a_fisheye_that_nerfstudio_undistorts_is_right(tmp_path: Path):
    """The dots lie where the pinhole of the changed intrinsics puts them; the coefficient is what the refusal names."""
    datamanager: SadgsDatamanager = fisheye_data(tmp_path, k1=1e-9).setup(device="cpu")
    dataset = datamanager.train_dataset
    check_camera_types(dataset.cameras)
    image = datamanager.cached_train[0]["image"].float().mean(-1)
    K = dataset.cameras.get_intrinsics_matrices()[0]
    assert float(K[0, 0]) != FISHEYE_FOCAL
    y, x = torch.meshgrid(torch.arange(image.shape[0]) + 0.5, torch.arange(image.shape[1]) + 0.5, indexing="ij")
    n_inside = 0
    for u, v in DIRECTIONS:
        at = K @ torch.tensor([u, v, 1.0])
        if not (6 < at[0] < image.shape[1] - 6 and 6 < at[1] < image.shape[0] - 6):
            continue
        weight = image * ((x - at[0]).abs() < 6) * ((y - at[1]).abs() < 6)
        centre = torch.stack([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
        assert (centre - at[:2]).norm() < 0.3, (u, v)
        n_inside += 1
    assert n_inside == len(DIRECTIONS)
    check_undistortion(dataset.cameras, dataset.image_filenames)


@pytest.mark.hard_case("a fisheye of about 180°, which nerfstudio makes black", "ValueError naming the file")
@pytest.mark.parametrize(("focal", "k1"), [(40.0, 1e-9), (41.0, 1e-3)])  # a focal length of 0, a centre far off
def test_a_fisheye_of_180_degrees_that_nerfstudio_makes_black_is_refused(tmp_path: Path, focal: float, k1: float):
    datamanager: SadgsDatamanager = fisheye_data(tmp_path, k1=k1, focal=focal).setup(device="cpu")
    assert datamanager.cached_train[0]["image"].max() == 0
    with pytest.raises(ValueError, match=r"images/0\.png is a FISHEYE image that nerfstudio could not undistort"):
        _ = TrainingViews(datamanager, SimpleNamespace(device="cpu")).cameras  # type: ignore[arg-type]


@pytest.mark.hard_case(
    "a fisheye whose coefficients are all 0 (nerfstudio leaves it as it is), and other cameras that are no pinholes",
    "one sentence naming the type and the remedy, before an image is cached",
)
@pytest.mark.parametrize(
    ("camera_model", "sentence"),
    [
        ("OPENCV_FISHEYE", "is a fisheye with all distortion coefficients 0"),
        ("ORTHOPHOTO", "camera model 'ORTHOPHOTO': give one of"),
    ],
)
def test_training_refuses_such_cameras(tmp_path: Path, camera_model: str, sentence: str):
    config = SadgsPipelineConfig(datamanager=fisheye_data(tmp_path, k1=0.0, camera_model=camera_model))
    with pytest.raises(ValueError, match=sentence):
        SadgsPipeline(config, device="cpu")


@pytest.mark.hard_case("c too large to be stored (> 4), ≤ 0, NaN", "ValueError naming `pipeline.frequency_constant`")
@pytest.mark.parametrize("constant", [0.0, -1.0, 4.1, math.nan])
def test_a_frequency_constant_that_cannot_be_stored_is_refused(constant: float):
    with pytest.raises(ValueError, match=r"pipeline\.frequency_constant must be in \(0, 4\]"):
        SadgsPipeline(SadgsPipelineConfig(frequency_constant=constant), device="cpu")
