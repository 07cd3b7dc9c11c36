"""What benchmarks that begin with folders of photos share: protocols, options, and running processes for captures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from subprocess import Popen
from typing import TypeVar

import yaml
from tyro.conf import Positional

from benchmarks.side_by_side import run_side_by_side, sigterm_exits

SUFFIXES = {".jpg", ".jpeg", ".png"}

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
