"""Binary glTF 2.0 with the extension KHR_gaussian_splatting: activated parameters in float32, without loss."""

from __future__ import annotations

import json
import struct
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.errors import InputError
from sadgs_ns.formats.gaussians import DEGREE_0, Context, Gaussians
from sadgs_ns.formats.packing import sigmoid, to_bytes

_EXTENSION = "KHR_gaussian_splatting"
# glTF's numbers for types of values, the purpose of a buffer, and the kind of primitives
_FLOAT = 5126
_BYTE = 5121
_ARRAY_BUFFER = 34962
_POINTS = 0
_MOST_BYTES = (1 << 32) - 1
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write(file: IO[bytes], gaussians: Gaussians, context: Context) -> None:
    """Write at least one Gaussian as the points of a mesh; raise InputError beyond the 4 GB that the format can hold.

    Viewers that do not know the extension show coloured points. The node turns y up, as in glTF.
    """
    x, y, z = context.up
    turn = np.array([-z, 0.0, x, 1 + y] if y > -1 else [1.0, 0.0, 0.0, 0.0])  # This quaternion, xyzw, turns up to y.
    attributes = _attributes(gaussians)
    arrays = list(attributes.values())
    sizes = [array.nbytes for array in arrays]
    accessors: list[dict[str, Any]] = []
    for index, array in enumerate(arrays):
        kind = {"componentType": _BYTE if array.dtype == np.uint8 else _FLOAT, "type": _TYPES[array.shape[1]]}
        accessors.append({"bufferView": index, "count": len(gaussians), **kind})
    accessors[0] |= {"min": gaussians.means.min(axis=0).tolist(), "max": gaussians.means.max(axis=0).tolist()}
    accessors[list(attributes).index("COLOR_0")]["normalized"] = True
    properties = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "sortingMethod": "cameraDistance"}
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {_EXTENSION: properties | {"projection": "perspective"}},
    }
    document = {
        "asset": {"version": "2.0", "generator": "sadgs_ns"},
        "extensionsUsed": [_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": (turn / np.linalg.norm(turn)).tolist()}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": sum(sizes[:index]), "byteLength": size, "target": _ARRAY_BUFFER}
            for index, size in enumerate(sizes)
        ],
        "buffers": [{"byteLength": sum(sizes)}],
    }
    head = json.dumps(document).encode()
    head += b" " * (-len(head) % 4)
    total = 12 + 8 + len(head) + 8 + sum(sizes)
    if total > _MOST_BYTES:
        problem = f"{len(gaussians):,} Gaussians take more than the 4 GB that glTF can hold"
        raise InputError(f"{problem}: choose another format.")
    file.write(struct.pack("<4sIIII", b"glTF", 2, total, len(head), 0x4E4F534A) + head)
    file.write(struct.pack("<II", sum(sizes), 0x004E4942))
    for array in arrays:
        file.write(array.tobytes())


def _attributes(gaussians: Gaussians) -> dict[str, NDArray[Any]]:
    """Return the arrays of a value for each Gaussian, whose sizes are multiples of 4 bytes, by glTF's names."""
    alphas = sigmoid(gaussians.opacities)[:, None]
    colors = np.c_[gaussians.features_dc * np.float32(DEGREE_0) + np.float32(0.5), alphas]
    attributes: dict[str, NDArray[Any]] = {
        "POSITION": gaussians.means,
        "COLOR_0": to_bytes(255 * colors),
        f"{_EXTENSION}:ROTATION": gaussians.quats[:, [1, 2, 3, 0]],
        f"{_EXTENSION}:SCALE": np.exp(gaussians.scales),
        f"{_EXTENSION}:OPACITY": alphas,
        f"{_EXTENSION}:SH_DEGREE_0_COEF_0": gaussians.features_dc,
    }
    for degree in range(1, gaussians.degree + 1):
        for index in range(2 * degree + 1):
            name = f"{_EXTENSION}:SH_DEGREE_{degree}_COEF_{index}"
            attributes[name] = gaussians.features_rest[:, degree**2 - 1 + index]
    return attributes
