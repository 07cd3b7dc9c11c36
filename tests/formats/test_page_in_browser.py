"""A page in a real browser, beside our own rendering. Needs Chromium and, the first time, a network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from helpers import browser
from helpers.browser import open_page
from helpers.gsplat_like import splatted
from helpers.random_gaussians import random_gaussians
from sadgs_ns import formats
from sadgs_ns.errors import InputError
from sadgs_ns.formats.gaussians import Context, Gaussians, Start

START = Start((1.0, -8.0, 2.0), (0.5, 0.5, 0.5), 60.0)


def render(gaussians: Gaussians, width: int, height: int) -> np.ndarray:
    """What an upright camera sees from the start, in [0, 1]. [H, W, 3]"""
    position = np.array(START.position)
    target = np.array(START.target)
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [right, np.cross(forward, right), forward]
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    focal = width / (2 * np.tan(np.radians(START.degrees) / 2))
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float32)
    harmonics = np.concatenate([gaussians.features_dc[:, None], gaussians.features_rest], axis=1)
    image, _, _ = splatted(
        torch.from_numpy(gaussians.means),
        torch.from_numpy(gaussians.quats),
        torch.from_numpy(gaussians.scales).exp(),
        torch.from_numpy(gaussians.opacities).sigmoid(),
        torch.from_numpy(harmonics),
        torch.from_numpy(viewmat).float()[None],
        K[None],
        width,
        height,
        sh_degree=3,
    )
    return image[0].clamp(0, 1).numpy()


@pytest.mark.slow
@pytest.mark.skipif(browser.CHROMIUM is None, reason="needs Chromium")
def test_a_page_shows_from_the_disk_what_we_render(tmp_path: Path):
    gaussians = random_gaussians(3000)
    gaussians.scales[:] += 1.0
    try:
        formats.write(tmp_path / "splat.html", gaussians, Context(start=START))
    except InputError as error:
        pytest.skip(str(error))
    found = 0.0
    with open_page(f"file://{tmp_path / 'splat.html'}?noui", tmp_path / "profile", 640, 480) as page:
        width, height = page.wait_for("document.querySelector('canvas') && [innerWidth, innerHeight]")
        expected = render(gaussians, width, height)
        assert expected.std() > 0.1
        for _ in range(30):
            page.screenshot(tmp_path / "shot.png")
            shown = np.asarray(Image.open(tmp_path / "shot.png").convert("RGB")) / 255
            found = -10 * np.log10(np.square(shown - expected).mean())
            if found > 27:
                break
            page.command("Runtime.evaluate", expression="new Promise(r => setTimeout(r, 1000))", awaitPromise=True)
        sources = page.run(
            "performance.getEntriesByType('resource').map(e => e.name).filter(n => n.startsWith('http'))"
        )
    print(f"{found:.1f} dB")
    assert found > 27, "dB between the page and our rendering"
    assert sources == [], "nothing is loaded from anywhere"
