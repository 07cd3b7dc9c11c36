"""The training cameras' poses, refined together with the Gaussians.

A table holds a correction of each view in its camera's frame (geometry/poses.py). A step makes the matrices of its
views from it on the device, so that steps can be CUDA graphs. The motion that all cameras have in common is taken out
again after each step: held-out cameras, viewers and the file know nothing of it.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sadgs_ns.geometry.poses import Gauge, corrected, image_motion, pixel_steps, view_depths
from sadgs_ns.kernels import use_triton
from sadgs_ns.training.run.checkpoints import check_number_of_views
from sadgs_ns.training.step.row_adam import RowUpdate

_POINTS = 5000  # Points, at equal distances among all, from which the depths of views are taken


def corrected_views(
    initial: Tensor,  # World-to-camera matrices of C views before correction. [C, 4, 4]
    table: Tensor,  # Corrections of all views. [V, 6]
    view_ids: Tensor,  # Indices of the views. int64 [C]
) -> Tensor:
    """Return the corrected matrices of views, differentiable by the table. [C, 4, 4]"""
    if use_triton(table):
        from sadgs_ns.kernels.poses import corrected as fused_corrected

        return fused_corrected(initial, table, view_ids)
    return corrected(initial, table.index_select(0, view_ids))


class RefinedPoses(torch.nn.Module):
    """Corrections of V training cameras' poses. Call `set_cameras` before anything else."""

    initial: Tensor  # World-to-camera matrices before correction. [V, 4, 4]
    units: Tensor  # How far each number of a correction goes to move its image by 1 px. [V, 6]
    gauge: Gauge

    def __init__(self, num_views: int) -> None:
        super().__init__()
        self.table = torch.nn.Parameter(torch.zeros(num_views, 6))

    @torch.no_grad()
    def set_cameras(
        self,
        viewmats: Tensor,  # [V, 4, 4]
        Ks: Tensor,  # Intrinsics in px. [V, 3, 3]
        sizes: Tensor,  # Width and height in px. [V, 2]
        points: Tensor,  # Points of the scene. [P, 3]
    ) -> None:
        """Set the initial poses, and derive units and gauge from them and the scene's depth; all are then fixed."""
        exact = viewmats.double().cpu()
        Ks = Ks.double().cpu()
        sizes = sizes.double().cpu()
        sample = points[:: len(points) // _POINTS + 1].double().cpu()
        depths = view_depths(exact, Ks, sizes, sample)
        motion = image_motion(Ks, sizes, depths)
        self.initial = viewmats.to(self.table)
        self.units = pixel_steps(motion).to(self.table)
        self.gauge = Gauge.of(self.initial, motion)

    def viewmats(
        self,
        initial: Tensor,  # World-to-camera matrices of C views before correction. [C, 4, 4]
        view_ids: Tensor,  # Indices of the views. int64 [C]
        table: Tensor | None = None,  # [V, 6]
    ) -> Tensor:
        """Return the corrected matrices of views, differentiable by `table`, which is the module's by default."""
        if table is None:
            table = self.table
        return corrected_views(initial, table, view_ids)

    @torch.no_grad()
    def viewmat(self, index: int) -> Tensor:
        """Return a view's matrix as it is now. [4, 4]"""
        row = slice(index, index + 1)
        return corrected(self.initial[row], self.table[row])[0]

    @torch.no_grad()
    def camera_to_world(self, index: int) -> Tensor:
        """Return a view's pose in OpenGL's axes, as nerfstudio has it. [3, 4]"""
        viewmat = self.viewmat(index)
        rotation = viewmat[:3, :3].T
        centre = -(rotation @ viewmat[:3, 3:])
        flip = viewmat.new_tensor([1.0, -1.0, -1.0])
        return torch.cat([rotation * flip, centre], dim=1)

    def row_update(
        self,
        views: list[Tensor],  # Indices of the views of each group of a step. int64 [C] each
        overflowed: list[Tensor | None],  # Of each group: 0 if it was drawn, or None if it surely was. int64 [1] each
    ) -> RowUpdate:
        """Return which corrections a step moves: those of the views that it drew. It does not wait for the device."""
        moved = torch.zeros_like(self.units[:, 0], dtype=torch.bool)
        for view_ids, flag in zip(views, overflowed, strict=True):
            if flag is None:
                moved.index_fill_(0, view_ids, True)
            else:
                moved.index_copy_(0, view_ids, (flag == 0).expand(len(view_ids)))
        return RowUpdate(moved, self.units)

    @torch.no_grad()
    def hold_frame(self) -> None:
        """Take the motion that all cameras have in common out of the table, without waiting for the device."""
        self.gauge.take_out(self.table)

    @torch.no_grad()
    def of_pose_adjustment(
        self,
        adjustment: Tensor,  # Translation and rotation vector of each view. [V, 6]
    ) -> Tensor:
        """Return the table for nerfstudio's camera optimizer SO3xR3, which earlier versions trained. [V, 6]

        It turns a camera and moves its centre along the world's axes. Of its SE3 the same is made, which differs by
        half the product of both.
        """
        rotation = self.initial[:, :3, :3]
        moves, turns = adjustment.to(self.initial).split(3, dim=1)
        vectors = -(rotation @ turns[..., None])[..., 0]
        still = torch.cat([vectors, torch.zeros_like(vectors)], dim=1)
        turned = corrected(self.initial, still)[:, :3, :3]
        return torch.cat([vectors, -(turned @ moves[..., None])[..., 0]], dim=1)


def fit_poses(state: dict[str, Any], poses: RefinedPoses | None) -> None:
    """Put poses that fit a model into the state of a checkpoint: its own, those of an earlier version, or none.

    Raises InputError if the adjustments of an earlier version are for other views.
    """
    table = state.pop("poses.table", None)
    adjustment = state.pop("camera_optimizer.pose_adjustment", None)
    if poses is None:
        return
    if table is None and adjustment is not None:
        check_number_of_views("camera_optimizer.pose_adjustment", adjustment, poses.table)
        table = poses.of_pose_adjustment(adjustment)
    if table is None:  # The poses were fixed.
        table = torch.zeros_like(poses.table)
    state["poses.table"] = table
