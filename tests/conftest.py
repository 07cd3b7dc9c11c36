"""Fixtures that several modules share, and the third-party warnings that the project's "error" filter lets pass: named,
so that ours still fail a test.

Where there is a GPU, tests train on it; those that compare runs bit by bit, or fork processes, take the CPU instead.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import torch
from hypothesis import HealthCheck, settings

# How long an example takes says nothing on a busy machine.
patient = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("patient", patient)
settings.register_profile("long", patient, max_examples=5000)  # pytest --hypothesis-profile=long
settings.load_profile("patient")

if "PYTEST_XDIST_WORKER" in os.environ and "OMP_NUM_THREADS" not in os.environ:
    # Where each worker's torch has a thread for every core, they wait for each other's: training takes four times as
    # long. The environment is for the processes that tests start.
    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)

THREADS = torch.get_num_threads()
# gsply's numba sets OpenMP's number of threads, torch's too, for all that follows in the process.
os.environ["NUMBA_NUM_THREADS"] = str(THREADS)

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # read when a kernel is defined: they then run on the CPU, slowly
    with contextlib.suppress(ImportError, AttributeError, TypeError):
        from helpers.quick_interpreter import speed_up

        speed_up()

if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    # Where a shell lets its children ignore Ctrl-C (nohup, in the background), so would the runs that tests interrupt.
    signal.signal(signal.SIGINT, signal.default_int_handler)

if TYPE_CHECKING:  # imported by the fixtures alone: nerfstudio takes seconds
    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

    from sadgs_ns.training.config import SadgsTrainerConfig

THIRD_PARTY_WARNINGS = (
    # nerfstudio's activations still use torch.cuda.amp's decorators.
    "ignore:`torch.cuda.amp.custom_(fwd|bwd):FutureWarning",
    # nerfstudio's trainer makes a torch.cuda.amp.GradScaler, which says that there is no CUDA.
    "ignore:`torch.cuda.amp.GradScaler:FutureWarning",
    "ignore:torch.cuda.amp.GradScaler is enabled, but CUDA is not available:UserWarning",
    # nerfstudio's trainer enters torch.autocast("cpu", enabled=False), whose default dtype it does not name.
    "ignore:In CPU autocast:UserWarning",
    # nerfstudio's cameras index a tensor with a list.
    "ignore:Using a non-tuple sequence for multidimensional indexing:UserWarning",
    # Modules that nerfstudio imports are compiled with torch.jit, which Python 3.14 will not have.
    r"ignore:`torch.jit.\w+` is deprecated:DeprecationWarning",
    # viser imports websockets' old names.
    "ignore:websockets.connection was renamed:DeprecationWarning",
    "ignore:websockets.legacy is deprecated:DeprecationWarning",
    # nerfstudio's writer logs the loss as it is, with its graph.
    "ignore:Converting a tensor with requires_grad=True to a scalar:UserWarning",
    # nerfstudio's OrientedBox copies tensors with torch.tensor.
    "ignore:To copy construct from a tensor:UserWarning",
    # Triton's interpreter makes Python numbers of arrays with one element.
    "ignore:Conversion of an array with ndim:DeprecationWarning",
    # numba, which gsply uses, finds the older TBB that open3d has loaded, and takes another of its threading layers.
    "ignore:.*The TBB threading layer requires TBB version:Warning",
    # torchmetrics makes AlexNet for LPIPS with torchvision's old arguments.
    "ignore:The parameter 'pretrained' is deprecated:UserWarning",
    "ignore:Arguments other than a weight enum:UserWarning",
)


def pytest_configure(config: pytest.Config) -> None:
    for warning in THIRD_PARTY_WARNINGS:
        config.addinivalue_line("filterwarnings", warning)


@pytest.hookimpl(trylast=True)  # after all fixtures
def pytest_runtest_teardown() -> None:
    assert torch.get_num_threads() == THREADS, "every later test of this process would compute with other threads"
    close_loggers()


def close_loggers() -> None:
    """Take away the loggers of the test's runs, to which all later runs of this process would write, too."""
    writer = sys.modules.get("nerfstudio.utils.writer")
    if writer is not None:
        for logger in writer.EVENT_WRITERS:
            if hasattr(logger, "tb_writer"):
                logger.tb_writer.close()  # which has a thread and a file
        writer.EVENT_WRITERS.clear()


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small drawn COLMAP dataset, to be read only."""
    from examples.drawn_scene.scene import write_scene
    from helpers.small_scenes import HEIGHT, POINTS, VIEWS, WIDTH

    folder = tmp_path_factory.mktemp("colmap") / "scene"
    write_scene(folder, WIDTH, HEIGHT, VIEWS, POINTS)
    return folder


@pytest.fixture(scope="session")
def open3d() -> None:
    """Skip where open3d, which parts of nerfstudio need, cannot be imported: it wants libusb."""
    from sadgs_ns.errors import InputError
    from sadgs_ns.formats.mesh import load_open3d

    try:
        load_open3d()
    except InputError as error:
        pytest.skip(f"open3d cannot be imported here: {error}")


@pytest.fixture
def colmap(scene: Path) -> ColmapDataParserConfig:
    """The scene's parser, with every 8th view held out."""
    from helpers.kill_and_resume import parser_of

    return parser_of(scene)


@pytest.fixture
def config(scene: Path, tmp_path: Path) -> SadgsTrainerConfig:
    """A run on the scene of a few iterations that saves only at its end."""
    from helpers.kill_and_resume import configure
    from helpers.small_scenes import ITERATIONS

    return configure(scene, tmp_path, ITERATIONS, save_every=0)
