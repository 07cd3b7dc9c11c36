"""The last adjustment of cameras and points, in which wrong matches hardly count.

COLMAP's own minimises the squares of residuals, so that a few wrong matches among thousands pull the cameras: with
other random samples, points of the scene `castle` move by a tenth of a pixel on the mean. With a robust loss, each
observation pulls less the further it lies from its point.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import pycolmap

LOSS_SCALE = 1.0  # Residual in px from which an observation counts as if it were wrong
_MOST_ERROR = 4.0  # Largest residual in px of an observation that is kept; COLMAP's
_LEAST_ANGLE = 1.5  # Least angle in degrees at which a point is seen; COLMAP's
_MOST_ITERATIONS = 50
_FIRM = 400
"""Observations a photo from which a model counts as firm. Of the captures that are placed alike by all samples each has
700 or more, and lund, whose models differed by up to 16 % of a photo's side, has 190."""
_LEAST_OBSERVATIONS = 15
"""Observations that a photo must keep. COLMAP registers a photo by 30 or more, in a relaxed attempt by 15, and some of
them may turn out wrong. Of 588 photos of twelve placings 587 kept 21 or more. One that was turned by 100° kept 13."""
_SETTLING_ROUNDS = 3  # After them no model of lund changed
_SETTLING_ITERATIONS = 200
_SETTLING_TOLERANCE = 1e-6
_TOLERANCE = 1e-3
"""Relative change of the cost at which the adjustment ends. With 1e-5 points move by as little between samples, in two
to seven times the time."""


def refine(model: pycolmap.Reconstruction, database: Path, options: pycolmap.IncrementalPipelineOptions) -> None:
    """Fit a model to cameras that have more parameters than before, which `adjust_robustly` then finishes.

    All cameras and points are adjusted, observations that do not fit are left out, and then those that have no point
    are triangulated again. Of a capture whose pixels are 3 % higher than wide this brings back all of the 4 % of the
    observations that did not fit one focal length.

    Args:
        model: Changed in place.
        database: The features and matches, with cameras of the model's kinds.
        options: Those by which the photos were placed.
    """
    mapper = _open_mapper(database, options)
    mapper_options = options.get_mapper()
    mapper_options.ba_global_ignore_redundant_points3D = False
    mapper.begin_reconstruction(model)
    mapper.iterative_global_refinement(
        1,
        0.0,
        mapper_options,
        options.get_global_bundle_adjustment(),
        options.get_triangulation(),
        normalize_reconstruction=False,
    )
    # Observations that did not fit by the earlier parameters may fit by these.
    for image_id in model.reg_image_ids():
        mapper.triangulate_image(options.get_triangulation(), image_id)
    mapper.end_reconstruction(discard=False)
    filter_observations(model)  # Some of those that were triangulated again are wrong.


def _open_mapper(database: Path, options: pycolmap.IncrementalPipelineOptions) -> pycolmap.IncrementalMapper:
    """Return COLMAP's mapper of the features and matches of a database."""
    with pycolmap.Database.open(database) as opened:
        chosen = pycolmap.DatabaseCacheOptions(min_num_matches=options.min_num_matches)
        cache = pycolmap.DatabaseCache.create(opened, chosen)
    return pycolmap.IncrementalMapper(cache)


def is_firm(model: pycolmap.Reconstruction) -> bool:
    """Tell whether a model has so many observations that it comes out alike whatever the random samples."""
    return model.compute_num_observations() >= _FIRM * model.num_reg_frames()


def settle(
    model: pycolmap.Reconstruction,
    database: Path,
    options: pycolmap.IncrementalPipelineOptions,
    fixed_cameras: Collection[int] = (),
) -> None:
    """Adjust a model that is not firm until nothing changes, and triangulate again in between.

    Few observations let the focal length and the scale along a walk slide together at hardly any cost, so an adjustment
    that ends early ends anywhere between. Of lund's 29 photos, models of 29 seeds came out with focal lengths of 840 to
    1,103 px and 4,549 to 5,687 observations; ten of them, settled, with 853 to 900 px and 5,655 to 5,778.

    Args:
        model: Changed in place. `adjust_robustly` is to follow.
        database: The features and matches.
        options: Those by which the photos were placed.
        fixed_cameras: Cameras whose intrinsics stay.
    """
    adjustment = robust_options()
    adjustment.ceres.solver_options.max_num_iterations = _SETTLING_ITERATIONS
    adjustment.ceres.solver_options.function_tolerance = _SETTLING_TOLERANCE
    mapper = _open_mapper(database, options)
    triangulation = options.get_triangulation()
    for _ in range(_SETTLING_ROUNDS):
        adjust_robustly(model, fixed_cameras, options=adjustment)
        mapper.begin_reconstruction(model)
        mapper.complete_and_merge_tracks(triangulation)
        mapper.retriangulate(triangulation)
        for image_id in model.reg_image_ids():
            mapper.triangulate_image(triangulation, image_id)
        mapper.end_reconstruction(discard=False)
        filter_observations(model)


def adjust_robustly(
    model: pycolmap.Reconstruction,
    fixed_cameras: Collection[int] = (),
    fixed_frames: Collection[int] = (),
    options: pycolmap.BundleAdjustmentOptions | None = None,
) -> None:
    """Adjust all cameras and points of a model by Cauchy's loss.

    Args:
        model: Changed in place.
        fixed_cameras: Cameras whose intrinsics stay. Those that the model lacks do not matter.
        fixed_frames: Frames whose poses stay. Without any, COLMAP holds two cameras to keep the model in its place.
        options: Another loss or tolerance than that of `robust_options`, for comparisons.
    """
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    for camera_id in fixed_cameras:
        if camera_id in model.cameras:
            config.set_constant_cam_intrinsics(camera_id)
    held = [frame_id for frame_id in fixed_frames if frame_id in model.frames and model.frames[frame_id].has_pose]
    for frame_id in held:
        config.set_constant_rig_from_world_pose(frame_id)
    for rig in model.rigs.values():
        for sensor in rig.sensor_ids():
            if not rig.is_ref_sensor(sensor):
                config.set_constant_sensor_from_rig_pose(sensor)
    if not held:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    if options is None:
        options = robust_options()
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    adjuster.solve()
    # The loss lets go of points that do not fit, even of some behind their cameras.
    filter_observations(model)
    model.update_point_3d_errors()


def leave_out_unheld(
    model: pycolmap.Reconstruction,
    fixed_frames: Collection[int] = (),
) -> None:
    """Leave out photos that hardly any observation holds in their place, and these observations.

    No adjustment follows: so few wrong observations moved points by .2 px at most in trials on mouse, plush and sceaux
    and by .9 px on lund, and another adjustment brought none closer by more than .02 px.

    Args:
        model: Changed in place.
        fixed_frames: Frames that stay.
    """
    observations = pycolmap.ObservationManager(model)
    for frame_id in list(model.reg_frame_ids()):
        if frame_id in fixed_frames:
            continue
        images = [model.images[data.id] for data in model.frames[frame_id].image_ids]
        if sum(image.num_points3D for image in images) < _LEAST_OBSERVATIONS:
            observations.deregister_frame(frame_id)


def filter_observations(model: pycolmap.Reconstruction) -> None:
    """Leave out observations of a model that do not fit, and points that are seen from hardly more than one side."""
    pycolmap.ObservationManager(model).filter_all_points3D(_MOST_ERROR, _LEAST_ANGLE)


def robust_options() -> pycolmap.BundleAdjustmentOptions:
    """Return the options of the adjustment."""
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_SCALE
    options.ceres.solver_options.max_num_iterations = _MOST_ITERATIONS
    options.ceres.solver_options.function_tolerance = _TOLERANCE
    return options
