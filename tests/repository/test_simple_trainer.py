"""The example of a plain training loop, which docs/strategy.md prints, with the torch splatter for gsplat's kernels."""

from __future__ import annotations

import inspect
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gsplat
import pytest
import torch

from examples import simple_trainer
from helpers import gsplat_like
from helpers.small_scenes import camera, random_params
from sadgs_ns.method.strategy import StructureAwareStrategy

CHECKOUT = Path(__file__).parents[2]
WIDTH = 64
HEIGHT = 48
VIEWS = 3
START = 60


@dataclass
class Short(StructureAwareStrategy):
    """The schedule of 3,000 iterations, a hundredth as long."""

    structure_every: int = 10
    absgs_every: int = 4
    refine_start_iter: int = 2
    refine_stop_iter: int = 24
    reset_every: int = 0
    eta_every: int = 1
    split_min_opacity: float = 0.0
    min_observations: int = 1


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Put the torch splatter in the place of gsplat's kernels; the list gets the number of Gaussians at each call."""
    counts: list[int] = []
    signature = inspect.signature(gsplat.rasterization)

    def rasterization(*args: Any, packed: bool, **options: Any) -> Any:
        counts.append(len(args[0]))
        signature.bind(*args, packed=packed, **options)  # gsplat's takes these arguments
        assert not packed
        return gsplat_like.rasterization(*args, **options)

    monkeypatch.setattr(simple_trainer, "rasterization", rasterization)
    return counts


def test_the_document_prints_the_example():
    (printed,) = re.findall(r"```python\n(.*?)```", (CHECKOUT / "docs/strategy.md").read_text("utf8"), re.S)
    assert printed == (CHECKOUT / "examples/simple_trainer.py").read_text("utf8")


def test_the_loop_runs_and_splits(calls: list[int]):
    torch.manual_seed(0)
    params = random_params(START)
    params["scales"].data += 1.0  # up to 10 px, against squares of 4 px
    params["sh0"] = torch.nn.Parameter(params.pop("features_dc").data[:, None])
    params["shN"] = torch.nn.Parameter(torch.zeros(START, 15, 3))
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    checker = 0.25 + 0.5 * ((x // 4 + y // 4) % 2).float()
    viewmats, Ks = (matrix.repeat(VIEWS, 1, 1) for matrix in camera(WIDTH, HEIGHT))
    viewmats[:, 0, 3] = torch.linspace(-0.2, 0.2, VIEWS)
    images = checker[None, ..., None].repeat(VIEWS, 1, 1, 3)
    simple_trainer.train(params, images, viewmats, Ks, 1.0, 38, Short())
    assert len(calls) == 38
    assert len({len(parameter) for parameter in params.values()}) == 1
    assert len(params["means"]) > 2 * START, "a fine checker under coarse Gaussians must be split"
    for parameter in params.values():
        assert parameter.isfinite().all()


@pytest.mark.slow
def test_the_program_learns_its_photos(calls: list[int], capsys: pytest.CaptureFixture[str]):
    torch.manual_seed(0)
    untrained = simple_trainer.main("cpu", 32, 24, iterations=1)
    trained = simple_trainer.main("cpu", 32, 24, iterations=30)
    assert trained > untrained + 8, "growth alone, without learning, brings 7"
    assert max(calls) > calls[0]
    printed = capsys.readouterr().out
    assert re.search(r"^800 points became [\d,]+ Gaussians; PSNR \d+\.\d\d dB$", printed, re.MULTILINE)
