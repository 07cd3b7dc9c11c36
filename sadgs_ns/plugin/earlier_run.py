"""The start of a run from the Gaussians of an earlier one, before photos were added to the capture."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape
from torch import Tensor

from sadgs_ns.data.coordinates import TRANSFORMS_NAME, Similarity, from_data
from sadgs_ns.errors import InputError
from sadgs_ns.plugin import checkpoints
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world

if TYPE_CHECKING:
    from sadgs_ns.plugin.pipeline import SadgsPipeline

_REMEDY = "give --pipeline.start-from the folder of a finished run of sadgs on this capture, or leave it out"


def start_from(pipeline: SadgsPipeline, run: Path) -> None:
    """Start from the Gaussians of an earlier run, and where none of them is, from those that the model starts from.

    They are moved to the frame of the present run, which nerfstudio's parsers derive from all cameras. Statistics and
    Adam's moments start anew. Call this before optimizers are made.

    Args:
        pipeline: The pipeline of the present run.
        run: The earlier run's folder.

    Raises:
        InputError: If the folder holds no checkpoint of this method, or does not tell how the run moved the data, or if
            the run was trained on another capture or with other harmonics.
    """
    found = checkpoints.read_chosen(run, None, None, _REMEDY)
    assert found is not None
    (path, state), parsed = found, pipeline.datamanager.train_dataparser_outputs
    if not (run / TRANSFORMS_NAME).is_file():
        raise InputError(f"{run} holds no {TRANSFORMS_NAME}, which tells how it moved the data: {_REMEDY}.")
    now = Similarity.of(parsed.dataparser_scale * parsed.dataparser_transform.double().numpy())
    change = now.after(from_data(run / TRANSFORMS_NAME).inverse())
    try:
        loaded = state["pipeline"] if isinstance(state["pipeline"], dict) else {}
        gaussians, views = pipeline.gaussians_of(loaded), loaded.get("_extra_state", {})
        if not {"images", "camera_positions"} <= views.keys():
            raise InputError("It does not tell of which views it is, so an earlier version or method made it.")
        positions = change.positions(views["camera_positions"].double().numpy())
        pipeline.refuse_other_capture(views["images"], torch.from_numpy(positions).float())
        if not change.keeps_all():
            gaussians = _moved(gaussians, change)
    except ValueError as error:  # An InputError is one, too.
        raise InputError(f"{path} cannot be started from: {str(error).rstrip('.')}; {_REMEDY}.") from error
    finite = torch.stack([value.flatten(1).isfinite().all(dim=1) for value in gaussians.values()]).all(dim=0)  # [N]
    dataset = pipeline.datamanager.train_dataset
    known = [index for index, file in enumerate(dataset.image_filenames) if file.name in views["images"]]
    cameras = dataset.cameras[torch.tensor(known, dtype=torch.long)]
    added = pipeline.model.start_from(
        {name: value[finite] for name, value in gaussians.items()},
        viewmats_from_camera_to_world(cameras.camera_to_worlds),
        cameras.get_intrinsics_matrices(),
        torch.cat([cameras.width, cameras.height], dim=-1),
    )
    CONSOLE.print(
        f"Starting from {int(finite.sum()):,} Gaussians of {path}, and from {added:,} points where it has none.",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
    held_out = {file.name for file in pipeline.datamanager.eval_dataset.image_filenames}
    if seen := len(held_out.intersection(views["images"])):
        CONSOLE.print(
            f"[yellow]{seen} of the {len(held_out)} views that are held out were trained on by {escape(str(run))}: "
            "what is measured on them says little of views that nobody saw.[/]",
            soft_wrap=True,
        )


def _moved(params: dict[str, Tensor], change: Similarity) -> dict[str, Tensor]:
    """Return parameters of Gaussians in another frame, with their harmonics turned. [N, …]

    Raises:
        ValueError: If the harmonics have a degree above 3.
    """
    arrays = {name: value.double().numpy() for name, value in params.items()}
    degree = math.isqrt(1 + arrays["features_rest"].shape[1]) - 1
    moved = {
        "means": change.positions(arrays["means"]),
        "scales": change.log_scales(arrays["scales"]),
        "quats": change.rotations(arrays["quats"]),
        "features_rest": change.harmonics(degree)[1:, 1:] @ arrays["features_rest"],
    }
    return params | {name: torch.from_numpy(value).float() for name, value in moved.items()}
