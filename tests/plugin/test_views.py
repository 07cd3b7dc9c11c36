"""Which views the steps of a run take: no view twice in a step, and all equally often."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig

from sadgs_ns.distributed.world import World
from sadgs_ns.method.schedule import Schedule
from sadgs_ns.plugin.images import ImagesAhead
from sadgs_ns.plugin.pipeline import SadgsPipeline
from sadgs_ns.plugin.views import TrainingViews

STEPS = 1000


class Datamanager:
    """nerfstudio's order of `total` views, without its images."""

    def __init__(self, total: int, **options: Any) -> None:
        self.config = FullImageDatamanagerConfig(**options)
        heights = torch.tensor([48, 30, 48, 16]).repeat(total)[:total, None]
        cameras = SimpleNamespace(
            camera_to_worlds=torch.rand((total, 3, 4), generator=torch.manual_seed(0)), height=heights, width=heights
        )
        self.cached_train = [{"image": torch.zeros(1, 1, 3)} for _ in range(total)]
        files = [Path(f"{index}.png") for index in range(total)]
        self.train_dataset: Any = type(
            "Dataset", (), {"cameras": cameras, "image_filenames": files, "__len__": lambda _: total}
        )()
        self.train_unseen_cameras = self.sample_train_cameras()

    sample_train_cameras = FullImageDatamanager.sample_train_cameras


def views_of(datamanager: Any, world: Any = None) -> TrainingViews:
    views = TrainingViews(datamanager, SimpleNamespace(device=torch.device("cpu")))  # type: ignore[arg-type]
    views.world = world or views.world
    return views


def steps_of(views: TrainingViews, number: int, steps: int = STEPS) -> list[list[int]]:
    return [[index for index, _ in views.draw(number)] for _ in range(steps)]


@pytest.mark.hard_case(
    "a round of views that ends inside a step of several", "no view twice in a step, all equally often"
)
@pytest.mark.parametrize(("total", "number"), [(10, 4), (5, 4), (4, 4), (7, 3), (10, 1)])
def test_no_view_comes_twice_in_a_step_and_all_come_equally_often(total: int, number: int):
    views = views_of(Datamanager(total))
    visits: Counter[int] = Counter()
    for drawn in steps_of(views, number):
        assert len(set(drawn)) == number
        visits.update(drawn)
        counts = [visits[index] for index in range(total)]
        assert max(counts) - min(counts) <= 1


@pytest.mark.parametrize(("total", "number"), [(60, 4), (10, 3), (5, 4)])
def test_images_that_are_decoded_ahead_change_no_order_and_are_awaited_once(total: int, number: int):
    options = {"max_thread_workers": 2}
    expected = steps_of(views_of(Datamanager(total, **options)), number, steps=100)
    datamanager = Datamanager(total, cache_images="cpu", **options)
    datamanager.cached_train = tuple(datamanager.cached_train)  # type: ignore[assignment]
    views = views_of(datamanager)
    awaited = 0
    for step in expected:
        assert views.ahead is not None
        known = views.ahead._loading.keys() | views.ahead._sent.keys()
        drawn = [index for index, _ in views.draw(number)]
        assert drawn == step
        awaited += not known.issuperset(drawn)
        assert len(views.ahead._loading) + len(views.ahead._sent) <= 2 + 2 * number
    assert awaited == 1
    views.close()


@pytest.mark.parametrize(("total", "number", "ranks"), [(60, 4, 2), (60, 4, 3), (10, 3, 2), (5, 4, 8)])
def test_each_process_prepares_what_it_composites_and_nothing_else(
    total: int, number: int, ranks: int, monkeypatch: pytest.MonkeyPatch
):
    options = {"max_thread_workers": 2}
    expected = steps_of(views_of(Datamanager(total, **options)), number, steps=100)
    loaded: list[int] = []
    load = ImagesAhead._load
    monkeypatch.setattr(ImagesAhead, "_load", lambda ahead, index: loaded.append(index) or load(ahead, index))
    composited: list[set[int]] = [set() for _ in expected]
    for rank in range(ranks):
        datamanager = Datamanager(total, cache_images="cpu", **options)
        datamanager.cached_train = tuple(datamanager.cached_train)  # type: ignore[assignment]
        world = World()
        world.rank, world.num_ranks = rank, ranks
        views = views_of(datamanager, world)
        loaded.clear()
        awaited, taken = 0, Counter[int]()
        assert views.ahead is not None
        for step, of_all in zip(expected, composited, strict=True):
            known = views.ahead._loading.keys() | views.ahead._sent.keys()
            drawn = views.draw(number)
            assert [index for index, _ in drawn] == step
            own = {index for index, data in drawn if "image" in data}
            taken.update(own)
            of_all |= own
            awaited += not known.issuperset(own)
        under_way = Counter(views.ahead._loading.keys() | views.ahead._sent.keys())
        assert under_way.total() <= 2 + 2 * number
        views.close()
        assert taken <= Counter(loaded) <= taken + under_way
        assert awaited <= 1
    assert composited == [set(step) for step in expected]


@pytest.mark.parametrize(("total", "number"), [(10, 5), (10, 1), (4, 4)])
def test_the_order_is_nerfstudio_s_where_rounds_end_with_steps(total: int, number: int):
    drawn = steps_of(views_of(Datamanager(total)), number, steps=20)
    order: list[int] = []
    nerfstudio = Datamanager(total)
    while len(order) < 20 * number:
        order += nerfstudio.train_unseen_cameras
        nerfstudio.train_unseen_cameras = nerfstudio.sample_train_cameras()
    assert [index for step in drawn for index in step] == order[: 20 * number]


def test_a_view_that_is_passed_over_comes_first_in_the_next_step():
    datamanager = Datamanager(4)
    datamanager.train_unseen_cameras = [2, 3]
    datamanager.sample_train_cameras = lambda: [3, 0, 2, 1]  # type: ignore[method-assign]
    assert steps_of(views_of(datamanager), 3, steps=2) == [[2, 3, 0], [3, 2, 1]]


@pytest.mark.parametrize(("total", "number"), [(10, 4), (5, 4), (10, 1)])
def test_views_that_are_put_back_come_next_and_all_count_equally_often(total: int, number: int):
    """Every seventh step fails, which is found out only when two more steps have been drawn."""
    views = views_of(Datamanager(total))
    visits: Counter[int] = Counter()
    lost: dict[int, list[int]] = {}
    for step in range(STEPS):
        views.put_back(back := lost.pop(step - 3, []))
        drawn = [index for index, _ in views.draw(number)]
        assert len(set(drawn)) == number and set(drawn) >= set(back)
        if step % 7 == 0:
            lost[step] = drawn
        else:
            visits.update(drawn)
        missing = Counter(index for indices in lost.values() for index in indices)
        counts = [visits[index] + missing[index] for index in range(total)]
        assert max(counts) - min(counts) <= 1


@pytest.mark.hard_case(
    "a run of several views a step is resumed", "goes on with the views of a run that was never stopped"
)
@pytest.mark.parametrize(("total", "number"), [(10, 4), (5, 4), (7, 3)])
def test_a_resumed_run_goes_on_with_the_views_of_the_run_that_was_never_stopped(total: int, number: int):
    undisturbed = steps_of(views_of(Datamanager(total)), number, steps=60)
    drawn = []
    datamanager = Datamanager(total)
    for _ in range(6):
        drawn += steps_of(views_of(datamanager), number, steps=10)
        pipeline: Any = SimpleNamespace(
            datamanager=datamanager,
            model=SimpleNamespace(strategy=SimpleNamespace(max_gaussians=1000)),
            device=torch.device("cpu"),
            _settings=dict,
            schedule=Schedule(iterations=10, views_per_iteration=number),
            config=SimpleNamespace(effort=1.0),
            _repeat_overflowed=lambda wait: None,
        )
        state = SadgsPipeline.get_extra_state(pipeline)
        datamanager = pipeline.datamanager = Datamanager(total)
        SadgsPipeline.set_extra_state(pipeline, state)
    assert drawn == undisturbed
