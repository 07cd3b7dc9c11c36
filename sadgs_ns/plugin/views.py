"""The training views: which of them a step takes, and their images and cameras on the training device."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import torch
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager
from torch import Tensor

from sadgs_ns.data.cameras import refuse_failed_undistortion
from sadgs_ns.distributed.bands import views_of_rank
from sadgs_ns.distributed.world import World
from sadgs_ns.plugin.images import ImagesAhead, thread_count
from sadgs_ns.plugin.model import SadgsModel
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world


class TrainingViews:
    """Draws training views and gives their cameras.

    Args:
        datamanager: Holds the images, the cameras, and the order in which views are drawn.
        model: Its camera optimizer corrects the cameras, and its device is the training device.

    Attributes:
        world: The processes of the run, of which each composites its share of a step.
    """

    def __init__(self, datamanager: FullImageDatamanager, model: SadgsModel) -> None:
        self.datamanager = datamanager
        self.model = model
        self.world = World()
        self._next_round: tuple[Any, list[int]] = None, []  # It is drawn from this state of the random generator.
        self._foreseen: deque[tuple[list[int], list[int]]] = deque()
        """Views of the next steps, and which of them this process composites."""
        self._steps: Iterator[list[int]] = iter(())
        """Yields the steps after these."""

    def __len__(self) -> int:
        """Number of training views."""
        return len(self.datamanager.train_dataset)

    @cached_property
    def ahead(self) -> ImagesAhead | None:
        """What brings images from the host ahead of their step; None where all images are on the device."""
        config = self.datamanager.config
        if config.cache_images == "gpu":
            return None
        return ImagesAhead(self.datamanager.cached_train, self.model.device, thread_count(config.max_thread_workers))

    @cached_property
    def sizes(self) -> list[tuple[int, int]]:
        """Height and width in px of all training images."""
        _ = self.datamanager.cached_train  # Undistorting the images has changed their sizes.
        cameras = self.datamanager.train_dataset.cameras
        return list(zip(cameras.height.flatten().tolist(), cameras.width.flatten().tolist(), strict=True))

    def draw(self, number: int, codes: tuple[bool, bool] = (False, False)) -> list[tuple[int, dict[str, Any]]]:
        """Draw the views of one step in nerfstudio's order, which is a sequence of rounds through all views.

        Where a round ends inside the step, the next one begins with those of its views that the step does not have yet;
        the views that were passed over come first in the next step. No view is drawn twice, then, unless a round holds
        fewer views than the step takes. Raises InputError as `ImagesAhead.take`.

        Args:
            number: Views to draw, at least 1 and at most as many as there are.
            codes: Whether this step, and whether the next one, needs the codes of S̄.

        Returns:
            Index and data of each view; the image is on the training device, and where images travel so is the mask.
            Where they travel, and there are several processes, views that only others composite come without data.
        """
        datamanager, device, ahead = self.datamanager, self.model.device, self.ahead
        indices: list[int] = []
        for _ in range(number):
            _take(datamanager.train_unseen_cameras, indices)
            if not datamanager.train_unseen_cameras:
                datamanager.train_unseen_cameras = datamanager.sample_train_cameras()
        if ahead is None:
            data = {index: datamanager.cached_train[index] for index in indices}
            drawn = {i: {**its, "image": its["image"].to(device, non_blocking=True)} for i, its in data.items()}
        else:
            composited = self._composited(indices)
            # This does not change from step to step, so that no view is forgotten that was on its way.
            share = -(-number // self.world.num_ranks)
            upcoming, following = self._upcoming(indices, ahead.threads + 2 * share)
            ahead.load([*composited, *upcoming])
            drawn = {index: {} for index in indices} | {i: ahead.take(i, codes[0]) for i in composited}
            ahead.load(upcoming)  # A view that was just taken may come again soon.
            ahead.send(following, codes[1])
        return [(index, drawn[index]) for index in indices]

    def _composited(self, indices: Sequence[int]) -> list[int]:
        """Return those of a step's views, each once, of which this process composites rows."""
        if not self.world.alone:
            of_step = views_of_rank([self.sizes[i] for i in indices], self.world.num_ranks, self.world.rank)
            indices = [indices[position] for position in of_step]
        return list(dict.fromkeys(indices))

    def _upcoming(self, drawn: list[int], most: int) -> tuple[list[int], list[int]]:
        """Return the views that this process will composite next, as far as they are known.

        Steps that were foreseen stay so, as long as those that are drawn are among them; looking for all of them anew
        in each step would take longer the more processes there are.

        Args:
            drawn: Views of the step that has been drawn.
            most: Number of views that are enough, unless the next step has more.

        Returns:
            The views of several steps, each once, and those among them of the next step.
        """
        foreseen = self._foreseen
        anew = not foreseen or foreseen.popleft()[0] != drawn
        if anew:
            foreseen.clear()
            self._steps = self._next_steps(len(drawn))
        upcoming = dict.fromkeys(index for _, composited in foreseen for index in composited)
        # What is foreseen is always ahead of what is drawn, so that a round that begins is the one that was foreseen.
        while len(upcoming) < most or len(foreseen) < 2:
            step = next(self._steps, None)
            if step is not None:
                foreseen.append((step, self._composited(step)))
                upcoming |= dict.fromkeys(foreseen[-1][1])
            elif anew:
                break
            else:  # Another round may be known by now.
                foreseen.clear()
                upcoming.clear()
                self._steps, anew = self._next_steps(len(drawn)), True
        following = foreseen[0][1] if foreseen else []
        return list(upcoming)[: max(most, len(following))], following

    def _next_steps(self, number: int) -> Iterator[list[int]]:
        """Yield the views of the next steps, as far as they are known without changing what will be drawn."""
        datamanager = self.datamanager
        generator, order, more = datamanager.random_generator, [*datamanager.train_unseen_cameras], True
        while True:
            step: list[int] = []
            while len(step) < number:
                if not order and not more:
                    # Which part of a step this process composites depends on the views of all of it.
                    if step and self.world.alone:
                        yield step
                    return
                if not order:
                    state, more = generator.getstate(), False
                    if self._next_round[0] != state:
                        self._next_round = state, datamanager.sample_train_cameras()
                        generator.setstate(state)
                    order = [*self._next_round[1]]
                _take(order, step)
            yield step

    def close(self) -> None:
        """End the threads that decode images; they start again if another view is drawn."""
        if vars(self).get("ahead") is not None:
            vars(self)["ahead"].close()

    def put_back(self, indices: Sequence[int]) -> None:
        """Let drawn views be the first of the next step, since what was drawn of them did not count."""
        self.datamanager.train_unseen_cameras = [*indices, *self.datamanager.train_unseen_cameras]

    @cached_property
    def cameras(self) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
        """World-to-camera matrices [4, 4] and intrinsics in px [3, 3] of all training views, each a tensor of its own.

        They are made once, because asking nerfstudio's cameras for them in each step makes the host wait for the
        device. Raises InputError if undistorting an image failed.
        """
        dataset = self.datamanager.train_dataset
        _ = self.datamanager.cached_train  # Undistorting the images has changed the intrinsics.
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
        _, every_K = self.cameras
        viewmats, Ks = [self.viewmat(index) for index in indices], [every_K[index] for index in indices]
        n = len(indices)
        if n == 1:
            return viewmats[0][None], Ks[0][None]
        # This takes one copy on the device instead of two; both results are contiguous, as gsplat wants them.
        flat_viewmats, flat_Ks = torch.cat([matrix.flatten() for matrix in viewmats + Ks]).split([16 * n, 9 * n])
        return flat_viewmats.view(n, 4, 4), flat_Ks.view(n, 3, 3).detach()


def _take(order: list[int], step: list[int]) -> None:
    """Move a view from the order of those to come to a step: the first that the step does not have, if there is one."""
    position = next((position for position, index in enumerate(order) if index not in step), 0)
    step.append(order.pop(position))
