"""Helpers of the viewer's panels: an element with a text, and the output that the viewer shows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfstudio.viewer.viewer_elements import ViewerControl, ViewerElement

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
