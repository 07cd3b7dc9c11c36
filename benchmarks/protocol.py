"""What a benchmark measures: scenes, rows and seeds, read from a YAML file.

    scenes:
      bonsai: {data: bonsai, dataparser: colmap, options: {colmap_path: sparse/0}}
    seeds: [0, 1]
    rows:
      - {label: ours, method: sadgs, overrides: {max_num_iterations: 3000}}

A row may name its own `scenes` and `seeds`; rows of different scenes may share a label. `source` says where the scenes
come from, for whoever lacks them; `curve_every: 500`, for all rows or for one, also measures the held-out views every
500 iterations of each run.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml


@dataclass(frozen=True)
class Scene:
    """A scene and how nerfstudio reads it."""

    name: str
    data: str
    """Folder, relative to the root that holds all scenes."""
    dataparser: str
    """A registered nerfstudio dataparser, as the method sets it where it is the method's own; `blender` stands for
    `blender-data`."""
    options: dict[str, Any] = field(default_factory=dict)
    """Dotted paths into the dataparser's config."""


@dataclass(frozen=True)
class Row:
    """A method with its settings; one line of the table per scene."""

    label: str
    method: str
    """A registered nerfstudio method."""
    overrides: dict[str, Any] = field(default_factory=dict)
    """Dotted paths into the method's TrainerConfig."""
    scenes: tuple[str, ...] | None = None
    """Which scenes; None means all."""
    seeds: tuple[int, ...] | None = None
    """Which seeds; None means the protocol's."""
    curve_every: int | None = None
    """Iterations between measurements of the held-out views within a run; None makes none."""
    aligned: bool = False
    """Whether held-out views are also measured after their cameras were aligned (alignment.py); `--aligned` sets it."""


@dataclass(frozen=True)
class Job:
    """One training run."""

    scene: Scene
    row: Row
    seed: int

    @property
    def key(self) -> str:
        """Identifies the run in a results file: scene, label, seed and a hash of what the protocol says.

        It knows nothing of the code and its defaults: rows say their commit.
        """
        settings: list[Any] = [self.row.method, self.row.overrides, dataclasses.asdict(self.scene)]
        if self.row.curve_every is not None:  # a finished run without the curve is not what is asked for
            settings.append(self.row.curve_every)
        if self.row.aligned:
            settings.append("aligned")
        digest = hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode()).hexdigest()[:12]
        return f"{self.scene.name}/{self.row.label}/{self.seed}/{digest}"


@dataclass(frozen=True)
class Protocol:
    """A benchmark."""

    scenes: dict[str, Scene]
    rows: tuple[Row, ...]
    seeds: tuple[int, ...] = (0, 1)
    source: str | None = None
    """What the scenes are called and where they come from."""

    def jobs(self) -> list[Job]:
        """All runs: rows in their order, then scenes, then seeds."""
        jobs = []
        for row in self.rows:
            names = row.scenes
            if names is None:
                names = tuple(self.scenes)
            seeds = row.seeds
            if seeds is None:
                seeds = self.seeds
            for name in names:
                jobs += [Job(self.scenes[name], row, seed) for seed in seeds]
        return jobs


def load(path: Path) -> Protocol:
    """Read a protocol; raises ValueError, which names the place and the remedy, if the file is none."""
    try:
        return parse(yaml.safe_load(path.read_text()))
    except OSError as error:
        raise ValueError(f"{path} cannot be read ({error.strerror}); give the path of a protocol file.") from error
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is not YAML: {' '.join(str(error).split())}.") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def parse(content: object) -> Protocol:
    """Turn the content of a protocol file into a Protocol; raises as `load`, without the file's name."""
    top = _mapping(content, "the protocol", {"scenes", "rows"}, {"seeds", "source", "curve_every"})
    scenes = {name: _scene(name, value) for name, value in _mapping(top["scenes"], "scenes").items()}
    if not scenes:
        raise ValueError("scenes is empty; name at least one scene.")
    common = {"curve_every": top.get("curve_every")}
    rows = []
    for i, value in enumerate(_list(top["rows"], "rows")):
        where = f"rows[{i}]"
        rows.append(_row({**common, **_mapping(value, where)}, where, scenes))
    pairs = Counter((row.label, scene) for row in rows for scene in row.scenes or scenes)
    for (label, scene), count in pairs.items():
        if count > 1:
            raise ValueError(f"two rows have the label {label!r} for {scene}; give each its own.")
    source = None
    if top.get("source") is not None:
        source = _text(top, "source", "the protocol")
    seeds = _seeds(top.get("seeds", [0, 1]), "seeds")
    return Protocol(scenes, tuple(rows), seeds, source)


def set_dotted(config: Any, path: str, value: Any) -> None:
    """Set one setting in a tree of dataclasses and dicts, in place.

    The path is of fields and keys, joined by dots. The value, from YAML, becomes a Path, tuple or float where the
    present one is. Raises ValueError if the path leads nowhere, or the value has another type than the present one.
    """
    *parents, last = path.split(".")
    node = config
    for i, name in enumerate(parents):
        node = _child(node, name, path, ".".join(parents[:i]))
    present = _child(node, last, path, ".".join(parents))
    value = _converted(value, present, path)
    if isinstance(node, dict):
        node[last] = value
    else:
        setattr(node, last, value)


def _child(node: Any, name: str, path: str, parent: str) -> Any:
    """Return the field or key of a node in a tree of settings; raise ValueError if the node has none of this name.

    The sentence of the error names the whole path, and the node's own path `parent`, which is "" for the root.
    """
    where = parent or "the config"
    if not isinstance(node, dict) and not dataclasses.is_dataclass(node):
        raise ValueError(f"override {path!r}: {where} is {node!r}, which has no settings; shorten the path.")
    if isinstance(node, dict):
        children = {str(key): value for key, value in node.items()}
    else:
        children = {field.name: getattr(node, field.name) for field in dataclasses.fields(node)}
    if name not in children:
        remedy = f"it has {', '.join(sorted(children))}."
        similar = difflib.get_close_matches(name, children, n=1)
        if similar:
            remedy = f"did you mean {similar[0]!r}?"
        raise ValueError(f"override {path!r}: {where} has no {name!r}; {remedy}")
    return children[name]


def _converted(value: Any, present: Any, path: str) -> Any:
    """Convert a value from YAML to the type of a setting's present value.

    The value stays as it is if either is None, or if both are numbers. Raises ValueError, which names the setting's
    path, if the value cannot be converted.
    """
    if present is None or value is None:
        return value
    if type(present) is type(value) and type(present) in (bool, int, float, str):
        return value
    if not isinstance(present, bool) and not isinstance(value, bool):  # Python counts a bool as an int.
        if isinstance(present, (int, float)) and isinstance(value, (int, float)):
            return value
        if isinstance(present, float) and isinstance(value, str):
            with contextlib.suppress(ValueError):
                return float(value)  # YAML 1.1 reads 1e-4 as text: a float needs a dot there.
        if isinstance(present, Path) and isinstance(value, str):
            return Path(value)
        if isinstance(present, (tuple, list)) and isinstance(value, list):
            return type(present)(value)
    kind = type(present).__name__
    if isinstance(present, dict) or dataclasses.is_dataclass(present):
        kind = "a group of settings"
    raise ValueError(f"override {path!r}: {value!r} is {type(value).__name__}, but the setting is {kind}.")


def _row(value: Any, where: str, scenes: Mapping[str, Scene]) -> Row:
    row = _mapping(value, where, {"label", "method"}, {"scenes", "seeds", "overrides", "curve_every"})
    names = None
    if row.get("scenes") is not None:
        names = tuple(map(str, _list(row["scenes"], f"{where}.scenes")))
    for name in names or ():
        if name not in scenes:
            raise ValueError(f"{where}.scenes names {name!r}, which is not under scenes; add it there.")
    seeds = None
    if row.get("seeds") is not None:
        seeds = _seeds(row["seeds"], f"{where}.seeds")
    every = row.get("curve_every")
    if every is not None and (type(every) is not int or every < 1):
        raise ValueError(f"curve_every must be a whole number of iterations from 1, not {every!r}.")
    overrides = _mapping(row.get("overrides") or {}, f"{where}.overrides")
    return Row(_text(row, "label", where), _text(row, "method", where), overrides, names, seeds, every)


def _scene(name: str, value: object) -> Scene:
    where = f"scenes.{name}"
    scene = _mapping(value, where, {"data", "dataparser"}, {"options"})
    options = _mapping(scene.get("options") or {}, f"{where}.options")
    return Scene(name, _text(scene, "data", where), _text(scene, "dataparser", where), options)


def _mapping(value: Any, where: str, required: set[str] | None = None, optional: Set[str] = frozenset()) -> Any:
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise ValueError(f"{where} must be a mapping with names as keys, not {value!r}.")
    if required is not None:
        for key in sorted(value.keys() - required - optional):
            raise ValueError(f"{where} has an unknown key {key!r}; it takes {', '.join(sorted(required | optional))}.")
        for key in sorted(required - value.keys()):
            raise ValueError(f"{where} lacks {key!r}; add it.")
    return value


def _list(value: object, where: str) -> list[Any]:
    if not isinstance(value, list) or not value:
        raise ValueError(f"{where} must be a list of at least one entry, not {value!r}.")
    return value


def _text(mapping: Mapping[str, Any], key: str, where: str) -> str:
    value = mapping[key]
    if not isinstance(value, str) or not value:
        raise ValueError(f"{where}.{key} must be text, not {value!r}; put it in quotes.")
    return value


def _seeds(value: object, where: str) -> tuple[int, ...]:
    seeds = _list(value, where)
    if not all(type(seed) is int and seed >= 0 for seed in seeds):
        raise ValueError(f"{where} must be a list of whole numbers from 0, not {value!r}.")
    return tuple(seeds)
