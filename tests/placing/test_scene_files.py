"""The files of a scene are those of nerfstudio's own writer, byte for byte."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from nerfstudio.process_data.colmap_utils import colmap_to_json

from sadgs_ns.placing import scene_files


def model_of(num_cameras: int, num_points: int) -> pycolmap.Reconstruction:
    """A model of four images, whose points lie on both sides of 0 and partly very near it."""
    rng = np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    for camera_id in range(1, num_cameras + 1):
        camera = pycolmap.Camera(model="PINHOLE", width=60, height=40, params=[50, 50, 30, 20], camera_id=camera_id)
        model.add_camera_with_trivial_rig(camera)
    for image_id in range(1, 5):
        keypoints = rng.uniform(0, 40, (num_points, 2))
        camera_id = 1 + image_id % num_cameras
        image = pycolmap.Image(name=f"{image_id}.png", camera_id=camera_id, image_id=image_id, keypoints=keypoints)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rng.normal(size=4)), rng.normal(size=3))
        model.add_image_with_trivial_frame(image, pose)
    for i in range(num_points):
        track = pycolmap.Track([pycolmap.TrackElement(1, i), pycolmap.TrackElement(2, i)])
        xyz = rng.normal(size=3) * 10.0 ** rng.integers(-8, 5)
        model.add_point3D(xyz, track, rng.integers(0, 256, 3, np.uint8))
    return model


@pytest.mark.parametrize("num_cameras", [1, 2])
def test_the_files_are_those_of_nerfstudio(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, num_cameras: int, capsys):
    monkeypatch.setattr(scene_files, "_AT_ONCE", 30)
    model = model_of(num_cameras, 100)
    model.delete_point3D(50)
    sparse = tmp_path / "theirs/sparse"
    sparse.mkdir(parents=True)
    model.write(sparse)
    colmap_to_json(sparse, tmp_path / "theirs")
    capsys.readouterr()
    ours = tmp_path / "ours"
    ours.mkdir()
    scene_files.write_transforms(model, ours, colmap_to_json)
    actual = sorted(path.name for path in ours.iterdir())
    assert actual == ["sparse_pc.ply", "transforms.json"]
    for name in ("sparse_pc.ply", "transforms.json"):
        assert (ours / name).read_bytes() == (tmp_path / "theirs" / name).read_bytes()
    assert model.num_points3D() == 99, "the model stays as it is"
    printed = capsys.readouterr().out
    assert printed == ""
