"""Checks of a COLMAP reconstruction, binary or text."""

from __future__ import annotations

import dataclasses
import filecmp
import os
import shlex
import sys
from collections.abc import Generator, Iterator, Sequence
from pathlib import Path

from sadgs_ns.data import colmap, images, layouts
from sadgs_ns.data.checks.findings import Finding, collect_findings, fault, warning
from sadgs_ns.data.checks.geometry import check_points, check_views
from sadgs_ns.data.checks.images import check_images
from sadgs_ns.data.checks.layouts import no_layout
from sadgs_ns.data.checks.splits import SPLITS, check_splits
from sadgs_ns.data.colmap_views import read_views
from sadgs_ns.data.layouts import ParserOptions, automatic_options
from sadgs_ns.data.nearby import NearbyFiles
from sadgs_ns.data.text import read_text
from sadgs_ns.data.views import View
from sadgs_ns.errors import InputError


@collect_findings
def check_colmap(data: Path, options: ParserOptions, open_images: bool = True) -> Iterator[Finding]:
    """Check a COLMAP reconstruction in a folder, to which the options' paths are relative, and its images if asked."""
    folder = data / options.images_path
    model_folder = data / options.colmap_path
    kind = colmap.model_kind(model_folder)
    if kind is None:
        raise InputError(_no_model(data, model_folder))
    cameras_path = model_folder / f"cameras.{kind}"
    poses_path = model_folder / f"images.{kind}"
    names, views = read_views(poses_path, cameras_path)
    this_model = f"end the command with `colmap {_words(data, options, names)}"
    yield from _check_folders(data, options, names, poses_path)
    files = {split: data / f"{split}_list.txt" for split in SPLITS}
    lists = {split: read_text(file).splitlines() for split, file in files.items() if file.is_file()}
    training = yield from check_splits(names, lists, lambda split: f"{files[split]}", folder.joinpath, options)
    sound = yield from check_views(views, training, poses_path)
    if options.masks_path is None and images.images_in(data / "masks"):
        problem = f"{data / 'masks'} holds masks that are not used"
        yield warning(f"{problem}: {this_model} --masks-path masks` to leave out what is black in them.")
    if open_images:
        factor = yield from _check_factor(folder, names, options)
        frames = _frames(data, options, names, views, factor)
        yield from check_images(frames, poses_path, data, look_for_unused=factor == 1)
        views = [view._replace(image=frame.image) for view, frame in zip(views, frames, strict=True)]
    if options.load_3D_points:
        random = f"{this_model} --load-3D-points False` to start from random points"
        points = colmap.points_file(model_folder)
        if points is None:
            yield fault(f"{model_folder} has no points3D file: copy the whole reconstruction, or {random}.")
            return
        remedy = f"run COLMAP's mapper again, or {random}"
        if not sound:
            views = []
        yield from check_points(colmap.read_points(points), views, points, remedy)


def _no_model(data: Path, model_folder: Path) -> str:
    """Return the sentence for a folder without a reconstruction where the options look for one."""
    models = layouts.find_reconstructions(data)
    if not models:
        return no_layout(data)
    found = automatic_options(data)
    problem = f"{model_folder} holds no COLMAP reconstruction, but {data / found.colmap_path} does"
    return f"{problem}: add `{_words(data, found, models[found.colmap_path])}` after `colmap`."


def _frames(
    data: Path, options: ParserOptions, names: Sequence[str], views: Sequence[View], factor: int
) -> list[images.Frame]:
    """Return the images, scaled down by a factor, of the views with these names, and their masks."""
    folder = images.smaller_folder(data / options.images_path, factor)
    frames = []
    masks = {}
    masks_folder = data
    if options.masks_path is not None:
        masks = _masks(data / options.masks_path, names)
        masks_folder = images.smaller_folder(data / options.masks_path, factor)
    for name, view in zip(names, views, strict=True):
        size = (view.camera.width, view.camera.height)
        size = images.scaled_size(size, factor, options.downscale_rounding_mode)
        mask = None
        if name in masks:
            mask = masks_folder / masks[name]
        frames.append(images.Frame(folder / name, size, mask))
    return frames


def _masks(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Return the masks of the images that have one, relative to the folder of masks.

    For an image without a mask, a file may have nearly the mask's name. Since it may be meant, the mask's own name is
    then returned, so that the check of masks reports it as missing. Raise InputError if no image has a mask.
    """
    masks = {}
    for name in names:
        mask = images.mask_name(folder, name)
        if mask is not None:
            masks[name] = mask
    nearby = NearbyFiles(folder, {folder / mask for mask in masks.values()})
    for name in names:
        expected = Path(name).with_suffix(".png")
        if name not in masks and nearby.find(folder / expected):
            masks[name] = expected
    if not masks:
        expected = folder / Path(names[0]).with_suffix(".png")
        problem = f"{folder} has no mask of any image, such as {expected}"
        raise InputError(f"{problem}: put masks there, or leave `--masks-path` out of the command.")
    return masks


def _check_folders(data: Path, options: ParserOptions, names: Sequence[str], poses: Path) -> Iterator[Finding]:
    """Refuse a folder of images that are not those of the model, and warn of another or larger model beside it."""
    folder = data / options.images_path
    smaller = images.smaller_folder(folder, options.downscale_factor or 1)
    if not any(os.path.isfile(place / name) for place in (folder, smaller) for name in names):
        found = layouts.images_folder(data, options.colmap_path, names)
        if found is not None:
            problem = f"{poses}: image {names[0]} is not in {folder}, but in {data / found}"
            remedy = _words(data, dataclasses.replace(options, images_path=found), names)
            raise InputError(f"{problem}: add `{remedy}` after `colmap`.")
        if not folder.is_dir():
            problem = f"{poses} has poses of {len(names)} images, but there is no folder {folder}: put them there"
            words = f"`colmap {_words(data, options, names)} --images-path FOLDER`"
            raise InputError(f"{problem}, or end the command with {words}, or --downscale-factor 4 for images_4.")
    for other, others in layouts.find_reconstructions(data).items():
        twin = data / other / poses.name  # The same file, as in a copy, is no other model.
        differs = len(others) == len(names) and twin.is_file() and not filecmp.cmp(twin, poses, shallow=False)
        if len(others) > len(names) or differs:
            problem = f"{poses} has {len(names)} images, {data / other} has {len(others)}"
            words = _words(data, dataclasses.replace(options, colmap_path=other), others)
            yield warning(f"{problem}: end the command with `colmap {words}` to train on those.")


def _words(data: Path, options: ParserOptions, names: Sequence[str]) -> str:
    """Return the options that nerfstudio's parser of COLMAP's files needs to read these images and their model."""
    words = ["--colmap-path", str(options.colmap_path)]
    if options.images_path != ParserOptions.images_path:
        words += ["--images-path", str(options.images_path)]
    first = next(iter(names), "")
    automatic = images.automatic_factor(data / options.images_path / first)
    if options.downscale_factor not in (None, automatic):
        words += ["--downscale-factor", str(options.downscale_factor)]
    return shlex.join(words)


def _check_factor(folder: Path, names: Sequence[str], options: ParserOptions) -> Generator[Finding, None, int]:
    """Return the downscale factor of the images to read; raise InputError if none exist and nobody can be asked."""
    factor = options.downscale_factor or images.automatic_factor(folder / names[0])
    smaller = images.smaller_folder(folder, factor)
    if factor == 1 or all((smaller / name).parent.exists() for name in names):
        return factor
    missing = next(smaller / name for name in names if not (smaller / name).parent.exists())
    found = NearbyFiles(smaller).sentence(missing)
    if found is not None:
        raise InputError(f"{missing} {found}.")
    if options.downscale_factor is not None:
        problem = f"{smaller} does not exist, which should hold the images scaled down by `--downscale-factor {factor}`"
        scale = f"`--pipeline.datamanager.camera-res-scale-factor {1 / factor:.4g}`"
        remedy = f"leave that option out, and put {scale} before the parser's name"
    else:
        problem = f"{folder} holds images of more than {images.MAX_AUTO_RESOLUTION} px and there is no {smaller}"
        remedy = "add `--downscale-factor 1` after `colmap` to take them as they are"
    if sys.stdin is None or not sys.stdin.isatty():
        raise InputError(f"{problem}: {remedy}.")
    yield warning(f"{problem}: nerfstudio will ask whether to make it with ffmpeg; say yes, or {remedy}.")
    return 1
