"""The training views: which of them a step takes, and their images and cameras on the training device."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import torch
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager
from torch import Tensor

from sadgs_ns.data.cameras import refuse_failed_undistortion
from sadgs_ns.errors import InputError
from sadgs_ns.plugin.model import SadgsModel
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world


class TrainingViews:
    """Draws training views and gives their cameras.

    Args:
        datamanager: Holds the images, the cameras, and the order in which views are drawn.
        model: Its camera optimizer corrects the cameras, and its device is the training device.
    """

    def __init__(self, datamanager: FullImageDatamanager, model: SadgsModel) -> None:
        self.datamanager = datamanager
        self.model = model

    def __len__(self) -> int:
        """Number of training views."""
        return len(self.datamanager.train_dataset)

    def draw(self, number: int) -> list[tuple[int, dict[str, Any]]]:
        """Draw the views of one step in nerfstudio's order, which is a sequence of rounds through all views.

        Where a round ends inside the step, the next one begins with those of its views that the step does not have yet;
        the views that were passed over come first in the next step. No view is drawn twice, then, unless a round holds
        fewer views than the step takes.

        Args:
            number: Views to draw, at least 1 and at most as many as there are.

        Returns:
            Index and data of each view; the image is on the training device.
        """
        datamanager, device = self.datamanager, self.model.device
        drawn: dict[int, dict[str, Any]] = {}
        views = []
        for _ in range(number):
            order = datamanager.train_unseen_cameras
            position = next((position for position, index in enumerate(order) if index not in drawn), 0)
            index = order.pop(position)
            if not order:
                datamanager.train_unseen_cameras = datamanager.sample_train_cameras()
            data = datamanager.cached_train[index]
            drawn[index] = {**data, "image": data["image"].to(device, non_blocking=True)}
            views.append((index, drawn[index]))
        return views

    def put_back(self, indices: Sequence[int]) -> None:
        """Let views be the first of the next step, since what was drawn of them did not count.

        Args:
            indices: Views that were drawn.
        """
        self.datamanager.train_unseen_cameras = [*indices, *self.datamanager.train_unseen_cameras]

    @cached_property
    def cameras(self) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
        """World-to-camera matrices [4, 4] and intrinsics in px [3, 3] of all training views, each a tensor of its own.

        They are made once, because asking nerfstudio's cameras for them in each step makes the host wait for the
        device.

        Raises:
            InputError: If a training image holds NaN or infinite pixels, masked or not (the loss multiplies by masks),
                or if undistorting it failed.
        """
        dataset = self.datamanager.train_dataset
        for index, data in enumerate(self.datamanager.cached_train):  # undistorting the images changes the intrinsics
            if data["image"].is_floating_point() and not data["image"].isfinite().all():
                name = dataset.image_filenames[index]
                raise InputError(f"{name} holds NaN or infinite pixels: replace them, or leave the image out.")
        cameras, device = dataset.cameras, self.model.device
        refuse_failed_undistortion(cameras, dataset.image_filenames)
        viewmats = viewmats_from_camera_to_world(cameras.camera_to_worlds)
        return viewmats.to(device).unbind(), cameras.get_intrinsics_matrices().to(device).unbind()

    def viewmat(self, index: int) -> Tensor:
        """World-to-camera matrix of a training view, corrected by the camera optimizer where it is on. [4, 4]"""
        viewmats, _ = self.cameras
        optimizer = self.model.camera_optimizer
        if optimizer.config.mode == "off":
            return viewmats[index]
        camera = self.datamanager.train_cameras[index : index + 1].to(self.model.device)
        camera.metadata = {"cam_idx": index}
        return viewmats_from_camera_to_world(optimizer.apply_to_camera(camera))[0]

    def stacked_cameras(self, indices: Sequence[int]) -> tuple[Tensor, Tensor]:
        """World-to-camera matrices [V, 4, 4] and intrinsics in px [V, 3, 3] of V training views."""
        viewmats, Ks = [self.viewmat(index) for index in indices], [self.cameras[1][index] for index in indices]
        n = len(indices)
        if n == 1:
            return viewmats[0][None], Ks[0][None]
        # This takes one copy on the device instead of two; both results are contiguous, as gsplat wants them.
        flat_viewmats, flat_Ks = torch.cat([matrix.flatten() for matrix in viewmats + Ks]).split([16 * n, 9 * n])
        return flat_viewmats.view(n, 4, 4), flat_Ks.view(n, 3, 3).detach()
