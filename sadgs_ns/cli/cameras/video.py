"""Photos from videos: the sharpest frame of each stretch. PyAV and OpenCV are imported only if there is a video."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from sadgs_ns.errors import InputError
from sadgs_ns.files import atomic_path


def count_frames(video: Path) -> int:
    """Return the number of a video's frames, which recordings do not tell; raise InputError if it is no video."""
    import av

    try:
        with av.open(os.fspath(video)) as container:
            stream = container.streams.best("video")
            assert isinstance(stream, av.VideoStream)
            return stream.frames or sum(packet.size > 0 for packet in container.demux(stream))
    except Exception as error:  # FFmpeg has many.
        why = getattr(error, "strerror", None) or "it shows nothing"
        remedy = "give a folder of photos or of videos, or convert a video to MP4 with H.264."
        raise InputError(f"{video} cannot be read as a video ({why}); {remedy}") from error


def read_frames(video: Path) -> Iterator[np.ndarray]:
    """Yield the frames of a video as a player shows them: upright, and without damaged ones. BGR, uint8 [H, W, 3]"""
    import av
    from av.error import InvalidDataError

    with av.open(os.fspath(video)) as container:
        stream = container.streams.best("video")
        assert isinstance(stream, av.VideoStream)  # `count_frames` was called before.
        stream.codec_context.thread_type = "AUTO"
        for packet in container.demux(stream):
            try:
                frames = stream.decode(packet)
            except InvalidDataError:
                continue
            for frame in frames:
                yield np.rot90(frame.to_ndarray(format="bgr24"), frame.rotation // 90)


def sharpest_frames(video: Path, count: int, total: int) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the number of each of `count` stretches of a video, and its frame, BGR, whose Laplacian varies most."""
    import cv2

    stretches = itertools.groupby(enumerate(read_frames(video)), lambda numbered: numbered[0] * count // total)
    for number, group in itertools.takewhile(lambda stretch: stretch[0] < count, stretches):
        grey = ((frame, cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)) for _, frame in group)
        yield number, max(grey, key=lambda both: cv2.Laplacian(both[1], cv2.CV_64F).var())[0]


def video_frames(source: Path, names: Sequence[str], count: int) -> Iterator[tuple[str, np.ndarray]]:
    """Return names and pictures of `count` sharp frames of a video, or of the videos with these names in a folder.

    A video of a folder gives a share by its length, and the names of its frames begin with its own. Raise InputError if
    a file is no video, or there are fewer than three frames.
    """
    totals = {name: count_frames(source / name) for name in names or [""]}
    everything = max(sum(totals.values()), 1)

    def all_frames() -> Iterator[tuple[str, np.ndarray]]:
        for name, total in totals.items():
            share = max(1, min(total, count * total // everything))
            for number, frame in sharpest_frames(source / name, share, max(total, 1)):
                yield f"{name}/{number:05d}.jpg".lstrip("/"), frame

    frames = all_frames()
    first = list(itertools.islice(frames, 3))
    if len(first) < 3:
        raise InputError(f"{source} gives {len(first)} frames; a reconstruction needs at least 3, better 30 or more.")
    return itertools.chain(first, frames)


def write_frames(frames: Iterable[tuple[str, np.ndarray]], folder: Path, report: Callable[[int], None]) -> None:
    """Write frames of `video_frames` to a folder as photos; raise WriteError if one cannot be written."""
    import cv2

    for done, (name, frame) in enumerate(frames, 1):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(folder / name) as partial:
            # OpenCV's own writing of files does not tell of a full disk.
            partial.write_bytes(cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 97])[1].tobytes())
        report(done)
