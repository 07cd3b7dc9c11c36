"""The Markdown table of a results file: `python -m benchmarks.table results.jsonl [--reference LABEL]`."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks import results
from benchmarks.results import Result

HEADER = ("Scene", "Method", "Loop s", "Ratio", "PSNR", "SSIM", "LPIPS", "Gaussians", "Peak GB", "Seeds")
_NOTHING = "–"


def markdown(rows: Iterable[Result], reference: str | None = None) -> str:
    """Results as a Markdown table: a line per scene and label, the mean over seeds ± half their range.

    Args:
        rows: Results; of several with one scene, label and seed the last counts. Failed ones are listed below.
        reference: Label whose loop seconds on the same scene are 1 in the column Ratio.

    Returns:
        The table, and under it what is wrong with it, if anything.
    """
    rows = list(rows)
    text = grid(HEADER, cells(rows, reference), names=2)
    return "\n".join([text, *([""] if notes(rows) else []), *(f"- {note}" for note in notes(rows))])


def grid(header: Sequence[str], lines: Iterable[Sequence[str]], names: int = 1) -> str:
    """Cells as a Markdown table.

    Args:
        header: The columns' names.
        lines: Of as many cells as the header.
        names: So many columns, the first ones, are to the left; the others, which hold numbers, are to the right.
    """
    rule = ["---"] * names + ["---:"] * (len(header) - names)
    cells = ([cell.replace("|", "\\|") for cell in line] for line in (header, rule, *lines))
    return "\n".join("| " + " | ".join(line) + " |" for line in cells)


def latest(rows: Iterable[Result]) -> list[Result]:
    """Of several results with one scene, label and seed the last."""
    return list({(row["scene"], row["label"], row["seed"]): row for row in rows}.values())


def groups(rows: Iterable[Result]) -> dict[tuple[str, str], list[Result]]:
    """The latest results that are ok by scene and label, a list of seeds each; scene by scene, as they first appear."""
    found: dict[tuple[str, str], list[Result]] = {}
    for row in latest(rows):
        if row["status"] == "ok":
            found.setdefault((row["scene"], row["label"]), []).append(row)
    scenes = list(dict.fromkeys(scene for scene, _ in found))
    return dict(sorted(found.items(), key=lambda item: scenes.index(item[0][0])))


def cells(rows: Iterable[Result], reference: str | None = None) -> list[tuple[str, ...]]:
    """The table's lines below `HEADER`; arguments as for `markdown`."""
    grouped = groups(rows)
    lines = []
    for (scene, label), group in grouped.items():
        base = mean(grouped.get((scene, reference or ""), []), "loop_seconds")
        loop = mean(group, "loop_seconds")
        lines.append(
            (
                scene,
                label,
                _cell(group, "loop_seconds", ".1f"),
                _NOTHING if base is None or loop is None else f"{loop / base:.3f}",
                _cell(group, "psnr", ".2f"),
                _cell(group, "ssim", ".4f"),
                _cell(group, "lpips", ".4f"),
                _cell(group, "gaussians", ",.0f"),
                _cell(group, "peak_gb", ".2f"),
                str(len(group)),
            )
        )
    return lines


def notes(rows: Iterable[Result]) -> list[str]:
    """What is wrong with the table, a sentence each: runs that failed, what does not compare."""
    last = latest(rows)
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
    return sentences


def _values(group: Iterable[Result], name: str) -> list[float]:
    return [row[name] for row in group if row.get(name) is not None]


def mean(group: Iterable[Result], name: str) -> float | None:
    """Mean of a field over the results that have it; None if none does."""
    values = _values(group, name)
    return sum(values) / len(values) if values else None


def half_range(group: Iterable[Result], name: str) -> float:
    """Half the range of a field over the results that have it, of which there must be one."""
    values = _values(group, name)
    return (max(values) - min(values)) / 2


def _cell(group: list[Result], name: str, form: str) -> str:
    values, average = _values(group, name), mean(group, name)
    if average is None:
        return _NOTHING
    spread = f" ± {half_range(group, name):{form}}" if len(values) > 1 else ""
    return f"{average:{form}}{spread}"


def main() -> None:
    """Print the table of a results file."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.table", description="Print a results file.")
    parser.add_argument("results", type=Path, help="JSON-lines file that python -m benchmarks wrote")
    parser.add_argument("--reference", metavar="LABEL", help="row whose loop seconds are 1 in the column Ratio")
    arguments = parser.parse_args()
    if not arguments.results.exists():
        parser.error(f"{arguments.results} does not exist; give a file that python -m benchmarks wrote.")
    print(markdown(results.read(arguments.results), arguments.reference))


if __name__ == "__main__":
    main()
