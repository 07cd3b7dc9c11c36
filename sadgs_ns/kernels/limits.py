"""The largest sizes that the kernels can address, and their checks.

Addresses have 64 bits, except where that would cost registers.
"""

from __future__ import annotations

from sadgs_ns.errors import InputError

MAX_ROWS = (2**31 - 256) // 3
"""Most Gaussians, and most pixels, of all views of a step, and most pixels of an image with a structure tensor:
rows of three numbers are addressed in 32 bits. A block of 256 numbers that begins below three times this ends there."""
MAX_PAIRS = 2**31 - 1  # Most pairs of a Gaussian and a tile: lists of tiles, here and in gsplat, have places of 32 bits
MAX_BLOCKS = 2**16 - 1  # Most views, and most images times channels: CUDA launches no more blocks along an axis
MAX_HEIGHT = 2 * MAX_BLOCKS  # Two rows of an image are a block of `structure_tensor`.


def _check_limit(limit: int, size: int, what: str, remedy: str) -> None:
    if size > limit:
        raise InputError(f"{what} are {size:,}, and the Triton kernels can address {limit:,}: {remedy}.")


def check_gaussians(num_views: int, num_gaussians: int) -> None:
    """Raise InputError if one step cannot render so many Gaussians in so many views."""
    _check_limit(MAX_BLOCKS, num_views, "The views of one step", "take fewer views at once")
    what = f"The Gaussians of all views of one step, {num_views:,} × {num_gaussians:,},"
    _check_limit(MAX_ROWS, num_views * num_gaussians, what, "take fewer views at once, or fewer Gaussians")


def check_pixels(num_views: int, height: int, width: int) -> None:
    """Raise InputError if one step cannot render and compare so many views of H × W px."""
    _check_limit(MAX_BLOCKS, num_views, "The views of one step", "take fewer views at once")
    _check_limit(MAX_HEIGHT, height, "The rows of an image", "make the images smaller")
    what = f"The pixels of all views of one step, {num_views:,} × {height:,} × {width:,},"
    _check_limit(MAX_ROWS, num_views * height * width, what, "take fewer views at once, or smaller images")


def check_batch(batch: int, channels: int, height: int, width: int) -> None:
    """Raise InputError if images are too many at once, or too large, for the structure tensor's kernels."""
    _check_limit(MAX_BLOCKS, batch * max(channels, 3), "The planes of a batch of images", "take fewer at once")
    _check_limit(MAX_HEIGHT, height, "The rows of an image", "make the images smaller")
    _check_limit(MAX_ROWS, height * width, f"The pixels of an image, {height:,} × {width:,},", "make it smaller")


def check_pairs(num_pairs: int) -> None:
    """Raise InputError if there are too many pairs of a Gaussian and a tile that it reaches, in all views."""
    remedy = "take fewer views at once, smaller images, or fewer and smaller Gaussians"
    _check_limit(MAX_PAIRS, num_pairs, "The pairs of a Gaussian and a tile of all views of one step", remedy)
