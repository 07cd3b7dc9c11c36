"""`python -m benchmarks captures`: where the captures of the tables come from, and whether a folder holds them.

configs/bench/captures.yaml says for each capture its source and licence, how its photos were made smaller, how many
there are and which are held out, digests that identify it, and the command that repeats its rows. Nothing is
downloaded: most sources state no licence, so whoever wants to repeat a row gets the photos from their page.

    python -m benchmarks captures                          # describes all
    python -m benchmarks captures fox                      # describes one
    python -m benchmarks captures --check ROOT             # compares the scenes in ROOT/NAME
    python -m benchmarks captures --check-photos ROOT      # compares photos as they were taken, in ROOT/NAME

The photos must be the same for figures to be the same. Cameras that were placed anew from the same photos differ a
little each time, so a row is then repeated only up to the spread between placings.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from tyro.conf import Positional

from benchmarks.capture_digests import SPARSE, TRANSFORMS, Model, Photos, measure_model, measure_photos

CAPTURES = Path(__file__).resolve().parents[1] / "configs" / "bench" / "captures.yaml"
"""What is known of the captures."""
IMAGES = Path("images")
"""Folder of a scene's photos."""


@dataclass(frozen=True)
class Source:
    """Where a capture comes from."""

    name: str
    page: str
    """Address of the page that has it."""
    licence: str


@dataclass(frozen=True)
class Capture:
    """A capture of the tables."""

    name: str
    shows: str
    source: Source
    prepared: str
    """What was done to the photos, and how the cameras were found."""
    split: str
    """Which photos are held out of training."""
    photos: Photos
    repeat: str
    """Command that repeats its rows, in which ROOT stands for the folder that holds NAME."""
    model: Model | None = None
    """Cameras and points of a scene; None of photos as they were taken."""

    def describe(self) -> str:
        """Return what is known of the capture, in a paragraph of lines."""
        sizes = " and ".join(self.photos.sizes)
        lines = [
            f"{self.name}: {self.shows}",
            f"  photos    {self.photos.count} of {sizes} px",
            f"  from      {self.source.name}, {self.source.page}",
            f"  licence   {self.source.licence}",
            f"  prepared  {self.prepared}",
            f"  held out  {self.split}",
        ]
        if self.model is not None:
            lines.append(f"  model     {self.model.views} cameras, {self.model.points:,} points")
            lines.append(f"  digests   cameras {self.model.cameras}, points {self.model.positions}")
        lines.append(f"  digests   names and sizes {self.photos.names}, files {self.photos.content}")
        lines.append(f"  repeat    {self.repeat.replace('NAME', self.name)}")
        return "\n".join(lines)

    def difference(self, folder: Path) -> str | None:
        """Return in a sentence what differs between a folder and this capture, or None if nothing does.

        What matters most is told first, and alone. Raises OSError, InputError or ValueError if a file cannot be read.
        """
        photos_folder = folder
        if self.model is not None:
            photos_folder = folder / IMAGES
        difference = self._photos_difference(measure_photos(photos_folder), photos_folder)
        if difference is None and self.model is not None:
            difference = self._model_difference(measure_model(folder), folder)
        return difference

    def _photos_difference(self, found: Photos, folder: Path) -> str | None:
        expected = self.photos
        if found.count != expected.count:
            return f"{folder} holds {found.count} photos instead of {expected.count}."
        if set(found.sizes) != set(expected.sizes):
            sizes = " and ".join(found.sizes)
            return f"the photos have {sizes} px instead of {' and '.join(expected.sizes)}."
        if found.names != expected.names:
            return "number and sizes of the photos match, but not their names."
        if found.content != expected.content:
            return (
                "names and sizes of the photos match, but the files differ: they were resized or compressed otherwise."
            )
        return None

    def _model_difference(self, found: Model | None, folder: Path) -> str | None:
        expected = self.model
        assert expected is not None
        if found is None:
            return f"the photos match, but {folder} has neither {SPARSE} nor {TRANSFORMS} with their cameras."
        if found.views != expected.views:
            return f"the photos match, but {found.views} of them have a camera instead of {expected.views}."
        if found.cameras != expected.cameras:
            return (
                "the photos match, but their cameras differ: they were placed anew, or the held-out views are others."
            )
        if found.points != expected.points:
            return f"photos and cameras match, but there are {found.points:,} points instead of {expected.points:,}."
        if found.positions != expected.positions:
            return "photos and cameras match, but the points lie elsewhere."
        return None


def load(path: Path = CAPTURES) -> tuple[dict[str, Capture], dict[str, Capture]]:
    """Read the scenes and the photos of a file, by their names. Raises ValueError, one sentence, if it is none."""
    try:
        content = yaml.safe_load(path.read_text("utf8"))
        scenes = {name: _capture(name, values) for name, values in content["scenes"].items()}
        photos = {name: _capture(name, values) for name, values in content["photos"].items()}
    except OSError as error:
        raise ValueError(f"{path} cannot be read ({error.strerror}); give the YAML file of captures.") from error
    except (AttributeError, KeyError, TypeError, yaml.YAMLError) as error:
        problem = " ".join(str(error).split())
        raise ValueError(f"{path} must be YAML with scenes and photos: {problem}.") from error
    return scenes, photos


def _capture(name: str, values: Mapping[str, Any]) -> Capture:
    fields = dict(values)
    measured = fields["photos"]
    fields["photos"] = Photos(**{**measured, "sizes": tuple(measured["sizes"])})
    fields["source"] = Source(**fields["source"])
    if "model" in fields:
        fields["model"] = Model(**fields["model"])
    return Capture(name, **fields)


def compare(captures: Mapping[str, Capture], root: Path, all_wanted: bool) -> bool:
    """Print for each capture whether its folder in `root` matches; return whether all do.

    Captures without a folder are named in a last line, and are a difference if `all_wanted`. Raises ValueError if no
    capture has a folder, or a file cannot be read.
    """
    absent = [name for name in captures if not (root / name).is_dir()]
    if len(absent) == len(captures):
        raise ValueError(f"{root} holds no folder {', '.join(absent)}; give the folder that holds the captures.")
    same = True
    for name, capture in captures.items():
        if name in absent:
            continue
        difference = capture.difference(root / name)
        print(f"{name}: {difference or 'matches'}", flush=True)
        if difference is not None:
            same = False
    if absent:
        print(f"Not in {root}: {', '.join(absent)}")
    return same and not (absent and all_wanted)


@dataclass
class Command:
    """Describe the captures of the tables, or compare folders with them."""

    names: Positional[tuple[str, ...]] = ()
    """captures (default: all)"""
    check: Path | None = None
    """folder whose folders NAME hold scenes, with images and cameras, to compare; exit code 1 if one differs"""
    check_photos: Path | None = None
    """folder whose folders NAME hold photos as they were taken, to compare; exit code 1 if one differs"""
    captures: Path = CAPTURES
    """YAML file that describes them"""

    def __call__(self) -> int:
        """Describe or compare; return 1 if a capture differs, otherwise 0."""
        scenes, photos = load(self.captures)
        for name in self.names:
            if name not in scenes and name not in photos:
                known = ", ".join(dict.fromkeys([*scenes, *photos]))
                raise ValueError(f"there is no capture {name!r}; the captures are {known}.")
        if self.names:
            scenes = {name: scenes[name] for name in self.names if name in scenes}
            photos = {name: photos[name] for name in self.names if name in photos}
        if self.check is None and self.check_photos is None:
            print("\n\n".join(capture.describe() for capture in [*scenes.values(), *photos.values()]))
            return 0
        same = True
        for captures, root in ((scenes, self.check), (photos, self.check_photos)):
            if root is not None:
                if not captures:
                    raise ValueError(f"{', '.join(self.names)} is not among what {root} is compared with.")
                same &= compare(captures, root, all_wanted=bool(self.names))
        return int(not same)
