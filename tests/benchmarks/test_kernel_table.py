"""The benchmark of what each kernel brings: twins compute what kernels do, and steps are timed from one state."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from benchmarks import __main__ as bench
from benchmarks import kernel_loops, kernel_share, kernel_table, kernel_twins, results
from benchmarks.kernel_loops import REFERENCE, Measured, Phase, Rounds, State, phases_of, run_to, train_steps
from benchmarks.kernel_share import Loop, Part
from benchmarks.kernel_twins import ALL, TWINS, Twin, replaced
from benchmarks.protocol import Job, Row, Scene
from helpers.generators import seeded
from helpers.gsplat_stub import stub_gsplat
from helpers.interpreted_rasterizer import use_our_rasterizer
from helpers.kill_and_resume import differences, set_up
from helpers.rendered_scene import random_scene
from sadgs_ns import kernels
from sadgs_ns.method.schedule import windows
from sadgs_ns.method.screen_gradients import keep_gradient
from sadgs_ns.render import backend_torch, rasterization
from sadgs_ns.render.types import Cameras, Gaussians, RenderOptions
from sadgs_ns.training.config import SadgsTrainerConfig

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
NO_KERNELS = {"__init__", "limits", "projection_forward", "shared", "trial"}
"""Files of `sadgs_ns/kernels` whose kernels belong to those of another file, or that have none."""
JOB = Job(Scene("demo", "demo", "colmap"), Row("sadgs", "sadgs"), 0)
PHASES = [Phase("densification", 4, 2, 8, captures=True), Phase("after", 9, 2, 4, captures=False)]


def test_each_file_of_kernels_has_a_twin():
    files = {path.stem for path in Path(kernels.__file__).parent.glob("*.py")}
    assert files - NO_KERNELS == TWINS.keys()


@pytest.mark.parametrize("name", [*TWINS, "all"])
def test_a_twin_stands_in_a_kernel_s_place_only_meanwhile(name: str):
    pytest.importorskip("triton", reason="Triton is not installed")
    twin = TWINS.get(name, ALL)
    assert twin.patches
    places = [(kernel_twins.import_module(f"sadgs_ns.{patch.module}"), patch.name) for patch in twin.patches]
    before = [getattr(module, name) for module, name in places]
    with replaced(twin):
        stand_ins = [getattr(module, name) for module, name in places]
    assert stand_ins == [patch.stand_in for patch in twin.patches]
    actual = [getattr(module, name) for module, name in places]
    assert actual == before
    assert not set(before) & set(stand_ins)


def test_adam_s_twin_updates_as_the_kernel():
    adam = pytest.importorskip("sadgs_ns.kernels.adam", reason="Triton is not installed")
    generator = seeded(0)
    shapes = [(20, 3), (20, 15, 3), (20, 1)]
    start = [torch.randn((4, *shape), generator=generator).to(DEVICE) for shape in shapes]
    start[1][1, 3] = torch.nan  # A gradient
    factors = torch.tensor([adam.rate_and_scale(600, rate, (0.9, 0.999)) for rate in (1e-2, 2e-3, 5e-2)])
    found = []
    for step in (adam.adam_step, kernel_twins.adam_step):
        tensors = [value.clone() for value in start]
        parameters, gradients, means, squares = zip(*(value.unbind() for value in tensors), strict=True)
        flag = torch.zeros(1, device=DEVICE)
        squares = tuple(square.square_() for square in squares)
        options: Any = {"betas": (0.9, 0.999), "eps": 1e-15, "max_gradient": 1e18}
        step(parameters, gradients, means, squares, factors.T.contiguous().to(DEVICE), flag, **options)
        assert flag.isnan()
        found.append([*parameters, *means, *squares])
    for ours, theirs in zip(*found, strict=True):
        assert_close(theirs, ours, rtol=1e-4, atol=1e-6)
    assert not torch.equal(found[0][0], start[0][0])


def drawn(absgrad: bool) -> dict[str, Tensor]:
    """Images and gradients of a random scene by the Triton backend, and the numbers of pairs of its views."""
    scene = {name: value.to(DEVICE, torch.float32) for name, value in random_scene(150, 24, seed=0).items()}
    viewmats = scene["viewmats"].repeat(2, 1, 1)
    viewmats[1, 0, 3] = 0.4
    leaves = {name: scene[name].clone().requires_grad_() for name in ("means", "quats", "scales", "opacities")}
    first = scene["colors"][:, 0].clone().requires_grad_()
    rest = scene["colors"][:, 1:].clone().requires_grad_()
    gaussians = Gaussians(*leaves.values(), (first, rest))  # type: ignore[arg-type]
    cameras = Cameras(viewmats, scene["Ks"].repeat(2, 1, 1), 24, 24)
    options = RenderOptions(sh_degree=3, absgrad=absgrad, tile_capacity=20_000, max_off_axis=0.9, backend="triton")
    colors, alphas, info = rasterization.rasterize(gaussians, cameras, options)
    means2d: Any = info["means2d"]
    if absgrad:
        keep_gradient(means2d)
    (colors.square().mean() + alphas.mean()).backward()
    found = {"colors": colors, "alphas": alphas, "first": first.grad, "rest": rest.grad}
    found |= {name: leaf.grad for name, leaf in leaves.items()}
    if absgrad:
        gradient = getattr(means2d, "grad2d", None)
        found |= {"absgrad": means2d.absgrad, "grad2d": means2d.grad if gradient is None else gradient}
    if "pair_counts" in info:
        for count in info["pair_counts"].wait():
            assert count > 100
        assert info["overflowed"].tolist() == [0]
    return {name: value.detach() for name, value in found.items() if value is not None}


@pytest.mark.parametrize("name", ["harmonics", "projection", "tiles", "compositing", "all"])
def test_gsplat_s_twins_draw_what_the_kernels_draw(name: str, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("triton", reason="Triton is not installed")
    if DEVICE == "cpu":
        use_our_rasterizer(monkeypatch)
        stub_gsplat(monkeypatch, per_axis_radii=True)
        if name == "tiles":
            monkeypatch.setattr(backend_torch, "TILE_SIZE", kernels.TILE_SIZE)
    with kernels.triton_switched(True):
        expected = drawn(absgrad=True)
        with replaced(TWINS.get(name, ALL)):
            found = drawn(absgrad=True)
    assert found.keys() == expected.keys()
    for part, value in expected.items():
        # Rounding moves a few pairs over a cut-off.
        assert (found[part] - value).norm() < 2e-3 * value.norm(), part


def test_steps_are_taken_between_two_densifications_by_absgs_and_after_the_last():
    # 30 parts of 70 iterations; structure steps end the 5th, 10th and 15th.
    early, late = phases_of(windows(2088), 2088)
    assert early.begin == 8 * 70
    assert early.steps == 70
    assert early.weight == 16 * 70
    assert early.captures is True
    assert late.begin == (1120 + 2088) // 2
    assert late.steps == 100
    assert late.weight == 2088 - 1120
    assert late.captures is False
    early, late = phases_of(windows(2088, structure_every=630), 2088)
    assert early.begin == 7 * 70
    actual = phases_of(windows(60), 60)[1].steps
    assert actual == 60 - (32 + 60) // 2


@pytest.fixture
def trainer(config: SadgsTrainerConfig) -> Any:
    """A run on the drawn scene that is set up, with poses and colours, of which torch computes everything."""
    config.max_num_iterations = 12
    config.pipeline.model.poses = "refined"
    config.pipeline.model.color_model = "affine"
    strategy = config.pipeline.model.strategy
    strategy.absgs_every = 2
    strategy.structure_every = 6
    strategy.refine_stop_iter = 8
    strategy.reset_every = 0
    strategy.refine_start_iter = 1
    strategy.eta_every = 1
    trainer = set_up(config)
    trainer.pipeline.train()
    return trainer


def state_of(trainer: Any) -> dict[str, Any]:
    """All that a checkpoint would hold."""
    adams = trainer.optimizers.optimizers.items()
    state = {"pipeline": trainer.pipeline.state_dict(), "optimizers": {name: adam.state_dict() for name, adam in adams}}
    rates = trainer.optimizers.schedulers.items()
    return copy.deepcopy(state | {"schedulers": {name: rate.state_dict() for name, rate in rates}})


def without_random_numbers(state: dict[str, Any]) -> dict[str, Any]:
    """The state without that of torch's generator, of which timed steps draw."""
    state["pipeline"]["_extra_state"].pop("torch")
    return state


def test_what_was_timed_leaves_the_run_as_it_was(trainer: Any):
    run_to(trainer, 0, 4)
    before = without_random_numbers(state_of(trainer))
    twins: dict[str, Twin | None] = {REFERENCE: None, "losses": TWINS["losses"]}
    measured = {name: Measured() for name in twins}
    state = State(trainer)
    train_steps(trainer, 4, 2)
    changed = without_random_numbers(state_of(trainer))
    assert differences(before, changed)
    state.restore()
    Rounds(trainer, twins, measured).run(PHASES[0], rounds=2, limit=100.0)
    trainer.pipeline.model.step = 3
    actual = differences(before, without_random_numbers(state_of(trainer)))
    assert actual == []
    for of_twin in measured.values():
        assert of_twin.error == ""
        assert len(of_twin.seconds["densification"]) == 2
        for seconds in of_twin.seconds["densification"]:
            assert seconds > 0
    run_to(trainer, 4, 12)
    assert trainer.pipeline.model.num_gaussians > 0


def test_no_round_begins_after_the_limit_but_the_first(trainer: Any):
    run_to(trainer, 0, 1)
    measured = {REFERENCE: Measured()}
    Rounds(trainer, {REFERENCE: None}, measured).run(Phase("after", 1, 1, 1, captures=False), rounds=9, limit=0.0)
    assert len(measured[REFERENCE].seconds["after"]) == 1


def test_a_twin_that_fails_has_the_error_and_others_go_on(trainer: Any):
    def fail(*_: Any, **__: Any) -> None:
        raise RuntimeError("no kernel image\nis available")

    broken = Twin("torch", (kernel_twins.Patch("training.step.train_step", "photometric_loss", fail),))
    run_to(trainer, 0, 1)
    twins: dict[str, Twin | None] = {"broken": broken, REFERENCE: None}
    measured = {name: Measured() for name in twins}
    Rounds(trainer, twins, measured).run(Phase("after", 1, 1, 1, captures=False), rounds=2, limit=100.0)
    assert measured["broken"] == Measured(error="RuntimeError: no kernel image")
    assert len(measured[REFERENCE].seconds["after"]) == 2


def test_launches_are_kernels_of_the_gpu_without_copies():
    cpu = SimpleNamespace(name="CPU")
    cuda = SimpleNamespace(name="CUDA")
    names = [("cudaLaunchKernel", cpu), ("_update", cuda), ("Memcpy DtoD (Device -> Device)", cuda), ("add", cuda)]
    events = [SimpleNamespace(name=name, device_type=kind) for name, kind in [*names, ("Memset (Device)", cuda)]]
    assert kernel_loops.launches_in(events) == 2


def loop(**measured: Measured) -> Loop:
    """Seconds of two rounds, of 8 steps of .5 s and of 4 steps of .25 s with all kernels: 5 s."""
    reference = Measured({"densification": [1.0, 1.0], "after": [0.5, 0.5]}, {"densification": 30.0, "after": 15.0})
    return Loop(PHASES, {REFERENCE: reference, **measured}, {}, {"iterations": 12, "devices": 1})


def test_a_row_has_the_loop_relative_to_that_with_all_kernels():
    tiles = Measured({"densification": [2.0, 1.5], "after": [0.5, 0.5]}, {"densification": 60.0, "after": 30.0})
    part = Part(JOB, {REFERENCE: None, "tiles": TWINS["tiles"]}, {}, is_short=False)
    first, second = kernel_share.rows_of(part, loop(tiles=tiles))
    assert first["label"] == REFERENCE
    assert first["ratio"] == 1
    assert first["steps_seconds"] == 5
    assert first["launches"] == 25
    assert first["launches_with_kernel"] is None
    assert second["key"] == "demo/tiles/0"
    assert second["by"] == "gsplat"
    assert second["launches"] == 50
    assert second["launches_with_kernel"] == 25
    actual = (second["low"], second["ratio"], second["high"])
    expected = pytest.approx((7 / 5, 8 / 5, 9 / 5))
    assert actual == expected
    assert second["ms"] == pytest.approx({"densification": 875, "after": 250})
    assert "host waits" in second["no_graphs"]
    assert first["no_graphs"] == ""


def test_a_run_with_options_or_on_two_devices_has_no_row_of_its_own_for_all_kernels():
    part = Part(JOB, {REFERENCE: None, "poses": TWINS["poses"]}, {}, is_short=True)
    measured = loop(poses=Measured({"densification": [1.0, 1.0], "after": [0.5, 0.5]}))
    labels = [row["label"] for row in kernel_share.rows_of(part, measured)]
    assert labels == ["poses"]
    part = dataclasses.replace(part, is_short=False)
    assert len(kernel_share.rows_of(part, measured)) == 2
    measured.about["devices"] = 2
    actual = [row["label"] for row in kernel_share.rows_of(part, measured)]
    assert actual == ["poses"]


def test_what_images_take_more_is_added_to_the_steps():
    part = Part(JOB, {REFERENCE: None}, {"structure_tensor": TWINS["structure_tensor"]}, is_short=False)
    measured = loop()
    measured.images.update({REFERENCE: 0.5, "structure_tensor": 1.0})
    row = kernel_share.rows_of(part, measured)[1]
    assert row["ratio"] == pytest.approx(5.5 / 5)
    assert row["images_seconds"] == 1.0


def test_a_kernel_whose_twin_failed_has_a_row_that_says_so():
    part = Part(JOB, {REFERENCE: None, "tiles": TWINS["tiles"]}, {}, is_short=False)
    row = kernel_share.rows_of(part, loop(tiles=Measured(error="RuntimeError: no")))[1]
    assert row["status"] == "failed"
    assert row["error"] == "RuntimeError: no"


def test_one_device_measures_all_kernels_but_those_that_send_and_two_only_these():
    plain, optional = kernel_share.parts_of(JOB, 1, (), with_options=True)
    names = {*plain.twins, *plain.once, *optional.twins}
    assert names == {REFERENCE, "no kernel", *TWINS} - {"exchange"}
    assert optional.is_short
    assert optional.job.row.overrides["pipeline.model.poses"] == "refined"
    assert {*optional.twins} == {REFERENCE, "poses"}
    assert len(kernel_share.parts_of(JOB, 1, (), with_options=False)) == 1
    (part,) = kernel_share.parts_of(JOB, 2, (), with_options=True)
    assert [*part.twins] == [REFERENCE, "exchange"]
    assert part.job.row.overrides == {"share_always": True}
    actual = kernel_share.parts_of(JOB, 2, ("tiles",), with_options=True)
    assert actual == []
    (part,) = kernel_share.parts_of(JOB, 1, ("tiles",), with_options=True)
    assert [*part.twins] == [REFERENCE, "tiles"]


def test_the_table_has_a_line_for_each_kernel_and_columns_for_each_scene():
    ok = {"status": "ok", "by": "torch"}
    rows = [
        ok
        | {"scene": "bonsai", "label": "adam", "ratio": 1.25, "low": 1.2, "high": 1.3, "launches": 41.4}
        | {"launches_with_kernel": 30.0},
        ok | {"scene": "bonsai", "label": "structure_tensor", "ratio": 1.002},
        {"status": "failed", "by": "torch", "scene": "site", "label": "adam", "error": "no"},
    ]
    assert kernel_table.markdown(rows).splitlines() == [
        "| Kernel | In its place | bonsai: loop | launches a step | site: loop | launches a step |",
        "| --- | --- | ---: | ---: | ---: | ---: |",
        "| adam | torch | 1.250 (1.200 to 1.300) | 41 / 30 | failed | – |",
        "| structure_tensor | torch | 1.002 | – | – | – |",
    ]


PROTOCOL = """
scenes: {demo: {data: scene, dataparser: colmap, options: {colmap_path: sparse/0, downscale_factor: 1}}}
seeds: [0]
rows:
  - label: sadgs
    method: sadgs
    overrides:
      max_num_iterations: 12
      pipeline.model.bounding_box_points: false
      pipeline.model.strategy.absgs_every: 2
      pipeline.model.strategy.structure_every: 6
"""


def test_the_command_writes_a_row_for_each_kernel(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(kernel_loops, "WARM_STEPS", 1)
    (tmp_path / "mine.yaml").write_text(PROTOCOL)
    (tmp_path / "scene").symlink_to(scene)
    output = tmp_path / "kernels.jsonl"
    words = ["kernels", str(tmp_path / "mine.yaml"), "--scenes", str(tmp_path), "--output", str(output)]
    words += ["--only", "demo", "--rounds", "1", "--kernels", "adam", "poses", "structure_tensor"]
    status = bench.main(words)
    assert status == 0, capsys.readouterr().err
    rows = results.read(output)
    labels = [row["label"] for row in rows]
    assert labels == [REFERENCE, "adam", "structure_tensor", "poses"]
    for row in rows:
        assert row["status"] == "ok"
        assert row["ratio"] > 0
        assert row["iterations"] == 12
    replayed = rows[1]["replayed"]
    assert replayed["densification"] == 0  # Every second step densifies, before a graph is replayed.
    if DEVICE == "cuda":
        assert replayed["after"] > 0
    else:
        assert replayed["after"] == 0
    assert {*rows[1]["ms"]} == {"densification", "after"}
    assert {*rows[3]["ms"]} == {"densification"}
    printed = capsys.readouterr().out
    assert "| poses | torch |" in printed


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--kernels", "nothing"], "--kernels names 'nothing'; give some of activations, "),
        (["--only", "nowhere"], "mine.yaml has no row 'sadgs' of the scene 'nowhere'."),
    ],
)
def test_unknown_names_are_refused_in_a_sentence(
    words: list[str], sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(PROTOCOL)
    given = ["kernels", "mine.yaml", "--scenes", ".", "--output", "rows.jsonl", *words]
    status = bench.main(given)
    assert status == 2
    errors = capsys.readouterr().err
    assert f"python -m benchmarks kernels: {sentence}" in errors
    assert not Path("rows.jsonl").exists()
