"""The kinds of tables and figures that `documents` makes of rows, and shows the descriptions of."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import approximations, plots
from benchmarks.results import Result
from benchmarks.table import grid, half_range, mean

RESULTS = Path("docs", "results")
"""Folder of the rows, in a checkout."""
NOTHING = "–"
_DIGITS = {"psnr": 2, "ssim": 4, "lpips": 4}


def number(value: float | None, digits: int, signed: bool = False) -> str:
    """A number with a real minus; three digits and more, which are of measures up to 1, go without a leading 0."""
    if value is None:
        return NOTHING
    rounded = round(value, digits)
    text = f"{abs(rounded):.{digits}f}"
    text = text.removeprefix("0") if digits > 2 else text
    return ("−" if rounded < 0 else "+" if rounded > 0 and signed else "") + text


def count(value: float) -> str:
    """How many Gaussians: thousands, from ten thousand on."""
    return f"{value:,.0f}" if value < 10_000 else f"{value / 1000:,.0f}k"


@dataclass(frozen=True)
class Run:
    """A line of a table of runs."""

    scene: str
    megapixels: float | None
    """Of an image."""
    name: str
    group: list[Result]
    """A result for each seed."""
    base: list[Result]
    """The same of the row whose loop is the measure; none if there is none."""

    def mean(self, field: str) -> float:
        """Mean over the seeds.

        Raises:
            ValueError: No result has that number.
        """
        if (value := mean(self.group, field)) is None:
            raise ValueError(f"{self.group[0]['key']} has no {field}; leave that column out.")
        return value

    def with_spread(self, field: str, digits: int) -> str:
        """Mean ± half the range of the seeds."""
        spread = f" ± {number(half_range(self.group, field), digits)}" if len(self.group) > 1 else ""
        return number(self.mean(field), digits) + spread

    def ratio(self) -> str:
        """Loop seconds, relative to those of `base`."""
        seconds = mean(self.base, "loop_seconds")
        if seconds is None:
            return NOTHING
        return "1" if self.group == self.base else f"1/{seconds / self.mean('loop_seconds'):.0f}"

    def photos(self) -> str:
        """The scene, and how many training views of what size it has."""
        size = "" if self.megapixels is None else f" of {self.megapixels} MP"
        return f"{self.scene}: {self.mean('train_views'):.0f}{size}"


COLUMNS: dict[str, tuple[str, Callable[[Run], str]]] = {
    "scene": ("Scene", lambda run: run.scene),
    "photos": ("Scene: training views", Run.photos),
    "method": ("Method", lambda run: run.name),
    "iterations": ("Iterations", lambda run: f"{run.mean('iterations'):,.0f}"),
    "loop": ("Loop s", lambda run: run.with_spread("loop_seconds", 1)),
    "seconds": ("Loop s", lambda run: number(run.mean("loop_seconds"), 0 if run.mean("loop_seconds") >= 100 else 1)),
    "date": ("Date", lambda run: run.group[0]["date"].split("T")[0]),
    "ratio": ("Ratio", Run.ratio),
    "psnr": ("PSNR", lambda run: run.with_spread("psnr", 2)),
    "ssim": ("SSIM", lambda run: run.with_spread("ssim", 4)),
    "lpips": ("LPIPS", lambda run: run.with_spread("lpips", 4)),
    "cc_psnr": ("PSNR, colours fitted", lambda run: run.with_spread("cc_psnr", 2)),
    "cc_ssim": ("SSIM, fitted", lambda run: run.with_spread("cc_ssim", 4)),
    "cc_lpips": ("LPIPS, fitted", lambda run: run.with_spread("cc_lpips", 4)),
    "gaussians": ("Gaussians", lambda run: count(run.mean("gaussians"))),
    "peak": ("Peak GB", lambda run: run.with_spread("peak_gb", 1)),
}
"""Header and cell of each column of a table of runs."""
_WORDS = ("scene", "photos", "method", "date")


@dataclass(frozen=True)
class Part:
    """Lines of a table of runs: of each scene a line for each label."""

    rows: str
    scenes: Sequence[str]
    labels: Mapping[str, str]
    """Label in the rows: name in the table."""
    reference: str | None = None
    """Label whose loop seconds on the same scene are 1."""


@dataclass(frozen=True)
class Runs:
    """A run a line."""

    columns: Sequence[str]
    lines: Sequence[Mapping[str, Any]]
    """Of `Part`."""

    def files(self) -> list[str]:
        """Names of the files that the table is made of."""
        return [line["rows"] for line in self.lines]

    def text(self, folder: Path, megapixels: Mapping[str, float]) -> str:
        """The table as Markdown, from the rows in a folder."""
        runs = [run for line in self.lines for run in runs_of(line, folder, megapixels)]
        for name in self.columns:
            if name not in COLUMNS:
                raise ValueError(f"there is no column {name!r}; there are {', '.join(COLUMNS)}.")
        lines = ([COLUMNS[name][1](run) for name in self.columns] for run in runs)
        words = sum(name in _WORDS for name in self.columns)
        return grid([COLUMNS[name][0] for name in self.columns], lines, words)


def runs_of(line: Mapping[str, Any], folder: Path, megapixels: Mapping[str, float]) -> list[Run]:
    """The runs of a `Part`."""
    part = described(Part, line)
    found, runs = grouped(folder, [part.rows]), []
    for scene in part.scenes:
        base = [] if part.reference is None else group_of(found, scene, part.reference)
        runs += [
            Run(scene, megapixels.get(scene), name, group_of(found, scene, label), base)
            for label, name in part.labels.items()
        ]
    return runs


@dataclass(frozen=True)
class Figure:
    """A plot of the ends of runs: quality against a cost."""

    cost: str
    """The field on the horizontal axis, one of `plots.COSTS`."""
    parts: Sequence[Mapping[str, Any]]
    """Of `Part`: runs on one machine."""
    elsewhere: Sequence[Mapping[str, Any]] = ()
    """Of `Part`: runs on others, drawn hollow."""

    def files(self) -> list[str]:
        """Names of the files that the figure is made of."""
        return [line["rows"] for line in (*self.parts, *self.elsewhere)]

    def points(self, folder: Path) -> list[plots.Point]:
        """What is drawn, from the rows in a folder."""
        runs = [(run, here) for here in (True, False) for line in (self.parts if here else self.elsewhere)
                for run in runs_of(line, folder, {})]  # fmt: skip
        return [
            plots.Point(run.name, here, *(run.mean(field) for field in (self.cost, *plots.PEER_METRICS)))
            for run, here in runs
        ]


@dataclass(frozen=True)
class Sweep:
    """A setting a line and scenes as columns: PSNR / SSIM / LPIPS / Gaussians, as differences from the first setting.

    The second line is half the range of the first one's runs, and ¹ a difference of which one side is a single run.
    """

    rows: Sequence[str]
    labels: Mapping[str, str]
    scenes: Mapping[str, Sequence[str]]

    def files(self) -> Sequence[str]:
        """Names of the files that the table is made of."""
        return self.rows

    def text(self, folder: Path, megapixels: Mapping[str, float]) -> str:
        """The table as Markdown, from the rows in a folder."""
        found = grouped(folder, self.rows)
        for label in self.labels:
            if label not in {other for _, other in found}:
                raise ValueError(f"{', '.join(self.rows)} have no row {label!r}.")
        (first, name), *others = self.labels.items()
        bases = [[group_of(found, scene, first) for scene in scenes] for scenes in self.scenes.values()]
        lines = [[name, *map(_absolute, bases)]]
        if any(len(group) > 1 for base in bases for group in base):
            lines.append(["half the range of its runs", *map(_spread, bases)])
        for label, name in others:
            settings = [[found.get((scene, label), []) for scene in scenes] for scenes in self.scenes.values()]
            lines.append([name, *(_difference(*pair) for pair in zip(settings, bases, strict=True))])
        return grid(["Setting", *self.scenes], lines)


@dataclass(frozen=True)
class Approximations:
    """What `python -m benchmarks kernels` measured."""

    rows: str
    table: str
    """One of `approximations.TABLES`."""
    input: str
    """The image, or `demo`."""
    variants: Sequence[str] | None = None
    """Which variants; None means all."""

    def files(self) -> list[str]:
        """Names of the files that the table is made of."""
        return [self.rows]

    def text(self, folder: Path, megapixels: Mapping[str, float]) -> str:
        """The table as Markdown, from the rows in a folder."""
        rows = [r for r in read_rows(folder / self.rows) if (r["table"], r["input"]) == (self.table, self.input)]
        by_variant = {row["variant"]: row for row in rows}
        names = list(by_variant) if self.variants is None else self.variants
        if not names or not by_variant.keys() >= set(names):
            raise ValueError(f"{self.rows} has of {self.table!r} and {self.input!r} only {', '.join(by_variant)}.")
        return approximations.body([by_variant[name] for name in names])


@dataclass(frozen=True)
class Growth:
    """What `python -m benchmarks growth` measured."""

    rows: str

    def files(self) -> list[str]:
        """Names of the files that the table is made of."""
        return [self.rows]

    def text(self, folder: Path, megapixels: Mapping[str, float]) -> str:
        """The table as Markdown, from the rows in a folder."""
        with (folder / self.rows).open(encoding="utf-8", newline="") as file:
            rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
        fewest = min(row["megapixels"] for row in rows if row["gaussians"] != rows[0]["gaussians"])
        rows.sort(key=lambda row: (row["megapixels"] != fewest, row["gaussians"], row["megapixels"]))
        lines = (
            (f"{row['gaussians']:,.0f}", f"{row['megapixels']:g}", number(row["ours_ms"], 2),
             number(row["gsplat_ms"], 2), f"{row['gsplat_ms'] / row['ours_ms']:.1f}")
            for row in rows
        )  # fmt: skip
        return grid(["Gaussians", "Megapixels", "Ours, ms", "gsplat and torch, ms", "Ratio"], lines, names=0)


Table = Runs | Sweep | Approximations | Growth
KINDS: dict[str, type] = {"runs": Runs, "sweep": Sweep, "approximations": Approximations, "growth": Growth}


def described(kind: type, content: Any) -> Any:
    """A dataclass from a mapping of its fields.

    Raises:
        ValueError: It is no mapping of them.
    """
    fields = [field.name for field in dataclasses.fields(kind)]
    needed = {f.name for f in dataclasses.fields(kind) if f.default is f.default_factory is dataclasses.MISSING}
    if not isinstance(content, dict) or not needed <= content.keys() <= set(fields):
        raise ValueError(f"{content!r} must be a mapping of {', '.join(fields)}.")
    return kind(**content)


def grouped(folder: Path, files: Iterable[str]) -> dict[tuple[str, str], list[Result]]:
    """The results of several files that are ok, by scene and label. All of them count, also several of one seed."""
    found: dict[tuple[str, str], list[Result]] = {}
    for row in (row for file in files for row in read_rows(folder / file)):
        if row["status"] == "ok":
            found.setdefault((row["scene"], row["label"]), []).append(row)
    return found


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of a file.

    Raises:
        ValueError: There is no such file, or a line of it is not JSON.
    """
    if not path.is_file():
        raise ValueError(f"{path} is not there; rows lie in {RESULTS}.")
    try:
        return [json.loads(line) for line in path.read_text("utf-8").splitlines()]
    except ValueError as error:
        raise ValueError(f"{path} holds a line that is not JSON; delete it.") from error


def group_of(found: Mapping[tuple[str, str], list[Result]], scene: str, label: str) -> list[Result]:
    """The results of a scene and a label.

    Raises:
        ValueError: There are none.
    """
    if (scene, label) not in found:
        raise ValueError(f"there is no row {label!r} of {scene}.")
    return found[scene, label]


def _means(cell: Sequence[list[Result]], field: str) -> float | None:
    """Mean over scenes of the means over seeds."""
    values = [mean(group, field) for group in cell]
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if len(known) == len(values) else None


def _absolute(cell: Sequence[list[Result]]) -> str:
    values = [number(_means(cell, field), digits) for field, digits in _DIGITS.items()]
    return " / ".join([*values, count(_means(cell, "gaussians") or 0)])


def _spread(cell: Sequence[list[Result]]) -> str:
    if any(len(group) < 2 for group in cell):
        return NOTHING
    spreads = {field: [half_range(group, field) for group in cell] for field in _DIGITS}
    return " / ".join(number(sum(spreads[field]) / len(cell), digits) for field, digits in _DIGITS.items())


def _difference(cell: Sequence[list[Result]], base: Sequence[list[Result]]) -> str:
    if not all(cell):
        return NOTHING
    parts = []
    for field, digits in _DIGITS.items():
        new, old = _means(cell, field), _means(base, field)
        parts.append(NOTHING if new is None or old is None else number(new - old, digits, signed=True))
    ratio = (_means(cell, "gaussians") or 0) / (_means(base, "gaussians") or 1)
    single = any(len(group) < 2 for group in (*cell, *base))
    return " / ".join([*parts, f"×{ratio:.2f}"]) + (" ¹" if single else "")
