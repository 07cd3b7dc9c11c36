"""Compare an exported file with original photos: `python -m benchmarks.chain_score SCENE PHOTOS SPLAT.ply OUT.json`.

The score reads the photos as they were taken, the cameras with their distortion that `sadgs-process` placed, and the
file; nothing that was undistorted or trained on enters it. The file is drawn at twice the photo's size by a pinhole
camera, warped through the photo's distorted camera and reduced by area. The photo is reduced by area, too, if it is
longer than the images of training. The file is drawn as other programs' viewers do (`sadgs_ns.cli.splat_file`).
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageOps
from torch import Tensor

from sadgs_ns.cli import splat_file
from sadgs_ns.cli.splat_file import Splat, read_splat
from sadgs_ns.geometry.point_colors import apply_gains
from sadgs_ns.render.types import Cameras

Array = NDArray[np.float32]
ENLARGED = 2  # Factor of the size at which the file is drawn, so that warping costs no detail
MARGIN = 8  # px around what the photo sees, for the warp's kernel
MOST_SIDE = 4.0  # Largest side of the drawn image, in those of the enlarged photo: lenses of 150° need more


def read_photo(file: Path, max_size: int) -> Array:
    """Read a photo upright in [0, 1], reduced by area to a longest side of at most `max_size` px. [H, W, 3]"""
    with Image.open(file) as image:
        pixels = np.asarray(ImageOps.exif_transpose(image).convert("RGB"), np.float32) / 255
    height, width = pixels.shape[:2]
    longest = max(width, height)
    if not max_size or longest <= max_size:
        return pixels
    scale = max_size / longest
    size = (round(scale * width), round(scale * height))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.float32)


@dataclass(frozen=True)
class Drawing:
    """A splat that a pinhole camera has drawn, and where it has the pixels of a distorted, enlarged photo."""

    colors: Tensor  # Not clamped [1, h, w, 3]
    alphas: Tensor  # [1, h, w, 1]
    at_x: Array  # In px from the centre of the first column [H', W']
    at_y: Array  # In px from the centre of the first row [H', W']
    size: tuple[int, int]  # Width and height of the photo in px

    def photo(self, gains: Sequence[float] | None = None) -> Array:
        """Return what the distorted camera sees, in [0, 1]. [H, W, 3]

        `gains`, factors of the channels [3], give colours the photo's exposure before they are clamped.
        """
        colors = self.colors
        if gains is not None:
            colors = apply_gains(colors, torch.tensor(gains, device=colors.device), self.alphas)
        pinhole = colors.clamp(0, 1)[0].cpu().numpy()
        warped = cv2.remap(pinhole, self.at_x, self.at_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return cv2.resize(warped, self.size, interpolation=cv2.INTER_AREA).clip(0, 1)


@torch.no_grad()
def draw(splat: Splat, camera: Any, viewmat: NDArray[np.float64], size: tuple[int, int]) -> Drawing:
    """Draw a splat for a photo of COLMAP's camera, with its distortion.

    Args:
        splat: In the frame of the camera's poses.
        camera: A pycolmap.Camera of the original photo.
        viewmat: World to camera. [3, 4]
        size: Width and height of the photo in px.
    """
    width = ENLARGED * size[0]
    height = ENLARGED * size[1]
    # Rays through the centres of the enlarged image's pixels, in the photo's pixels and then without distortion.
    x = (np.arange(width) + 0.5) * camera.width / width
    y = (np.arange(height) + 0.5) * camera.height / height
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = np.asarray(camera.cam_from_img(pixels)).reshape(height, width, -1)[..., :2]
    focal_x = camera.focal_length_x * width / camera.width
    focal_y = camera.focal_length_y * height / camera.height
    drawn_x = focal_x * rays[..., 0]
    drawn_y = focal_y * rays[..., 1]
    left, right = _bounds(drawn_x, width)
    top, bottom = _bounds(drawn_y, height)
    device = splat.gaussians.means.device
    K = torch.tensor([[focal_x, 0.0, -left], [0.0, focal_y, -top], [0.0, 0.0, 1.0]], device=device)
    pose = torch.eye(4, device=device)
    pose[:3] = torch.from_numpy(viewmat).to(pose)
    cameras = Cameras(pose[None], K[None].float(), right - left, bottom - top)
    colors, alphas = splat_file.draw(splat, cameras)
    # OpenCV numbers pixels by their centres.
    at_x = (drawn_x - left - 0.5).astype(np.float32)
    at_y = (drawn_y - top - 0.5).astype(np.float32)
    return Drawing(colors, alphas, at_x, at_y, size)


def _bounds(values: NDArray[np.float64], side: int) -> tuple[int, int]:
    """Return the first and the last pixel that a drawn image needs, which is not larger than MOST_SIDE sides."""
    finite = values[np.isfinite(values)]
    limit = MOST_SIDE / 2 * side
    return math.floor(max(finite.min(), -limit)) - MARGIN, math.ceil(min(finite.max(), limit)) + MARGIN


def model_folder(scene: Path) -> Path:
    """Return the folder of the model with the distorted cameras in a scene of `sadgs-process`."""
    settings = json.loads((scene / "work" / "settings.json").read_text("utf8"))
    return scene / "work" / settings["model"]


def compare(
    scene: Path,
    photos: Path,
    splat: Splat,
    max_size: int,
    names: Sequence[str],
    gains: Mapping[str, Sequence[float]] | None = None,
) -> dict[str, Any]:
    """Compare held-out photos with the file.

    Args:
        scene: What `sadgs-process` made of the photos.
        photos: Their folder.
        splat: The file, in the frame of the cameras.
        max_size: Longest side in px at which they are compared; 0 compares at their own size.
        names: All photos, in the order that decides which are held out.
        gains: Factors of a rendering's channels [3] by the names of the scene's images.

    Returns:
        `views`: PSNR in dB, SSIM and LPIPS (None without its weights) of each held-out photo by its name; their means
        `psnr`, `ssim` and `lpips`, and `worst`, the least PSNR; the numbers of `photos` and `registered` ones; and the
        names of those held out that did not register, `missing`. With `gains` also `gain_views`: the same as `views`
        for renderings at their photo's exposure.
    """
    import pycolmap  # Pillow cannot write PNGs if it is loaded after this.

    from benchmarks.chain import held_out, photo_of
    from benchmarks.evaluate import load_lpips

    model = pycolmap.Reconstruction(model_folder(scene))
    images = {photo_of(image.name, names): image for image in model.images.values() if image.has_pose}
    device = splat.gaussians.means.device
    network = load_lpips()
    if network is not None:
        network.to(device)
    views: dict[str, list[float | None]] = {}
    gain_views: dict[str, list[float | None]] = {}
    for name in held_out(names):
        if name not in images:
            continue
        image = images[name]
        photo = read_photo(photos / name, max_size)
        size = (photo.shape[1], photo.shape[0])
        viewmat = image.cam_from_world().matrix()
        truth = torch.from_numpy(photo).to(device)
        drawing = draw(splat, image.camera, viewmat, size)
        views[name] = measured(torch.from_numpy(drawing.photo()).to(device), truth, network)
        if gains is None:
            continue
        gain_views[name] = views[name]
        if image.name in gains:
            gained = drawing.photo(gains[image.name])
            gain_views[name] = measured(torch.from_numpy(gained).to(device), truth, network)
    columns = list(zip(*views.values(), strict=True))
    score = {
        "photos": len(names),
        "registered": len(images),
        "missing": [name for name in held_out(names) if name not in images],
        "views": views,
        "psnr": statistics.fmean(columns[0]),
        "ssim": statistics.fmean(columns[1]),
        "lpips": None if network is None else statistics.fmean(columns[2]),
        "worst": min(columns[0]),
    }
    if gains is not None:
        score["gain_views"] = gain_views
    return score


@torch.no_grad()
def measured(
    rendered: Tensor,  # In [0, 1] [H, W, 3]
    truth: Tensor,  # In [0, 1] [H, W, 3]
    network: Any,  # Of LPIPS; None without its weights
) -> list[float | None]:
    """Return PSNR in dB, SSIM and LPIPS of a rendering, rounded; LPIPS is None without its network."""
    from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

    rendered = rendered.movedim(-1, 0)[None]
    truth = truth.movedim(-1, 0)[None]
    psnr = float(peak_signal_noise_ratio(rendered, truth, data_range=1.0))
    ssim: Any = structural_similarity_index_measure(rendered, truth, data_range=1.0, sigma=1.5, kernel_size=11)
    lpips = None
    if network is not None:
        lpips = round(float(network(rendered, truth)), 4)
    return [round(psnr, 3), round(float(ssim), 4), lpips]


def main() -> None:
    """Write the score of a file."""
    from benchmarks.photo_captures import photos_of
    from benchmarks.run import software

    parser = argparse.ArgumentParser(prog="python -m benchmarks.chain_score", description=__doc__)
    for name in ("scene", "photos", "splat", "output"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--max-size", type=int, default=1600)
    parser.add_argument("--gains", type=Path)
    options = parser.parse_args()
    gains = None
    if options.gains is not None:
        gains = json.loads(options.gains.read_text("utf8"))
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    splat = read_splat(options.splat, device)
    score = compare(options.scene, options.photos, splat, options.max_size, photos_of(options.photos), gains)
    score["gaussians"] = len(splat.gaussians.means)
    score["megabytes"] = round(options.splat.stat().st_size / 1e6, 1)
    score["gpu"] = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    score["versions"] = software()
    options.output.write_text(json.dumps(score), "utf8")


if __name__ == "__main__":
    main()
