"""The benchmark of the whole way from photos to the file: what is held out, how a file is drawn, and what lowers it."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import yaml
from numpy.testing import assert_allclose
from PIL import Image
from torch.nn import Parameter

from benchmarks import chain, chain_score, chain_table, results, side_by_side
from examples import simple_trainer
from examples.drawn_scene.drawing import View, render
from examples.drawn_scene.scene import SceneDescription, describe_scene
from helpers import gsplat_like
from helpers.json_files import read_json, write_json
from sadgs_ns.formats import write
from sadgs_ns.formats.gaussians import of_parameters
from sadgs_ns.render.types import Gaussians

WIDTH = 64
HEIGHT = 48
VIEWS = 16


def test_every_eighth_photo_is_held_out_whatever_its_suffix_in_the_scene(tmp_path: Path):
    photos = [f"{i:02d}.jpg" for i in range(17)]
    assert chain.held_out(photos) == ["00.jpg", "08.jpg", "16.jpg"]
    # The seventeenth did not register, and the ninth was converted.
    names = [f"images/{name}" for name in photos[:16] if name != "08.jpg"] + ["images/08.jpg.png"]
    write_json(tmp_path / "transforms.json", {"frames": [{"file_path": name} for name in names]})
    actual = chain.hold_out(tmp_path, chain.held_out(photos))
    assert actual == 14
    described = read_json(tmp_path / "transforms.json")
    assert set(described["test_filenames"]) == {"images/00.jpg", "images/08.jpg.png"} == set(described["val_filenames"])
    actual = set(described["train_filenames"])
    assert actual == set(names) - set(described["test_filenames"])


def row(label: str, seed: int, views: dict[str, list[float]], **fields: Any) -> dict[str, Any]:
    seconds = {"cameras": 10.0, "training": 20.0, "export": 2.0}
    others = {"photos": 16, "registered": 16, "missing": [], "gaussians": 12_345, "seconds": seconds}
    return {"scene": "desk", "label": label, "seed": seed, "status": "ok", "views": views, **others, **fields}


def test_a_table_compares_views_that_registered_in_all_rows():
    whole = {"a": [20.0, 0.5, 0.2], "b": [30.0, 0.7, 0.4]}
    rows = [
        row("old", 0, whole),
        row("old", 1, {"a": [22.0, 0.5, 0.2], "b": [30.0, 0.7, 0.4]}),
        row("new", 0, {"a": [25.0, 0.6, 0.1]}, registered=15, missing=["b"]),
    ]
    assert chain_table.common_views(rows) == ["a"]
    old, new = chain_table.markdown(rows).splitlines()[2:]
    assert "| desk | old | 16 of 16 | 21.00 ± 1.41 | .5000 ± .0000 | .2000 ± .0000 | 20.0 | 12k |" in old
    assert "| desk | new | 15 of 16 | 25.00 | .6000 | .1000 | 25.0 | 12k |" in new
    assert old.endswith("| b |")
    assert new.endswith("| b |")


def test_a_run_with_gains_has_a_second_line_for_renderings_at_their_photo_s_exposure():
    gained = row("gains", 0, {"a": [20.0, 0.5, 0.2]}, gain_views={"a": [23.0, 0.6, 0.1]})
    plain, at_exposure = chain_table.markdown([gained]).splitlines()[2:]
    assert "| desk | gains | 16 of 16 | 20.00 | .5000 | .2000 |" in plain
    assert "| desk | gains, at the photo's exposure | 16 of 16 | 23.00 | .6000 | .1000 |" in at_exposure


def test_the_protocol_names_eight_captures():
    protocol = chain.load(Path(chain.__file__).parents[1] / "configs/bench/chain.yaml")
    assert len(protocol.captures) == 8
    assert protocol.seeds == [0, 1, 2]
    assert protocol.max_size == 1600


def test_a_protocol_that_is_none_is_refused(tmp_path: Path):
    file = tmp_path / "chain.yaml"
    with pytest.raises(ValueError, match="cannot be read"):
        chain.load(file)
    file.write_text(yaml.dump({"captures": {}, "colour": "red"}))
    with pytest.raises(ValueError, match="must be YAML with captures and seeds"):
        chain.load(file)


def test_a_gaussian_is_drawn_where_the_photo_s_distorted_camera_sees_it():
    import pycolmap

    params = [60.0, 60.0, 40.0, 30.0, -0.2, 0.05, 0.01, -0.01]
    camera = pycolmap.Camera(model="OPENCV", width=80, height=60, params=params)
    center = np.array([0.5, -0.3, 1.0])
    gaussians = Gaussians(
        means=torch.from_numpy(center).float()[None],
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        scales=torch.full((1, 3), 0.02),
        opacities=torch.ones(1),
        colors=(torch.full((1, 3), 1.7), torch.zeros((1, 0, 3))),
    )
    drawn = chain_score.draw(chain_score.Splat(gaussians, 0), camera, np.eye(3, 4), (80, 60)).photo()
    assert drawn.shape == (60, 80, 3)
    assert drawn.max() > 0.5
    y, x = np.mgrid[:60, :80] + 0.5
    weights = drawn.sum(axis=-1)
    found = np.array([(x * weights).sum(), (y * weights).sum()]) / weights.sum()
    expected = np.asarray(camera.img_from_cam(center[None]))[0]
    assert np.abs(expected - [40 + 60 * 0.5, 30 - 60 * 0.3]).max() > 2, "the lens moves it"
    assert_allclose(found, expected, atol=0.15)


def test_an_exposure_shows_what_is_too_bright_at_the_median_one():
    import pycolmap

    camera = pycolmap.Camera(model="PINHOLE", width=24, height=16, params=[12.0, 12.0, 12.0, 8.0])
    gaussians = Gaussians(
        means=torch.tensor([[0.0, 0.0, 1.0]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        scales=torch.full((1, 3), 30.0),
        opacities=torch.full((1,), 0.999),
        colors=(torch.full((1, 3), 1.0 / 0.28209479), torch.zeros((1, 0, 3))),  # Harmonics that mean 1.5
    )
    splat = chain_score.Splat(gaussians, 0)
    drawing = chain_score.draw(splat, camera, np.eye(3, 4), (24, 16))
    assert drawing.photo()[8, 12].tolist() == [1, 1, 1]
    gained = drawing.photo(gains=[0.6, 0.5, 0.4])[8, 12]
    alpha = 0.999
    expected = [alpha * (1.5 * k + 0.055 * (k - 1)) for k in (0.6, 0.5, 0.4)]
    assert_allclose(gained, expected, atol=2e-3)


def write_capture(folder: Path, scene: SceneDescription, images: np.ndarray) -> tuple[Path, Path]:
    """Write photos, and a scene of `sadgs-process` that has their cameras alone; return both folders."""
    import pycolmap

    photos = folder / "photos"
    model = folder / "scene" / "work/model"
    photos.mkdir(parents=True)
    model.mkdir(parents=True)
    reconstruction = pycolmap.Reconstruction()
    for i, view in enumerate(scene.views):
        Image.fromarray(images[i]).save(photos / view.name)
        center = [WIDTH / 2, HEIGHT / 2]
        camera = pycolmap.Camera(
            model="PINHOLE", width=WIDTH, height=HEIGHT, params=[view.focal, view.focal, *center], camera_id=i + 1
        )
        reconstruction.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=view.name, camera_id=i + 1, image_id=i + 1)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(view.rotation), view.translation)
        reconstruction.add_image_with_trivial_frame(image, pose)
    reconstruction.write(model)
    write_json(folder / "scene" / "work/settings.json", {"model": "model"})
    return folder / "scene", photos


def train(scene: SceneDescription, images: np.ndarray, file: Path) -> None:
    """Train a few iterations on images that are not held out, and write the file."""
    torch.manual_seed(0)
    kept = [i for i in range(VIEWS) if i % chain.INTERVAL]
    viewmats = torch.eye(4).repeat(VIEWS, 1, 1)
    Ks = torch.eye(3).repeat(VIEWS, 1, 1)
    for i, view in enumerate(scene.views):
        viewmats[i, :3] = torch.from_numpy(np.c_[view.rotation, view.translation])
        Ks[i, :2] = torch.tensor([[view.focal, 0.0, WIDTH / 2], [0.0, view.focal, HEIGHT / 2]])
    colors = torch.from_numpy(scene.colours) / 255
    params = simple_trainer.start_from(torch.from_numpy(scene.points).float(), colors, scale=0.03)
    targets = torch.from_numpy(images).float()[kept] / 255
    strategy = simple_trainer.StructureAwareStrategy(refine_stop_iter=0)
    simple_trainer.train(params, targets, viewmats[kept], Ks[kept], 1.0, 80, strategy)
    arrays = {name: parameter_values(params, name) for name in ("means", "scales", "quats")}
    arrays["opacities"] = parameter_values(params, "opacities")
    arrays["features_dc"] = parameter_values(params, "sh0")[:, 0]
    arrays["features_rest"] = parameter_values(params, "shN")
    write(file, of_parameters(arrays))


def parameter_values(params: dict[str, Parameter], name: str) -> np.ndarray:
    return params[name].detach().numpy()


def test_the_score_falls_when_the_photos_are_blurred_before_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(simple_trainer, "rasterization", gsplat_like.rasterization)
    monkeypatch.setenv("TORCH_HOME", "/dev/null")  # LPIPS is left out.
    scene = describe_scene(WIDTH, HEIGHT, VIEWS, points=3000)
    sharp = np.stack([draw_photo(scene, view) for view in scene.views])
    blurred = np.stack([cv2.GaussianBlur(image, (0, 0), 1.5) for image in sharp])
    folder, photos = write_capture(tmp_path, scene, sharp)
    names = chain.photos_of(photos)
    scores = {}
    for name, images in (("sharp", sharp), ("blurred", blurred)):
        file = tmp_path / f"{name}.ply"
        train(scene, images, file)
        splat = chain_score.read_splat(file, torch.device("cpu"))
        scores[name] = chain_score.compare(folder, photos, splat, 1600, names)
    actual = list(scores["sharp"]["views"])
    assert actual == chain.held_out(names)
    assert scores["sharp"]["registered"] == VIEWS
    assert scores["sharp"]["missing"] == []
    dark = dict.fromkeys(names, (0.5, 0.5, 0.5))
    splat = chain_score.read_splat(tmp_path / "sharp.ply", torch.device("cpu"))
    darker = chain_score.compare(folder, photos, splat, 1600, names, dark)
    assert darker["views"] == scores["sharp"]["views"]
    for name, (psnr, *_) in darker["gain_views"].items():
        assert psnr < darker["views"][name][0] - 3
    assert scores["sharp"]["psnr"] > scores["blurred"]["psnr"] + 0.5
    assert scores["sharp"]["ssim"] > scores["blurred"]["ssim"] + 0.03


def draw_photo(scene: SceneDescription, view: View) -> np.ndarray:
    return render(scene.surfaces, view)


def test_a_chain_that_ends_without_a_row_is_a_failed_one_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    names = ["desk", "lamp"]
    for name in names:
        (tmp_path / name).mkdir()
        (tmp_path / name / "0.jpg").touch()
    (tmp_path / "chain.yaml").write_text(yaml.dump({"captures": {name: name for name in names}, "seeds": [0]}))
    started: list[tuple[str, str | None]] = []

    def start(
        measured: chain.Chain, gpu: str | None, work: Path, site: Path | None, log: Path
    ) -> subprocess.Popen[bytes]:
        started.append((measured.capture, gpu))
        if measured.capture == "desk":
            return subprocess.Popen(["false"], start_new_session=True)
        identity = {"key": measured.key, "lpips": 0.2, "psnr": 30.0, "ssim": 0.9}
        write_json(work / "row.json", {**row("new", 0, {"a": [30.0, 0.9, 0.2]}), **identity})
        return subprocess.Popen(["true"], start_new_session=True)

    monkeypatch.setattr(chain, "_start", start)
    monkeypatch.setattr(side_by_side, "POLL_SECONDS", 0.01)
    output = tmp_path / "rows.jsonl"
    command = chain.Command(tmp_path / "chain.yaml", tmp_path, output, "new", gpus="1")
    assert command() == 1
    assert started == [("desk", "1"), ("lamp", "1")]
    failed, done = results.read(output)
    assert failed["key"] == "desk/new/0"
    assert failed["status"] == "failed"
    assert "code 1 and no row" in failed["error"]
    assert done["key"] == "lamp/new/0"
    assert done["status"] == "ok"
    started.clear()
    command()
    assert started == [("desk", "1")], "what is done is not done again"


def test_a_score_that_fails_has_a_row_with_its_name_and_its_output_in_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    photos = tmp_path / "desk"
    photos.mkdir()
    (photos / "0.jpg").touch()
    work = tmp_path / "work"
    (work / "scene").mkdir(parents=True)
    write_json(work / "scene/transforms.json", {"frames": [{"file_path": "images/0.jpg"}]})

    def run_program(code: str, *arguments: Any) -> None:
        if code != chain.LOADER:  # The package's commands leave no splat here, which the score needs.
            side_by_side.run_program(code, *arguments)

    monkeypatch.setattr(chain, "run_program", run_program)
    log = tmp_path / "rows.log"
    failed = chain.row_of(chain.Chain("desk", photos, 0, "new", 64, 1.0), work, None, log)
    assert failed["status"] == "failed"
    assert failed["error"] == f"chain_score ended with code 1; see {log}."
    output = log.read_text()
    assert output.startswith("=== desk/new/0\n")
    assert "splat.ply" in output
