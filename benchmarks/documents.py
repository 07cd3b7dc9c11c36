"""`python -m benchmarks documents`: tables of README.md and docs/*.md, and some figures, from the rows in docs/results.

A table stands between `<!-- table: NAME -->` and `<!-- end -->`. What it is made of is in docs/results/tables.yaml:

    megapixels: {fox: 0.68}
    tables:
      main:                     # a run a line; several seeds are a mean ± half their range
        kind: runs
        columns: [scene, method, loop, ratio, psnr]
        lines:
          - {rows: beside.jsonl, scenes: [fox], labels: {splatfacto: splatfacto, ours: sadgs}, reference: splatfacto}
      thresholds:               # a setting a line, as its difference from the first one
        kind: sweep
        rows: [sweep.jsonl]
        labels: {T1: × 1, T2: × 2}
        scenes: {fox: [fox], castle: [castle, castle-2]}   # a column each, of the mean of these scenes
      storage: {kind: approximations, rows: approximations.jsonl, table: structure_tensor, input: demo}
      growth: {kind: growth, rows: growth.csv}
    figures:
      peers-time:               # docs/figures/peers-time.png, quality against the field `cost`, a run a point
        cost: loop_seconds
        parts: [{rows: peers.jsonl, scenes: [fox], labels: {splatfacto: splatfacto}}]
        elsewhere: [{rows: ours.jsonl, scenes: [fox], labels: {ours: sadgs}}]

Labels are those of the rows, with the name that the table gives them, or the figure, where names of one method begin
with the same word. A figure holds the points that it was drawn from, which are compared, since pixels depend on
matplotlib's version.
"""

from __future__ import annotations

import dataclasses
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

from benchmarks import command_lines, plots
from benchmarks.document_tables import KINDS, RESULTS, Figure, Table, described
from sadgs_ns.atomic import atomic_path

FIGURES = Path("docs", "figures")
"""Folder of the figures, in a checkout."""
TABLES = "tables.yaml"
_MARKED = re.compile(r"^<!-- table: (\S+) -->\n(.*?)^<!-- end -->$", re.MULTILINE | re.DOTALL)
_OPENED = re.compile(r"^<!-- (?:table: \S+|end) -->$", re.MULTILINE)


@dataclass(frozen=True)
class Catalogue:
    """What tables.yaml holds."""

    megapixels: Mapping[str, float]
    """Of an image of each scene."""
    tables: Mapping[str, Table]
    figures: Mapping[str, Figure] = dataclasses.field(default_factory=dict)


def read_catalogue(path: Path) -> Catalogue:
    """Read tables.yaml.

    Raises:
        ValueError: It cannot be read, or is not what this module's docstring shows.
    """
    try:
        content = yaml.safe_load(path.read_text("utf-8"))
        tables = {}
        for name, table in described(Catalogue, content).tables.items():
            kind = table.pop("kind", None)
            if kind not in KINDS:
                raise ValueError(f"table {name}: kind is {kind!r}; give one of {', '.join(KINDS)}.")
            tables[name] = described(KINDS[kind], table)
        figures = {name: described(Figure, figure) for name, figure in content.get("figures", {}).items()}
        return Catalogue(content["megapixels"], tables, figures)
    except OSError as error:
        raise ValueError(f"{path} cannot be read ({error.strerror}); give the folder of a checkout.") from error
    except (AttributeError, TypeError) as error:
        raise ValueError(f"{path}: tables must be a mapping of names to mappings.") from error
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is not YAML: {' '.join(str(error).split())}.") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def write(checkout: Path, check: bool = False) -> list[str]:
    """Write the tables and figures of a checkout's documents, none where one of them is described wrongly.

    Args:
        checkout: Folder of README.md and docs.
        check: Write nothing.

    Returns:
        `DOCUMENT: table NAME` of each table that is not what its rows give, or was not, and files of such figures.

    Raises:
        ValueError: A table without description, rows or end, a description without a table, or rows that no table has.
        WriteError: If a document cannot be written.
    """
    folder = checkout / RESULTS
    catalogue = read_catalogue(folder / TABLES)
    documents = [path for path in (checkout / "README.md", *sorted((checkout / "docs").glob("*.md"))) if path.exists()]
    texts, changed, used = {}, [], set()
    for path in documents:
        text = path.read_text("utf-8")
        if len(_OPENED.findall(text)) != 2 * len(_MARKED.findall(text)):
            raise ValueError(f"{path}: each `<!-- table: NAME -->` needs one `<!-- end -->` after it.")

        def replaced(match: re.Match[str], path: Path = path) -> str:
            name = match[1]
            if name not in catalogue.tables:
                raise ValueError(f"{path}: table {name} is not in {folder / TABLES}.")
            used.add(name)
            try:
                new = f"\n{catalogue.tables[name].text(folder, catalogue.megapixels)}\n\n"
            except ValueError as error:
                raise ValueError(f"{path}: table {name}: {error}") from error
            except (AttributeError, KeyError, TypeError) as error:
                raise ValueError(
                    f"{path}: table {name}: its description or rows are not as expected ({error!r})."
                ) from error
            if new != match[2]:
                changed.append(f"{path}: table {name}")
            return f"<!-- table: {name} -->\n{new}<!-- end -->"

        texts[path] = _MARKED.sub(replaced, text)
    if spare := catalogue.tables.keys() - used:
        raise ValueError(f"{folder / TABLES}: no document holds {', '.join(sorted(spare))}; delete what none needs.")
    drawn = {}
    for name, figure in catalogue.figures.items():
        path = checkout / FIGURES / f"{name}.png"
        try:
            points = figure.points(folder)
            if plots.drawn_points(path) != plots.as_text(figure.cost, points):
                drawn[path] = (figure.cost, points)
        except (ValueError, AttributeError, KeyError, TypeError) as error:
            raise ValueError(f"{folder / TABLES}: figure {name}: {error}") from error
    made = (*catalogue.tables.values(), *catalogue.figures.values())
    cited = {TABLES, *(file for one in made for file in one.files())}
    if spare := {path.name for path in folder.iterdir()} - cited:
        raise ValueError(f"{folder}: no table is made of {', '.join(sorted(spare))}; delete what none needs.")
    for path, text in {} if check else texts.items():
        if text != path.read_text("utf-8"):
            with atomic_path(path) as partial:
                partial.write_text(text, "utf-8")
    for path, (cost, points) in {} if check else drawn.items():
        with atomic_path(path) as partial:
            plots.save_peers(cost, points, partial)
    return [*changed, *map(str, drawn)]


def main(argv: Sequence[str] | None = None) -> int:
    """Write the tables, or check them.

    Returns:
        Exit code: 0, 1 if `--check` found a table that is not what its rows give, 2 if the input is wrong.
    """
    given = command_lines.documents().parse_args(argv)
    try:
        changed = write(given.checkout, given.check)
    except (ValueError, OSError) as error:
        print(f"python -m benchmarks documents: {error}", file=sys.stderr)
        return 2
    for name in changed:
        print(
            f"{name} is not what its rows give; run python -m benchmarks documents."
            if given.check
            else f"{name} is written."
        )
    return int(given.check and bool(changed))


if __name__ == "__main__":
    sys.exit(main())
