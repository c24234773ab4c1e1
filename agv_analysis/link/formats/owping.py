"""What owping -R prints: a line a packet of one direction.

    SEQNO STIME SS SERR RTIME RS RERR TTL

STIME and RTIME are time stamps of OWAMP as one whole number of 64 bits: seconds since 1900 times 2^32. A packet that
was lost has RTIME 0. Lines come in the order of arrival. Source: owping(1); RFC 4656, 4.1.2.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.rows import lines_of_words
from agv_analysis.link.formats.text_columns import head_of, numbers_at
from agv_analysis.link.large_arrays import Column, column_of, firsts_in_order, parts, reordered_by
from agv_analysis.link.measurement import LOST, RECEIVED, Malformed, Measurement, PacketOutcomes, needs_packets
from agv_analysis.link.packet_grid import count_on
from agv_analysis.run import Floats

_COLUMNS = (8, 7)
"""Words of a line; older versions have no TTL."""

_STAMP = 18
"""Digits of a time stamp at least."""

Stamps = NDArray[np.uint64]

_SECOND = 2.0**-32


def _matches(head: bytes, path: Path) -> bool:
    for line in head.splitlines()[:20]:
        words = line.split()
        if len(words) in _COLUMNS and all(words[i].isdigit() for i in (0, 1, 2, 4, 5)):
            return len(words[1]) >= _STAMP
    return False


def _read(path: Path, options: Options) -> Measurement:
    malformed, found = Malformed(), tuple(Column(np.uint64) for _ in range(3))
    for block, words in lines_of_words(path, _words(path), malformed, options.progress):
        columns = [numbers_at(block.text, words.begins[:, i]) for i in (0, 1, 4)]
        good = np.ones(len(words.lines), dtype=np.bool_)
        for i, numbers in zip((0, 1, 4), columns, strict=True):
            good &= numbers.length == words.ends[:, i] - words.begins[:, i]
        good &= columns[1].length >= _STAMP
        good &= (columns[2].length >= _STAMP) | (columns[2].digits == 0)
        for i in np.flatnonzero(~good).tolist():
            malformed.add(block.number + int(words.lines[i]), block.line(int(words.lines[i])))
        for column, numbers in zip(found, columns, strict=True):
            column.extend(numbers.digits[good])
    needs_packets(len(found[0]), str(path), "line of a packet", malformed)
    seq, sent, received = (column.values for column in found)
    return _measurement(str(path), seq, sent, received, malformed)


def _words(path: Path) -> int:
    for line in head_of(path).splitlines():
        if len(line.split()) in _COLUMNS:
            return len(line.split())
    return _COLUMNS[0]


def _measurement(source: str, seq: Stamps, sent: Stamps, received: Stamps, malformed: Malformed) -> Measurement:
    count, reordered, newest = len(seq), 0, np.uint64(0)
    for part in parts(count, seq, received):
        arrived = np.append(newest, seq[part][received[part] > 0])
        reordered += int(np.count_nonzero(arrived < np.maximum.accumulate(arrived)))
        newest = arrived.max()
    at = firsts_in_order(seq)
    if at is not None:
        seq, sent, received = (reordered_by(column, at) for column in (seq, sent, received))

    def delays() -> Iterator[Floats]:
        for part in parts(len(seq), sent, received):
            delay = (received[part] - sent[part]).astype(np.int64) * _SECOND  # wraps, so negative ones come out
            yield np.where(received[part] == 0, np.nan, delay)

    outcomes = (np.where(received[part] == 0, LOST, RECEIVED) for part in parts(len(seq), received))
    times = column_of(((sent[part] - sent[0]).astype(np.int64) * _SECOND for part in parts(len(seq), sent)), np.float64)
    count_on(times)
    return Measurement(
        source=source, format="owping", sent=times,
        uplink=PacketOutcomes(column_of(outcomes, np.int8), column_of(delays(), np.float64)),
        duplicates=count - len(seq), reordered=reordered, malformed=malformed,
        notes=("one direction was measured, and is taken for the uplink; delays are as good as the two clocks agree",),
    )  # fmt: skip


FORMAT = Format("owping", "output of owping -R", 45, _matches, _read)
