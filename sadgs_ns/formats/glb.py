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
_JSON_CHUNK = 0x4E4F534A  # The letters "JSON", by which a file marks its description
_BINARY_CHUNK = 0x004E4942  # The letters "BIN"
_MOST_BYTES = (1 << 32) - 1
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write(file: IO[bytes], gaussians: Gaussians, context: Context) -> None:
    """Write at least one Gaussian as the points of a mesh; raise InputError beyond the 4 GB that the format can hold.

    Viewers that do not know the extension show coloured points. The node turns y up, as in glTF.
    """
    attributes = _attributes(gaussians)
    document = _document(attributes, _turn_to_y(context.up))
    head = json.dumps(document).encode()
    padding = -len(head) % 4
    head += b" " * padding
    content = sum(array.nbytes for array in attributes.values())  # In bytes
    total = 12 + 8 + len(head) + 8 + content
    if total > _MOST_BYTES:
        problem = f"{len(gaussians):,} Gaussians take more than the 4 GB that glTF can hold"
        raise InputError(f"{problem}: choose another format.")
    file.write(struct.pack("<4sII", b"glTF", 2, total))
    file.write(struct.pack("<II", len(head), _JSON_CHUNK))
    file.write(head)
    file.write(struct.pack("<II", content, _BINARY_CHUNK))
    for array in attributes.values():
        file.write(array.tobytes())


def _turn_to_y(up: tuple[float, float, float]) -> list[float]:
    """Return the quaternion, xyzw, that turns an axis of the Gaussians' frame to y."""
    x, y, z = up
    if y > -1:
        turn = np.array([-z, 0.0, x, 1 + y])
    else:
        turn = np.array([1.0, 0.0, 0.0, 0.0])
    return (turn / np.linalg.norm(turn)).tolist()


def _document(attributes: dict[str, NDArray[Any]], rotation: list[float]) -> dict[str, Any]:
    """Return glTF's description of a mesh of points with these attributes, in a node with a rotation."""
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, int]] = []
    offset = 0
    for index, array in enumerate(attributes.values()):
        component = _FLOAT
        if array.dtype == np.uint8:
            component = _BYTE
        count, width = array.shape
        size = array.nbytes
        accessor = {"bufferView": index, "count": count, "componentType": component, "type": _TYPES[width]}
        accessors.append(accessor)
        view = {"buffer": 0, "byteOffset": offset, "byteLength": size, "target": _ARRAY_BUFFER}
        views.append(view)
        offset += size
    numbers = {name: index for index, name in enumerate(attributes)}
    positions = attributes["POSITION"]
    of_positions = accessors[numbers["POSITION"]]
    of_positions["min"] = positions.min(axis=0).tolist()
    of_positions["max"] = positions.max(axis=0).tolist()
    accessors[numbers["COLOR_0"]]["normalized"] = True
    splats = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    }
    primitive = {"attributes": numbers, "mode": _POINTS, "extensions": {_EXTENSION: splats}}
    return {
        "asset": {"version": "2.0", "generator": "sadgs_ns"},
        "extensionsUsed": [_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": rotation}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }


def _attributes(gaussians: Gaussians) -> dict[str, NDArray[Any]]:
    """Return the arrays of a value for each Gaussian, whose sizes are multiples of 4 bytes, by glTF's names."""
    alphas = sigmoid(gaussians.opacities)[:, None]  # [N, 1]
    rgb = gaussians.features_dc * np.float32(DEGREE_0) + np.float32(0.5)
    rgba = np.c_[rgb, alphas]
    attributes: dict[str, NDArray[Any]] = {
        "POSITION": gaussians.means,
        "COLOR_0": to_bytes(255 * rgba),
        f"{_EXTENSION}:ROTATION": gaussians.quats[:, [1, 2, 3, 0]],
        f"{_EXTENSION}:SCALE": np.exp(gaussians.scales),
        f"{_EXTENSION}:OPACITY": alphas,
        f"{_EXTENSION}:SH_DEGREE_0_COEF_0": gaussians.features_dc,
    }
    for degree in range(1, gaussians.degree + 1):
        first_of_degree = degree**2 - 1
        for index in range(2 * degree + 1):
            name = f"{_EXTENSION}:SH_DEGREE_{degree}_COEF_{index}"
            attributes[name] = gaussians.features_rest[:, first_of_degree + index]
    return attributes
