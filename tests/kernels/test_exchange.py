"""The kernels that pack Gaussians for other processes write and read the rows that torch does."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from helpers.generators import seeded
from sadgs_ns.distributed import exchange
from sadgs_ns.render.types import Projected

kernels = pytest.importorskip("sadgs_ns.kernels.exchange", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


@pytest.mark.parametrize("per_axis_radii", [False, True], ids=["gsplat 1.4", "gsplat 1.5"])
@pytest.mark.parametrize("number", [0, 1, 70, 200])
def test_rows_are_torchs_and_give_the_gaussians_back(per_axis_radii: bool, number: int):
    """70 rows end within a program's, and with 200 of 100 places some are sent twice."""
    generator = seeded(0)
    shapes = [(2, 50, 2), (2, 50), (2, 50, 3), (2, 50), (2, 50, 3)]
    means2d, depths, conics, opacities, colors = (torch.randn(shape, generator=generator) for shape in shapes)
    radii = torch.randint(0, 5000, (2, 50, 2) if per_axis_radii else (2, 50), generator=generator, dtype=torch.int32)
    projected = [x.to(DEVICE) for x in (radii, means2d, depths, conics, opacities, colors)]
    places = torch.randint(0, 100, (number,), generator=generator).to(DEVICE)
    rows = exchange.pack(projected, places)
    assert torch.equal(kernels.pack(*projected, places), rows)
    for top in (0, 48):
        taken = kernels.unpack(rows, top)
        for name, value, expected in zip(Projected._fields[:6], taken, exchange.unpack(rows, top), strict=True):
            assert value.is_contiguous(), name
            assert value.dtype == expected.dtype, name
            assert_close(value, expected, rtol=0, atol=0)
    taken = kernels.unpack(rows, 0)
    for value, whole in zip(taken, projected, strict=True):
        assert torch.equal(value[0], whole.flatten(0, 1)[places])


def test_rows_of_gradients_are_taken_as_they_lie_or_put_together():
    rows = torch.arange(60.0).view(1, 5, 12)
    *parts, _ = rows.split([2, 3, 1, 3, 2, 1], dim=-1)
    columns = [parts[0], parts[1], parts[2][..., 0], parts[3], parts[4], None]
    widths = exchange._GRADIENTS
    taken = exchange._gradient_rows(columns, widths, 4, like=rows)
    assert taken.data_ptr() == rows.data_ptr()
    assert torch.equal(taken, rows[0, :4])
    for changed in ([columns[0].clone(), *columns[1:]], [*columns[:3], columns[3].clone(), *columns[4:]]):
        copied = exchange._gradient_rows(changed, widths, 4, like=rows)
        assert copied.data_ptr() != rows.data_ptr()
        assert torch.equal(copied[:, :11], rows[0, :4, :11])
        assert (copied[:, 11] == 0).all()
    without = exchange._gradient_rows([None, *columns[1:]], widths, 4, like=rows)
    assert (without[:, :2] == 0).all()
    assert torch.equal(without[:, 2:11], rows[0, :4, 2:11])
