"""The benchmark's protocol, its bookkeeping and its table; nothing is trained."""

from __future__ import annotations

import dataclasses
import importlib
import os
import re
import signal
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import pytest

from benchmarks import __main__ as bench
from benchmarks import protocol, results, side_by_side
from benchmarks.protocol import Job, Row, Scene, set_dotted
from benchmarks.run import build_config, describe
from benchmarks.table import markdown
from helpers.json_files import write_json

CONFIGS = Path(__file__).parents[2] / "configs/bench"


def content(**changes: Any) -> dict[str, Any]:
    return {
        "scenes": {"fox": {"data": "fox", "dataparser": "colmap"}, "south": {"data": "south", "dataparser": "colmap"}},
        "rows": [{"label": "ours", "method": "sadgs"}],
        **changes,
    }


def row(**changes: Any) -> dict[str, Any]:
    return {"label": "ours", "method": "sadgs", **changes}


def result(**changes: Any) -> dict[str, Any]:
    measured = {"loop_seconds": 10.0, "psnr": 30.0, "ssim": 0.9, "lpips": 0.1, "gaussians": 1000, "peak_gb": 2.0}
    identity = {"key": "fox/ours/0/x", "scene": "fox", "label": "ours", "seed": 0, "status": "ok", "error": None}
    return {**identity, **measured, **changes}


# Protocol


def test_jobs_are_rows_then_scenes_then_seeds():
    rows = [row(label="a"), row(label="b", scenes=["south"], seeds=[7])]
    jobs = protocol.parse(content(rows=rows, seeds=[0, 1])).jobs()
    actual = [(j.row.label, j.scene.name, j.seed) for j in jobs]
    assert actual == [
        ("a", "fox", 0), ("a", "fox", 1), ("a", "south", 0), ("a", "south", 1), ("b", "south", 7),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ([], "the protocol must be a mapping"),
        ({"rows": []}, "the protocol lacks 'scenes'"),
        (
            content(speed=1),
            "the protocol has an unknown key 'speed'; it takes curve_every, rows, scenes, seeds, source.",
        ),
        (content(scenes={}), "scenes is empty"),
        (content(scenes={"fox": {"data": "fox", "dataparser": "colmap", "eval": 8}}), "unknown key 'eval'"),
        (content(scenes={"fox": {"data": 3, "dataparser": "colmap"}}), "scenes.fox.data must be text, not 3"),
        (content(rows=[row(overide={})]), "rows[0] has an unknown key 'overide'"),
        (content(rows=[row(scenes=["lego"])]), "rows[0].scenes names 'lego'"),
        (content(rows=[row(sweep={"a": [3]})]), "rows[0] has an unknown key 'sweep'"),
        (content(rows=[row(), row()]), "two rows have the label 'ours'"),
        (content(seeds=[0.5]), "seeds must be a list of whole numbers"),
        (content(rows=[row(seeds=[])]), "rows[0].seeds must be a list of at least one entry"),
    ],
)
def test_wrong_protocols_say_what_is_wrong(wrong: object, sentence: str):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        protocol.parse(wrong)


def test_load_names_the_file(tmp_path: Path):
    with pytest.raises(ValueError, match=r"missing\.yaml cannot be read"):
        protocol.load(tmp_path / "missing.yaml")
    (tmp_path / "wrong.yaml").write_text("scenes: [")
    with pytest.raises(ValueError, match=r"wrong\.yaml is not YAML"):
        protocol.load(tmp_path / "wrong.yaml")
    (tmp_path / "wrong.yaml").write_text("{}")
    with pytest.raises(ValueError, match=r"wrong\.yaml: the protocol lacks"):
        protocol.load(tmp_path / "wrong.yaml")


def test_key_changes_with_everything_that_sets_a_run_up():
    scene = Scene("fox", "fox", "colmap")
    ours = Row("ours", "sadgs", {"a": 1})
    jobs = [
        Job(scene, ours, 0),
        Job(scene, ours, 1),
        Job(scene, dataclasses.replace(ours, overrides={"a": 2}), 0),
        Job(scene, dataclasses.replace(ours, method="splatfacto"), 0),
        Job(dataclasses.replace(scene, options={"downscale_factor": 2}), ours, 0),
    ]
    assert len({job.key for job in jobs}) == len(jobs)
    # Which other scenes and seeds a row has is not part of a run.
    actual = Job(scene, dataclasses.replace(ours, seeds=(0,), scenes=("fox",)), 0).key
    assert actual == jobs[0].key


# Overrides


@dataclasses.dataclass
class Inner:
    rate: float = 0.1
    path: Path = Path("a")
    shape: tuple[int, ...] = (1, 2)
    on: bool = False
    mode: str = "off"


@dataclasses.dataclass
class Outer:
    inner: Inner = dataclasses.field(default_factory=Inner)
    groups: dict[str, Any] = dataclasses.field(default_factory=lambda: {"means": {"lr": 1.0, "scheduler": None}})
    steps: int = 10
    limit: int | None = None


def test_set_dotted_walks_dataclasses_and_dicts_and_keeps_types():
    config = Outer()
    for path, value in {
        "inner.rate": "1e-4",  # what YAML makes of 1e-4
        "inner.path": "b/c",
        "inner.shape": [3, 4],
        "inner.on": True,
        "groups.means.lr": 2,
        "groups.means.scheduler": None,
        "steps": 20,
        "limit": 5,
    }.items():
        set_dotted(config, path, value)
    assert config.inner == Inner(1e-4, Path("b/c"), (3, 4), True)
    assert config.groups["means"] == {"lr": 2, "scheduler": None}
    assert config.steps == 20
    assert config.limit == 5


@pytest.mark.parametrize(
    ("path", "value", "sentence"),
    [
        ("inner.raet", 1, "override 'inner.raet': inner has no 'raet'; did you mean 'rate'?"),
        ("nothing", 1, "the config has no 'nothing'; it has groups, inner, limit, steps."),
        ("groups.means.scheduler.max_steps", 1, "groups.means.scheduler is None, which has no settings"),
        ("groups.quats.lr", 1, "groups has no 'quats'"),
        ("inner", 3, "3 is int, but the setting is a group of settings"),
        ("inner.on", 1, "1 is int, but the setting is bool"),
        ("inner.mode", False, "False is bool, but the setting is str"),
        ("inner.rate", "fast", "'fast' is str, but the setting is float"),
        ("steps", True, "True is bool, but the setting is int"),
    ],
)
def test_set_dotted_names_what_it_cannot_set(path: str, value: object, sentence: str):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        set_dotted(Outer(), path, value)


@pytest.fixture(scope="module")
def nerfstudio() -> None:
    """nerfstudio's registry, imported without the warnings of its own modules."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        importlib.import_module("nerfstudio.configs.method_configs")


@pytest.mark.usefixtures("nerfstudio")
@pytest.mark.parametrize("name", ["ours", "demo-gate"])
def test_shipped_protocols_fit_the_real_configs(name: str, tmp_path: Path):
    jobs = protocol.load(CONFIGS / f"{name}.yaml").jobs()
    for job in jobs:
        (tmp_path / job.scene.data).mkdir(exist_ok=True)
        config = build_config(job.scene, job.row, job.seed, tmp_path, tmp_path)
        assert config.steps_per_save == getattr(config, "seconds_per_save", 0) == 0  # none within the measured loop


@pytest.mark.usefixtures("nerfstudio")
def test_build_config_of_splatfacto(tmp_path: Path):
    (tmp_path / "fox").mkdir()
    job = next(j for j in protocol.load(CONFIGS / "ours.yaml").jobs() if j.row.label == "splatfacto-3k")
    config: Any = build_config(dataclasses.replace(job.scene, data="fox"), job.row, 1, tmp_path, tmp_path)
    assert config.max_num_iterations == config.optimizers["means"]["scheduler"].max_steps == 3000
    assert config.pipeline.model.num_downscales == 0
    datamanager = config.pipeline.datamanager
    assert datamanager.data == tmp_path / "fox"
    assert datamanager.dataparser.colmap_path == Path("sparse/0")
    assert datamanager.train_cameras_sampling_seed == config.machine.seed == 1
    for what in ("viewer", "viewer_legacy", "tensorboard", "wandb", "comet"):
        assert not getattr(config, f"is_{what}_enabled")(), what
    assert not config.logging.local_writer.enable

    from nerfstudio.configs.method_configs import all_methods

    assert all_methods["splatfacto"].max_num_iterations == 30000, "the registry must not change"


@pytest.mark.usefixtures("nerfstudio")
@pytest.mark.parametrize("method", ["splatfacto", "sadgs"])
def test_a_methods_own_settings_of_its_parser_stay(method: str, tmp_path: Path):
    (tmp_path / "lego").mkdir()
    scene = Scene("lego", "lego", "nerfstudio-data", {"downscale_factor": 1})
    config: Any = build_config(scene, Row("ours", method), 0, tmp_path, tmp_path)
    parser = config.pipeline.datamanager.dataparser
    assert parser.load_3D_points, "nerfstudio's default reads no points"
    assert parser.downscale_factor == 1

    from nerfstudio.configs.method_configs import all_methods

    registered: Any = all_methods[method]
    again: Any = build_config(dataclasses.replace(scene, options={}), Row("ours", method), 0, tmp_path, tmp_path)
    assert again.pipeline.datamanager.dataparser.downscale_factor is None, "the registry must not change"
    assert registered.pipeline.datamanager.data is None


@pytest.mark.usefixtures("nerfstudio")
@pytest.mark.parametrize(
    ("scene", "changes", "sentence"),
    [
        ({}, {"method": "splatfact"}, "row 'ours': nerfstudio has no method 'splatfact'"),
        ({}, {"method": "nerfacto"}, "row 'ours': 'nerfacto' trains on rays"),
        ({"dataparser": "colmp"}, {}, "scene 'fox': nerfstudio has no dataparser 'colmp'"),
        ({"data": "foxes"}, {}, "does not exist; check --scenes"),
        ({"options": {"downscale": 1}}, {}, "the config has no 'downscale'; did you mean 'downscale_factor'?"),
        ({}, {"overrides": {"pipeline.model.speed": 1}}, "pipeline.model has no 'speed'"),
    ],
)
def test_build_config_names_what_is_wrong(tmp_path: Path, scene: dict, changes: dict, sentence: str):
    (tmp_path / "fox").mkdir()
    job = Scene(**{"name": "fox", "data": "fox", "dataparser": "colmap", **scene})
    with pytest.raises(ValueError, match=re.escape(sentence)):
        build_config(job, Row(**{"label": "ours", "method": "splatfacto", **changes}), 0, tmp_path, tmp_path)


def test_describe_is_one_sentence():
    assert describe(ValueError("row has no x.")) == "row has no x."
    assert describe(RuntimeError("out of memory\nmore")) == "RuntimeError: out of memory"
    assert "TORCH_HOME" in describe(ConnectionError())


# Bookkeeping


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(side_by_side, "POLL_SECONDS", 0.01)


class FakeRunner:
    """Runs that end at once: with the result "ok", or as a process that fails without one."""

    def __init__(self, crashes: set[str] | None = None) -> None:
        self.crashes = crashes or set()
        self.started: list[tuple[str, str | None]] = []

    def __call__(self, job: Job, gpu: str | None, folder: Path) -> subprocess.Popen[bytes]:
        self.started.append((job.row.label, gpu))
        (folder / "log").write_text("what it said")
        if job.row.label in self.crashes:
            return subprocess.Popen([sys.executable, "-S", "-c", "raise SystemExit(3)"], start_new_session=True)
        write_json(folder / "result.json", {"status": "ok", "error": None, "psnr": 30.0})
        return subprocess.Popen(["true"], start_new_session=True)


def some_jobs(labels: str = "abc") -> list[Job]:
    return [Job(Scene("fox", "fox", "colmap"), Row(label, "sadgs"), 0) for label in labels]


def test_results_are_written_and_done_runs_are_skipped(tmp_path: Path):
    output = tmp_path / "out/results.jsonl"
    log = tmp_path / "results.log"
    jobs = some_jobs()
    runner = FakeRunner(crashes={"b"})
    bench.run_all(jobs, runner, lambda r: results.append(output, r), log)
    assert runner.started == [("a", None), ("b", None), ("c", None)]
    written = results.read(output)
    assert [(r["label"], r["status"], r["jobs_per_gpu"]) for r in written] == [
        ("a", "ok", 1), ("b", "failed", 1), ("c", "ok", 1),
    ]  # fmt: skip
    assert "ended with code 3" in written[1]["error"]
    assert log.read_text().startswith("=== fox/b/0/")
    assert "what it said" in log.read_text()

    todo = bench.unfinished(jobs, written)
    assert [job.row.label for job in todo] == ["b"]
    bench.run_all(todo, FakeRunner(), lambda r: results.append(output, r), log)
    actual = {r["label"]: r["status"] for r in results.read(output)}
    expected = {"a": "ok", "b": "ok", "c": "ok"}
    assert actual == expected
    assert not bench.unfinished(jobs, results.read(output))


def test_gpus_are_shared_out(tmp_path: Path):
    runner = FakeRunner()
    seen = []
    bench.run_all(some_jobs("abcd"), runner, seen.append, tmp_path / "log", gpus=["0", "1"], jobs_per_gpu=2)
    actual = [gpu for _, gpu in runner.started]
    assert actual == ["0", "1", "0", "1"]
    for r in seen:
        assert r["jobs_per_gpu"] == 2


def test_an_interrupt_ends_the_running_processes(tmp_path: Path):
    processes: list[subprocess.Popen[bytes]] = []

    def launch(job: Job, gpu: str | None, folder: Path) -> subprocess.Popen[bytes]:
        if job.row.label == "a":
            return FakeRunner()(job, gpu, folder)
        processes.append(subprocess.Popen(["sleep", "600"], start_new_session=True))
        return processes[-1]

    def interrupt(_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        bench.run_all(some_jobs("ab"), launch, interrupt, tmp_path / "log", gpus=["0", "1"])
    assert processes[0].poll() == -signal.SIGTERM, "it should end before its ten minutes are over"


@pytest.mark.usefixtures("nerfstudio")
def test_sigterm_ends_the_runs_and_its_handler_is_the_program_s_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    processes: list[subprocess.Popen[bytes]] = []

    def launch(job: Job, gpu: str | None, folder: Path) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(["sleep", "600"], start_new_session=True)
        poll = process.poll

        def terminate() -> int | None:
            process.poll = poll
            os.kill(os.getpid(), signal.SIGTERM)
            return poll()

        process.poll = terminate
        processes.append(process)
        return process

    fox = {"data": "fox", "dataparser": "nerfstudio-data"}
    write_json(tmp_path / "p.yaml", content(scenes={"fox": fox}))
    (tmp_path / "fox").mkdir()
    arguments = [str(tmp_path / "p.yaml"), "--scenes", str(tmp_path), "--output", str(tmp_path / "r.jsonl")]
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(bench, "launcher", lambda root: launch)
    with pytest.raises(SystemExit) as stopped:
        bench.main(arguments)
    assert stopped.value.code == 143
    assert processes[0].poll() is not None
    assert signal.getsignal(signal.SIGTERM) == before
    monkeypatch.setattr(bench, "launcher", lambda root: FakeRunner(crashes={"ours"}))
    status = bench.main(arguments)
    assert status == 1
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize(("gpus", "there"), [("0,0+1", None), ("0+1", 1), ("0", 2), ("0+1+2", 2)])
def test_runs_on_other_numbers_of_devices_are_not_mixed(
    gpus: str, there: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    write_json(tmp_path / "p.yaml", content(scenes={"fox": {"data": "fox", "dataparser": "nerfstudio-data"}}))
    (tmp_path / "fox").mkdir()
    monkeypatch.setattr(bench, "launcher", lambda root: pytest.fail("nothing may start"))
    output = tmp_path / "r.jsonl"
    results.append(output, result(devices=there))
    arguments = ["p.yaml", "--scenes", ".", "--output", str(output), "--gpus", gpus]
    monkeypatch.chdir(tmp_path)
    status = bench.main(arguments)
    assert status == 2
    errors = capsys.readouterr().err
    assert f"and another --output than {output} if that has runs on others" in errors


def test_a_half_written_line_is_ignored_and_swallows_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "results.jsonl"
    actual = results.read(path, missing_ok=True)
    assert actual == []
    results.append(path, result(key="a"))
    with path.open("a") as file:
        file.write('{"key": "b", "sta')
    results.append(path, {"key": "of no scene"})
    results.append(path, result(key="c"))
    keys = [r["key"] for r in results.read(path)]
    assert keys == ["a", "c"]
    said = capsys.readouterr().err
    assert "results.jsonl:2 is not a result" in said
    assert "results.jsonl:3 is not a result" in said


@pytest.mark.usefixtures("nerfstudio")
def test_wrong_input_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    options = ["--scenes", str(tmp_path), "--output", str(tmp_path / "r.jsonl")]
    for arguments, sentence in [
        ([str(tmp_path / "no.yaml")], "no.yaml cannot be read"),
        ([str(CONFIGS / "demo-gate.yaml")], "does not exist; check --scenes"),
        ([str(CONFIGS / "demo-gate.yaml"), "--only", "nothing"], "--only 'nothing' leaves no run"),
        ([str(CONFIGS / "demo-gate.yaml"), "--only", "["], "is not a regular expression"),
    ]:
        status = bench.main([*arguments, *options])
        assert status == 2
        errors = capsys.readouterr().err
        assert sentence in errors


# Table


def test_table_means_over_seeds_and_ratio_to_the_reference():
    rows = [
        result(label="base", loop_seconds=100.0),
        result(seed=0, loop_seconds=9.0, psnr=30.0, gaussians=1_000_000),
        result(seed=1, loop_seconds=11.0, psnr=31.0, gaussians=2_000_000, lpips=None),
        result(seed=3, psnr=32.0, gaussians=3_000_000),
        result(seed=2, status="failed", error="RuntimeError: out of memory"),
        result(scene="south", label="ours", lpips=None, peak_gb=None),
    ]
    lines = markdown(rows, "base").splitlines()
    assert lines[2] == "| fox | base | 100.0 | 1.000 | – | 30.00 | – | – | .9000 | .1000 | 1,000 | 2.0 | 1 |"
    assert lines[3].startswith("|  | ours | 10.0 ± 1.0 | 0.100 | – | 31.00 ± 1.00 | – | – | .9000 ± .0000 | .1000, ")
    assert lines[3].endswith(" | .1000, .1000 | 2,000k | 2.0 | 3 |")
    assert lines[4] == "| south | ours | 10.0 | – | – | 30.00 | – | – | .9000 | – | 1,000 | – | 1 |"
    assert lines[-1] == "- fox, ours, seed 2 failed: RuntimeError: out of memory"


def test_table_takes_the_last_result_and_tells_of_shared_gpus():
    text = markdown([result(psnr=20.0, key="old"), result(psnr=25.0, key="new", jobs_per_gpu=2)])
    assert "25.00" in text
    assert "20.00" not in text
    assert text.endswith("- Some runs shared a GPU: their times are not comparable.")


def test_table_tells_of_our_runs_of_several_commits():
    commits = ["a" * 40, "b" * 40]
    rows = [result(seed=i, method="sadgs-indoor", versions={"commit": commits[i]}) for i in range(2)]
    told = "- The rows of sadgs are of several commits (aaaaaaa, bbbbbbb);"
    assert told in markdown(rows)
    assert told not in markdown([{**row, "method": "splatfacto"} for row in rows])


def test_a_finished_run_is_one_line():
    assert bench.line(result()) == (
        "fox ours seed 0: loop 10.0 s, PSNR 30.00, SSIM 0.9000, LPIPS 0.1000, 1,000 Gaussians, 2.00 GB"
    )
    assert bench.line(result(lpips=None, peak_gb=None)).endswith("SSIM 0.9000, 1,000 Gaussians")
    actual = bench.line(result(status="failed", error="no data."))
    assert actual == "fox ours seed 0: failed: no data."


def test_other_commands_are_told_and_reached(capsys: pytest.CaptureFixture[str]):
    for arguments in (["--help"], *([name, "--help"] for name in bench.COMMANDS)):
        with pytest.raises(SystemExit, match="0"):
            bench.main(arguments)
        printed = capsys.readouterr().out
        assert printed.startswith(f"usage: python -m benchmarks {arguments[0] if len(arguments) == 2 else '['}")
        if len(arguments) == 1:
            for name in bench.COMMANDS:
                assert f"  {name}: " in printed
