"""Files in JSON, as tests read and change them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def read_json(path: Path) -> Any:
    """What a file in JSON describes."""
    return json.loads(path.read_text())


def write_json(path: Path, content: Any) -> None:
    """Write a file in JSON, in place of one that is there."""
    path.write_text(json.dumps(content))
