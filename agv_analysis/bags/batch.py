"""Messages of one topic, still serialised, and their parting into groups of one layout."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags.errors import UndecodableError
from agv_analysis.bags.layout import Layout, trace
from agv_analysis.bags.schema import Struct

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Batch:
    """Messages of one topic that lie in one buffer, in file order."""

    buffer: Bytes
    starts: Ints
    """Where each payload begins, shape (n,)."""
    sizes: Ints
    """Bytes of each payload, shape (n,)."""
    log_time: Ints
    """[ns], shape (n,)."""
    publish_time: Ints
    """[ns], shape (n,)."""

    def __len__(self) -> int:
        return len(self.starts)

    def payloads(self) -> Iterator[bytes]:
        """The messages' bytes, one after the other."""
        for begin, size in zip(self.starts.tolist(), self.sizes.tolist(), strict=True):
            yield self.buffer[begin : begin + size].tobytes()


@dataclass(frozen=True)
class Group:
    """Messages of a batch that have one layout."""

    layout: Layout
    places: Ints
    """Their places in the batch, shape (g,)."""
    payloads: Bytes
    """Their bytes, shape (g, size)."""


class Layouts:
    """All layouts of a topic's messages that have been met."""

    def __init__(self, kind: Struct) -> None:
        self._kind = kind
        self._known: dict[bytes, Layout] = {}
        self._latest: dict[int, Layout] = {}
        self.misfits = 0
        """Messages that are not of the topic's type."""
        self.first_misfit = ""
        """Why the first of them is not."""

    def split(self, batch: Batch) -> list[Group]:
        """The messages of a batch by layout; those that are not of the topic's type are counted as misfits."""
        sizes = batch.sizes
        if (sizes == sizes[0]).all():
            return list(self._of_size(batch, np.arange(len(batch)), int(sizes[0])))
        return [
            group
            for size in np.unique(sizes).tolist()
            for group in self._of_size(batch, np.flatnonzero(sizes == size), size)
        ]

    def _of_size(self, batch: Batch, places: Ints, size: int) -> Iterator[Group]:
        """Groups of the messages at `places`, all of which have `size` bytes."""
        payloads = gather(batch.buffer, batch.starts[places], size)
        layout = self._latest.get(size)
        while len(places):
            layout = layout or self._trace(payloads[0].tobytes())
            if layout is None:
                places, payloads = places[1:], payloads[1:]
                continue
            same = _has_layout(payloads, layout)
            if same.all():
                yield Group(layout, places, payloads)
                return
            if same.any():
                yield Group(layout, places[same], payloads[same])
                places, payloads = places[~same], payloads[~same]
            layout = None

    def _trace(self, payload: bytes) -> Layout | None:
        """Layout of a message, None if it is not of the topic's type."""
        try:
            layout = trace(self._kind, payload)
        except UndecodableError as error:
            self.first_misfit = self.first_misfit or str(error)
            self.misfits += 1
            return None
        layout = self._known.setdefault(layout.key, layout)
        self._latest[len(payload)] = layout
        return layout


def gather(buffer: Bytes, starts: Ints, size: int) -> Bytes:
    """Copies of the `size` bytes that begin at each of `starts`, shape (n, size)."""
    if size == 0 or not len(starts):
        return np.empty((len(starts), size), np.uint8)
    windows: NDArray[Any] = np.ndarray((len(buffer) - size + 1,), f"V{size}", buffer, strides=(1,))
    return np.asarray(windows[starts].view(np.uint8).reshape(-1, size))


def values_at(payloads: Bytes, offset: int, code: str) -> NDArray[Any]:
    """The value of numpy type `code` at `offset` of each payload (a view), shape (n,)."""
    n, size = payloads.shape
    return np.ndarray((n,), code, payloads.data, offset, (size,))


def _has_layout(payloads: Bytes, layout: Layout) -> NDArray[np.bool_]:
    """Which messages have a layout that fits their size?"""
    word = "<u4" if layout.head[1] else ">u4"
    same = values_at(payloads, 0, "<u2") == int.from_bytes(layout.head, "little")
    if len(layout.guards) > 16:
        n, size = payloads.shape
        words = np.ndarray((n, size - 3), word, payloads.data, strides=(size, 1))
        return np.asarray(same & (words[:, layout.guards] == layout.lengths).all(axis=1))
    for offset, length in zip(layout.guards.tolist(), layout.lengths.tolist(), strict=True):
        same &= values_at(payloads, offset, word) == length
    return np.asarray(same)
