"""This package's parsers in the place of nerfstudio's."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import imageio
import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.blender_dataparser import Blender
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio
from nerfstudio.data.dataparsers.scannet_dataparser import ScanNet
from numpy.typing import NDArray
from torch import Tensor

from sadgs_ns.data import colmap, ply
from sadgs_ns.data.images import NO_MASK, mask_name
from sadgs_ns.data.run_frame import POINTS_FILE, centre_poses, points_in_the_run, undo_centring
from sadgs_ns.data.transforms import blender_images, read_blender
from sadgs_ns.data.transforms_parser import TransformsParser, scene_box

_BLENDER_SIDE = 1.5  # Half the side of the box around a Blender scene, which nerfstudio gives it


class BlenderParser(Blender):
    """Makes of a Blender scene what nerfstudio's parser makes, also where names end in .png or validation is missing.

    nerfstudio's parser reads the scene's files itself, and no method gives it another content.
    """

    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
        meta = read_blender(self.data / f"transforms_{split}.json")
        frames = meta["frames"]
        images = blender_images(frames, self.data)
        first_image = imageio.v2.imread(images[0])
        height, width = first_image.shape[:2]
        poses = np.array([frame["transform_matrix"] for frame in frames]).astype(np.float32)  # [V, 4, 4]
        camera_to_worlds = torch.from_numpy(poses[:, :3])
        camera_to_worlds[:, :, 3] *= self.scale_factor
        angle = float(meta["camera_angle_x"])  # Horizontal angle of view in radians
        focal = 0.5 * width / np.tan(0.5 * angle)  # In px
        cameras = Cameras(
            camera_to_worlds=camera_to_worlds,
            fx=focal,
            fy=focal,
            cx=width / 2.0,
            cy=height / 2.0,
            camera_type=CameraType.PERSPECTIVE,
        )
        points = {}
        ply_path = self.config.ply_path
        if ply_path is not None:
            identity = torch.eye(4)[:3]
            points = _read_ply(self.config.data / ply_path, identity, self.config.scale_factor)
        return DataparserOutputs(
            image_filenames=images,
            cameras=cameras,
            alpha_color=self.alpha_color_tensor,
            scene_box=scene_box(_BLENDER_SIDE),
            dataparser_scale=self.scale_factor,
            metadata=points,
        )


class ScanNetParser(ScanNet):
    """nerfstudio's parser of ScanNet's scenes, which reads points without open3d, and none if there is no such file."""

    def _load_3D_points(self, path: Path, transform: Tensor, scale: float, use_colors: bool) -> dict[str, Tensor]:
        if not path.is_file():  # By default there is none.
            return {}
        return _read_ply(path, transform, scale)


class ColmapParser(ColmapDataParser):
    """nerfstudio's parser of COLMAP's files, which reads points in a tenth of the time and finds masks by all names.

    The poses are read once, and not for each split.
    """

    _read: dict[str, Any] | None = None  # What `_get_all_images_and_cameras` returned
    _middle: NDArray[np.float64] = np.zeros(3)  # By which the poses were centred, in the frame of the data

    def _generate_dataparser_outputs(self, split: str = "train", **options: Any) -> DataparserOutputs:
        outputs = super()._generate_dataparser_outputs(split, **options)
        undo_centring(outputs, self._middle)
        return outputs

    def _get_all_images_and_cameras(self, recon_dir: Path) -> dict[str, Any]:
        if self._read is None:
            self._read = self._read_images_and_cameras(recon_dir)
        return self._read

    def _read_images_and_cameras(self, recon_dir: Path) -> dict[str, Any]:
        config = self.config
        meta = super()._get_all_images_and_cameras(recon_dir)
        if config.masks_path is not None:
            masks = config.data / config.masks_path
            images = config.data / config.images_path
            for frame in meta["frames"]:
                name = os.path.relpath(frame["file_path"], images.as_posix())
                mask = mask_name(masks, name)
                frame["mask_path"] = str(NO_MASK)
                if mask is not None:
                    frame["mask_path"] = (masks / mask).as_posix()
        self._middle = centre_poses(meta, config.center_method).of_data
        return meta

    def _setup_downscale_factor(self, image_filenames: list[Path], mask_filenames: list[Path], *others: Any) -> Any:
        present = [mask for mask in mask_filenames if mask != NO_MASK]
        images, smaller, depths, factor = super()._setup_downscale_factor(image_filenames, present, *others)
        remaining = iter(smaller)
        masks = []
        for mask in mask_filenames:
            if mask != NO_MASK:
                mask = next(remaining)
            masks.append(mask)
        return images, masks, depths, factor

    def _load_3D_points(self, colmap_path: Path, transform_matrix: Tensor, scale_factor: float) -> dict[str, Tensor]:
        matches = {}
        if self.config.max_2D_matches_per_3D_point != 0:
            matches = super()._load_3D_points(colmap_path, transform_matrix, scale_factor)
        source = colmap.points_file(colmap_path) or colmap_path / "points3D.bin"
        positions, colors = colmap.read_points(source)
        placed = points_in_the_run(positions - self._middle, colors, transform_matrix, scale_factor)
        return matches | placed | {POINTS_FILE: source}  # type: ignore[return-value]


OWN: dict[type, type] = {
    Blender: BlenderParser,
    ColmapDataParser: ColmapParser,
    ScanNet: ScanNetParser,
    Nerfstudio: TransformsParser,
}
"""This package's parser in the place of each of nerfstudio's."""


def _read_ply(path: Path, transform: Tensor, scale: float) -> dict[str, Tensor]:
    """Return the points of a PLY file in the run's frame, to which a transform [3, 4] maps; none if it has none."""
    positions, colors = ply.read_points(path)
    if len(positions) == 0:
        return {}
    return points_in_the_run(positions, colors, transform, scale)
