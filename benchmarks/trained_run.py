"""Loads a trained run, for benchmarks that look into it after training."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def load_pipeline(config: Path, step: int | None = None) -> Any:
    """Return the pipeline of a run, as nerfstudio loads it, at the checkpoint of a step.

    Args:
        config: The run's config.yml.
        step: Without it the last checkpoint is loaded.
    """
    from nerfstudio.utils.eval_utils import eval_setup

    def choose(loaded: Any) -> Any:
        loaded.load_step = step
        return loaded

    _, pipeline, _, _ = eval_setup(config, test_mode="test", update_config_callback=choose)
    return pipeline
