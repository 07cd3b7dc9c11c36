"""The parser of a `transforms.json`, in the place of nerfstudio's."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras import camera_utils
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio, NerfstudioDataParserConfig
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.data.utils.dataparsers_utils import (
    get_train_eval_split_all,
    get_train_eval_split_filename,
    get_train_eval_split_fraction,
    get_train_eval_split_interval,
)
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray
from torch import Tensor

from sadgs_ns.data import colmap, ply
from sadgs_ns.data.images import NO_MASK
from sadgs_ns.data.layouts import COLMAP_FOLDERS, transforms_path
from sadgs_ns.data.run_frame import (
    POINTS_FILE,
    Centring,
    centre_poses,
    move_to_fixed_frame,
    points_in_the_run,
    undo_centring,
)
from sadgs_ns.data.transforms import DISTORTION, read_transforms

_INTRINSICS = {
    "fl_x": ("fx", torch.float32),
    "fl_y": ("fy", torch.float32),
    "cx": ("cx", torch.float32),
    "cy": ("cy", torch.float32),
    "h": ("height", torch.int32),
    "w": ("width", torch.int32),
}
"""Keys of a frame, and the name and type that nerfstudio's cameras have for each."""


class TransformsParser(Nerfstudio):
    """Makes of a `transforms.json` what nerfstudio's parser makes, after completing and centring its content.

    nerfstudio's parser reads the file itself, and no argument or method gives it another content. So this one does the
    whole work, with nerfstudio's functions for orientation, division and cameras. In `read_transforms` each frame gets
    all its values, which makes the work much shorter here.
    """

    config: NerfstudioDataParserConfig

    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
        config = self.config
        path = transforms_path(config.data)
        folder = path.parent
        meta = read_transforms(path)
        centring = centre_poses(meta, config.center_method)
        frames = self._sort_by_file(meta["frames"], folder)
        images = self._files(frames, "file_path", "images_", folder)
        _check_intrinsics(frames)
        masks = self._masks(frames, folder)
        depths = self._files(frames, "depth_file_path", "depths_", folder)
        indices = self._indices(meta, images, split, folder)
        poses, transform, scale = self._place_poses(frames, meta)
        cameras = _make_cameras(frames, poses, meta, torch.tensor(indices, dtype=torch.long))
        assert self.downscale_factor is not None  # The names of the images have set it.
        cameras.rescale_output_resolution(scaling_factor=1.0 / self.downscale_factor)
        from_data = transform
        if "applied_transform" in meta:
            applied = torch.tensor(meta["applied_transform"], dtype=transform.dtype)  # [3, 4]
            last_row = torch.tensor([[0, 0, 0, 1]], dtype=transform.dtype)
            from_data = transform @ torch.cat([applied, last_row])
        if "applied_scale" in meta:
            scale *= float(meta["applied_scale"])
        points = {}
        if config.load_3D_points:
            points = _read_points(meta, folder, centring, transform, from_data, scale)
        metadata = {
            "depth_filenames": _select(depths, indices) or None,
            "depth_unit_scale_factor": config.depth_unit_scale_factor,
            "mask_color": config.mask_color,
            **points,
        }
        outputs = DataparserOutputs(
            image_filenames=_select(images, indices),
            cameras=cameras,
            scene_box=scene_box(config.scene_scale),
            mask_filenames=_select(masks, indices) or None,
            dataparser_scale=scale,
            dataparser_transform=from_data,
            metadata=metadata,
        )
        undo_centring(outputs, centring.of_data)
        move_to_fixed_frame(outputs, meta, path)
        return outputs

    def _sort_by_file(self, frames: Sequence[dict[str, Any]], folder: Path) -> list[dict[str, Any]]:
        """Return the frames in the order of the names of their images, as nerfstudio divides them."""
        names = self._files(frames, "file_path", "images_", folder)
        return [frames[index] for index in np.argsort(names)]  # type: ignore[arg-type]

    def _files(self, frames: Sequence[dict[str, Any]], key: str, smaller: str, folder: Path) -> list[Path]:
        """Return the files that frames name by a key, or nothing if no frame has it; ValueError if only some have it.

        Names of folders with smaller copies start with `smaller`.
        """
        files = [self._get_fname(Path(frame[key]), folder, smaller) for frame in frames if key in frame]
        if len(files) not in (0, len(frames)):
            kind = key.split("_")[0]
            raise ValueError(f"Different number of image and {kind} filenames.")
        return files

    def _masks(self, frames: Sequence[dict[str, Any]], folder: Path) -> list[Path]:
        """Return the mask of each frame, `NO_MASK` for those that name none; none if no frame names one."""
        if not any("mask_path" in frame for frame in frames):
            return []
        masks = []
        for frame in frames:
            mask = NO_MASK
            if "mask_path" in frame:
                mask = self._get_fname(Path(frame["mask_path"]), folder, "masks_")
            masks.append(mask)
        return masks

    def _indices(self, meta: dict[str, Any], images: Sequence[Path], split: str, folder: Path) -> NDArray[np.integer]:
        """Return the indices of the images in a split, which the file lists, or by the parser's options."""
        if f"{split}_filenames" in meta:
            listed = {self._get_fname(Path(name), folder) for name in meta[f"{split}_filenames"]}
            unknown = listed.difference(images)
            if unknown:
                raise RuntimeError(f"Some filenames for split {split} were not found: {unknown}.")
            indices = [index for index, image in enumerate(images) if image in listed]
            CONSOLE.log(f"[yellow] Dataset is overriding {split}_indices to {indices}")
            return np.array(indices, dtype=np.int32)
        if any(f"{other}_filenames" in meta for other in ("train", "val", "test")):
            raise RuntimeError(f"The dataset's list of filenames for split {split} is missing.")
        training, held_out = self._divide(list(images))
        if split == "train":
            return training
        if split in ("val", "test"):
            return held_out
        raise ValueError(f"Unknown dataparser split {split}")

    def _divide(self, images: list[Path]) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
        """Return the indices of training and of held-out images by the parser's options."""
        mode = self.config.eval_mode
        if mode == "fraction":
            return get_train_eval_split_fraction(images, self.config.train_split_fraction)
        if mode == "filename":
            return get_train_eval_split_filename(images)
        if mode == "interval":
            return get_train_eval_split_interval(images, self.config.eval_interval)
        if mode == "all":
            CONSOLE.log(
                "[yellow] Be careful with '--eval-mode=all'. If using camera optimization, the cameras may diverge in "
                "the current implementation, giving unpredictable results."
            )
            return get_train_eval_split_all(images)
        raise ValueError(f"Unknown eval mode {mode}")

    def _place_poses(self, frames: Sequence[dict[str, Any]], meta: dict[str, Any]) -> tuple[Tensor, Tensor, float]:
        """Return the poses in the run's frame [V, 3, 4], and the transform [3, 4] and the scale that led there.

        The scale is applied after the transform.
        """
        config = self.config
        method = config.orientation_method
        if "orientation_override" in meta:
            method = meta["orientation_override"]
            CONSOLE.log(f"[yellow] Dataset is overriding orientation method to {method}")
        stored = np.array([frame["transform_matrix"] for frame in frames])  # [V, 4, 4]
        poses, transform = camera_utils.auto_orient_and_center_poses(
            torch.from_numpy(stored.astype(np.float32)), method=method, center_method=config.center_method
        )
        scale = 1.0
        if config.auto_scale_poses:
            scale /= float(poses[:, :3, 3].abs().max())
        scale *= config.scale_factor
        poses[:, :3, 3] *= scale
        return poses[:, :3, :4], transform, scale


def scene_box(half_side: float) -> SceneBox:
    """Return a cube around the origin, given half the length of its edges."""
    corners = [[-half_side] * 3, [half_side] * 3]
    return SceneBox(torch.tensor(corners, dtype=torch.float32))


def _select(files: Sequence[Path], indices: NDArray[np.integer]) -> list[Path]:
    """Return the files with these indices; none if there are no files."""
    if not files:
        return []
    return [files[index] for index in indices]


def _check_intrinsics(frames: Sequence[dict[str, Any]]) -> None:
    """Raise ValueError for the first frame that lacks one of its intrinsics."""
    for frame in frames:
        for key, (name, _) in _INTRINSICS.items():
            if key not in frame:
                raise ValueError(f"{name} not specified in frame")


def _make_cameras(frames: Sequence[dict[str, Any]], poses: Tensor, meta: dict[str, Any], indices: Tensor) -> Cameras:
    """Return nerfstudio's cameras of the frames with these indices; poses are those of all frames. [V, 3, 4]"""
    camera_type = CAMERA_MODEL_TO_TYPE[meta["camera_model"]]
    intrinsics = {}
    for key, (name, dtype) in _INTRINSICS.items():
        values = torch.tensor([float(frame[key]) for frame in frames])  # [V]
        intrinsics[name] = values.to(dtype)[indices]
    distortion = torch.stack([_distortion(frame) for frame in frames])  # [V, 6 or 12]
    metadata = {}
    crop_radius = meta.get("fisheye_crop_radius")
    if camera_type in (CameraType.FISHEYE, CameraType.FISHEYE624) and crop_radius is not None:
        metadata["fisheye_crop_radius"] = crop_radius
    return Cameras(
        **intrinsics,
        distortion_params=distortion[indices],
        camera_to_worlds=poses[indices],
        camera_type=camera_type,
        metadata=metadata,
    )


def _distortion(frame: dict[str, Any]) -> Tensor:
    """Return the distortion coefficients of a frame, in nerfstudio's order. [6 or 12]"""
    if "distortion_params" in frame:
        return torch.tensor(frame["distortion_params"], dtype=torch.float32)
    return torch.tensor([float(frame.get(name, 0.0)) for name in DISTORTION])


def _read_points(
    meta: dict[str, Any], folder: Path, centring: Centring, transform: Tensor, from_data: Tensor, scale: float
) -> dict[str, Any]:
    """Return the points of the file's PLY, or of a COLMAP model beside it, in the run's frame; none if there are none.

    A PLY is in the frame of the poses, of which `transform` [3, 4] maps to the run's frame, and a model is in that of
    the data, of which `from_data` [3, 4] does.
    """
    model = folder / COLMAP_FOLDERS[0]
    if "ply_file_path" in meta:
        positions, colors = ply.read_points(folder / meta["ply_file_path"])
        if len(positions) > 0:
            return points_in_the_run(positions - centring.of_poses, colors, transform, scale)
    elif not model.exists():
        CONSOLE.print(
            "[bold yellow]Warning: load_3D_points set to true but no point cloud found. splatfacto will use random "
            "point cloud initialization."
        )
    source = colmap.points_file(model)
    if source is None:
        return {}
    positions, colors = colmap.read_points(source)
    return points_in_the_run(positions - centring.of_data, colors, from_data, scale) | {POINTS_FILE: source}
