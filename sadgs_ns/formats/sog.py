"""SOG, PlayCanvas's layout, version 2: a zip archive of lossless WebP images, one pixel a Gaussian, and `meta.json`.

Positions have 16 bits, evenly in sign(x) ln(1 + |x|), each of the three smallest components of quaternions 8 bits, and
opacities 8 bits. Scales and colours have 256 levels, chosen for the scene. A Gaussian's higher harmonics are one of up
to 65,536 sets, found by k-means, with values of 256 levels.
"""

from __future__ import annotations

import io
import json
import math
import warnings
import zipfile
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sadgs_ns.formats.gaussians import Context, Gaussians
from sadgs_ns.formats.packing import codebook, morton_order, nearest_level, sigmoid, smallest_three, to_bytes

_PALETTE = 1 << 16  # Most sets of higher harmonics
_SETS_A_ROW = 64  # Sets of harmonics in a row of their image
_SAMPLE = 1 << 16  # Sets of harmonics from which the coarse clusters are made
_ROUNDS = 8  # Rounds of k-means


def write(file: IO[bytes], gaussians: Gaussians, _: Context) -> None:
    """Write at least one Gaussian as SOG, neighbours together."""
    gaussians = gaussians[morton_order(gaussians.means)]
    count = len(gaussians)
    width = 4 * math.ceil(math.sqrt(count) / 4)
    logs = np.sign(gaussians.means) * np.log1p(np.abs(gaussians.means.astype(np.float64)))
    low = logs.min(axis=0)
    high = logs.max(axis=0)
    span = np.where(high > low, high - low, 1)
    positions = np.rint((logs - low) / span * 65535).astype(np.uint16)
    largest, others = smallest_three(gaussians.quats)
    other_bytes = to_bytes(255 * (others * math.sqrt(0.5) + 0.5))
    largest_bytes = (252 + largest).astype(np.uint8)
    scale_levels = codebook(gaussians.scales)
    color_levels = codebook(gaussians.features_dc)
    colors = nearest_level(gaussians.features_dc, color_levels)
    alphas = to_bytes(255 * sigmoid(gaussians.opacities))
    images = {
        "means_l": _image((positions & 255).astype(np.uint8), width),
        "means_u": _image((positions >> 8).astype(np.uint8), width),
        "quats": _image(np.c_[other_bytes, largest_bytes], width),
        "scales": _image(nearest_level(gaussians.scales, scale_levels), width),
        "sh0": _image(np.c_[colors, alphas], width),
    }
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "sadgs_ns"},
        "count": count,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_levels.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_levels.tolist(), "files": ["sh0.webp"]},
    }
    if gaussians.degree:
        bands = gaussians.features_rest.shape[1]
        sets, labels = palette(gaussians.features_rest.reshape(count, -1))
        levels = codebook(sets)
        centroids = nearest_level(sets, levels).reshape(-1, 3)
        label_bytes = np.stack([labels & 255, labels >> 8, 0 * labels], axis=1)  # [N, 3]
        images["shN_centroids"] = _image(centroids, _SETS_A_ROW * bands)
        images["shN_labels"] = _image(label_bytes.astype(np.uint8), width)
        meta["shN"] = {
            "count": len(sets),
            "bands": gaussians.degree,
            "codebook": levels.tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    with zipfile.ZipFile(file, "w") as archive:
        for name, image in images.items():
            encoded = io.BytesIO()
            image.save(encoded, "webp", lossless=True, exact=True, quality=50, method=4)
            entry = zipfile.ZipInfo(f"{name}.webp")
            archive.writestr(entry, encoded.getvalue())
        entry = zipfile.ZipInfo("meta.json")
        archive.writestr(entry, json.dumps(meta))


def _image(pixels: NDArray[np.uint8], width: int) -> Image.Image:
    """Return an image of opaque RGB, or RGBA, pixels in rows. [P, 3] or [P, 4]"""
    height = math.ceil(len(pixels) / width)
    whole = np.zeros((height * width, 4), np.uint8)
    whole[:, 3] = 255
    number, channels = pixels.shape
    whole[:number, :channels] = pixels
    return Image.fromarray(whole.reshape(height, width, 4))


def palette(vectors: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return a palette [P, D] of vectors [N, D], and the index of each vector's entry in the palette [N].

    P is at most `_PALETTE`. k-means finds coarse clusters of a sample, and then fine ones in each coarse cluster, as
    many as its share of the vectors asks for. A vector is so compared with about 2 √P centres in a round; one k-means
    of all vectors would compare it with P.
    """
    number = min(_PALETTE, len(vectors) // 2 + 1)
    generator = np.random.default_rng(0)
    sample = vectors
    if len(vectors) > _SAMPLE:
        chosen = generator.choice(len(vectors), _SAMPLE, replace=False)
        sample = vectors[chosen]
    coarse = _k_means(sample, math.isqrt(number), generator)
    parts = np.array_split(vectors, len(vectors) // _SAMPLE + 1)
    coarse_labels = np.concatenate([_nearest(part, coarse) for part in parts])
    centers = []
    labels = np.empty(len(vectors), np.int64)
    used = 0
    for cluster in range(len(coarse)):
        (members,) = (coarse_labels == cluster).nonzero()
        if not len(members):
            continue
        share = number * len(members) // len(vectors)
        # One less, because shares below 1 are rounded up: all together must not exceed the palette.
        num_fine = max(share - 1, 1)
        fine = _k_means(vectors[members], num_fine, generator)
        labels[members] = used + _nearest(vectors[members], fine)
        centers.append(fine)
        used += len(fine)
    return np.concatenate(centers), labels


def _k_means(vectors: NDArray[np.float32], number: int, generator: np.random.Generator) -> NDArray[np.float32]:
    """Return the centres of `number` clusters of vectors, which are at least as many. [N, D] → [number, D]"""
    from scipy.cluster.vq import kmeans2  # It takes a third of a second to import.

    chosen = generator.choice(len(vectors), number, replace=False)
    start = vectors[chosen]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Of clusters that became empty, which keep their centre.
        centers, _ = kmeans2(vectors, start, _ROUNDS, minit="matrix")
    return centers.astype(np.float32)


def _nearest(vectors: NDArray[np.float32], centers: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the index of each vector's nearest centre. [N, D], [M, D] → [N]"""
    from scipy.cluster.vq import vq

    indices, _ = vq(vectors, centers, check_finite=False)
    return indices
