"""nerfstudio glue: nerfstudio's loader of whole images, behind checks of what the data ask it to do."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.datasets.base_dataset import InputDataset

from sadgs_ns import colmap_model


@dataclass
class SadgsDatamanagerConfig(FullImageDatamanagerConfig):
    """nerfstudio's."""

    _target: type = field(default_factory=lambda: SadgsDatamanager)


class SadgsDatamanager(FullImageDatamanager[InputDataset]):
    """Checks a COLMAP model before nerfstudio reads it, and where its images lie.

    Here rather than in the pipeline, because `ns-render dataset` makes a datamanager of its own.

    Raises:
        ValueError: As `colmap_model.check` and `colmap_model.check_paths`.
    """

    def __init__(self, config: FullImageDatamanagerConfig, *args: Any, **kwargs: Any) -> None:
        parser = config.dataparser
        if isinstance(parser, ColmapDataParserConfig):
            colmap_model.check((config.data or parser.data) / parser.colmap_path)
        super().__init__(config, *args, **kwargs)  # type: ignore[arg-type]
        for dataset in (self.train_dataset, self.eval_dataset):
            colmap_model.check_paths(dataset.image_filenames)
