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
    """Yield number and picture [H, W, 3] of the sharpest frame of each of `count` stretches of a video.

    The sharpest is the one whose Laplacian varies most.

    Raises:
        InputError: If OpenCV cannot read the video.
    """
    capture = cv2.VideoCapture(str(video))
    total = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    if not capture.isOpened() or total < 1:
        raise InputError(f"{video} cannot be read as a video; convert it to MP4 with H.264.")
    stretch = max(total / count, 1.0)
    best: tuple[float, np.ndarray] | None = None
    for i in itertools.count():
        read, frame = capture.read()
        number = int(i / stretch)
        if best is not None and (not read or int((i - 1) / stretch) != number):
            yield int((i - 1) / stretch), best[1]
            best = None
        if not read:
            return
        grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        sharpness = float(cv2.Laplacian(grey, cv2.CV_64F).var())
        if best is None or sharpness > best[0]:
            best = (sharpness, frame)


def video_frames(video: Path, count: int) -> Iterator[tuple[int, np.ndarray]]:
    """Return the `sharpest_frames` of a video, of which there are at least three.

    Raises:
        InputError: If the file is no video, or gives fewer than three frames.
    """
    if video.suffix.lower() not in VIDEO_SUFFIXES:
        raise InputError(f"{video} is neither a folder of photos nor a video ({', '.join(sorted(VIDEO_SUFFIXES))}).")
    frames = sharpest_frames(video, count)
    first = list(itertools.islice(frames, 3))
    if len(first) < 3:
        raise InputError(f"{video} gives {len(first)} frames; a reconstruction needs at least 3, better 30 or more.")
    return itertools.chain(first, frames)


def write_frames(frames: Iterable[tuple[int, np.ndarray]], folder: Path, report: Callable[[int], None]) -> None:
    """Write frames to a folder as numbered photos.

    Args:
        frames: Number and picture [H, W, 3] of each, BGR and 8-bit, as OpenCV reads them.
        folder: Where the photos go.
        report: Called with the number of stretches of the video that are done.

    Raises:
        WriteError: If one cannot be written.
    """
    for number, frame in frames:
        with atomic_path(folder / f"{number:05d}.jpg") as partial:
            # OpenCV's own writing of files does not tell of a full disk.
            partial.write_bytes(cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 97])[1].tobytes())
        report(number + 1)
