"""The protocols in configs/bench, and what a benchmark says of scenes that are not there; nothing is trained."""

from __future__ import annotations

import importlib
import re
import subprocess
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks import __main__ as bench
from benchmarks import protocol
from benchmarks.datasets import check, image_names
from benchmarks.protocol import Job, Row, Scene
from benchmarks.run import build_config

CONFIGS = Path(__file__).parents[2] / "configs/bench"
OTHERS = ("captures", "chain", "chain-exposure", "disturbed-cameras", "placing", "seconds")
"""The description of the captures, and protocols of `chain`, `cameras` and `seconds`, which begin with photos."""
PROTOCOLS = sorted(path.stem for path in CONFIGS.glob("*.yaml") if path.stem not in OTHERS)
OPTIONS = {"colmap_path": "sparse/0", "downscale_factor": 4}


@pytest.fixture(scope="module", autouse=True)
def nerfstudio() -> None:
    """nerfstudio's registry, imported without the warnings of its own modules."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        importlib.import_module("nerfstudio.configs.method_configs")


def load(name: str) -> protocol.Protocol:
    return protocol.load(CONFIGS / f"{name}.yaml")


def configs(name: str, root: Path) -> dict[tuple[str, str], Any]:
    """By scene and label."""
    jobs = load(name).jobs()
    for job in jobs:
        (root / job.scene.data).mkdir(parents=True, exist_ok=True)
    return {(j.scene.name, j.row.label): build_config(j.scene, j.row, j.seed, root, root) for j in jobs}


def colmap_scene(
    folder: Path,
    images: str = "images_4",
    names: tuple[str, ...] = ("a.jpg", "b.jpg"),
    size: tuple[int, int] = (4, 3),
    text: bool = False,
) -> Path:
    """A scene with a COLMAP model of these images, in this order, and their files in one folder."""
    from nerfstudio.data.utils import colmap_parsing_utils as colmap

    (folder / images).mkdir(parents=True)
    (folder / "sparse/0").mkdir(parents=True)
    for name in names:
        Image.new("RGB", size).save(folder / images / name)
    pose = (np.array([1.0, 0, 0, 0]), np.zeros(3))
    points = (np.zeros((1, 2)), np.array([-1]))
    views = {i: colmap.Image(i, *pose, 1, name, *points) for i, name in enumerate(names, 1)}
    cameras = {1: colmap.Camera(1, "PINHOLE", 16, 12, np.array([10.0, 10.0, 8.0, 6.0]))}
    colmap.write_model(cameras, views, {}, str(folder / "sparse/0"), ext=".txt" if text else ".bin")
    return folder


def job(name: str = "garden", **options: Any) -> Job:
    return Job(Scene(name, name, "colmap", {**OPTIONS, **options}), Row("ours", "sadgs"), 0)


def names_of(options: dict[str, Any], folder: Path) -> list[str]:
    config = build_config(Scene("s", folder.name, "colmap", options), Row("r", "sadgs"), 0, folder.parent, folder)
    return image_names(config.pipeline.datamanager.dataparser, folder)  # type: ignore[attr-defined]


# Protocols


@pytest.mark.parametrize("name", PROTOCOLS)
def test_every_row_of_every_protocol_fits_the_config_of_its_method(name: str, tmp_path: Path):
    jobs = load(name).jobs()
    assert len({job.key for job in jobs}) == len(jobs)
    assert len(configs(name, tmp_path)) >= 1


@pytest.mark.parametrize("name", ["mipnerf360", "deep-blending", "tanks-and-temples"])
def test_table_1_has_the_settings_of_the_paper(name: str, tmp_path: Path):
    built = configs(name, tmp_path)
    for ours in ("sadgs", "sadgs-paper"):
        actual = {scene for scene, label in built if label == ours}
        assert actual == set(load(name).scenes)
    for (scene, label), config in built.items():
        parser = config.pipeline.datamanager.dataparser
        assert parser.eval_mode == "interval"
        assert parser.eval_interval == 8
        assert parser.colmap_path == Path("sparse/0")
        indoor = scene in {"room", "counter", "kitchen", "bonsai"}
        assert parser.downscale_factor == {"mipnerf360": 2 if indoor else 4}.get(name, 1)
        if label == "sadgs-paper":
            assert config.pipeline.views_per_iteration == (2 if indoor or name == "deep-blending" else 1)
            assert config.max_num_iterations == (7000 if name == "tanks-and-temples" else 3000)
        if label == "sadgs":
            assert config.max_num_iterations is None, "derived"
            assert config.pipeline.views_per_iteration is None, "derived"
        if label.startswith("sadgs"):
            assert config.pipeline.model.strategy.tau_split == 0.8
    expected = {
        "mipnerf360": {*["bicycle", "flowers", "garden", "stump", "treehill", "room", "counter", "kitchen", "bonsai"]},
        "deep-blending": {"drjohnson", "playroom"},
        "tanks-and-temples": {"train", "truck"},
    }[name]
    assert set(load(name).scenes) == expected


@pytest.mark.parametrize(
    ("full", "stored"),  # sizes of the official images and images_4 or images_2
    [((4946, 3286), (1237, 822)), ((5187, 3361), (1297, 840)), ((3114, 2075), (1557, 1038))],
)
def test_the_cameras_of_mipnerf360_have_the_size_of_the_official_images(full: tuple[int, int], stored: tuple[int, int]):
    from nerfstudio.cameras.cameras import Cameras

    options = load("mipnerf360").scenes["bicycle" if full[0] > 4000 else "room"].options
    camera = Cameras(torch.eye(4)[None, :3], 1.0, 1.0, full[0] / 2, full[1] / 2, width=full[0], height=full[1])
    camera.rescale_output_resolution(1 / options["downscale_factor"], options["downscale_rounding_mode"])
    assert (camera.width.item(), camera.height.item()) == stored


def test_each_ablation_changes_one_thing_of_the_full_method(tmp_path: Path):
    built = configs("ablations", tmp_path)
    strategy = "pipeline.model.strategy"
    windows = {"structure_every": 500, "absgs_every": 100, "refine_start_iter": 100, "reset_every": 1200}
    longer = {f"{strategy}.{name}": value for name, value in windows.items()}  # as in the preset
    full: dict[str, Any] = {}
    no_absgs = {f"{strategy}.absgs_every": 0}
    dense = {"pipeline.model.stereo_points": 150_000}
    of_castle = {"AbsGS, dense start": dense, "no AbsGS, dense start": no_absgs | dense}
    caps = {
        ("fox", "as many as splatfacto"): 390_000,
        ("castle", "as many as splatfacto"): 750_000,
        ("tree", "as many as splatfacto"): 800_000,
        ("fox", "as many as FastGS"): 143_000,
        ("fox", "sadgs, as many as FastGS"): 110_000,
    }
    of_three = {
        "30k iterations": {"max_num_iterations": 30000, **longer},
        "15k iterations": {"max_num_iterations": 15000, **longer},
        "full": full,
        "30k position schedule": {"optimizers.means.scheduler.max_steps": 30000},
        "no multiview consistency": {f"{strategy}.tau_split": 0.0},
        "no structure steps": {f"{strategy}.structure_every": 0},
        "no AbsGS": no_absgs,
        "no bounding-box points": {"pipeline.model.bounding_box_points": False},
    }
    changes = {
        **{(scene, label): change for scene in ("bonsai", "fox", "south-half") for label, change in of_three.items()},
        **{("castle-4", label): change for label, change in of_castle.items()},
        **{(scene, "full"): full for scene in ("castle", "tree")},
        **{run: {f"{strategy}.max_gaussians": cap} for run, cap in caps.items()},
    }
    ours = [row for row in load("ablations").rows if row.method.startswith("sadgs")]
    actual = {(scene, row.label): row.overrides for row in ours for scene in row.scenes or ()}
    assert actual == changes
    for scene, label in changes:
        paper = "sadgs-paper-indoor" if scene in ("bonsai", "fox") else "sadgs-paper"
        assert built[scene, label].method_name == ("sadgs" if label.startswith("sadgs") else paper)


def test_the_progressive_ablation_begins_with_splatfacto_and_another_schedule_of_positions(tmp_path: Path):
    built = configs("ablations", tmp_path)
    for scene in ("bonsai", "fox", "south-half"):
        base = built[scene, "base"]
        schedule = built[scene, "+ schedule"]
        assert base.method_name == schedule.method_name == "splatfacto"
        assert base.max_num_iterations == schedule.max_num_iterations == 3000
        steps = [config.optimizers["means"]["scheduler"].max_steps for config in (base, schedule)]
        assert steps == [30000, 3000]


def of_sadgs(name: str, root: Path) -> dict[tuple[str, str], Any]:
    """Configs of the protocol's rows of `sadgs`."""
    return {key: config for key, config in configs(name, root).items() if config.method_name == "sadgs"}


def test_all_efforts_are_measured_on_all_scenes(tmp_path: Path):
    built = of_sadgs("ours", tmp_path)
    efforts: dict[str, set[float]] = {}
    for (scene, _), config in built.items():
        assert config.pipeline.model.background_color == ("white" if scene == "lego" else "black")
        assert config.max_num_iterations is None
        assert config.rates_follow_views
        efforts.setdefault(scene, set()).add(config.pipeline.effort)
    assert set(efforts) == set(load("ours").scenes)
    for of_scene in efforts.values():
        assert of_scene == {0.25, 0.5, 1.0, 2.0, 4.0, 8.0}


def test_defaults_are_chosen_on_validation_views_and_the_main_table_is_of_test_views():
    for name, options in (("defaults", {}), ("ours", {"eval_mode": "interval", "eval_interval": 8})):
        for scene in load(name).scenes.values():
            held_out = {key: value for key, value in scene.options.items() if key.startswith("eval")}
            assert held_out == ({} if scene.name == "lego" else options)


def test_the_main_table_has_three_seeds_of_both_methods():
    seeds: dict[tuple[str, str], list[int]] = {}
    for made in load("ours").jobs():
        seeds.setdefault((made.row.label, made.scene.name), []).append(made.seed)
    for scene in load("ours").scenes:
        assert seeds["sadgs", scene] == [0, 1, 2]
        assert seeds["splatfacto", scene] == [0, 1, 2]
        for label in ("effort 0.5", "effort 4"):
            assert seeds[label, scene] == [0]


def content(*rows: dict[str, Any], **changes: Any) -> dict[str, Any]:
    scene = {"data": "x", "dataparser": "colmap"}
    return {"scenes": {"fox": scene, "south": scene}, "rows": list(rows), **changes}


def test_rows_of_different_scenes_may_share_a_label():
    fox = {"label": "full", "method": "sadgs", "scenes": ["fox"]}
    south = {"label": "full", "method": "sadgs", "scenes": ["south"]}
    jobs = protocol.parse(content(fox, south, seeds=[0])).jobs()
    actual = [(job.scene.name, job.row.label) for job in jobs]
    expected = [("fox", "full"), ("south", "full")]
    assert actual == expected
    with pytest.raises(ValueError, match="two rows have the label 'full' for south"):
        protocol.parse(content(south, {"label": "full", "method": "sadgs"}))


def test_the_source_is_text_and_changes_no_key():
    row = {"label": "full", "method": "sadgs"}
    with_source = protocol.parse(content(row, source="the moon"))
    without = protocol.parse(content(row))
    assert with_source.source == "the moon"
    assert without.source is None
    actual = [job.key for job in with_source.jobs()]
    expected = [job.key for job in without.jobs()]
    assert actual == expected
    with pytest.raises(ValueError, match="source must be text, not 3"):
        protocol.parse(content(row, source=3))


# Scenes that are not there


@pytest.mark.parametrize("text", [False, True])
def test_names_come_in_the_models_order_from_the_folder_of_that_size(tmp_path: Path, text: bool):
    folder = colmap_scene(tmp_path / "garden", "images_4", ("b.jpg", "a.jpg"), text=text)
    assert names_of(OPTIONS, folder) == ["b.jpg", "a.jpg"]
    with pytest.raises(FileNotFoundError, match=re.escape(f"{folder / 'images_2'} does not exist")):
        names_of({**OPTIONS, "downscale_factor": 2}, folder)


def test_without_a_factor_the_folder_is_the_one_that_nerfstudio_would_choose(tmp_path: Path):
    small = colmap_scene(tmp_path / "small", "images", size=(1600, 1))
    actual = names_of({"colmap_path": "sparse/0"}, small)
    assert actual == ["a.jpg", "b.jpg"]
    large = colmap_scene(tmp_path / "large", "images", size=(3201, 1))
    with pytest.raises(FileNotFoundError, match="large/images_4 does not exist"):
        names_of({"colmap_path": "sparse/0"}, large)


def test_what_is_missing_in_a_scene_is_named(tmp_path: Path):
    folder = colmap_scene(tmp_path / "garden")
    (folder / "images_4/b.jpg").unlink()
    with pytest.raises(FileNotFoundError, match=r"garden/images_4 lacks 1 of 2 images, such as b\.jpg"):
        names_of(OPTIONS, folder)
    with pytest.raises(FileNotFoundError, match="garden/sparse holds no COLMAP model"):
        names_of({**OPTIONS, "colmap_path": "sparse"}, folder)


def test_all_missing_scenes_are_one_sentence_with_their_source(tmp_path: Path):
    with pytest.raises(ValueError) as error:
        check([job("garden"), job("stump")], tmp_path, "the data set Mip-NeRF 360")
    assert str(error.value) == (
        f"scene 'garden': {tmp_path / 'garden'} does not exist, scene 'stump': {tmp_path / 'stump'} does not exist; "
        "check --scenes or get the data set Mip-NeRF 360."
    )


def test_another_order_of_the_images_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    colmap_scene(tmp_path / "garden", names=("b.jpg", "a.jpg"))
    check([job()], tmp_path)
    errors = capsys.readouterr().err
    assert "scene 'garden': COLMAP numbered its images in another order" in errors


def test_the_command_says_what_is_missing_before_it_runs_anything(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    output = tmp_path / "out/results.jsonl"
    command = [str(CONFIGS / "mipnerf360.yaml"), "--scenes", str(tmp_path), "--output", str(output)]
    status = bench.main(command)
    assert status == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"{tmp_path / 'bicycle'} does not exist" in said
    assert "360_v2" in said
    assert not output.parent.exists()


def test_a_run_cannot_wait_for_an_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    given: dict[str, Any] = {}
    monkeypatch.setattr(subprocess, "Popen", lambda command, **options: given.update(options))
    bench.launcher(tmp_path)(job(), None, tmp_path)
    assert given["stdin"] == subprocess.DEVNULL
