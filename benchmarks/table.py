"""Results as Markdown tables, of a results file or of the rows that the documents cite."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from benchmarks.results import Result

Groups = Mapping[tuple[str, str], Sequence[Result]]
"""Results that are ok by scene and label, one a seed."""
NOTHING = "–"
DIGITS = {"psnr": 2, "ssim": 4, "lpips": 4}


def number(value: float | None, digits: int, signed: bool = False) -> str:
    """A number with a real minus, and without a leading 0 before two digits or more."""
    if value is None:
        return NOTHING
    rounded = round(value, digits)
    text = f"{abs(rounded):.{digits}f}"
    if digits > 1:
        text = text.removeprefix("0")
    if rounded < 0:
        return f"−{text}"
    if rounded > 0 and signed:
        return f"+{text}"
    return text


def count(value: float) -> str:
    """How many Gaussians: thousands, from ten thousand on."""
    if value < 10_000:
        return f"{value:,.0f}"
    return f"{value / 1000:,.0f}k"


def grid(header: Sequence[str], lines: Iterable[Sequence[str]], names: int = 1) -> str:
    """Cells as a Markdown table; the first `names` columns are aligned to the left, the others to the right."""
    rule = ["---"] * names + ["---:"] * (len(header) - names)
    text = []
    for line in (header, rule, *lines):
        cells = [cell.replace("|", "\\|") for cell in line]
        text.append("| " + " | ".join(cells) + " |")
    return "\n".join(text)


def latest(rows: Iterable[Result]) -> list[Result]:
    """Of several results with one scene, label and seed the last."""
    return list({(row["scene"], row["label"], row["seed"]): row for row in rows}.values())


def groups(rows: Iterable[Result]) -> dict[tuple[str, str], list[Result]]:
    """The results that are ok by scene and label; scene by scene, as they first appear."""
    found: dict[tuple[str, str], list[Result]] = {}
    for row in rows:
        if row["status"] == "ok":
            found.setdefault((row["scene"], row["label"]), []).append(row)
    scenes = list(dict.fromkeys(scene for scene, _ in found))
    return dict(sorted(found.items(), key=lambda item: scenes.index(item[0][0])))


def values(group: Iterable[Result], name: str) -> list[float]:
    """A field of the results that have it."""
    found = [row.get(name) for row in group]
    return [value for value in found if value is not None]


def mean(group: Iterable[Result], name: str) -> float | None:
    """Mean of a field over the results that have it; None if none does."""
    known = values(group, name)
    if not known:
        return None
    return statistics.fmean(known)


Cell = Sequence[Sequence[Result]]
"""The runs of each scene that a cell of a table stands for, one a seed; a capture's folds are several scenes."""


def mean_over_scenes(cell: Cell, name: str) -> float | None:
    """Mean over scenes of the means over seeds; None if a scene has no number."""
    means = [mean(group, name) for group in cell]
    known = [value for value in means if value is not None]
    if not known or len(known) < len(cell):
        return None
    return statistics.fmean(known)


def deviation(cell: Cell, name: str) -> float | None:
    """Pooled standard deviation over the seeds of all scenes; None if these say less than three seeds of one scene."""
    squares = []
    freedom = 0
    for group in cell:
        numbers = values(group, name)
        if len(numbers) > 1:
            squares.append((len(numbers) - 1) * statistics.variance(numbers))
            freedom += len(numbers) - 1
    if freedom < 2:
        return None
    # `sum` rounds differently from Python 3.12 on.
    return math.sqrt(math.fsum(squares) / freedom)


def seconds_to_match(run: Result, goal: Mapping[str, float | None]) -> float | None:
    """Loop seconds at which a run's curve first has the goal's PSNR, SSIM and LPIPS at once, as far as it has these.

    Infinity if it never has, None if there is no goal or the run was not measured so on its way.
    """
    names = [name for name in DIGITS if goal.get(name) is not None]
    curve = run.get("curve") or []
    if not names or not curve or any(point.get(name) is None for point in curve for name in names):
        return None
    for point in curve:
        if all(_is_as_good(name, point[name], goal[name]) for name in names):
            return point["seconds"]
    return math.inf


def _is_as_good(name: str, value: float, goal: float | None) -> bool:
    """Whether a measure is as good as a goal, which is known; less LPIPS is better, more of the others."""
    assert goal is not None
    if name == "lpips":
        return value <= goal
    return value >= goal


@dataclass(frozen=True)
class Run:
    """A line of a table of runs."""

    scene: str
    name: str
    cell: Cell
    base: Cell = ()
    """The same scenes of the row that the others are compared with; none if there is none."""
    megapixels: float | None = None
    """Of an image."""

    def mean(self, field: str) -> float:
        """Mean over scenes and seeds; raises ValueError if no result has that number."""
        value = mean_over_scenes(self.cell, field)
        if value is None:
            raise ValueError(f"{self.cell[0][0]['key']} has no {field}; leave that column out.")
        return value

    def spread(self, field: str, digits: int) -> str:
        """The mean ± the pooled standard deviation; both numbers of two runs."""
        known = [value for group in self.cell for value in values(group, field)]
        if len(known) == 2 and len(self.cell) == 1:
            return ", ".join(number(value, digits) for value in known)
        text = number(self.mean(field), digits)
        spread = deviation(self.cell, field)
        if spread is None:
            return text
        return f"{text} ± {number(spread, digits)}"

    def seconds(self) -> str:
        """Loop seconds of which three digits count."""
        return _three_digits(self.mean("loop_seconds"))

    def ratio(self, form: Callable[[float], str]) -> str:
        """Loop seconds, relative to those of `base`."""
        seconds = mean_over_scenes(self.base, "loop_seconds")
        if seconds is None:
            return NOTHING
        return form(self.mean("loop_seconds") / seconds)

    def matched(self) -> str:
        """Median of the loop seconds at which runs first match the last quality of `base`; a run of `base` its own."""
        found = []
        for group, base in zip(self.cell, self.base, strict=False):
            goal = {name: mean(base, name) for name in DIGITS}
            for run in group:
                if run.get("loop_seconds") is None:  # It ran on another host.
                    continue
                if any(run is other for other in base):
                    found.append(seconds_to_match(run, run))
                else:
                    found.append(seconds_to_match(run, goal))
        if None in found or not found:
            return NOTHING
        seconds = statistics.median(value for value in found if value is not None)
        if math.isinf(seconds):
            return "never"
        return _three_digits(seconds)

    def views(self) -> list[list[float]]:
        """PSNR of each held-out view of all scenes, over the seeds; raises ValueError if a run does not tell it."""
        runs = [run for group in self.cell for run in group]
        for run in runs:
            if not run.get("view_psnr"):
                raise ValueError(f"{run['key']} has no view_psnr; leave that column out.")
        found = []
        for group in self.cell:
            of_runs = [run["view_psnr"] for run in group]
            found += [list(view) for view in zip(*of_runs, strict=True)]
        return found

    def median_view(self) -> str:
        """Median over views of the means over seeds."""
        return number(statistics.median(map(statistics.fmean, self.views())), 2)

    def worst_view(self) -> str:
        """The lowest PSNR of any view in any run."""
        return number(min(map(min, self.views())), 2)

    def seeds(self) -> str:
        """The least number of runs of a scene, and how many scenes there are if several."""
        seeds = str(min(map(len, self.cell)))
        if len(self.cell) == 1:
            return seeds
        return f"{len(self.cell)} × {seeds}"

    def photos(self) -> str:
        """The scene, and how many training views of what size it has."""
        text = f"{self.scene}: {self.mean('train_views'):.0f}"
        if self.megapixels is None:
            return text
        return f"{text} of {self.megapixels} MP"


def _three_digits(seconds: float) -> str:
    """Seconds with one decimal below 100."""
    if seconds >= 100:
        return number(seconds, 0)
    return number(seconds, 1)


def _spread(field: str, digits: int) -> Callable[[Run], str]:
    return lambda run: run.spread(field, digits)


def _fraction(ratio: float) -> str:
    if ratio == 1:
        return "1"
    return f"1/{1 / ratio:.0f}"


COLUMNS: dict[str, tuple[str, Callable[[Run], str]]] = {
    "scene": ("Scene", lambda run: run.scene),
    "photos": ("Scene: training views", Run.photos),
    "method": ("Method", lambda run: run.name),
    "date": ("Date", lambda run: run.cell[0][0]["date"].split("T")[0]),
    "iterations": ("Iterations", lambda run: f"{run.mean('iterations'):,.0f}"),
    "loop": ("Loop s", _spread("loop_seconds", 1)),
    "seconds": ("Loop s", Run.seconds),
    "ratio": ("Ratio", lambda run: run.ratio(_fraction)),
    "relative": ("Ratio", lambda run: run.ratio("{:.3f}".format)),
    "matched": ("Matched s", Run.matched),
    "psnr": ("PSNR", _spread("psnr", 2)),
    "median": ("Median view", Run.median_view),
    "worst": ("Worst view", Run.worst_view),
    "ssim": ("SSIM", _spread("ssim", 4)),
    "lpips": ("LPIPS", _spread("lpips", 4)),
    "cc_psnr": ("PSNR, colours fitted", _spread("cc_psnr", 2)),
    "cc_ssim": ("SSIM, fitted", _spread("cc_ssim", 4)),
    "cc_lpips": ("LPIPS, fitted", _spread("cc_lpips", 4)),
    "aligned_psnr": ("PSNR, aligned", _spread("aligned_psnr", 2)),
    "aligned_ssim": ("SSIM, aligned", _spread("aligned_ssim", 4)),
    "aligned_lpips": ("LPIPS, aligned", _spread("aligned_lpips", 4)),
    "gain_psnr": ("PSNR, photo's gain", _spread("gain_psnr", 2)),
    "gain_ssim": ("SSIM, photo's gain", _spread("gain_ssim", 4)),
    "gain_lpips": ("LPIPS, photo's gain", _spread("gain_lpips", 4)),
    "moved_iou": ("Moved, overlap", _spread("moved_iou", 2)),
    "moved_share": ("Left out", _spread("moved_share", 4)),
    "moved_wrong": ("Wrongly left out", _spread("moved_wrong", 4)),
    "gaussians": ("Gaussians", lambda run: count(run.mean("gaussians"))),
    "peak": ("Peak GB", lambda run: number(run.mean("peak_gb"), 1)),
    "seeds": ("Seeds", Run.seeds),
}
"""Header and cell of each column of a table of runs."""
WORDS = ("scene", "photos", "method", "date")
_PRINTED = ("scene", "method", "loop", "relative", "matched", "psnr", "median", "worst", "ssim", "lpips", "gaussians")
_PRINTED += ("peak", "seeds")


def of_runs(runs: Iterable[Run], columns: Sequence[str], may_be_missing: Collection[str] = ()) -> str:
    """Return a Markdown table with a line for each run and some of COLUMNS.

    A cell of the first column is empty if it would repeat the one above. A missing number is NOTHING in the columns
    that `may_be_missing` names. Raises ValueError if one is missing elsewhere, or if there is no such column.
    """

    def cell(name: str, run: Run) -> str:
        _, column = COLUMNS[name]
        try:
            return column(run)
        except ValueError:
            if name not in may_be_missing:
                raise
            return NOTHING

    unknown = {*columns} - COLUMNS.keys()
    if unknown:
        raise ValueError(f"there is no column {', '.join(map(repr, unknown))}; there are {', '.join(COLUMNS)}.")
    header = []
    for name in columns:
        title, _ = COLUMNS[name]
        header.append(title)
    lines = []
    above = None
    for run in runs:
        line = [cell(name, run) for name in columns]
        first = line[0]
        if first == above:
            line[0] = ""
        lines.append(line)
        above = first
    words = [name for name in columns if name in WORDS]
    return grid(header, lines, names=len(words))


def markdown(rows: Iterable[Result], reference: str | None = None) -> str:
    """Results as a Markdown table, and under it what is wrong with it: failed runs, shared GPUs, several commits.

    A line is of one scene and label; of several results with one seed the last counts. The label `reference` has the
    loop seconds that are 1 in the column Ratio, and the quality that others match. The sentences also say how much the
    seeds of a label differ over all scenes.
    """
    last = latest(rows)
    grouped = groups(last)
    runs = []
    for (scene, label), group in grouped.items():
        base = grouped.get((scene, reference or ""), [])
        runs.append(Run(scene, label, [group], [base]))
    columns: list[str] = [*_PRINTED]
    if any(row.get("aligned_psnr") is not None for row in last):
        place = columns.index("gaussians")
        columns[place:place] = ["aligned_psnr", "aligned_ssim", "aligned_lpips"]
    if any(row.get("moved_share") is not None for row in last):
        place = columns.index("gaussians")
        columns[place:place] = ["moved_iou", "moved_share", "moved_wrong"]
    lines = [of_runs(runs, columns, may_be_missing=columns)]
    sentences = [*_spreads_over_scenes(grouped), *_faults(last)]
    if sentences:
        lines.append("")
    lines += [f"- {sentence}" for sentence in sentences]
    return "\n".join(lines)


def _spreads_over_scenes(grouped: Groups) -> list[str]:
    """Sentences on how much the seeds of each label differ over all scenes."""
    sentences = []
    for label in dict.fromkeys(label for _, label in grouped):
        cell = [group for (_, other), group in grouped.items() if other == label]
        spread = _deviations(cell)
        if spread != NOTHING and len(cell) > 1:
            sentences.append(
                f"{label}: pooled standard deviation {spread} of PSNR, SSIM and LPIPS over {len(cell)} scenes."
            )
    return sentences


def _faults(rows: Sequence[Result]) -> list[str]:
    """Sentences on failed runs, runs that shared a GPU, and rows of several commits."""
    sentences = []
    commits = set()
    for row in rows:
        error = row.get("error")
        if error:
            sentences.append(f"{row['scene']}, {row['label']}, seed {row['seed']} failed: {error}")
        elif str(row.get("method")).startswith("sadgs"):
            versions = row.get("versions") or {}
            commits.add((versions.get("commit") or "")[:7])
    if any(row.get("jobs_per_gpu", 1) > 1 for row in rows):
        sentences.append("Some runs shared a GPU: their times are not comparable.")
    commits.discard("")
    if len(commits) > 1:
        sentences.append(
            f"The rows of sadgs are of several commits ({', '.join(sorted(commits))}); a run is made again when its "
            "line is deleted."
        )
    return sentences


def of_sweep(found: Groups, labels: Mapping[str, str], scenes: Mapping[str, Sequence[str]]) -> str:
    """A setting a line and scenes as columns: PSNR / SSIM / LPIPS / Gaussians, as differences from the first setting.

    The second line is the pooled standard deviation of all settings' runs; ¹ and ² mark differences with so few seeds
    on one side. `labels` are the names of the rows' labels, and `scenes` the scenes whose mean a column is.
    """
    for label in labels:
        if label not in {other for _, other in found}:
            raise ValueError(f"the rows have no row {label!r}.")
    first, *others = labels
    spreads = []
    for column in scenes.values():
        for scene in column:
            group_of(found, scene, first)
        spreads.append(_deviations([group for label in labels for group in _cell(found, column, label)]))
    bases = [_cell(found, column, first) for column in scenes.values()]
    lines = [[labels[first], *map(_absolute, bases)], ["standard deviation", *spreads]]
    for label in others:
        line = [labels[label]]
        for column, base in zip(scenes.values(), bases, strict=True):
            cell = _cell(found, column, label)
            if all(cell):
                line.append(_difference(cell, base) + _few(cell, base))
            else:
                line.append(NOTHING)
        lines.append(line)
    return grid(["Setting", *scenes], lines)


def _cell(found: Groups, scenes: Iterable[str], label: str) -> Cell:
    """The runs of a label on some scenes; none where there are none."""
    return [found.get((scene, label), []) for scene in scenes]


@dataclass(frozen=True)
class Change:
    """A line of a table of changes: what a change from one label to another does to some scenes, with a text."""

    texts: Sequence[str]
    """Of the columns before the numbers."""
    old: Sequence[Cell]
    """Of each scene, or of each capture that has folds."""
    new: Sequence[Cell]
    remark: str

    def cells(self) -> list[str]:
        """The texts, the least and the most of the differences, the seeds' spread, scenes × seeds, and the remark."""
        if not self.old:
            return [*self.texts, "not measured", NOTHING, NOTHING, self.remark]
        parts = [_difference(*pair).split(" / ") for pair in zip(self.new, self.old, strict=True)]
        ranges = [_range(column) for column in zip(*parts, strict=True)]
        groups = [group for cell in (*self.old, *self.new) for group in cell]
        count = f"{len(self.old)} × {min(map(len, groups))}"
        return [*self.texts, " / ".join(ranges), _deviations(groups), count, self.remark]


def of_changes(changes: Iterable[Change], header: Sequence[str], remark: str) -> str:
    """Changes as a Markdown table, a line each, from the least to the most that a scene changes by."""
    numbers = ["PSNR / SSIM / LPIPS / Gaussians", "Spread", "Scenes × seeds"]
    return grid([*header, *numbers, remark], [change.cells() for change in changes], len(header) + 4)


def group_of(found: Groups, scene: str, label: str) -> Sequence[Result]:
    """The results of a scene and a label; raises ValueError if there are none."""
    if (scene, label) not in found:
        raise ValueError(f"there is no row {label!r} of {scene}.")
    return found[scene, label]


def _absolute(cell: Cell) -> str:
    numbers = [number(mean_over_scenes(cell, field), digits) for field, digits in DIGITS.items()]
    return " / ".join([*numbers, count(mean_over_scenes(cell, "gaussians") or 0)])


def _deviations(cell: Cell) -> str:
    """Those of PSNR, SSIM and LPIPS."""
    spreads = [number(deviation(cell, field), digits) for field, digits in DIGITS.items()]
    if spreads[0] == NOTHING:
        return NOTHING
    return " / ".join(spreads)


def _difference(cell: Cell, base: Cell) -> str:
    parts = []
    for field, digits in DIGITS.items():
        new = mean_over_scenes(cell, field)
        old = mean_over_scenes(base, field)
        if new is None or old is None:
            parts.append(NOTHING)
        else:
            parts.append(number(new - old, digits, signed=True))
    ratio = (mean_over_scenes(cell, "gaussians") or 0) / (mean_over_scenes(base, "gaussians") or 1)
    return " / ".join([*parts, f"×{ratio:.2f}"])


def _few(cell: Cell, base: Cell) -> str:
    """A mark on a difference of fewer than three seeds."""
    return {1: " ¹", 2: " ²"}.get(min(map(len, (*cell, *base))), "")


def _range(differences: Sequence[str]) -> str:
    """The least and the most of differences that are written like those of `_difference`, if all are known."""
    if NOTHING in differences:
        return NOTHING
    ordered = sorted(differences, key=lambda text: float(text.replace("−", "-").lstrip("×")))
    least, most = ordered[0], ordered[-1]
    if least == most:
        return least
    return f"{least} to {most.lstrip('×')}"
