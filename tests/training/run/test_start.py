"""The start of training in `sadgs`, which must train as `ns-train` does, without what nerfstudio imports beside it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from helpers import forked_python
from helpers.kill_and_resume import differences
from helpers.small_scenes import VIEWS
from sadgs_ns.training.run.deferred_imports import DEFERRED, TorchForCameras

UNUSED = (
    "nerfstudio.configs.method_configs", "nerfstudio.viewer.viewer", "nerfstudio.scripts.train", "torch._dynamo",
    "torch._inductor", "torchvision", "torch.utils.tensorboard", "tensorly", "viser", "requests", "sympy", "matplotlib",
)  # fmt: skip
TRAINING = f"""
import json, sys
from sadgs_ns.training.run.deferred_imports import StandIn
from sadgs_ns.training.run.start import train
del sys.argv[0]
train()
held = [
    (name, of.__name__) for name, module in list(sys.modules.items()) for of in list(vars(module).values())
    if type(of) is StandIn
]
unused = [name for name in {UNUSED} if name in sys.modules]
left = [name for name, module in sys.modules.items() if type(module) is StandIn]
from nerfstudio.model_components import lib_bilagrid
from nerfstudio.models import splatfacto
from nerfstudio.pipelines import base_pipeline
from nerfstudio.utils import tensor_dataclass, writer
import torch, torchvision, viser
from torch.utils.tensorboard import SummaryWriter
of_cameras = tensor_dataclass.torch.broadcast_shapes
resolved = [
    base_pipeline.vutils.save_image is torchvision.utils.save_image,
    type(writer.SummaryWriter(log_dir="logs")) is SummaryWriter,
    splatfacto.color_correct.__call__(torch.ones(2, 2, 3), torch.ones(2, 2, 3)).shape == (2, 2, 3),
    sys.modules["nerfstudio.engine.trainer"].viser.ViserServer is viser.ViserServer,
    of_cameras((2, 1), 3) == (2, 3) == of_cameras(torch.Size([2, 3])),
    of_cameras is not torch.broadcast_shapes and torch.broadcast_shapes.__module__ == "torch.functional",
    tensor_dataclass.torch.Tensor is torch.Tensor,
]
import nerfstudio.scripts.train  # as for several GPUs
print(json.dumps({{"held": held, "unused": unused, "left": left, "resolved": resolved}}))
"""


@pytest.fixture(scope="module")
def runs(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, dict[str, Any]]:
    """Folders of a run of `ns-train sadgs`, and of one with our start, and what the process of the second told."""
    folder = tmp_path_factory.mktemp("start")
    words = ["ns-train", "sadgs", "--data", str(scene), "--output-dir", str(folder / "out"), "--timestamp", "run"]
    words += ["--vis", "none", "--max-num-iterations", "12", "--pipeline.model.strategy.structure-every", "4"]
    words += ["--pipeline.model.strategy.refine-start-iter", "1", "--pipeline.model.strategy.min-observations", "1"]
    words += ["--machine.device-type", "cpu", "colmap", "--colmap-path", "sparse/0", "--downscale-factor", "1"]
    made = forked_python.python(forked_python.NS_TRAIN.format(words))
    assert made.returncode == 0, made.stderr
    shutil.move(folder / "out", folder / "ns-train")
    command = [sys.executable, "-W", "ignore", "-c", TRAINING, *words]
    environment = os.environ | {"CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=folder, env=environment, timeout=forked_python.HANGS
    )
    assert done.returncode == 0, done.stderr
    found = [next((folder / name).glob("*/sadgs/run")) for name in ("ns-train", "out")]
    return found[0], found[1], json.loads(done.stdout.splitlines()[-1])


def test_a_run_is_that_of_ns_train_bit_by_bit(runs: tuple[Path, Path, dict[str, Any]]):
    theirs, ours, _ = runs
    for name in ("config.yml", "plan.yml", "dataparser_transforms.json"):
        assert (ours / name).read_bytes() == (theirs / name).read_bytes(), name
    checkpoints = [torch.load(next(run.glob("nerfstudio_models/*.ckpt")), weights_only=True) for run in (theirs, ours)]
    assert checkpoints[0]["step"] == 11
    assert len(checkpoints[0]["pipeline"]["_model.gauss_params.means"]) > VIEWS
    assert differences(*checkpoints) == []


def test_nothing_is_imported_that_training_does_not_use(runs: tuple[Path, Path, dict[str, Any]]):
    assert runs[2]["unused"] == []


def test_stand_ins_lie_only_where_nerfstudio_asked_for_them(runs: tuple[Path, Path, dict[str, Any]]):
    told = runs[2]
    assert told["left"] == [], "others would import it"
    names = {name for names in DEFERRED.values() for name in names}
    actual = {holder.partition(".")[0] for holder, _ in told["held"]}
    assert actual == {"nerfstudio"}
    for _, held in told["held"]:
        assert any(f"{held}.".startswith(f"{name}.") for name in names), held


def test_a_stand_in_is_the_true_thing_for_who_asks(runs: tuple[Path, Path, dict[str, Any]]):
    assert runs[2]["resolved"] == [True] * 7


def test_shapes_of_cameras_that_do_not_fit_are_refused_as_by_torch():
    shapes = TorchForCameras("torch").broadcast_shapes
    for wrong in [((2, 3), (4,)), ((2,), "3")]:
        with pytest.raises(RuntimeError) as ours:
            shapes(*wrong)
        with pytest.raises(RuntimeError) as theirs:
            torch.broadcast_shapes(*wrong)
        assert str(ours.value) == str(theirs.value)
