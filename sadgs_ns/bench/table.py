"""The Markdown table of a results file: `python -m sadgs_ns.bench.table results.jsonl [--reference LABEL]`."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

from sadgs_ns.bench import results
from sadgs_ns.bench.results import Result

_HEADER = ("Scene", "Method", "Loop s", "Ratio", "PSNR", "SSIM", "LPIPS", "Gaussians", "Peak GB", "Seeds")
_NOTHING = "–"


def markdown(rows: Iterable[Result], reference: str | None = None) -> str:
    """Results as a Markdown table: a line per scene and label, the mean over seeds ± half their range.

    Args:
        rows: Results; of several with one scene, label and seed the last counts. Failed ones are listed below.
        reference: Label whose loop seconds on the same scene are 1 in the column Ratio.

    Returns:
        The table, and under it what is wrong with it, if anything.
    """
    latest = {(row["scene"], row["label"], row["seed"]): row for row in rows}.values()
    groups: dict[tuple[str, str], list[Result]] = {}
    for row in latest:
        if row["status"] == "ok":
            groups.setdefault((row["scene"], row["label"]), []).append(row)
    lines = [_HEADER, ("---", "---", *["---:"] * (len(_HEADER) - 2))]
    for scene in dict.fromkeys(scene for scene, _ in groups):
        for label in [label for s, label in groups if s == scene]:
            group = groups[scene, label]
            base = _mean(groups.get((scene, reference or ""), []), "loop_seconds")
            loop = _mean(group, "loop_seconds")
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
    text = "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
    notes = [f"- {r['scene']}, {r['label']}, seed {r['seed']} failed: {r['error']}" for r in latest if r["error"]]
    if any(row.get("jobs_per_gpu", 1) > 1 for row in latest):
        notes.append("- Some runs shared a GPU: their times are not comparable.")
    return text + ("\n\n" + "\n".join(notes) if notes else "")


def _values(group: list[Result], name: str) -> list[float]:
    return [row[name] for row in group if row.get(name) is not None]


def _mean(group: list[Result], name: str) -> float | None:
    values = _values(group, name)
    return sum(values) / len(values) if values else None


def _cell(group: list[Result], name: str, form: str) -> str:
    values, mean = _values(group, name), _mean(group, name)
    if mean is None:
        return _NOTHING
    spread = f" ± {(max(values) - min(values)) / 2:{form}}" if len(values) > 1 else ""
    return f"{mean:{form}}{spread}"


def main() -> None:
    """Print the table of a results file."""
    parser = argparse.ArgumentParser(prog="python -m sadgs_ns.bench.table", description="Print a results file.")
    parser.add_argument("results", type=Path, help="JSON-lines file that sadgs-bench wrote")
    parser.add_argument("--reference", metavar="LABEL", help="row whose loop seconds are 1 in the column Ratio")
    arguments = parser.parse_args()
    if not arguments.results.exists():
        parser.error(f"{arguments.results} does not exist; give a file that sadgs-bench wrote.")
    print(markdown(results.read(arguments.results), arguments.reference))


if __name__ == "__main__":
    main()
