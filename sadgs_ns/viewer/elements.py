"""Helpers of the model and the viewer's panels: lazy outputs, a text, and the output that the viewer shows."""

from __future__ import annotations

import threading
from collections import UserDict
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfstudio.viewer.viewer_elements import ViewerControl, ViewerElement
from torch import Tensor

from sadgs_ns.training.run.progress import warn

if TYPE_CHECKING:
    from viser import ViserServer


class ViewerMarkdown(ViewerElement[str]):
    """A text in the viewer; `text` returns it at the start and at every `refresh`."""

    def __init__(self, name: str, text: Callable[[], str]) -> None:
        super().__init__(name)
        self.text = text
        self._shown = ""

    def install(self, viser_server: ViserServer) -> None:
        self._shown = self.text()
        # Without a root, viser warns of images that come with the text.
        self.gui_handle: Any = viser_server.gui.add_markdown(self._shown, image_root=Path())

    def refresh(self) -> None:
        """Send the text to the viewer, if there is one, when it has changed."""
        if self.gui_handle is not None and (text := self.text()) != self._shown:
            self._shown = self.gui_handle.content = text


def show_output(control: ViewerControl, name: str) -> None:
    """Have the viewer, if there is one, show one of its output types, if it knows that type already."""
    if (viewer := getattr(control, "viewer", None)) is not None:  # set when the viewer is made
        output = viewer.control_panel._output_render  # nerfstudio 1.1 has no public way.
        if name in output.options:
            output.value = name


def shows_output(control: ViewerControl, name: str) -> bool:
    """Tell whether the viewer shows one of its output types, in the whole window or in half of it."""
    if (viewer := getattr(control, "viewer", None)) is None:
        return False
    panel = viewer.control_panel
    return name == panel.output_render or (panel.split and name == panel.split_output_render)


class LazyOutputs(UserDict[str, Any]):
    """Tensors by name, or functions that make them when they are first read.

    nerfstudio does not tell a model which outputs it needs, so each would cost `ns-eval` and `ns-render` time.
    """

    def __getitem__(self, name: str) -> Tensor:
        value: Any = self.data[name]
        if callable(value):
            value = self.data[name] = value()
        return value


def in_viewer() -> bool:
    """Tell whether nerfstudio's viewer draws in this thread."""
    from nerfstudio.viewer.render_state_machine import RenderStateMachine

    return isinstance(threading.current_thread(), RenderStateMachine)


@lru_cache(maxsize=8)
def warn_once(text: str) -> None:
    """Print a warning, unless it was printed before."""
    warn(text)
