"""Messages of one topic, still serialised, and their parting into groups of one layout."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags.bag_errors import UndecodableError
from agv_analysis.bags.layout import LEAD, Layout, trace
from agv_analysis.bags.schema import Struct

NO_DEFINITION = "the bag does not hold the definition of its type, and no ROS 2 distribution knows one"

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Batch:
    """Messages of one topic in one buffer, in file order; each is its lead (log and publish time), then its payload."""

    buffer: Bytes
    starts: Ints
    """Where each message begins, shape (n,)."""
    sizes: Ints
    """Bytes of each message, the lead of 16 included, shape (n,)."""

    def __len__(self) -> int:
        return len(self.starts)

    @property
    def total(self) -> int:
        """Bytes of all messages together."""
        return int(self.sizes.sum())

    def after(self, first: int, count: int | None = None) -> Batch:
        """The messages from `first` on, `count` at most."""
        return self.at(slice(first, None if count is None else first + count))

    def at(self, places: slice | Ints) -> Batch:
        """The messages at some places."""
        return Batch(self.buffer, self.starts[places], self.sizes[places])

    @property
    def log_times(self) -> Ints:
        """[ns], shape (n,)."""
        return numbers_at(self.buffer, self.starts, "<i8")

    @property
    def publish_times(self) -> Ints:
        """[ns], shape (n,)."""
        return numbers_at(self.buffer, self.starts + 8, "<i8")

    def payloads(self) -> Iterator[bytes]:
        """The messages as they were sent, one after the other."""
        for begin, size in zip(self.starts.tolist(), self.sizes.tolist(), strict=True):
            yield self.buffer[begin + LEAD : begin + size].tobytes()


@dataclass(frozen=True)
class Group:
    """Messages of a batch that have one layout."""

    layout: Layout
    places: Ints
    """Their places in the batch, shape (g,)."""
    messages: Bytes
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

    @property
    def places(self) -> frozenset[tuple[str, str, int | None, tuple[int, ...]]]:
        """Where in messages the values lie, over all layouts."""
        leaves = [leaf for layout in self._known.values() for leaf in layout.leaves]
        return frozenset((leaf.path, leaf.code, leaf.block, tuple(leaf.offsets)) for leaf in leaves)

    def split(self, batch: Batch) -> list[Group]:
        """The messages of a batch by layout; those that are not of the topic's type are counted as misfits.

        Raises UndecodableError if the type has no values and a message has: its definition was not recorded then.
        """
        sizes = batch.sizes
        if not len(batch):
            return []
        if (sizes == sizes[0]).all():
            return list(self._grouped(gather(batch.buffer, batch.starts, int(sizes[0])), np.arange(len(batch))))
        return [
            group
            for size in np.unique(sizes).tolist()
            for places in [np.flatnonzero(sizes == size)]
            for group in self._grouped(gather(batch.buffer, batch.starts[places], size), places)
        ]

    def _grouped(self, messages: Bytes, places: Ints) -> Iterator[Group]:
        """Groups of messages, shape (n, size), from those places of a batch."""
        layout = self._latest.get(messages.shape[1])
        while len(places):
            layout = layout or self._trace(messages[0].tobytes())
            if layout is None:
                places, messages = places[1:], messages[1:]
                continue
            same = _has_layout(messages, layout)
            if same.all():
                yield Group(layout, places, messages)
                return
            if same.any():
                yield Group(layout, places[same], messages[same])
                places, messages = places[~same], messages[~same]
            layout = None

    def _trace(self, message: bytes) -> Layout | None:
        """Layout of a message, None if it is not of the topic's type."""
        try:
            layout = trace(self._kind, message)
        except UndecodableError as error:
            if self._kind.is_empty:
                raise UndecodableError(NO_DEFINITION) from None
            self.first_misfit = self.first_misfit or str(error)
            self.misfits += 1
            return None
        layout = self._known.setdefault(layout.key, layout)
        self._latest[len(message)] = layout
        return layout


def gather(buffer: Bytes, starts: Ints, size: int) -> Bytes:
    """Copies of the `size` bytes that begin at each of `starts`, shape (n, size)."""
    return np.asarray(numbers_at(buffer, starts, f"V{size}").view(np.uint8).reshape(-1, size))


def number(buffer: Bytes, place: int, size: int) -> int:
    """The little-endian number of `size` bytes at a place; a single load, once compiled."""
    value = np.int64(0)
    for i in range(size):
        value |= np.int64(buffer[place + i]) << (8 * i)
    return int(value)


def numbers_at(buffer: Bytes, starts: Ints, code: str) -> NDArray[Any]:
    """The values of numpy type `code` that begin at each of `starts`, aligned or not, shape (n,)."""
    windows: NDArray[Any] = np.ndarray((len(buffer) - np.dtype(code).itemsize + 1,), code, buffer, strides=(1,))
    return np.asarray(windows[starts])


def values_at(messages: Bytes, offset: int, code: str) -> NDArray[Any]:
    """The value of numpy type `code` at `offset` of each message of shape (n, size); a view, shape (n,)."""
    n, size = messages.shape
    values: NDArray[Any] = np.ndarray((n,), code, messages.data, offset, (size,))
    return values


def _has_layout(messages: Bytes, layout: Layout) -> NDArray[np.bool_]:
    """Which messages have this layout? Their size, shape (n, size), must fit it."""
    word = layout.order + "u4"
    same = values_at(messages, LEAD, "<u2") == layout.head
    if len(layout.guards) > 16:
        n, size = messages.shape
        words: NDArray[Any] = np.ndarray((n, size - 3), word, messages.data, strides=(size, 1))
        return np.asarray(same & (words[:, layout.guards] == layout.lengths).all(axis=1))
    for offset, length in zip(layout.guards.tolist(), layout.lengths.tolist(), strict=True):
        same &= values_at(messages, offset, word) == length
    return np.asarray(same)
