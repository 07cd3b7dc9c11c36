"""The last adjustment of cameras and points, in which wrong matches hardly count.

COLMAP's own minimises the squares of residuals, so that a few wrong matches among thousands pull the cameras: with
other random samples, points of the scene `castle` move by a tenth of a pixel on the mean. With a robust loss, each
observation pulls less the further it lies from its point.
"""

from __future__ import annotations

from collections.abc import Collection

import pycolmap

LOSS_SCALE = 1.0  # Residual in px from which an observation counts as if it were wrong
_MOST_ITERATIONS = 50
_TOLERANCE = 1e-3
"""Relative change of the cost at which the adjustment ends. With 1e-5 points move by as little between samples, in two
to seven times the time."""


def adjust_robustly(
    model: pycolmap.Reconstruction, fixed_cameras: Collection[int] = (), fixed_frames: Collection[int] = ()
) -> None:
    """Adjust all cameras and points of a model by Cauchy's loss.

    Args:
        model: Changed in place.
        fixed_cameras: Cameras whose intrinsics stay. Those that the model lacks do not matter.
        fixed_frames: Frames whose poses stay. Without any, COLMAP holds two cameras to keep the model in its place.
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
    adjuster = pycolmap.create_default_bundle_adjuster(robust_options(), config, model)
    adjuster.solve()
    model.update_point_3d_errors()


def robust_options() -> pycolmap.BundleAdjustmentOptions:
    """Return the options of the adjustment."""
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_SCALE
    options.ceres.solver_options.max_num_iterations = _MOST_ITERATIONS
    options.ceres.solver_options.function_tolerance = _TOLERANCE
    return options
