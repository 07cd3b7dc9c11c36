"""Results as Markdown tables, of a results file or of the rows that the documents cite, and plots of a results file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from benchmarks import results
from benchmarks.results import Result

Groups = Mapping[tuple[str, str], Sequence[Result]]
"""Results that are ok by scene and label, one a seed."""
NOTHING = "–"
DIGITS = {"psnr": 2, "ssim": 4, "lpips": 4}


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


def grid(header: Sequence[str], lines: Iterable[Sequence[str]], names: int = 1) -> str:
    """Cells as a Markdown table; the first `names` columns are aligned to the left, the others to the right."""
    rule = ["---"] * names + ["---:"] * (len(header) - names)
    cells = ([cell.replace("|", "\\|") for cell in line] for line in (header, rule, *lines))
    return "\n".join("| " + " | ".join(line) + " |" for line in cells)


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
    """A field, `phases.loss` being one of a field's, of the results that have it."""
    field, _, inner = name.partition(".")
    found = [(row.get(field) or {}).get(inner) if inner else row.get(field) for row in group]
    return [value for value in found if value is not None]


def mean(group: Iterable[Result], name: str) -> float | None:
    """Mean of a field over the results that have it; None if none does."""
    known = values(group, name)
    return sum(known) / len(known) if known else None


def half_range(group: Iterable[Result], name: str) -> float:
    """Half the range of a field over the results that have it, of which there must be one."""
    known = values(group, name)
    return (max(known) - min(known)) / 2


@dataclass(frozen=True)
class Run:
    """A line of a table of runs."""

    scene: str
    name: str
    group: Sequence[Result]
    """A result for each seed."""
    base: Sequence[Result] = ()
    """The same of the row whose loop is the measure; none if there is none."""
    megapixels: float | None = None
    """Of an image."""

    def mean(self, field: str) -> float:
        """Mean over the seeds; raises ValueError if no result has that number."""
        if (value := mean(self.group, field)) is None:
            raise ValueError(f"{self.group[0]['key']} has no {field}; leave that column out.")
        return value

    def spread(self, field: str, digits: int) -> str:
        """The mean ± half the range of the seeds."""
        several = len(values(self.group, field)) > 1
        spread = f" ± {number(half_range(self.group, field), digits)}" if several else ""
        return number(self.mean(field), digits) + spread

    def seconds(self) -> str:
        """Loop seconds of which three digits count."""
        return number(self.mean("loop_seconds"), 0 if self.mean("loop_seconds") >= 100 else 1)

    def ratio(self, form: Callable[[float], str]) -> str:
        """Loop seconds, relative to those of `base`."""
        seconds = mean(self.base, "loop_seconds")
        return NOTHING if seconds is None else form(self.mean("loop_seconds") / seconds)

    def photos(self) -> str:
        """The scene, and how many training views of what size it has."""
        size = "" if self.megapixels is None else f" of {self.megapixels} MP"
        return f"{self.scene}: {self.mean('train_views'):.0f}{size}"


def _spread(field: str, digits: int) -> Callable[[Run], str]:
    return lambda run: run.spread(field, digits)


def _fraction(ratio: float) -> str:
    return "1" if ratio == 1 else f"1/{1 / ratio:.0f}"


COLUMNS: dict[str, tuple[str, Callable[[Run], str]]] = {
    "scene": ("Scene", lambda run: run.scene),
    "photos": ("Scene: training views", Run.photos),
    "method": ("Method", lambda run: run.name),
    "date": ("Date", lambda run: run.group[0]["date"].split("T")[0]),
    "iterations": ("Iterations", lambda run: f"{run.mean('iterations'):,.0f}"),
    "loop": ("Loop s", _spread("loop_seconds", 1)),
    "seconds": ("Loop s", Run.seconds),
    "ratio": ("Ratio", lambda run: run.ratio(_fraction)),
    "relative": ("Ratio", lambda run: run.ratio("{:.3f}".format)),
    "psnr": ("PSNR", _spread("psnr", 2)),
    "ssim": ("SSIM", _spread("ssim", 4)),
    "lpips": ("LPIPS", _spread("lpips", 4)),
    "cc_psnr": ("PSNR, colours fitted", _spread("cc_psnr", 2)),
    "cc_ssim": ("SSIM, fitted", _spread("cc_ssim", 4)),
    "cc_lpips": ("LPIPS, fitted", _spread("cc_lpips", 4)),
    "gaussians": ("Gaussians", lambda run: count(run.mean("gaussians"))),
    "peak": ("Peak GB", _spread("peak_gb", 1)),
    "seeds": ("Seeds", lambda run: str(len(run.group))),
}
"""Header and cell of each column of a table of runs."""
WORDS = ("scene", "photos", "method", "date")
_PRINTED = ("scene", "method", "loop", "relative", "psnr", "ssim", "lpips", "gaussians", "peak", "seeds")


def of_runs(runs: Iterable[Run], columns: Sequence[str | Sequence[str]], strict: bool = True) -> str:
    """Runs as a Markdown table, a line each.

    The columns are names of COLUMNS, or a header and a field of seconds or milliseconds each. Raises ValueError if
    there is no such column or, with `strict`, a number is missing.
    """

    def cell(column: Callable[[Run], str], run: Run) -> str:
        try:
            return column(run)
        except ValueError:
            if strict:
                raise
            return NOTHING

    if unknown := {name for name in columns if isinstance(name, str)} - COLUMNS.keys():
        raise ValueError(f"there is no column {', '.join(map(repr, unknown))}; there are {', '.join(COLUMNS)}.")
    known = [COLUMNS[name] if isinstance(name, str) else (name[0], _spread(name[1], 1)) for name in columns]
    lines = ([cell(column, run) for _, column in known] for run in runs)
    return grid([header for header, _ in known], lines, sum(name in WORDS for name in columns))


def markdown(rows: Iterable[Result], reference: str | None = None) -> str:
    """Results as a Markdown table, and under it what is wrong with it: failed runs, shared GPUs, several commits.

    A line is the mean over seeds ± half their range of one scene and label; of several results with one seed the last
    counts. The label `reference` has the loop seconds that are 1 in the column Ratio.
    """
    last = latest(rows)
    grouped = groups(last)
    bases = {scene: grouped.get((scene, reference or ""), []) for scene, _ in grouped}
    runs = [Run(scene, label, group, bases[scene]) for (scene, label), group in grouped.items()]
    sentences = [f"{r['scene']}, {r['label']}, seed {r['seed']} failed: {r['error']}" for r in last if r.get("error")]
    if any(row.get("jobs_per_gpu", 1) > 1 for row in last):
        sentences.append("Some runs shared a GPU: their times are not comparable.")
    ours = [row for row in last if str(row.get("method")).startswith("sadgs") and not row.get("error")]
    commits = {commit[:7] for row in ours if (commit := (row.get("versions") or {}).get("commit"))}
    if len(commits) > 1:
        sentences.append(
            f"The rows of sadgs are of several commits ({', '.join(sorted(commits))}); a run is made again when its "
            "line is deleted."
        )
    text = of_runs(runs, _PRINTED, strict=False)
    return "\n".join([text, *([""] if sentences else []), *(f"- {sentence}" for sentence in sentences)])


def of_sweep(found: Groups, labels: Mapping[str, str], scenes: Mapping[str, Sequence[str]]) -> str:
    """A setting a line and scenes as columns: PSNR / SSIM / LPIPS / Gaussians, as differences from the first setting.

    The second line is half the range of the first one's runs, and ¹ marks differences from or to a single run. `labels`
    are the names of the rows' labels, and `scenes` the scenes whose mean a column is.
    """
    for label in labels:
        if label not in {other for _, other in found}:
            raise ValueError(f"the rows have no row {label!r}.")
    (first, name), *others = labels.items()
    bases = [[group_of(found, scene, first) for scene in column] for column in scenes.values()]
    lines = [[name, *map(_absolute, bases)]]
    if any(len(group) > 1 for base in bases for group in base):
        lines.append(["half the range of its runs", *map(_spreads, bases)])
    for label, name in others:
        settings = [[found.get((scene, label), []) for scene in column] for column in scenes.values()]
        lines.append([name, *(_difference(*pair) for pair in zip(settings, bases, strict=True))])
    return grid(["Setting", *scenes], lines)


def group_of(found: Groups, scene: str, label: str) -> Sequence[Result]:
    """The results of a scene and a label; raises ValueError if there are none."""
    if (scene, label) not in found:
        raise ValueError(f"there is no row {label!r} of {scene}.")
    return found[scene, label]


def _means(cell: Sequence[Sequence[Result]], field: str) -> float | None:
    """Mean over scenes of the means over seeds."""
    known = [value for group in cell if (value := mean(group, field)) is not None]
    return sum(known) / len(known) if len(known) == len(cell) else None


def _absolute(cell: Sequence[Sequence[Result]]) -> str:
    numbers = [number(_means(cell, field), digits) for field, digits in DIGITS.items()]
    return " / ".join([*numbers, count(_means(cell, "gaussians") or 0)])


def _spreads(cell: Sequence[Sequence[Result]]) -> str:
    if any(len(group) < 2 for group in cell):
        return NOTHING
    spreads = {field: sum(half_range(group, field) for group in cell) / len(cell) for field in DIGITS}
    return " / ".join(number(spreads[field], digits) for field, digits in DIGITS.items())


def _difference(cell: Sequence[Sequence[Result]], base: Sequence[Sequence[Result]]) -> str:
    if not all(cell):
        return NOTHING
    parts = []
    for field, digits in DIGITS.items():
        new, old = _means(cell, field), _means(base, field)
        parts.append(NOTHING if new is None or old is None else number(new - old, digits, signed=True))
    ratio = (_means(cell, "gaussians") or 0) / (_means(base, "gaussians") or 1)
    single = any(len(group) < 2 for group in (*cell, *base))
    return " / ".join([*parts, f"×{ratio:.2f}"]) + (" ¹" if single else "")


def of_growth(rows: Sequence[Mapping[str, Any]]) -> str:
    """Milliseconds of steps of some numbers of Gaussians, in images of some sizes."""
    lines = (
        (f"{row['gaussians']:,.0f}", f"{row['megapixels']:g}", number(row["ours_ms"], 2), number(row["gsplat_ms"], 2),
         f"{row['gsplat_ms'] / row['ours_ms']:.1f}")
        for row in rows
    )  # fmt: skip
    return grid(["Gaussians", "Megapixels", "Ours, ms", "gsplat and torch, ms", "Ratio"], lines, names=0)


def _short(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.2g}"


_ERRORS = {"median": "{}, median", "p95": "{}, 95 %", "max": "{}, max", "flips": "η > 1 flips"}
APPROXIMATIONS: dict[str, dict[str, str]] = {
    "structure_tensor": {
        "bytes": "Bytes/px", **{name: header.format("Λ") for name, header in _ERRORS.items()}, "ms": "ms an image"
    },
    "footprint": {**{name: header.format("η") for name, header in _ERRORS.items()}, "ms": "ms a view"},
}  # fmt: skip
"""Headers of the numbers of the tables that `approximations` measures."""


def of_approximations(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows of one of `approximations`' tables; a number that is None is a dash."""

    def cell(name: str, value: float | None) -> str:
        return NOTHING if value is None else f"{_short(100 * value)} %" if name in _ERRORS else _short(value)

    columns = APPROXIMATIONS[rows[0]["table"]]
    lines = ((row["variant"], *(cell(name, row[name]) for name in columns)) for row in rows)
    return grid(("Variant", *columns.values()), lines)


@dataclass
class Command:
    """Print the table of a results file, and plot quality against time and the number of Gaussians."""

    results: Positional[Path]
    """JSON-lines file that python -m benchmarks wrote"""
    reference: str | None = None
    """label of the row whose loop seconds are 1 in the column Ratio"""
    plots: Path | None = None
    """folder that takes quality-time.png and quality-count.png"""

    def __call__(self) -> int:
        rows = results.read(self.results)
        grouped = groups(latest(rows))
        if not grouped:
            raise ValueError(f"{self.results} has no successful run among its {len(rows)}.")
        labels = dict.fromkeys(label for _, label in grouped)
        if self.reference is not None and self.reference not in labels:
            raise ValueError(f"--reference {self.reference!r} is no label of these: {', '.join(labels)}.")
        print(markdown(rows, self.reference))
        if self.plots is not None:
            from benchmarks import plots

            self.plots.mkdir(parents=True, exist_ok=True)
            for name, cost in (("quality-time", "loop_seconds"), ("quality-count", "gaussians")):
                plots.save(plots.quality(grouped.items(), cost), self.plots / f"{name}.png")
        return 0
