"""Where images are kept: on the device, decoded on the host, or compressed. Training must not notice the difference."""

from __future__ import annotations

import contextlib
import dataclasses
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from PIL import Image

from helpers.json_files import read_json, write_json
from helpers.kill_and_resume import set_up
from helpers.refusals import refusal
from helpers.short_runs import blender_data, checkpoint, configure, nerfstudio_data, train
from helpers.small_scenes import HEIGHT, VIEWS, WIDTH
from sadgs_ns.cli.inspection import get_view
from sadgs_ns.data.cameras import TRAINING_VIEW
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor
from sadgs_ns.training.config import SadgsDatamanagerConfig
from sadgs_ns.training.datamanager import SadgsDatamanager
from sadgs_ns.training.run.trainer import SadgsTrainer
from sadgs_ns.training.step import structure_cache, undistortion
from sadgs_ns.training.step.images import ImagePrefetcher
from sadgs_ns.training.step.structure_cache import StructureCache, observe_training_views
from sadgs_ns.training.step.views import ViewSampler

COMPRESSED: Any = "compressed"
TIERS = ("gpu", "cpu", COMPRESSED)
ITERATIONS = 12
LENSES = {
    "perspective": {"camera_model": "OPENCV", "k1": 0.1, "k2": -0.02, "p1": 0.003, "p2": -0.002},
    "fisheye": {"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k2": 0.01, "k3": 0.002, "k4": 0.001},
}
nerfstudio_leaves_files_open = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
"""It opens an image with Pillow, which closes the file only where the image can be decoded."""


def distorted(folder: Path, kind: str, masks: bool) -> DataParserConfig:
    """A dataset in which all views but the first have a lens, and one of them another one."""
    parser = nerfstudio_data(folder, masks=masks)
    path = folder / "transforms.json"
    meta = read_json(path)
    lens = dict(LENSES[kind])
    meta["camera_model"] = lens.pop("camera_model")
    for index, frame in enumerate(meta["frames"]):
        if kind == "fisheye" or index > 0:
            frame.update({name: value * (2 if index == 4 else 1) for name, value in lens.items()})
    write_json(path, meta)
    return parser


def jpegs(folder: Path) -> DataParserConfig:
    """A dataset of JPEGs of many kinds: grey, progressive, turned by a tag, with colours sampled in all usual ways."""
    exif = Image.Exif()
    exif[0x0112] = 6  # The camera was turned by a quarter.
    kinds: list[dict[str, Any]] = [{"subsampling": kind} for kind in ("4:2:0", "4:2:2", "4:4:4")]
    kinds += [{"progressive": True}, {"exif": exif}, {"quality": 30}, {"quality": 100}, {"keep_rgb": True}]
    parser = nerfstudio_data(folder)
    path = folder / "transforms.json"
    meta = read_json(path)
    for index, frame in enumerate(meta["frames"]):
        with Image.open(folder / frame["file_path"]) as image:
            frame["file_path"] = frame["file_path"].replace(".png", ".jpg")
            kind = {"quality": 80, **kinds[index % len(kinds)]}
            image.convert("L" if index == 9 else "RGB").save(folder / frame["file_path"], **kind)
    write_json(path, meta)
    return parser


DATA: dict[str, Callable[[Path], DataParserConfig]] = {
    "plain": nerfstudio_data,
    "jpeg": jpegs,
    "masks and sizes": lambda folder: nerfstudio_data(folder, [(WIDTH, HEIGHT), (40, 30)], masks=True),
    "alpha": lambda folder: nerfstudio_data(folder, alpha=True),
    "alpha on white": lambda folder: blender_data(folder, "white"),
    "perspective": lambda folder: distorted(folder, "perspective", masks=False),
    "perspective with masks": lambda folder: distorted(folder, "perspective", masks=True),
    "fisheye with masks": lambda folder: distorted(folder, "fisheye", masks=True),
}


def datamanager_of(parser: DataParserConfig, cls: Any = SadgsDatamanagerConfig, **options: Any) -> Any:
    return cls(dataparser=parser, **options).setup(device="cpu")


def assert_same_images(images: Any, expected: Any, difference: int = 0) -> None:
    """Check that data agree to the bit, but images may have a difference in levels."""
    assert len(images) == len(expected)
    for data, other in zip(images, expected, strict=True):
        assert data.keys() == other.keys()
        assert data["image_idx"] == other["image_idx"]
        for name in data.keys() - {"image_idx"}:
            assert data[name].dtype == other[name].dtype
            assert data[name].shape == other[name].shape
            if name == "image":
                assert (data[name].int() - other[name].int()).abs().max() <= difference
            else:
                assert torch.equal(data[name], other[name])
            assert data[name].is_contiguous()


def assert_same_cameras(cameras: Any, expected: Any) -> None:
    for field in dataclasses.fields(cameras):
        value = getattr(cameras, field.name)
        other = getattr(expected, field.name)
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, other)
        else:  # Ours also know which training views they are.
            others = {name: known for name, known in (value or {}).items() if name != TRAINING_VIEW}
            assert others == (other or {})


def warp_bilinearly(image: Any, warp: undistortion.Warp) -> Any:
    return cv2.remap(image, warp.x, warp.y, cv2.INTER_LINEAR)


@pytest.mark.hard_case(
    "masks in which black is 16 and white 235, or 16 bits, or with a JPEG's noise", "what is below half is hidden"
)
@pytest.mark.parametrize(("mode", "black", "white"), [("L", 16, 235), ("L", 0, 1), ("I;16", 4096, 60160), ("1", 0, 1)])
@pytest.mark.parametrize("kind", ["perspective", None])
def test_the_darker_half_of_a_mask_s_values_is_hidden(
    kind: str | None, mode: str, black: int, white: int, tmp_path: Path
):
    if kind is None:
        parser = nerfstudio_data(tmp_path, masks=True)
    else:
        parser = distorted(tmp_path, kind, masks=True)
    expected = [data["mask"] for data in datamanager_of(parser, cache_images=COMPRESSED).cached_train]
    for path in tmp_path.glob("images/mask_*"):
        values = np.where(np.asarray(Image.open(path)) > 0, white, black)
        if mode == "1":
            Image.fromarray(values > 0).save(path)
        else:
            Image.fromarray(values.astype(np.uint16 if mode == "I;16" else np.uint8)).save(path)
    found = [data["mask"] for data in datamanager_of(parser, cache_images=COMPRESSED).cached_train]
    for pair in zip(found, expected, strict=True):
        assert torch.equal(*pair)
    for mask in expected:
        assert 0 < mask.float().mean() < 1


def test_hidden_pixels_get_the_parser_s_colour(tmp_path: Path):
    parser = nerfstudio_data(tmp_path, masks=True)
    parser.mask_color = (1.0, 0.0, 0.0)
    for data in datamanager_of(parser, cache_images=COMPRESSED).cached_train:
        hidden = data["image"][~data["mask"][..., 0]]
        assert (hidden == torch.tensor([1, 0, 0])).all()
        assert len(hidden) > 0
        assert data["image"][data["mask"][..., 0]].float().std() > 1


@pytest.mark.hard_case("`--mask-color` without masks", "trains; a warning says that it does nothing")
def test_a_colour_for_what_masks_hide_is_of_no_use_without_masks(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    said = "--mask-color does nothing, because the capture has no masks: leave it out, or name them."
    for masks in (True, False):
        parser = nerfstudio_data(tmp_path / str(masks), masks=masks)
        parser.mask_color = (1.0, 0.0, 0.0)
        set_up(configure(tmp_path / "run", parser))
        printed = capsys.readouterr().out
        assert (said in printed) == (not masks)


@pytest.mark.parametrize("options", [{}, {"camera_res_scale_factor": 0.5}], ids=str)
@pytest.mark.parametrize("tier", TIERS)
@pytest.mark.parametrize("data", DATA)
def test_images_and_cameras_are_nerfstudio_s_to_the_bit(
    data: str, tier: Any, options: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Distorted images are compared as nerfstudio interpolates them: between 1/32 of a pixel, and up to the border."""
    parser = DATA[data](tmp_path)
    difference = 0
    if data.startswith(("perspective", "fisheye")):
        difference = 3
        monkeypatch.setattr(undistortion, "apply_warp", warp_bilinearly)
    in_bytes: dict[str, Any] = {"cache_images": "gpu", "cache_images_type": "uint8"}
    expected: FullImageDatamanager = datamanager_of(parser, FullImageDatamanagerConfig, **in_bytes, **options)
    datamanager = datamanager_of(parser, cache_images=tier, **options)
    assert datamanager.config.cache_images == tier
    for _ in range(2):  # Decoding an image again gives the same image.
        assert_same_images(datamanager.cached_train, expected.cached_train, difference)
        assert_same_images(datamanager.cached_eval, expected.cached_eval, difference)
        assert_same_cameras(datamanager.train_dataset.cameras, expected.train_dataset.cameras)
        assert_same_cameras(datamanager.eval_dataset.cameras, expected.eval_dataset.cameras)
    assert_same_cameras(datamanager.train_cameras, expected.train_cameras)
    assert datamanager.get_train_rays_per_batch() == expected.get_train_rays_per_batch()
    views = datamanager.fixed_indices_eval_dataloader
    expected_views = expected.fixed_indices_eval_dataloader
    assert_same_images([view for _, view in views], [view for _, view in expected_views], difference)
    for (camera, _), (other, _) in zip(views, expected_views, strict=True):
        assert_same_cameras(camera, other)
    _, view = datamanager.next_train(0)  # This is what other methods' pipelines ask for.
    assert_same_images([view], [expected.next_train(0)[1]], difference)


@pytest.mark.parametrize("agrees", [True, False])
def test_jpegs_are_decoded_by_opencv_only_if_it_agrees_with_pillow(
    agrees: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    parser = jpegs(tmp_path)
    expected = datamanager_of(parser, FullImageDatamanagerConfig, cache_images="gpu", cache_images_type="uint8")
    assert len(expected.cached_train) == VIEWS - 1
    by_pillow: list[int] = []
    decode = cv2.imdecode
    read = InputDataset.get_numpy_image
    monkeypatch.setattr(cv2, "imdecode", lambda *args: decode(*args) + (0 if agrees else 1))
    monkeypatch.setattr(
        InputDataset, "get_numpy_image", lambda dataset, index: by_pillow.append(index) or read(dataset, index)
    )
    datamanager = datamanager_of(parser, cache_images=COMPRESSED)
    assert_same_images(list(datamanager.cached_train), expected.cached_train)
    assert_same_images(list(datamanager.cached_train), expected.cached_train)
    assert by_pillow == ([0] if agrees else 2 * list(range(VIEWS - 1)))


@nerfstudio_leaves_files_open
def test_a_file_that_breaks_later_is_named(tmp_path: Path):
    read = datamanager_of(nerfstudio_data(tmp_path, masks=True), cache_images="compressed")
    assert len(list(read.cached_train)) == len(read.train_dataset)
    path = read.train_dataset.image_filenames[2]
    path.write_bytes(path.read_bytes()[:300])
    sentence = rf"^{path} or its mask cannot be read as an image \(.+\): copy it again, or leave it out of .*\.$"
    with refusal(sentence):
        _ = read.cached_train[2]


@pytest.mark.parametrize("tier", TIERS)
def test_a_file_that_changed_its_size_is_named(tier: Any, tmp_path: Path):
    datamanager = datamanager_of(nerfstudio_data(tmp_path), cache_images=tier)
    path = datamanager.train_dataset.image_filenames[2]
    Image.fromarray(np.zeros((10, 20, 3), np.uint8)).save(path)
    with refusal(rf"^{path} has 20 × 10 px, but its camera {WIDTH} × {HEIGHT}: use "):
        list(datamanager.cached_train)


# --- training ---


def run(parser: DataParserConfig, tier: Any, folder: Path, **options: Any) -> tuple[SadgsTrainer, list[Any]]:
    """Train on the CPU, and return the trainer with the sums of all parameters after each step."""
    config = configure(folder, parser, ITERATIONS, **{"eta_every": 2, **options})
    config.machine.device_type = "cpu"
    config.pipeline.views_per_iteration = 3
    config.pipeline.datamanager.cache_images = tier
    steps = []

    def note(trainer: SadgsTrainer) -> None:
        steps.append([(name, value.sum().item()) for name, value in trainer.pipeline.model.gauss_params.items()])

    return train(config, note), steps


@pytest.mark.parametrize("data", ["masks and sizes", "alpha"])
def test_training_is_the_same_bit_for_bit_wherever_images_are_kept(data: str, tmp_path: Path):
    states = []
    sums = []
    seen = []
    for tier in TIERS:
        trainer, steps = run(DATA[data](tmp_path / f"data {tier}"), tier, tmp_path / tier)
        assert isinstance(trainer.pipeline.datamanager.cached_train, list) is (tier != "compressed")
        assert (trainer.pipeline.views.prefetcher is None) is (tier == "gpu")
        states.append(checkpoint(trainer, ITERATIONS - 1)["pipeline"])
        sums.append(steps)
        view = get_view(trainer.pipeline, 1)  # as sadgs-inspect and the viewer's panel ask for it
        observed = observe_training_views(trainer.pipeline.structure_cache)
        seen.append([view.photo, view.structure_tensor.nan_to_num(-1), view.camera[1], *observed.values()])
    for tensors in zip(*seen, strict=True):
        for tensor in tensors:
            assert torch.equal(tensor, tensors[0])
    assert sums[0] == sums[1] == sums[2]
    expected = states[0]
    for state in states[1:]:
        for name in expected:
            if isinstance(expected[name], torch.Tensor):
                assert torch.equal(state[name], expected[name]), name
        assert torch.equal(state["_extra_state"]["torch"], expected["_extra_state"]["torch"])
        actual = views_to_come(state["_extra_state"]["views"])
        assert actual == views_to_come(expected["_extra_state"]["views"])


def views_to_come(state: dict[str, Any]) -> list[int]:
    """The order of many views; where images travel, more rounds of it have been shuffled already."""
    sampler = ViewSampler(state["num_views"], 0)
    sampler.load_state_dict(state)
    return sampler.draw(10 * sampler.num_views)


def image_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith("images")]


def test_threads_decode_ahead_and_end_with_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    seen: list[int] = []
    late: list[int] = []
    take = ImagePrefetcher.take
    copy = ImagePrefetcher._copy

    def noted_take(prefetcher: ImagePrefetcher, indices: list[int]) -> Any:
        late.extend(index for index in indices if index not in prefetcher._loading | prefetcher._sent)
        return take(prefetcher, indices)

    def noted_copy(prefetcher: ImagePrefetcher, index: int) -> Any:
        seen.append(len(image_threads()))
        assert len(prefetcher._loading) + len(prefetcher._sent) <= prefetcher.threads + 3 * 3
        return copy(prefetcher, index)

    monkeypatch.setattr(ImagePrefetcher, "take", noted_take)
    monkeypatch.setattr(ImagePrefetcher, "_copy", noted_copy)
    run(nerfstudio_data(tmp_path / "data"), "compressed", tmp_path)
    assert len(late) == 3, "The first step's images alone are late."
    assert min(seen) >= 1, "The first step's images alone are late."
    assert image_threads() == []


def test_an_image_that_breaks_during_the_run_ends_it_in_one_sentence(tmp_path: Path):
    parser = nerfstudio_data(tmp_path / "data")
    config = configure(tmp_path, parser, ITERATIONS)
    config.pipeline.datamanager.cache_images = COMPRESSED
    config.steps_per_save = 2

    def remove(trainer: SadgsTrainer) -> None:
        if trainer.step == 5:
            for path in trainer.pipeline.datamanager.train_dataset.image_filenames:
                path.unlink()

    sentence = (
        r"^\S+\.png cannot be read as an image \(No such file or directory\): copy it again, or leave it out of the "
        r"reconstruction; what the last checkpoint holds goes on with --load-dir \S+\.$"
    )
    with refusal(sentence):
        train(config, remove)
    assert image_threads() == []
    (saved,) = (tmp_path / "test/sadgs/run/nerfstudio_models").glob("*.ckpt")
    assert int(saved.stem.removeprefix("step-")) >= 4


@nerfstudio_leaves_files_open
def test_an_image_that_is_broken_at_the_start_ends_the_run_in_one_sentence(tmp_path: Path):
    parser = nerfstudio_data(tmp_path / "data")
    config = configure(tmp_path, parser, ITERATIONS)
    config.pipeline.datamanager.cache_images = COMPRESSED

    class Breaking(SadgsDatamanager):
        """It is broken after the checks, as a file is whose damage Pillow finds only where it decodes."""

        def _load_images(self, split: Any, cache_images_device: Any) -> Any:
            for path in self.train_dataset.image_filenames:
                path.write_bytes(path.read_bytes()[:300])
            return super()._load_images(split, cache_images_device)

    config.pipeline.datamanager._target = Breaking
    with refusal(r"^\S+\.png cannot be read as an image \(.+\): copy it again, or leave it "):
        train(config)
    assert image_threads() == []


def test_s_is_computed_once_beside_decoded_images_and_anew_beside_compressed_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    number: list[int] = []
    compute = StructureCache.quantized
    monkeypatch.setattr(
        StructureCache, "quantized", lambda cache, data: number.append(len(data)) or compute(cache, data)
    )
    counts = {}
    for tier in TIERS:
        number.clear()
        trainer, _ = run(nerfstudio_data(tmp_path / f"data {tier}"), tier, tmp_path / tier, eta_every=1)
        counts[tier] = sum(number)
        observed = 3 * sum(trainer.pipeline.model.strategy.observes(step) for step in range(ITERATIONS))
    training = VIEWS - 1  # The parser holds out one view of ten.
    assert counts["gpu"] == counts["cpu"] == training < counts["compressed"] == observed


def test_images_in_bytes_are_not_searched_for_nan_because_the_host_would_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    known: list[bool] = []
    compute = multiscale_structure_tensor

    def noted(*args: Any, known_finite: bool = False, **options: Any) -> Any:
        known.append(known_finite)
        with monkeypatch.context() as patch:
            patch.setattr(torch.Tensor, "isfinite", None)  # Asking for it is an error.
            return compute(*args, known_finite=known_finite, **options)

    monkeypatch.setattr(structure_cache, "multiscale_structure_tensor", noted)
    run(nerfstudio_data(tmp_path / "data", masks=True), COMPRESSED, tmp_path)
    assert known
    assert all(known)


# --- CUDA's streams, without CUDA ---


class Stream:
    """A stream of CUDA's, as far as the order of its work goes."""

    def __init__(self, name: str, log: list[str]) -> None:
        self.name = name
        self.log = log

    def wait_event(self, event: Event) -> None:
        self.log.append(f"{self.name} waits for {event.name}")


class Event:
    """An event of CUDA's, named by what its stream did last."""

    def record(self, stream: Stream) -> None:
        self.name = stream.log[-1]


class Pixels(torch.Tensor):
    """A tensor that notes where it is copied and which stream uses it."""

    label: str
    log: list[str]
    pinned: bool
    is_cuda = False

    @classmethod
    def of(cls, name: str, log: list[str], pinned: bool) -> Pixels:
        pixels = torch.zeros((2, 2, 3), dtype=torch.uint8).as_subclass(cls)
        pixels.label = name
        pixels.log = log
        pixels.pinned = pinned
        return pixels

    def is_pinned(self) -> bool:
        return self.pinned

    def pin_memory(self) -> Pixels:  # type: ignore[override]
        return Pixels.of(self.label, self.log, pinned=True)

    def to(self, device: torch.device, non_blocking: bool) -> Pixels:  # type: ignore[override]
        assert self.pinned, "another copy would make the host wait"
        assert non_blocking, "another copy would make the host wait"
        self.log.append(f"{self.label} is copied")
        copied = Pixels.of(self.label, self.log, pinned=False)
        copied.is_cuda = True
        return copied

    def record_stream(self, stream: Stream) -> None:  # type: ignore[override]
        self.log.append(f"{stream.name} uses {self.label}")


@pytest.mark.parametrize("kind", ["pinned", "pageable", "compressed"])
def test_a_step_waits_for_the_copies_of_its_own_images_alone_and_the_host_for_none(
    kind: str, monkeypatch: pytest.MonkeyPatch
):
    log: list[str] = []
    copies = Stream("copying", log)
    training = Stream("training", log)
    devices: list[Any] = []
    monkeypatch.setattr(torch.cuda, "Stream", lambda device: copies)
    monkeypatch.setattr(torch.cuda, "Event", Event)
    monkeypatch.setattr(torch.cuda, "stream", contextlib.nullcontext)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: training)
    monkeypatch.setattr(torch.cuda, "set_device", devices.append)
    pin = ImagePrefetcher._pinned
    wanted = threading.Event()
    monkeypatch.setattr(
        ImagePrefetcher, "_pinned", lambda prefetcher, index: (index < 2 or wanted.wait()) and pin(prefetcher, index)
    )
    images: Any = [{"image": Pixels.of(f"image {index}", log, kind == "pinned")} for index in range(3)]
    device = torch.device("cuda", 0)
    prefetcher = ImagePrefetcher(images if kind != "compressed" else tuple(images), device, threads=1)
    data = prefetcher.take([0])
    assert data[0]["image"].is_cuda
    steps = ["image 0 is copied", "training waits for image 0 is copied", "training uses image 0"]
    assert log == steps
    prefetcher.prefetch([1], following=[])
    if kind != "pinned":
        prefetcher._loading[1].result()
    prefetcher.prefetch([1, 2], following=[1, 2])  # No thread has loaded image 2.
    steps += ["image 1 is copied"] + ["image 2 is copied"] * (kind == "pinned")
    assert log == steps
    prefetcher.take([1])
    assert log == [*steps, "training waits for image 1 is copied", "training uses image 1"]
    assert devices == ([device] if kind != "pinned" else [])  # A thread of its own would pin for the first GPU.
    wanted.set()
    prefetcher.close()
