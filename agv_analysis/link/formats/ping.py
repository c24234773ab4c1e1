"""What ping prints: iputils (Linux, with -D and -O too), BusyBox and the BSDs.

    [1700000000.123456] 64 bytes from 10.0.0.2: icmp_seq=1 ttl=64 time=0.045 ms (DUP!)
    [1700000000.143456] no answer yet for icmp_seq=2
    From 10.0.0.1 icmp_seq=3 Destination Host Unreachable
    5 packets transmitted, 4 received, 20% packet loss, time 81ms

A number that no reply has is lost, whether -O says so or not; a reply that comes after its "no answer yet" is late, not
lost. -D stamps a reply when it is printed, so its packet was sent the round-trip time earlier. Numbers have 16 bits and
begin anew. Source: ping(8) of iputils.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.text_columns import Block, Places, blocks, is_preceded_by, numbers_at
from agv_analysis.link.measurement import (
    Malformed,
    Measurement,
    MeasurementError,
    Numbered,
    PacketOutcomes,
    joined,
    on_grid,
    unwrapped,
)
from agv_analysis.run import Floats

_USUAL_INTERVAL = 1.0
"""Time between packets that ping takes without -i [s]."""

_HEADER = re.compile(rb"PING\s")
_SUMMARY = re.compile(rb"(\d+) packets transmitted(?:.*?\btime (\d+) ?ms)?")
_REPLY = re.compile(rb": (?:icmp_)?seq=\d+ ttl=\d+|no answer yet for icmp_seq=\d+")
_OTHER = re.compile(
    rb"-+ .* ping statistics -+|(rtt|round-trip) .*|\^C|\d+ packets transmitted.*|pipe \d+|ping: .*|WARNING: .*"
    rb"|Request timeout for icmp_seq \d+|\d+/\d+ packets,.*|.*\+\d+ (duplicates|errors|corrupted).*|PATTERN: .*"
)
"""Lines that say nothing of a packet."""

Ints = NDArray[np.int64]


@dataclass
class _Found:
    """What the lines of a file say, so far."""

    seq: list[Ints] = field(default_factory=list)
    """Of every line with a number, reply or not."""
    is_reply: list[NDArray[np.bool_]] = field(default_factory=list)
    rtt: list[Floats] = field(default_factory=list)
    stamp: list[Floats] = field(default_factory=list)
    malformed: Malformed = field(default_factory=Malformed)
    has_header: bool = False
    is_busybox: bool = False
    transmitted: int | None = None
    total: float | None = None
    """Time of the whole run by the summary [s]."""


def _matches(head: bytes, path: Path) -> bool:
    return bool(_REPLY.search(head) or (_HEADER.match(head) and b"bytes" in head[:200]) or b" ping statistics " in head)


def _read(path: Path, options: Options) -> Measurement:
    found = _Found()
    for block in blocks(path, options.progress):
        _read_block(block, found)
    if not any(len(seq) for seq in found.seq):
        only = ": it has the summary alone; run ping without -q" if found.transmitted is not None else ""
        raise MeasurementError(f"{path}: has no line of a packet{only}")
    return _measurement(str(path), found, options)


def _read_block(block: Block, found: _Found) -> None:
    text = block.text
    signs = np.flatnonzero((text == ord("=")) | (text == ord("<")))
    at_seq = signs[is_preceded_by(text, signs, b"seq")]
    lines = len(block.starts)
    line_of_seq = block.line_of(at_seq)
    rtt = _milliseconds(block, signs[~is_preceded_by(text, signs, b"ttl")] + 1, lines)
    first = _after_stamp(block)
    stamped = text[block.starts] == ord("[")
    stamp = np.full(lines, np.nan)
    stamp[stamped] = numbers_at(text, block.starts[stamped] + 1).values
    letter = text[first]
    is_reply = (letter >= ord("0")) & (letter <= ord("9"))
    is_none = np.isin(letter, np.frombuffer(b"nFR", dtype=np.uint8))  # no answer yet, From, Request timeout
    whole = np.zeros(lines, dtype=np.bool_)
    numbers = numbers_at(text, at_seq + 1)
    whole[line_of_seq[numbers.length > 0]] = True
    whole &= is_reply | is_none
    kept = whole[line_of_seq] & (numbers.length > 0)
    kept &= np.append(True, np.diff(line_of_seq) > 0)  # the first number of a line
    rows = line_of_seq[kept]
    found.seq.append(numbers.integers[kept])
    found.is_reply.append(is_reply[rows])
    found.rtt.append(rtt[rows])
    found.stamp.append(stamp[rows])
    if not found.is_busybox and len(at_seq):
        found.is_busybox = not bool(is_preceded_by(text, at_seq[:1], b"icmp_seq")[0])
    for i in np.flatnonzero(~whole).tolist():
        _read_other(block, i, found)


def _milliseconds(block: Block, places: Places, lines: int) -> Floats:
    """The numbers at these places that ` ms` follows, by line [s], NaN on lines that have none.

    Whatever is before them: ping speaks the user's language.
    """
    text, last = block.text, len(block.text) - 1
    numbers = numbers_at(text, places)
    ends = places + numbers.length
    is_time = numbers.length > 0
    for i, letter in enumerate(b" ms"):
        is_time &= text[np.minimum(ends + i, last)] == letter
    values = np.full(lines, np.nan)
    values[block.line_of(places[is_time])] = 1e-3 * numbers.values[is_time]
    return values


def _after_stamp(block: Block) -> Places:
    """Where each line begins behind its time stamp in brackets."""
    text, first = block.text, block.starts.copy()
    ends = np.flatnonzero(text == ord("]"))
    lines = block.line_of(ends)
    of_stamp = text[block.starts[lines]] == ord("[")
    rows = lines[of_stamp][::-1]  # of several brackets on a line the first one counts
    first[rows] = np.minimum(ends[of_stamp][::-1] + 2, len(text) - 1)
    return np.asarray(first)


def _read_other(block: Block, i: int, found: _Found) -> None:
    """A line that has no packet in it."""
    line = block.line(i)
    if _HEADER.match(line):
        found.has_header = True
        return
    summary = _SUMMARY.search(line)
    if summary is not None:
        found.transmitted = int(summary[1])
        found.total = None if summary[2] is None else int(summary[2]) * 1e-3
        return
    if line.strip() and not _OTHER.fullmatch(line.strip()):
        found.malformed.add(block.number + i, line)


def _measurement(source: str, found: _Found, options: Options) -> Measurement:
    seq, is_reply = unwrapped(np.concatenate(found.seq)), np.concatenate(found.is_reply)
    rtt, stamp = joined(found.rtt), joined(found.stamp)
    first, last, notes = _range(seq, found)
    for parts in (found.seq, found.is_reply, found.rtt, found.stamp):
        parts.clear()  # of a long file they are as much again
    interval, said = _interval(found, options)
    seq, rtt, sent = seq[is_reply], rtt[is_reply], stamp[is_reply]
    sent -= np.nan_to_num(rtt)
    has_times = not np.isnan(sent).all() and len(seq) > 1
    grid = on_grid(Numbered(seq, (rtt,), sent if has_times else None), first, last, interval)
    if not has_times:
        notes = (*notes, said)
    return Measurement(
        source=source, format="ping", sent=grid.sent, round_trip=PacketOutcomes(grid.outcome, grid.delays[0]),
        duplicates=grid.duplicates, reordered=grid.reordered, malformed=found.malformed, notes=notes,
    )  # fmt: skip


def _range(seq: Ints, found: _Found) -> tuple[int, int, tuple[str, ...]]:
    """First and last number that were sent, and what must be said of them."""
    begins = 0 if found.is_busybox or int(seq.min()) == 0 else 1
    first = begins if found.has_header and int(seq[0]) < 32768 else int(seq.min())
    last, notes = int(seq.max()), []
    if not found.has_header:
        notes.append("the beginning of the log is missing: packets before the first one in it are unknown")
    if found.transmitted is None:
        notes.append("the summary is missing: packets after the last one in the log are unknown")
    else:
        last = max(last, first + found.transmitted - 1)
    return first, last, tuple(notes)


def _interval(found: _Found, options: Options) -> tuple[float, str]:
    """Time between packets [s] of a log without time stamps, and where it is from."""
    if options.interval is not None:
        return options.interval, f"packets were sent every {options.interval:g} s, as --interval says"
    if found.total is not None and found.transmitted is not None and found.transmitted > 1 and found.total > 0.0:
        interval = found.total / (found.transmitted - 1)
        return interval, f"packets were sent every {interval:g} s on average, by the summary: ping -D stamps each"
    return _USUAL_INTERVAL, (
        f"the log does not say when packets were sent: ping's usual {_USUAL_INTERVAL:g} s is assumed between them; say "
        "otherwise with --interval, or run ping with -D"
    )


FORMAT = Format("ping", "output of ping", 40, _matches, _read)
