"""What holds the messages of an MCAP file, its chunks opened on a thread of their own, a few ahead of the reading."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

from agv_analysis.bags.bag_errors import DamagedError
from agv_analysis.bags.chunk import Content, largest_size, open_chunk, sort_out
from agv_analysis.bags.records import Chunk, Index

_TOGETHER = 2**20
"""Bytes of chunks, when inflated, that go to the other thread at a time."""

_MOST_TOGETHER = 1000
"""Chunks that do so at most, however small they are."""

_AHEAD = 3 * _TOGETHER
"""Bytes that may be inflated ahead, unless a single chunk has more; a processor's cache holds them until their turn."""


class Run(NamedTuple):
    """Messages outside of any chunk that follow each other."""

    position: int
    content: bytes
    starts: list[int]


class Packed(NamedTuple):
    """A chunk."""

    position: int
    chunk: Chunk
    indexes: list[Index]
    """Of its messages."""


class Opened(NamedTuple):
    """A chunk, inflated."""

    content: bytes
    found: Content
    is_indexed: bool
    """Do its message indexes name exactly its messages?"""


class Cut(NamedTuple):
    """What is left of a chunk within which the file ends."""

    position: int
    content: bytes


Item = Run | Packed | Cut


class _Some(NamedTuple):
    """What goes to the other thread at a time."""

    items: list[Item]
    size: int
    """Bytes, when inflated."""


def _open(item: Item, is_large: bool) -> Opened | DamagedError | None:
    """A chunk inflated and checked, its messages found, or what is wrong with it; None for anything else."""
    if not isinstance(item, Packed):
        return None
    try:
        content = open_chunk(item.chunk)
    except DamagedError as error:
        return error
    return Opened(content, *sort_out(content, item.indexes, is_large))


def _open_all(items: list[Item], is_large: bool) -> list[Opened | DamagedError | None]:
    return [_open(item, is_large) for item in items]


def open_ahead(items: Iterator[Item], is_large: bool) -> Iterator[tuple[Item, Opened | DamagedError | None]]:
    """The same items, a few chunks ahead being opened on another thread; in place what is too little for that."""
    parts = _together(items)
    beginning = list(itertools.islice(parts, 2))
    if len(beginning) < 2:
        for some in beginning:
            yield from zip(some.items, _open_all(some.items, is_large), strict=True)
        return
    waiting: deque[tuple[_Some, Future[list[Opened | DamagedError | None]]]] = deque()
    with ThreadPoolExecutor(1, "bag") as pool:
        for some in itertools.chain(beginning, parts):
            waiting.append((some, pool.submit(_open_all, some.items, is_large)))
            while len(waiting) > 1 and sum(ahead.size for ahead, _ in waiting) > _AHEAD:
                ready, opened = waiting.popleft()
                yield from zip(ready.items, opened.result(), strict=True)
        for ready, opened in waiting:
            yield from zip(ready.items, opened.result(), strict=True)


def _together(items: Iterator[Item]) -> Iterator[_Some]:
    """The items, several at a time unless they are large: to wake a thread takes as long as a small chunk does."""
    some, size = [], 0
    for item in items:
        some.append(item)
        size += largest_size(item.chunk) if isinstance(item, Packed) else len(item.content)
        if size >= _TOGETHER or len(some) == _MOST_TOGETHER:
            yield _Some(some, size)
            some, size = [], 0
    if some:
        yield _Some(some, size)
