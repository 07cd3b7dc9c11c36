"""What benchmarks that begin with folders of photos share: protocols, options, and running processes for captures."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from subprocess import Popen
from typing import Any, TypeVar

import yaml
from tyro.conf import Positional

from benchmarks import results
from benchmarks.side_by_side import run_side_by_side, sigterm_exits

SUFFIXES = {".jpg", ".jpeg", ".png"}
_ROW_FILE = "row.json"  # In the folder of a process

Job = TypeVar("Job")
Protocol = TypeVar("Protocol")


def photos_of(folder: Path) -> list[str]:
    """Return the names of a folder's photos in their order, by which some are held out."""
    paths = [path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES]
    return sorted(path.relative_to(folder).as_posix() for path in paths)


def load_protocol(path: Path, kind: Callable[..., Protocol], content: str) -> Protocol:
    """Read a protocol of a kind. Raises ValueError, one sentence, if it is none; `content` says what it is of."""
    try:
        return kind(**yaml.safe_load(path.read_text("utf8")))
    except OSError as error:
        raise ValueError(f"{path} cannot be read ({error.strerror}); give the YAML file of {content}.") from error
    except (TypeError, yaml.YAMLError) as error:
        problem = " ".join(str(error).split())
        raise ValueError(f"{path} must be YAML with captures and seeds: {problem}.") from error


@dataclass
class PhotoCommand:
    """The options of a benchmark that begins with folders of photos."""

    protocol: Positional[Path]
    """YAML file of captures and seeds"""
    photos: Path
    """folder that holds the captures' folders"""
    output: Path
    """JSON-lines file; rows already in it are not measured again"""
    label: str
    """name of these rows, such as a commit"""

    def folder_of(self, capture: str) -> Path:
        """Return a capture's folder, given its path below that of all; raise ValueError if it holds no photos."""
        folder = self.photos / capture
        if not photos_of(folder):
            raise ValueError(f"{folder} holds no photos; check --photos.")
        return folder.resolve()

    def run(
        self,
        jobs: Sequence[Job],
        launch: Callable[[Job, str | None, Path], Popen[bytes]],
        ended: Callable[[Job, int, Path], None],
        gpus: Sequence[str | None] = (None,),
    ) -> bool:
        """Run jobs as `run_side_by_side` does; return whether they came to their end without an interrupt."""
        self.output.parent.mkdir(parents=True, exist_ok=True)
        with sigterm_exits():
            try:
                run_side_by_side(jobs, launch, ended, gpus)
            except KeyboardInterrupt:
                return False
        return True

    def done_keys(self) -> set[str]:
        """Return the keys of the rows that ended well in an earlier call."""
        rows = results.read(self.output, missing_ok=True)
        return {row["key"] for row in rows if row["status"] == "ok"}


def write_row(work: Path, row: Mapping[str, Any]) -> None:
    """Leave the row of a process in its folder, where `written_row` finds it."""
    (work / _ROW_FILE).write_text(json.dumps(row), "utf8")


def written_row(work: Path, failed: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the row that a process left in its folder, or what `failed` returns if it ended without."""
    written = work / _ROW_FILE
    if written.exists():
        return json.loads(written.read_text("utf8"))
    return failed()


def exit_status(rows: Sequence[Mapping[str, Any]], keys: Collection[str]) -> int:
    """Return 1 if a row of these keys did not end well, otherwise 0."""
    return int(any(row["status"] != "ok" for row in rows if row["key"] in keys))
