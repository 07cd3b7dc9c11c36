"""The kernels of the structure tensor against torch in float64."""

from __future__ import annotations

import pytest
import torch

from helpers.recorded_calls import record_calls
from sadgs_ns import kernels
from sadgs_ns.method import structure_tensor
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor

structure = pytest.importorskip("sadgs_ns.kernels.structure_tensor", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


@pytest.mark.parametrize("shape", [(2, 3, 21, 34), (1, 1, 1, 40), (1, 2, 5, 3)], ids=str)
@pytest.mark.parametrize("axis", [2, 3])
def test_convolution_equals_torchs_in_float64(shape, axis):
    generator = torch.Generator().manual_seed(0)
    image = torch.randn(shape, generator=generator)
    kernel = torch.randn(9, generator=generator)
    actual = structure.correlate(image.to(DEVICE), kernel.to(DEVICE), axis)
    weight = kernel.double().view((1, 1, -1, 1) if axis == 2 else (1, 1, 1, -1)).expand(shape[1], -1, -1, -1)
    padding = (4, 0) if axis == 2 else (0, 4)
    expected = torch.nn.functional.conv2d(image.double(), weight, padding=padding, groups=shape[1])
    torch.testing.assert_close(actual.cpu().double(), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    ("masked", "energy_blur", "epsilon"),
    [(False, 0.0, None), (False, 2.0, 1e-3), (True, 0.0, 1e-3), (True, 2.0, None), ("transposed", 2.0, None)],
)
def test_structure_tensors_are_the_same_with_the_kernels(monkeypatch, masked, energy_blur, epsilon):
    images = torch.rand((2, 9, 14, 3), generator=torch.Generator().manual_seed(0)).to(DEVICE)
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
    calls = record_calls(monkeypatch, structure, "correlate", "differentiate", "aggregate")
    actual = multiscale_structure_tensor(images, masks, **options)
    assert set(calls) == {"correlate", "differentiate", "aggregate"}
    atol = 1e-5 * float(expected.nan_to_num().abs().max())
    torch.testing.assert_close(actual.double(), expected, atol=atol, rtol=1e-4, equal_nan=True)
