"""What the viewer's panels share: a text, and switching what the viewer shows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfstudio.viewer.viewer_elements import ViewerControl, ViewerElement

if TYPE_CHECKING:
    from viser import ViserServer


class ViewerMarkdown(ViewerElement[str]):
    """A text in the viewer, which `text` returns when it is installed and at every `refresh`."""

    def __init__(self, name: str, text: Callable[[], str]) -> None:
        super().__init__(name)
        self.text = text
        self._shown = ""

    def _create_gui_handle(self, viser_server: ViserServer) -> None:
        self._shown = self.text()
        # Without a root, viser warns of images that come with the text.
        self.gui_handle: Any = viser_server.gui.add_markdown(self._shown, image_root=Path())

    def install(self, viser_server: ViserServer) -> None:
        self._create_gui_handle(viser_server)

    def refresh(self) -> None:
        """Send the text to the viewer, if there is one and the text has changed."""
        if self.gui_handle is not None and (text := self.text()) != self._shown:
            self._shown = self.gui_handle.content = text


def show_output(control: ViewerControl, name: str) -> None:
    """Have the viewer, if it has met the control, show one of its output types, if it knows that already."""
    viewer = getattr(control, "viewer", None)  # It is set when the viewer is made.
    if viewer is not None:
        output = viewer.control_panel._output_render  # nerfstudio 1.1 has no public way.
        if name in output.options:
            output.value = name


def shows_output(control: ViewerControl, name: str) -> bool:
    """Tell whether the viewer shows one of its output types, in the whole window or in a half of it."""
    viewer = getattr(control, "viewer", None)
    if viewer is None:
        return False
    panel = viewer.control_panel
    return name == panel.output_render or (panel.split and name == panel.split_output_render)
