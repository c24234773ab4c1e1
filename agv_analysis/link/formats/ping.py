"""What ping prints: iputils (Linux, with -D and -O too), BusyBox and the BSDs.

    [1700000000.123456] 64 bytes from 10.0.0.2: icmp_seq=1 ttl=64 time=0.045 ms (DUP!)
    [1700000000.143456] no answer yet for icmp_seq=2
    16 bytes from ::1, icmp_seq=0 hlim=64 time=0.059 ms
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

from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.text_columns import Block, Places, blocks, is_preceded_by, numbers_at
from agv_analysis.link.large_arrays import count_of
from agv_analysis.link.measurement import RECEIVED, Malformed, Measurement, MeasurementError, PacketOutcomes
from agv_analysis.link.packet_grid import CountedOn, PacketGrid
from agv_analysis.run import Floats

_USUAL_INTERVAL = 1.0
"""Time between packets that ping takes without -i [s]."""

_HEADER = re.compile(rb"PING6?[\s(]")
_SUMMARY = re.compile(
    rb"[^\d%]*(\d{1,18})[^\d,%]*(?:,|\xef\xbc\x8c|\xe3\x80\x81)[^\d%]*(\d{1,18})[^\d%].*[^\w:.][\d.]+ ?%"
    rb"[^,]*(?:, ?[^\d,]*(\d{1,18}) ?(?:ms|[\x80-\xff]))?"
)
"""The same in every language: packets sent, received, a percentage, and perhaps the time; commas may be Chinese."""
_REPLY = re.compile(rb"[:,] (?:icmp_)?seq=\d+ (?:ttl|hlim)=\d+|no answer yet for icmp_seq=\d+")
_OTHER = re.compile(
    rb"-+ .* -+|(rtt|round-trip) .*|\^C|\d+ packets transmitted.*|pipe \d+|ping6?: .*|WARNING: .*"
    rb"|Request timeout for icmp_seq \d+|\d+/\d+ packets,.*|.*\+\d+ (duplicates|errors|corrupted).*|PATTERN: .*"
    rb"|wrong data byte .*|#\d+\s[0-9a-f ]*"
)
"""Lines that say nothing of a packet."""


@dataclass
class _Found:
    """What the lines of a file say, so far."""

    grid: PacketGrid = field(default_factory=lambda: PacketGrid(delays=1))
    numbers: CountedOn = field(default_factory=CountedOn)
    malformed: Malformed = field(default_factory=Malformed)
    begin: int | None = None
    """The first number in the file."""
    begin_line: int = 0
    """Where it is."""
    has_header: bool = False
    is_busybox: bool | None = None
    transmitted: int | None = None
    received: int | None = None
    """By the summary, both."""
    stamped_from: int | None = None
    """The second of the first time stamp, from which on the others count."""
    total: float | None = None
    """Time of the whole run by the summary [s]."""
    below: int = 0
    """Replies whose time is less than what is printed."""


def _matches(head: bytes, path: Path) -> bool:
    return bool(_REPLY.search(head) or (_HEADER.match(head) and b"bytes" in head[:200]) or b" ping statistics " in head)


def _read(path: Path, options: Options) -> Measurement:
    found = _Found()
    for block in blocks(path, options.progress):
        _read_block(block, found, path)
    if found.begin is None and found.received == 0 and found.transmitted:  # whose lines are not needed
        found.begin = 1
        found.grid.mention(np.ones(1, dtype=np.int64))
    if found.begin is None:
        only = ": it has the summary alone; run ping without -q and -f" if found.transmitted is not None else ""
        raise MeasurementError(f"{path}: has no line of a packet{only}")
    return _measurement(str(path), found, options)


def _read_block(block: Block, found: _Found, path: Path) -> None:
    text, last = block.text, len(block.text) - 1
    signs = np.flatnonzero((text == ord("=")) | (text == ord("<")))
    is_seq = is_preceded_by(text, signs, b"seq")
    is_ttl = is_preceded_by(text, signs, b" ttl") | is_preceded_by(text, signs, b" hlim")
    at_seq, at_ttl, others = signs[is_seq], signs[is_ttl], signs[~is_seq & ~is_ttl]
    lines = len(block.starts)
    line_of_seq = block.line_of(at_seq)
    rtt = _milliseconds(block, others + 1, lines)
    first = _after_stamp(block)
    stamped = text[block.starts] == ord("[")
    stamp = np.full(lines, np.nan)
    stamps = numbers_at(text, block.starts[stamped] + 1, commas=True)
    if found.stamped_from is None and (stamps.length > 0).any():
        found.stamped_from = int(stamps.values[stamps.length > 0][0])
    stamp[stamped] = stamps.beyond(found.stamped_from or 0)
    letter = text[first]
    is_reply = (letter >= ord("0")) & (letter <= ord("9"))
    has_ttl = np.zeros(lines, dtype=np.bool_)
    has_ttl[block.line_of(at_ttl)] = True
    numbers = numbers_at(text, at_seq + 1)
    ends = text[np.minimum(at_seq + 1 + numbers.length, last)]
    # What is not a reply says of a number that none came yet; a line with a time to live whose beginning is missing is
    # neither, and of a number at the end of a reply's line digits may be missing.
    is_whole = (numbers.length > 0) & (is_reply[line_of_seq] == has_ttl[line_of_seq])
    is_whole |= (numbers.length > 0) & is_reply[line_of_seq] & (ends == ord(" "))
    kept = is_whole & np.append(True, np.diff(line_of_seq) > 0)[: len(at_seq)]  # the first number of a line
    rows = line_of_seq[kept]
    seq, is_reply = found.numbers.take(numbers.integers[kept]), is_reply[rows]
    if found.begin is None and len(seq):
        found.begin, found.begin_line = int(seq[0]), block.number + int(rows[0])
        found.is_busybox = not bool(is_preceded_by(text, at_seq[kept][:1], b"icmp_seq")[0])
    found.grid.mention(seq[~is_reply])
    rows, rtt = rows[is_reply], rtt[rows[is_reply]]
    sent = stamp[rows] - np.nan_to_num(rtt)
    found.grid.add(seq[is_reply], (rtt,), None if np.isnan(sent).all() else sent)
    found.below += int(np.count_nonzero(text == ord("<")))
    has_number = np.zeros(lines, dtype=np.bool_)
    has_number[line_of_seq[kept]] = True
    for i in np.flatnonzero(~has_number).tolist():
        _read_other(block, i, found, path)


def _milliseconds(block: Block, places: Places, lines: int) -> Floats:
    """The numbers at these places that ` ms` or a word in other letters follows, by line [s], NaN on lines without one.

    Whatever is before them: ping speaks the user's language, and its only unit is that.
    """
    text, last = block.text, len(block.text) - 1
    numbers = numbers_at(text, places, commas=True)
    ends = places + numbers.length
    behind = np.minimum(ends + (text[np.minimum(ends, last)] == ord(" ")), last)
    is_time = text[behind] >= 0x80
    if not is_time.all():
        is_ms = np.ones(len(ends), dtype=np.bool_)
        for i, letter in enumerate(b" ms"):
            is_ms &= text[np.minimum(ends + i, last)] == letter
        is_time |= is_ms
    is_time &= numbers.length > 0
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


def _read_other(block: Block, i: int, found: _Found, path: Path) -> None:
    """A line that has no packet in it."""
    line = block.line(i)
    if _HEADER.match(line):
        if found.has_header or 0 < found.begin_line < block.number + i:
            raise MeasurementError(f"{path}:{block.number + i}: another run begins: give each run of ping its own file")
        found.has_header = True
        return
    summary = _SUMMARY.match(line)
    if summary is not None:
        found.transmitted, found.received = int(summary[1]), int(summary[2])
        found.total = None if summary[3] is None else int(summary[3]) * 1e-3
        return
    if line.strip() and not _OTHER.fullmatch(line.strip()):
        found.malformed.add(block.number + i, line)


def _measurement(source: str, found: _Found, options: Options) -> Measurement:
    first, last, notes = _range(found)
    interval, said = _interval(found, options)
    is_dated = found.grid.dated > 1
    grid = found.grid.whole(interval, first, last)
    replies = count_of(grid.outcome, lambda part: part == RECEIVED)
    if found.received is not None and found.received != replies:
        said_of_both = f"{replies} replies are in the log, and {found.received} by its summary"
        notes = (*notes, f"{said_of_both}: a number without a reply counts as lost")
    if not is_dated:
        notes = (*notes, said)
    if found.below:
        notes = (*notes, f"{found.below} replies took less than the time that is printed, which stands for it")
    return Measurement(
        source=source, format="ping", sent=grid.sent, round_trip=PacketOutcomes(grid.outcome, grid.delays[0]),
        duplicates=grid.duplicates, reordered=grid.reordered, malformed=found.malformed, notes=notes,
    )  # fmt: skip


def _range(found: _Found) -> tuple[int, int, tuple[str, ...]]:
    """First and last number that were sent, and what must be said of them."""
    grid, notes = found.grid, []
    begins = 0 if found.is_busybox or grid.first == 0 else 1
    is_whole = found.has_header and found.begin is not None and found.begin < 32768
    first, last = min(begins, grid.first) if is_whole else grid.first, grid.last
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
