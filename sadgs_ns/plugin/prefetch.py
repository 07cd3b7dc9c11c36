"""Images that travel to the device ahead of their step."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from typing import Any

import torch
from torch import Tensor


class ImagePrefetcher:
    """Brings images from the host to the device ahead of the step that needs them, on a stream of their own.

    What is not in pinned memory is decoded, or copied, into pinned memory by threads. torch keeps pinned memory that is
    no longer used for the next images, so that it takes as much as the images that are under way. Without CUDA the
    images stay where they are, and only decoding runs ahead.

    Args:
        images: All images, on the host: a list of decoded ones, or `LazyImages`.
        device: Device of training.
        threads: Number of threads that decode.
    """

    def __init__(self, images: Sequence[Mapping[str, Any]], device: torch.device, threads: int) -> None:
        self.images = images
        self.device = device
        self.threads = threads
        on_cuda = device.type == "cuda"
        self._ready = isinstance(images, list) and all(not on_cuda or data["image"].is_pinned() for data in images)
        """Whether all images can be copied as they are, without a thread's help."""
        self._stream = torch.cuda.Stream(device) if on_cuda else None
        self._pool: ThreadPoolExecutor | None = None
        self._loading: dict[int, Future[dict[str, Any]]] = {}
        self._sent: dict[int, tuple[dict[str, Any], torch.cuda.Event | None]] = {}
        self._kept: dict[int, torch.cuda.Event | None] = {}
        """Views of which the codes of S̄ are kept on the host, with the end of their copy."""

    def load(self, indices: Iterable[int]) -> None:
        """Have threads load images, in this order, and forget what was under way and is not among them."""
        wanted = dict.fromkeys(indices)
        for index in self._loading.keys() - wanted.keys():
            self._loading.pop(index).cancel()
        for index in self._sent.keys() - wanted.keys():
            del self._sent[index]
        if not self._ready:
            for index in wanted:
                if index not in self._loading and index not in self._sent:
                    self._loading[index] = self._submit(index)

    def send(self, indices: Iterable[int], with_codes: bool) -> None:
        """Start copying the next step's images that threads have loaded to the device; this waits for nothing.

        `with_codes` says whether that step needs the codes of S̄, too.
        """
        for index in dict.fromkeys(indices):
            if index not in self._sent and (self._ready or (index in self._loading and self._loading[index].done())):
                self._sent[index] = self._copied(index, with_codes)

    def take(self, index: int, with_codes: bool) -> dict[str, Any]:
        """Return a view's data on the device, and wait only where its image is not decoded yet.

        Returns:
            `image` [H, W, 3 or 4], boolean `mask` [H, W, 1] if there is one, what else the dataset added and, with
            `with_codes`, `codes` uint8 [H, W, 3] of S̄ where they are known. The present stream may use it.

        Raises:
            InputError: As `LazyImages.__getitem__`.
        """
        data, copied = self._sent.pop(index, None) or self._copied(index, with_codes)
        if copied is not None:
            stream = torch.cuda.current_stream(self.device)
            stream.wait_event(copied)
            for value in data.values():
                if isinstance(value, Tensor) and value.is_cuda:
                    value.record_stream(stream)  # Its memory belongs to the stream of the copies.
        return data

    def keep_codes(self, index: int, codes: Tensor) -> None:
        """Keep a view's codes of S̄, uint8 [H, W, 3], on the host, if its image is there decoded and pinned.

        Beside images that are not decoded, codes would take more memory than the images; they are computed again.
        """
        if not self._ready:
            return
        self._codes[index].copy_(codes, non_blocking=True)
        written = None
        if self._stream is not None:
            written = torch.cuda.Event()
            written.record(torch.cuda.current_stream(self.device))
        self._kept[index] = written

    def kept_codes(self, index: int) -> Tensor | None:
        """Return the codes of S̄ of a view on the device, if they are kept. uint8 [H, W, 3]"""
        # They were written by the stream that now reads them.
        return self._codes[index].to(self.device, non_blocking=True) if index in self._kept else None

    def close(self) -> None:
        """End the threads; they start again where another image is asked for."""
        pool, self._pool = self._pool, None
        self._loading.clear()
        self._sent.clear()
        if pool is not None:
            pool.shutdown(cancel_futures=True)

    @cached_property
    def _codes(self) -> list[Tensor]:
        """Room for the codes of S̄ of all views on the host. uint8 [H, W, 3] each

        It is made at once, because the host waits for the device whenever pinned memory is new.
        """
        pinned = self._stream is not None
        shapes = [(*data["image"].shape[:2], 3) for data in self.images]
        return [torch.empty(shape, dtype=torch.uint8, pin_memory=pinned) for shape in shapes]

    def _submit(self, index: int) -> Future[dict[str, Any]]:
        if self._pool is None:
            on_cuda = {"initializer": torch.cuda.set_device, "initargs": (self.device,)}
            self._pool = ThreadPoolExecutor(self.threads, "images", **(on_cuda if self._stream is not None else {}))  # type: ignore[arg-type]
        return self._pool.submit(self._load, index)

    def _load(self, index: int) -> dict[str, Any]:
        """Return a view's data on the host, in pinned memory where there is CUDA; this runs in a thread."""
        data = dict(self.images[index])
        if self._stream is not None:
            data = {name: v.pin_memory() if isinstance(v, Tensor) else v for name, v in data.items()}
        return data

    def _copied(self, index: int, with_codes: bool) -> tuple[dict[str, Any], torch.cuda.Event | None]:
        """Return a view's data on the device, and the event that says when they are there; None without CUDA."""
        if self._ready:
            data = dict(self.images[index])
        else:
            data = (self._loading.pop(index, None) or self._submit(index)).result()
        with_codes = with_codes and index in self._kept
        if with_codes:
            data["codes"] = self._codes[index]
        if self._stream is None:
            return data, None
        with torch.cuda.stream(self._stream):
            if with_codes and (written := self._kept[index]) is not None:
                self._stream.wait_event(written)
            data = {
                name: v.to(self.device, non_blocking=True) if isinstance(v, Tensor) else v for name, v in data.items()
            }
            copied = torch.cuda.Event()
            copied.record(self._stream)
        return data, copied
