"""The recipes of docs/develop.md work as they are printed there, and the program that profiles a step does."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
import yaml

from benchmarks import __main__ as bench
from examples.drawn_scene.scene import SPARSE_FOLDER
from helpers import forked_python
from helpers.generators import seeded
from helpers.small_scenes import adam, camera, random_params, training_step
from sadgs_ns.cli import sadgs
from sadgs_ns.cli.photos_to_splat import PhotosToSplat
from sadgs_ns.method import growth, statistics
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor

CHECKOUT = Path(__file__).parents[2]
WIDTH = 64
HEIGHT = 48


def blocks(heading: str, language: str = "python") -> list[str]:
    """The code below a heading of the document."""
    text = (CHECKOUT / "docs/develop.md").read_text("utf8")
    (section,) = re.findall(rf"^###? {re.escape(heading)}\n(.*?)(?=^##)", text, re.MULTILINE | re.DOTALL)
    return re.findall(rf"^```{language}\n(.*?)^```$", section, re.MULTILINE | re.DOTALL)


def entry(heading: str, module: ModuleType) -> dict[str, Any]:
    """What a recipe adds to a table of a module: its last block, after the others have been run as if there."""
    *before, last = blocks(heading)
    names = dict(vars(module))
    for code in before:
        exec(code, names)
    return eval(f"{{{last}}}", names)


def train(strategy: StructureAwareStrategy, steps: int) -> tuple[dict[str, Any], list[int]]:
    """The strategy's state after some steps on noise, and the number of Gaussians after each."""
    params = random_params(60)
    params["scales"].data += 1.0  # up to 10 px
    optimizers = adam(params)
    state = strategy.initialize_state(1.0)
    viewmats, Ks = camera(WIDTH, HEIGHT)
    images = torch.rand((1, HEIGHT, WIDTH, 3), generator=seeded(0))
    tensors = multiscale_structure_tensor(images)
    counts = []
    for step in range(steps):
        training_step(strategy, params, optimizers, state, step, images, tensors, viewmats, Ks)
        counts.append(len(params["means"]))
    return state, counts


def test_a_statistic(monkeypatch: pytest.MonkeyPatch):
    for name, statistic in entry("A statistic of the views", statistics).items():
        monkeypatch.setitem(statistics.STATISTICS, name, statistic)
    strategy = StructureAwareStrategy(
        structure_every=9, absgs_every=0, refine_start_iter=2, refine_stop_iter=20, reset_every=0, eta_every=1,
        split_min_opacity=0.0, min_observations=1, max_gaussians=500,
    )  # fmt: skip
    state, counts = train(strategy, 12)
    assert counts[8] > counts[7] == 60
    eta_sum = state["eta_sum"]
    bound = state["eta_max"] * state["n_total"][:, None]
    assert eta_sum.shape == (counts[-1], 3)
    assert eta_sum.any()
    assert (eta_sum <= bound * (1 + 1e-5)).all()


def test_a_rule_of_growth(monkeypatch: pytest.MonkeyPatch):
    for name, rule in entry("A rule of growth", growth).items():
        monkeypatch.setitem(growth.RULES, name, rule)
    strategy = StructureAwareStrategy(
        structure_every=0, absgs_every=0, refine_start_iter=2, refine_stop_iter=40, reset_every=0, max_gaussians=100
    )
    assert train(strategy, 31)[1] == [60] * 29 + [97] * 2, "15 of 16 parts of the way to the cap, after 3 of 4"


def test_an_export_format(tmp_path: Path):
    """A process adds it before it imports the commands, which is when they make their help."""
    module, line = blocks("An export format")
    (tmp_path / "xyz.py").write_text(module)
    params = {"means": 3, "scales": 3, "quats": 4, "opacities": 1, "features_dc": 3}
    values = {f"_model.gauss_params.{name}": torch.ones(5, width) for name, width in params.items()}
    values["_model.gauss_params.features_rest"] = torch.zeros(5, 15, 3)
    torch.save({"step": 7, "pipeline": values, "optimizers": {}, "scalers": {}}, tmp_path / "step-000000007.ckpt")
    run = forked_python.python(f"""
import sys
sys.path.insert(0, {str(tmp_path)!r})
import xyz
from sadgs_ns.formats import FORMATS
FORMATS.update({{{line}}})
from sadgs_ns.cli import export, sadgs
assert export.main(["{tmp_path}/step-000000007.ckpt", "--output", "{tmp_path}/splat.xyz"]) == 0
assert sadgs.main(["{tmp_path}", "--formats", "no-such"]) == 2
export.main(["--help"])
""")
    assert run.returncode == 0, run.stderr
    assert (tmp_path / "splat.xyz").read_text() == "1 1 1\n" * 5
    assert "glb, html, xyz, mesh.ply, and not 'no-such'" in run.stderr
    assert ".html, .xyz, or .mesh.ply" in run.stdout


def test_a_stage(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    def stub(work: PhotosToSplat, line: object) -> str:
        (work.folder / "log").mkdir(exist_ok=True)
        return "done before"

    added = entry("A stage between photos and a splat", sadgs)
    monkeypatch.setattr(sadgs, "STAGES", dict.fromkeys(sadgs.STAGES, stub) | added)
    monkeypatch.setattr(PhotosToSplat, "worker", lambda *others: None)
    command = [str(scene), "--output", str(tmp_path / "out"), "--formats", "ply"]
    archive = tmp_path / "out/log.zip"
    for status in (f"{archive}", f"{archive}; done before"):
        assert sadgs.main(command) == 0
        lines = re.findall(r"^(\S+) +\d:\d\d  (.*)$", capsys.readouterr().out, re.MULTILINE)
        expected = [*((name, "done before") for name in ("cameras", "training", "export")), ("logs", status)]
        assert lines[:4] == expected
    assert archive.is_file()


@pytest.mark.slow
def test_a_protocol(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Its row of half the effort, two iterations long, on a drawn scene, and the table of a document."""
    (shown,) = map(yaml.safe_load, blocks("A protocol to measure", "yaml"))
    garden = shown["scenes"]["garden"]
    garden["options"] |= {"colmap_path": str(SPARSE_FOLDER), "downscale_factor": 1}
    (row,) = (row for row in shown["rows"] if row["label"] == "draft")
    row["overrides"]["max_num_iterations"] = 2
    (tmp_path / "mine.yaml").write_text(yaml.dump({"scenes": {"garden": garden}, "seeds": [0], "rows": [row]}))
    (tmp_path / garden["data"]).symlink_to(scene)
    results = tmp_path / "docs/results"
    results.mkdir(parents=True)
    monkeypatch.setenv("TORCH_HOME", "/dev/null")  # LPIPS is left out.
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    rows = results / "rows.jsonl"
    status = bench.main([str(tmp_path / "mine.yaml"), "--scenes", str(tmp_path), "--output", str(rows)])
    assert status == 0
    (found,) = map(json.loads, rows.read_text().splitlines())
    assert found["label"] == "draft"
    assert found["status"] == "ok"
    assert found["iterations"] == 2
    line = {"rows": "rows.jsonl", "scenes": ["garden"], "labels": {"draft": "half the effort"}}
    table = {"kind": "runs", "columns": ["scene", "method", "psnr"], "lines": [line]}
    (results / "tables.yaml").write_text(yaml.dump({"megapixels": {}, "tables": {"mine": table}}))
    document = tmp_path / "README.md"
    document.write_text("<!-- table: mine -->\n<!-- end -->\n")
    status = bench.main(["documents", str(tmp_path)])
    assert status == 0
    assert f"| garden | half the effort | {found['psnr']:.2f} |" in document.read_text()


def test_a_step_is_profiled(scene: Path, tmp_path: Path):
    (program,) = blocks("Profile a step")
    words = ["ns-train", "sadgs", "--output-dir", str(tmp_path), "--vis", "tensorboard", "--max-num-iterations", "21"]
    words += ["--pipeline.model.strategy.absgs-every", "0", "--pipeline.model.strategy.structure-every", "0"]
    words += ["colmap", "--data", str(scene), "--colmap-path", str(SPARSE_FOLDER), "--downscale-factor", "1"]
    run = forked_python.python(f"import sys\nsys.argv[:] = {words}\n{program}")
    assert run.returncode == 0, run.stderr
    assert run.stdout.count("Self CPU time total") == 1
    assert re.search(r"aten::mul +.* \d+ *$", run.stdout, re.MULTILINE)
