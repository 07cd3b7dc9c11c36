"""The Triton kernels against torch code that does the same: on the GPU, or in Triton's interpreter without one."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import Any

import gsplat
import numpy as np
import pytest
import torch
from gsplat.cuda._torch_impl import _spherical_harmonics
from torch import Tensor
from torch.testing import assert_close

from helpers import forked_python, small_scenes
from helpers.closeness import assert_within, assert_within_peak
from helpers.generators import seeded
from helpers.gsplat_like import rasterization
from helpers.rendered_scene import random_scene
from sadgs_ns import kernels
from sadgs_ns.method import losses, structure_tensor
from sadgs_ns.method.quantization import quantize
from sadgs_ns.method.screen_gradients import accumulate_gradients, empty_gradients
from sadgs_ns.method.statistics import STATISTICS, Statistic, empty_statistics, observe, observed_eta
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor
from sadgs_ns.render import backend_gsplat
from sadgs_ns.render.activations import activate
from sadgs_ns.render.off_axis import cull_off_axis
from sadgs_ns.training.step.optimizers import AdamUpdate, FusedAdam

triton = pytest.importorskip("triton", reason="Triton is not installed")
activations = pytest.importorskip("sadgs_ns.kernels.activations", reason="Triton is not installed")
quantization = pytest.importorskip("sadgs_ns.kernels.quantization", reason="Triton is not installed")
adam = pytest.importorskip("sadgs_ns.kernels.adam", reason="Triton is not installed")
structure = pytest.importorskip("sadgs_ns.kernels.structure_tensor", reason="Triton is not installed")
harmonics = pytest.importorskip("sadgs_ns.kernels.harmonics", reason="Triton is not installed")
observation = pytest.importorskip("sadgs_ns.kernels.statistics", reason="Triton is not installed")
photometric = pytest.importorskip("sadgs_ns.kernels.losses", reason="Triton is not installed")
screen_gradients = pytest.importorskip("sadgs_ns.kernels.screen_gradients", reason="Triton is not installed")
tiles = pytest.importorskip("sadgs_ns.kernels.tiles", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
fused_photometric_loss = partial(photometric.photometric_loss, window=losses.WINDOW)


def recorded(monkeypatch: pytest.MonkeyPatch, module: Any, *names: str) -> list[str]:
    """A list of the functions of a module that are called from now on: no reference may be compared with itself."""
    calls: list[str] = []
    for name in names:
        run = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *a, name=name, run=run, **o: calls.append(name) or run(*a, **o))
    return calls


@pytest.mark.hard_case("pixels where both images agree", "L1 has a kink there; its gradient is 0, as torch's")
@pytest.mark.parametrize("shape", [(2, 21, 47, 3), (1, 11, 11, 3), (1, 20, 60, 3), (1, 40, 13, 3)], ids=str)
def test_loss_and_gradient_equal_the_float64_reference(shape):
    generator = seeded(0)
    target = torch.rand(shape, generator=generator)
    noise = 0.1 * torch.randn(shape, generator=generator)
    noise[:, : shape[1] // 2] = 0  # where both images agree, L1 has a kink: its gradient there is 0
    results = []
    for function, dtype in ((fused_photometric_loss, torch.float32), (losses.photometric_loss, torch.float64)):
        y = target.to(DEVICE, dtype)
        x = (target + noise).to(DEVICE, dtype).requires_grad_()
        parts = torch.linspace(-0.1, 0.3, 7).to(DEVICE, dtype).requires_grad_()
        loss, psnr = function(x, y, ssim_lambda=0.3, l2_lambda=1.5, parts=parts)
        (3 * loss).backward()
        assert x.grad is not None
        assert parts.grad is not None
        assert parts.grad.tolist() == [3.0] * 7
        results.append((loss.detach().double(), psnr.double(), x.grad.double()))
    fast, reference = results
    assert not torch.equal(reference[2], torch.zeros_like(reference[2]))
    assert_within(fast[0], reference[0], 2e-6)
    assert_within(fast[1], reference[1], 1e-5)
    assert_within_peak(fast[2], reference[2], 5e-5)


def test_the_loss_does_not_depend_on_how_many_rows_a_program_handles(monkeypatch):
    generator = seeded(0)
    target = torch.rand((1, 35, 12, 3), generator=generator).to(DEVICE)
    results = []
    for programs in (1, 1000):  # One of 35 rows, and three of at most 16
        monkeypatch.setattr(photometric, "_PROGRAMS", programs)
        x = (0.9 * target).requires_grad_()
        loss, psnr = fused_photometric_loss(x, target, ssim_lambda=0.3, l2_lambda=1.5)
        loss.backward()
        results.append([loss.detach(), psnr, x.grad])
    for of_one, of_three in zip(*results, strict=True):
        assert_within_peak(of_one, of_three, 1e-6)


@pytest.mark.parametrize("size", [(1, 11, 33), (4, 532, 2397), (1, 1060, 4800), (2, 3000, 12000)], ids=str)
def test_programs_of_the_loss_cover_the_images_and_run_at_the_same_time(size):
    views, height, row = size
    (columns, strips, of_views), rows = photometric._strips(*size)
    assert columns * photometric._COLUMNS >= row
    assert strips * rows >= height
    assert of_views == views
    assert columns * strips * views <= photometric._PROGRAMS


def test_the_loss_reads_bytes_as_the_floats_that_they_stand_for():
    generator = seeded(0)
    images = torch.randint(0, 256, (2, 21, 47, 3), generator=generator, dtype=torch.uint8).to(DEVICE)
    predicted = torch.rand((2, 21, 47, 3), generator=generator).to(DEVICE)
    results = []
    for target in (images, images * torch.tensor(1 / 255)):
        x = predicted.clone().requires_grad_()
        loss, psnr = fused_photometric_loss(x, target, ssim_lambda=0.3, l2_lambda=1.5)
        loss.backward()
        results.append([loss.detach(), psnr, x.grad])
    # On a GPU the product with 1/255 is fused with the sum that follows it, and not rounded in between.
    rounding = 1e-6 if DEVICE.type == "cuda" else 0.0
    for of_bytes, of_floats in zip(*results, strict=True):
        assert_within_peak(of_bytes, of_floats, rounding)
    with kernels.triton_switched(False):
        slow = losses.photometric_loss(predicted, images, ssim_lambda=0.3, l2_lambda=1.5)
    actual = results[0][:2]
    assert_close(actual, list(slow), atol=1e-5, rtol=1e-5)


def test_flat_images_have_a_finite_gradient():
    x = torch.zeros((1, 16, 16, 3), device=DEVICE, requires_grad=True)
    loss, _ = fused_photometric_loss(x, torch.zeros_like(x), ssim_lambda=0.2, l2_lambda=2.0)
    loss.backward()
    assert x.grad is not None
    assert abs(float(loss)) < 1e-6
    assert torch.isfinite(x.grad).all()


@pytest.mark.parametrize("function", [fused_photometric_loss, losses.photometric_loss])
def test_psnr_carries_no_gradient(function):
    x = torch.rand((1, 12, 12, 3), generator=seeded(0)).to(DEVICE).requires_grad_()
    _, psnr = function(x, torch.zeros_like(x), ssim_lambda=0.2, l2_lambda=2.0)
    assert psnr > 0
    assert not psnr.requires_grad


@pytest.mark.parametrize("value", [0.0, 1e-9, 1e15, math.inf, math.nan])
def test_psnr_of_extreme_errors_is_torchs(value):
    x = torch.zeros((1, 12, 12, 3), device=DEVICE)
    x[0, 3, 4, 1] = value
    with np.errstate(all="ignore"):  # Triton's interpreter computes with numpy
        _, actual = fused_photometric_loss(x, torch.zeros_like(x), ssim_lambda=0.2, l2_lambda=2.0)
    with kernels.triton_switched(False):
        _, expected = losses.photometric_loss(x, torch.zeros_like(x))
    assert_close(actual, expected, rtol=1e-6, atol=0, equal_nan=True)


def test_partial_sums_are_added_as_accurately_as_torch_adds_them():
    """Their numbers are no multiple of what is added at once, and several times as many."""
    generator = seeded(0)
    sums = torch.rand((3, 12150), generator=generator)  # SSIM, and absolute and squared differences
    parts = torch.rand(5000, generator=generator) / 5e6
    loss = torch.zeros((), device=DEVICE)
    psnr = torch.zeros((), device=DEVICE)
    n = 12150 * 1024
    weights = 0.8 / n, 0.2 / n, 2.0 / n
    photometric._finish[1,](
        sums.to(DEVICE), parts.to(DEVICE), loss, psnr,
        n, 12150, 5000, 0.2, *weights, photometric._LANES,
    )  # fmt: skip
    of_ssim, l1, l2, more = (float(values.double().sum()) for values in (*sums, parts))
    expected = weights[0] * l1 + 0.2 - weights[1] * of_ssim + weights[2] * l2 + more
    assert float(loss) == pytest.approx(expected, abs=3e-8)
    assert float(psnr) == pytest.approx(-10 * math.log10(l2 / n), rel=1e-6)


@pytest.mark.hard_case(
    "a process started with `SADGS_TRITON=0`", "uses no Triton kernel, on whichever device it computes"
)
def test_the_environment_switches_the_kernels_off():
    code = "import importlib, torch; from sadgs_ns import kernels; importlib.reload(kernels); "  # Reads the switch
    code += "kernels.available = lambda device: True; "
    code += "print(kernels.switched_off(), kernels.use_triton(torch.device('cuda')), kernels.use_triton(torch.ones(1)))"
    for value, expected in (("0", "True False False"), ("1", "False True True")):
        environment = {**os.environ, kernels.SWITCH: value}
        process = forked_python.python(code, environment)
        assert process.stdout.split("\n")[0] == expected, process.stderr


def test_a_test_can_switch_the_kernels_either_way_but_doubles_never_reach_them():
    floats = torch.ones(1)
    doubles = torch.ones(1, dtype=torch.float64)
    for on in (True, False):
        with kernels.triton_switched(on):
            assert kernels.use_triton(floats) is kernels.use_triton(floats.device) is on
            assert not kernels.use_triton(doubles)
    assert kernels.use_triton(floats.device) is kernels.available(floats.device)


def test_kernels_are_for_the_current_cuda_device_only(monkeypatch):
    monkeypatch.setattr(kernels, "_compiles", lambda device: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    names = ("cpu", "cuda", "cuda:0", "cuda:1")
    actual = [kernels.available(torch.device(name)) for name in names]
    assert actual == [False, True, False, True]


@pytest.fixture
def nothing_tried(monkeypatch):
    """A process in which nobody has asked for the kernels."""
    monkeypatch.setattr(kernels, "_working", set())
    monkeypatch.setattr(kernels, "_asked", Counter())
    kernels._has_triton.cache_clear()
    yield
    kernels._has_triton.cache_clear()


def test_a_triton_that_compiles_is_found(nothing_tried):
    assert kernels._compiles(DEVICE)


@pytest.mark.hard_case("a trial of Triton that fails once", "told once, tried again")
def test_a_failure_is_told_once_and_tried_again_and_a_success_is_kept(nothing_tried, monkeypatch):
    """The trial fails twice, as while another program fills the memory, and is made at questions 1, 2 and 4."""
    outcomes = [RuntimeError("CUDA error: out of memory.\nCompile with …"), RuntimeError("out of memory"), None]

    def run_trial(device):
        outcome = outcomes.pop(0)
        if outcome is not None:
            raise outcome

    monkeypatch.setattr("sadgs_ns.kernels.trial.run_trial", run_trial)
    with pytest.warns(
        UserWarning, match=r"do not run here \(CUDA error: out of memory\); they are tried again"
    ) as told:
        answers = [kernels._compiles(DEVICE) for _ in range(20)]
    assert answers == [False] * 3 + [True] * 17
    assert len(told) == 1
    assert not outcomes


@pytest.mark.hard_case("a trial of Triton that fails for good", "told once, tried again ever more rarely")
def test_a_failure_that_lasts_is_tried_at_ever_longer_intervals(nothing_tried, monkeypatch):
    trials = []
    monkeypatch.setattr("sadgs_ns.kernels.trial.run_trial", lambda device: trials.append(device) or 1 / 0)
    with pytest.warns(UserWarning, match=r"\(division by zero\)"):
        for _ in range(1000):
            assert not kernels._compiles(DEVICE)
    assert len(trials) == 10


def test_an_old_triton_is_left_alone_and_named(nothing_tried, monkeypatch):
    monkeypatch.setattr("triton.__version__", "3.4.0")
    with pytest.warns(UserWarning, match=r"do not run here: 3\.4\.0 is older than 3\.5 \(torch 2\.9\);") as told:
        for _ in range(10):
            assert not kernels._compiles(DEVICE)
    assert len(told) == 1


@pytest.mark.parametrize("shape", [(2, 3, 21, 34), (1, 1, 1, 40), (1, 2, 5, 3)], ids=str)
@pytest.mark.parametrize("axis", [2, 3])
def test_convolution_equals_torchs_in_float64(shape, axis):
    generator = seeded(0)
    image = torch.randn(shape, generator=generator)
    kernel = torch.randn(9, generator=generator)
    actual = structure.correlate(image.to(DEVICE), kernel.to(DEVICE), axis)
    weight = kernel.double().view((1, 1, -1, 1) if axis == 2 else (1, 1, 1, -1)).expand(shape[1], -1, -1, -1)
    padding = (4, 0) if axis == 2 else (0, 4)
    expected = torch.nn.functional.conv2d(image.double(), weight, padding=padding, groups=shape[1])
    assert_close(actual.cpu().double(), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    ("masked", "energy_blur", "epsilon"),
    [(False, 0.0, None), (False, 2.0, 1e-3), (True, 0.0, 1e-3), (True, 2.0, None), ("transposed", 2.0, None)],
)
def test_structure_tensors_are_the_same_with_the_kernels(monkeypatch, masked, energy_blur, epsilon):
    images = torch.rand((2, 9, 14, 3), generator=seeded(0)).to(DEVICE)
    masks = torch.ones((2, 9, 14), dtype=torch.bool, device=DEVICE) if masked else None
    if masks is not None:
        masks[0, 3:6, 5:7] = False
        if masked == "transposed":  # the same in memory of another order
            masks = masks.mT.contiguous().mT
    monkeypatch.setattr("sadgs_ns.method.structure_tensor.NUM_LEVELS", 2)
    if DEVICE.type == "cpu":  # the interpreter also computes what a block has beyond the image
        monkeypatch.setattr(structure, "_TILES", {2: (16, 16), 3: (16, 16)})
        monkeypatch.setattr(structure, "_PIXELS", 64)
    monkeypatch.setattr(structure_tensor, "TRUNCATION", 1.5)  # Shorter kernels, which must not be remembered.
    monkeypatch.setattr(structure_tensor, "gaussian_kernel", structure_tensor.gaussian_kernel.__wrapped__)
    options = {"energy_blur": energy_blur, "epsilon": epsilon}
    expected = multiscale_structure_tensor(images.double(), masks, **options)
    monkeypatch.setattr(kernels, "available", lambda device: True)
    calls = recorded(monkeypatch, structure, "correlate", "differentiate", "aggregate")
    actual = multiscale_structure_tensor(images, masks, **options)
    assert set(calls) == {"correlate", "differentiate", "aggregate"}
    atol = 1e-5 * float(expected.nan_to_num().abs().max())
    assert_close(actual.double(), expected, atol=atol, rtol=1e-4, equal_nan=True)


def test_quantized_tensors_are_the_references_or_their_neighbours(monkeypatch):
    tensor = torch.rand((3, 100, 3), generator=seeded(0)) ** 8 * torch.tensor([16.0, 1.0, 16.0])
    tensor[0, :4] = torch.tensor([[0.0, 0, 0], [64, 0, 1e-12], [0, 0.1, 1], [8, -9, 8]])
    tensor[1, :4] = torch.tensor([[math.nan] * 3, [math.nan, 0, 1], [1, math.nan, 1], [1, 0, math.nan]])  # masked
    with kernels.triton_switched(False):
        expected = quantize(tensor).int()
    calls = recorded(monkeypatch, quantization, "quantize")
    with kernels.triton_switched(True):
        actual = quantize(tensor.to(DEVICE)).cpu().int()
    assert len(calls) == 1
    assert (actual - expected).abs().max() <= 1
    assert (actual != expected).float().mean() < 0.01
    assert torch.equal(actual[:2, :4], expected[:2, :4])


@pytest.mark.parametrize("per_axis_radii", [False, True], ids=["gsplat 1.4", "gsplat 1.5"])
@pytest.mark.parametrize(("degree", "num_others"), [(0, 15), (1, 15), (2, 15), (3, 15), (3, 24)])
def test_colours_and_gradients_equal_gsplats_float64_harmonics(monkeypatch, degree, num_others, per_axis_radii):
    generator = seeded(degree)
    shapes = (40, 3), (40, 3), (40, num_others, 3), (3, 3), (3, 40, 3)
    *values, centres, weights = (torch.randn(shape, generator=generator) for shape in shapes)
    viewmats = small_scenes.cameras_at(centres)
    radii = torch.randint(-1, 9, (3, 40, 2), generator=generator)
    radii = radii if per_axis_radii else radii[..., 0].contiguous()
    drawn = (radii > 0).all(dim=-1) if per_axis_radii else radii > 0
    fast = [value.to(DEVICE, copy=True).requires_grad_() for value in values]
    colors = harmonics.colors_from_harmonics(degree, *fast, viewmats.to(DEVICE), radii.to(DEVICE))
    v_colors = (weights * drawn[..., None]).to(DEVICE)
    if per_axis_radii:  # as compositing returns them
        v_colors = torch.nn.functional.pad(v_colors, (6, 3))[..., 6:9]
    # What is not written keeps what was in the memory before.
    monkeypatch.setattr(torch, "empty_like", lambda tensor: torch.full_like(tensor, math.nan))
    colors.backward(v_colors)
    positions = small_scenes.centres_of(viewmats)
    assert_close(positions[:, 0].float(), centres, atol=1e-5, rtol=1e-5)
    slow = means, first, rest = [value.double().requires_grad_() for value in values]
    coefficients = torch.cat([first[:, None], rest], dim=1).expand(3, -1, -1, -1)
    expected = (_spherical_harmonics(degree, means - positions, coefficients) + 0.5).clamp_min(0)
    (expected * weights * drawn[..., None]).sum().backward()
    assert_close(colors[drawn.to(DEVICE)].double().cpu(), expected[drawn], atol=2e-6, rtol=2e-6)
    assert (expected == 0).any()
    assert (expected > 0).any()
    for actual, reference in zip(fast, slow, strict=True):
        assert actual.grad is not None
        gradient = torch.zeros_like(reference) if reference.grad is None else reference.grad
        assert_close(actual.grad.double().cpu(), gradient, atol=2e-5, rtol=2e-5)


@pytest.mark.parametrize("per_axis_radii", [False, True], ids=["gsplat 1.4", "gsplat 1.5"])
@pytest.mark.parametrize("kept", [Tensor.half, quantize], ids=["float16", "8 bits"])
def test_observation_equals_the_reference(monkeypatch, kept, per_axis_radii):
    n = 150
    width = 40
    height = 30
    params = {name: p.detach() for name, p in small_scenes.random_params(n).items()}
    params["scales"][::9] += 3  # reaches over the border
    params["means"][::13, 2] = -1  # behind the camera
    viewmats, Ks = small_scenes.camera(width, height, focal=40.0)
    viewmats = viewmats.repeat(2, 1, 1)
    Ks = Ks.repeat(2, 1, 1)
    viewmats[1, :3, :3] = torch.linalg.qr(torch.eye(3) + 0.1)[0]
    viewmats[1, :3, 3] = torch.tensor([0.1, -0.2, 0.5])
    _, _, info = small_scenes.splat(
        {name: torch.nn.Parameter(p) for name, p in params.items()}, viewmats, Ks, width, height
    )
    radius = info["radii"] if info["radii"].dim() == 2 else info["radii"].amin(dim=-1)
    info["radii"] = torch.stack([radius, 2 * radius], dim=-1) if per_axis_radii else radius
    generator = seeded(0)
    factors = torch.randn((2, height, width, 2, 2), generator=generator)
    tensors = factors @ factors.mT
    info |= {"viewmats": viewmats, "Ks": Ks}
    tensors = torch.stack([tensors[..., 0, 0], tensors[..., 0, 1], tensors[..., 1, 1]], -1)
    tensors[:, :, 18:22] = math.nan  # masked
    info["structure_tensors"] = kept(tensors)
    # Whoever adds a statistic adds it in one place.
    monkeypatch.setitem(STATISTICS, "log_sum", Statistic((3,), lambda values, eta: values.add_(eta.log1p().nansum(0))))
    on_device = {name: torch.nn.Parameter(value.to(DEVICE)) for name, value in params.items()}
    info = {k: value.detach().to(DEVICE) if isinstance(value, Tensor) else value for k, value in info.items()}
    jitters = torch.rand((2, 2, n, 2), generator=generator).to(DEVICE)
    results = []
    calls = recorded(monkeypatch, observation, "observed_eta")
    for fused in (False, True):
        statistics = empty_statistics(n, torch.device(DEVICE))
        with kernels.triton_switched(fused):
            for jitter in jitters:
                observe(statistics, on_device, info, jitter=jitter)
            results.append((observed_eta(on_device, info, jitters[0]), statistics))
        assert len(calls) == 3 * fused
    (expected, reference), (eta, fast) = results
    assert_close(eta, expected, atol=1e-6, rtol=2e-5, equal_nan=True)
    assert torch.equal(eta.isnan().any(dim=2), eta.isnan().all(dim=2))
    assert 0 < eta.isnan().sum() < eta.numel()
    assert reference["n_total"].sum() > n / 2
    assert reference["n_low"].sum() > 0
    assert reference["n_high"].sum() > 0
    assert (reference["n_total"] == 0).any()
    assert reference["log_sum"].sum() > 0
    assert fast.keys() == reference.keys() == STATISTICS.keys()
    for name in STATISTICS:
        if name.startswith("n_"):
            assert torch.equal(fast[name], reference[name]), name
        assert_close(fast[name], reference[name], atol=1e-6, rtol=2e-5)


@pytest.mark.parametrize("layout", ["parts of rows", "apart", "transposed"])
@pytest.mark.parametrize("per_axis_radii", [False, True], ids=["gsplat 1.4", "gsplat 1.5"])
def test_screen_gradients_add_up_as_in_the_reference(monkeypatch, per_axis_radii, layout):
    views = 3
    n = 300
    generator = seeded(0)
    rows = torch.randn((views, n, 12), generator=generator)
    rows[0, 1, :2] = math.nan
    rows[1, 2, 10] = math.nan
    rows[2, 3, 9] = math.inf
    radii = torch.randint(-1, 4, (views, n, 2), generator=generator, dtype=torch.int32)
    radii[:, 1:4] = 1
    radii[:, 5] = 0
    radii = radii if per_axis_radii else radii[..., 1].contiguous()
    rows = rows.to(DEVICE)  # before it is cut: a copy of a part would lie apart
    parts = [rows[..., :2], rows[..., 9:11]]
    if layout == "apart":
        parts = [part.contiguous() for part in parts]
    elif layout == "transposed":
        parts = [part.mT.contiguous().mT for part in parts]
    results = []
    calls = recorded(monkeypatch, screen_gradients, "accumulate_gradients")
    for fused in (False, True):
        means2d = torch.zeros((views, n, 2), device=DEVICE)
        means2d.grad, means2d.absgrad = parts  # type: ignore[attr-defined]
        info = {"means2d": means2d, "radii": radii.to(DEVICE), "width": 64, "height": 48}
        sums = empty_gradients(n, DEVICE)
        for _ in range(2):
            with kernels.triton_switched(fused):
                accumulate_gradients(sums, info, num_views=views)
        results.append(sums)
        assert len(calls) == 2 * fused
    reference, fast = results
    actual = set(reference["grad_count"].unique().tolist())
    assert actual == {0, 2, 4, 6}
    assert reference["grad2d"][5] == 0
    assert reference["absgrad2d"].isinf().nonzero().tolist() == [[3]]
    assert not reference["grad2d"].isnan().any()
    assert torch.equal(fast.pop("grad_count"), reference["grad_count"])
    for name, value in fast.items():
        assert_close(value, reference[name], atol=1e-5, rtol=1e-6)


@pytest.mark.parametrize("used", ["scales", "opacities", "penalty", "scales opacities penalty"])
@pytest.mark.parametrize("n", [1, 37, 1024, 2050])
def test_activations_and_their_gradients_equal_torchs_in_float64(monkeypatch, n, used):
    generator = seeded(n)
    log_scales = torch.randn((n, 3), generator=generator)
    logits = torch.randn((n, 1), generator=generator)
    weights = torch.randn((n, 12), generator=generator)
    logits[0] = -12.0
    log_scales[0] = torch.tensor([-9.0, 3.0, 0.0])
    penalty = 0.3 if "penalty" in used else 0.0
    calls = recorded(monkeypatch, activations, "activate")
    results = []
    for fused, dtype in ((True, torch.float32), (False, torch.float64)):
        inputs = [value.to(DEVICE, dtype, copy=True).requires_grad_() for value in (log_scales, logits)]
        with kernels.triton_switched(fused):
            scales, opacities, penalized = activate(inputs[0], inputs[1], penalty)
        assert scales.shape == (n, 3)
        assert opacities.shape == (n,)
        assert (penalized is None) is (penalty == 0)
        rows = weights.to(DEVICE, dtype)
        outputs = {"scales": (scales, rows[:, :3]), "opacities": (opacities, rows[:, 5])}  # as compositing returns them
        if penalized is not None:
            outputs["penalty"] = penalized, torch.full_like(penalized, 1.7)
        chosen = [outputs[name] for name in used.split()]
        torch.autograd.backward([output for output, _ in chosen], [gradient for _, gradient in chosen])
        whole = [scales, opacities] if penalized is None else [scales, opacities, penalized.sum()]
        results.append([value.detach().double() for value in whole])
        results[-1] += [
            torch.zeros_like(value).double() if value.grad is None else value.grad.double() for value in inputs
        ]
    assert len(calls) == 1
    assert_close(*results, atol=1e-9, rtol=3e-6)


ADAM = {"betas": (0.9, 0.999), "eps": 1e-15}
OURS = {**ADAM, "max_gradient": 1e18}
WIDTHS = [(3,), (15, 3), (), (4,), (1,)]  # a row of each parameter
LRS = (0.1, 0.01, 0.3, 0.003, 0.02)


def with_moments(start: list[Tensor]) -> tuple[tuple[Tensor, ...], ...]:
    """Copies of parameters, and their first and second moments of zeros."""
    zeros = [tuple(torch.zeros_like(p, device=DEVICE) for p in start) for _ in range(2)]
    return tuple(p.to(DEVICE).clone() for p in start), *zeros


def factors(steps: Sequence[int], lrs: Sequence[float]) -> Tensor:
    """Of the updates with these numbers."""
    columns = [adam.rate_and_scale(step, lr, ADAM["betas"]) for step, lr in zip(steps, lrs, strict=True)]
    return torch.tensor(columns, device=DEVICE).T.contiguous()


@pytest.mark.parametrize("rows", [0, 1, 37, 1024], ids="{} Gaussians".format)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-5), (torch.float32, 2e-5)], ids=str)
def test_adam_in_one_launch_equals_torchs_and_one_launch_for_each_parameter(rows, dtype, tolerance):
    generator = seeded(0)
    start = [torch.randn((rows, *width), generator=generator) for width in WIDTHS]
    expected = [torch.nn.Parameter(p.to(dtype, copy=True)) for p in start]
    groups = [{"params": [p], "lr": lr} for p, lr in zip(expected, LRS, strict=True)]
    optimizer = torch.optim.Adam(groups, **ADAM)
    together = with_moments(start)
    separate = with_moments(start)
    noted = torch.zeros(1, device=DEVICE)
    for step in range(1, 4):
        gradients = tuple(torch.randn(p.shape, generator=generator) for p in start)
        for parameter, gradient in zip(expected, gradients, strict=True):
            parameter.grad = gradient.to(dtype)
        optimizer.step()
        gradients = tuple(gradient.to(DEVICE) for gradient in gradients)
        adam.adam_step(together[0], gradients, *together[1:], factors([step] * 5, LRS), noted, **OURS)
        for gradient, lr, (p, m, v) in zip(gradients, LRS, zip(*separate, strict=True), strict=True):
            adam.adam_step((p,), (gradient,), (m,), (v,), factors([step], [lr]), noted, **OURS)
    assert float(noted) == 0
    for one, other in zip(together, separate, strict=True):
        if torch.device("cpu") == DEVICE:
            assert all(map(torch.equal, one, other))
        else:  # compiled, a product and a sum may round once in one kernel and twice in another
            assert_close(one, other, atol=1e-7, rtol=2e-6)
    for actual, parameter in zip(together[0], expected, strict=True):
        assert_close(actual.to("cpu", dtype), parameter.detach(), atol=tolerance, rtol=tolerance)


@pytest.mark.parametrize("flags", [[], [0], [1], [0, 1], [1, 1]])
def test_an_update_of_a_step_that_overflowed_changes_nothing(flags):
    parameters = with_moments([torch.ones((37, *width)) for width in WIDTHS])
    gradients = tuple(torch.full_like(p, math.nan) for p in parameters[0])
    noted = torch.zeros(1, device=DEVICE)
    overflowed = tuple(torch.tensor([flag], device=DEVICE) for flag in flags)
    adam.adam_step(parameters[0], gradients, *parameters[1:], factors([1] * 5, LRS), noted, overflowed, **OURS)
    drawn = not flags or 0 in flags
    assert bool(noted.isnan()) == drawn, "nothing is noted, either"
    gradients = tuple(torch.ones_like(p) for p in parameters[0])
    adam.adam_step(parameters[0], gradients, *parameters[1:], factors([1] * 5, LRS), noted, overflowed, **OURS)
    for values, start in zip(parameters, (1, 0, 0), strict=True):
        for value in values:
            assert bool((value == start).all()) != drawn


def test_adam_counts_each_parameters_own_updates():
    start = [torch.linspace(-1, 1, 50), torch.linspace(1, 2, 50)]
    expected = [torch.nn.Parameter(p.double()) for p in start]
    optimizers = [torch.optim.Adam([p], lr=0.1, eps=1e-15) for p in expected]
    actual = with_moments(start)
    noted = torch.zeros(1, device=DEVICE)
    for step in range(1, 5):
        for k in (0, 1) if step > 2 else (0,):  # the other one's gradients come late
            expected[k].grad = torch.full_like(expected[k], step)
            optimizers[k].step()
        gradients = tuple(torch.full_like(p, step) for p in actual[0])
        if step > 2:
            both = factors([step, step - 2], [0.1, 0.1])
            adam.adam_step(actual[0], gradients, *actual[1:], both, noted, **OURS)
        else:
            first = [values[:1] for values in (actual[0], gradients, *actual[1:])]
            adam.adam_step(*first, factors([step], [0.1]), noted, **OURS)
    for p, q in zip(actual[0], expected, strict=True):
        assert_close(p.double().cpu(), q.detach(), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -1e30])
@pytest.mark.parametrize("k", range(len(WIDTHS)))
def test_a_gradient_that_is_not_finite_is_noted_and_left_out_of_its_parameter_alone(k, wrong):
    start = [torch.ones((37, *width)) for width in WIDTHS]
    results = []
    for value in (0.0, wrong):
        parameters = with_moments(start)
        noted = torch.zeros(1, device=DEVICE)
        gradients = tuple(torch.full_like(p, 0.5) for p in parameters[0])
        gradients[k].flatten()[-1:] = value  # within the block that is not full
        adam.adam_step(parameters[0], gradients, *parameters[1:], factors([1] * 5, LRS), noted, **OURS)
        actual = bool(noted.isnan())
        assert actual == (value != 0.0)
        results.append([tensor for tensors in parameters for tensor in tensors])
    assert all(map(torch.equal, *results))


def test_an_update_keeps_torchs_state_while_it_runs_the_kernel(monkeypatch):
    states = []
    for triton in (False, True):
        monkeypatch.setattr(kernels, "available", lambda device, triton=triton: triton)
        start = torch.linspace(-1, 1, 50, device=DEVICE)
        adam_of = {"a": FusedAdam([torch.nn.Parameter(start.clone())], lr=0.01)}
        noted = torch.zeros(1, device=DEVICE)
        for _ in range(3):
            update = AdamUpdate(adam_of)
            update.launch({"a": update.parameters["a"].detach().clone()}, update.factors().to(DEVICE), noted)
        restored = FusedAdam([torch.nn.Parameter(update.parameters["a"].detach().clone())], lr=0.01)
        restored.load_state_dict(adam_of["a"].state_dict())
        again = AdamUpdate({"a": restored})
        again.launch({"a": torch.ones(50, device=DEVICE)}, again.factors().to(DEVICE), noted)
        states.append((update.parameters["a"], again.parameters["a"], adam_of["a"].state_dict()["state"]))
    (*slow, slow_state), (*fast, fast_state) = states
    assert_close(fast, slow, atol=1e-6, rtol=1e-6)
    assert slow_state.keys() == fast_state.keys() == {0}
    assert slow_state[0].keys() == fast_state[0].keys()


def projected_gaussians(num_views: int, n: int, width: int, height: int) -> dict[str, Tensor]:
    """Projected Gaussians of all sizes, of which some are long and thin, faint, culled or off the image."""
    generator = seeded(0)

    def random(*shape: int) -> Tensor:
        return torch.rand((num_views, n, *shape), generator=generator)

    factors = torch.randn((num_views, n, 2, 2), generator=generator) * torch.exp(4 * random(1, 1) - 1)
    factors[:, ::4, :, 1] *= 1e-3
    covariances = factors @ factors.mT + 0.3 * torch.eye(2)
    inverses = torch.linalg.inv(covariances.double()).float()
    opacities = random()
    opacities[:, ::7] = 0.003
    radii = torch.ceil(3 * torch.linalg.eigvalsh(covariances)[..., -1].sqrt()).int()
    radii[:, ::11] = 0
    conics = torch.stack([inverses[..., 0, 0], inverses[..., 0, 1], inverses[..., 1, 1]], dim=-1)
    conics[:, ::11] = torch.nan  # what gsplat leaves unwritten
    return {
        "means2d": random(2) * torch.tensor([width, height]) * 1.4 - torch.tensor([width, height]) * 0.2,
        "radii": radii,
        "depths": random(),
        "conics": conics,
        "opacities": opacities,
    }


@pytest.mark.parametrize(("tile_size", "radius_per_axis"), [(8, False), (16, True)])
def test_tiles_list_the_gaussians_that_reach_them_and_hardly_more(tile_size, radius_per_axis):
    width = 75
    height = 50
    n = 120
    gaussians = projected_gaussians(2, n, width, height)
    radii = gaussians["radii"][..., None].expand(-1, -1, 2).float()  # [C, N, 2]
    if radius_per_axis:  # as gsplat 1.5
        gaussians["radii"] = gaussians["radii"][..., None] * torch.tensor([1, 2], dtype=torch.int32)
        radii = gaussians["radii"].float()
    on_device = {name: value.to(DEVICE) for name, value in gaussians.items()}
    starts, ids, _ = tiles.intersect_tiles(**on_device, width=width, height=height, tile_size=tile_size).lists()
    rows = math.ceil(height / tile_size)
    columns = math.ceil(width / tile_size)
    assert starts.shape == (2, rows, columns)
    lists = ids.cpu().tensor_split(starts.cpu().flatten().tolist()[1:])
    n_listed = n_needed = n_square = 0
    for number, listed in enumerate(lists):
        view = number // (rows * columns)
        row = number // columns % rows
        column = number % columns
        depths = gaussians["depths"].flatten()[listed.long()]
        assert (depths.diff() >= 0).all()
        y, x = torch.meshgrid(torch.arange(tile_size) + 0.5, torch.arange(tile_size) + 0.5, indexing="ij")
        pixels = torch.stack([x + column * tile_size, y + row * tile_size], dim=-1).reshape(1, -1, 2)
        delta = (gaussians["means2d"][view, :, None] - pixels).double()  # [N, pixels, 2]
        a, b, c = gaussians["conics"][view].double()[..., None].unbind(dim=1)
        sigma = (a * delta[..., 0] ** 2 + c * delta[..., 1] ** 2) / 2 + b * delta[..., 0] * delta[..., 1]
        reaches = (gaussians["opacities"][view, :, None] * torch.exp(-sigma) >= 1 / 255).any(dim=1)
        low = ((gaussians["means2d"][view] - radii[view]) / tile_size).floor()
        high = ((gaussians["means2d"][view] + radii[view]) / tile_size).ceil()
        here = torch.tensor([column, row])
        in_square = (radii[view] > 0).all(dim=1) & (low <= here).all(dim=1) & (high > here).all(dim=1)
        needed = set((view * n + (reaches & in_square).nonzero().flatten()).tolist())
        assert len(listed) == len(set(listed.tolist()))
        assert needed <= set(listed.tolist()) <= set((view * n + in_square.nonzero().flatten()).tolist())
        n_listed = n_listed + len(listed)
        n_needed = n_needed + len(needed)
        n_square = n_square + int(in_square.sum())
    assert n_needed > 500
    assert n_listed < 1.02 * n_needed < 0.7 * n_square


def test_more_tiles_than_16_bits_number_are_listed_as_view_by_view():
    n = 40
    width = 1480  # 23,125 tiles a view, 69,375 in three
    height = 1000
    gaussians = {name: value.to(DEVICE) for name, value in projected_gaussians(3, n, width, height).items()}
    starts, ids, _ = tiles.intersect_tiles(**gaussians, width=width, height=height, tile_size=8).lists()
    assert starts.shape == (3, 125, 185)
    assert starts.numel() > 2**16
    parts = []
    for view in range(3):
        alone = {name: value[view : view + 1] for name, value in gaussians.items()}
        start, listed, _ = tiles.intersect_tiles(**alone, width=width, height=height, tile_size=8).lists()
        parts.append((start[0] + sum(len(ids) for _, ids in parts), listed + view * n))
    assert torch.equal(starts, torch.stack([start for start, _ in parts]))
    assert torch.equal(ids, torch.cat([listed for _, listed in parts]))
    assert len(ids) > 500


def test_a_gaussian_that_is_listed_in_parts_is_listed_as_by_one_lane(monkeypatch):
    """Also where a Gaussian has more parts than rows, whose last rows are few, and where programs share many parts."""
    gaussians = {name: value.to(DEVICE) for name, value in projected_gaussians(2, 60, 320, 240).items()}
    gaussians["radii"][:, 1] = 2000  # It covers all tiles.
    gaussians["conics"][:, 1] = torch.tensor([1e-6, 0.0, 1e-6])
    found = []
    for few, part, programs in ((10**9, 256, 8), (64, 256, 8), (0, 256, 8), (0, 16, 1)):
        monkeypatch.setattr(tiles, "_FEW_PAIRS", few)
        monkeypatch.setattr(tiles, "_PART_PAIRS", part)
        monkeypatch.setattr(tiles, "_PROGRAMS", programs)
        found.append(tiles.intersect_tiles(**gaussians, width=320, height=240, tile_size=8).lists())
    for lists in found[1:]:
        for one, other in zip(found[0], lists, strict=True):
            assert torch.equal(one, other)
    for g in (1, 61):
        assert (found[0][1] == g).sum() == 40 * 30
    assert len(found[0][1]) > 2 * 40 * 30 + 500


def listed_by_tile(lists: tuple[Tensor, ...], rows: int) -> list[list[int]]:
    """What gsplat's forward pass reads for each tile of the image, view by view."""
    starts, ids = (values.cpu() for values in lists[:2])
    places = starts.flatten().tolist()
    by_tile = [ids[begin:end].tolist() for begin, end in zip(places, [*places[1:], len(ids)], strict=True)]
    tiles_per_view = starts[0].numel()
    columns = starts.shape[2]
    return [listed for number, listed in enumerate(by_tile) if number % tiles_per_view < rows * columns]


@pytest.fixture
def few_programs(monkeypatch):
    """Each program handles more Gaussians than on a GPU, since the interpreter runs one program after the other."""
    if DEVICE.type == "cpu":
        monkeypatch.setattr(tiles, "_LANES", 128)


@pytest.mark.parametrize("per_axis_radii", [False, True], ids=["gsplat 1.4", "gsplat 1.5"])
@pytest.mark.parametrize(("num_views", "width", "height"), [(1, 75, 50), (3, 75, 50), (2, 64, 48)])
def test_lists_longer_than_needed_equal_the_exact_ones_tile_by_tile(
    few_programs, num_views, width, height, per_axis_radii
):
    """The last height is a multiple of a tile's: padding must not reach the image's last row of tiles there."""
    gaussians = projected_gaussians(num_views, 120, width, height)
    if per_axis_radii:
        gaussians["radii"] = gaussians["radii"][..., None].repeat(1, 1, 2)
    on_device = {name: value.to(DEVICE, copy=True) for name, value in gaussians.items()}
    pending = tiles.intersect_tiles(**on_device, width=width, height=height, tile_size=8)
    rows = math.ceil(height / 8)
    columns = math.ceil(width / 8)
    exact = pending.lists()
    num_pairs = len(exact[1])
    counts = pending.pair_counts
    views = exact[1].cpu() // 120  # Each view has 120 Gaussians.
    assert counts.wait() == torch.bincount(views, minlength=num_views).tolist()
    assert counts.ready()
    assert sum(counts.wait()) == num_pairs > 500
    for capacity in (num_pairs, num_pairs + 1, 2 * num_pairs):
        starts, ids, overflowed = pending.lists(capacity)
        assert overflowed.tolist() == [0]
        assert starts.shape == (num_views, rows + 1, columns)
        assert len(ids) == capacity
        assert starts.dtype == ids.dtype == torch.int32
        actual = listed_by_tile((starts, ids), rows)
        assert actual == listed_by_tile(exact, rows)
        assert starts.flatten()[-1] == num_pairs, "padding is valid and at the end"
        assert (ids[num_pairs:] == 0).all(), "padding is valid and at the end"
    assert torch.equal(on_device["radii"].cpu(), gaussians["radii"])


@pytest.mark.parametrize("per_axis_radii", [False, True], ids=["gsplat 1.4", "gsplat 1.5"])
@pytest.mark.parametrize("missing", [1, 400])
def test_lists_shorter_than_needed_are_empty_and_nothing_counts_as_drawn(few_programs, per_axis_radii, missing):
    gaussians = projected_gaussians(2, 120, 75, 50)
    if per_axis_radii:
        gaussians["radii"] = gaussians["radii"][..., None].repeat(1, 1, 2)
    on_device = {name: value.to(DEVICE) for name, value in gaussians.items()}
    pending = tiles.intersect_tiles(**on_device, width=75, height=50, tile_size=8)
    needed = sum(pending.pair_counts.wait())
    lists = pending.lists(needed - missing)
    assert len(lists[1]) == needed - missing
    assert (lists[1] == 0).all()
    assert lists.overflowed.tolist() == [1]
    assert not any(listed_by_tile(lists, rows=7))
    assert (on_device["radii"] == 0).all()
    assert sum(pending.pair_counts.wait()) == needed


def test_a_row_of_tiles_below_the_image_may_need_numbers_of_32_bits(few_programs):
    """The image's 65,536 tiles have numbers of 16 bits; with the row below it they have not."""
    gaussians = {name: value.to(DEVICE) for name, value in projected_gaussians(1, 40, 2048, 2048).items()}
    pending = tiles.intersect_tiles(**gaussians, width=2048, height=2048, tile_size=8)
    exact = pending.lists()
    actual = listed_by_tile(pending.lists(len(exact[1]) + 50), 256)
    assert actual == listed_by_tile(exact, 256)


def test_no_gaussian_in_sight_makes_empty_lists():
    gaussians = projected_gaussians(1, 5, 32, 32)
    gaussians["radii"] = torch.zeros_like(gaussians["radii"])
    on_device = {name: value.to(DEVICE) for name, value in gaussians.items()}
    starts, ids, _ = tiles.intersect_tiles(**on_device, width=32, height=32, tile_size=16).lists()
    assert len(ids) == 0
    assert (starts == 0).all()


@pytest.mark.parametrize("per_axis_radii", [False, True], ids=["gsplat 1.4", "gsplat 1.5"])
def test_far_off_the_axis_radii_are_zero_as_torch_makes_them(few_programs, per_axis_radii):
    """The lists are those of the radii that torch culls."""
    gaussians = projected_gaussians(2, 150, 40, 30)
    if per_axis_radii:
        gaussians["radii"] = gaussians["radii"][..., None] * torch.tensor([1, 2], dtype=torch.int32)
    gaussians["means2d"][0, :4] = torch.tensor([[math.nan, 1.0], [1.0, math.inf], [-15.0, 15.0], [20.0, 36.5]])
    expected = cull_off_axis(gaussians["radii"], gaussians["means2d"], 40, 30, 0.8)
    assert 60 < (expected > 0).sum() < (gaussians["radii"] > 0).sum() - 60
    lists = []
    for radii, max_off_axis in ((expected, 0.0), (gaussians["radii"], 0.8)):
        on_device = {name: value.to(DEVICE, copy=True) for name, value in (gaussians | {"radii": radii}).items()}
        pending = tiles.intersect_tiles(**on_device, width=40, height=30, tile_size=8, max_off_axis=max_off_axis)
        lists.append(pending.lists())
        assert torch.equal(on_device["radii"].cpu(), expected)
    assert all(map(torch.equal, *lists))
    assert len(lists[0][1]) > 100


@pytest.mark.parametrize("dtype", [torch.int16, torch.int32])
@pytest.mark.parametrize(("num_pairs", "num_tiles"), [(0, 5), (1, 1), (700, 40), (1000, 1500), (513, 512)])
def test_the_lists_order_and_starts_are_torchs(dtype, num_pairs, num_tiles):
    """Most tiles have no pair in the longest case, and neither number is a multiple of what a program handles."""
    generator = seeded(0)
    numbers = torch.randint(0, num_tiles, (num_pairs,), generator=generator) - 2**15
    sorted_tiles, by_tile = numbers.to(dtype).to(DEVICE).sort(stable=True)
    ids = torch.randperm(num_pairs, generator=generator).int().to(DEVICE)
    ordered = torch.empty_like(ids)
    starts = ids.new_empty(num_tiles)
    lanes = tiles._ORDER_LANES
    of_pairs = triton.cdiv(num_pairs, lanes)
    tiles._order[of_pairs + triton.cdiv(num_tiles, lanes),](
        sorted_tiles, by_tile, ids, ordered, starts, num_pairs, num_tiles, of_pairs, num_pairs.bit_length(), lanes
    )
    every = torch.arange(num_tiles, device=DEVICE) - 2**15
    assert torch.equal(starts, torch.searchsorted(sorted_tiles.long(), every, out_int32=True))
    assert torch.equal(ordered, ids[by_tile])


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
