"""Image quality and rendering speed of a trained splatting model, the same for every method.

The metrics are computed here and not by the model: nerfstudio's own ones differ between methods and versions. Images
are float in [0, 1], not rounded to 8 bits.

- `ssim` is torchmetrics': a Gaussian window of 11 px, σ = 1.5 px, the image reflected at its border, the mean over all
  pixels.
- `ssim_padded` is what 3DGS and the papers after it report: the same but zeros outside the image, where both images are
  then equal. On photographs of 0.7 to 2 megapixels with an SSIM of 0.65 to 0.95 it was 0.0007 to 0.0018 larger.
- `lpips` is torchmetrics' with AlexNet, which sees the images stretched to [-1, 1], as it was trained to.
- `lpips_vgg` is what 3DGS and the papers after it report: VGG, which is handed the images in [0, 1].
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from pytorch_msssim import ssim as ssim_without_border
from torch import Tensor

from sadgs_ns.gsplat_internals import NEAR_PLANE

if TYPE_CHECKING:  # torchmetrics takes a second to import, which is no part of the training that is timed
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

View = tuple[Any, dict[str, Any]]
"""A nerfstudio Cameras of one camera, and its batch with "image" [H, W, 3 or 4], uint8 or float."""

Networks = Mapping[str, "LearnedPerceptualImagePatchSimilarity | None"]
"""LPIPS networks by the names of their results; None where there are no weights."""

_WINDOW = 11
"""Width of SSIM's window in px."""


def now() -> float:
    """Seconds on a monotonic clock, after all work that the GPU has been given."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def load_lpips() -> LearnedPerceptualImagePatchSimilarity | None:
    """LPIPS with AlexNet, on the CPU, or None and one printed line where its weights cannot be had."""
    return _load("alex")


def load_lpips_vgg() -> LearnedPerceptualImagePatchSimilarity | None:
    """LPIPS with VGG, on the CPU, or None and one printed line unless its weights lie in $TORCH_HOME."""
    from torchvision.models import VGG16_Weights

    weights = Path(torch.hub.get_dir(), "checkpoints", Path(VGG16_Weights.DEFAULT.url).name)
    if weights.exists():
        return _load("vgg")
    print(f"LPIPS with VGG is left out: there is no {weights}.")
    return None


def _load(net: Literal["alex", "vgg"]) -> LearnedPerceptualImagePatchSimilarity | None:
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    try:
        return LearnedPerceptualImagePatchSimilarity(net_type=net, normalize=net == "alex")
    except (OSError, RuntimeError) as error:
        name = {"alex": "AlexNet", "vgg": "VGG"}[net]
        print(f"LPIPS is left out, its {name} weights are not in $TORCH_HOME and not to be downloaded ({error}).")
        return None


@torch.no_grad()
def render(model: Any, view: View) -> tuple[Tensor, Tensor]:
    """Render a view with a splatting model in eval mode.

    Returns:
        The rendering and the photograph over the rendering's background, in [0, 1]. [1, 3, H, W] both
    """
    camera, batch = view
    outputs = model.get_outputs_for_camera(camera)
    truth = model.composite_with_background(model.get_gt_img(batch["image"]), outputs["background"])
    return tuple(image[..., :3].clamp(0, 1).movedim(-1, 0)[None] for image in (outputs["rgb"], truth))  # type: ignore[return-value]


@torch.no_grad()
def quality(model: Any, views: Iterable[View], networks: Networks) -> dict[str, Any]:
    """Means over views of `psnr` in dB, `ssim`, `ssim_padded`, and the LPIPS of each network (None without one).

    Where the model's configuration asks for `color_corrected_metrics`, each is there a second time, as `cc_psnr` and so
    on, nerfstudio's names, of renderings whose colours were fitted to the photograph by quadratic least squares.
    `view_psnr` lists the PSNR of each view in their order: a mean over few views can be the work of one. The
    networks are on the model's device during the call only, so that they take no memory from training.
    """
    from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

    fits = getattr(model.config, "color_corrected_metrics", False)
    used = {name: network.to(model.device) for name, network in networks.items() if network is not None}
    window: Any = {"gaussian_kernel": True, "sigma": 1.5, "kernel_size": _WINDOW}
    measures: dict[str, Any] = {
        "psnr": partial(peak_signal_noise_ratio, data_range=1.0),
        "ssim": partial(structural_similarity_index_measure, data_range=1.0, **window),
        "ssim_padded": ssim_padded,
        **used,
    }
    values: dict[str, list[float]] = {
        f"{prefix}{name}": [] for prefix in ("", *(["cc_"] if fits else [])) for name in {**measures, **networks}
    }
    # nerfstudio has cuDNN search for algorithms, with whatever memory is free as their workspace. Probably so a process
    # came to hold 133 GiB, for want of which another one on the same GPU failed here.
    cudnn = torch.backends.cudnn
    with cudnn.flags(enabled=True, benchmark=False, deterministic=False, allow_tf32=cudnn.allow_tf32):
        for view in views:
            rendered, truth = render(model, view)
            for prefix, image in (("", rendered), *([("cc_", fitted(rendered, truth))] if fits else [])):
                for name, measure in measures.items():
                    values[f"{prefix}{name}"].append(float(measure(image, truth)))
    for network in used.values():
        network.cpu()
    means = {name: statistics.fmean(of_views) if of_views else None for name, of_views in values.items()}
    return means | {"view_psnr": [round(psnr, 2) for psnr in values["psnr"]]}


def view_psnr_in_viewers(model: Any, views: Iterable[View], view_psnr: list[float]) -> list[float]:
    """Return the PSNR of each view in dB as other programs' viewers show the exported file: from NEAR_PLANE on.

    Args:
        view_psnr: What `quality` measured; returned unless the model has a `near_plane` that lies beyond theirs.
    """
    near_plane = getattr(model, "near_plane", 0.0)
    if near_plane <= NEAR_PLANE:
        return view_psnr
    model.near_plane = NEAR_PLANE
    try:
        return quality(model, views, {})["view_psnr"]
    finally:
        model.near_plane = near_plane


def fitted(image: Tensor, truth: Tensor) -> Tensor:
    """The rendering with its colours fitted to the photograph. [1, 3, H, W] both, in [0, 1]"""
    from nerfstudio.model_components.lib_bilagrid import color_correct

    return color_correct(image[0].movedim(0, -1), truth[0].movedim(0, -1)).movedim(-1, 0)[None]


def ssim_padded(image: Tensor, truth: Tensor) -> Tensor:
    """SSIM as 3DGS computes it: zeros lie outside the images, and every pixel counts. [B, 3, H, W] both, in [0, 1]"""
    border = [_WINDOW // 2] * 4
    padded = (torch.nn.functional.pad(one, border) for one in (image, truth))
    return ssim_without_border(*padded, data_range=1.0, win_size=_WINDOW, win_sigma=1.5)


@torch.no_grad()
def frames_per_second(model: Any, cameras: list[Any], passes: int = 3) -> float:
    """Rendering rate over all cameras, colour and depth: the median of some passes."""
    seconds = []
    for _ in range(passes):
        start = now()
        for camera in cameras:
            model.get_outputs_for_camera(camera)
        seconds.append(now() - start)
    return len(cameras) / statistics.median(seconds)
