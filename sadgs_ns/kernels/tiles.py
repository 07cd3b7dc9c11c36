"""Exact lists of the Gaussians that reach each tile of the image, which gsplat's `rasterize_to_pixels` walks through.

gsplat lists a Gaussian in every tile that its 3σ square (1.4) or rectangle (1.5) touches. Most of a long, thin or faint
Gaussian's square lies outside the ellipse in which it is at least 1/255 opaque, and there the rasterizer skips it pixel
by pixel. Here a tile is listed only if the ellipse meets the rectangle of its pixel centres, which draws the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from sadgs_ns.kernels import cdiv
from sadgs_ns.kernels.limits import check_pairs
from sadgs_ns.kernels.shared import drawn

_LANES = 32  # Gaussians that one program handles: one warp of them, so that a large Gaussian holds up only 31 others
_FEW_PAIRS = 64
"""Largest number of tiles of a Gaussian that one lane lists. A larger Gaussian is cut into parts."""
_PART_PAIRS = 256
"""Mean number of tiles of a part. A Gaussian that reaches all tiles of an image would take a lane, or a program, longer
than the rest of a step."""
_PART_ROWS = 4  # Rows of tiles of a part that a program writes at once
_PART_COLUMNS = 8  # Columns of tiles of a part that a program writes at once
_PROGRAMS = 4096  # Most programs that share out the parts: as many as an H100 runs at once, of one warp each
_PLACE = tl.constexpr(2**24)  # Factor on a Gaussian's place by depth, noted with the number of one of its parts
_SKIPPED_ROWS = tl.constexpr(32)  # Rows of tiles before a part that are counted at once
_MIDDLE_TILE = tl.constexpr(2**15)  # Tiles are numbered from minus this: 16 bits then tell 65,536 of them apart.
_ORDER_LANES = 512  # Pairs or tiles that one program handles where the lists are put in order


@triton.jit
def _load_ellipse(
    means2d, radii, conics, opacities, g, exists, tile_width, tile_height,
    PER_GAUSSIAN: tl.constexpr, TILE: tl.constexpr,
):  # fmt: skip
    """Load the values that decide which tiles the Gaussians with numbers g reach, of N Gaussians in each of C views.

    Returns:
        The ellipse, a tuple: its centre x, y; the conic a, b, c; the level 2 ln(255 α) at which the ellipse ends; the
        conic's determinant; `proper`; the first column of tiles; and one past the last column.
        The first row of tiles, and one past the last row.

        `proper` is whether the determinant is above 1e-30 and finite and the level below 1e30. If not, the Gaussian is
        listed in all tiles in which gsplat lists it.
    """
    rx = tl.load(radii + PER_GAUSSIAN * g, exists, 0).to(tl.float32)
    ry = rx
    if PER_GAUSSIAN == 2:
        ry = tl.load(radii + 2 * g + 1, exists, 0).to(tl.float32)
    opacity = 255.0 * tl.load(opacities + g, exists, 0.0)
    drawn = exists & (rx > 0) & (ry > 0) & (opacity >= 1)  # gsplat writes no centre of a culled one
    x = tl.load(means2d + 2 * g, drawn, 0.0)
    y = tl.load(means2d + 2 * g + 1, drawn, 0.0)
    drawn = drawn & (tl.abs(x) < float("inf")) & (tl.abs(y) < float("inf"))
    x = tl.where(drawn, x, 0.0)
    y = tl.where(drawn, y, 0.0)
    a = tl.load(conics + 3 * g, drawn, 1.0)
    b = tl.load(conics + 3 * g + 1, drawn, 0.0)
    c = tl.load(conics + 3 * g + 2, drawn, 1.0)
    # The determinant of a thin conic would cancel in float32. gsplat's exponent does: its rounding raises the level.
    determinant = (a.to(tl.float64) * c.to(tl.float64) - b.to(tl.float64) * b.to(tl.float64)).to(tl.float32)
    proper = (determinant > 1e-30) & (determinant < float("inf"))
    a = tl.where(proper, a, 1.0)
    b = tl.where(proper, b, 0.0)
    c = tl.where(proper, c, 1.0)
    determinant = tl.where(proper, determinant, 1.0)
    level = 2 * tl.log(tl.where(drawn, opacity, 1.0)) * (1 + 1e-6 * a * c / determinant) + 1e-4
    proper = proper & (level < 1e30)
    first_column = tl.minimum(tl.maximum(tl.floor((x - rx) / TILE), 0), tile_width).to(tl.int32)
    last_column = tl.minimum(tl.maximum(tl.ceil((x + rx) / TILE), 0), tile_width).to(tl.int32)
    first_row = tl.minimum(tl.maximum(tl.floor((y - ry) / TILE), 0), tile_height)
    last_row = tl.minimum(tl.maximum(tl.ceil((y + ry) / TILE), 0), tile_height)
    reach = tl.sqrt(level * a / determinant) + 0.01
    first_row = tl.where(proper, tl.maximum(first_row, tl.ceil((y - reach + 0.5) / TILE) - 1), first_row).to(tl.int32)
    last_row = tl.where(proper, tl.minimum(last_row, tl.floor((y + reach - 0.5) / TILE) + 1), last_row).to(tl.int32)
    last_row = tl.where(drawn, last_row, first_row)
    return (x, y, a, b, c, level, determinant, proper, first_column, last_column), first_row, last_row


@triton.jit
def _columns_of_row(row, ellipse, TILE: tl.constexpr):
    """Return the first, and one past the last, column of the tiles in a row that the ellipse meets."""
    x, y, a, b, c, level, determinant, proper, first_column, last_column = ellipse
    low = row * TILE + 0.5 - y  # the row's first pixel centres, from the Gaussian's
    high = low + (TILE - 1)
    reach_x = tl.sqrt(level * c / determinant)
    rightmost = tl.minimum(tl.maximum(-b / c * reach_x, low), high)  # where the ellipse within the row extends furthest
    leftmost = tl.minimum(tl.maximum(b / c * reach_x, low), high)
    right = (-b * rightmost + tl.sqrt(tl.maximum(a * level - determinant * rightmost * rightmost, 0.0))) / a + 0.01
    left = (-b * leftmost - tl.sqrt(tl.maximum(a * level - determinant * leftmost * leftmost, 0.0))) / a - 0.01
    # Both sides are clipped, so that an ellipse of billions of px does not overflow integers.
    low = first_column.to(tl.float32)
    high = last_column.to(tl.float32)
    first = tl.minimum(tl.maximum(tl.ceil((x + left + 0.5) / TILE) - 1, low), high)
    last = tl.minimum(tl.maximum(tl.floor((x + right - 0.5) / TILE) + 1, low), high)
    return tl.where(proper, first, first_column).to(tl.int32), tl.where(proper, last, last_column).to(tl.int32)


@triton.jit(do_not_specialize=["n", "tile_width", "tile_height"])
def _count(
    means2d, radii, conics, opacities, counts, n, tile_width, tile_height, half_width, half_height, reach_x, reach_y,
    PER_GAUSSIAN: tl.constexpr, TILE: tl.constexpr, CULL: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Count the tiles that each Gaussian reaches in each view.

    With CULL the radii of Gaussians whose centre is out of reach of the image's centre, or NaN, become 0 first.
    """
    g = tl.program_id(0) * LANES + tl.arange(0, LANES)
    exists = g < n
    if CULL:
        # The projection writes no centre of the others.
        has_centre = drawn(radii, g, exists, PER_GAUSSIAN)
        x = tl.load(means2d + 2 * g, has_centre, 0.0)
        y = tl.load(means2d + 2 * g + 1, has_centre, 0.0)
        near = (tl.abs(x - half_width) < reach_x) & (tl.abs(y - half_height) < reach_y)
        for i in tl.static_range(PER_GAUSSIAN):
            tl.store(radii + PER_GAUSSIAN * g + i, 0, exists & ~near)
        exists = exists & near
    ellipse, first_row, last_row = _load_ellipse(
        means2d, radii, conics, opacities, g, exists, tile_width, tile_height, PER_GAUSSIAN, TILE
    )
    count = tl.zeros([LANES], tl.int32)
    for i in range(tl.max(last_row - first_row)):
        row = first_row + i
        first, last = _columns_of_row(row, ellipse, TILE)
        count += tl.where(row < last_row, tl.maximum(last - first, 0), 0)
    tl.store(counts + g, count, g < n)


@triton.jit(
    do_not_specialize=["n", "num_gaussians", "num_pairs", "num_tiles", "tile_width", "tile_height", "rows_per_view"]
)
def _list(
    means2d, radii, conics, opacities, order, ends, tiles, ids, parts, part_count, overflowed,
    n, num_gaussians, num_pairs, num_tiles, tile_width, tile_height, rows_per_view,
    PER_GAUSSIAN: tl.constexpr, TILE: tl.constexpr, LANES: tl.constexpr, FEW: tl.constexpr, PART: tl.constexpr,
):  # fmt: skip
    """Write the tile and the Gaussian of each pair, the nearest Gaussians first.

    A Gaussian of more than FEW pairs is left to `_list_parts`: each of its parts is noted in `parts`, as _PLACE times
    its place in the order plus the part's number, and counted in `part_count`.

    The last tile gets the rest of the `num_pairs` places. If these are too few, radii become 0 and `overflowed` 1.
    """
    lane = tl.program_id(0) * LANES + tl.arange(0, LANES)
    exists = lane < n
    needed = tl.load(ends + n - 1)
    fits = needed <= num_pairs
    tl.store(overflowed, 1, needed > num_pairs)
    g = tl.load(order + lane, exists, 0).to(tl.int32)
    place = tl.load(ends + lane - 1, exists & (lane > 0), 0)
    pairs = tl.load(ends + lane, exists & fits, 0) - place
    num_parts = tl.where(pairs > FEW, (pairs + PART - 1) // PART, 0).to(tl.int32)
    total = tl.sum(num_parts)
    if total > 0:
        first_part = tl.atomic_add(part_count, total) + tl.cumsum(num_parts, 0) - num_parts
        for i in range(tl.max(num_parts)):
            tl.store(parts + first_part + i, lane.to(tl.int64) * _PLACE + i, i < num_parts)
    ellipse, first_row, last_row = _load_ellipse(
        means2d, radii, conics, opacities, g, exists, tile_width, tile_height, PER_GAUSSIAN, TILE
    )
    for i in tl.static_range(PER_GAUSSIAN):
        tl.store(radii + PER_GAUSSIAN * g + i, 0, exists & (needed > num_pairs))
    last_row = tl.where(fits & (num_parts == 0), last_row, first_row)
    row_of_view = g // num_gaussians * rows_per_view
    for i in range(tl.max(last_row - first_row)):
        row = first_row + i
        first, last = _columns_of_row(row, ellipse, TILE)
        last = tl.where(row < last_row, last, first)
        for j in range(tl.max(last - first)):
            listed = first + j < last
            tile = (row_of_view + row) * tile_width + first + j
            tl.store(tiles + place, (tile - _MIDDLE_TILE).to(tiles.dtype.element_ty), listed)
            tl.store(ids + place, g, listed)
            place += listed.to(place.dtype)
    stride = tl.num_programs(0) * LANES
    used = tl.where(fits, needed, 0)
    for i in range(tl.cdiv(num_pairs - used, stride)):
        unused = used + i * stride + lane
        last_tile = num_tiles - 1 - _MIDDLE_TILE + lane * 0
        tl.store(tiles + unused, last_tile.to(tiles.dtype.element_ty), unused < num_pairs)
        tl.store(ids + unused, lane * 0, unused < num_pairs)


@triton.jit(do_not_specialize=["num_gaussians", "tile_width", "tile_height", "rows_per_view"])
def _list_parts(
    means2d, radii, conics, opacities, order, ends, tiles, ids, parts, part_count,
    num_gaussians, tile_width, tile_height, rows_per_view,
    PER_GAUSSIAN: tl.constexpr, TILE: tl.constexpr, PART: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Write the pairs of the parts that `_list` noted. A part is a share of the rows of a Gaussian's tiles."""
    row_offset = tl.arange(0, ROWS)
    column_offset = tl.arange(0, COLUMNS)[None, :]
    skipped_offset = tl.arange(0, _SKIPPED_ROWS)
    num_noted = tl.load(part_count)
    index = tl.program_id(0)
    while index < num_noted:
        noted = tl.load(parts + index)
        position = noted // _PLACE
        part = noted % _PLACE
        g = tl.load(order + position).to(tl.int32)
        place = tl.load(ends + position - 1, position > 0, 0)
        num_parts = (tl.load(ends + position) - place + PART - 1) // PART
        ellipse, first_row, last_row = _load_ellipse(
            means2d, radii, conics, opacities, g, True, tile_width, tile_height, PER_GAUSSIAN, TILE
        )
        num_rows = last_row - first_row
        part_row = first_row + (num_rows * part // num_parts).to(tl.int32)
        last_row = first_row + (num_rows * (part + 1) // num_parts).to(tl.int32)
        while first_row < part_row:  # Parts before this one take the places before this one's.
            row = first_row + skipped_offset
            first, last = _columns_of_row(row, ellipse, TILE)
            place += tl.sum(tl.where(row < part_row, tl.maximum(last - first, 0), 0))
            first_row += _SKIPPED_ROWS
        row_of_view = g // num_gaussians * rows_per_view
        while part_row < last_row:
            row = part_row + row_offset
            first, last = _columns_of_row(row, ellipse, TILE)
            count = tl.where(row < last_row, tl.maximum(last - first, 0), 0)
            first_place = place + tl.cumsum(count, 0) - count
            first_tile = (row_of_view + row) * tile_width + first - _MIDDLE_TILE
            for j in range(0, tl.max(count), COLUMNS):
                listed = j + column_offset < count[:, None]
                at = first_place[:, None] + j + column_offset
                tile = first_tile[:, None] + j + column_offset
                tl.store(tiles + at, tile.to(tiles.dtype.element_ty), listed)
                tl.store(ids + at, g + column_offset * 0 + row_offset[:, None] * 0, listed)
            place += tl.sum(count)
            part_row += ROWS
        index += tl.num_programs(0)


@triton.jit(do_not_specialize=["num_pairs", "num_tiles", "of_pairs", "halvings"])
def _order(tiles, by_tile, ids, ordered, starts, num_pairs, num_tiles, of_pairs, halvings, LANES: tl.constexpr):
    """Bring the Gaussians of the pairs into the order of the tiles, and find where each tile's list starts.

    The first `of_pairs` programs handle LANES pairs each, the others LANES tiles, whose starts are found by bisection.
    """
    program = tl.program_id(0)
    lane = tl.arange(0, LANES)
    if program < of_pairs:
        at = program.to(tl.int64) * LANES + lane
        exists = at < num_pairs
        tl.store(ordered + at, tl.load(ids + tl.load(by_tile + at, exists, 0), exists, 0), exists)
    else:
        tile = (program - of_pairs) * LANES + lane
        low = tile.to(tl.int64) * 0
        high = low + num_pairs
        for _ in range(halvings):
            middle = (low + high) // 2
            searching = low < high
            before = tl.load(tiles + middle, searching, 0).to(tl.int32) < tile - _MIDDLE_TILE
            low = tl.where(searching & before, middle + 1, low)
            high = tl.where(searching & ~before, middle, high)
        tl.store(starts + tile, low.to(tl.int32), tile < num_tiles)


@dataclass(frozen=True)
class PairCounts:
    """How many pairs of a Gaussian and a tile each view of a call has, on their way to the host."""

    counts: Tensor
    """In the host's memory once `arrived` has happened; on the device while a CUDA graph is captured. int64 [C]"""
    arrived: torch.cuda.Event | None  # None where the host need not wait

    @staticmethod
    def sent(counts: Tensor) -> PairCounts:
        """Start to copy counts, int64 [C], from any device to the host; they may be overwritten after this call."""
        if counts.device.type != "cuda":
            return PairCounts(counts.clone(), None)
        on_host = torch.empty(counts.shape, dtype=torch.int64, pin_memory=True).copy_(counts, non_blocking=True)
        arrived = torch.cuda.Event()
        arrived.record()
        return PairCounts(on_host, arrived)

    def ready(self) -> bool:
        """Return whether they have arrived, without waiting."""
        return self.arrived is None or self.arrived.query()

    def wait(self) -> list[int]:
        """Wait until they have arrived, and return them."""
        if self.arrived is not None and not self.arrived.query():
            self.arrived.synchronize()
        return self.counts.tolist()


class TileLists(NamedTuple):
    """Which Gaussians each tile draws."""

    starts: Tensor
    """Where each tile's list starts. int32 [C, tile rows, tile columns], with one more row of given length"""
    ids: Tensor  # Indices in C · N that the lists hold, from front to back. int32 [number of pairs, or `capacity`]
    overflowed: Tensor  # 1 if the given length was too short, so that nothing is drawn, else 0. int64 [1]


@dataclass(frozen=True)
class PendingTiles:
    """Tile lists whose length is on its way to the host, which may give the device other work meanwhile."""

    ellipses: list[Tensor]  # means2d [C, N, 2], radii [C, N(, 2)], conics [C, N, 3] and opacities [C, N]
    order: Tensor  # Indices in C · N of the Gaussians of all views, from front to back. int64 [C * N]
    ends: Tensor  # Where the pairs of each Gaussian end, in this order. int64 [C * N]
    pair_counts: PairCounts  # Their number in each view, whose sum is the last of `ends`
    tile_size: int  # px
    tile_counts: tuple[int, int, int]  # Numbers of views, and of rows and columns of tiles in each

    @torch.no_grad()
    def lists(self, capacity: int | None = None) -> TileLists:
        """Make the lists with a given length, in [1, 2³¹), or wait for the exact length.

        Lists of a given length have one more row of tiles in each view, which lies below the image. The last tile of
        that row in the last view gets the places that are left, so that nobody draws them. If there are more pairs than
        places, it gets all of them, and the radii that the lists were made of are set to 0: then nothing is drawn, no
        gradient flows and no statistic counts the views. Raises InputError if 32 bits do not number the pairs.
        """
        views, rows, columns = self.tile_counts
        if capacity is None:
            num_pairs = sum(self.pair_counts.wait())
            rows_per_view = rows
        else:
            num_pairs = capacity
            rows_per_view = rows + 1
        check_pairs(num_pairs)
        num_tiles = views * rows_per_view * columns
        device = self.ends.device
        tile_type = torch.int32
        if num_tiles <= 2 * _MIDDLE_TILE.value:
            tile_type = torch.int16
        tiles = torch.empty(num_pairs, dtype=tile_type, device=device)
        ids = torch.empty(num_pairs, dtype=torch.int32, device=device)
        n = len(self.order)
        per_gaussian = self.ellipses[1].dim() - 1
        # A Gaussian of p > _FEW_PAIRS pairs has at most p / _PART_PAIRS + 1 parts.
        most_parts = num_pairs // _PART_PAIRS + num_pairs // (_FEW_PAIRS + 1) + 1
        # Each of the two numbers begins at 16 bytes, because Triton would compile anew for what is less aligned.
        parts = self.order.new_empty(most_parts)
        numbers = self.order.new_zeros(3)
        part_count = numbers[:1]
        overflowed = numbers[2:]
        listed = (*self.ellipses, self.order, self.ends, tiles, ids, parts, part_count)
        _list[cdiv(n, _LANES),](
            *listed, overflowed, n, n // views, num_pairs, num_tiles, columns, rows, rows_per_view,
            per_gaussian, self.tile_size, _LANES, _FEW_PAIRS, _PART_PAIRS, num_warps=1,
        )  # fmt: skip
        _list_parts[min(most_parts, _PROGRAMS),](
            *listed, n // views, columns, rows, rows_per_view,
            per_gaussian, self.tile_size, _PART_PAIRS, _PART_ROWS, _PART_COLUMNS, num_warps=1,
        )  # fmt: skip
        tiles, by_tile = tiles.sort(stable=True)
        starts = ids.new_empty((views, rows_per_view, columns))
        ordered = torch.empty_like(ids)
        of_pairs = cdiv(num_pairs, _ORDER_LANES)
        _order[of_pairs + cdiv(num_tiles, _ORDER_LANES),](
            tiles, by_tile, ids, ordered, starts, num_pairs, num_tiles, of_pairs, num_pairs.bit_length(), _ORDER_LANES
        )
        return TileLists(starts, ordered, overflowed)


@torch.no_grad()
def intersect_tiles(
    means2d: Tensor, radii: Tensor, depths: Tensor, conics: Tensor, opacities: Tensor,
    width: int, height: int, tile_size: int, max_off_axis: float = 0.0,
) -> PendingTiles:  # fmt: skip
    """Begin to list the Gaussians of each tile, in place of gsplat's `isect_tiles` and `isect_offset_encode`.

    The tensors are those of `render.types.Projected`. The radii should be contiguous: they are set to 0 in place where
    a Gaussian is culled here, as `render.off_axis.cull_off_axis` does, and by `lists` where its capacity is too small.
    `tile_size`, in px, is a power of two. Give the device other work before asking the result for its lists.
    """
    num_views, num_gaussians = means2d.shape[:2]
    tile_width = cdiv(width, tile_size)
    tile_height = cdiv(height, tile_size)
    ellipses = [value.contiguous() for value in (means2d, radii, conics, opacities)]
    n = num_views * num_gaussians
    device = means2d.device
    counts = torch.empty(n, dtype=torch.int64, device=device)  # cumsum would convert others
    _count[cdiv(n, _LANES),](
        *ellipses, counts, n, tile_width, tile_height,
        width / 2, height / 2, max_off_axis * width / 2, max_off_axis * height / 2,
        radii.dim() - 1, tile_size, max_off_axis > 0, _LANES, num_warps=1,
    )  # fmt: skip
    # The Gaussians are sorted by depth, and then their pairs by tile in 16 or 32 bits. That moves a fraction of the
    # bytes of one sort of the pairs by both in 64 bits. Both sorts are stable, as gsplat's is.
    order = depths.flatten().argsort(stable=True)
    ends = counts[order].cumsum(0)
    if num_views == 1:
        per_view = ends[-1:]
    else:
        per_view = counts.view(num_views, -1).sum(1)
    if device.type == "cuda" and torch.cuda.is_current_stream_capturing():
        pair_counts = PairCounts(per_view, None)
    else:
        pair_counts = PairCounts.sent(per_view)
    return PendingTiles(ellipses, order, ends, pair_counts, tile_size, (num_views, tile_height, tile_width))
