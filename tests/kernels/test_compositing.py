"""The compositing's two passes against the plain formula in float64 and its autograd, and on CUDA against gsplat's."""

from __future__ import annotations

from typing import Any

import gsplat
import pytest
import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci
from torch import Tensor
from torch.testing import assert_close

from helpers import small_scenes
from helpers.closeness import assert_within, assert_within_peak
from helpers.generators import seeded
from helpers.gsplat_like import rasterization
from helpers.rendered_scene import random_scene
from sadgs_ns import gsplat_compat, kernels
from sadgs_ns.kernels import triton_switched
from sadgs_ns.method.screen_gradients import accumulate_gradients, empty_gradients, keep_gradient
from sadgs_ns.render import backend_gsplat
from sadgs_ns.render.rasterization import visible

compositing = pytest.importorskip("sadgs_ns.kernels.compositing", reason="Triton is not installed")
tiles = pytest.importorskip("sadgs_ns.kernels.tiles", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
NAMES = ("means2d", "conics", "colors", "opacities", "absgrad")


TINY = 0.05
"""Standard deviation of the "tiny" kind in px; gsplat's own blur leaves none under 0.55."""


def make_scene(
    kind: str, num_views: int = 1, n: int = 60, width: int = 21, height: int = 18, tiny: float = TINY
) -> dict[str, Any]:
    """Projected Gaussians with their tile lists, and gradients of what they render."""
    generator = seeded(1)

    def random(*shape: int) -> Tensor:
        return torch.rand((num_views, n, *shape), generator=generator)

    size = torch.tensor([width, height])
    means2d = random(2) * size * 1.4 - size * 0.2
    angles = 3.2 * random()
    sigmas = 0.6 + 3 * random(2)
    opacities = 0.05 + 0.85 * random()
    if kind == "opaque":
        opacities = 0.95 + 0.05 * random()
        sigmas = 2 * sigmas + 2
        opacities[:, ::3] = 1.0  # alpha is cut off at 0.999 around the centre
    elif kind == "faint":
        opacities = 0.012 * random()  # mostly below 1/255
    elif kind == "long and thin":  # 0.3 px² is gsplat's blur; centres up to 100 px off
        sigmas = torch.stack([20 + 80 * random(), torch.full((num_views, n), 0.56)], dim=-1)
        means2d = size / 2 + 60 * (random() - 0.5)[..., None] * torch.stack([angles.cos(), angles.sin()], dim=-1)
    elif kind == "tiny":
        sigmas = torch.full((num_views, n, 2), tiny)
        means2d = means2d.floor() + 0.5 + min(4 * tiny, 1.0) * random(2)
    elif kind == "huge":
        sigmas = 500 + 1000 * random(2)
        means2d = means2d + 2000 * (random(2) - 0.5)
        opacities = 0.3 * opacities
    rotations = torch.stack([angles.cos(), -angles.sin(), angles.sin(), angles.cos()], dim=-1).unflatten(-1, (2, 2))
    precisions = (rotations / sigmas[..., None, :] ** 2) @ rotations.mT
    scene: dict[str, Any] = {
        "means2d": means2d,
        "conics": torch.stack([precisions[..., 0, 0], precisions[..., 0, 1], precisions[..., 1, 1]], dim=-1),
        "colors": random(3),
        "opacities": opacities,
        "depths": random(),
        "v_renders": torch.randn((num_views, height, width, 3), generator=generator),
        "v_alphas": torch.randn((num_views, height, width, 1), generator=generator),
    }
    scene = {name: value.to(DEVICE) for name, value in scene.items()}
    radii = torch.full((num_views, n), 10**6, dtype=torch.int32, device=DEVICE)
    scene["pending"] = tiles.intersect_tiles(
        scene["means2d"], radii, scene["depths"], scene["conics"], scene["opacities"], width, height, 8
    )
    scene["starts"], scene["ids"], _ = scene["pending"].lists()
    return scene


def reference(scene: dict[str, Any]) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """Gradients by autograd in float64, alphas [C, height, width, 1] and last_ids [C, height, width]."""
    num_views, height, width = scene["v_renders"].shape[:3]
    n = scene["means2d"].shape[1]
    means2d, conics, colors, opacities = (scene[name].double().cpu().requires_grad_() for name in NAMES[:4])
    lists = scene["ids"].cpu().long().tensor_split(scene["starts"].cpu().flatten()[1:].long())
    rows, columns = scene["starts"].shape[1:]
    place = torch.full((num_views, n, rows, columns), -1)  # of each Gaussian in each tile's list
    begin = 0
    for number, listed in enumerate(lists):
        tile = number % (rows * columns)
        place[listed // n, listed % n, tile // columns, tile % columns] = begin + torch.arange(len(listed))
        begin += len(listed)
    place = place.repeat_interleave(8, 2).repeat_interleave(8, 3)[:, :, :height, :width].flatten(2)  # [C, N, P]
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([x, y], dim=-1).reshape(-1, 2)
    order = scene["depths"].cpu().argsort(dim=1, stable=True)[..., None].expand_as(place)
    delta = means2d[:, :, None] - pixels  # [C, N, P, 2]
    delta.retain_grad()
    a, b, c = conics[:, :, None].unbind(-1)
    sigma = 0.5 * (a * delta[..., 0] ** 2 + c * delta[..., 1] ** 2) + b * delta[..., 0] * delta[..., 1]
    alpha = (opacities[..., None] * torch.exp(-sigma)).clamp_max(0.999)
    alpha = torch.where((place < 0) | (sigma < 0) | (alpha < 1 / 255), 0.0, alpha).gather(1, order)
    left = (1 - alpha).cumprod(dim=1)
    alpha = torch.where(left <= 1e-4, 0.0, alpha)
    behind = (1 - alpha).cumprod(dim=1)
    weights = alpha * torch.cat([torch.ones_like(behind[:, :1]), behind[:, :-1]], dim=1)
    renders = weights.mT @ colors.gather(1, order[..., :3])  # [C, P, 3]
    alphas = 1 - behind[:, -1]
    loss = (renders * scene["v_renders"].double().cpu().flatten(1, 2)).sum()
    (loss + (alphas * scene["v_alphas"].double().cpu().flatten(1)).sum()).backward()
    scene["renders"] = renders.detach().reshape(num_views, height, width, 3)
    gradients: dict[str, Any] = dict(zip(NAMES, (means2d.grad, conics.grad, colors.grad, opacities.grad), strict=False))
    gradients["absgrad"] = delta.grad.abs().sum(dim=2)  # type: ignore[union-attr]
    last_ids = torch.where(weights > 0, place.gather(1, order), 0).amax(dim=1).reshape(num_views, height, width)
    return gradients, alphas.detach().reshape(num_views, height, width, 1), last_ids.int()


def gradients_of(scene: dict[str, Any], alphas: Tensor, last_ids: Tensor, absgrad: bool = True) -> dict[str, Any]:
    """Gradients by the kernel, converted to float64 on the CPU."""
    results = compositing.composite_backward(
        *(scene[name] for name in NAMES[:4]),
        scene["starts"],
        scene["ids"],
        alphas.float().to(DEVICE),
        last_ids.to(DEVICE),
        scene["v_renders"],
        scene["v_alphas"],
        absgrad,
    )
    return {name: None if value is None else value.double().cpu() for name, value in zip(NAMES, results, strict=True)}


# Largest error, relative to the largest gradient. The kernel is given alphas in float32, as gsplat's is: where 1e-4 of
# the light is left, 1 - alpha has an error of up to 6e-4. Tiny Gaussians' offsets cancel against those of their tile.
TOLERANCES = {"usual": 2e-6, "opaque": 3e-4, "faint": 2e-6, "long and thin": 3e-4, "tiny": 1e-3, "huge": 1e-4}


@pytest.mark.hard_case(
    "compositing opaque, faint, tiny, huge, long and thin Gaussians", "gradients equal float64 autograd"
)
@pytest.mark.parametrize("kind", TOLERANCES)
def test_gradients_equal_float64_autograd(kind):
    scene = make_scene(kind, num_views=2 if kind == "usual" else 1)
    expected, alphas, last_ids = reference(scene)
    if kind == "opaque":  # most lists end behind what is drawn
        assert (alphas > 0.999).float().mean() > 0.3
        assert last_ids.max() < len(scene["ids"]) - 5
    gradients = gradients_of(scene, alphas, last_ids)
    for name, value in expected.items():
        assert value.abs().max() > 0
        error = (gradients[name] - value).abs().max() / value.abs().max()
        assert error < (5e-4 if name == "absgrad" else TOLERANCES[kind]), (name, float(error))


def drawn_by_the_kernel(scene: dict[str, Any]) -> tuple[Tensor, Tensor, Tensor]:
    height, width = scene["v_renders"].shape[1:3]
    splats = (scene[name] for name in NAMES[:4])
    return compositing.composite_forward(*splats, width, height, scene["starts"], scene["ids"])


@pytest.mark.parametrize("kind", TOLERANCES)
def test_what_is_drawn_equals_the_plain_formula_in_float64(kind):
    scene = make_scene(kind, num_views=2 if kind == "usual" else 1)
    _, alphas, last_ids = reference(scene)
    renders, found, last = (value.cpu() for value in drawn_by_the_kernel(scene))
    # Where alpha is within rounding of 1/255, it decides whether a Gaussian is drawn.
    agrees = last == last_ids
    assert agrees.float().mean() > 0.98
    tolerance = 2e-5 if kind in ("long and thin", "huge") else 2e-6
    actual = renders[agrees].double()
    expected = scene["renders"][agrees]
    assert_within(actual, expected, tolerance)
    actual = found[agrees].double()
    assert_within(actual, alphas[agrees], tolerance)
    assert_within(found.double(), alphas, 1 / 255 + tolerance)


def test_a_colour_that_is_not_finite_makes_the_pixels_nan_that_see_it_and_no_others():
    scene = make_scene("usual")
    before = drawn_by_the_kernel(scene)
    scene["colors"][0, 7, 1] = float("nan")
    scene["colors"][0, 9, 2] = float("inf")
    after = drawn_by_the_kernel(scene)
    scene["colors"] = torch.zeros_like(scene["colors"])
    scene["colors"][0, [7, 9]] = 1.0
    sees = drawn_by_the_kernel(scene)[0][..., 0] > 0
    assert 5 < sees.sum() < sees.numel() - 5
    assert after[0][sees].isnan().all()
    assert torch.equal(after[0][~sees], before[0][~sees])
    assert torch.equal(after[1], before[1])
    assert torch.equal(after[2], before[2])


def test_places_below_the_image_are_not_drawn_and_nothing_in_sight_is_black():
    scene = make_scene("usual")
    expected = drawn_by_the_kernel(scene)
    needed = len(scene["ids"])
    scene["starts"], scene["ids"], _ = scene["pending"].lists(needed + 50)
    for one, other in zip(expected, drawn_by_the_kernel(scene), strict=True):
        assert torch.equal(one, other)
    scene["starts"], scene["ids"], _ = scene["pending"].lists(needed - 1)
    for value in drawn_by_the_kernel(scene):
        assert not value.any()
    scene["starts"], scene["ids"] = torch.zeros_like(scene["starts"]), scene["ids"][:0]
    for value in drawn_by_the_kernel(scene):
        assert not value.any()


@pytest.mark.parametrize("sigma", [0.05, 0.1, 0.2, 0.55])
def test_small_gaussians_err_as_the_module_says(sigma):
    scene = make_scene("tiny", n=100, width=37, height=30, tiny=sigma)
    expected, alphas, last_ids = reference(scene)
    gradients = gradients_of(scene, alphas, last_ids)
    errors = {name: float((gradients[name] - value).norm() / value.norm()) for name, value in expected.items()}
    assert errors.pop("conics") < 2e-6 / sigma**2  # "about 1e-6"
    assert errors.pop("absgrad") < (3e-4 if sigma < 0.5 else 1.5e-4)
    assert max(errors.values()) < 1e-5, errors


def test_without_absgrad_the_rest_is_the_same():
    scene = make_scene("usual", n=30, width=9, height=9)
    _, alphas, last_ids = reference(scene)
    both = [gradients_of(scene, alphas, last_ids, absgrad) for absgrad in (True, False)]
    assert both[0].pop("absgrad") is not None
    assert both[1].pop("absgrad") is None
    for name, value in both[0].items():
        actual = both[1][name]
        assert_close(actual, value, atol=1e-6, rtol=1e-5)


def test_without_a_gradient_of_alphas_it_counts_as_zero():
    scene = make_scene("usual", n=30, width=9, height=9)
    _, alphas, last_ids = reference(scene)
    scene["v_alphas"] = torch.zeros_like(scene["v_alphas"])
    expected = gradients_of(scene, alphas, last_ids)
    scene["v_alphas"] = None
    for name, value in gradients_of(scene, alphas, last_ids).items():
        assert_close(value, expected[name], atol=1e-6, rtol=1e-5)


@pytest.mark.hard_case(
    "a pixel's gradient NaN, ±inf or beyond 10¹⁸",
    "NaN in the gradients of the Gaussians that it sees, and of no others",
)
@pytest.mark.parametrize("broken", [float("nan"), float("inf"), -1e30])
def test_a_broken_pixel_reaches_the_gaussians_that_it_sees_and_no_others(broken):
    scene = make_scene("usual", width=8, height=8)
    _, alphas, last_ids = reference(scene)
    scene["v_renders"][0, 2, 3, 1] = 0
    expected = gradients_of(scene, alphas, last_ids)
    scene["v_renders"][0, 2, 3, 1] = broken
    gradients = gradients_of(scene, alphas, last_ids)
    delta = scene["means2d"][0].cpu() - torch.tensor([3.5, 2.5])
    a, b, c = scene["conics"][0].cpu().unbind(-1)
    sigma = 0.5 * (a * delta[:, 0] ** 2 + c * delta[:, 1] ** 2) + b * delta[:, 0] * delta[:, 1]
    seen = scene["opacities"][0].cpu() * torch.exp(-sigma) >= 1 / 255
    place = torch.full_like(seen, -1, dtype=torch.long)
    place[scene["ids"].cpu().long()] = torch.arange(len(scene["ids"]))
    seen &= (place >= 0) & (place <= last_ids[0, 2, 3])
    assert 5 < seen.sum() < 55
    for name in NAMES[:4]:
        assert gradients[name][0, seen].isnan().all(), name
        actual = gradients[name][0, ~seen]
        assert_close(actual, expected[name][0, ~seen], atol=1e-6, rtol=1e-5)


def test_nothing_in_sight_has_gradients_of_zero():
    scene = make_scene("usual", n=3)
    scene["starts"], scene["ids"] = torch.zeros_like(scene["starts"]), scene["ids"][:0]
    alphas = torch.zeros(1, 18, 21, 1)
    last_ids = torch.zeros(1, 18, 21, dtype=torch.int32)
    for value in gradients_of(scene, alphas, last_ids).values():
        assert (value == 0).all()


@pytest.mark.parametrize(("num_views", "width", "height"), [(2, 21, 18), (1, 16, 16)])
def test_places_that_no_list_needs_change_nothing(num_views, width, height):
    scene = make_scene("usual", num_views, 30, width, height)
    _, alphas, last_ids = reference(scene)
    expected = gradients_of(scene, alphas, last_ids)
    scene["starts"], scene["ids"], _ = scene["pending"].lists(len(scene["ids"]) + 300)
    _, alphas_again, last_ids_again = reference(scene)
    assert torch.equal(alphas_again, alphas)
    assert torch.equal(last_ids_again, last_ids)
    gradients = gradients_of(scene, alphas, last_ids)
    for name, value in expected.items():
        if DEVICE.type == "cpu":
            assert torch.equal(gradients[name], value), name
        else:  # atomic additions come in any order
            assert_close(gradients[name], value, atol=1e-5, rtol=1e-5)


def test_lists_that_are_too_short_have_gradients_of_zero():
    scene = make_scene("usual", 2, 30)
    scene["starts"], scene["ids"], _ = scene["pending"].lists(len(scene["ids"]) - 1)
    alphas = torch.zeros(2, 18, 21, 1)
    last_ids = torch.zeros(2, 18, 21, dtype=torch.int32)
    for value in gradients_of(scene, alphas, last_ids).values():
        assert (value == 0).all()


def test_tiles_without_gaussians_stay_out_of_the_others_lists():
    # The one Gaussian is first in the only list; pixels that draw nothing name the same place as their last.
    scene = make_scene("usual", n=1, width=40, height=40)
    scene["starts"], scene["ids"], _ = tiles.intersect_tiles(
        scene["means2d"].fill_(20.0), torch.full((1, 1), 4, dtype=torch.int32, device=DEVICE), scene["depths"],
        scene["conics"], scene["opacities"].fill_(0.9), 40, 40, 8,
    ).lists()  # fmt: skip
    assert 0 < len(scene["ids"]) < 10
    expected, alphas, last_ids = reference(scene)
    gradients = gradients_of(scene, alphas, last_ids)
    for name in NAMES[:4]:
        assert_close(gradients[name], expected[name], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("through", ["colours and alphas", "colours", "alphas"])
def test_autograd_gets_what_the_kernel_returns(through):
    scene = make_scene("usual", n=30, width=9, height=9)
    for name, what in (("v_renders", "colours"), ("v_alphas", "alphas")):
        if what not in through:
            scene[name] = torch.zeros_like(scene[name])
    expected, _, _ = reference(scene)
    inputs = {name: scene[name].clone() for name in NAMES[:4]}
    for name in ("means2d", "colors"):
        inputs[name].requires_grad_()
    renders, alphas = compositing.rasterize_to_pixels(
        *(inputs[name] for name in NAMES[:4]), 9, 9, scene["starts"], scene["ids"], True
    )
    outputs = {"v_renders": renders, "v_alphas": alphas}
    used = [name for name in outputs if scene[name].any()]
    torch.autograd.backward([outputs[name] for name in used], [scene[name] for name in used])
    for name, value in expected.items():
        found = inputs["means2d"].absgrad if name == "absgrad" else inputs[name].grad
        if name == "means2d":
            assert torch.equal(inputs[name].grad2d, found)
        if name in ("conics", "opacities"):
            assert found is None
        else:
            actual = found.double().cpu()
            assert_within_peak(actual, value, 5e-4)


@pytest.mark.skipif(
    torch.cuda.is_available(), reason="with CUDA, tests/render/test_rasterization.py takes gsplat's own kernels"
)
@pytest.mark.parametrize(("max_off_axis", "capacity"), [(0.0, None), (0.5, None), (0.0, 3000)])
def test_the_assembled_rasterizer_differentiates_as_the_splatter_does(monkeypatch, max_off_axis, capacity):
    """All of it for two views; torch code stands in for gsplat's projection."""
    width = 22
    height = 18

    def project(means, quats, scales, opacities, viewmats, Ks, width, height, near_plane):
        covariances = _quat_scale_to_covar_preci(quats, scales, True, False)[0]
        assert covariances is not None
        return _fully_fused_projection(means, covariances, viewmats, Ks, width, height, near_plane=near_plane)[:4]

    monkeypatch.setattr(gsplat_compat, "project", project)
    generator = seeded(0)
    viewmats = torch.eye(4).repeat(2, 1, 1)
    viewmats[1, :3, :3] = torch.linalg.qr(torch.eye(3) + 0.05 * torch.randn(3, 3, generator=generator))[0]
    viewmats[1, :3, :3] *= viewmats[1, :3, :3].diagonal().sign()
    viewmats[1, :3, 3] = torch.tensor([0.2, 0.1, 0.3])
    Ks = small_scenes.camera(width, height, 30.0)[1].repeat(2, 1, 1)
    rest = 0.1 * torch.randn((60, 15, 3), generator=generator)
    v_renders = 0.1 * torch.randn((2, height, width, 3), generator=generator)
    results = []
    drawn = []
    for backend, dtype in (("triton", torch.float32), ("torch", torch.float64)):
        values = {name: p.detach() for name, p in small_scenes.random_params(60).items()} | {"rest": rest}
        values = {name: value.to(dtype, copy=True).requires_grad_() for name, value in values.items()}
        colors: Any = values["features_dc"], values["rest"]
        geometry = values["means"], values["quats"], values["scales"].exp(), torch.sigmoid(values["opacities"])
        options = {"tile_capacity": capacity} if dtype == torch.float32 else {}
        with triton_switched(backend == "triton"):
            renders, _, info = rasterization(
                *geometry, colors, viewmats.to(dtype), Ks.to(dtype), width, height, **options, backend=backend,
                sh_degree=3, absgrad=True, max_off_axis=max_off_axis,
            )  # fmt: skip
        if options:
            needed = sum(info["pair_counts"].wait())
            assert len(info["flatten_ids"]) == (capacity or needed) >= needed > 150
        drawn.append(int(visible(info).sum()))
        keep_gradient(info["means2d"])
        assert info["means2d"].retains_grad is (dtype == torch.float64), "torch would copy the gradient"
        renders.backward(v_renders.to(dtype))
        sums = empty_gradients(60, torch.device("cpu"))
        accumulate_gradients(sums, info, num_views=2)
        results.append({name: value.grad for name, value in values.items()} | {"absgrad": info["means2d"].absgrad})
        results[-1]["renders"] = renders.detach()
        results[-1]["summed gradient"] = sums["grad2d"]
    assert drawn[0] == drawn[1]
    assert (drawn[0] < 70) is (max_off_axis > 0)
    for name, expected in results[1].items():
        error = (results[0][name].double() - expected).norm() / expected.norm()
        assert error < (1e-4 if name == "absgrad" else 5e-6), (name, float(error))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat's kernels need CUDA")
@pytest.mark.parametrize("kind", TOLERANCES)
def test_what_is_drawn_is_as_close_to_float64_as_what_gsplat_draws(kind):
    """Rounding decides where alpha is 1/255, and in the exponents of long, thin Gaussians, where products cancel."""
    scene = make_scene(kind, num_views=3, n=300, width=93, height=70)
    _, true_alphas, _ = reference(scene)
    means2d, conics, colors, opacities = (scene[name].contiguous() for name in NAMES[:4])
    expected = gsplat.rasterize_to_pixels(
        means2d, conics, colors, opacities, 93, 70, 8, scene["starts"], scene["ids"], absgrad=False
    )  # fmt: skip
    truths = (scene["renders"], true_alphas)
    for ours, gsplats, true in zip(drawn_by_the_kernel(scene)[:2], expected, truths, strict=True):
        error = (ours.cpu() - true).abs()
        gsplats_error = (gsplats.cpu() - true).abs()
        assert error.mean() <= 1.2 * gsplats_error.mean() + 1e-6, (float(error.mean()), float(gsplats_error.mean()))
        assert (error > 1e-5).float().mean() <= 1.2 * (gsplats_error > 1e-5).float().mean() + 1e-3
        assert error.max() <= 2 * gsplats_error.max() + 0.005


@pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat's kernels need CUDA")
@pytest.mark.parametrize("kind", TOLERANCES)
def test_gradients_are_as_close_to_float64_as_gsplats(kind):
    """Norms are compared: rounding moves a few pairs over a cut-off in either's passes, and single values with them.

    Where ours may err more than gsplat's, it is by what the module states.
    """
    scene = make_scene(kind, num_views=2, n=300, width=93, height=70)
    expected, _, _ = reference(scene)
    errors = []
    for ours in (True, False):
        means2d, conics, colors, opacities = inputs = [scene[name].clone().requires_grad_() for name in NAMES[:4]]
        lists = scene["starts"], scene["ids"]
        if ours:
            outputs = compositing.rasterize_to_pixels(means2d, conics, colors, opacities, 93, 70, *lists, True)
        else:
            outputs = gsplat.rasterize_to_pixels(
                means2d, conics, colors, opacities, 93, 70, 8, *lists, absgrad=True
            )  # fmt: skip
        torch.autograd.backward(outputs, [scene["v_renders"], scene["v_alphas"]])
        gradients: dict[str, Any] = dict(
            zip(NAMES, [*(value.grad for value in inputs), means2d.absgrad], strict=True)
        )  # fmt: skip
        of_run = {}
        for name, value in expected.items():
            difference = gradients[name].double().cpu() - value
            of_run[name] = float(difference.norm() / value.norm())
        errors.append(of_run)
    print(kind, *errors)
    stated = {"absgrad": 1e-4}
    if kind == "tiny":
        stated = {"absgrad": 3e-4, "conics": 1e-6 / TINY**2}
    for name, error in errors[0].items():
        assert error < max(2 * errors[1][name], stated.get(name, 1e-5)), (name, error, errors[1][name])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat's kernels need CUDA")
@pytest.mark.parametrize(("render_mode", "max_off_axis"), [("RGB", 0.0), ("RGB+ED", 0.0), ("RGB", 0.7)])
def test_rasterization_equals_gsplats_own(monkeypatch, render_mode, max_off_axis):
    monkeypatch.setattr(backend_gsplat, "TILE_SIZE", kernels.TILE_SIZE)  # gsplat 1.4 cuts off at borders of tiles
    scene = {name: value.float().cuda() for name, value in random_scene(3000, 128, seed=0).items()}
    del scene["weights"]
    shared = {"width": 128, "height": 128, "sh_degree": 3, "render_mode": render_mode, "absgrad": False}
    images = [rasterization(**scene, **shared, max_off_axis=max_off_axis, backend="triton")]
    images.append(rasterization(**scene, **shared, max_off_axis=max_off_axis, backend="gsplat"))
    if max_off_axis == 0:
        images.append(gsplat.rasterization(**scene, **shared, packed=False, tile_size=kernels.TILE_SIZE))
    (renders, alphas, _), *others = images
    # Rounding decides whether a Gaussian is drawn where its alpha is 1/255.
    for expected, expected_alphas, _ in others:
        for one, other in ((renders, expected), (alphas, expected_alphas)):
            different = (one - other).abs() > 1e-5 * (1 + other.abs())
            assert different.float().mean() < 1e-3
