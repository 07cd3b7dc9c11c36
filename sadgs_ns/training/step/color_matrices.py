"""A colour matrix for each training view, so that the Gaussians need not learn its exposure and white balance.

A gain in linear light is an affine map of all but the darkest sRGB values, so the matrices can express any exposure.
3DGS learns such matrices, too (its option `exposure`), of all training views and without an anchor.
"""

from __future__ import annotations

import torch
from torch import Tensor


def anchored(
    matrices: Tensor,  # [V, 3, 4]
    views: Tensor,  # [C]
) -> Tensor:
    """Return the matrices of some views, moved so that the mean over all views is the identity. [C, 3, 4]

    Otherwise the Gaussians and all matrices could change together, and held-out views, which have no matrix, would have
    colours that no photo has. No gradient flows through the mean.
    """
    with torch.no_grad():
        shift = torch.eye(3, 4, dtype=matrices.dtype, device=matrices.device) - matrices.mean(dim=0)
    return matrices.index_select(0, views) + shift


def correct_colors(
    render: Tensor,  # [C, H, W, 3]
    alpha: Tensor,  # [C, H, W, 1]
    matrices: Tensor,  # [C, 3, 4]
) -> Tensor:
    """Apply affine maps (M | b) to the colours and alphas that `composite` returned: M c + α b. [C, H, W, 3]

    The offset b counts as much as the Gaussians cover: pixels that nothing covers stay black, and teach the matrices
    nothing.
    """
    return render @ matrices[:, None, :, :3].mT + alpha * matrices[:, None, None, :, 3]
