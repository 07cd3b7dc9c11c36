"""nerfstudio glue: nerfstudio's loader of whole images, behind checks of the names in the data."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.datasets.base_dataset import InputDataset

from sadgs_ns import colmap, paths


@dataclass
class SadgsDatamanagerConfig(FullImageDatamanagerConfig):
    """nerfstudio's."""

    _target: type = field(default_factory=lambda: SadgsDatamanager)


class SadgsDatamanager(FullImageDatamanager[InputDataset]):
    """Checks what the data's images are called, and where they lie.

    Here rather than in the pipeline, because `ns-render dataset` makes a datamanager of its own.

    Raises:
        InputError: As `colmap.read_poses`, `paths.check_names` and `paths.check_paths`.
    """

    def __init__(self, config: FullImageDatamanagerConfig, *args: Any, **kwargs: Any) -> None:
        parser = config.dataparser
        if isinstance(parser, ColmapDataParserConfig):  # before it offers to make smaller images
            model = (config.data or parser.data) / parser.colmap_path
            kind = "txt" if (model / "cameras.txt").exists() else "bin"
            if (source := model / f"images.{kind}").is_file():
                paths.check_names((name for name, _, _ in colmap.read_poses(source)), source)
        super().__init__(config, *args, **kwargs)  # type: ignore[arg-type]
        for dataset in (self.train_dataset, self.eval_dataset):
            paths.check_paths(dataset.image_filenames)
