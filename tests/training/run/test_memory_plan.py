"""The memory plan of a run, with a device whose memory is made up.

The memory that the driver has left and that torch's allocator keeps unused must hold the new Gaussians (parameter,
gradient, two moments, statistics), a copy of the widest parameter while it is rewritten, and the working memory of the
next step, which is the largest of three phases: tile lists, loss, backward pass. `render/step_memory.py` counts it for
the views, pixels and tile pairs of a step: 114 bytes for each pixel in the loss (300 without our kernels), and
altogether about 1.8 kB a Gaussian of degree 3 at one view a step, 2.3 kB at two and 3.5 kB at four, if each has 12
pairs in a view. Fragmentation of the allocator's unused memory is not counted.

On an H200, with all but 6 or 3 GB taken by another process, a run that would take 8.6 GB warned at each step that it
reduced, went on and ended with a checkpoint; with 1.2 GB it ended at iteration 0 with one sentence.
"""

from __future__ import annotations

import copy
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras

from examples.drawn_scene.scene import write_scene
from helpers.kill_and_resume import configure, set_up
from helpers.refusals import refusal
from sadgs_ns import host
from sadgs_ns.errors import InputError
from sadgs_ns.kernels import triton_switched
from sadgs_ns.method import running_strategy as strategy_module
from sadgs_ns.method.running_strategy import empty_state
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.render import step_memory
from sadgs_ns.render.step_memory import StepSize
from sadgs_ns.training.run.memory_plan import (
    ImageStorage,
    TrainingSize,
    choose_image_storage,
    fit_to_memory,
    image_bytes,
    training_size,
)

DEFAULT = StructureAwareStrategy.max_gaussians
WIDTH = 48
HEIGHT = 36
VIEWS = 10
KEPT = 4 * 4 * 59 + 4 * (3 + 3 + 3 + 1 + 3)
"""Of a Gaussian: parameter, gradient, two moments; three statistics an axis, a count, three of AbsGS."""
WIDEST = 4 * 45


def params(n: int = 10) -> dict[str, torch.nn.Parameter]:
    """As splatfacto's of degree 3: 59 numbers."""
    shapes: dict[str, tuple[int, ...]] = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (1,)}
    shapes |= {"features_dc": (3,), "features_rest": (15, 3)}
    return {name: torch.nn.Parameter(torch.zeros(n, *shape)) for name, shape in shapes.items()}


def each(views: int = 1) -> float:
    """Bytes of one more Gaussian: what it keeps, its widest parameter once more, and the larger of what it takes while
    tile lists are sorted and in the backward pass.
    """
    lists = 16 + views * (52 + 40) + step_memory.PAIRS_PER_GAUSSIAN * views * 40
    backward = 16 + 28 + views * (52 + 84) + step_memory.PAIRS_PER_GAUSSIAN * views * 4
    return KEPT + WIDEST + max(lists, backward)


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch):
    """Sets a card's free and total memory in GB."""

    def set_memory(free: float, total: float) -> None:
        monkeypatch.setattr(step_memory, "available_bytes", lambda device: (1e9 * free, 1e9 * total))

    return set_memory


def fit(
    other: float = 0.0,
    n: int = 10,
    views: int = 1,
    pixels: int = 0,
    budget_gb: float | None = None,
    cap: int = DEFAULT,
):
    """The cap, and what the user is told."""
    size = TrainingSize(other, StepSize(views, pixels))
    with triton_switched(True):  # The loss is computed by our kernels, as on a card.
        return fit_to_memory(cap, params(n), size, budget_gb)  # type: ignore[arg-type]


def test_what_a_gaussian_takes_is_what_a_split_asks_for():
    size = StepSize(views=2, pixels=1000, pairs=5000)
    lists = 10 * (16 + 2 * 92 + WIDEST) + 5000 * 40
    state = empty_state(0, torch.device("cpu"))
    assert step_memory.kept_bytes(params(), state) == KEPT  # type: ignore[arg-type]
    for grown in (0, 1, 7):
        free = lists + grown * each(2)
        with triton_switched(True):
            found = [step_memory.affordable_growth(params(), state, room, size) for room in (free, free - 1)]  # type: ignore[arg-type]
        assert found == [grown, max(grown - 1, 0)]


def test_gains_take_the_colours_once_more_in_each_phase_and_their_gradient_in_the_last():
    cpu = torch.device("cpu")
    plain = step_memory.step_bytes(1000, StepSize(3, 10**6, 10**5), cpu)
    info = {"n_cameras": 3, "width": 1000, "height": 1000, "flatten_ids": torch.zeros(10**5), "has_color_maps": True}
    size = StepSize.of([info])
    assert size == StepSize(3, 3 * 10**6, 10**5, has_color_maps=True)
    gained = step_memory.step_bytes(1000, StepSize(3, 10**6, 10**5, has_color_maps=True), cpu)
    more = {name: gained[name] - plain[name] for name in plain}
    assert more == {"tile lists": 36000, "loss": 36000, "backward": 72000}


def test_each_phase_counts_what_it_grows_with():
    def peak(n: int = 1000, views: int = 1, pixels: int = 10**6, pairs: int = 10**5) -> dict[str, float]:
        return step_memory.step_bytes(n, StepSize(views, pixels, pairs), torch.device("cpu"))

    for name, value in peak().items():
        assert peak(n=2000)[name] > value
    for name, value in peak().items():
        assert peak(views=4)[name] > value
    for name, value in peak().items():
        assert peak(pairs=10**7)[name] > value
    actual = max(peak(pixels=10**7), key=peak(pixels=10**7).__getitem__)
    assert actual == "loss"
    actual = max(peak(pairs=10**8), key=peak(pairs=10**8).__getitem__)
    assert actual == "tile lists"
    actual = max(peak(n=10**7), key=peak(n=10**7).__getitem__)
    assert actual == "backward"


@pytest.mark.hard_case("several views a step", "the memory plan leaves room for fewer Gaussians")
def test_several_views_leave_room_for_fewer_gaussians(card: Any):
    card(5, 6)
    one = fit(views=1, pixels=6_500_000)[0]
    four = fit(views=4, pixels=4 * 6_500_000)[0]
    assert one == int(4e9 // each(1))
    assert four < 0.5 * one
    assert fit(views=4)[0] == int(4e9 // each(4))


@pytest.mark.parametrize("free", [30.0, 80.0, 139.0])
def test_a_large_card_keeps_the_default(free: float, card: Any):
    card(free, 140)
    cap, line = fit(other=1e9)
    assert cap == DEFAULT == 4_000_000
    assert line == f"At most 4,000,000 Gaussians: {1 + 4e-3 * each():.1f} GB of the card's 140.0 GB."


def test_a_small_card_gets_a_cap_that_takes_four_fifths_of_what_is_free(card: Any):
    card(7.5, 8)
    cap, line = fit(other=1e9)
    assert cap == int((0.8 * 7.5e9 - 1e9) // each()) < DEFAULT
    assert 1e9 + cap * each() <= 0.8 * 7.5e9 < 1e9 + (cap + 1) * each()
    assert line == f"At most {cap:,} Gaussians: 6.0 GB of the card's 8.0 GB; 7.5 GB are free."


def test_a_budget_bounds_it_and_never_raises_max_gaussians(card: Any):
    card(139, 140)
    cap, line = fit(other=1e9, budget_gb=4.0)
    assert cap == int(3e9 // each())
    assert line == f"At most {cap:,} Gaussians: 4.0 GB of the card's 140.0 GB; memory_budget_gb is 4."
    assert fit(budget_gb=100.0)[0] == DEFAULT
    assert fit(budget_gb=100.0, cap=1000)[0] == 1000
    assert fit(budget_gb=4.0, cap=1000)[0] == 1000
    assert fit(budget_gb=4.0, cap=3_000_000)[0] == int(4e9 // each())
    card(2, 8)  # more than is free is not there to be taken
    assert fit(budget_gb=4.0)[0] == int(2e9 // each())


def test_a_cap_that_the_user_chose_stays_without_a_budget(card: Any):
    card(2, 8)
    cap, line = fit(cap=1_000_000)
    assert cap == 1_000_000
    assert line.startswith("At most 1,000,000 Gaussians: 1.8 GB of the card's 8.0 GB.")


@pytest.mark.hard_case("a memory budget that leaves no room", "refused in one sentence")
def test_a_full_card_still_starts_and_a_budget_for_nothing_is_refused(card: Any):
    card(0.5, 8)
    cap, line = fit(other=1e9)
    assert cap == 1
    assert line.endswith("which holds no more than the 10 at the start: none will be added.")
    with pytest.raises(InputError) as error:
        fit(other=1e9, budget_gb=0.5)
    assert str(error.value) == (
        "pipeline.memory_budget_gb is 0.5 and leaves no room for Gaussians: images and rendering take 1.0 GB, and 0.5 "
        "GB are free; raise it, take fewer or smaller images, or lower pipeline.views-per-iteration."
    )


def test_a_structure_tensor_that_is_computed_late_has_its_room_beside_the_gaussians(card: Any):
    card(7.5, 8)
    size = TrainingSize(0.0, StepSize(), structure_bytes=3e9)
    cap, *_ = fit_to_memory(DEFAULT, params(), size)  # type: ignore[arg-type]
    assert cap == int((0.8 * 7.5e9 - 3e9) // (KEPT + WIDEST)) < fit()[0]


def test_without_cuda_nothing_changes():
    size = TrainingSize(1e9, StepSize(1, 10**6, 10**6))
    actual = fit_to_memory(DEFAULT, params(), size, 0.1)
    assert actual == (  # type: ignore[arg-type]
        DEFAULT,
        "At most 4,000,000 Gaussians: this device's memory is not planned with, so this is max_gaussians.",
    )


def test_what_is_free_counts_what_this_process_holds_as_its_own(monkeypatch: pytest.MonkeyPatch):
    """So that a resumed run, whose Gaussians are there already, gets the cap that it had."""
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (50, 100))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: 30)
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda device: 10)
    device = torch.device("cuda")
    assert step_memory.available_bytes(device) == (80, 100)
    assert step_memory.free_bytes(device) == 70


# --- the size of a run ---


def cameras(width: int = 64, height: int = 48, focal: float = 60.0, number: int = 1) -> Cameras:
    """Cameras as `scenes.camera`'s, in nerfstudio's axes, one unit apart along the viewing axis."""
    poses = torch.diag(torch.tensor([1.0, -1.0, -1.0]))[None].repeat(number, 1, 1)
    positions = torch.zeros(number, 3, 1)
    positions[:, 2, 0] = -torch.arange(number)
    return Cameras(torch.cat([poses, positions], dim=-1), focal, focal, width / 2, height / 2, width, height)


def test_the_size_of_a_run_is_that_of_its_images_and_largest_step():
    train = cameras(number=3)
    held_out = cameras(100, 10, number=2)
    datamanager: Any = SimpleNamespace(
        config=SimpleNamespace(cache_images="gpu"),
        train_dataset=SimpleNamespace(cameras=train),
        eval_dataset=SimpleNamespace(cameras=held_out),
    )
    size = training_size(datamanager, views=2)
    expected = 3 * (3 * 64 * 48 + 2 * 1000) + 3 * 3 * 64 * 48
    assert size.image_bytes == expected
    assert size.step == StepSize(2, 2 * 64 * 48)
    datamanager.config.cache_images = "cpu"
    size = training_size(datamanager, views=2)
    assert size.image_bytes == 2 * 6 * 64 * 48  # of the next step
    assert size.structure_bytes == 300 * 2 * 64 * 48  # Only images on the device have theirs from the start.
    size = training_size(datamanager, views=2, processes=2)
    assert size.image_bytes == (3 + 2 * 3) * 64 * 48  # Each process has one of the images, and the codes of both.
    assert size.structure_bytes == 300 * 64 * 48
    train.height = torch.tensor([[30], [48], [48]])  # Of two sizes each process may have a part of either.
    assert training_size(datamanager, views=2, processes=2).image_bytes == 2 * 6 * 64 * 48


# --- ns-train ---


def test_ns_train_says_the_cap_at_the_start_and_keeps_it(
    card: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    # The final prune would leave fewer than the cap.
    monkeypatch.setattr(strategy_module, "FINAL_PRUNE_OPACITY", 0.0)
    write_scene(tmp_path / "scene", WIDTH, HEIGHT, VIEWS, points=100)
    config = configure(tmp_path / "scene", tmp_path, iterations=24, save_every=0)
    config.pipeline.model.bounding_box_points = False
    strategy = config.pipeline.model.strategy
    strategy.max_gaussians = DEFAULT
    strategy.clone_grad2d = 0.0
    strategy.refine_start_iter = 1
    strategy.min_opacity = 0.0
    images = VIEWS * WIDTH * HEIGHT * 3 + 8 * WIDTH * HEIGHT * 3
    unbounded = copy.deepcopy(config)
    loss = 300 * WIDTH * HEIGHT  # in torch, since the device is the CPU; no phase takes more for so few Gaussians
    card((images + loss + 120.5 * (KEPT + WIDEST + 16 + 52 + step_memory.PAIRS_PER_GAUSSIAN * 4)) / 0.8e9, 8)
    trainer = set_up(config)
    model = trainer.pipeline.model
    assert model.num_points < 120
    printed = capsys.readouterr().out
    assert "At most 120 Gaussians: 0.0 GB of the card's 8.0 GB; " in printed
    trainer.train()
    assert model.num_points == model.plan.strategy.max_gaussians == 120
    assert config.pipeline.model.strategy.max_gaussians == DEFAULT, "config.yml tells what was asked for"
    card(139, 140)
    trainer = set_up(unbounded)
    assert trainer.pipeline.model.plan.strategy.max_gaussians == DEFAULT


def test_a_budget_for_nothing_ends_ns_train_with_one_sentence(card: Any, tmp_path: Path):
    write_scene(tmp_path / "scene", WIDTH, HEIGHT, VIEWS, points=100)
    config = configure(tmp_path / "scene", tmp_path, iterations=24, save_every=0)
    config.pipeline.memory_budget_gb = 1e-6
    card(8, 8)
    with refusal(r"^pipeline\.memory_budget_gb is 1e-06 and leaves no room"):
        set_up(config)


@pytest.mark.parametrize("number", [600, 500])
def test_images_are_kept_where_there_is_room(number: int, card: Any, monkeypatch: pytest.MonkeyPatch):
    def datamanager(side: int) -> Any:
        def dataset(number: int) -> Any:
            cameras = SimpleNamespace(height=torch.full((number, 1), side), width=torch.tensor(side))
            return type("Dataset", (), {"cameras": cameras, "__len__": lambda _: number})()

        config = SimpleNamespace(cache_images="gpu")
        return SimpleNamespace(config=config, train_dataset=dataset(number), eval_dataset=dataset(100))

    gpu = torch.device("cuda")
    share = 0.25 if number > 500 else 0.5
    small = datamanager(100)
    large = datamanager(10_000)
    size = image_bytes(small)
    assert size == 3 * (number + 100) * 100**2 + 3 * number * 100**2
    monkeypatch.setattr(host, "available_host_bytes", lambda: 1e15)

    card(1.01 * size / share / 1e9, 80)
    assert choose_image_storage(small, gpu) == ImageStorage("gpu")
    card(0.99 * size / share / 1e9, 80)
    storage = choose_image_storage(small, gpu)
    assert storage.where == "cpu", "the caller applies it"
    assert small.config.cache_images == "gpu", "the caller applies it"
    assert storage.sentence.startswith(
        "The images stay in the host's memory and are copied ahead of the steps: decoded images and their structure "
        f"take {size / 1e9:.2g} GB, and the GPU has 0."
    )

    card(80, 80)
    monkeypatch.setattr(host, "available_host_bytes", lambda: 1.99 * image_bytes(large))
    for device, name in ((gpu, "GPU"), (torch.device("cpu"), "host")):
        storage = choose_image_storage(large, device)
        compressed = "The images stay compressed and are decoded ahead of the steps: decoded images and "
        assert storage.where == "compressed"
        assert storage.sentence.startswith(compressed)
        assert f" take {image_bytes(large) / 1e9:.2g} GB, and the {name} has " in storage.sentence
    monkeypatch.setattr(host, "available_host_bytes", lambda: 2.01 * image_bytes(large))
    actual = choose_image_storage(large, torch.device("cpu"))
    assert actual == ImageStorage("gpu")  # the training device


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({}, math.inf),
        ({"proc/meminfo": "MemTotal: 9 kB\nMemAvailable:    2000 kB\n"}, 2048000),
        (
            {"memory.max": "max\n", "memory.current": "1\n", "memory.stat": "inactive_file 1\n"},
            math.inf,
        ),
        (
            {"memory.max": "5000\n", "memory.current": "3000\n", "memory.stat": "anon 7\ninactive_file 400\n"},
            2400,
        ),
        (
            {
                "memory/memory.limit_in_bytes": "5000\n",
                "memory/memory.usage_in_bytes": "3000\n",
                "memory/memory.stat": "inactive_file 9\ntotal_inactive_file 300\n",
            },
            2300,
        ),
    ],
)
def test_the_host_s_memory_is_what_linux_and_a_container_leave(files: dict, expected: float, tmp_path: Path):
    for name, text in files.items():
        path = tmp_path / (name if name.startswith("proc") else f"sys/fs/cgroup/{name}")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    assert host.available_host_bytes(tmp_path) == expected
    assert host.available_host_bytes() > 0
