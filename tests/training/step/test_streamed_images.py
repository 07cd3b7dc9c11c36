"""Images that are not on the device, in several processes: each decodes and keeps what it composites, not more."""

from __future__ import annotations

import errno
import os
import signal
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from helpers.gloo_ranks import run_ranks
from helpers.sharded_training import STRUCTURE_EVERY, few_steps, record, set_up_together
from helpers.short_runs import nerfstudio_data
from helpers.small_scenes import HEIGHT, POINTS, VIEWS, WIDTH
from sadgs_ns import host
from sadgs_ns.distributed.world import World
from sadgs_ns.errors import InputError, RunError
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.run.memory_plan import ImageStorage, choose_image_storage, image_bytes
from sadgs_ns.training.step.images import ImagePrefetcher, LazyImages, thread_count
from sadgs_ns.training.step.structure_cache import StructureCache
from sadgs_ns.training.step.views import TrainingViews

TRAINING = VIEWS - 1
"""Number of views that the parser does not hold out."""


def configured(folder: Path, parser: Any, tier: Any, views: int) -> SadgsTrainerConfig:
    config = few_steps(parser.data, folder, views)
    config.pipeline.datamanager.dataparser = parser
    config.pipeline.datamanager.cache_images = tier
    config.pipeline.datamanager.max_thread_workers = 2
    config.pipeline.model.num_random = POINTS
    return config


def record_images(world: World, config: SadgsTrainerConfig) -> dict[str, Any]:
    """Train, and note the views of each step, which of them came with an image, and what was decoded and computed."""
    patch = pytest.MonkeyPatch()
    steps: list[list[int]] = []
    own: list[list[int]] = []
    decoded: list[int] = []
    computed: list[int] = []
    under_way: list[int] = []
    draw = TrainingViews.draw
    decode = LazyImages.__getitem__
    quantized = StructureCache.quantized
    close = ImagePrefetcher.close

    def noted_draw(views: TrainingViews, *args: Any, **options: Any) -> Any:
        drawn = draw(views, *args, **options)
        steps.append([index for index, _ in drawn])
        own.append([index for index, data in drawn if "image" in data])
        return drawn

    def noted_close(ahead: ImagePrefetcher) -> None:
        under_way.extend([*ahead._loading, *ahead._sent])
        close(ahead)

    patch.setattr(TrainingViews, "draw", noted_draw)
    patch.setattr(LazyImages, "__getitem__", lambda images, i: decoded.append(i) or decode(images, i))
    patch.setattr(StructureCache, "quantized", lambda cache, data: computed.append(len(data)) or quantized(cache, data))
    patch.setattr(ImagePrefetcher, "close", noted_close)
    trainer = set_up_together(world, config)
    result = record(trainer)
    parameters = {name: value.detach() for name, value in trainer.pipeline.model.gauss_params.items()}
    return result | {
        "steps": steps, "own": own, "decoded": decoded, "computed": sum(computed), "under way": under_way,
        "parameters": parameters,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("ranks", "views", "sizes"),
    [
        (2, 2, [(WIDTH, HEIGHT)]),
        pytest.param(2, 3, [(WIDTH, HEIGHT), (40, 30)], marks=pytest.mark.slow),
        pytest.param(3, 1, [(WIDTH, 64)], marks=pytest.mark.slow),
    ],
)
def test_processes_that_decode_what_they_composite_train_as_if_each_had_all_images(
    ranks: int, views: int, sizes: list[tuple[int, int]], tmp_path: Path
):
    parser = nerfstudio_data(tmp_path / "data", sizes, masks=True)
    of_tier = {}
    for tier in ("gpu", "cpu", "compressed"):
        config = configured(tmp_path / tier, parser, tier, views)
        of_tier[tier] = run_ranks(record_images, ranks, tmp_path / f"meet {tier}", config)
    for results in of_tier.values():
        for result, expected in zip(results, of_tier["gpu"], strict=True):
            assert result["losses"] == expected["losses"]
            assert result["steps"] == expected["steps"]
            for name, value in expected["parameters"].items():
                assert torch.equal(result["parameters"][name], value), name
    visits = views * STRUCTURE_EVERY  # Every step up to the structure step observes η.
    computed = {}
    for tier, results in of_tier.items():
        computed[tier] = sum(result["computed"] for result in results)
    drawn: set[int] = set()
    for step in of_tier["cpu"][0]["steps"][:STRUCTURE_EVERY]:
        drawn.update(step)
    assert computed["gpu"] == ranks * TRAINING, "all have all images and compute S̄ of all"
    assert computed["cpu"] == len(drawn)
    assert computed["compressed"] == visits
    for result in of_tier["compressed"]:
        needed = Counter(index for step in result["own"] for index in step)
        decoded = Counter(result["decoded"])
        assert needed <= decoded
        assert decoded - needed <= Counter(result["under way"])  # Those are of steps after the last one.
        assert len(result["under way"]) <= 2 + 2 * views
    own = [result["own"] for result in of_tier["compressed"]]
    for step, *parts in zip(of_tier["compressed"][0]["steps"], *own, strict=True):
        actual = {index for part in parts for index in part}
        assert actual == set(step)
        if views == ranks:
            actual = [len(part) for part in parts]
            assert actual == [1] * ranks


def train_until_an_image_is_lost(world: World, config: SadgsTrainerConfig, folder: Path) -> tuple[str, int]:
    """Train, while the last process cannot read images any more after three steps; by which error each ends."""
    trainer = set_up_together(world, config)
    iterate = trainer.train_iteration
    last = world.rank == world.num_ranks - 1

    def fail(*args: Any, **options: Any) -> Any:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))

    def breaking(step: int) -> Any:
        if step == 3 and last:
            trainer.pipeline.views.close()  # It forgets what is decoded already.
            images: Any = trainer.pipeline.datamanager.cached_train
            images._dataset.get_data = fail
        return iterate(step)

    trainer.train_iteration = breaking  # type: ignore[method-assign]
    with pytest.raises(InputError if last else RunError) as error:
        trainer.train()
    if last:
        (folder / "sentence").write_text(str(error.value), "utf8")
        os.kill(os.getpid(), signal.SIGKILL)  # It ends, as ns-train does, before the other processes do.
    return str(error.value), len(list(trainer.checkpoint_dir.glob("*.ckpt")))


@pytest.mark.hard_case(
    "an image that one of several processes cannot read any more",
    "it ends with the image's name, the others say that one ended; the run resumes from the last checkpoint",
)
def test_an_image_that_one_process_cannot_read_any_more_ends_all(tmp_path: Path):
    config = configured(tmp_path / "runs", nerfstudio_data(tmp_path / "data"), "compressed", 2)
    config.steps_per_save = 2
    (message, checkpoints), _ = run_ranks(
        train_until_an_image_is_lost, 2, tmp_path / "meet", config, tmp_path, doomed=(1,)
    )
    assert message.startswith("Another process of the run ended")
    assert checkpoints == 1
    sentence = (tmp_path / "sentence").read_text("utf8")
    assert ".png cannot be read as an image (No such file or directory): copy it again" in sentence


# --- the host's memory ---


def sizes_of(number: int, side: int) -> Any:
    """What `choose_image_storage` reads of a datamanager with square images."""
    cameras = SimpleNamespace(height=torch.full((number, 1), side), width=torch.full((number, 1), side))
    dataset = type("Dataset", (), {"cameras": cameras, "__len__": lambda _: number})()
    return SimpleNamespace(
        config=SimpleNamespace(cache_images="gpu"),
        train_dataset=dataset,
        eval_dataset=dataset,
    )


def place_together(world: World, asked: str) -> tuple[str, str]:
    """Place images where the host has room for those of one process, and the last finds less of it than the others."""
    datamanager = sizes_of(10, 100)
    datamanager.config.cache_images = asked
    free = 4.1 * image_bytes(datamanager) if world.rank == 0 else 3.9 * image_bytes(datamanager)
    pytest.MonkeyPatch().setattr(host, "available_host_bytes", lambda: free)
    storage = choose_image_storage(datamanager, torch.device("cpu"))
    return storage.where, storage.sentence


@pytest.mark.hard_case(
    "`cache_images cpu` with several processes, for all of which the host has no room; processes that find "
    "different memory",
    "one line; the images stay compressed, in all of them",
)
@pytest.mark.parametrize("asked", ["gpu", "cpu"])
def test_processes_that_find_different_memory_place_their_images_alike(asked: str, tmp_path: Path):
    (first, line), (second, same_line) = run_ranks(place_together, 2, tmp_path, asked)
    assert first == second == "compressed"
    assert line == same_line
    assert line.startswith("The images stay compressed and are decoded ahead of the steps: decoded ")
    of_each = "structure take 0.0009 GB in each process, and the host has 0.0018 GB free for each."
    assert asked == "gpu" or line.endswith(of_each)


def test_decoded_images_stay_on_the_host_where_all_processes_have_room(monkeypatch: pytest.MonkeyPatch):
    datamanager = sizes_of(10, 100)
    datamanager.config.cache_images = "cpu"
    monkeypatch.setattr(host, "available_host_bytes", lambda: 4.1 * image_bytes(datamanager))
    monkeypatch.setenv("WORLD_SIZE", "2")
    actual = choose_image_storage(datamanager, torch.device("cpu"))
    assert actual == ImageStorage("cpu")
    monkeypatch.setattr(host, "available_host_bytes", lambda: 0.0)
    monkeypatch.setenv("WORLD_SIZE", "1")  # One process keeps them where it is told to.
    actual = choose_image_storage(datamanager, torch.device("cpu"))
    assert actual == ImageStorage("cpu")


def test_processes_of_a_machine_share_the_cores(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(12))
    assert thread_count(None) == 12
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    assert thread_count(None) == 6
    assert thread_count(3) == 3
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "16")
    assert thread_count(None) == 1
