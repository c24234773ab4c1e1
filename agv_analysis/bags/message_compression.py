"""Messages that rosbag2 compressed one by one (`compression_mode: message`), in whatever storage they lie.

Which channels they are is seen at the messages themselves: CDR begins with a zero, zstd never does.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import groupby

import numpy as np

from agv_analysis.bags.bag_errors import DamagedError
from agv_analysis.bags.compression import compression_of, declared_size, inflate_start
from agv_analysis.bags.findings import Findings
from agv_analysis.bags.layout import LEAD
from agv_analysis.bags.message_batch import Batch
from agv_analysis.bags.records import Channel
from agv_analysis.bags.storage import IsWanted, Storage

MAX_MESSAGE = 2**28
"""Most bytes that one message may inflate to."""

_TOGETHER = 2**26
"""Inflated bytes that are passed on together, unless a single message has more."""

_Found = tuple[Channel, Batch]


def inflated_batches(storage: Storage, is_wanted: IsWanted, findings: Findings) -> Iterator[_Found]:
    """The batches of a storage, messages that were compressed one by one inflated.

    One that cannot be inflated is reported and left out, also if it has more than MAX_MESSAGE bytes.
    """
    packed: dict[str, bool] = {}
    # The key holds on to the buffer, so that no other one can have its id.
    for _, part in groupby(storage.batches(is_wanted), key=lambda found: (id(found[1].buffer), found[1].buffer)):
        yield from _of_one_buffer(part, packed, findings)


def _of_one_buffer(part: Iterable[_Found], packed: dict[str, bool], findings: Findings) -> Iterator[_Found]:
    """The batches of one buffer; those that were compressed come in one new buffer, in the order that they had."""
    waiting: list[_Found] = []
    for channel, batch in part:
        if channel.topic not in packed:
            packed[channel.topic] = channel.encoding in ("", "cdr") and _is_packed(batch)
        if packed[channel.topic]:
            waiting.append((channel, batch))
        else:
            yield channel, batch
    if waiting:
        yield from _inflate_together(waiting, findings)


def _is_packed(batch: Batch) -> bool:
    if not len(batch):
        return False
    begin = int(batch.starts[0]) + LEAD
    return compression_of(batch.buffer[begin : begin + 4].tobytes()) == "zstd"


def _inflate_together(found: list[_Found], findings: Findings) -> Iterator[_Found]:
    messages = sorted(
        (start, number, size)
        for number, (_, batch) in enumerate(found)
        for start, size in zip(batch.starts.tolist(), batch.sizes.tolist(), strict=True)
    )
    buffer = found[0][1].buffer
    parts: list[bytes] = []
    owners: list[int] = []
    total = 0
    for start, number, size in messages:
        content = buffer[start : start + size].tobytes()
        try:
            parts.append(content[:LEAD] + _inflated(content[LEAD:]))
            owners.append(number)
        except DamagedError as error:
            topic = found[number][0].topic
            findings.add(f"{topic}: message that cannot be inflated, left out ({error})", is_loss=True)
            continue
        total += len(parts[-1])
        if total > _TOGETHER:
            yield from _joined(found, parts, owners)
            parts, owners, total = [], [], 0
    if parts:
        yield from _joined(found, parts, owners)


def _joined(found: list[_Found], parts: list[bytes], owners: list[int]) -> Iterator[_Found]:
    """Messages in one buffer, by the batches that they were in."""
    sizes = np.array([len(part) for part in parts], np.int64)
    starts, owner, together = np.cumsum(sizes) - sizes, np.array(owners), np.frombuffer(b"".join(parts), np.uint8)
    for number, (channel, _) in enumerate(found):
        mine = np.flatnonzero(owner == number)
        if len(mine):
            yield channel, Batch(together, starts[mine], sizes[mine])


def _inflated(data: bytes) -> bytes:
    """A message that was compressed alone. Raises DamagedError, for one of more than MAX_MESSAGE bytes, too."""
    size = declared_size("zstd", data)
    if size is not None and size > MAX_MESSAGE:
        raise DamagedError(f"{size} bytes are declared, at most {MAX_MESSAGE} are inflated")
    inflated = inflate_start("zstd", data, MAX_MESSAGE + 1)
    if len(inflated) > MAX_MESSAGE:
        raise DamagedError(f"it holds more than {MAX_MESSAGE} bytes")
    return inflated
