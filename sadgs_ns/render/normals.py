"""Render a map of the normals of Gaussians."""

from __future__ import annotations

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from gsplat.utils import normalized_quat_to_rotmat
from torch import Tensor

from sadgs_ns.render.blending import blend
from sadgs_ns.render.types import DEFAULTS, Cameras, RenderOptions


@torch.no_grad()
def normals_map(params: Mapping[str, Tensor], camera: Cameras, drawing: RenderOptions = DEFAULTS) -> Tensor:
    """Return the blended normals of the Gaussians, of unit length in world axes, 0 where nothing is drawn. [H, W, 3]

    A Gaussian's normal is the axis of its smallest scale, turned towards the camera. This is an estimate, because
    training does not flatten Gaussians; those of the depth map are as rough (docs/guide-viewing.md has both).
    The arguments are those of `blend`.
    """
    quats = F.normalize(params["quats"], dim=-1)
    rotmats = normalized_quat_to_rotmat(quats)  # The columns are the Gaussians' axes. [N, 3, 3]
    thinnest = params["scales"].argmin(dim=1)  # [N]
    normals = rotmats.gather(2, thinnest[:, None, None].expand(-1, 3, 1))[..., 0]  # [N, 3]
    viewmat = camera.viewmats[0]
    minus_center = viewmat[:3, :3].T @ viewmat[:3, 3]  # The camera's centre is −Rᵀ t. [3]
    rays = params["means"] + minus_center  # [N, 3]
    faces_away = (rays * normals).sum(dim=1, keepdim=True) > 0  # [N, 1]
    facing = torch.where(faces_away, -normals, normals)
    blended, _ = blend(params, facing, camera, drawing)
    return F.normalize(blended, dim=-1)
