"""The viewer's panel in a real browser: what is chosen there is drawn, what is set there reaches the run.

Needs Chromium and takes a minute: `pytest -m slow tests/viewer/test_viewer_in_browser.py`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer.viewer import Viewer

from examples.drawn_scene.scene import write_scene
from helpers import browser
from helpers.browser import Page, open_page
from helpers.forked_python import HANGS
from helpers.kill_and_resume import configure, set_up
from sadgs_ns.viewer.structure_panel import OUTPUT

LABEL = "[...document.querySelectorAll('label')].filter(l => l.textContent == '{}')[0]"
ELEMENT = "document.getElementById(" + LABEL + ".htmlFor)"
OPTION = "[...document.querySelectorAll('[role=option]')].filter(o => o.textContent == '{}' && o.offsetParent)[0]"


def eventually(condition: Callable[[], bool], seconds: float = HANGS) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.2)


def select(page: Page, label: str, option: str) -> None:
    """Choose an option; once more where the panel moved under the mouse, because a text above it changed."""
    for _ in range(20):
        page.click(ELEMENT.format(label))
        with suppress(TimeoutError):
            page.wait_for(f"!!{OPTION.format(option)}", 10)
            page.click(OPTION.format(option))
            page.wait_for(f"{ELEMENT.format(label)}.value == '{option}'", 5)
            return
    raise TimeoutError(f"{label} never became {option}")


LEGEND = "[...document.querySelectorAll('img')].filter(i => i.alt == 'largest η' && i.naturalWidth == 720)[0]"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of viser, websockets and torchmetrics
@pytest.mark.skipif(browser.CHROMIUM is None, reason="needs Chromium")
def test_the_panel_shows_and_sets_what_is_chosen_in_a_browser(tmp_path: Path):
    write_scene(tmp_path / "scene", 64, 48, 10, points=300)
    config = configure(tmp_path / "scene", tmp_path / "runs", 30, save_every=0)
    config.pipeline.model.strategy.split_min_opacity = 0.0
    config.save_config()
    trainer = set_up(config)
    trainer.train()
    pipeline = trainer.pipeline
    panel = pipeline.structure
    config.viewer.websocket_port_default = 7137  # the first free port from there
    viewer = Viewer(config.viewer, tmp_path / "log", tmp_path, pipeline, train_lock=threading.Lock())
    viewer.init_scene(pipeline.datamanager.train_dataset, "completed")
    url = viewer.viewer_info[0].split(": ")[-1]
    try:
        with open_page(url, tmp_path / "profile") as page:
            page.wait_for("document.body.innerText.includes('Custom Elements')")
            assert f"{pipeline.model.num_points:,} Gaussians" in page.run("document.body.innerText")
            eventually(lambda: OUTPUT in viewer.control_panel._output_render.options)
            page.click("[...document.querySelectorAll('button')].filter(b => b.textContent.includes('Hide Train'))[0]")
            assert not page.run(f"!!{LEGEND}")
            select(page, "Show", "η")
            page.wait_for(f"{ELEMENT.format('Output type')}.value == '{OUTPUT}'")
            assert panel.choice.value == "η"
            assert panel.statistics() is not None
            width = page.wait_for(f"!!{LEGEND} && {LEGEND}.getBoundingClientRect().width")
            assert 200 < width <= 720, "the numbers are sharp: it is not enlarged"
            assert "over 1 violates" in page.run("document.body.innerText")
            page.click(ELEMENT.format("max_gaussians"))
            page.run(f"{ELEMENT.format('max_gaussians')}.select()")
            page.type("4567")
            page.press("Enter", 13)
            eventually(lambda: pipeline.model.plan.strategy.max_gaussians == 4567)
            page.wait_for("document.body.innerText.includes('cap 4,567')")
            select(page, "Preview", "what stays")
            number = pipeline.model.num_points
            page.wait_for(f"document.body.innerText.includes('{number:,} of {number:,} Gaussians would stay.')")
            page.wait_for(f"{ELEMENT.format('Output type')}.value == 'cleaned'")
            page.click(ELEMENT.format("min views"))  # In the middle of the slider.
            page.wait_for("document.body.innerText.includes('of 8 training views are taken away.')")
            assert pipeline.cleaning.cleaning.min_views > 0
            select(page, "Show", "off")
            page.wait_for(f"{ELEMENT.format('Output type')}.value == 'rgb' && !{LEGEND}")
    finally:
        viewer.viser_server.stop()
        for thread in threading.enumerate():  # one that still renders when Python ends would abort it
            if isinstance(thread, RenderStateMachine):
                thread.running = False
                thread.join(HANGS)
