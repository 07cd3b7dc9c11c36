"""Frames of videos have the colours that their tags tell, or their size if they have none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from av.video.reformatter import Colorspace

from sadgs_ns.placing.video import video_frames

RED = (200, 30, 30)
BT_709 = Colorspace.ITU709
BT_601 = Colorspace.ITU601
UNTAGGED = 2


def record(file: Path, size: tuple[int, int], matrix: Colorspace, tag: int) -> Path:
    """Write a red video by a matrix from RGB to YUV, which the stream tells or not."""
    width, height = size
    with av.open(str(file), "w") as container:
        stream: Any = container.add_stream("libx264", rate=10, options={"crf": "1", "preset": "ultrafast"})
        stream.width = width
        stream.height = height
        stream.pix_fmt = "yuv420p"
        stream.codec_context.colorspace = tag
        drawn = av.VideoFrame.from_ndarray(np.full((height, width, 3), RED, np.uint8), format="rgb24")
        for _ in range(3):
            frame = drawn.reformat(format="yuv420p", dst_colorspace=matrix)
            frame.colorspace = tag
            frame.pts = None
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with av.open(str(file)) as container:
        assert next(container.decode(video=0)).colorspace == tag
    return file


@pytest.mark.hard_case(
    "videos without colour tags", "BT.709 from 720 lines or 1280 columns on, as players show them, BT.601 below"
)
@pytest.mark.parametrize(
    ("size", "matrix", "tag"),
    [
        ((1280, 720), BT_709, UNTAGGED),
        ((320, 720), BT_709, UNTAGGED),
        ((1280, 544), BT_709, UNTAGGED),
        ((720, 576), BT_601, UNTAGGED),
        ((1280, 720), BT_709, 1),
        ((1280, 720), BT_601, 6),
        ((320, 240), BT_709, 1),
    ],
)
def test_a_film_has_the_colours_that_its_tag_or_size_tells(
    size: tuple[int, int], matrix: Colorspace, tag: int, tmp_path: Path
):
    frames = list(video_frames(record(tmp_path / "film.mp4", size, matrix, tag), [], 3))
    assert len(frames) == 3
    for _, frame in frames:
        assert np.abs(frame[8, 8, ::-1].astype(int) - RED).max() <= 5


def test_an_untagged_film_in_rgb_keeps_its_values(tmp_path: Path):
    with av.open(str(tmp_path / "film.avi"), "w") as container:
        stream: Any = container.add_stream("png", rate=10)
        stream.width = 1280
        stream.height = 720
        stream.pix_fmt = "rgb24"
        for _ in range(3):
            drawn = av.VideoFrame.from_ndarray(np.full((720, 1280, 3), RED, np.uint8), format="rgb24")
            container.mux(stream.encode(drawn))
        container.mux(stream.encode())
    for _, frame in video_frames(tmp_path / "film.avi", [], 3):
        assert (frame == RED[::-1]).all()
