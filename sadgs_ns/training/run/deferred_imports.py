"""Modules that nerfstudio imports at its start, and that a run of `sadgs` never uses.

They take over half of its time. While a module of nerfstudio is imported, each module that it need not have is replaced
by a stand-in, which imports the real module when something asks for it. Later imports get the real one.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from functools import cache, partial
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
import torch

DEFERRED: dict[str, tuple[str, ...]] = {
    # Its writer of logs has a kind for TensorBoard, which is used with `--vis tensorboard`.
    "nerfstudio.configs.base_config": ("torch.utils.tensorboard",),
    # The viewer moves boxes.
    "nerfstudio.data.scene_box": ("viser", "viser.transforms"),
    # Pictures of depth are coloured.
    "nerfstudio.utils.colormaps": ("matplotlib",),
    # It downloads vocabulary trees for COLMAP.
    "nerfstudio.process_data.colmap_utils": ("requests",),
    # Other packages' parsers are imported here, and get all that they import.
    "nerfstudio.configs.dataparser_configs": (),
    # One option of ns-eval saves images. torchvision imports torch's compiler.
    "nerfstudio.pipelines.base_pipeline": ("torchvision", "torchvision.utils"),
    # Bilateral grids, which import tensorly, are no option of this method, and it calls no function that is compiled.
    "nerfstudio.models.splatfacto": ("nerfstudio.model_components.lib_bilagrid", "nerfstudio.utils.misc"),
    # Without a viewer nothing reads these.
    "nerfstudio.engine.trainer": ("nerfstudio.viewer.viewer", "nerfstudio.viewer_legacy.server.viewer_state", "viser"),
    "nerfstudio.viewer.viewer_elements": ("viser", "viser.transforms"),
}
"""Modules of nerfstudio in the order in which they are imported, and those that each gets a stand-in for."""


class StandIn(ModuleType):
    """Stands for a module, for what it holds, or for what a call returns, until that is read or called."""

    importing = False  # Whether nerfstudio is being imported, which asks for names, and needs none of them yet

    def __init__(self, name: str, find: Callable[[], Any]) -> None:
        super().__init__(name)
        self._find = cache(find)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # The machinery of imports asks for these.
            raise AttributeError(name)
        if StandIn.importing:
            return StandIn(f"{self.__name__}.{name}", lambda: getattr(self._find(), name))
        return getattr(self._find(), name)

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        if StandIn.importing:  # It is a decorator.
            return StandIn(f"{self.__name__}()", lambda: self._find()(*arguments, **options))
        return self._find()(*arguments, **options)


class TorchForCameras(ModuleType):
    """torch, but with a `broadcast_shapes` that imports nothing.

    nerfstudio broadcasts the shapes of each batch of cameras. torch's function imports sympy for sizes that may be
    unknown, which takes a third of a second.
    """

    def __getattr__(self, name: str) -> Any:
        return getattr(torch, name)

    @staticmethod
    def broadcast_shapes(*shapes: Any) -> torch.Size:
        """Broadcast shapes as torch does, and raise RuntimeError as torch does."""
        try:
            return torch.Size(np.broadcast_shapes(*shapes))
        except (TypeError, ValueError):
            return torch.broadcast_shapes(*shapes)


def import_nerfstudio() -> None:
    """Import nerfstudio's trainer, model and parsers with stand-ins for what `DEFERRED` names."""
    try:
        for importer, names in DEFERRED.items():
            StandIn.importing = bool(names)  # Other packages may need what they ask for.
            _import_with_stand_ins(importer, names)
    finally:
        StandIn.importing = False
    from nerfstudio.utils import tensor_dataclass

    # Only this module sees it; torch itself stays as it is.
    tensor_dataclass.torch = TorchForCameras("torch")  # pyright: ignore[reportPrivateImportUsage]


def _import_with_stand_ins(importer: str, names: Sequence[str]) -> None:
    """Import the module `importer` while stand-ins replace the modules `names` in `sys.modules`."""
    imported_before = {name: sys.modules[name] for name in names if name in sys.modules}
    for name in names:
        stand_in = StandIn(name, partial(import_module, name))
        sys.modules[name] = stand_in
        parent, _, child = name.rpartition(".")
        if parent in names:
            setattr(sys.modules[parent], child, stand_in)
    try:
        import_module(importer)
    finally:
        for name in names:
            del sys.modules[name]
        sys.modules.update(imported_before)
