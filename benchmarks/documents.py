"""`python -m benchmarks documents`: tables of README.md and docs/*.md, and some figures, from the rows in docs/results.

A table stands between `<!-- table: NAME -->` and `<!-- end -->`. What it is made of is in docs/results/tables.yaml:

    megapixels: {fox: 0.68}
    tables: {NAME: {kind: runs, …}}     # of the methods of `Source`
    figures: {NAME: {kind: peers, …}}   # of those whose names end in `_drawn`: docs/figures/NAME.png

`kind` is the method and the other keys are its arguments, `lines` being those of `Source.lines`. Labels are those of
the rows, with the name that the table gives them, or the figure, where names of one method begin with the same word. A
figure holds a digest of what it was drawn from, which is compared, since pixels depend on matplotlib's version.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from tyro.conf import Positional

from benchmarks import camera_table, chain_table, kernel_table, table
from benchmarks.table import Change, Run
from sadgs_ns.files import atomic_path

RESULTS = Path("docs", "results")
"""Folder of the rows in a checkout."""
FIGURES = Path("docs", "figures")
"""Folder of the figures in a checkout."""
TABLES = "tables.yaml"
"""Name of the description among the rows."""
Scenes = Sequence[str] | Mapping[str, Sequence[str]]
"""Scenes, or names with the scenes that each is the mean of, as those of a capture that hold out other views."""
_MARKED = re.compile(r"^<!-- table: (\S+) -->\n(.*?)^<!-- end -->$", re.MULTILINE | re.DOTALL)
_OPENED = re.compile(r"^<!-- (?:table: \S+|end) -->$", re.MULTILINE)


@dataclass
class Source:
    """The rows of a folder, and the tables and the data of figures that are made of them."""

    folder: Path
    megapixels: Mapping[str, float]
    """Of an image of each scene."""
    cited: set[str] = field(default_factory=lambda: {TABLES})
    """Names of the files that were read."""

    def read(self, *names: str) -> list[dict[str, Any]]:
        """Return the rows of files in the folder, one file after the other; raises ValueError if a file is missing."""
        self.cited.update(names)
        rows: list[dict[str, Any]] = []
        for name in names:
            path = self.folder / name
            if not path.is_file():
                raise ValueError(f"{path} is not there; rows lie in docs/results.")
            lines = path.read_text("utf-8").splitlines()
            rows += [json.loads(line) for line in lines]
        return rows

    def groups(self, rows: str | Sequence[str]) -> table.Groups:
        """The rows of a file, or of several, by scene and label."""
        names = rows
        if isinstance(names, str):
            names = [names]
        return table.groups(self.read(*names))

    def lines(
        self, rows: str | Sequence[str], scenes: Scenes, labels: Mapping[str, str], reference: str | None = None
    ) -> list[Run]:
        """Of each scene, or capture with folds, a run for each label; the others are compared with `reference`."""
        found = self.groups(rows)
        runs = []
        for scene, folds in folds_of(scenes).items():
            base = []
            if reference is not None:
                base = [table.group_of(found, fold, reference) for fold in folds]
            for label, name in labels.items():
                cell = [table.group_of(found, fold, label) for fold in folds]
                runs.append(Run(scene, name, cell, base, self.megapixels.get(scene)))
        return runs

    def runs(
        self, columns: Sequence[str], lines: Sequence[Mapping[str, Any]], may_be_missing: Sequence[str] = ()
    ) -> str:
        """A run a line, which may lack the numbers of some columns."""
        runs = [run for line in lines for run in self.lines(**line)]
        return table.of_runs(runs, columns, may_be_missing)

    def change(
        self,
        texts: Sequence[str],
        remark: str,
        rows: Sequence[str] = (),
        change: tuple[str, str] = ("", ""),
        scenes: Scenes = (),
    ) -> Change:
        """What changing from one label to another does to scenes, or to captures with folds."""
        found = self.groups(rows)
        before, after = change
        old = []
        new = []
        for folds in folds_of(scenes).values():
            old.append([table.group_of(found, fold, before) for fold in folds])
            new.append([table.group_of(found, fold, after) for fold in folds])
        return Change(texts, old, new, remark)

    def changes(self, header: Sequence[str], remark: str, lines: Sequence[Mapping[str, Any]]) -> str:
        """A change a line."""
        changes = [self.change(**line) for line in lines]
        return table.of_changes(changes, header, remark)

    def sweep(self, rows: Sequence[str], labels: Mapping[str, str], scenes: Mapping[str, Sequence[str]]) -> str:
        """A setting a line."""
        found = self.groups(rows)
        return table.of_sweep(found, labels, scenes)

    def kernels(self, rows: str) -> str:
        """What `benchmarks.kernel_share` measured, a line for each kernel."""
        return kernel_table.markdown(self.read(rows))

    def startup(self, rows: str) -> str:
        """What `benchmarks.startup` measured, a line for each way to start."""
        from benchmarks import startup  # It imports matplotlib, which takes a second.

        return startup.markdown(self.read(rows))

    def chain(self, rows: str, labels: Mapping[str, str]) -> str:
        """What `benchmarks.chain` measured, a line for each capture and label."""
        return chain_table.markdown(self.read(rows), labels)

    def cameras(self, rows: str, labels: Mapping[str, str]) -> str:
        """What `benchmarks.cameras` measured of captures, a line for each capture, label and variant."""
        return camera_table.markdown(self.read(rows), labels)

    def true_cameras(self, rows: str, labels: Mapping[str, str]) -> str:
        """What `benchmarks.cameras` measured of drawn captures, a line for each, label and variant."""
        return camera_table.markdown_of_truths(self.read(rows), labels)

    def peers_drawn(self, lines: Sequence[Mapping[str, Any]], elsewhere: Sequence[Mapping[str, Any]] = ()) -> list[Any]:
        """Arguments of `plots.peers`."""
        runs = [(run, True) for line in lines for run in self.lines(**line)]
        runs += [(run, False) for line in elsewhere for run in self.lines(**line)]
        points = []
        for run, here in runs:
            means = [run.mean(name) for name in ("loop_seconds", "psnr", "lpips")]
            points.append((run.name, here, *means))
        return [points]

    def quality_drawn(
        self,
        rows: str | Sequence[str],
        scenes: Sequence[str],
        labels: Mapping[str, str],
        joined: Mapping[str, Sequence[str]] | None = None,
        joined_scenes: Sequence[str] = (),
    ) -> list[Any]:
        """Return the arguments of `plots.quality`.

        Args:
            rows: The file of the rows, or several.
            scenes: The scenes to draw.
            labels: The labels to draw in each scene, and their names in the figure.
            joined: Names in the figure, and for each the labels whose runs one line joins.
            joined_scenes: The scenes that have these lines.
        """
        found = self.groups(rows)
        joined = joined or {}
        named = []
        for scene in scenes:
            for label, name in labels.items():
                results = table.group_of(found, scene, label)
                named.append(((scene, name), results))
            if scene not in joined_scenes:
                continue
            for name, joined_labels in joined.items():
                joined_results: list[Any] = []
                for label in joined_labels:
                    joined_results += table.group_of(found, scene, label)
                named.append(((scene, name), joined_results))
        return [named, list(joined)]


def folds_of(scenes: Scenes) -> Mapping[str, Sequence[str]]:
    """Names with the scenes that each is the mean of."""
    if isinstance(scenes, Mapping):
        return scenes
    return {scene: [scene] for scene in scenes}


def made(source: Source, what: str, name: str, description: Any) -> Any:
    """The text of a described `table`, or the arguments of a described `figure`'s function in `plots`.

    Raises ValueError, one sentence, if the description is wrong or a row lacks what it names.
    """
    try:
        options = dict(description)
        method = options.pop("kind")
        if what == "figure":
            method = f"{method}_drawn"
        return getattr(source, method)(**options)
    except ValueError as error:
        raise ValueError(f"{what} {name}: {error}") from error
    except (AttributeError, KeyError, TypeError) as error:
        raise ValueError(f"{what} {name}: its description or rows are not as expected ({error}).") from error


def described(folder: Path) -> tuple[Source, dict[str, Any], dict[str, Any]]:
    """The rows in a folder, and the descriptions of tables and figures by their names; raises ValueError."""
    try:
        content = yaml.safe_load((folder / TABLES).read_text("utf-8"))
        return Source(folder, content["megapixels"]), dict(content["tables"]), dict(content.get("figures", {}))
    except OSError as error:
        raise ValueError(f"{folder / TABLES} cannot be read ({error.strerror}); give a checkout's folder.") from error
    except (yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError) as error:
        told = " ".join(str(error).split())
        raise ValueError(f"{folder / TABLES} must be YAML with mappings of megapixels and tables: {told}.") from error


def write(checkout: Path, check: bool = False) -> list[str]:
    """Write the tables and figures of a checkout's documents, or only `check` them.

    Returns `DOCUMENT: table NAME` of each table that was not what its rows give, and files of such figures.

    Raises:
        ValueError: A table without description, rows or end, a description without a table, or rows that no table has;
            nothing is written then.
        WriteError: A document cannot be written.
    """
    folder = checkout / RESULTS
    source, tables, figures = described(folder)
    new = {name: f"\n{made(source, 'table', name, description)}\n\n" for name, description in tables.items()}
    drawn = {name: made(source, "figure", name, description) for name, description in figures.items()}
    spare = {path.name for path in folder.iterdir()} - source.cited
    if spare:
        raise ValueError(f"{folder}: no table is made of {', '.join(sorted(spare))}; delete what none needs.")
    texts = {}
    changed = []
    used = set()
    for path in _documents(checkout):
        text = path.read_text("utf-8")
        for name, old in _marked(path, text):
            if name not in new:
                raise ValueError(f"{path}: table {name} is not in {folder / TABLES}.")
            used.add(name)
            if new[name] != old:
                changed.append(f"{path}: table {name}")
        texts[path] = _MARKED.sub(lambda match: f"<!-- table: {match[1]} -->\n{new[match[1]]}<!-- end -->", text)
    unused = tables.keys() - used
    if unused:
        raise ValueError(f"{folder / TABLES}: no document holds {', '.join(sorted(unused))}; delete what none needs.")
    if not check:
        _write_texts(texts)
    for name, arguments in drawn.items():
        path = checkout / FIGURES / f"{name}.png"
        if _draw(path, figures[name]["kind"], arguments, check):
            changed.append(str(path))
    return changed


def _documents(checkout: Path) -> list[Path]:
    """The documents of a checkout that are there."""
    paths = [checkout / "README.md", *sorted((checkout / "docs").glob("*.md"))]
    return [path for path in paths if path.exists()]


def _marked(path: Path, text: str) -> list[tuple[str, str]]:
    """Names and texts of the tables that stand in a document; raises ValueError if one has no end."""
    marked = _MARKED.findall(text)
    if len(_OPENED.findall(text)) != 2 * len(marked):
        raise ValueError(f"{path}: each `<!-- table: NAME -->` needs one `<!-- end -->` after it.")
    return marked


def _write_texts(texts: Mapping[Path, str]) -> None:
    """Write the documents whose text is another one; raises WriteError."""
    for path, text in texts.items():
        if text != path.read_text("utf-8"):
            with atomic_path(path) as partial:
                partial.write_text(text, "utf-8")


def _draw(path: Path, kind: str, arguments: Sequence[Any], check: bool) -> bool:
    """Draw a figure, or only `check` it, and return whether the file was not drawn from these arguments."""
    from benchmarks import plots

    digest = hashlib.sha256(json.dumps(arguments).encode()).hexdigest()
    if plots.digest_in(path) == digest:
        return False
    if not check:
        figure = getattr(plots, kind)(*arguments)
        with atomic_path(path) as partial:
            plots.save(figure, partial, digest)
    return True


@dataclass
class Command:
    """Write the tables that stand between `<!-- table: NAME -->` and `<!-- end -->` in README.md and docs/*.md, and
    figures, as docs/results/tables.yaml describes them, from the rows in docs/results."""

    checkout: Positional[Path] = Path()
    """folder of README.md and docs"""
    check: bool = False
    """write nothing; exit with 1 if one is not as its rows"""

    def __call__(self) -> int:
        changed = write(self.checkout, self.check)
        remedy = "is written."
        if self.check:
            remedy = "is not what its rows give; run python -m benchmarks documents."
        for name in changed:
            print(f"{name} {remedy}")
        return int(self.check and bool(changed))
