"""Where cameras stand, and rigid matrices the other way round.

A rotation is inverted by its transpose. The inverse of a general matrix takes a library of linear algebra, whose first
use on a GPU can take longer than all else here, and for which the host waits.
"""

from __future__ import annotations

import torch
from torch import Tensor


def camera_centres(
    viewmats: Tensor,  # World to camera, rigid [C, 4, 4]
) -> Tensor:
    """Return the positions of cameras in world space. [C, 3]"""
    rotations = viewmats[:, :3, :3]
    translations = viewmats[:, :3, 3:]
    return -(rotations.mT @ translations)[..., 0]


def inverse_rigid(
    viewmats: Tensor,  # Rigid [C, 4, 4]
) -> Tensor:
    """Return the inverses of rigid matrices, such as camera to world for world to camera. [C, 4, 4]"""
    rotations = viewmats[:, :3, :3].mT  # [C, 3, 3]
    upper = torch.cat([rotations, camera_centres(viewmats)[..., None]], dim=2)  # [C, 3, 4]
    return torch.cat([upper, viewmats[:, 3:]], dim=1)
