"""What owping -R prints: a line a packet of one direction.

    SEQNO STIME SS SERR RTIME RS RERR TTL

STIME and RTIME are time stamps of OWAMP as one whole number of 64 bits: seconds since 1900 times 2^32. A packet that
was lost has RTIME 0. Lines come in the order of arrival. Source: owping(1); RFC 4656, 4.1.2.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.rows import lines_of_words
from agv_analysis.link.formats.text_columns import head_of, numbers_at
from agv_analysis.link.measurement import LOST, RECEIVED, Malformed, Measurement, PacketOutcomes, needs_packets

_COLUMNS = (8, 7)
"""Words of a line; older versions have no TTL."""

_SECOND = 2.0**-32


def _matches(head: bytes, path: Path) -> bool:
    for line in head.splitlines()[:20]:
        words = line.split()
        if len(words) in _COLUMNS and all(words[i].isdigit() for i in (0, 1, 2, 4, 5)):
            return len(words[1]) >= 18
    return False


def _read(path: Path, options: Options) -> Measurement:
    malformed, parts = Malformed(), []
    for block, words in lines_of_words(path, _words(path), malformed, options.progress):
        columns = [numbers_at(block.text, words.begins[:, i]) for i in (0, 1, 4)]
        good = np.ones(len(words.lines), dtype=np.bool_)
        for i, numbers in zip((0, 1, 4), columns, strict=True):
            good &= numbers.length == words.ends[:, i] - words.begins[:, i]
        for i in np.flatnonzero(~good).tolist():
            malformed.add(block.number + int(words.lines[i]), block.line(int(words.lines[i])))
        parts.append(np.stack([numbers.digits[good] for numbers in columns]))
    found = np.concatenate(parts, axis=1) if parts else np.zeros((3, 0), dtype=np.uint64)
    needs_packets(found.shape[1], str(path), "line of a packet", malformed)
    return _measurement(str(path), found, malformed)


def _words(path: Path) -> int:
    for line in head_of(path).splitlines():
        if len(line.split()) in _COLUMNS:
            return len(line.split())
    return _COLUMNS[0]


def _measurement(source: str, found: NDArray[np.uint64], malformed: Malformed) -> Measurement:
    seq = found[0].astype(np.int64)
    arrived = seq[found[2] > 0]
    reordered = int(np.count_nonzero(arrived < np.maximum.accumulate(arrived))) if len(arrived) else 0
    _, at = np.unique(seq, return_index=True)
    sent, received = found[1][at], found[2][at]
    is_lost = received == 0
    delay = np.where(is_lost, np.nan, (received - sent).astype(np.int64) * _SECOND)  # wraps, so negative ones come out
    times = (sent - sent[0]).astype(np.int64) * _SECOND
    return Measurement(
        source=source, format="owping", sent=np.maximum.accumulate(times),
        uplink=PacketOutcomes(np.where(is_lost, LOST, RECEIVED).astype(np.int8), delay),
        duplicates=len(seq) - len(at), reordered=reordered, malformed=malformed,
        notes=("one direction was measured, and is taken for the uplink; delays are as good as the two clocks agree",),
    )  # fmt: skip


FORMAT = Format("owping", "output of owping -R", 45, _matches, _read)
