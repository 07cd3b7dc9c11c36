"""Fuzz: damaged COLMAP models end in success or an error, never in a hang, a crash or gigabytes.

A run of the suite draws 100 new examples; hypothesis prints the one that fails, and how to repeat it. `pytest
tests/data/test_fuzz.py --hypothesis-profile=long` draws 5,000.
"""

from __future__ import annotations

import resource
import shutil
import signal
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

from examples.drawn_scene.scene import SPARSE_FOLDER, write_scene
from sadgs_ns.data.checks.capture import check_capture
from sadgs_ns.errors import InputError
from sadgs_ns.training.config import SadgsDatamanagerConfig

FEW = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
MEMORY = 1 << 30
"""Bytes that an example may allocate on top of what the process has."""
SECONDS = 20
"""Time of the processor that an example may take."""


@contextmanager
def bounded() -> Iterator[None]:
    """Fail what takes too long or too much memory; both end with an error here instead of the machine's."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limits = resource.getrlimit(resource.RLIMIT_AS)

    def too_long(number: int, frame: object) -> None:
        raise AssertionError(f"an example took more than {SECONDS} s")

    previous = signal.signal(signal.SIGPROF, too_long)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, limits[1]))
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, previous)
        resource.setrlimit(resource.RLIMIT_AS, limits)


# --- COLMAP ---


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "scene"
    write_scene(folder, 16, 16, 9, 10)
    return folder


FILES = ("cameras.bin", "images.bin", "points3D.bin")
flips = st.tuples(st.just("flip"), st.floats(0, 1), st.integers(1, 255))
cuts = st.tuples(st.just("cut"), st.floats(0, 1), st.just(0))
counts = st.tuples(
    st.just("count"), st.floats(0, 1), st.integers(0, 2**64 - 1) | st.sampled_from([2**k for k in range(64)])
)
inserts = st.tuples(st.just("insert"), st.floats(0, 1), st.integers(0, 2**64 - 1))
damages = st.tuples(st.sampled_from(FILES), flips | cuts | counts | inserts)


def damage(content: bytes, kind: str, where: float, value: int) -> bytes:
    """Flip bits of a byte, cut the end off, overwrite eight bytes with a count, or insert them."""
    at = min(int(where * len(content)), len(content) - 1)
    if kind == "flip":
        return content[:at] + bytes([content[at] ^ value]) + content[at + 1 :]
    if kind == "cut":
        return content[:at]
    return content[:at] + struct.pack("<Q", value) + content[at + (8 if kind == "count" else 0) :]


def parse(data: Path) -> str | None:
    """Read a dataset as a run does, up to the images; the error if there is one."""
    parser = ColmapDataParserConfig(data=data, colmap_path=Path(SPARSE_FOLDER), downscale_factor=1)
    config = SadgsDatamanagerConfig(dataparser=parser)
    with bounded():
        try:
            check_capture(config)
            config.setup(device="cpu")
        except InputError as error:
            assert len(str(error).splitlines()) == 1, error
            return str(error)
        except MemoryError as error:
            raise AssertionError("nerfstudio was let to allocate what a file asked for") from error
        except Exception as error:
            return f"{type(error).__name__}: {error}"
    return None


@pytest.fixture(scope="module")
def copy(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene, with files of COLMAP's that a test may damage."""
    return Path(shutil.copytree(scene, tmp_path_factory.mktemp("damaged") / "scene"))


@pytest.mark.hard_case(
    "COLMAP files with bits flipped, cut off, counts overwritten, bytes inserted",
    "it parses or raises within 20 s of CPU time and 1 GiB",
)
@given(st.lists(damages, min_size=1, max_size=3))
@example([("images.bin", ("flip", 0.33887574379230695, 121))])  # A name with a character that ends a line
@FEW
def test_a_damaged_colmap_model_parses_or_raises_within_bounds(
    scene: Path, copy: Path, changes: list[tuple[str, tuple[str, float, int]]]
):
    files = {name: (scene / SPARSE_FOLDER / name).read_bytes() for name in FILES}
    for name, change in changes:
        files[name] = damage(files[name] or b"\0", *change)
    for name, content in files.items():
        (copy / SPARSE_FOLDER / name).write_bytes(content)
    parse(copy)


def test_the_undamaged_model_parses(scene: Path):
    assert parse(scene) is None


@pytest.mark.hard_case(
    "a count of 2³¹ to 2⁶⁴ keypoints or track entries (nerfstudio alone allocates it)", "one sentence names the file"
)
@pytest.mark.parametrize("count", [2**31, 2**34, 2**40, 2**60, 2**64 - 1])
@pytest.mark.parametrize("name", ["images.bin", "points3D.bin"])
def test_a_count_beyond_the_file_is_one_sentence_that_names_it(name: str, count: int, scene: Path, copy: Path):
    for other in FILES:
        shutil.copy(scene / SPARSE_FOLDER / other, copy / SPARSE_FOLDER / other)
    path = copy / SPARSE_FOLDER / name
    content = path.read_bytes()
    # The first image's keypoints follow its pose and name, the first point's track its position, colour and error.
    at = content.index(b"\0", 8 + 64) + 1 if name == "images.bin" else 8 + 43
    path.write_bytes(content[:at] + struct.pack("<Q", count) + content[at + 8 :])
    message = parse(copy)
    assert message is not None
    assert message.startswith(f"{path} is cut off or corrupt")
