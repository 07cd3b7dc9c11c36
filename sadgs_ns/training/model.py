"""The model that nerfstudio trains: splatfacto's with the structure-aware strategy and this package's rasterizer."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from dataclasses import asdict, replace
from functools import cached_property
from typing import Any

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes
from nerfstudio.models.splatfacto import SplatfactoModel
from pytorch_msssim import SSIM
from scipy.spatial import KDTree
from torch import Tensor

from sadgs_ns.data.cameras import camera_positions, check_drawn_cameras, training_view
from sadgs_ns.distributed.world import World
from sadgs_ns.errors import InputError
from sadgs_ns.geometry.camera_paths import CameraPaths
from sadgs_ns.geometry.extents import camera_extent
from sadgs_ns.geometry.initialization import neighbour_scales
from sadgs_ns.geometry.point_colors import apply_gains, srgb_gains
from sadgs_ns.geometry.scale_limits import camera_distances, limit_scales
from sadgs_ns.method.losses import photometric_loss
from sadgs_ns.method.running_strategy import RunningStrategy
from sadgs_ns.method.strategy import DEFAULT_ITERATIONS
from sadgs_ns.render.activations import activate
from sadgs_ns.render.normals import normals_map
from sadgs_ns.render.rasterization import choose_backend, rasterize, viewmats_from_camera_to_world
from sadgs_ns.render.tile_forecast import TileForecast
from sadgs_ns.render.types import Cameras as Pinholes
from sadgs_ns.render.types import Gaussians, RenderOptions
from sadgs_ns.training.config import SadgsModelConfig
from sadgs_ns.training.datamanager import NUM_PIXELS
from sadgs_ns.training.exposure_table import ExposureTable
from sadgs_ns.training.initial_gaussians import color_features, initial_gaussians, spheres
from sadgs_ns.training.lpips import load_lpips
from sadgs_ns.training.outputs import LazyOutputs, crop_background, in_viewer, rgba_image, warn_once
from sadgs_ns.training.run.run_plan import RunPlan
from sadgs_ns.training.step.dropout import Dropout
from sadgs_ns.training.step.parameter_average import RunningMean
from sadgs_ns.training.step.poses import RefinedPoses, fit_poses

CAMERA_CLEARANCE = 2.0
"""Initial Gaussians within this many of their standard deviations of a camera are dropped, unlike in the paper. That
brought 1.7 dB on the scene `south`, elsewhere nothing (docs/results.md#why-these-defaults)."""
NORMALS = "normals"  # Name of an output that is computed only when it is read
LIMIT_EVERY = 25  # Iterations between limits on scales, in which an axis grows at most threefold at the presets' rates
HAZE_EVERY = 100  # Iterations between prunes of haze after densification, the last one before averaging begins


class SadgsModel(SplatfactoModel):
    """The Gaussians, their rendering and their loss; nerfstudio's other programs see a splatfacto model."""

    config: SadgsModelConfig
    strategy: RunningStrategy
    plan: RunPlan  # There is none until `follow`, which comes before the first rendering.
    every_view_id: Tensor
    exposure_maps: Tensor | None

    def populate_modules(self) -> None:
        """Make parameters, metrics and the strategy; splatfacto's own needs CUDA, and LPIPS's weights at once."""
        config = self.config
        config.check()
        self.strategy = config.strategy.for_run(DEFAULT_ITERATIONS)  # Until `follow` sets that of the run.
        self.strategy_state = self.strategy.initialize_state()
        pixels = self.kwargs.get("metadata", {}).get(NUM_PIXELS)
        params, synthetic = initial_gaussians(config, self.seed_points, pixels)
        self.synthetic = synthetic  # Those that stand for no SfM point: random ones, and on the bounding box. bool [N]
        self.gauss_params = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in params.items()})
        # nerfstudio's programs ask for one; it does nothing.
        self.camera_optimizer = CameraOptimizerConfig(mode="off").setup(num_cameras=self.num_train_data, device="cpu")
        self.poses: RefinedPoses | None = None
        if config.poses == "refined":
            self.poses = RefinedPoses(self.num_train_data)
        self.ssim = SSIM(data_range=1.0, size_average=True, channel=3)
        self._lpips: list[torch.nn.Module | None] = []  # A list keeps its weights out of the checkpoint.
        self.step = 0
        self.average = RunningMean()
        self.dropout: Dropout | None = None  # `follow` makes one if the plan asks for it.
        self.camera_positions: Tensor | None = None  # [C, 3]
        self.tile_forecast: TileForecast | None = TileForecast()
        self.color_matrices: torch.nn.Parameter | None = None  # [V, 3, 4]
        self.crop_box: OrientedBox | None = None
        self.viewer_outputs: Callable[[Cameras, dict[str, Tensor]], dict[str, Tensor]] | None = None
        self.world = World()
        if config.color_model == "affine":
            self.color_matrices = torch.nn.Parameter(torch.eye(3, 4).repeat(self.num_train_data, 1, 1))
        self.exposure: ExposureTable | None = None  # Stored with the extra state, as its size is that of the data
        self.gain_of_held_out: Callable[[Mapping[str, Any]], Tensor | None] = lambda data: None
        self.register_buffer("exposure_maps", None, persistent=False)  # `color_maps` of `exposure`. [V, 2, 3]
        # An index that is made in a step must be copied to the device in that step.
        self.register_buffer("every_view_id", torch.arange(self.num_train_data), persistent=False)  # [V]

    def set_cameras(self, cameras: Cameras) -> None:
        """Set the extent and drop Gaussians that are too close to a camera; call before optimizers are made."""
        if self.poses is not None:
            points = self.means.detach()
            if self.seed_points is not None:
                points = self.seed_points[0].to(points)
            viewmats = viewmats_from_camera_to_world(cameras.camera_to_worlds)
            sizes = torch.cat([cameras.width, cameras.height], dim=-1)
            self.poses.set_cameras(viewmats, cameras.get_intrinsics_matrices(), sizes, points)
        positions = camera_positions(cameras)
        self.strategy_state["scene_scale"] = camera_extent(positions)
        self.camera_positions = positions.to(self.means)
        radii = CAMERA_CLEARANCE * self.scales.detach().exp().amax(dim=1)  # [N]
        keep = camera_distances(self.means.detach(), self.camera_positions, radii) >= radii
        if keep.any():
            for parameter in self.gauss_params.values():
                parameter.data = parameter.data[keep]
            self.synthetic = self.synthetic[keep.cpu()]

    def add_points(self, means: Tensor, colors: Tensor, scales: Tensor) -> int:
        """Start from more points, as many as the cap allows; call before optimizers are made. Return their number.

        Means [P, 3], colours in [0, 1] [P, 3] and largest standard deviations [P], which neighbours also limit.
        """
        room = max(min(len(means), self.strategy.options.max_gaussians - self.num_points), 0)
        if not room:
            return 0
        known = self.means.detach()[~self.synthetic.to(self.means.device)]
        means = means[:room]
        colors = colors[:room]
        scales = scales[:room]
        spacing = neighbour_scales(torch.cat([known, means.to(known)]))[len(known) :]  # [room]
        scales = torch.minimum(scales, spacing.to(scales))
        opacity = self.config.initial_opacity
        added = spheres(means, colors, scales, opacity, sh_degree=self.config.sh_degree)
        for name, parameter in self.gauss_params.items():
            parameter.data = torch.cat([parameter.data, added[name].to(parameter)])
        self.synthetic = torch.cat([self.synthetic, torch.zeros(room, dtype=torch.bool)])
        return room

    def clear_paths(self, viewmats: Tensor, near_plane: float) -> None:
        """Let densification prune haze near the paths of the training cameras [C, 4, 4], if the options ask for it.

        `near_plane` is the scene's (`scene_near_plane`), which need not be the run's.
        """
        if not self.config.clear_paths:
            return
        surfaces = self.means.detach()[~self.synthetic.to(self.device)]
        if self.seed_points is not None:
            points, _ = self.seed_points  # No Gaussian starts from those near cameras, but they are on surfaces, too.
            surfaces = torch.cat([surfaces, points.to(surfaces)])
        self.strategy_state["camera_paths"] = CameraPaths.of(viewmats, near_plane, surfaces)

    def shard(self, world: World) -> None:
        """Keep this process's part of the Gaussians only, and all poses as they are.

        Raises InputError if the backend needs all Gaussians.
        """
        self.poses = None
        choose_backend(self.config.backend, world.device, world.is_single)
        part = world.take_even_part(self.num_points)
        for parameter in self.gauss_params.values():
            parameter.data = parameter.data[part].clone()
        self.world = world
        self.tile_forecast = None  # How many pairs a view has depends on the Gaussians of all.

    @property
    def num_gaussians(self) -> int:
        """Number of Gaussians of all processes."""
        if self.world.is_single:
            return self.num_points
        return self.world.total

    def follow(self, plan: RunPlan) -> None:
        """From now on, densify, average and draw according to a plan."""
        self.plan = plan
        self.strategy = plan.strategy.for_run(plan.iterations, self.world)
        self.dropout = None
        if plan.dropout > 0:
            self.dropout = Dropout(plan.dropout, torch.initial_seed(), self.device)

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Return the callback that nerfstudio calls before a step.

        After a step, the pipeline calls `densify` with the step's infos, and `finish_step`.
        """
        before_step, _ = super().get_training_callbacks(training_callback_attributes)
        return [before_step]

    def densify(self, infos: Sequence[dict[str, Any]]) -> None:
        """Split, clone and prune Gaussians if that is due after a step, given its `StepResult.infos`."""
        self.strategy.densify(self.gauss_params, self.optimizers, self.strategy_state, self.step, infos)

    def finish_step(self) -> None:
        """Prune haze and limit scales if that is due, and average the parameters at the run's end."""
        iterations = self.plan.iterations
        done = self.step + 1
        # The number of iterations that are left before averaging begins; it is negative once they are averaged.
        before_mean = iterations - round(self.config.averaged_share * iterations) - done
        if before_mean >= 0:
            self.average.clear()  # A run that is trained on may have begun to average earlier.
            if done > self.strategy.windows.refine_stop_iter and before_mean % HAZE_EVERY == 0:
                self.strategy.prune_haze(self.gauss_params, self.optimizers, self.strategy_state)
        else:
            self.average.add(self.gauss_params)
            if done >= iterations:
                self.average.move_to(self.gauss_params)
        if done % LIMIT_EVERY == 0 or done >= iterations:
            self._limit_scales()

    def _limit_scales(self) -> None:
        """Shorten Gaussians that are longer than the option `max_angular_scale` allows, if it sets a limit."""
        if self.config.max_angular_scale > 0 and self.camera_positions is not None:
            limit_scales(self.scales, self.means, self.camera_positions, self.config.max_angular_scale)

    @property
    def trained_params(self) -> dict[str, Tensor]:
        """Parameters by name that a training step reads: the Gaussians', and perhaps colour matrices and poses."""
        params: dict[str, Tensor] = dict(self.gauss_params.items())
        if self.color_matrices is not None:
            params["color_matrices"] = self.color_matrices
        if self.poses is not None:
            params["poses"] = self.poses.table
        return params

    def get_param_groups(self) -> dict[str, list[torch.nn.Parameter]]:
        """Return what is optimized, by the names of the optimizers."""
        return {name: [parameter] for name, parameter in self.trained_params.items()}  # type: ignore[misc]

    @property
    def may_use_gains(self) -> bool:
        """Whether photos may have gains; learned colour matrices are another answer to the same question."""
        return self.config.exposure == "auto" and self.config.color_model == "none"

    def set_exposure(self, table: ExposureTable | None) -> None:
        """From now on, compare training photos with renderings at their exposure, or with plain ones if it is None."""
        self.exposure = table
        self.exposure_maps = None
        if table is not None:
            self.exposure_maps = table.color_maps().to(self.device)

    def color_points(self, stops: Tensor) -> None:
        """Bring the Gaussians of SfM points to the median exposure; call before training.

        The points' colours are means over photos, and `stops` [P, 3] are log₂ of these photos' mean gains.
        """
        if self.seed_points is None:
            return
        positions, colors = self.seed_points
        real = (~self.synthetic).nonzero()[:, 0].to(self.device)
        points = positions.float().cpu()
        known = points.isfinite().all(dim=1)
        if not known.any() or not len(real):
            return
        # Each of these Gaussians begins at a point, and some points have none.
        distances, nearest = KDTree(points[known]).query(self.means.detach()[real].cpu())
        found = torch.from_numpy(distances == 0)
        rows = torch.from_numpy(nearest)[found]
        to_median = 1 / srgb_gains(stops[known][rows])
        at_median = apply_gains(colors[known][rows].cpu() / 255, to_median).clamp(0, 1)
        features = color_features(at_median, self.config.sh_degree).to(self.gauss_params["features_dc"])
        self.gauss_params["features_dc"].data[real[found.to(self.device)]] = features

    def view_ids(self, cam_indices: Sequence[int]) -> Tensor | None:
        """Return indices of C views on the device, int64 [C], without waiting; None if a step needs none."""
        if self.color_matrices is None and self.exposure_maps is None and self.poses is None:
            return None
        return torch.cat([self.every_view_id[index : index + 1] for index in cam_indices])

    def color_maps(
        self,
        view_ids: Tensor | None,  # What `view_ids` returned. int64 [C]
    ) -> Tensor | None:
        """Return how `render.rasterization.project` gives C training views their exposure; None without gains."""
        if self.exposure_maps is None or view_ids is None:
            return None
        return self.exposure_maps.index_select(0, view_ids)

    def shown_rows(self, chosen: Tensor | None = None) -> Tensor | None:
        """Return which Gaussians are drawn: the chosen ones that lie in the viewer's crop box. bool [N]

        None stands for all Gaussians, in the argument and in the result. In training, the box hides nothing.
        """
        if self.crop_box is None or self.training:
            return chosen
        inside = self.crop_box.within(self.means)
        if chosen is None:
            return inside
        return chosen & inside

    def cropped(self, values: Mapping[str, Tensor], chosen: Tensor | None = None) -> Mapping[str, Tensor]:
        """Return the rows of tensors [N, …] of the Gaussians that are drawn, as `shown_rows` chooses them."""
        rows = self.shown_rows(chosen)
        if rows is None:
            return values
        return {name: value[rows] for name, value in values.items()}

    @property
    def backend(self) -> str:
        """Name of the backend that draws; raises InputError if the option's cannot."""
        return choose_backend(self.config.backend, self.device)

    @property
    def drawing(self) -> RenderOptions:
        """The options that all pictures of these Gaussians share; `color_options` are for colours."""
        return RenderOptions(
            near_plane=self.plan.near_plane, max_off_axis=self.plan.max_off_axis, backend=self.config.backend
        )

    def color_options(self, **changes: Any) -> RenderOptions:
        """Return the options to draw colours at this step, with other values of some fields."""
        degree = None
        if self.config.sh_degree > 0:
            # Each iteration adds a degree; 3DGS's 1,000 iterations for each would be too many in so short a run.
            degree = min(self.step, self.config.sh_degree)
        return replace(self.drawing, sh_degree=degree, **changes)

    def render(
        self, cameras: Pinholes, options: RenderOptions, chosen: Tensor | None = None
    ) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """Rasterize the Gaussians, in the viewer those inside its crop box, in their colours.

        `chosen`, bool [N], leaves out all others. Returns unclamped colours, with depth if `options` ask for it
        [C, H, W, 3 or 4], accumulated opacity [C, H, W, 1], and the rasterizer's info.
        """
        gaussians, _ = self.gaussians(chosen=chosen)
        return rasterize(gaussians, cameras, options)

    def gaussians(
        self, params: Mapping[str, Tensor] | None = None, opacity_reg: float = 0.0, chosen: Tensor | None = None
    ) -> tuple[Gaussians, Tensor | None]:
        """Return the activated Gaussians inside the viewer's crop box, of `params` or the model's own.

        `chosen`, bool [N], leaves out all others. The second result are numbers [P] whose sum is the mean opacity
        times `opacity_reg`; None if that factor is 0.
        """
        if params is None:
            params = dict(self.gauss_params.items())
        params = self.cropped(params, chosen)
        colors: Tensor | tuple[Tensor, Tensor] = (params["features_dc"], params["features_rest"])
        if self.config.sh_degree == 0:
            colors = torch.sigmoid(params["features_dc"])  # [N, 3]
        scales, opacities, penalty = activate(params["scales"], params["opacities"], opacity_reg)
        return Gaussians(params["means"], params["quats"], scales, opacities, colors), penalty

    def step_options(self, cameras: Pinholes, indices: Sequence[int]) -> RenderOptions:
        """Return how training views, by their indices, are drawn at this step, with the foreseen length of lists."""
        forecast = self.tile_forecast
        capacity = None
        if forecast is not None:
            capacity = forecast.capacity(indices, cameras[2:], self.num_points)
        return self.color_options(absgrad=self.strategy.needs_absgrad(self.step), tile_capacity=capacity)

    @property
    def opacity_reg_now(self) -> float:
        """Factor on the mean opacity in this step's loss."""
        if self.step < self.strategy.windows.refine_stop_iter:
            return self.config.opacity_reg
        return 0.0

    def before_background(self, render: Tensor, alpha: Tensor, background: Tensor) -> Tensor:
        """Put renderings [C, H, W, ≥ 3] with their opacity [C, H, W, 1] on a background [3]. → [C, H, W, 3]"""
        if self.config.background_color == "black":
            return render[..., :3]
        return render[..., :3] + (1 - alpha) * background

    def get_outputs(self, camera: Cameras, chosen: Tensor | None = None) -> dict[str, Any]:
        """Render one camera, shape [1], for viewer and evaluation. Raise InputError if it is no pinhole.

        Args:
            camera: The camera.
            chosen: Which Gaussians to draw; those outside the viewer's crop box are left out anyway. bool [N]

        Returns:
            `rgb` [H, W, 3] in [0, 1]; `depth` [H, W, 1], the mean of the drawn Gaussians' depths along the viewing axis
            in the run's units, and the largest one where nothing is; `accumulation` [H, W, 1]; `background` [H, W, 3].
        """
        check_drawn_cameras(camera)
        pinhole = self.pinhole(camera)
        background = crop_background(self.background)
        rows = self.shown_rows(chosen)
        if rows is not None and not rows.any():
            return self.get_empty_outputs(pinhole.width, pinhole.height, background)
        render, alpha, _ = self.render(pinhole, self.color_options(expected_depth=True), chosen)
        depth = render[..., 3:4]
        return {
            "rgb": (render[..., :3] + (1 - alpha) * background).clamp(0.0, 1.0)[0],
            "depth": torch.where(alpha > 0, depth, depth.detach().max())[0],
            "accumulation": alpha[0],
            "background": background.expand(pinhole.height, pinhole.width, 3),
        }

    def pinhole(self, camera: Cameras) -> Pinholes:
        """Return nerfstudio's camera, shape [1], as the rasterizer takes it, that of a training view as refined."""
        # Poses of a camera path may be whole numbers.
        viewmats = viewmats_from_camera_to_world(camera.camera_to_worlds.float()).to(self.device)
        view = training_view(camera)
        if self.poses is not None and view is not None:
            viewmats = self.poses.viewmat(view)[None]
        Ks = camera.get_intrinsics_matrices().to(self.device)
        return Pinholes(viewmats, Ks, int(camera.width.item()), int(camera.height.item()))

    @torch.no_grad()
    def get_normals(self, camera: Cameras, params: Mapping[str, Tensor] | None = None) -> Tensor:
        """Render the normals of one camera, shape [1], which takes about as long as its colours. [H, W, 3]

        They are 0.5 + 0.5 n with n of `normals_map`, in the world's axes, and black where nothing is.
        `params` default to the model's own inside the viewer's crop box.
        """
        if params is None:
            params = self.cropped(dict(self.gauss_params.items()))
        pinhole = self.pinhole(camera)
        if not len(params["means"]):
            return torch.zeros((pinhole.height, pinhole.width, 3), device=self.device)
        normals = normals_map(params, pinhole, self.drawing)
        return torch.where((normals != 0).any(dim=-1, keepdim=True), 0.5 + 0.5 * normals, 0.0)

    def get_outputs_for_camera(  # type: ignore[override]
        self, camera: Cameras, obb_box: OrientedBox | None = None
    ) -> MutableMapping[str, Tensor]:
        """Render one camera, shape [1], as `get_outputs` inside a crop box, and add the panels' pictures.

        Outside the viewer, `normals` are added, and computed when they are first read. A camera that is no pinhole
        raises InputError; the viewer, whose thread would end, shows nothing instead.
        """
        try:
            outputs: dict[str, Any] = super().get_outputs_for_camera(camera, obb_box)
        except InputError as error:
            if not in_viewer():
                raise
            warn_once(str(error))
            outputs = self.get_empty_outputs(int(camera.width), int(camera.height), self.background)
        if in_viewer():
            if self.viewer_outputs is not None:
                outputs |= self.viewer_outputs(camera, outputs)
            return outputs
        params = self.cropped(dict(self.gauss_params.items()))
        named = {**outputs, NORMALS: lambda: self.get_normals(camera, params)}
        return LazyOutputs(named, lambda: self.draw_unclamped(camera))

    @torch.no_grad()
    def draw_unclamped(self, camera: Cameras) -> Tensor:
        """Render the colours of one camera, shape [1], without background; they may be above 1. [H, W, 3]"""
        render, _, _ = self.render(self.pinhole(camera), self.color_options())
        return render[0, ..., :3]

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """Return a rendering without its background, and how opaque it is, in [0, 1]. [H, W, 4]"""
        return rgba_image(outputs, output_name)

    def get_gt_img(self, image: Tensor) -> Tensor:
        """Return an image, uint8 or floats in [0, 1] [H, W, 3 or 4], on the device and in [0, 1], in one launch."""
        image = image.to(self.device)
        if image.dtype == torch.uint8:
            return image / 255.0
        return image

    @cached_property
    def background(self) -> Tensor:
        """Colour behind the Gaussians; it is made once. [3]"""
        brightness = 0.0
        if self.config.background_color == "white":
            brightness = 1.0
        return torch.full((3,), brightness, device=self.device)

    def composite_with_background(self, image: Tensor, background: Tensor) -> Tensor:
        """Put images in [0, 1] [..., H, W, 3 or 4] on the background, [3] or [H, W, 3], if they have alpha."""
        if image.shape[-1] == 4:
            alpha = image[..., 3:]
            return alpha * image[..., :3] + (1 - alpha) * background
        return image

    def photo(self, data: Mapping[str, Any]) -> Tensor:
        """Return an image of the datamanager as the loss sees it: on the device and the background. [H, W, 3]"""
        return self.composite_with_background(self.get_gt_img(data["image"]), self.background)

    def get_loss_dict(
        self, outputs: Mapping[str, Any], batch: Mapping[str, Any], metrics_dict: Mapping[str, Any] | None = None
    ) -> dict[str, Tensor]:
        """Return the photometric loss of renderings, `rgb` […, H, W, 3]; training has its own (train_step.py)."""
        rgb, target = self.masked_pair(outputs["rgb"], batch, outputs["background"])
        rgb = rgb.reshape(-1, *rgb.shape[-3:])  # [C, H, W, 3]
        target = target.reshape(-1, *target.shape[-3:])
        loss, _ = photometric_loss(rgb, target, ssim_lambda=self.config.ssim_lambda)
        return {"main_loss": loss}

    def masked_pair(self, rgb: Tensor, batch: Mapping[str, Any], background: Tensor) -> tuple[Tensor, Tensor]:
        """Return a rendering and its photo […, H, W, 3] within the mask, on the same background, for the loss.

        `rgb` is not clamped, and `batch` holds `image`, uint8 or floats in [0, 1] […, H, W, 3 or 4], and perhaps a
        boolean `mask` […, H, W, 1]. The photo stays in bytes if nothing changes it.
        """
        target = batch["image"].to(self.device)
        if "mask" in batch or target.shape[-1] == 4:  # Otherwise the loss reads bytes as they are.
            target = self.composite_with_background(self.get_gt_img(target), background)
        if "mask" in batch:
            mask = batch["mask"].to(self.device)
            target = target * mask
            rgb = rgb * mask
        return rgb, target

    def psnr(self, predicted: Tensor, target: Tensor) -> Tensor:
        """Return PSNR in dB of images in [0, 1], [1, 3, H, W] or [H, W, 3]."""
        return -10 * (predicted - target).square().mean().log10()

    def lpips(self, predicted: Tensor, target: Tensor) -> Tensor:
        """Return LPIPS (AlexNet) of images [1, 3, H, W] in [0, 1], or NaN if its weights cannot be loaded."""
        if not self._lpips:
            self._lpips = [load_lpips(self.device)]
        metric = self._lpips[0]
        if metric is None:
            return predicted.new_tensor(math.nan)
        return metric(predicted, target)

    def get_image_metrics_and_images(
        self, outputs: MutableMapping[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Return PSNR, SSIM and, if its weights can be loaded, LPIPS of one held-out view.

        If training used gains, `gain_psnr` and so on compare the photo with a rendering at its exposure.
        """
        metrics, images = super().get_image_metrics_and_images(outputs, batch)  # type: ignore[arg-type]
        gained = self.at_exposure_of_photo(outputs, batch)
        if gained is not None:
            photo = self.composite_with_background(self.get_gt_img(batch["image"]), outputs["background"])
            predicted = gained.movedim(-1, 0)[None]
            truth = photo.movedim(-1, 0)[None]
            metrics["gain_psnr"] = float(self.psnr(truth, predicted))
            metrics["gain_ssim"] = float(self.ssim(truth, predicted))
            metrics["gain_lpips"] = float(self.lpips(truth, predicted))
        for name in ("lpips", "cc_lpips", "gain_lpips"):
            if name in metrics and math.isnan(metrics[name]):
                del metrics[name]
        return metrics, images

    def at_exposure_of_photo(self, outputs: Mapping[str, Tensor], batch: Mapping[str, Any]) -> Tensor | None:
        """Return a held-out view's rendering with its photo's gain, or None if training used no gains. [H, W, 3]

        The photo's gain comes from points' colours, not from the rendering, and is applied before clamping.
        """
        if self.exposure is None:
            return None
        gains = self.gain_of_held_out(batch)
        if gains is None:
            return None
        assert isinstance(outputs, LazyOutputs)  # Only the viewer gets others.
        alpha = outputs["accumulation"]
        gained = apply_gains(outputs.unclamped(), gains.to(alpha), alpha)
        return self.before_background(gained, alpha, outputs["background"]).clamp(0.0, 1.0)

    def get_extra_state(self) -> dict[str, Any]:
        """Return the step, the strategy's state, the mean of the parameters so far, and the photos' gains."""
        state = dict(self.strategy_state)
        if "camera_paths" in state:
            state["camera_paths"] = asdict(state["camera_paths"])
        extra = {"step": self.step, "strategy_state": state, "average": self.average.state_dict()}
        if self.exposure is not None:
            extra["exposure"] = self.exposure.state_dict()
        return extra

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_extra_state` saved."""
        self.step = state["step"]
        self.strategy_state = self._on_device(state["strategy_state"])
        paths = self.strategy_state.pop("camera_paths", None)
        if paths is not None and self.config.clear_paths:
            self.strategy_state["camera_paths"] = CameraPaths(**self._on_device(paths))
        self.average.load_state_dict(state["average"], self.device)
        self.set_exposure(ExposureTable.of(state.get("exposure")))

    def _on_device(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return a dictionary with its tensors on the model's device, and with all other values as they are."""
        moved = {}
        for name, value in values.items():
            if isinstance(value, Tensor):
                value = value.to(self.device)
            moved[name] = value
        return moved

    def load_state_dict(self, dict: dict[str, Any], **kwargs: Any) -> Any:  # type: ignore[override]
        """Load a checkpoint of any number of Gaussians, into the parameters that optimizers may hold.

        Raises InputError if it has the poses of other views.
        """
        dict = {**dict}
        if self.color_matrices is None:
            dict.pop("color_matrices", None)
        fit_poses(dict, self.poses)
        for name, parameter in self.gauss_params.items():
            parameter.data = torch.empty_like(dict[f"gauss_params.{name}"], device=self.device)
        return super(SplatfactoModel, self).load_state_dict(dict, **kwargs)
