"""The clock of Triton's compiler."""

from __future__ import annotations

import contextlib
from typing import Any


class CompileTimer(contextlib.AbstractContextManager):
    """Times what Triton compiles while the context is open, however often it is opened.

    Kernels that an earlier run on the machine has left in Triton's cache count as nothing.
    """

    def __init__(self) -> None:
        self._times: list[float] = []  # a list, since threads compile side by side

    @property
    def seconds(self) -> float:
        """Sum over the kernels, also over those that are compiled at the same time."""
        return sum(self._times)

    def __enter__(self) -> CompileTimer:
        self._listen(self._note)
        return self

    def __exit__(self, *_: object) -> None:
        self._listen(None)

    def _listen(self, listener: Any) -> None:
        try:
            from triton import knobs
        except ImportError:  # no Triton, or one too old for our kernels
            return
        knobs.compilation.listener = listener

    def _note(self, *, times: Any, cache_hit: bool, **_: Any) -> None:
        if not cache_hit:
            self._times.append(times.total / 1e6)  # from µs
