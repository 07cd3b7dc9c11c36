"""The methods that nerfstudio finds through this package's entry points."""

from __future__ import annotations

from typing import Any

from nerfstudio.plugins.types import MethodSpecification

from sadgs_ns.method.schedule import DENSIFICATION_SHARE
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.training.config import SadgsModelConfig, SadgsPipelineConfig, SadgsTrainerConfig
from sadgs_ns.training.step.optimizers import FusedAdamOptimizerConfig, RunLengthDecaySchedulerConfig, pose_optimizer

RATES: dict[str, tuple[float, float, float]] = {
    "means": (1.6e-4, 1.0, 0.01),
    "features_dc": (2.5e-3, 1.0, 0.1),
    "features_rest": (2.5e-4, 1.0, 0.1),
    "opacities": (0.025, 1.0, 0.1),
    "scales": (0.02, 1.0, 1.0),
    "quats": (0.002, 1.0, 1.0),
    "color_matrices": (3e-3, 1.0, 0.1),
}
"""Learning rate of each group of parameters, and factors on it at the first and last iteration, for steps of one view.

Positions, colours and opacities start at 3DGS's rates; scales have four times 3DGS's rate, rotations twice.
"""
HELD = ("features_dc", "features_rest", "opacities")  # Their rates are constant until densification ends and fall then.
CONSTANT = {name: (RATES[name][0], 1.0, 1.0) for name in HELD}  # Rates in the paper's presets, which do not fall


def optimizers(**rates: tuple[float, float, float]) -> dict[str, dict[str, Any]]:
    """Return Adam, and a schedule if its rate changes, of each group of parameters. `rates` override `RATES`."""
    groups: dict[str, dict[str, Any]] = {}
    for name, (lr, initial_factor, final_factor) in (RATES | rates).items():
        groups[name] = {"optimizer": FusedAdamOptimizerConfig(lr=lr)}
        if (initial_factor, final_factor) != (1.0, 1.0):
            hold = 0.0
            if name in HELD:
                hold = DENSIFICATION_SHARE
            groups[name]["scheduler"] = RunLengthDecaySchedulerConfig(
                initial_factor=initial_factor, final_factor=final_factor, hold_share=hold
            )
    groups["poses"] = pose_optimizer()
    return groups


def paper_pipeline(views_per_iteration: int) -> SadgsPipelineConfig:
    """Return the paper's options, with those of AbsGS and the released code where it gives none (docs/method.md)."""
    return SadgsPipelineConfig(
        views_per_iteration=views_per_iteration,
        energy_blur=0.0,
        epsilon=1e-6,
        model=SadgsModelConfig(
            ssim_lambda=0.2,
            opacity_reg=0.0,
            averaged_share=0.0,
            near_plane="scene",
            max_angular_scale=0.0,
            stereo_points=0,
            dropout=0.0,
            clear_paths=False,
            starts_per_pixel=0.0,
            strategy=StructureAwareStrategy(
                eta_every=1,
                min_observations=1,
                split_min_opacity=0.0,
                child_scale=1.0,
                clone_grad2d=2e-4,
                split_absgrad2d=4e-4,
                absgs_long_axis=False,
                min_opacity=0.005,
                structure_every=500,
                absgs_every=100,
                refine_start_iter=100,
                refine_stop_iter=1900,
                reset_every=1200,
            ),
        ),
    )


sadgs = MethodSpecification(
    description="Structure-aware densification; the number of views decides how long it trains.",
    config=SadgsTrainerConfig(method_name="sadgs", optimizers=optimizers()),
)


def paper_method(name: str, where: str, views: int, **rates: tuple[float, float, float]) -> MethodSpecification:
    """Return a preset of the paper, with these rates of scales and rotations."""
    views_in_words = {1: "one view", 2: "two views"}[views]
    return MethodSpecification(
        description=(
            f"Structure-aware densification with the paper's loss and children, {where} scenes; 3,000 iterations of "
            f"{views_in_words}."
        ),
        config=SadgsTrainerConfig(
            method_name=name,
            max_num_iterations=3000,
            pipeline=paper_pipeline(views_per_iteration=views),
            rates_follow_views=False,
            optimizers=optimizers(**CONSTANT, **rates),
        ),
    )


sadgs_paper = paper_method("sadgs-paper", "outdoor", 1, scales=(0.01, 1.0, 1.0))
sadgs_paper_indoor = paper_method("sadgs-paper-indoor", "indoor", 2, scales=(5e-3, 3.0, 0.5), quats=(1e-3, 3.0, 0.5))
