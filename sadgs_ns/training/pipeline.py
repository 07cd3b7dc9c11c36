"""nerfstudio's pipeline for this method: it holds data and model, prepares each step, and reports on it."""

from __future__ import annotations

import math
import statistics
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import asdict
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer
from nerfstudio.pipelines.base_pipeline import VanillaPipeline
from torch import Tensor

from sadgs_ns.data.cameras import camera_positions, check_camera_types
from sadgs_ns.data.checks.capture import findings_of
from sadgs_ns.data.exif_exposure import exposure_stops, exposures_of
from sadgs_ns.errors import InputError
from sadgs_ns.geometry.exposure import gains_of_others
from sadgs_ns.geometry.point_colors import srgb_gains
from sadgs_ns.gsplat_compat import FAR_PLANE
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world
from sadgs_ns.render.types import Cameras as Pinholes
from sadgs_ns.training.config import SadgsPipelineConfig
from sadgs_ns.training.datamanager import SadgsDatamanager
from sadgs_ns.training.model import NORMALS, SadgsModel
from sadgs_ns.training.photo_names import photo_names, same_photos
from sadgs_ns.training.run.checkpoints import check_number_of_views, check_order_of_views
from sadgs_ns.training.run.memory_plan import choose_image_storage
from sadgs_ns.training.run.moved_search import MovedSearch
from sadgs_ns.training.run.point_observations import PointObservations
from sadgs_ns.training.run.progress import note, warn
from sadgs_ns.training.run.run_plan import RunPlan, unknown_fields
from sadgs_ns.training.step import nonfinite
from sadgs_ns.training.step.images import stack
from sadgs_ns.training.step.nonfinite import NonFiniteLog
from sadgs_ns.training.step.structure_cache import StructureCache, observe_training_views
from sadgs_ns.training.step.train_step import StepResult, ViewGroup
from sadgs_ns.training.step.views import TrainingViews
from sadgs_ns.viewer.cleaning_panel import CleaningPanel
from sadgs_ns.viewer.elements import shows_output
from sadgs_ns.viewer.shown_run import ShownRun
from sadgs_ns.viewer.structure_panel import StructurePanel

_OF_VIEWS = {"_model.color_matrices", "_model.poses.table", "_model.camera_optimizer.pose_adjustment"}
"""Tensors of a checkpoint that have a row for each training view."""
_NAMED_STEPS = 5  # Number of iterations whose images a report of losses that are not finite names
_SAMPLED = 1000  # About so many cameras and Gaussians suffice to find out whether training can see anything


class SadgsPipeline(VanillaPipeline):
    """Data, model and viewer panels of a run. Raises InputError if options are wrong or the data is unusable."""

    config: SadgsPipelineConfig
    datamanager: SadgsDatamanager
    model: SadgsModel  # nerfstudio's property; the model is never wrapped for several devices

    def __init__(self, config: SadgsPipelineConfig, *args: Any, **kwargs: Any) -> None:
        config.check()
        mode = kwargs.get("test_mode", "val")
        opens_images = mode != "inference"  # This mode is for rendering new views.
        if mode != "val":  # The run is loaded, and no option of nerfstudio's commands names other data.
            _check_data_of_run(config)
        for finding in findings_of(config.datamanager, open_images=opens_images):
            if finding.severity == "warning":
                warn(finding.sentence)
        super().__init__(config, *args, **kwargs)
        backend = self.model.backend  # This raises InputError if it cannot work.
        for dataset in (self.datamanager.train_dataset, self.datamanager.eval_dataset):
            check_camera_types(dataset.cameras)
        if opens_images and config.datamanager.cache_images != "compressed":
            self._store_images()
        self._warn_of_other_background()
        self._warn_of_missing_masks()
        if config.model.backend == "auto" and backend == "gsplat":
            warn("Triton's kernels are not used: training takes about twice as long without them.")
        if self.model.poses is not None and isinstance(self.datamanager.config.dataparser, BlenderDataParserConfig):
            note("The poses stay as they are: those of Blender data are exact.")
            self.model.poses = None
        self.model.set_cameras(self.datamanager.train_dataset.cameras)
        self.views = TrainingViews(self.datamanager, self.model)
        self.structure_cache = StructureCache(
            self.views,
            self.device,
            self.model.photo,
            config.frequency_constant,
            energy_blur=config.energy_blur,
            epsilon=config.epsilon,
        )
        self.moved_search = MovedSearch(self.structure_cache)
        self.log = NonFiniteLog(self.device)
        self._infos: list[dict[str, Any]] = []  # The rasterizer's, of the last step until densification has read them
        self._means_gradient: Tensor | None = None  # [N, 3], of the last step
        self.diverged = ""  # A sentence with the reason once nothing is learned any more
        shown_run = ShownRun(
            model=self.model,
            datamanager=self.datamanager,
            structure_tensors=self.structure_cache,
            view_cameras=self._view_cameras,
            observe=partial(observe_training_views, self.structure_cache),
            warn=warn,
        )
        self.structure = StructurePanel(shown_run)
        self.cleaning = CleaningPanel(shown_run)
        self.model.viewer_outputs = self._viewer_outputs
        self.model.gain_of_held_out = self._gain_of_held_out

    def _store_images(self) -> None:
        """Keep the images where the memory has room for them, and print it if that is not where the options say."""
        storage = choose_image_storage(self.datamanager, self.device)
        self.datamanager.config.cache_images = storage.where  # type: ignore[assignment]
        if storage.sentence:
            note(storage.sentence)

    def _warn_of_other_background(self) -> None:
        """Print a warning if the parser puts transparent images on another background than the Gaussians'."""
        behind_images = getattr(self.datamanager.dataparser.config, "alpha_color", None)
        behind_gaussians = self.config.model.background_color
        if behind_images is not None and behind_images != behind_gaussians:
            warn(
                f"The images were put on {behind_images}, the Gaussians lie on {behind_gaussians}: consider "
                f"--pipeline.model.background-color {behind_images}."
            )

    def _warn_of_missing_masks(self) -> None:
        """Print a warning if an option names a colour for what masks hide, and the capture has no masks."""
        color = getattr(self.datamanager.dataparser.config, "mask_color", None)
        if color and self.datamanager.train_dataparser_outputs.mask_filenames is None:
            warn("--mask-color does nothing, because the capture has no masks: leave it out, or name them.")

    def point_observations(self, split: Literal["train", "eval"]) -> PointObservations | None:
        """Return a reader of the SfM points' colours in the photos of a split; None if there are no points.

        The reader uses the dataset's cameras, which change when images are undistorted: give it images that are loaded.
        """
        if self.model.seed_points is None:
            return None
        points, _ = self.model.seed_points
        dataset = self.datamanager.eval_dataset
        if split == "train":
            dataset = self.datamanager.train_dataset
        return PointObservations(points.float(), dataset, self.device)

    @cached_property
    def _held_out_observations(self) -> PointObservations | None:
        return self.point_observations("eval")

    def _gain_of_held_out(self, data: Mapping[str, Any]) -> Tensor | None:
        """Return the factors of sRGB's values of a held-out photo [3], 1 if it has too few points.

        `data` is what the datamanager gives for it. The factors come from the colours that points have in the training
        photos, or from EXIF if there are no points. None if the points are others than those of training.
        """
        table = self.model.exposure
        if table is None:
            return None
        files = self.datamanager.eval_dataset.image_filenames
        index = int(data["image_idx"])
        if len(table.points) == 0:
            return srgb_gains(self._stops_by_exif(files[index]))
        observing = self._held_out_observations
        if observing is None or len(observing.points) != len(table.points):
            return None
        observations = observing.of_one(index, data)
        stops, _ = gains_of_others(observations, table.points.double().numpy(), 1)
        return srgb_gains(torch.from_numpy(stops[0]))

    def _stops_by_exif(self, file: Path) -> Tensor:
        """Return log₂ of a held-out photo's gain, relative to the training photos' median, by EXIF; 0 without. [3]"""
        training = exposures_of(self.datamanager.train_dataset.image_filenames)
        own = exposure_stops(file)
        if training is None or own is None:
            return torch.zeros(3)
        return torch.full((3,), own - statistics.median(training))

    def _view_cameras(self) -> list[Pinholes]:
        """Return the camera of each training view, with the pose that is learned so far."""
        _, Ks = self.views.cameras
        cameras = []
        for index, (height, width) in enumerate(self.views.sizes):
            viewmat = self.views.viewmat(index).detach()
            cameras.append(Pinholes(viewmat[None], Ks[index][None], width, height))
        return cameras

    def _viewer_outputs(self, camera: Cameras, rendered: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the panels' pictures and normals, which cannot be lazy while training changes the Gaussians."""
        outputs = {NORMALS: rendered["rgb"]}
        if shows_output(self.structure.viewer, NORMALS):
            outputs[NORMALS] = self.model.get_normals(camera)
        outputs |= self.structure.outputs(camera, rendered)
        outputs |= self.cleaning.outputs(camera, rendered)
        return outputs

    def follow(self, plan: RunPlan) -> None:
        """From now on, train and draw according to a plan."""
        self.model.follow(plan)
        self.structure.set_max_gaussians.value = plan.strategy.max_gaussians
        self.structure.set_tau_split.value = plan.strategy.tau_split

    def train(self, mode: bool = True) -> SadgsPipeline:
        """Set the mode of all modules, unless they have it; nerfstudio calls this before every step."""
        if mode == self.training == self.model.training:
            return self
        return super().train(mode)

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Return the callbacks of data and model, and those that report, densify and refresh the panel, in order."""
        step_end = TrainingCallbackLocation.AFTER_TRAIN_ITERATION
        run_end = TrainingCallbackLocation.AFTER_TRAIN
        # The log is read before densification makes new parameters, which have no gradients.
        return [
            TrainingCallback([step_end], lambda step: self._report_nonfinite_if_full()),
            *super().get_training_callbacks(training_callback_attributes),
            TrainingCallback([step_end], lambda step: self._densify()),
            TrainingCallback([step_end], lambda step: self._find_moved(step)),
            TrainingCallback([step_end, run_end], lambda step: self.structure.refresh()),
            TrainingCallback([run_end], lambda step: self._report_nonfinite(last=True)),
            TrainingCallback([run_end], lambda step: self._report_moved(training_callback_attributes.trainer)),
        ]

    def _densify(self) -> None:
        """Let the model densify and do what else is due after a step."""
        self.model.densify(self._infos)
        self._infos = []  # They hold large tensors.
        self.model.finish_step()

    def _find_moved(self, step: int) -> None:
        """Judge what moved in the training photos, if the option asks for it and that is due after a step."""
        if self.config.find_moved and self.moved_search.is_due(step):
            self.moved_search.judge()

    def _report_moved(self, trainer: Trainer | None) -> None:
        """Say what was left out, and write masks of it into the run's folder."""
        if trainer is not None and self.model.world.rank == 0:
            self.moved_search.report(trainer.base_dir)

    def _report_nonfinite_if_full(self) -> None:
        if self.log.full:
            self._report_nonfinite()

    def clear_paths(self, near_plane: float) -> None:
        """Let densification prune haze near the training cameras' paths, as `SadgsModel.clear_paths` says."""
        cameras = self.datamanager.train_dataset.cameras
        self.model.clear_paths(viewmats_from_camera_to_world(cameras.camera_to_worlds), near_plane)

    def check_visibility(self, near_plane: float) -> None:
        """Raise InputError if fewer than 1 % of the Gaussians lie between the near and the far plane of any camera."""
        poses = self.datamanager.train_dataset.cameras.camera_to_worlds  # [C, 3, 4]
        viewmats = viewmats_from_camera_to_world(_sample(poses))
        means = _sample(self.model.means.detach()).to(viewmats)  # [N, 3]
        depths = means @ viewmats[:, 2, :3].T + viewmats[:, 2, 3]  # [N, C]
        drawn = ((depths > near_plane) & (depths < FAR_PLANE)).any(dim=1)
        world = self.model.world
        share = world.sum(drawn.float().mean().to(world.device)) / world.num_ranks
        if share < 0.01:
            extent = float(self.model.strategy_state["scene_scale"])
            raise InputError(
                f"The renderings would be empty, since a camera sees from {near_plane:.2g} to {FAR_PLANE:g} units and "
                f"the cameras lie within {extent:.2g}: set the parser's scale-factor so that they lie within about 1, "
                "or leave its auto-scale-poses on."
            )

    def _report_nonfinite(self, last: bool = False) -> None:
        """Print in which of the last iterations, and with which images, a loss or gradient was not finite.

        If that lasts and gradients move nothing, `diverged` becomes the sentence that says so. The `last` report may
        cover fewer iterations than `nonfinite.DIVERGED_STEPS`.
        """
        problems = self.log.read()
        files = self.datamanager.train_dataset.image_filenames
        for step, views, problem in problems[:_NAMED_STEPS]:
            names = " and ".join(files[view].name for view in views)
            warn(f"Iteration {step + 1}, {names}: {problem}; such gradients counted as 0, training goes on.")
        if len(problems) > _NAMED_STEPS:
            warn(f"The same in {len(problems) - _NAMED_STEPS} more of the last iterations.")
        enough = nonfinite.DIVERGED_STEPS
        if last:
            enough = min(enough, self.log.steps)
        lasts = bool(problems) and self.log.streak >= enough
        gradient = self._means_gradient
        if self.model.world.all(lasts and gradient is not None and nonfinite.has_no_update(gradient)):
            self.diverged = self._describe_divergence(problems)

    def _describe_divergence(self, problems: list[tuple[int, list[int], str]]) -> str:
        """Say since when nothing is learned, why and in which images, given the steps that were not finite."""
        last_step, _, problem = problems[-1]
        files = self.datamanager.train_dataset.image_filenames
        names: dict[int, str] = {}  # By views, so that each is named once
        for _, views, _ in problems:
            for view in views:
                names[view] = files[view].name
        images = ", ".join(list(names.values())[:_NAMED_STEPS])
        if len(names) > _NAMED_STEPS:
            images += f" and {len(names) - _NAMED_STEPS} more"
        return (
            f"Nothing was learned in the last {self.log.streak} iterations, up to iteration {last_step + 1}: {problem} "
            f"(images {images})"
        )

    def _repeat_overflowed(self, *, wait: bool = False) -> None:
        """Requeue the views that were not drawn because their tile lists were longer than foreseen."""
        forecast = self.model.tile_forecast
        if forecast is not None:
            self.views.sampler.requeue(forecast.overflowed(wait=wait))

    def next_views(self, step: int) -> list[ViewGroup]:
        """Draw the views of a step, bring their images to the device, and group them by their sizes."""
        self._repeat_overflowed()
        model = self.model
        groups: dict[tuple[int, ...], list[tuple[int, Mapping[str, Any]]]] = defaultdict(list)
        for index, data in self.views.draw(model.plan.views_per_iteration):
            if model.world.is_single:
                size = data["image"].shape
            else:
                size = self.views.sizes[index]  # This process loads only the images that it composites.
            groups[size].append((index, data))
        result = []
        for (height, width, *_), views in groups.items():
            indices = [index for index, _ in views]
            data = [data for _, data in views]
            quantized = None
            if model.strategy.observes(step):
                quantized = stack(self.structure_cache.get(views, model.world))
            # A step itself moves them as the poses are refined.
            cameras = Pinholes(*self.views.stacked_cameras(indices, refined=False), width, height)
            options = model.step_options(cameras, indices)
            result.append(ViewGroup(indices, cameras, options, data, model.view_ids(indices), quantized))
        return result

    def record_step(self, step: int, groups: list[ViewGroup], result: StepResult) -> None:
        """Keep what densification, later steps and reports need, without waiting for the device."""
        self._infos = result.infos
        self._means_gradient = result.means_gradient
        self.log.record(step, [index for group in groups for index in group.indices], result.loss)
        forecast = self.model.tile_forecast
        for group, info in zip(groups, result.infos, strict=True):
            if forecast is not None and "pair_counts" in info:  # Only our kernels count pairs.
                size = group.cameras[2:]
                capacity = group.options.tile_capacity
                forecast.rendered(group.indices, size, capacity, info["pair_counts"])

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, float]:
        """Return the mean, and for several views the deviation, of each metric; raise InputError without views."""
        views = len(self.datamanager.eval_dataset)
        if views == 0:
            raise InputError(
                "The run holds out no view, so that there is nothing to measure: train anew with `sadgs … --measure`, "
                "or with an --eval-mode that holds out some, unless transforms.json lists the images of each split."
            )
        return super().get_average_eval_image_metrics(step, output_path, get_std and views > 1)

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load a checkpoint, or raise InputError where nerfstudio would mix it with another method or model."""
        loaded = {key.removeprefix("module."): value for key, value in loaded_state.items()}
        for name, parameter in self.model.gauss_params.items():
            value = loaded.get(f"_model.gauss_params.{name}")
            if value is None:
                raise InputError(f"The checkpoint has no {name} of Gaussians, so another method made it.")
            if value.shape[1:] != parameter.shape[1:]:
                raise InputError(
                    f"The checkpoint's {name} have the shape {list(value.shape[1:])}, the model's "
                    f"{list(parameter.shape[1:])}: set pipeline.model.sh-degree as it was."
                )
        if not {"_extra_state", "_model._extra_state"} <= loaded.keys():
            raise InputError("The checkpoint lacks the state of structure-aware densification, so splatfacto made it.")
        for name, parameter in self.named_parameters():
            value = loaded.get(name)
            if ".gauss_params." not in name and value is not None:
                check_number_of_views(name, value, parameter)
        positions = camera_positions(self.datamanager.train_dataset.cameras)
        for name in sorted(_OF_VIEWS & loaded.keys()):
            check_order_of_views(name, loaded["_extra_state"].get("camera_positions"), positions)
        super().load_pipeline(loaded_state, step)

    def get_extra_state(self) -> dict[str, Any]:
        """Return what a resumed run needs to go on as if it had never stopped, and what identifies its data."""
        self._repeat_overflowed(wait=True)  # The sampler's state must hold these views.
        state: dict[str, Any] = {
            "torch": torch.get_rng_state(),
            "views": self.views.sampler.state_dict(),
            "plan": asdict(self.model.plan),
            "images": [path.name for path in self.datamanager.train_dataset.image_filenames],
            "camera_positions": camera_positions(self.datamanager.train_dataset.cameras),
        }
        if len(self.views.moved):
            state["photo_names"] = self._photo_names
            state["moved"] = self.views.moved.state_dict(state["photo_names"])
        if self.device.type == "cuda":
            state["cuda"] = torch.cuda.get_rng_state(self.device)
        return state

    @property
    def _photo_names(self) -> list[str]:
        return photo_names(self.datamanager.train_dataset.image_filenames)

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_extra_state` saved; the order of the views only if their number is the same.

        A warning names the fields of the plan that another version wrote and this one does not have.
        """
        plan = RunPlan.of(state["plan"])
        unknown = unknown_fields(state["plan"])
        if unknown:
            problem = "The checkpoint's plan has options that this version of sadgs does not have"
            warn(f"{problem}; they are ignored: {', '.join(unknown)}.")
        self.follow(plan)
        torch.set_rng_state(state["torch"].cpu())
        self.views.sampler.load_state_dict(state["views"])
        moved = state.get("moved", {})
        if not self.config.find_moved:
            moved = {}
        names = []
        if moved:
            names = self._names_in(state)
        self.views.moved.load_state_dict(moved, names, self.device)
        if "cuda" in state and self.device.type == "cuda":
            torch.cuda.set_rng_state(state["cuda"].cpu(), self.device)

    def _names_in(self, state: Mapping[str, Any]) -> list[str]:
        """Return the names that a checkpoint's state has for the present training photos, "" for those it lacks."""
        names = self._photo_names
        before = state.get("photo_names")
        if before is None:  # Earlier versions did not note them.
            return names
        known = []
        for row in same_photos(before, names):
            name = ""
            if row is not None:
                name = before[row]
            known.append(name)
        return known


def _check_data_of_run(config: SadgsPipelineConfig) -> None:
    """Raise InputError if the capture of a run that is loaded is not where the run's settings say."""
    data = Path(config.datamanager.data or config.datamanager.dataparser.data)
    if not data.exists():
        remedy = f"put it there, or correct {data} in the run's config.yml"
        if not data.is_absolute():
            remedy = f"change to the folder in which training was started with `cd`, or correct {data} in config.yml"
        raise InputError(f"{data.absolute()}, on which the run was trained, is not there: {remedy}.")


def _sample(rows: Tensor) -> Tensor:
    """Return up to `_SAMPLED` rows of a tensor, at equal distances. [N, …] → [n, …]"""
    every = math.ceil(len(rows) / _SAMPLED)
    return rows[::every]
