"""What each shortcut in computing and storing S̄ gets wrong and costs, and how S̄ reacts to image perturbations."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.overrides import TorchFunctionMode

from sadgs_ns.method.codes import decode, encode
from sadgs_ns.method.eta import wavelength
from sadgs_ns.method.statistics import HIGH_ETA
from sadgs_ns.method.structure_tensor import TRUNCATION, multiscale_structure_tensor

REFERENCE_TRUNCATION = 8.0
"""Kernels of the reference end at this many standard deviations, where float64 cannot tell them from whole ones."""
TRUNCATIONS = (2.0, 2.5, 3.0, 4.0, 5.0, REFERENCE_TRUNCATION)
AXIS_LENGTHS = (3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0)
"""Axes ‖v‖ in px whose η > 1 decision is compared at every pixel; c = 0.4 has no wavelength under 2.5 px."""
PAPER = {"exposure ×0.5": 0.05, "exposure ×1.5": 0.08, "noise": 0.07, "sharpened ×1.5": 0.12, "sharpened ×3": 0.40,
         "JPEG": 0.12}  # fmt: skip
"""Average relative change of S̄ in the paper's supplement."""

Image = NDArray[np.uint8]
Row = dict[str, Any]
"""`table`, `variant`, and the numbers of that table's columns; None is a number that this device cannot give."""


def timed(function: Callable[[], Any], device: torch.device, repeats: int) -> tuple[Any, float]:
    """What a function returns, and the median milliseconds of `repeats` calls after that first one.

    On a CPU they are processor time, summed over its threads: other processes there do not disturb it.
    """
    clock = time.perf_counter if device.type == "cuda" else time.process_time

    def call() -> tuple[Any, float]:
        _synchronize(device)
        start = clock()
        result = function()
        _synchronize(device)
        return result, 1e3 * (clock() - start)

    result, _ = call()
    return result, statistics.median(call()[1] for _ in range(repeats))


def _synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def spread(errors: Tensor) -> Row:
    """Median, 95th percentile and maximum of errors ≥ 0 of any shape."""
    ordered = errors.flatten().sort().values  # torch.quantile refuses more than 16 M values
    last = len(ordered) - 1
    return {
        name: float(ordered[round(last * quantile)])
        for name, quantile in (("median", 0.5), ("p95", 0.95), ("max", 1.0))
    }


def relative_change(tensor: Tensor, reference: Tensor) -> float:
    """Average change of S̄ over its average magnitude: the paper's "average relative change". Both [..., 3]"""
    return float((tensor - reference).norm(dim=-1).mean() / reference.norm(dim=-1).mean())


def map_errors(tensor: Tensor, reference: Tensor) -> Row:
    """Errors of the wavelength Λ relative to the reference's, and the η > 1 decisions that flip.

    Args:
        tensor: S̄. [B, H, W, 3]
        reference: The same, of the reference. [B, H, W, 3]

    Returns:
        `change` of S̄, `median`, `p95` and `max` of |Λ / Λ_ref − 1| over the pixels, and `flips`, the fraction of
        pixels × AXIS_LENGTHS on the other side of η = 1.
    """
    tensor, reference = tensor.double(), reference.double()
    actual, expected = wavelength(tensor), wavelength(reference)  # [B, H, W]
    flips = [
        ((length / actual > HIGH_ETA) != (length / expected > HIGH_ETA)).double().mean() for length in AXIS_LENGTHS
    ]
    errors = spread((actual / expected - 1).abs())
    change = relative_change(tensor, reference)
    return {"change": change, **errors, "flips": float(torch.stack(flips).mean())}


class ConvolutionPrecision(TorchFunctionMode):
    """Inside this context every convolution's operands and result have another precision, the rest is untouched.

    Accumulation stays float32, as on CUDA. A CPU's 16-bit convolutions are so slow that there the operands and the
    result are rounded and the convolution between is float32: the same error, but no time worth measuring.

    Args:
        dtype: Of operands and result.
        allow_tf32: Let cuDNN use TF32 for float32 convolutions.
    """

    def __init__(self, dtype: torch.dtype, allow_tf32: bool = False) -> None:
        super().__init__()
        self.dtype, self.allow_tf32 = dtype, allow_tf32

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is not torch.conv2d:
            return func(*args, **(kwargs or {}))
        image, weight, *rest = args
        image_, weight_ = image.to(self.dtype), weight.to(self.dtype)
        if not image.is_cuda:
            image_, weight_ = image_.to(image.dtype), weight_.to(image.dtype)
        with torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=False, allow_tf32=self.allow_tf32):
            result = func(image_, weight_, *rest, **(kwargs or {}))
        return result.to(self.dtype).to(image.dtype)


def structure_tensor_rows(images: Tensor, repeats: int) -> Iterator[Row]:
    """How S̄ is computed and stored.

    Truncation and what is shipped are held against float64 with kernels to 8σ; precision and storage
    against float64 with the kernels that are shipped, so that their rows show what they alone add.

    Args:
        images: float32 in [0, 1]. [B, H, W, C]
        repeats: Timed calls of each variant.
    """
    device = images.device
    measure = partial(timed, device=device, repeats=repeats)

    def row(variant: str, tensor: Tensor, reference: Tensor, ms: float | None, bytes_per_pixel: int) -> Row:
        errors = map_errors(tensor, reference)
        ms = None if ms is None else ms / len(images)
        return {"table": "structure_tensor", "variant": variant, "bytes": bytes_per_pixel, **errors, "ms": ms}

    double = images.double()
    compute = partial(multiscale_structure_tensor, images)
    reference, ms = measure(partial(multiscale_structure_tensor, double, truncation=REFERENCE_TRUNCATION))
    yield row(f"reference: float64, kernels to {REFERENCE_TRUNCATION:g}σ", reference, reference, ms, 24)
    for truncation in TRUNCATIONS:
        tensor, ms = measure(partial(compute, truncation=truncation))
        yield row(f"float32, kernels to {truncation:g}σ", tensor, reference, ms, 12)
    code, ms = measure(lambda: encode(compute()))
    yield row(f"as shipped: float32, to {TRUNCATION:g}σ, stored in 8 bits", decode(code), reference, ms, 3)

    shipped = multiscale_structure_tensor(double)
    precisions: tuple[tuple[str, AbstractContextManager[Any], bool, bool], ...] = (
        ("float32", nullcontext(), True, True),
        ("TF32 convolutions", ConvolutionPrecision(torch.float32, allow_tf32=True), False, True),
        ("float16 convolutions", ConvolutionPrecision(torch.float16), True, False),
        ("bfloat16 convolutions", ConvolutionPrecision(torch.bfloat16), True, False),
    )
    for variant, context, anywhere, timed_anywhere in precisions:
        if device.type != "cuda" and not anywhere:
            unknown = dict.fromkeys(("bytes", "median", "p95", "max", "flips", "ms"))
            yield {"table": "structure_tensor", "variant": f"precision alone: {variant}", **unknown}
            continue
        run = partial(compute, fused=isinstance(context, nullcontext))  # our kernel knows float32 only
        with context:
            if timed_anywhere or device.type == "cuda":
                tensor, ms = measure(run)
            else:
                tensor, ms = run(), None
        yield row(f"precision alone: {variant}", tensor, shipped, ms, 12)

    single = shipped.float()
    for variant, to_code, from_code, size in (
        ("float32", lambda: single, lambda code: code, 12),
        ("float16", single.half, lambda code: code, 6),
        ("8 bits", lambda: encode(single), decode, 3),
    ):
        code, ms = measure(to_code)
        yield row(f"storage alone: {variant}", from_code(code), shipped, ms, size)


def _sharpened(image: Image, factor: float) -> Image:
    """Sharpness as Pillow and torchvision define it: the image extrapolated from its 3×3 blur by the factor."""
    kernel = np.array([[1, 1, 1], [1, 5, 1], [1, 1, 1]]) / 13
    return _image(factor * image + (1 - factor) * cv2.filter2D(image, -1, kernel).astype(np.float64))


def _jpeg(image: Image, quality: int) -> Image:
    _, encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR), np.uint8)[..., ::-1]


def _image(array: Any) -> Image:
    """Rounded and clipped to 8 bits."""
    return np.clip(np.rint(array), 0, 255).astype(np.uint8)


def perturbations(seed: int = 0) -> dict[str, tuple[Callable[[Image], NDArray[Any]], float]]:
    """By name: a map of an RGB image in grey levels, and the change of S̄ that the paper's supplement reports.

    The paper does not say whether exposure was clipped and rounded; it has one number for both of our rows.
    """
    rng = np.random.default_rng(seed)
    return {
        "exposure ×0.5": (lambda image: 0.5 * image, PAPER["exposure ×0.5"]),
        "exposure ×0.5, rounded to 8 bits": (lambda image: _image(0.5 * image), PAPER["exposure ×0.5"]),
        "exposure ×1.5, not clipped": (lambda image: 1.5 * image, PAPER["exposure ×1.5"]),
        "exposure ×1.5, clipped to 8 bits": (lambda image: _image(1.5 * image), PAPER["exposure ×1.5"]),
        "Gaussian noise of one grey level": (lambda image: image + rng.normal(size=image.shape), PAPER["noise"]),
        "sharpened ×1.5": (lambda image: _sharpened(image, 1.5), PAPER["sharpened ×1.5"]),
        "sharpened ×3": (lambda image: _sharpened(image, 3.0), PAPER["sharpened ×3"]),
        "JPEG, quality 80": (lambda image: _jpeg(image, 80), PAPER["JPEG"]),
    }


def robustness_rows(images: Sequence[Image], device: torch.device) -> Iterator[Row]:
    """What image perturbations change, with everything as shipped but the storage.

    Args:
        images: RGB, of one size. [H, W, 3] each
        device: Where S̄ is computed.
    """
    reference = multiscale_structure_tensor(batch(images, device))
    for variant, (perturb, paper) in perturbations().items():
        tensor = multiscale_structure_tensor(batch([perturb(image) for image in images], device))
        yield {"table": "robustness", "variant": variant, **map_errors(tensor, reference), "paper": paper}


def batch(images: Sequence[NDArray[Any]], device: torch.device) -> Tensor:
    """Images in grey levels → float32, 255 becoming 1. [B, H, W, 3]"""
    return torch.from_numpy(np.stack(images).astype(np.float32)).to(device) / 255
