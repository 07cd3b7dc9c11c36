"""Which views the steps of a run take: no view twice in a step, and all equally often."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig

from sadgs_ns.distributed.world import World
from sadgs_ns.training.step.images import ImagePrefetcher
from sadgs_ns.training.step.views import TrainingViews, ViewSampler

STEPS = 1000


class Datamanager:
    """A datamanager of `total` views, without their images."""

    def __init__(self, total: int, **options: Any) -> None:
        self.config = FullImageDatamanagerConfig(**options)
        heights = torch.tensor([48, 30, 48, 16]).repeat(total)[:total, None]
        cameras = SimpleNamespace(height=heights, width=heights)
        self.cached_train = [{"image": torch.zeros(1, 1, 3)} for _ in range(total)]
        self.train_dataset: Any = type("Dataset", (), {"cameras": cameras, "__len__": lambda _: total})()


def views_of(datamanager: Any, world: Any = None) -> TrainingViews:
    model: Any = SimpleNamespace(device=torch.device("cpu"), world=world or World())
    return TrainingViews(datamanager, model)


def steps_of(views: TrainingViews, number: int, steps: int = STEPS) -> list[list[int]]:
    return [[index for index, _ in views.draw(number)] for _ in range(steps)]


def drawn_by(sampler: ViewSampler, number: int, steps: int = STEPS) -> list[list[int]]:
    return [sampler.draw(number) for _ in range(steps)]


@pytest.mark.hard_case(
    "a round of views that ends inside a step of several", "no view twice in a step, all equally often"
)
@pytest.mark.parametrize(("total", "number"), [(10, 4), (5, 4), (4, 4), (7, 3), (10, 1), (1, 1)])
def test_no_view_comes_twice_in_a_step_and_all_come_equally_often(total: int, number: int):
    visits: Counter[int] = Counter()
    for drawn in drawn_by(ViewSampler(total, 0), number):
        assert len(set(drawn)) == number
        visits.update(drawn)
        counts = [visits[index] for index in range(total)]
        assert max(counts) - min(counts) <= 1


@pytest.mark.parametrize(("total", "number"), [(3, 5), (1, 3), (2, 4)])
def test_a_step_of_more_views_than_there_are_has_all_of_them_equally_often(total: int, number: int):
    for drawn in drawn_by(ViewSampler(total, 0), number, steps=100):
        counts = [drawn.count(index) for index in range(total)]
        assert len(drawn) == number
        assert max(counts) - min(counts) <= 1


@pytest.mark.parametrize(("total", "number"), [(60, 4), (10, 3), (5, 4), (3, 3)])
def test_foreseen_steps_are_drawn_and_foreseeing_changes_no_order(total: int, number: int):
    expected = drawn_by(ViewSampler(total, 0), number, steps=60)
    sampler = ViewSampler(total, 0)
    for step in range(50):
        actual = sampler.foresee(number, step % 11)
        assert actual == expected[step : step + step % 11]
        assert sampler.draw(number) == expected[step]


@pytest.mark.parametrize(("total", "number"), [(60, 4), (10, 3), (5, 4)])
def test_images_that_are_decoded_ahead_change_no_order_and_are_awaited_once(total: int, number: int):
    options = {"max_thread_workers": 2}
    expected = steps_of(views_of(Datamanager(total, **options)), number, steps=100)
    datamanager = Datamanager(total, cache_images="cpu", **options)
    datamanager.cached_train = tuple(datamanager.cached_train)  # type: ignore[assignment]
    views = views_of(datamanager)
    awaited = 0
    for step in expected:
        assert views.prefetcher is not None
        known = views.prefetcher._loading.keys() | views.prefetcher._sent.keys()
        drawn = [index for index, _ in views.draw(number)]
        assert drawn == step
        awaited += not known.issuperset(drawn)
        assert len(views.prefetcher._loading) + len(views.prefetcher._sent) <= 2 + 2 * number
    assert awaited == 1
    views.close()


@pytest.mark.parametrize(("total", "number", "ranks"), [(60, 4, 2), (60, 4, 3), (10, 3, 2), (5, 4, 8)])
def test_each_process_prepares_what_it_composites_and_nothing_else(
    total: int, number: int, ranks: int, monkeypatch: pytest.MonkeyPatch
):
    options = {"max_thread_workers": 2}
    expected = steps_of(views_of(Datamanager(total, **options)), number, steps=100)
    loaded: list[int] = []
    pin = ImagePrefetcher._pinned
    monkeypatch.setattr(ImagePrefetcher, "_pinned", lambda images, index: loaded.append(index) or pin(images, index))
    composited: list[set[int]] = [set() for _ in expected]
    for rank in range(ranks):
        datamanager = Datamanager(total, cache_images="cpu", **options)
        datamanager.cached_train = tuple(datamanager.cached_train)  # type: ignore[assignment]
        world = World()
        world.rank = rank
        world.num_ranks = ranks
        views = views_of(datamanager, world)
        loaded.clear()
        awaited = 0
        taken = Counter[int]()
        assert views.prefetcher is not None
        for step, of_all in zip(expected, composited, strict=True):
            known = views.prefetcher._loading.keys() | views.prefetcher._sent.keys()
            drawn = views.draw(number)
            assert [index for index, _ in drawn] == step
            own = {index for index, data in drawn if "image" in data}
            taken.update(own)
            of_all |= own
            awaited += not known.issuperset(own)
        under_way = Counter(views.prefetcher._loading.keys() | views.prefetcher._sent.keys())
        assert under_way.total() <= 2 + 2 * number
        views.close()
        assert taken <= Counter(loaded) <= taken + under_way
        assert awaited <= 1
    assert composited == [set(step) for step in expected]


@pytest.mark.parametrize(("total", "number"), [(10, 5), (10, 1), (4, 4)])
def test_the_order_is_nerfstudio_s_where_rounds_end_with_steps(total: int, number: int):
    nerfstudio: Any = SimpleNamespace(
        config=FullImageDatamanagerConfig(train_cameras_sampling_seed=7), train_dataset=range(total)
    )
    order: list[int] = []
    while len(order) < 20 * number:
        order += FullImageDatamanager.sample_train_cameras(nerfstudio)
    views = views_of(Datamanager(total, train_cameras_sampling_seed=7))
    actual = [index for step in steps_of(views, number, steps=20) for index in step]
    assert actual == order[: 20 * number]


def test_a_view_that_is_passed_over_comes_first_in_the_next_step():
    sampler = ViewSampler(4, 0)
    sampler.load_state_dict(sampler.state_dict() | {"order": [2, 3, 3, 0, 2, 1]})
    actual = drawn_by(sampler, 3, steps=2)
    expected = [[2, 3, 0], [3, 2, 1]]
    assert actual == expected


@pytest.mark.parametrize("foreseen", [0, 5])
@pytest.mark.parametrize(("total", "number"), [(10, 4), (5, 4), (10, 1)])
def test_views_that_are_put_back_come_next_and_all_count_equally_often(total: int, number: int, foreseen: int):
    """Every seventh step fails, which is found out only when two more steps have been drawn."""
    sampler = ViewSampler(total, 0)
    visits: Counter[int] = Counter()
    lost: dict[int, list[int]] = {}
    for step in range(STEPS):
        back = lost.pop(step - 3, [])
        sampler.requeue(back)
        following = sampler.foresee(number, foreseen)
        drawn = sampler.draw(number)
        assert following[:1] in ([], [drawn])
        assert len(set(drawn)) == number
        assert set(drawn) >= set(back)
        if step % 7 == 0:
            lost[step] = drawn
        else:
            visits.update(drawn)
        missing = Counter(index for indices in lost.values() for index in indices)
        counts = [visits[index] + missing[index] for index in range(total)]
        assert max(counts) - min(counts) <= 1


@pytest.mark.hard_case(
    "a view that did not count, put back before a step whose other views include it", "comes once in each step"
)
def test_a_view_that_is_put_back_twice_comes_in_two_steps():
    sampler = ViewSampler(4, 0)
    sampler.load_state_dict(sampler.state_dict() | {"order": [0, 1]})
    sampler.requeue([0])
    assert sampler.draw(2) == [0, 1]
    assert sampler.draw(2)[0] == 0


@pytest.mark.hard_case(
    "a run of several views a step is resumed", "goes on with the views of a run that was never stopped"
)
@pytest.mark.parametrize(("total", "number"), [(10, 4), (5, 4), (7, 3)])
def test_a_resumed_run_goes_on_with_the_views_of_the_run_that_was_never_stopped(total: int, number: int):
    undisturbed = drawn_by(ViewSampler(total, 0), number, steps=60)
    drawn = []
    sampler = ViewSampler(total, 0)
    for seed in range(6):
        drawn += drawn_by(sampler, number, steps=10)
        sampler.foresee(number, seed)
        state = sampler.state_dict()
        drawn_by(sampler, number, steps=10)  # The state is a copy.
        sampler = ViewSampler(total, seed)
        sampler.load_state_dict(state)
    assert drawn == undisturbed


def test_a_run_on_another_number_of_views_starts_an_order_of_its_own():
    state = ViewSampler(7, 0).state_dict()
    for total in (6, 8):
        sampler = ViewSampler(total, 1)
        sampler.load_state_dict(state)
        actual = drawn_by(sampler, 3, steps=20)
        expected = drawn_by(ViewSampler(total, 1), 3, steps=20)
        assert actual == expected


def test_another_seed_is_another_order():
    assert ViewSampler(20, 0).draw(20) != ViewSampler(20, 1).draw(20)
