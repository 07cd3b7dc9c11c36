"""Photos from videos: the sharpest frame of each stretch. PyAV and OpenCV are imported only if there is a video."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sadgs_ns.errors import InputError
from sadgs_ns.files import atomic_path

_HDR = (16, 18)  # FFmpeg's numbers of PQ and HLG, in which phones record unless they are told otherwise
_ARCHIVES = {b"PK\x03\x04": 0, b"7z\xbc\xaf": 0, b"Rar!": 0, b"\x1f\x8b": 0, b"\xfd7zXZ": 0, b"BZh": 0, b"ustar": 257}
"""What archives hold at which byte: ZIP, 7z, RAR, gzip, xz, bzip2 and tar."""
_BT_709 = 1  # FFmpeg's number of this matrix from colours to luma and chroma
_NO_MATRIX = 2  # FFmpeg's number of a frame that names none
_HD_SIZE = (1280, 720)  # Width and height in px, either of which makes a video HD


def is_archive(path: Path) -> bool:
    """Return whether a file is a ZIP or another archive by its content; False if it cannot be read."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        start = file.read(512)
        return any(start[place:].startswith(signature) for signature, place in _ARCHIVES.items())
    return False


def count_frames(video: Path) -> int:
    """Return the number of a video's frames, which recordings do not tell; raise InputError if it is no video.

    FFmpeg takes archives of JPEGs, single images and texts for videos, too; these are refused.
    """
    import av

    if is_archive(video):
        raise InputError(f"{video} is an archive: unpack it, and give the folder of its photos or videos.")
    remedy = "give a folder of photos or of videos, or convert a video to MP4 with H.264."
    try:
        with av.open(os.fspath(video)) as container:
            kind = container.format.name
            stream = container.streams.best("video")
            assert isinstance(stream, av.VideoStream)
            number = stream.frames or sum(packet.size > 0 for packet in container.demux(stream))
    except Exception as error:  # FFmpeg has many.
        why = getattr(error, "strerror", None) or "it shows nothing"
        raise InputError(f"{video} cannot be read as a video ({why}); {remedy}") from error
    if kind == "image2" or kind.endswith("_pipe"):
        raise InputError(f"{video} is a single image, and a reconstruction needs at least 3; give their folder.")
    if kind == "tty":
        raise InputError(f"{video} cannot be read as a video (it is a text); {remedy}")
    return number


def read_frames(stream: Any) -> Iterator[Any]:
    """Yield the frames of PyAV's stream of a video, without damaged ones."""
    from av.error import InvalidDataError

    stream.codec_context.thread_type = "AUTO"
    for packet in stream.container.demux(stream):
        with contextlib.suppress(InvalidDataError):
            yield from stream.decode(packet)


def filtered(frames: Iterable[Any], stream: Any, *filters: tuple[str, str]) -> Iterator[Any]:
    """Yield a stream's frames as FFmpeg's filters, name and options each, return them."""
    from av.filter import Graph

    graph = Graph()
    nodes = graph.add_buffer(stream), *(graph.add(*one) for one in filters), graph.add("buffersink")
    graph.link_nodes(*nodes).configure()
    for frame in itertools.chain(frames, [None]):
        graph.vpush(frame)
        with contextlib.suppress(BlockingIOError, EOFError):
            while True:
                yield graph.vpull()


def sharpest_frames(video: Path, count: int, total: int) -> Iterator[tuple[int, np.ndarray]]:
    """Yield numbers of `count` stretches of a video, and their sharpest frames, upright and in sRGB. BGR [H, W, 3]"""
    import av
    import cv2

    def sharpness(frame: Any) -> float:
        return cv2.Laplacian(frame.to_ndarray(format="gray"), cv2.CV_64F).var()

    with av.open(os.fspath(video)) as container:
        stream = container.streams.best("video")
        assert isinstance(stream, av.VideoStream)  # `count_frames` was called before.
        frames = read_frames(stream)
        first = list(itertools.islice(frames, 1))
        frames = itertools.chain(first, frames)
        if any(frame.interlaced_frame for frame in first):  # Comb-like edges would count as sharp.
            frames = filtered(frames, stream, ("bwdif", "deint=interlaced"))
        stretches = itertools.groupby(enumerate(frames), lambda numbered: numbered[0] * count // total)
        chosen = (max((frame for _, frame in stretch), key=sharpness) for i, stretch in stretches if i < count)
        if stream.codec_context.color_trc in _HDR:
            to_sdr = "out_transfer=iec61966-2-1:out_primaries=bt709"
            chosen = filtered(chosen, stream, ("scale", to_sdr), ("format", "bgr24"))
        for number, frame in enumerate(chosen):
            yield number, np.rot90(pixels_of(frame), frame.rotation // 90)


def pixels_of(frame: Any) -> np.ndarray:
    """Return the colours of PyAV's frame, by its own matrix if it names one. BGR [H, W, 3]

    FFmpeg takes a frame that names none for BT.601. That is the matrix of SD alone: HD has BT.709, as players know.
    """
    is_hd = frame.width >= _HD_SIZE[0] or frame.height >= _HD_SIZE[1]
    if is_hd and frame.colorspace == _NO_MATRIX:
        frame.colorspace = _BT_709
    return frame.to_ndarray(format="bgr24")


def video_frames(source: Path, names: Sequence[str], count: int) -> Iterator[tuple[str, np.ndarray]]:
    """Return file names and pictures of about `count` sharp frames. BGR [H, W, 3]

    If there are no names, `source` is the video. Otherwise it is the folder of the videos with these names. Each gives
    frames in proportion to its length, at least one, and its frames are named as files in a folder of its name.

    Raise InputError if a file is no video, or if there are fewer than three frames.
    """
    videos = names or [""]  # `source / ""` is `source` itself.
    totals = {name: count_frames(source / name) for name in videos}
    total_of_all = max(sum(totals.values()), 1)

    def frames_of_all() -> Iterator[tuple[str, np.ndarray]]:
        for name, total in totals.items():
            share = count * total // total_of_all
            share = max(1, min(total, share))
            for number, frame in sharpest_frames(source / name, share, max(total, 1)):
                file_name = f"{number:05d}.jpg"
                if name:
                    file_name = f"{name}/{file_name}"
                yield file_name, frame

    frames = frames_of_all()
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
