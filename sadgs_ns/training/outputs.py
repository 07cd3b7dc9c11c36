"""The outputs of a rendering, some of which are computed only for those who read them, and who these are."""

from __future__ import annotations

import threading
from collections import UserDict
from functools import lru_cache
from typing import Any

from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape
from torch import Tensor


class LazyOutputs(UserDict[str, Any]):
    """Tensors by name, as nerfstudio reads them: a function that stands in for a tensor is called at the first read.

    nerfstudio does not tell a model which of its outputs are wanted, so that each of them would cost `ns-eval` and
    `ns-render` time, also where nobody looks at it.
    """

    def __getitem__(self, name: str) -> Tensor:
        value: Any = self.data[name]
        if callable(value):
            value = self.data[name] = value()
        return value


def in_viewer() -> bool:
    """Tell whether this is a thread in which nerfstudio's viewer draws."""
    from nerfstudio.viewer.render_state_machine import RenderStateMachine

    return isinstance(threading.current_thread(), RenderStateMachine)


@lru_cache(maxsize=8)
def warn_once(text: str) -> None:
    """Print a warning, unless it was printed before."""
    CONSOLE.print(f"[yellow]{escape(text)}[/]")
