"""Read the options of `ns-train sadgs` as it does, without importing all of nerfstudio."""

# ruff: noqa: E402 - nerfstudio is imported after what it need not have was replaced
from __future__ import annotations

import copy
from collections.abc import Sequence

import tyro
from tyro.conf import FlagConversionOff, SuppressFixed

from sadgs_ns.training.run.deferred_imports import import_nerfstudio

import_nerfstudio()  # This comes before any import of nerfstudio.

from nerfstudio.engine.trainer import TrainerConfig

from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.presets import sadgs


def read_options(words: Sequence[str]) -> TrainerConfig:
    """Return what these options of `ns-train sadgs` ask for, or print an error or their help, and exit."""
    annotated = SuppressFixed[FlagConversionOff[SadgsTrainerConfig]]  # as nerfstudio annotates its methods
    return tyro.cli(annotated, prog="ns-train sadgs", args=words, default=copy.deepcopy(sadgs.config))


def check_words(words: Sequence[str]) -> None:
    """Print an error and exit unless these are options of `ns-train sadgs`; the function of a worker."""
    read_options(words)
