"""The documents' training loop, run as it is printed there, with the torch splatter instead of gsplat's kernels."""

from __future__ import annotations

import inspect
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gsplat
import pytest
import torch

from helpers import gsplat_like
from helpers.small_scenes import adam, camera, random_params
from sadgs_ns.method import strategy as strategy_module
from sadgs_ns.method.strategy import StructureAwareStrategy

DOCUMENT = Path(__file__).parents[2] / "docs" / "strategy.md"
WIDTH, HEIGHT, VIEWS, START = 64, 48, 3, 60


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


def block() -> str:
    """The only Python in the document."""
    (code,) = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text("utf8"), re.S)
    return code


def test_the_loop_of_the_document_runs_and_splits(monkeypatch: pytest.MonkeyPatch):
    calls = 0
    signature = inspect.signature(gsplat.rasterization)

    def rasterization(*args: Any, packed: bool, **options: Any) -> Any:
        nonlocal calls
        calls += 1
        signature.bind(*args, packed=packed, **options)  # gsplat's takes these arguments
        assert not packed
        return gsplat_like.rasterization(*args, **options)

    monkeypatch.setattr(gsplat, "rasterization", rasterization)
    monkeypatch.setattr(strategy_module, "StructureAwareStrategy", Short)
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
    names: dict[str, Any] = {
        "torch": torch, "params": params, "optimizers": adam(params), "images": images,
        "viewmats": viewmats, "Ks": Ks, "width": WIDTH, "height": HEIGHT, "iterations": 38, "scene_scale": 1.0,
    }  # fmt: skip
    exec(block(), names)
    assert calls == 38
    assert len({len(parameter) for parameter in params.values()}) == 1
    assert len(params["means"]) > 2 * START, "a fine checker under coarse Gaussians must be split"
    assert all(parameter.isfinite().all() for parameter in params.values())
    assert set(names["state"]) == {"scene_scale", "structure_steps"}, "the statistics end with densification"
