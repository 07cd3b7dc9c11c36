"""Fuzz: malformed presets and damaged COLMAP models end in success or an error, never in a hang, a crash or gigabytes.

The examples are drawn anew in each run; hypothesis prints the one that fails, and how to repeat it. More of them:
`pytest tests/test_fuzz.py --hypothesis-profile=long`.
"""

from __future__ import annotations

import resource
import shutil
import signal
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.plugins.types import MethodSpecification

from sadgs_ns.data.validation.parsers import refuse_bad_data
from sadgs_ns.demo.scene import SPARSE_FOLDER, write_scene
from sadgs_ns.errors import InputError
from sadgs_ns.plugin import presets
from sadgs_ns.plugin.datamanager import SadgsDatamanagerConfig
from sadgs_ns.plugin.presets import OPTIMIZER_GROUPS, load_preset

FEW = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
MEMORY = 1 << 30
"""Bytes that an example may allocate on top of what the process has."""
SECONDS = 20
"""Time that an example may take."""


@contextmanager
def bounded() -> Iterator[None]:
    """Fail what takes too long or too much memory; both end with an error here instead of the machine's."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limits = resource.getrlimit(resource.RLIMIT_AS)

    def too_long(number: int, frame: object) -> None:
        raise AssertionError(f"an example took more than {SECONDS} s")

    previous = signal.signal(signal.SIGALRM, too_long)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, limits[1]))
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, previous)
        resource.setrlimit(resource.RLIMIT_AS, limits)


# --- presets ---


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Stands for `configs/`."""
    path = tmp_path_factory.mktemp("configs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(presets, "_configs", lambda: path)
        yield path


def outcome(folder: Path, content: bytes) -> MethodSpecification | str:
    """The preset, or the error, which must be one line that names the file."""
    (folder / "p.yaml").write_bytes(content)
    with bounded():
        try:
            return load_preset("p")
        except ValueError as error:
            message = str(error)
    assert message.startswith("p.yaml") and len(message.splitlines()) == 1 and len(message) < 4000, message
    return message


SADGS = (Path(__file__).parents[2] / "configs" / "sadgs.yaml").read_text()
hashable = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.dates()
hashable |= st.sampled_from(["white", "1e-3", 10**400, -1, 0.5, "SO3xR3", b"bytes"])
scalars = hashable | st.just([1, 2])
KEYS = """
    max_num_iterations pipeline model strategy tau_split optimizers description viewer machine data load_dir load_step
    gradient_accumulation_steps vis means lr schedule final_factor max_steps max_norm _target datamanager dataparser
    camera_optimizer mode background_color
"""
keys = st.sampled_from(KEYS.split())
values = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(keys | hashable, inner, max_size=4),
    max_leaves=12,
)


@given(st.dictionaries(keys, values, max_size=5))
@FEW
def test_any_change_to_a_preset_loads_or_is_one_line_that_names_the_file(folder: Path, change: dict[str, Any]):
    content = yaml.safe_load(SADGS) | change
    result = outcome(folder, yaml.safe_dump(content).encode())
    if isinstance(result, MethodSpecification):
        assert result.config.method_name == "p" and set(result.config.optimizers) == set(OPTIMIZER_GROUPS)


PATHS = """
    max_num_iterations load_step load_dir vis gradient_accumulation_steps machine.seed viewer viewer.websocket_port
    pipeline.views_per_iteration pipeline.model.background_color pipeline.model.strategy.tau_split
    pipeline.datamanager.data optimizers optimizers.means optimizers.means.lr optimizers.means.max_norm
    optimizers.means.schedule.max_steps optimizers.quats.schedule description
"""
paths = st.sampled_from([path.split(".") for path in PATHS.split()])


@given(paths, values)
@FEW
def test_any_value_of_a_known_key_loads_or_the_line_names_the_key(folder: Path, path: list[str], value: Any):
    content = yaml.safe_load(SADGS)
    inner = content
    for name in path[:-1]:
        inner = inner.setdefault(name, {})
    inner[path[-1]] = value
    result = outcome(folder, yaml.safe_dump(content).encode())
    if isinstance(result, str):
        assert any(name in result for name in path[-2:])


@given(st.binary(max_size=60) | st.text(max_size=60).map(lambda text: text.encode("utf8", "surrogatepass")))
@example(b"[" * 5000)
@example(b"&a [*a]")
@example(b"a: !!timestamp x")
@example(b"a: !!bool x")
@example(b"a: !!int ''")
@example(b"a: 2020-99-99")
@example(b"<<: 1")
@example(b"\xff\xfe")
@example(b"")
@example(b"- description")
@example(b"description: d\noptimizers: 3")
@example(b"description: d\noptimizers: {means: 3}")
@example(b"description: d\noptimizers: {means: {schedule: 3}}")
@example(b"description: d\noptimizers: {positions: {lr: 1.0}}")
@example(b"description: [d]\noptimizers: {}")
@example(b"description: d\noptimizers: {}")
@example(b"description: d\noptimizers: {}\nload_step: soon")
@example(b"description: d\noptimizers: {}\nload_step: true")
@example(b"description: d\noptimizers: {}\n? [a, b]\n: c")
@example(("a: " + "9" * 5000).encode())
@FEW
def test_text_that_is_no_preset_is_one_line_that_names_the_file(folder: Path, content: bytes):
    assert isinstance(outcome(folder, content), str)


@given(st.integers(0, len(SADGS) - 1), st.characters() | st.just(""), st.integers(0, 3))
@FEW
def test_a_preset_with_a_few_characters_changed_loads_or_is_one_line(
    folder: Path, at: int, inserted: str, deleted: int
):
    text = SADGS[:at] + inserted + SADGS[at + deleted :]
    outcome(folder, text.encode("utf8", "surrogatepass"))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("load_step: soon", "p.yaml: load_step must be Optional[int], got str 'soon'."),
        ("load_step: true", "p.yaml: load_step must be Optional[int], got bool True."),
        ("vis: everything", "p.yaml: vis must be Literal['viewer',"),
        ("gradient_accumulation_steps: {means: many}", "p.yaml: gradient_accumulation_steps must be Dict[str, int],"),
        ("optimizers: {positions: {lr: 1.0}}", "p.yaml: optimizers: unknown group 'positions'; known are means,"),
        ("optimizers: {means: {lr: 1.0}}", "p.yaml: optimizers lacks 'features_dc'; add it."),
        ("optimizers: {means: {max_norm: much}}", "p.yaml: optimizers.means: max_norm must be Optional[float],"),
    ],
)
def test_what_was_accepted_before_is_refused_by_name(text: str, sentence: str, folder: Path):
    key = text.partition(":")[0]
    content = {**yaml.safe_load(SADGS), key: yaml.safe_load(text)[key]}
    result = outcome(folder, yaml.safe_dump(content).encode())
    assert isinstance(result, str) and result.startswith(sentence)


def test_values_of_an_empty_field_s_type_load(folder: Path):
    content = {**yaml.safe_load(SADGS), "load_step": 3, "load_dir": "some/folder"}
    result = outcome(folder, yaml.safe_dump(content).encode())
    assert isinstance(result, MethodSpecification)
    assert (result.config.load_step, result.config.load_dir) == (3, Path("some/folder"))


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
            refuse_bad_data(config)
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


@given(st.lists(damages, min_size=1, max_size=3))
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
    assert message is not None and message.startswith(f"{path} is cut off or corrupt")
