"""Send projected Gaussians to the processes that composite them, and their gradients back."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.autograd.function import once_differentiable

from sadgs_ns.distributed.bands import Band
from sadgs_ns.distributed.world import World
from sadgs_ns.gsplat_compat import drawn
from sadgs_ns.render.types import Projected

_GRADIENTS = (2, 3, 1, 3, 2, 1)
"""Widths of our compositing's columns of gradients: centre, conic, opacity, colour, absolute centre, unused."""

_NUM_TENSORS = 6
"""The first fields of `Projected` are tensors, one row for each Gaussian."""


class Exchange:
    """Sends the Gaussians that each band draws to the process that composites it.

    It is made with the Gaussians of this process in all V views and all bands of `share_rows`. The host waits for the
    device once, to learn the Gaussians' numbers; the processes' flags come along.

    Attributes:
        bands: Those that this process composites.
        counts: Rows that each process has for each of these bands.
        places: Indices in V · N of the rows that this process sends, in the order of all bands. int64 [M]
        fused: Whether kernels write and read rows, and gradients have the columns of `_GRADIENTS`, in all processes.
        whole_views: Whether each view is one band, so that no row is sent twice.
        absolute: Centres of each of these bands, in which compositing leaves the absolute gradients asked for.
    """

    def __init__(self, world: World, projected: Projected, bands: Sequence[Band]) -> None:
        self.fused = world.uses_kernels
        self.whole_views = len(bands) == len(projected.opacities)
        reached = _reached(projected, bands)  # [B, N]
        flags = torch.tensor([world.flags_out], device=world.device)
        counted = torch.cat([reached.sum(1), flags])  # [B + 1]
        gathered = world.gather(counted)  # [R, B + 1]
        n = reached.shape[1]
        self.places = reached.flatten().nonzero()[:, 0]  # [M], in B · N
        band_views = [band.view for band in bands]
        if band_views != list(range(len(bands))):
            views = torch.tensor(band_views, device=world.device)  # [B]
            self.places = views[self.places // n] * n + self.places % n
        table = gathered.tolist()
        for row in table:
            world.flags_in |= row.pop()
        mine = [index for index, band in enumerate(bands) if band.rank == world.rank]
        self.bands = [bands[index] for index in mine]
        self.counts: list[list[int]] = []
        for row in table:
            self.counts.append([row[index] for index in mine])
        self._received = [sum(row) for row in self.counts]
        self._sent = [0] * world.num_ranks
        for band, number in zip(bands, table[world.rank], strict=True):
            self._sent[band.rank] += number
        self.absolute: list[Tensor] = []

    def send(self, projected: Projected, absgrad: bool) -> tuple[Tensor, list[Projected]]:
        """Send the Gaussians, differentiably; call once.

        With `absgrad`, `backward` gives `projected.means2d` the attributes `absgrad`, its absolute gradients, and
        `grad2d`, its gradient.

        Returns:
            Zero, which must be added to the loss, so that backward runs in a process that composites nothing, too; and
            for each band of this process the Gaussians of its view, shifted to the band's first drawn row.
        """
        if absgrad:
            projected.means2d.grad2d = None  # type: ignore[attr-defined] # `keep_gradient` looks for it.
        anchor, *flat = _Exchanged.apply(self, absgrad, *projected[:_NUM_TENSORS])  # type: ignore[misc]
        received = []
        for index, band in enumerate(self.bands):
            tensors = flat[_NUM_TENSORS * index : _NUM_TENSORS * (index + 1)]
            height = band.bottom - band.top
            received.append(Projected(*tensors, width=projected.width, height=height))
        if absgrad and torch.is_grad_enabled():
            # These hold the graph, which holds this object, until `backward` releases them.
            self.absolute = [part.means2d for part in received]
        return anchor, received

    def forth(self, rows: Tensor) -> list[Tensor]:
        """Send rows, in the order of `places` [M, K], and return those of each band of this process."""
        received = rows.new_empty((sum(self._received), rows.shape[1]))
        dist.all_to_all_single(received, rows, self._received, self._sent)
        return _transposed(received, self.counts)

    def back(self, parts: Sequence[Tensor], nothing: Tensor) -> Tensor:
        """Send rows of each band of this process back, and return the others', in the order of `places`. [M, K]

        `nothing` [0, K] is sent if this process composites nothing.
        """
        rows = nothing
        if len(parts) == 1:
            rows = parts[0]  # They came in the order of the processes.
        elif parts:
            by_band = torch.cat([*parts])
            counts_of_bands = list(zip(*self.counts, strict=True))
            rows = torch.cat(_transposed(by_band, counts_of_bands))
        received = rows.new_empty((len(self.places), nothing.shape[1]))
        dist.all_to_all_single(received, rows.contiguous(), self._sent, self._received)
        return received


class _Exchanged(torch.autograd.Function):
    """Send forward with `Exchange.forth`, and gradients back with `Exchange.back`, the absolute ones beside them."""

    @staticmethod
    def forward(ctx: Any, exchange: Exchange, absgrad: bool, *projected: Tensor) -> tuple[Tensor, ...]:  # type: ignore[override]
        _, means2d, _, _, opacities, _ = projected
        ctx.set_materialize_grads(False)
        ctx.exchange = exchange
        ctx.absgrad = absgrad
        ctx.shape = opacities.shape
        ctx.save_for_backward(means2d)
        if exchange.fused:
            from sadgs_ns.kernels import exchange as kernel  # Triton need not be installed.

            rows = kernel.pack(*(value.detach().contiguous() for value in projected), places=exchange.places)
        else:
            kernel = None
            rows = pack([value.detach() for value in projected], exchange.places)
        outputs = []
        for band, received in zip(exchange.bands, exchange.forth(rows), strict=True):
            if not len(received):
                received = received.new_zeros((1, received.shape[1]))  # A Gaussian whose radius is 0 is not drawn.
            if kernel is None:
                part = unpack(received, band.top)
            else:
                part = kernel.unpack(received.contiguous(), band.top)
            radii = part[0]
            ctx.mark_non_differentiable(radii)
            outputs += part
        return means2d.new_zeros(()), *outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, _: Tensor | None, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        exchange: Exchange = ctx.exchange
        (means2d,) = ctx.saved_tensors
        if exchange.fused:
            widths = list(_GRADIENTS)
        elif ctx.absgrad:
            widths = [2, 3, 1, 3, 2]
        else:
            widths = [2, 3, 1, 3]
        parts = []
        for index in range(len(exchange.bands)):
            number = sum(row[index] for row in exchange.counts)
            of_band = gradients[6 * index : 6 * index + 6]
            _, v_means2d, _, v_conics, v_opacities, v_colors = of_band  # Depths decide no colour.
            v_absolute = None
            if ctx.absgrad:
                v_absolute = getattr(exchange.absolute[index], "absgrad", None)
            columns = [v_means2d, v_conics, v_opacities, v_colors, v_absolute, None][: len(widths)]
            parts.append(_gradient_rows(columns, widths, number, like=means2d))
        exchange.absolute = []
        width = sum(widths)
        nothing = means2d.new_empty((0, width))
        rows = exchange.back(parts, nothing)  # [M, width]
        dense = means2d.new_zeros((ctx.shape.numel(), width))  # [V · N, width]
        if exchange.whole_views:
            dense.index_copy_(0, exchange.places, rows)
        else:
            dense.index_add_(0, exchange.places, rows)
        v_means2d, v_conics, v_opacities, v_colors, *v_absolute = dense.view(*ctx.shape, -1).split(widths, -1)
        if ctx.absgrad:
            means2d.absgrad = v_absolute[0]
            means2d.grad2d = v_means2d
        return None, None, None, v_means2d, None, v_conics, v_opacities[..., 0], v_colors


def pack(projected: Sequence[Tensor], places: Tensor) -> Tensor:
    """Return rows of centre, conic, opacity, colour, depth and radius of the Gaussians at some places in V · N.

    `projected` are the six tensors of `Projected`. int64 [M] → [M, 10 + 1 or 2]
    """
    radii, means2d, depths, conics, opacities, colors = projected
    size = opacities.numel()
    columns = [value.reshape(size, -1)[places] for value in (means2d, conics, opacities, colors, depths)]
    radii_column = radii.reshape(size, -1)[places].to(means2d.dtype)
    return _beside([*columns, radii_column])


def unpack(rows: Tensor, top: int) -> tuple[Tensor, ...]:
    """Return the six tensors of `Projected` of one view from rows of `pack`; centres are counted from row `top`."""
    radii_of_one = rows.shape[1] - 10  # Number of radii of a Gaussian
    parts = rows[None].split([2, 3, 1, 3, 1, radii_of_one], dim=-1)
    contiguous = [part.clone(memory_format=torch.contiguous_format) for part in parts]
    means2d, conics, opacities, colors, depths, radii = contiguous
    means2d[..., 1] -= top
    if radii_of_one == 1:
        radii = radii[..., 0]
    return radii.int(), means2d, depths[..., 0], conics, opacities[..., 0], colors


def _gradient_rows(columns: Sequence[Tensor | None], widths: Sequence[int], number: int, like: Tensor) -> Tensor:
    """Put gradients of one view, or zeros for None, into M rows, unless they are parts of such rows already.

    [1, at least M, width] each, or [1, at least M] → [M, sum of the widths]. Those of our compositing are such parts.
    """
    whole_width = sum(widths)
    first = columns[0]
    if first is not None and _are_parts_of_rows(columns, widths):
        return first.as_strided((number, whole_width), (whole_width, 1))
    filled = []
    for value, width in zip(columns, widths, strict=True):
        if value is None:
            filled.append(like.new_zeros((number, width)))
        else:
            filled.append(value.reshape(-1, width)[:number])
    return _beside(filled)


def _are_parts_of_rows(columns: Sequence[Tensor | None], widths: Sequence[int]) -> bool:
    """Return whether gradients, as `_gradient_rows` takes them, lie side by side in rows; the last two may be None."""
    first = columns[0]
    if first is None or any(value is None for value in columns[1:4]):
        return False
    if first.dim() != 3 or first.stride()[1:] != (sum(widths), 1):
        return False
    starts = accumulate(widths, initial=0)  # In columns
    for value, start in zip(columns, starts, strict=False):
        address = first.data_ptr() + first.element_size() * start
        if value is not None and value.data_ptr() != address:
            return False
    return True


@torch.no_grad()
def _reached(projected: Projected, bands: Sequence[Band]) -> Tensor:
    """Return which Gaussians each band draws. bool [B, N]"""
    radii = projected.radii
    means2d = projected.means2d
    visible = drawn(radii, means2d)  # [V, N]
    if [band.view for band in bands] == list(range(len(visible))):
        return visible
    y = means2d[..., 1]  # [V, N]
    if radii.dim() == 3:
        reach = radii[..., 1]  # [V, N]
    else:
        reach = radii
    lowest = y + reach
    highest = y - reach
    of_bands = []
    for band in bands:
        in_rows = (lowest[band.view] > band.top) & (highest[band.view] < band.bottom)
        of_bands.append(visible[band.view] & in_rows)
    return torch.stack(of_bands)


def _beside(values: Sequence[Tensor]) -> Tensor:
    """Put columns beside each other; `torch.cat` along them took several times as long on a GPU. [M, ·] each"""
    widths = [value.shape[1] for value in values]
    rows = values[0].new_empty((len(values[0]), sum(widths)))
    for columns, value in zip(rows.split(widths, dim=1), values, strict=True):
        columns.copy_(value)
    return rows


def _transposed(rows: Tensor, numbers: Sequence[Sequence[int]]) -> list[Tensor]:
    """Return the rows of each B, in the order of A, of rows in order of A and then of B, given their numbers."""
    groups = len(numbers[0])
    if groups <= 1:
        return [rows] * groups
    pieces = rows.split([number for row in numbers for number in row])
    return [torch.cat(pieces[group::groups]) for group in range(groups)]
