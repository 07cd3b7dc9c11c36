"""Images that are copied to the device ahead of their step."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import torch
from torch import Tensor


class ImagePrefetcher:
    """Copies images from the host to the device ahead of the step that needs them, on its own stream.

    Threads decode images, and copy them to pinned memory, which torch reuses for later images. Without CUDA only
    decoding runs ahead. `images` are decoded ones or `LazyImages`; if they are `decoded`, no thread is needed.
    """

    def __init__(self, images: Sequence[Mapping[str, Any]], device: torch.device, threads: int) -> None:
        self.images = images
        self.device = device
        self.threads = threads
        on_cuda = device.type == "cuda"
        self.decoded = isinstance(images, list) and all(not on_cuda or data["image"].is_pinned() for data in images)
        self._stream = torch.cuda.Stream(device) if on_cuda else None
        self._pool: ThreadPoolExecutor | None = None
        self._loading: dict[int, Future[dict[str, Any]]] = {}
        self._sent: dict[int, tuple[dict[str, Any], torch.cuda.Event | None]] = {}

    def take(self, indices: Sequence[int]) -> dict[int, dict[str, Any]]:
        """Return the data of a step's views by index, as `LazyImages` gives it, on the device and for this stream.

        The host waits only for images that are not decoded yet. Raises InputError as `LazyImages.__getitem__`.
        """
        self._load(indices)
        taken = {}
        for index in indices:
            taken[index], copied = self._sent.pop(index, None) or self._copy(index)
            if copied is not None:
                stream = torch.cuda.current_stream(self.device)
                stream.wait_event(copied)
                for value in taken[index].values():
                    if isinstance(value, Tensor) and value.is_cuda:
                        value.record_stream(stream)  # Its memory belongs to the copying stream.
        return taken

    def prefetch(self, upcoming: Sequence[int], following: Sequence[int]) -> None:
        """Load the images of upcoming views, drop all others, and start copies of loaded ones of the following step."""
        for index in self._loading.keys() - set(upcoming):
            self._loading.pop(index).cancel()
        for index in self._sent.keys() - set(upcoming):
            del self._sent[index]
        self._load(upcoming)
        for index in following:
            if index not in self._sent and (self.decoded or self._loading[index].done()):
                self._sent[index] = self._copy(index)

    def close(self) -> None:
        """End the threads; they start again if another image is needed."""
        pool, self._pool = self._pool, None
        self._loading.clear()
        self._sent.clear()
        if pool is not None:
            pool.shutdown(cancel_futures=True)

    def _load(self, indices: Iterable[int]) -> None:
        """Have threads load images in this order, unless they are under way."""
        if self.decoded:
            return
        for index in indices:
            if index in self._loading or index in self._sent:
                continue
            if self._pool is None:
                initializer: Any = (torch.cuda.set_device, (self.device,)) if self._stream is not None else ()
                self._pool = ThreadPoolExecutor(self.threads, "images", *initializer)
            self._loading[index] = self._pool.submit(self._pinned, index)

    def _pinned(self, index: int) -> dict[str, Any]:
        """Return a view's data on the host, with CUDA in pinned memory; this runs in a thread."""
        data, pin = dict(self.images[index]), self._stream is not None
        return {name: v.pin_memory() if pin and isinstance(v, Tensor) else v for name, v in data.items()}

    def _copy(self, index: int) -> tuple[dict[str, Any], torch.cuda.Event | None]:
        """Return a view's data on the device, and with CUDA the event of their arrival."""
        data = dict(self.images[index]) if self.decoded else self._loading.pop(index).result()
        if self._stream is None:
            return data, None
        with torch.cuda.stream(self._stream):
            data = {
                name: v.to(self.device, non_blocking=True) if isinstance(v, Tensor) else v for name, v in data.items()
            }
            copied = torch.cuda.Event()
            copied.record(self._stream)
        return data, copied
