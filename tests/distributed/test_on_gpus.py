"""Two GPUs draw, differentiate and train what one does, over NCCL.

The processes are started by torchrun, since those of tests/helpers/forked_python.py see no GPU. This module is their
program.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from torch.testing import assert_close

from helpers.closeness import assert_within
from helpers.sharded_rendering import GAUSSIANS, inputs, splats, weights
from sadgs_ns.distributed.rasterization import rasterize
from sadgs_ns.distributed.world import World
from sadgs_ns.render.rasterization import rasterize as rasterize_alone
from sadgs_ns.render.rasterization import visible
from sadgs_ns.render.types import RenderOptions

GPUS = pytest.mark.skipif(torch.cuda.device_count() < 2, reason="two GPUs are needed")
TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]


def run(command: list[str]) -> subprocess.CompletedProcess[str]:
    """Run a program that finds the modules that this one does."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=240, check=False)


def compare_with_one(world: World, views: int) -> None:
    """Compare this process's part of images, gradients and absolute gradients with those of one process."""
    device = world.device
    weight = weights(views).to(device)
    options = RenderOptions(sh_degree=1, absgrad=True)
    alone = {name: value.detach().to(device).requires_grad_() for name, value in inputs().items()}
    colors, alphas, info = rasterize_alone(*splats(alone, views), options)
    expected = torch.cat([colors, alphas], dim=-1)
    info["means2d"].grad2d = None
    (expected * weight).sum().backward()

    part = world.take_even_part(GAUSSIANS)
    mine = {name: value.detach().to(device).requires_grad_() for name, value in inputs(part).items()}
    rendered, own = rasterize(world, *splats(mine, views), options)
    loss = own["anchor"]
    for band, colors, alphas in rendered:
        assert band is not None
        image = torch.cat([colors, alphas], dim=-1)[0, band.first - band.top : band.last - band.top]
        rows = slice(band.first, band.last)
        assert_within(image, expected[band.view, rows], 1e-5)
        loss = loss + (image * weight[band.view, rows]).sum()
    loss.backward()
    seen = visible(own)
    assert torch.equal(seen, visible(info)[:, part])
    for name in ("grad2d", "absgrad"):
        whole = getattr(info["means2d"], name)[:, part]
        scale = float(whole[seen].abs().max())
        actual = getattr(own["means2d"], name)[seen]
        assert_close(actual, whole[seen], atol=1e-3 * scale, rtol=1e-2)
    for name, leaf in mine.items():
        gradient = alone[name].grad
        assert gradient is not None
        assert_close(leaf.grad, gradient[part], atol=1e-3 * float(gradient.abs().max()), rtol=1e-2)


@GPUS
def test_two_gpus_draw_and_differentiate_what_one_does():
    result = run([*TORCHRUN, __file__])
    assert result.returncode == 0, result.stdout + result.stderr
    assert result.stdout.count("as one GPU does") == 2


def assert_finished(result: subprocess.CompletedProcess[str], folder: Path) -> None:
    """Compare what a run printed and saved with what a run of one process does."""
    assert result.returncode == 0, result.stdout + result.stderr
    (checkpoint,) = folder.rglob("*.ckpt")
    state = torch.load(checkpoint, weights_only=True)
    number = len(state["pipeline"]["_model.gauss_params.means"])
    assert number > 100
    assert len(state["optimizers"]["means"]["state"][0]["exp_avg"]) == number
    assert len(re.findall("Training Finished", result.stdout)) == 1


@GPUS
@pytest.mark.parametrize("start", ["nerfstudio", "torchrun"])
def test_a_run_on_two_gpus_ends_with_one_checkpoint(start: str, scene: Path, tmp_path: Path):
    options = [
        "sadgs", "--data", str(scene), "--output-dir", str(tmp_path), "--experiment-name", "test",
        "--max-num-iterations", "60", "--pipeline.views-per-iteration", "2",
        "--pipeline.model.strategy.max-gaussians", "5000", "--share-always", "True",
    ]  # fmt: skip
    if start == "nerfstudio":
        command = [sys.executable, "-m", "nerfstudio.scripts.train", *options, "--machine.num-devices", "2"]
    else:
        command = [*TORCHRUN, "-m", "nerfstudio.scripts.train", *options]
    result = run(command)
    assert_finished(result, tmp_path)


@GPUS
@pytest.mark.parametrize("tier", ["compressed", "cpu"])
def test_two_gpus_train_on_images_of_several_sizes_that_are_on_the_host(tier: str, tmp_path: Path):
    from helpers.short_runs import nerfstudio_data  # It imports nerfstudio, which the program below does without.

    parser = nerfstudio_data(tmp_path / "data", [(48, 36), (40, 30)], masks=True)
    result = run([
        *TORCHRUN, "-m", "nerfstudio.scripts.train", "sadgs", "--data", str(parser.data),
        "--output-dir", str(tmp_path), "--max-num-iterations", "60", "--pipeline.views-per-iteration", "3",
        "--pipeline.datamanager.cache-images", tier, "--pipeline.model.num-random", "300", "--share-always", "True",
    ])  # fmt: skip
    assert_finished(result, tmp_path)


def main() -> None:
    local = int(os.environ["LOCAL_RANK"])
    torch.cuda.set_device(local)
    dist.init_process_group("nccl")
    world = World(torch.device("cuda", local))
    for views in (1, 2, 3):
        compare_with_one(world, views)
    print(f"Rank {world.rank} draws and differentiates as one GPU does.", flush=True)
    dist.destroy_process_group()


if __name__ == "__main__":
    main()
