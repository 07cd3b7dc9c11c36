"""Image quality and rendering speed of a trained splatting model, the same for every method.

The metrics are computed here and not by the model: nerfstudio's own ones differ between methods and versions. Images
are float in [0, 1], not rounded to 8 bits.

SSIM is torchmetrics': a Gaussian window of 11 px, σ = 1.5 px, the image reflected at its border, all pixels counted.
LPIPS is torchmetrics' with AlexNet, which sees the images stretched to [-1, 1], as it was trained to.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Iterable
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from sadgs_ns.gsplat_compat import NEAR_PLANE

if TYPE_CHECKING:  # torchmetrics takes a second to import, which is no part of the training that is timed
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

View = tuple[Any, dict[str, Any]]
"""A nerfstudio Cameras of one camera, and its batch with "image" [H, W, 3 or 4], uint8 or float."""


def now() -> float:
    """Seconds on a monotonic clock, after all work that the GPU has been given."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def load_lpips() -> LearnedPerceptualImagePatchSimilarity | None:
    """LPIPS with AlexNet, on the CPU, or None and one printed line where its weights cannot be had."""
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    try:
        return LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True)
    except (OSError, RuntimeError) as error:
        print(f"LPIPS is left out, its weights are not in $TORCH_HOME and not to be downloaded ({error}).")
        return None


@torch.no_grad()
def render(model: Any, view: View) -> tuple[dict[str, Tensor], Tensor]:
    """Render a view in eval mode, and return the renderings by the prefixes of their metrics, and the photograph.

    The photograph lies over its background. All are [1, 3, H, W] and in [0, 1]. `cc_` has colours that were fitted to
    the photograph, if the model's configuration asks for it, and `gain_` the photograph's exposure, which the colours
    of SfM points tell, if the model was trained with gains.
    """
    from nerfstudio.model_components.lib_bilagrid import color_correct

    camera, batch = view
    outputs = model.get_outputs_for_camera(camera)
    truth = model.composite_with_background(model.get_gt_img(batch["image"]), outputs["background"])
    truth = truth[..., :3].clamp(0, 1)
    images = {"": outputs["rgb"][..., :3].clamp(0, 1)}
    if getattr(model.config, "color_corrected_metrics", False):
        images["cc_"] = color_correct(images[""], truth)
    if getattr(model, "exposure", None) is not None:  # Models of other methods have none.
        gained = model.at_exposure_of_photo(outputs, batch)
        if gained is not None:
            images["gain_"] = gained
    return {prefix: _as_batch(image) for prefix, image in images.items()}, _as_batch(truth)


def _as_batch(image: Tensor) -> Tensor:
    """[H, W, 3] → [1, 3, H, W]"""
    return image.movedim(-1, 0)[None]


@torch.no_grad()
def quality(
    model: Any, views: Iterable[View], network: LearnedPerceptualImagePatchSimilarity | None = None
) -> dict[str, Any]:
    """Means over views of `psnr` in dB, `ssim` and `lpips`, which is None without the network.

    Where the model's configuration asks for `color_corrected_metrics`, each is there a second time, as `cc_psnr` and so
    on, nerfstudio's names, of renderings whose colours were fitted to the photograph by quadratic least squares. Where
    training used gains, `gain_psnr` and so on are of renderings with the photograph's exposure.
    `view_psnr` lists the PSNR of each view in their order: a mean over few views can be the work of one. The network is
    on the model's device during the call only, so that it takes no memory from training.
    """
    from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

    measures: dict[str, Any] = {
        "psnr": partial(peak_signal_noise_ratio, data_range=1.0),
        "ssim": partial(structural_similarity_index_measure, data_range=1.0, sigma=1.5, kernel_size=11),
        "lpips": None,
    }
    if network is not None:
        measures["lpips"] = network.to(model.device)
    values: dict[str, list[float]] = {name: [] for name in measures}
    # nerfstudio has cuDNN search for algorithms, with whatever memory is free as their workspace. Probably so a process
    # came to hold 133 GiB, for want of which another one on the same GPU failed here.
    cudnn = torch.backends.cudnn
    with cudnn.flags(enabled=True, benchmark=False, deterministic=False, allow_tf32=cudnn.allow_tf32):
        for view in views:
            images, truth = render(model, view)
            for prefix, image in images.items():
                for name, measure in measures.items():
                    of_views = values.setdefault(f"{prefix}{name}", [])
                    if measure is not None:
                        of_views.append(float(measure(image, truth)))
    if network is not None:
        network.cpu()
    measured: dict[str, Any] = {}
    for name, of_views in values.items():
        measured[name] = None
        if of_views:
            measured[name] = statistics.fmean(of_views)
    measured["view_psnr"] = [round(psnr, 2) for psnr in values["psnr"]]
    return measured


def view_psnr_in_viewers(model: Any, views: Iterable[View], view_psnr: list[float]) -> list[float]:
    """Return the PSNR of each view in dB as other programs' viewers show the exported file.

    They draw from NEAR_PLANE on, and Gaussians at any distance off the axis. `view_psnr`, which `quality` measured, is
    returned if the model's plan does so, too.
    """
    plan = getattr(model, "plan", None)  # Models of other methods have none.
    if plan is None or (plan.near_plane <= NEAR_PLANE and plan.max_off_axis == 0):
        return view_psnr
    model.plan = dataclasses.replace(plan, near_plane=NEAR_PLANE, max_off_axis=0.0)
    try:
        return quality(model, views)["view_psnr"]
    finally:
        model.plan = plan
