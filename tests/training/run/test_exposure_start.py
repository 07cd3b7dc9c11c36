"""Whole runs on photos whose exposures are known: gains come from points' colours and stay as they were found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.models.splatfacto import SH2RGB
from numpy.testing import assert_allclose
from PIL import ExifTags, Image
from torch import Tensor
from torch.testing import assert_close

from benchmarks.evaluate import quality
from benchmarks.exposures import with_gains
from examples.drawn_scene.scene import describe_scene, write_scene
from helpers.closeness import assert_within_share
from helpers.gloo_ranks import run_ranks
from helpers.json_files import read_json, write_json
from helpers.kill_and_resume import parser_of, set_up
from helpers.sharded_training import few_steps, set_up_together
from helpers.short_runs import configure, nerfstudio_data, train
from sadgs_ns.cli.measuring import outputs_of_file
from sadgs_ns.cli.splat_file import Splat
from sadgs_ns.distributed.world import World
from sadgs_ns.geometry.point_colors import BRIGHTEST, apply_gains
from sadgs_ns.method.losses import photometric_loss
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.model import SadgsModel
from sadgs_ns.training.run import exposure_start
from sadgs_ns.training.run.point_observations import PointObservations
from sadgs_ns.training.run.trainer import SadgsTrainer
from sadgs_ns.training.step.train_step import ViewGroup, training_step

WIDTH = 64
HEIGHT = 48
VIEWS = 14
POINTS = 1500
APART = 1.5
"""Stops between the two exposures of the training photos."""
INTERVAL = 8
"""Every 8th photo from the first is held out."""


def stops_of(index: int) -> float:
    """log₂ of a photo's gain: every other training photo is darker, and held-out ones lie between."""
    if index % INTERVAL == 0:
        return -0.5 * APART
    place = index - index // INTERVAL  # Among the training photos, which are as many of either exposure
    return -APART * (place % 2)


@pytest.fixture(scope="module")
def exposed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drawn room with photos of two exposures, and held-out photos with their median; to be read only."""
    folder = tmp_path_factory.mktemp("exposed") / "room"
    write_scene(folder, WIDTH, HEIGHT, VIEWS, POINTS)
    for index, path in enumerate(sorted((folder / "images").iterdir())):
        gains = np.full(3, 2.0 ** stops_of(index))
        Image.fromarray(with_gains(np.asarray(Image.open(path)), gains)).save(path)
    return folder


def run_of(scene: Path, output: Path, exposure: Any = "auto", iterations: int = 2) -> SadgsTrainerConfig:
    config = configure(output, parser_of(scene), iterations)
    config.pipeline.model.starts_per_pixel = 0.0  # On small images, too, all points
    config.machine.device_type = "cpu"
    config.pipeline.views_per_iteration = 1
    config.pipeline.model.exposure = exposure
    config.pipeline.model.strategy.refine_stop_iter = 0
    return config


def training_stops() -> np.ndarray:
    stops = np.array([stops_of(index) for index in range(VIEWS) if index % INTERVAL])
    return stops - np.median(stops)


@pytest.mark.slow
def test_photos_of_two_exposures_train_to_the_median_exposure(exposed: Path, tmp_path: Path, monkeypatch: Any):
    monkeypatch.setattr(SadgsModel, "lpips", lambda *_: float("nan"))  # Its weights would be downloaded.
    measured = {}
    for exposure in ("auto", "off"):
        trainer = train(run_of(exposed, tmp_path / exposure, exposure, 150))
        trainer.pipeline.eval()
        model = trainer.pipeline.model
        measured[exposure] = quality(model, trainer.pipeline.datamanager.fixed_indices_eval_dataloader)
        means = trainer.pipeline.get_average_eval_image_metrics()
        assert ("gain_psnr" in means) == (exposure == "auto")
    assert measured["auto"]["psnr"] > measured["off"]["psnr"] + 0.4
    assert measured["auto"]["ssim"] > measured["off"]["ssim"] + 0.02
    expected = pytest.approx(measured["auto"]["psnr"], abs=0.3)
    assert measured["auto"]["gain_psnr"] == expected, "they have the median"
    assert "gain_psnr" not in measured["off"]


@pytest.mark.hard_case(
    "held-out photos that are darker than the median, with things that are too bright at the median exposure",
    "their rendering gets its exposure before it is clamped",
)
def test_held_out_photos_show_what_the_median_exposure_clips(exposed: Path, tmp_path: Path, monkeypatch: Any):
    monkeypatch.setattr(SadgsModel, "lpips", lambda *_: float("nan"))
    pipeline = set_up(run_of(exposed, tmp_path)).pipeline
    pipeline.eval()
    model = pipeline.model
    model.gauss_params["features_dc"].data.fill_(1.0 / 0.28209479)  # Harmonics that mean 1.5
    model.gauss_params["features_rest"].data.zero_()
    factors = torch.tensor([0.6, 0.5, 0.4])
    model.gain_of_held_out = lambda data: factors
    camera, batch = pipeline.datamanager.next_eval(0)
    outputs = model.get_outputs_for_camera(camera)
    gained = model.at_exposure_of_photo(outputs, batch)
    assert gained is not None
    alpha = outputs["accumulation"]
    assert_allclose(gained, alpha * (1.5 * factors + 0.055 * (factors - 1)), atol=1e-5)
    batch["image"] = gained
    metrics, _ = model.get_image_metrics_and_images(outputs, batch)
    assert metrics["gain_psnr"] > 80
    assert metrics["psnr"] < 20
    gaussians, _ = model.gaussians()
    first, rest = gaussians.colors
    measured = []
    for colors in ((first, rest), (first / 4, rest)):
        splat = Splat(gaussians._replace(colors=colors), model.config.sh_degree)
        measures, _ = model.get_image_metrics_and_images(outputs_of_file(model, splat, camera), batch)
        measured.append(measures)
    assert measured[0] == pytest.approx(metrics, rel=1e-5)
    assert measured[1]["gain_psnr"] < 20, "a file is measured as it is"


def test_gains_and_colours_of_points_are_those_that_were_drawn(exposed: Path, tmp_path: Path, capsys: Any):
    model = set_up(run_of(exposed, tmp_path)).pipeline.model
    printed = " ".join(capsys.readouterr().out.split())
    assert "Exposure, by the points' colours, varies by 0.7" in printed
    table = model.exposure
    assert table is not None
    assert model.exposure_maps is not None
    assert_allclose(table.stops, np.repeat(training_stops()[:, None], 3, axis=1), atol=0.1)
    expected = torch.exp2(table.stops / 2.4).float()
    factors, offsets = model.exposure_maps.unbind(dim=1)
    assert_close(factors, expected)
    assert_close(offsets, 0.055 * (expected - 1))


def test_colours_of_points_are_brought_from_their_photos_mean_to_the_median_exposure(exposed: Path, tmp_path: Path):
    model = set_up(run_of(exposed, tmp_path / "auto")).pipeline.model
    plain = set_up(run_of(exposed, tmp_path / "off", "off")).pipeline.model
    described = describe_scene(WIDTH, HEIGHT, VIEWS, POINTS, 0)
    of_training = [index for index in range(VIEWS) if index % INTERVAL]
    sees = described.tracks[:, of_training]
    means = (sees * training_stops()).sum(1) / sees.sum(1)
    before = SH2RGB(plain.gauss_params["features_dc"].detach()).double().numpy()
    after = SH2RGB(model.gauss_params["features_dc"].detach()).double().numpy()
    assert len(before) == POINTS
    expected = (before + 0.055) * 2.0 ** (-means[:, None] / 2.4) - 0.055
    close = np.abs(after - expected.clip(0, 1)) < 0.02
    moved = np.abs(means) > 0.05
    assert moved.mean() > 0.3, "but where photos are too dark or clipped"
    assert close[moved].mean() > 0.8, "but where photos are too dark or clipped"


def test_even_exposure_trains_without_gains_and_a_line_says_so(tmp_path: Path, capsys: Any):
    write_scene(tmp_path / "room", WIDTH, HEIGHT, VIEWS, POINTS)
    model = set_up(run_of(tmp_path / "room", tmp_path / "out")).pipeline.model
    assert model.exposure is None
    assert model.view_ids([0]) is None
    printed = " ".join(capsys.readouterr().out.split())
    assert "which is too little" in printed


def test_other_options_train_without_gains(exposed: Path, tmp_path: Path):
    for name, change in (("exposure", "off"), ("color_model", "affine")):
        config = run_of(exposed, tmp_path / name)
        setattr(config.pipeline.model, name, change)
        assert set_up(config).pipeline.model.exposure is None


def with_gains_of_pictures(model: SadgsModel, colors: Tensor, alphas: Tensor, views: list[int]) -> Tensor:
    """Apply gains to finished pictures [C, H, W, 3], as the method is written down."""
    assert model.exposure is not None
    gains = model.exposure.gains()[views].float()
    pictures = [apply_gains(colors[c], gains[c], alphas[c]) for c in range(len(views))]
    return torch.stack(pictures)


def test_a_step_compares_photos_with_pictures_at_their_exposure_and_excuses_clipped_pixels(
    exposed: Path, tmp_path: Path
):
    config = run_of(exposed, tmp_path)
    config.pipeline.views_per_iteration = 2
    pipeline = set_up(config).pipeline
    model = pipeline.model
    model.train()
    model.gauss_params["features_dc"].data += 10.0  # Brighter than white in many pixels
    assert model.exposure is not None
    for _ in range(VIEWS):
        (group,) = pipeline.next_views(0)
        if model.exposure.stops[group.indices].std() > 0.5:  # Views of one gain would hide a mistake.
            break
    image = group.batch(None)["image"].clone()
    image[:, : HEIGHT // 2] = 255
    group = replace(group, images=image)
    views = group.indices
    assert model.exposure.stops[views].std() > 0.5

    result = training_loss(model, [group])
    colors, alphas, _ = model.render(group.cameras, group.options)
    gained = with_gains_of_pictures(model, colors, alphas, views)
    photo = image / 255
    excused = torch.where((photo > BRIGHTEST) & (gained > photo), photo, gained)
    expected, _ = photometric_loss(excused, photo, ssim_lambda=model.config.ssim_lambda)
    not_excused, _ = photometric_loss(gained, photo, ssim_lambda=model.config.ssim_lambda)
    plain, _ = photometric_loss(colors, photo, ssim_lambda=model.config.ssim_lambda)
    assert_close(result, expected.detach())
    for other in (not_excused, plain):
        assert abs(other.detach() - expected.detach()) > 0.01


def training_loss(model: SadgsModel, groups: list[ViewGroup]) -> Tensor:
    """Return the loss of a step whose update does nothing."""

    class NoUpdate:
        parameters = ("means",)

        def launch(self, *arguments: Any) -> None:
            pass

    nothing: Any = NoUpdate()
    return training_step(model, groups, 0.0, nothing, torch.zeros(0), torch.zeros(1)).loss


def test_what_moved_is_judged_by_pictures_at_the_photos_exposure(exposed: Path, tmp_path: Path):
    pipeline = set_up(run_of(exposed, tmp_path)).pipeline
    model = pipeline.model
    gaussians, _ = model.gaussians()
    views = [2, 3]
    with torch.no_grad():
        drawn, depths, cameras = pipeline.moved_search._draw(gaussians, views)
        options = model.color_options(expected_depth=True)
        colors, alphas, _ = model.render(cameras, options)
        gained = with_gains_of_pictures(model, colors[..., :3], alphas, views).clamp(0, 1)
        assert_close(drawn, gained.movedim(-1, 1))
        assert (gained - colors[..., :3].clamp(0, 1)).abs().max() > 0.05
        plain = torch.where(depths > 0, colors[..., 3], 0.0)
        assert_close(depths, plain)
        assert (depths > 0).float().mean() > 0.2


def test_a_resumed_run_has_the_same_gains_bit_for_bit(exposed: Path, tmp_path: Path, monkeypatch: Any):
    first = train(run_of(exposed, tmp_path / "first")).pipeline.model.exposure
    config = run_of(exposed, tmp_path / "again", iterations=4)
    config.load_dir = tmp_path / "first/test/sadgs/run/nerfstudio_models"
    monkeypatch.setattr("sadgs_ns.training.run.exposure_start.fit_exposures", None)  # It is not computed anew.
    model = set_up(config).pipeline.model
    assert first is not None
    assert model.exposure is not None
    assert model.exposure.names == first.names
    assert torch.equal(model.exposure.stops, first.stops)
    assert torch.equal(model.exposure_maps, first.color_maps())  # type: ignore[arg-type]
    config.pipeline.model.exposure = "off"
    assert set_up(config).pipeline.model.exposure is None


@pytest.mark.hard_case("photos are added to a run with gains", "the earlier ones keep their gains, and so the median")
def test_added_photos_do_not_move_the_gains_of_earlier_ones(exposed: Path, tmp_path: Path, monkeypatch: Any):
    config = run_of(exposed, tmp_path / "first")
    parser: Any = config.pipeline.datamanager.dataparser
    parser.eval_mode = "interval"
    parser.eval_interval = 4
    before = train(config).pipeline.model.exposure
    config = run_of(exposed, tmp_path / "again", iterations=4)
    config.load_dir = tmp_path / "first/test/sadgs/run/nerfstudio_models"
    after = set_up(config).pipeline.model.exposure
    assert before is not None
    assert after is not None
    rows = {name: row for row, name in enumerate(after.names)}
    kept = [rows[name] for name in before.names]
    assert len(before.names) < len(after.names)
    assert torch.equal(after.stops[kept], before.stops)
    shift = (after.stops[kept].mean(dim=1).numpy() - training_stops()[kept]).mean()
    actual = after.stops.mean(dim=1).numpy()
    assert_allclose(actual, training_stops() + shift, atol=0.06)


@pytest.mark.hard_case(
    "a run with gains is resumed after its photos' folder was renamed, or with photos of other names",
    "the gains stay, or are found anew",
)
@pytest.mark.parametrize("name", ["images", "photo"])
def test_gains_stay_if_the_folder_has_another_name_and_are_found_anew_with_unknown_photos(
    name: str, exposed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    before = train(run_of(exposed, tmp_path / "first")).pipeline.model.exposure
    trainer = set_up(run_of(exposed, tmp_path / "again", iterations=4))
    pipeline = trainer.pipeline
    assert before is not None
    files: Any = pipeline.datamanager.train_dataset.image_filenames
    files[:] = [path.parent.with_name("renamed") / path.name.replace("image", name) for path in files]
    if name == "photo":
        files[:] = [path.with_name(f"photo_{path.name}") for path in files]
    pipeline.model.set_exposure(before)
    colors = pipeline.model.gauss_params["features_dc"].clone()
    exposure_start.resume_with_gains(pipeline, pipeline.model.world)
    after = pipeline.model.exposure
    assert after is not None
    printed = " ".join(capsys.readouterr().out.split())
    if name == "images":
        assert torch.equal(after.stops, before.stops)
        assert f"{len(files)} photos keep theirs, 0 were added" in printed
    else:
        assert "found anew, because no photo has the name of one that the checkpoint knows" in printed
        assert_allclose(after.stops.numpy(), before.stops.numpy(), atol=1e-6)
    assert after.names[0].startswith("renamed/")
    assert torch.equal(pipeline.model.gauss_params["features_dc"], colors), "the Gaussians were trained already"


@pytest.mark.hard_case(
    "`exposure auto` where it can do nothing: with learned colour matrices, or a checkpoint without gains",
    "a line says so",
)
def test_a_line_tells_why_there_are_no_gains(exposed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    config = run_of(exposed, tmp_path / "first")
    config.pipeline.model.color_model = "affine"
    train(config)
    assert "Gains of exposure are off, because a colour matrix" in " ".join(capsys.readouterr().out.split())
    config = run_of(exposed, tmp_path / "second")
    config.pipeline.model.exposure = "off"
    train(config)
    config = run_of(exposed, tmp_path / "again", iterations=4)
    config.load_dir = tmp_path / "second/test/sadgs/run/nerfstudio_models"
    set_up(config)
    assert "the checkpoint has none, and so has this run" in " ".join(capsys.readouterr().out.split())


def exposures_together(world: World, config: SadgsTrainerConfig) -> dict[str, Any]:
    """Train in several processes, as `exposures_of` in one."""
    return exposures_of(set_up_together(world, config))


def exposures_of(trainer: SadgsTrainer) -> dict[str, Any]:
    """Train, and return this process's gains and losses."""
    losses = []
    iterate = trainer.train_iteration

    def noted(step: int) -> Any:
        result = iterate(step)
        losses.append(float(result[0]))
        return result

    trainer.train_iteration = noted  # type: ignore[method-assign]
    trainer.train()
    model = trainer.pipeline.model
    assert model.exposure is not None
    assert model.exposure_maps is not None
    return {"stops": model.exposure.stops, "maps": model.exposure_maps, "losses": losses}


def test_two_processes_train_with_the_same_gains_as_one(exposed: Path, tmp_path: Path):
    def configured(name: str) -> SadgsTrainerConfig:
        config = few_steps(exposed, tmp_path / name, views=2)
        config.pipeline.model.bounding_box_points = False
        config.pipeline.model.exposure = "auto"
        return config

    torch.manual_seed(0)
    alone = exposures_of(set_up(configured("alone")))
    results = run_ranks(exposures_together, 2, tmp_path / "meet", configured("together"))
    for result in results:
        assert torch.equal(result["stops"], alone["stops"])
        assert torch.equal(result["maps"], alone["maps"])
        actual = torch.tensor(result["losses"][:4])
        expected = torch.tensor(alone["losses"][:4])
        assert_within_share(actual, expected, 1e-5)


def with_exif(folder: Path, name: str) -> NerfstudioDataParserConfig:
    """Data without points, whose photos' EXIF says that every other one was exposed half as long."""
    parser = nerfstudio_data(folder)
    path = parser.data / "transforms.json"
    meta = read_json(path)
    for index, frame in enumerate(meta["frames"]):
        drawn = parser.data / frame["file_path"]
        file = drawn.with_suffix(".jpg")
        frame["file_path"] = f"images/{file.name}"
        exif = Image.Exif()
        tags: dict[Any, float] = {ExifTags.Base.ExposureTime: 0.01 * 2.0 ** -(index % 2)}
        tags |= {ExifTags.Base.FNumber: 4.0, ExifTags.Base.ISOSpeedRatings: 100}
        exif.get_ifd(ExifTags.IFD.Exif).update(tags)
        Image.open(drawn).save(file, exif=exif, quality=98)
    write_json(path, meta)
    return parser


def test_exif_serves_without_points(tmp_path: Path, monkeypatch: Any):
    monkeypatch.setattr(SadgsModel, "lpips", lambda *_: float("nan"))
    config = configure(tmp_path / "out", with_exif(tmp_path / "data", "exif"), 2)
    config.pipeline.model.exposure = "auto"
    pipeline = set_up(config).pipeline
    table = pipeline.model.exposure
    assert table is not None
    assert len(table.points) == 0
    steps = table.stops[:, 0] - table.stops[:, 0].roll(1)
    assert set(table.stops.unique().round(decimals=3).tolist()) <= {-1.0, -0.5, 0.0, 0.5, 1.0}
    assert steps.abs().max() == 1
    pipeline.eval()
    assert "gain_psnr" in pipeline.get_average_eval_image_metrics()


def test_a_line_says_if_exif_and_points_disagree(exposed: Path, tmp_path: Path, monkeypatch: Any, capsys: Any):
    stops = iter(np.linspace(-8, -5, VIEWS - 2))
    monkeypatch.setattr(exposure_start, "exposures_of", lambda files: [float(next(stops)) for _ in files])
    model = set_up(run_of(exposed, tmp_path)).pipeline.model
    printed = " ".join(capsys.readouterr().out.split())
    assert "By EXIF, exposure varies in a range of 3.0 stops, but by the points' colours of 1.5" in printed
    assert model.exposure is not None
    actual = model.exposure.stops.mean(dim=1)
    assert_allclose(actual, training_stops(), atol=0.1)


@pytest.mark.hard_case("thousands of photos", "10,000 points are looked for in each, if there are so many")
@pytest.mark.parametrize(
    ("photos", "points", "tried"), [(100, 3_000, 3_000), (100, 60_000, 15_000), (5_000, 60_000, 10_000)]
)
def test_points_are_looked_for_in_all_photos(photos: int, points: int, tried: int):
    dataset: Any = range(photos)  # Only their number counts.
    observations = PointObservations(torch.zeros(points, 3), dataset, torch.device("cpu"))
    assert len(observations._candidates) == tried
