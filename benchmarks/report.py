"""`python -m benchmarks report RESULTS.jsonl --output FOLDER`: the plots and the page of a results file."""

from __future__ import annotations

import base64
import importlib.resources
import shlex
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jinja2
from matplotlib.figure import Figure

from benchmarks import command_lines, plots, results, table, views
from benchmarks.plots import Groups
from benchmarks.results import Result

SCENES_A_FIGURE, BARS_A_FIGURE = 4, 12
"""What a printed page holds; the page shows more scenes in several figures, the files in one."""
_SOFTWARE = ("torch", "gsplat", "nerfstudio", "sadgs_ns", "commit")


def load(path: Path, reference: str | None = None) -> list[Result]:
    """The results of a file, at least one of them ok.

    Raises:
        ValueError: No such file, a line that is no result, nothing that is ok, or no row with the label `reference`.
    """
    if not path.is_file():
        raise ValueError(f"{path} is not a file; give one that python -m benchmarks wrote.")
    try:
        rows = results.read(path, strict=True)
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not text; give a file that python -m benchmarks wrote.") from error
    labels = dict.fromkeys(label for _, label in table.groups(rows))
    if not labels:
        raise ValueError(f"{path} has no successful run among its {len(rows)}, so there is nothing to draw.")
    if reference is not None and reference not in labels:
        raise ValueError(f"--reference {reference!r} is no label with a successful run; there are {', '.join(labels)}.")
    return rows


def write(
    rows: list[Result],
    output: Path,
    images: Path | None = None,
    reference: str | None = None,
    title: str = "Benchmark",
    commands: Sequence[str] = (),
    views_a_scene: int = 3,
) -> None:
    """Write the plots and `report.html`; a folder that exists keeps its other files, and on an error all of them.

    Args:
        rows: At least one is ok.
        images: Folder that the results' paths of images are relative to; without it the page shows none.
        reference: As for `table.markdown`.
        commands: Shown as what made the results and the page.

    Raises:
        ValueError: `output` is a file, or as `views.compare`.
    """
    if output.exists() and not output.is_dir():
        raise ValueError(f"--output {output} is a file; name a folder.")
    groups = table.groups(rows)
    looks = plots.styles(label for _, label in groups)
    bars = Counter(scene for scene, _ in groups)
    step = min(max(BARS_A_FIGURE // max(bars.values()), 1), SCENES_A_FIGURE)
    scenes = list(bars)
    chunks = [scenes[i : i + step] for i in range(0, len(scenes), step)]
    parts = [{key: group for key, group in groups.items() if key[0] in chunk} for chunk in chunks]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary, "report")  # of usual permissions, which the copy takes on
        folder.mkdir()
        shown = views.compare(groups, images, folder / "views", views_a_scene) if images else []
        figures = []
        for name, heading, caption, draw in _FIGURES:
            drawn = draw(groups, looks)
            plots.save(drawn, folder / name)
            inline = [plots.svg(drawn if part == groups else draw(part, looks)) for part in parts]
            sources = [f"data:image/svg+xml;base64,{base64.b64encode(svg.encode()).decode()}" for svg in inline]
            figures.append({"name": name, "heading": heading, "caption": caption, "sources": sources})
        page = _template().render(
            title=title,
            commands=commands,
            environments=_environments(rows),
            software=_SOFTWARE,
            methods=_methods(groups),
            reference=reference,
            header=table.HEADER,
            lines=table.cells(rows, reference),
            notes=table.notes(rows),
            figures=figures,
            stages=plots.STAGES,
            seconds=[(key, {name: table.mean(group, name) for name in plots.STAGES}) for key, group in groups.items()],
            views=shown,
        )
        (folder / "report.html").write_text(page, encoding="utf-8")
        shutil.copytree(folder, output, dirs_exist_ok=True)


_FIGURES: tuple[tuple[str, str, str, Callable[[Groups, dict[str, plots.Style]], Figure]], ...] = (
    (
        "quality-time",
        "Quality against training time",
        "Held-out views; large markers are means over seeds at the end of training. A line is the mean of runs that "
        "were evaluated on their way; beginnings far worse than every end are left out.",
        plots.quality_time,
    ),
    (
        "quality-count",
        "Quality against the number of Gaussians",
        "Held-out views at the end of training; large markers are means over seeds. No method gives better quality "
        "with as few Gaussians as one on the Pareto front.",
        plots.quality_count,
    ),
    (
        "time-breakdown",
        "Where the time goes",
        "Means over seeds. Evaluation, and the compilation of kernels, which a machine does once, are left out.",
        lambda groups, _: plots.time_breakdown(groups),
    ),
)


def _environments(rows: list[Result]) -> list[dict[str, Any]]:
    """What machines and software the runs had, with the number of runs and their first and last date."""
    found: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in table.latest(rows):
        versions = row.get("versions") or {}
        same = {"gpu": row.get("gpu"), "jobs_per_gpu": row.get("jobs_per_gpu")}
        same |= {name: versions.get(name) for name in _SOFTWARE}
        entry = found.setdefault(tuple(same.values()), {**same, "runs": 0, "dates": []})
        entry["runs"] += 1
        entry["dates"] = sorted({*entry["dates"], *([row["date"][:10]] if row.get("date") else [])})
    return list(found.values())


def _methods(groups: Groups) -> list[dict[str, Any]]:
    """What each label stands for: one entry, or one for each of the settings it had."""
    names = ("label", "method", "iterations", "overrides")
    found: list[dict[str, Any]] = []
    for group in groups.values():
        for row in group:
            if (entry := {name: row.get(name) for name in names}) not in found:
                found.append(entry)
    return found


def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    source = importlib.resources.files("benchmarks").joinpath("report.html.j2")
    return environment.from_string(source.read_text(encoding="utf-8"))


def main(argv: Sequence[str] | None = None) -> int:
    """Write the plots and the page of a results file.

    Returns:
        Exit code: 0, or 2 if the input is wrong.
    """
    argv = sys.argv[1:] if argv is None else argv
    arguments = command_lines.report().parse_args(argv)
    commands = [
        *([arguments.command] if arguments.command else []),
        shlex.join(["python -m benchmarks", "report", *argv]),
    ]
    try:
        if arguments.views < 1:
            raise ValueError(f"--views must be 1 or more, not {arguments.views}.")
        rows = load(arguments.results, arguments.reference)
        write(rows, arguments.output, arguments.images, arguments.reference, arguments.title, commands, arguments.views)
    except (ValueError, OSError) as error:
        print(f"python -m benchmarks report: {error}", file=sys.stderr)
        return 2
    print(arguments.output / "report.html")
    return 0


if __name__ == "__main__":
    sys.exit(main())
