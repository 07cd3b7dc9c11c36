"""Start training for `sadgs` as `ns-train sadgs` does, without importing all of nerfstudio."""

from __future__ import annotations

import random
import sys

from sadgs_ns.training.kernels_ahead import compile_ahead

if {"-h", "--help"}.isdisjoint(sys.argv):
    compile_ahead.begin()  # It goes on while the rest is imported.

import numpy as np
import torch

from sadgs_ns.events import report
from sadgs_ns.training.run.train_options import read_options  # This comes before any import of nerfstudio.

# isort: split
from sadgs_ns.training.run import trainer  # noqa: F401 - a run's config imports it when it begins


def train() -> None:
    """Do what `ns-train` does with `sys.argv`, whose first two words are `ns-train sadgs`."""
    report("imported")
    config = read_options(sys.argv[2:])
    if config.data:
        config.pipeline.datamanager.data = config.data
    config.set_timestamp()
    config.save_config()
    if config.machine.num_devices > 1:
        from nerfstudio.scripts.train import launch, train_loop

        launch(train_loop, config.machine.num_devices, config.machine.num_machines, config=config)
        return
    torch.backends.cudnn.benchmark = True
    random.seed(config.machine.seed)
    np.random.seed(config.machine.seed)
    torch.manual_seed(config.machine.seed)
    run = config.setup(local_rank=0, world_size=1)
    run.setup()
    run.train()
