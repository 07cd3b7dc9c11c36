"""Plan memory before the first step: where the images are kept, and how many Gaussians the device can hold."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager

from sadgs_ns import host
from sadgs_ns.distributed.bands import views_of_rank
from sadgs_ns.errors import InputError
from sadgs_ns.method.ops import Params
from sadgs_ns.method.running_strategy import empty_state
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.render import step_memory
from sadgs_ns.render.step_memory import StepSize
from sadgs_ns.training.run.processes import least, number_of_processes, processes_on_this_machine
from sadgs_ns.training.step.structure_cache import PIXELS_PER_BATCH

PLANNED_SHARE = 0.8  # Share of the available memory to plan with; the rest is for fragments and other programs
QUANTIZED_BYTES = 3  # Bytes that S̄ takes for each pixel of the training images (`method.quantization`)
STRUCTURE_PIXEL_BYTES = 300  # Bytes that a pixel takes at most while S̄ is computed
MANY_IMAGES = 500  # Up to this many training images nerfstudio would keep on the device, however large they are
IMAGE_SHARE = 0.25  # Largest share of the device's free memory for the images if there are more than `MANY_IMAGES`
FEW_IMAGES_SHARE = 0.5  # The same if there are no more
HOST_SHARE = 0.5
"""Largest share of the host's free memory for decoded images. torch rounds a pinned image up to a power of two."""


@dataclass(frozen=True)
class TrainingSize:
    """What a run keeps and renders, apart from its Gaussians."""

    image_bytes: float  # Bytes of images and their S̄ on the training device
    step: StepSize  # The largest step of the run, without the Gaussians' pairs
    structure_bytes: float = 0.0  # To compute S̄ of a step's images before rendering; 0 if all is done at the start


def training_size(
    datamanager: FullImageDatamanager, views: int, processes: int = 1, has_color_maps: bool = False
) -> TrainingSize:
    """Measure a run with this many views a step, shared out to processes, without opening an image."""
    cameras = datamanager.train_dataset.cameras
    largest = int((cameras.height * cameras.width).max())
    pixels = math.ceil(views * largest / processes)  # A process composites its share.
    step = StepSize(views, pixels, exchanged=processes > 1, has_color_maps=has_color_maps)
    if datamanager.config.cache_images == "gpu":
        return TrainingSize(image_bytes(datamanager), step)
    sizes = [(height, width) for height, width in torch.cat([cameras.height, cameras.width], dim=-1).tolist()]
    here = _most_views_of_a_process(sizes, views, processes)
    # The images of the next step are there, too. A process has those that it composites, and S̄ of all.
    kept = (3 * here + QUANTIZED_BYTES * views) * largest
    structure = STRUCTURE_PIXEL_BYTES * max(largest, min(PIXELS_PER_BATCH, here * largest))
    return TrainingSize(float(kept), step, float(structure))


def _most_views_of_a_process(sizes: Sequence[tuple[int, int]], views: int, processes: int) -> int:
    """Return how many of a step's views a process composites rows of, at most; `sizes` are of all training views."""
    if len(set(sizes)) > 1:
        return views  # A process may have a part of each view.
    of_step = (sizes[0],) * views
    return max(len(views_of_rank(of_step, processes, rank)) for rank in range(processes))


def image_bytes(datamanager: FullImageDatamanager) -> float:
    """Return the bytes of all images, held-out ones too, and of S̄ of the training images."""
    train = _pixels_of(datamanager.train_dataset.cameras)
    held_out = _pixels_of(datamanager.eval_dataset.cameras)
    return 3 * (train + held_out) + QUANTIZED_BYTES * train


def _pixels_of(cameras: Cameras) -> float:
    """Return the number of pixels of all images of these cameras."""
    return float((cameras.height * cameras.width).sum())


@dataclass(frozen=True)
class ImageStorage:
    """Where a run keeps its images."""

    where: str  # A value of the datamanager's option `cache_images`
    sentence: str = ""  # What to tell the user; empty if the images are kept where the options ask for


def choose_image_storage(datamanager: FullImageDatamanager, device: torch.device) -> ImageStorage:
    """Choose where the images are kept, by the free memory, alike in all processes; call before they are loaded.

    The option `cache_images` must be "gpu" or "cpu". The caller applies what is returned.
    """
    requested: str = datamanager.config.cache_images
    size = image_bytes(datamanager)
    host_free = least(host.available_host_bytes() / processes_on_this_machine(), device)
    fits_host = size <= HOST_SHARE * host_free
    needs = f"decoded images and their structure take {size / 1e9:.2g} GB"
    on_host = "The images stay in the host's memory and are copied ahead of the steps"
    compressed = "The images stay compressed and are decoded ahead of the steps"
    if requested == "cpu":
        # Several processes would each decode all images.
        if fits_host or number_of_processes() == 1:
            return ImageStorage(requested)
        free = f"the host has {host_free / 1e9:.2g} GB free for each"
        return ImageStorage("compressed", f"{compressed}: {needs} in each process, and {free}.")
    if device.type != "cuda":
        if fits_host:
            return ImageStorage(requested)
        return ImageStorage("compressed", f"{compressed}: {needs}, and the host has {host_free / 1e9:.2g} GB free.")
    share = FEW_IMAGES_SHARE
    if len(datamanager.train_dataset) > MANY_IMAGES:
        share = IMAGE_SHARE
    device_free = least(step_memory.available_bytes(device)[0], device)
    if size <= share * device_free:
        return ImageStorage(requested)
    reason = f"{needs}, and the GPU has {device_free / 1e9:.2g} GB free"
    if fits_host:
        return ImageStorage("cpu", f"{on_host}: {reason}.")
    return ImageStorage("compressed", f"{compressed}: {reason}.")


def fit_to_memory(
    cap: int,  # The strategy's `max_gaussians`
    params: Params,  # The initial Gaussians of this process, one of `processes` with equal parts and a device each
    size: TrainingSize,
    budget_gb: float | None = None,  # Of each device, in 10⁹ bytes; None is `PLANNED_SHARE` of what is free
    processes: int = 1,
) -> tuple[int, str]:
    """Lower the cap of Gaussians to what the budget, or the device's free memory, holds; call before the first step.

    A cap below the present number adds no Gaussian and removes none. Without a budget, only the default of
    `max_gaussians` is lowered; without CUDA, nothing is.

    Returns the cap of all processes and a sentence for the user. Raises InputError if the budget holds no Gaussian.
    """
    device = params["means"].device
    n = len(params["means"])
    free, total = step_memory.available_bytes(device)
    if math.isinf(free):
        return cap, f"At most {cap:,} Gaussians: this device's memory is not planned with, so this is max_gaussians."
    state = empty_state(0, device)
    bytes_of_one = step_memory.kept_bytes(params, state) + step_memory.widest_bytes(params)

    def need(num_gaussians: int) -> float:
        """Return the bytes that a process with so many Gaussians needs at most."""
        step = replace(size.step, pairs=step_memory.PAIRS_PER_GAUSSIAN * size.step.views * num_gaussians)
        working = max(size.structure_bytes, *step_memory.step_bytes(num_gaussians, step, device).values())
        return size.image_bytes + bytes_of_one * num_gaussians + working

    why = ""
    if budget_gb is not None or cap == StructureAwareStrategy.max_gaussians:
        if budget_gb is None:
            budget = PLANNED_SHARE * free
            limit = f"{free / 1e9:.1f} GB are free"
        else:
            budget = min(1e9 * budget_gb, free)
            limit = f"memory_budget_gb is {budget_gb:g}"
        no_gaussians = {name: value[:0] for name, value in params.items()}
        left = budget - size.image_bytes
        rendered = step_memory.affordable_growth(no_gaussians, state, left, size.step)
        affordable = processes * min(rendered, (left - size.structure_bytes) / bytes_of_one)
        if budget_gb is not None and affordable < 1:
            raise InputError(
                f"pipeline.memory_budget_gb is {budget_gb:g} and leaves no room for Gaussians: images and rendering "
                f"take {need(0) / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free; raise it, take fewer or "
                "smaller images, or lower pipeline.views-per-iteration."
            )
        if affordable < cap:
            cap = max(int(affordable), 1)
            why = f"; {limit}"
            if cap < n * processes:
                why += f", which holds no more than the {n * processes:,} at the start: none will be added"
    needed = need(max(math.ceil(cap / processes), n))
    card = "the card"
    if processes > 1:
        card = "each card"
    return cap, f"At most {cap:,} Gaussians: {needed / 1e9:.1f} GB of {card}'s {total / 1e9:.1f} GB{why}."
