"""`python -m examples.turn RUN --output turn.webp`: a moving picture of a trained splat, which repeats without a jump.

The camera begins at the training camera in the middle of the others and moves once along an ellipse about what that
camera looks at. Run it in a checkout; a GPU is not needed. `make turn` makes the picture of the gallery.

A browser and most programs for pictures show WebP files that move.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from sadgs_ns.errors import InputError
from sadgs_ns.files import atomic_path
from sadgs_ns.formats.html import middle_camera, start_at

if TYPE_CHECKING:
    from sadgs_ns.training.model import SadgsModel
    from sadgs_ns.training.pipeline import SadgsPipeline

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
OPAQUE = 5.0
"""Logit of the opacity of shrunk Gaussians."""
UP = np.array([0.0, 0.0, 1.0])
"""Upwards in nerfstudio's frame."""


@dataclass
class Turn:
    """Draw a splat from a camera that moves along an ellipse, and write a moving picture (WebP or GIF)."""

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Folder of a run of sadgs, or its config.yml."""
    output: Path
    """File to write, whose name ends in .webp or .gif."""
    frames: int = 48
    """Number of pictures."""
    seconds: float = 5.0
    """Duration of a turn."""
    width: int = 320
    """Width of the splat's picture in px."""
    across: float = 25.0
    """Angle to either side, about the upwards axis, in degrees."""
    along: float = 8.0
    """Angle upwards and downwards, about the camera's horizontal axis, in degrees."""
    shrink: float = 1.0
    """If above 1, a second picture beside the first shows the Gaussians so many times smaller, and opaque."""
    quality: int = 60
    """Quality of WebP, up to 100."""


def turned(pose: Array, target: Array, across: float, along: float) -> Array:
    """Turn a camera about a point, and let it look at that as before.

    Args:
        pose: Camera to world, with OpenGL's axes. [3, 4]
        target: The point. [3]
        across: Angle about the upwards axis, rad.
        along: Angle about the camera's horizontal axis, rad.
    """
    rotation = Rotation.from_rotvec(across * UP) * Rotation.from_rotvec(along * pose[:, 0])
    turned_axes = rotation.as_matrix() @ pose[:, :3]
    position = target + rotation.apply(pose[:, 3] - target)
    return np.concatenate([turned_axes, position[:, None]], axis=1)


def ellipse(pose: Array, target: Array, across: float, along: float, frames: int) -> Array:
    """Return poses [F, 3, 4] along an ellipse of cameras about a point; the angles are in rad, as in `turned`."""
    poses = []
    for frame in range(frames):
        phase = 2 * math.pi * frame / frames
        poses.append(turned(pose, target, across * math.sin(phase), along * math.cos(phase)))
    return np.stack(poses)


def draw(pipeline: SadgsPipeline, options: Turn) -> list[Picture]:
    """Draw the pictures of a turn. [H, W, 3] each"""
    import torch

    model = pipeline.model
    cameras = pipeline.datamanager.train_dataset.cameras
    poses = cameras.camera_to_worlds.numpy().astype(np.float64)  # [C, 3, 4]
    middle = middle_camera(poses[:, :, 3])
    camera = cameras[middle : middle + 1]
    factor = options.width / int(camera.width)
    camera.rescale_output_resolution(factor)
    gaussians = model.gauss_params
    means = gaussians["means"].detach().cpu().numpy()
    side = max(int(camera.width), int(camera.height))
    start = start_at(poses[middle], side, float(camera.fx), means)
    target = np.array(start.target)
    pictures = []
    across = math.radians(options.across)
    along = math.radians(options.along)
    for pose in ellipse(poses[middle], target, across, along, options.frames):
        camera.camera_to_worlds = torch.from_numpy(pose).to(torch.float32)[None]
        halves = [_picture(model, camera)]
        if options.shrink > 1:
            with _shrunk(model, options.shrink):
                halves.append(_picture(model, camera))
        pictures.append(np.concatenate(halves, axis=1))
    return pictures


@contextmanager
def _shrunk(model: SadgsModel, factor: float) -> Iterator[None]:
    """Make the Gaussians so many times smaller, and opaque, while the block runs."""
    gaussians = model.gauss_params
    scales = gaussians["scales"].data
    opacities = gaussians["opacities"].data
    before = opacities.clone()
    scales -= math.log(factor)
    opacities.fill_(OPAQUE)
    try:
        yield
    finally:
        scales += math.log(factor)
        opacities.copy_(before)


def _picture(model: SadgsModel, camera) -> Picture:
    outputs = model.get_outputs_for_camera(camera.to(model.device))
    color = outputs["rgb"].clamp(0, 1)
    levels = (255 * color).round()
    return levels.byte().cpu().numpy()


def write(path: Path, pictures: Sequence[Picture], seconds: float, quality: int) -> None:
    """Write pictures as a file that shows them again and again. Raises WriteError if the disk is full."""
    images = [Image.fromarray(picture) for picture in pictures]
    duration = round(1000 * seconds / len(images))
    with atomic_path(path) as partial:
        images[0].save(
            partial, save_all=True, append_images=images[1:], duration=duration, loop=0, quality=quality, method=6
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code, 2 if the input is wrong."""
    options = tyro.cli(Turn, prog="python -m examples.turn", args=arguments)
    try:
        if options.output.suffix not in (".webp", ".gif"):
            raise InputError(f"--output {options.output} must end in .webp or .gif.")
        if options.frames < 2 or options.width < 16:
            raise InputError("--frames must be 2 or more, and --width 16 or more.")
        # This import takes ten seconds, which wrong arguments need not wait for.
        from sadgs_ns.cli.inspection import load_run

        pipeline, _ = load_run(options.run)
        pictures = draw(pipeline, options)
        write(options.output, pictures, options.seconds, options.quality)
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    size = options.output.stat().st_size / 1e6
    print(f"{options.output}: {len(pictures)} pictures, {size:.1f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
