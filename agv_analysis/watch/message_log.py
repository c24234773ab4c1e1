"""The messages of the last minutes as they came, packed, for a bag that is asked for while the loop runs."""

from __future__ import annotations

import pickle
import threading
import zlib
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

_CHUNK = 1024
"""Messages that are packed together: poses and errors, most of whose bytes are zeros, then need a tenth of the room."""


class Heard(NamedTuple):
    """A serialised message: the number of its topic, its bytes, and when it was received [ns since 1970]."""

    topic: int
    data: bytes
    received_ns: int


class MessageLog:
    """Messages of the last `seconds`, in the order in which they were taken; it may be read while it grows."""

    def __init__(self, seconds: float) -> None:
        self._length_ns = round(seconds * 1e9)
        self._chunks: deque[tuple[int, bytes]] = deque()
        self._open: list[Heard] = []
        self._lock = threading.Lock()

    def add(self, messages: list[Heard]) -> None:
        """Append messages, and forget those that are too old by now."""
        with self._lock:
            self._open += messages
            while len(self._open) >= _CHUNK:
                full, self._open = self._open[:_CHUNK], self._open[_CHUNK:]
                content = pickle.dumps([tuple(heard) for heard in full], pickle.HIGHEST_PROTOCOL)
                self._chunks.append((full[-1].received_ns, zlib.compress(content, 1)))
            while self._chunks and self._open and self._chunks[0][0] < self._open[-1].received_ns - self._length_ns:
                self._chunks.popleft()

    def clear(self) -> None:
        """Forget all: another run has begun."""
        with self._lock:
            self._chunks.clear()
            self._open = []

    def messages(self) -> Iterator[Heard]:
        """The messages that are here now."""
        with self._lock:
            chunks, last = list(self._chunks), list(self._open)
        for _, content in chunks:
            yield from (Heard(*heard) for heard in pickle.loads(zlib.decompress(content)))  # its own, from above
        yield from last
