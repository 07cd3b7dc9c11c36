"""What the files of `sadgs-export` take and lose: `python -m benchmarks formats RUN` on any machine.

It writes a run in every format, reads the lossy ones back with gsply, which is not ours, renders the held-out views,
and prints sizes and PSNRs as a markdown table. glTF loses nothing, and a page holds the SOG.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gsply
import numpy as np
import torch
from gsply.sog_reader import sogread
from gsply.spz import read_spz
from PIL import Image
from torch import Tensor
from tyro.conf import Positional

from benchmarks.table import grid
from sadgs_ns.cli.export import Export, export
from sadgs_ns.data.run_cameras import RunCameras, read_cameras
from sadgs_ns.formats import FORMATS
from sadgs_ns.render.rasterization import rasterize, viewmats_from_camera_to_world

_LOSSY = (".compressed.ply", ".spz", ".sog")


@torch.no_grad()
def render(path: Path, cameras: RunCameras, device: torch.device) -> list[Tensor]:
    """Render what gsply reads from a file, before black.

    Args:
        path: A PLY, compressed PLY, SPZ or SOG.
        cameras: C cameras in the file's frame.
        device: Where to render.

    Returns:
        C images in [0, 1]. [H, W, 3]
    """
    read: Any = {".spz": read_spz, ".sog": sogread}.get(path.suffix, gsply.plyread)
    data = read(str(path))
    rest = np.zeros((len(data.means), 0, 3), np.float32) if data.shN is None else data.shN
    harmonics = torch.from_numpy(np.concatenate([data.sh0[:, None], rest], axis=1)).to(device)
    parts = [torch.from_numpy(np.ascontiguousarray(part)).to(device) for part in (data.means, data.quats, data.scales)]
    opacities = torch.from_numpy(data.opacities).flatten().to(device).sigmoid()
    viewmats = viewmats_from_camera_to_world(cameras.camera_to_worlds).to(device)
    images = []
    for viewmat, K, (width, height) in zip(viewmats, cameras.Ks.to(device), cameras.sizes, strict=True):
        means, quats, scales = parts
        view = viewmat[None], K[None], width, height
        degree = round(harmonics.shape[1] ** 0.5) - 1
        image, _, _ = rasterize(means, quats, scales.exp(), opacities, harmonics, *view, sh_degree=degree)
        images.append(image[0].clamp(0, 1).cpu())
    return images


def psnr(images: Sequence[Tensor], others: Sequence[Tensor]) -> float:
    """Return the mean PSNR of pairs of images in [0, 1], in dB."""
    return float(np.mean([-10 * (a - b).square().mean().log10() for a, b in zip(images, others, strict=True)]))


@dataclass
class Command:
    """Write a run's Gaussians in every format, read them back, and compare sizes and renderings."""

    run: Positional[Path]
    """folder of a run, or its config.yml"""
    output: Path = Path("formats")
    """folder that takes the files"""
    data: Path | None = None
    """folder of the capture (default: where it was in training)"""

    def __call__(self) -> int:
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        paths = {suffix: self.output / f"splat{suffix}" for suffix in FORMATS}
        counts = [export(Export(self.run, path, data=self.data)) for path in paths.values()]
        cameras = read_cameras(self.run if self.run.is_dir() else self.run.parent, self.data, split="test")
        photos = [torch.from_numpy(np.asarray(Image.open(p).convert("RGB")) / 255).float() for p in cameras.photos]
        before = render(paths[".ply"], cameras, device)
        print(f"{counts[0]:,} Gaussians, {len(photos)} held-out views, rendered on {device.type}, ", end="")
        print(f"gsply {gsply.__version__}.\n")
        whole, lines = paths[".ply"].stat().st_size, []
        for suffix, path in paths.items():
            size = path.stat().st_size
            cells = ["as the SOG" if suffix == ".html" else "as the PLY", ""]
            if suffix in (".ply", *_LOSSY):
                after = before if suffix == ".ply" else render(path, cameras, device)
                cells = [f"{psnr(after, photos):.2f} dB", "" if suffix == ".ply" else f"{psnr(after, before):.1f} dB"]
            lines.append((f"`{suffix}`", f"{size / 1e6:.2f}", f"{100 * size / whole:.0f} %", *cells))
        print(grid(("format", "MB", "of the PLY", "PSNR of the held-out views", "PSNR to the PLY's rendering"), lines))
        return 0
