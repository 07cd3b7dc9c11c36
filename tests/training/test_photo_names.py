"""Photos are known again by their names when a run is resumed."""

from __future__ import annotations

from pathlib import Path

import pytest

from sadgs_ns.training.photo_names import common_folder, photo_names, same_photos


def test_the_common_folder_holds_all_files():
    assert common_folder([Path("a/b/1.png"), Path("a/c/1.png")]) == Path("a").absolute()
    assert common_folder([Path("a/b/1.png"), Path("a/b/2.png")]) == Path("a/b").absolute()
    assert common_folder([Path("a/b/1.png"), Path("a/c/1.png").absolute()]) == Path("a").absolute()


def test_names_have_the_common_folder_and_all_below_it():
    files = [Path("/data/scene/images/1.png"), Path("/data/scene/images/2.png")]
    assert photo_names(files) == ["images/1.png", "images/2.png"]
    rig = [Path("/data/rig/left/images/1.png"), Path("/data/rig/right/images/1.png")]
    assert photo_names(rig) == ["rig/left/images/1.png", "rig/right/images/1.png"]
    assert photo_names([Path("1.png")]) == [f"{Path.cwd().name}/1.png"]


@pytest.mark.hard_case(
    "a run is resumed with photos that were added, or whose folder was renamed, and photos of a rig have equal names",
    "each photo keeps its own gain, and what moved in it",
)
@pytest.mark.parametrize(
    ("before", "now", "same"),
    [
        pytest.param(["i/1.png", "i/2.png"], ["i/2.png", "i/3.png"], [1, None], id="added and removed"),
        pytest.param(["old/1.png", "old/2.png"], ["new/1.png", "new/2.png"], [0, 1], id="renamed"),
        pytest.param(["i/1.png", "i/2.png"], ["i_2/2.png", "i_2/9.png"], [1, None], id="of another size"),
        pytest.param(["r/a/1.png", "r/b/1.png"], ["s/b/1.png", "s/a/1.png"], [1, 0], id="a rig, renamed"),
        pytest.param(["r/a/1.png"], ["r/a/1.png", "r/b/1.png"], [0, None], id="added to a rig"),
        pytest.param(["a/1.png", "a/2.png"], ["r/b/1.png", "r/a/1.png"], [None, 0], id="a camera added"),
        pytest.param(["r/a/1.png", "r/b/2.png"], ["r/b/1.png", "r/b/2.png"], [None, 1], id="another of a rig"),
        pytest.param(["i/1.png", "i/1.png"], ["r/a/i/1.png", "r/b/i/1.png"], [None, None], id="cannot be told apart"),
    ],
)
def test_a_photo_is_the_one_with_the_most_of_its_path(before: list[str], now: list[str], same: list[int | None]):
    assert same_photos(before, now) == same
