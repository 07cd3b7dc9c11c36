"""Photos from a video: the sharpest frame of each of its stretches."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np

from sadgs_ns.atomic import atomic_path
from sadgs_ns.errors import InputError

VIDEO_SUFFIXES = {".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v"}


def sharpest_frames(video: Path, count: int) -> Iterator[tuple[int, np.ndarray]]:
    """Yield number and picture of the sharpest frame of each of `count` stretches of a video.

    The sharpest is the one whose Laplacian varies most. Pictures are BGR, uint8 [H, W, 3].

    Raises:
        InputError: If OpenCV cannot read the video.
    """
    capture = cv2.VideoCapture(str(video))
    total = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    if not capture.isOpened() or total < 1:
        raise InputError(f"{video} cannot be read as a video; convert it to MP4 with H.264.")
    stretch = max(total / count, 1.0)
    frames = itertools.takewhile(lambda read: read[0], iter(capture.read, None))
    for number, group in itertools.groupby(enumerate(frames), lambda numbered: int(numbered[0] / stretch)):
        yield number, max((frame for _, (_, frame) in group), key=_sharpness)


def _sharpness(frame: np.ndarray) -> float:
    return float(cv2.Laplacian(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), cv2.CV_64F).var())


def check_video(video: Path) -> None:
    """Raise an InputError if a file's name is not that of a video."""
    if video.suffix.lower() not in VIDEO_SUFFIXES:
        raise InputError(f"{video} is neither a folder of photos nor a video ({', '.join(sorted(VIDEO_SUFFIXES))}).")


def video_frames(video: Path, count: int) -> Iterator[tuple[int, np.ndarray]]:
    """Return the `sharpest_frames` of a video, of which there are at least three.

    Raises:
        InputError: If the file is no video, or gives fewer than three frames.
    """
    check_video(video)
    frames = sharpest_frames(video, count)
    first = list(itertools.islice(frames, 3))
    if len(first) < 3:
        raise InputError(f"{video} gives {len(first)} frames; a reconstruction needs at least 3, better 30 or more.")
    return itertools.chain(first, frames)


def write_frames(frames: Iterable[tuple[int, np.ndarray]], folder: Path, report: Callable[[int], None]) -> None:
    """Write frames, as `video_frames` yields them, to a folder as numbered photos; raise a WriteError if one fails."""
    for number, frame in frames:
        with atomic_path(folder / f"{number:05d}.jpg") as partial:
            # OpenCV's own writing of files does not tell of a full disk.
            partial.write_bytes(cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 97])[1].tobytes())
        report(number + 1)
