"""Reading the config.yml of a run that an earlier version of this package made.

nerfstudio reads config.yml with `yaml.Loader`, which makes an object of each class that the file names and gives it the
attributes that the file lists. In files of earlier versions classes have other names, some options are missing and
others are no longer known. The constructors that are registered here, for our own classes alone, mend this.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import yaml
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.splatfacto import SplatfactoModelConfig
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

MOVED = {
    "sadgs_ns.trainer.SadgsTrainer": "sadgs_ns.plugin.trainer.SadgsTrainer",
    "sadgs_ns.plugin.trainer.SadgsMachineConfig": "sadgs_ns.plugin.config.SadgsMachineConfig",
    "sadgs_ns.plugin.trainer.SadgsViewerConfig": "sadgs_ns.plugin.config.SadgsViewerConfig",
    "sadgs_ns.pipeline.SadgsPipeline": "sadgs_ns.plugin.pipeline.SadgsPipeline",
    "sadgs_ns.pipeline.SadgsPipelineConfig": "sadgs_ns.plugin.pipeline.SadgsPipelineConfig",
    "sadgs_ns.datamanager.SadgsDatamanager": "sadgs_ns.plugin.datamanager.SadgsDatamanager",
    "sadgs_ns.datamanager.SadgsDatamanagerConfig": "sadgs_ns.plugin.datamanager.SadgsDatamanagerConfig",
    "sadgs_ns.model.SadgsModel": "sadgs_ns.plugin.model.SadgsModel",
    "sadgs_ns.model.SadgsModelConfig": "sadgs_ns.plugin.model.SadgsModelConfig",
    "sadgs_ns.strategy.StructureAwareStrategy": "sadgs_ns.method.strategy.StructureAwareStrategy",
    "sadgs_ns.optimizers.FusedAdam": "sadgs_ns.plugin.optimizers.FusedAdam",
    "sadgs_ns.optimizers.FusedAdamOptimizerConfig": "sadgs_ns.plugin.optimizers.FusedAdamOptimizerConfig",
    "sadgs_ns.optimizers.RunLengthDecayScheduler": "sadgs_ns.plugin.optimizers.RunLengthDecayScheduler",
    "sadgs_ns.optimizers.RunLengthDecaySchedulerConfig": "sadgs_ns.plugin.optimizers.RunLengthDecaySchedulerConfig",
}
"""Earlier names of classes that a config.yml names, and where these are now."""

CONSTANTS: dict[str, Any] = {
    "scale_position_lr": True,
    "noise_floor": 0.02,
    "densify": True,
    "num_downscales": 0,
    "sh_degree_interval": 1,
    "l2_lambda": 2.0,
    "camera_clearance": 2.0,
    "directional_eta": False,
    "split_exponent": 0.5,
    "split_extent": 3**0.5,
    "tau_prune": 0.8,
    "prune_opacity": 0.1,
    "small_scale": 0.001,
    "clamp_opacity": 0.8,
    "reset_factor": 0.1,
    "final_prune_opacity": 0.1,
    "eta_min_opacity": 0.3,
    "memory_budget_gb": None,
    "verbose": False,
    "use_scale_regularization": False,
}
"""Removed options at the values that the method has kept: a run with these lacks nothing."""


BEFORE: dict[str, Any] = {
    "rates_follow_views": False,
    "averaged_share": 0.0,
    "max_off_axis": 0.0,
    "max_angular_scale": 0.0,
    "color_model": "none",
}
"""New options whose default changes a run, at the value that runs of earlier versions had."""


NO_OPTIONS = ("run_length", "shards")
"""What earlier versions wrote among the options and is decided in each run."""


REPLACED = {("use_bilateral_grid", True): ("color_model", "bilateral_grid")}
"""Removed options with a value that another option now has a value for."""


def read_with(trainer_config: type[TrainerConfig]) -> None:
    """Let `yaml.Loader` read earlier versions' names of our classes, and bring what it reads up to date.

    Args:
        trainer_config: The class of the whole configuration, `SadgsTrainerConfig`.
    """

    def whole(loader: yaml.Loader, node: Any) -> TrainerConfig:
        config = trainer_config.__new__(trainer_config)
        for name, value in loader.construct_mapping(node, deep=True).items():
            setattr(config, str(name), value)
        if left_out := _bring_up_to_date(config, ""):
            CONSOLE.print(
                "[yellow]The config.yml is of another version of sadgs; of its options this version leaves out "
                f"{escape(', '.join(left_out))}: rendering is the same, more training may not be.[/]"
            )
        return config

    prefix = "tag:yaml.org,2002:python/"
    name = trainer_config.__name__
    for module in ("sadgs_ns.trainer", trainer_config.__module__):
        yaml.add_constructor(f"{prefix}object:{module}.{name}", whole, Loader=yaml.Loader)
    for before, now in MOVED.items():
        yaml.add_constructor(
            f"{prefix}object:{before}",
            lambda loader, node, now=now: loader.construct_python_object(now, node),
            Loader=yaml.Loader,
        )
        yaml.add_constructor(
            f"{prefix}name:{before}",
            lambda loader, node, now=now: loader.construct_python_name(now, node),
            Loader=yaml.Loader,
        )


def _bring_up_to_date(config: Any, path: str) -> list[str]:
    """Give our classes in a configuration the options that they lack, and take those that they no longer have.

    Args:
        config: The configuration, or a part of it.
        path: What leads to the part, such as `pipeline.`.

    Returns:
        The options that were taken and might change a run, such as `pipeline.model.densify=False`.
    """
    if isinstance(config, dict):
        return [left for name, value in config.items() for left in _bring_up_to_date(value, f"{path}{name}.")]
    if not dataclasses.is_dataclass(config) or not type(config).__module__.startswith("sadgs_ns."):
        return []
    options = {option.name: option for option in dataclasses.fields(config)}
    for (name, value), (now, means) in REPLACED.items():
        if now in options and vars(config).get(name) is value:
            delattr(config, name)
            setattr(config, now, means)
    for name, option in options.items():
        if option.init and name not in vars(config):
            made = option.default_factory is not dataclasses.MISSING
            default = option.default_factory() if made else option.default  # type: ignore[misc]
            setattr(config, name, BEFORE.get(name, default))
    harmless = {**vars(SplatfactoModelConfig()), **CONSTANTS}  # options of splatfacto's densification had no effect
    left_out: list[str] = []
    for name, value in sorted(vars(config).items()):
        if name in options:
            left_out += _bring_up_to_date(value, f"{path}{name}.")
        else:
            delattr(config, name)
            if name not in NO_OPTIONS and (name not in harmless or harmless[name] != value):
                left_out.append(f"{path}{name}={value!r}")
    return left_out
