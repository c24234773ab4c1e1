"""The messages of a chunk by channel, in one compiled loop over its records."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from agv_analysis.bags.message_batch import Bytes, Ints, number
from agv_analysis.bags.records import MESSAGE, MESSAGE_HEAD, RECORD
from agv_analysis.compiled.functions import HAS_NUMBA, compiled

_RECORD = RECORD.size


class ChunkIndex(NamedTuple):
    """The messages of a chunk, those of one channel side by side, each channel's in the order of the file."""

    starts: Ints
    """Where their records begin, shape (n,)."""
    lengths: Ints
    """Lengths of their records' contents, shape (n,)."""
    ends: Ints
    """Where in these arrays the messages of each channel number end, shape (highest number + 1,)."""


def index_chunk(content: bytes) -> ChunkIndex | None:
    """The messages of a chunk of messages alone; None if there is anything else in it, or no compiler."""
    if not HAS_NUMBA:
        return None
    found = ChunkIndex(*compiled(index_of_chunk)(np.frombuffer(content, np.uint8)))
    return found if len(found.starts) else None


def index_of_chunk(content: Bytes) -> tuple[Ints, Ints, Ints]:
    """`ChunkIndex` as a tuple, empty if the content is not filled by messages. Written to be compiled."""
    room = len(content) // (_RECORD + MESSAGE_HEAD) + 1
    positions, channels = np.empty(room, np.int32), np.empty(room, np.int32)
    count, highest, position = 0, 0, 0
    while position < len(content):
        length = message_length(content, position)
        if length < 0:
            count = 0
            break
        channel = channel_of(content, position)
        positions[count], channels[count] = position, channel
        highest = max(highest, channel)
        position += _RECORD + length
        count += 1
    positions[count] = position
    ends = np.zeros(highest + 1, np.int64)
    for i in range(count):
        ends[channels[i]] += 1
    before = 0
    for channel in range(highest + 1):  # for now, where the messages of the channel begin
        before, ends[channel] = before + ends[channel], before
    starts, lengths = np.empty(count, np.int64), np.empty(count, np.int64)
    for i in range(count):
        place = ends[channels[i]]
        starts[place], lengths[place] = positions[i], positions[i + 1] - positions[i] - _RECORD
        ends[channels[i]] += 1
    return starts, lengths, ends


def message_length(content: Bytes, position: int) -> int:
    """Length of the content of the message record at `position`, -1 if there is no whole one."""
    left = len(content) - position - _RECORD
    if left < MESSAGE_HEAD or content[position] != MESSAGE:
        return -1
    length = number(content, position + 1, 8)
    return -1 if length < MESSAGE_HEAD or length > left else length


def channel_of(content: Bytes, position: int) -> int:
    """Channel of the message record at `position`."""
    return number(content, position + _RECORD, 2)
