"""A record of which functions of a module are called."""

from __future__ import annotations

from typing import Any

import pytest


def record_calls(monkeypatch: pytest.MonkeyPatch, module: Any, *names: str) -> list[str]:
    """A list to which each call of these functions of a module adds its name.

    So a test can tell that a kernel ran, and that no reference is compared with itself.
    """
    calls: list[str] = []
    for name in names:
        run = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *a, name=name, run=run, **o: calls.append(name) or run(*a, **o))
    return calls
