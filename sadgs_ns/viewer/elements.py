"""Helpers of the viewer's panels: an element with a text, and the output type that the viewer shows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfstudio.viewer.viewer_elements import ViewerControl, ViewerElement

if TYPE_CHECKING:
    from viser import ViserServer


class ViewerMarkdown(ViewerElement[str]):
    """A text in the viewer, which `text` returns at the start and at every `refresh`."""

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
        if self.gui_handle is None:
            return
        text = self.text()
        if text != self._shown:
            self._shown = text
            self.gui_handle.content = text


def show_output(control: ViewerControl, name: str) -> None:
    """Have the viewer, if there is one, show one of its output types, if it knows that type already."""
    control_panel = _control_panel(control)
    if control_panel is None:
        return
    dropdown = control_panel._output_render  # nerfstudio 1.1 has no public way to set it.
    if name in dropdown.options:
        dropdown.value = name


def shows_output(control: ViewerControl, name: str) -> bool:
    """Tell whether the viewer shows one of its output types, in the whole window or in half of it."""
    control_panel = _control_panel(control)
    if control_panel is None:
        return False
    if name == control_panel.output_render:
        return True
    return control_panel.split and name == control_panel.split_output_render


def _control_panel(control: ViewerControl) -> Any:
    """Return the viewer's own panel, or None if there is no viewer."""
    viewer = getattr(control, "viewer", None)  # The viewer sets this attribute when it starts.
    if viewer is None:
        return None
    return viewer.control_panel
