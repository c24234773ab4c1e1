"""What irtt client prints without -q: a line a reply.

    seq=3 rtt=1.2ms rd=601.5µs sd=603µs ipdv=10.1µs (LATE)
    DUP! seq=3

Delays have the units of Go's durations; `rd` and `sd` are there if the server has stamps. A number without a line was
lost, on which way is not known. Source: the client of irtt.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.text_columns import Block, Bytes, Places, blocks, is_preceded_by, numbers_at
from agv_analysis.link.large_arrays import is_all_nan
from agv_analysis.link.measurement import (
    Malformed,
    Measurement,
    PacketOutcomes,
    needs_packets,
    of_one_way,
)
from agv_analysis.link.packet_grid import PacketGrid
from agv_analysis.run import Floats

_LINE = re.compile(rb"^seq=\d+ rtt=-?[\d.]+", re.MULTILINE)
_OTHER = re.compile(rb"\[.*\] .*|DUP! seq=\d+|\s.*|.*(stats|rate|loss|duration|pkts|sent/received|Min|---|RTT).*")
"""Lines that say nothing of a reply: events, duplicates, and the table at the end, which is set to the right."""

_SENT = re.compile(rb"\s*packets sent/received: (\d{1,18})/\d+")

_USUAL_INTERVAL = 1.0
"""Time between packets that irtt takes without -i [s]."""

_NAMES = (b"rtt", b"sd", b"rd")


def _matches(head: bytes, path: Path) -> bool:
    return _LINE.search(head) is not None


def _read(path: Path, options: Options) -> Measurement:
    malformed, found, duplicates, sent = Malformed(), PacketGrid(delays=3), 0, 0
    for block in blocks(path, options.progress):
        table, again, stated = _table(block, malformed)
        found.add(table[:, 0].astype(np.int64), tuple(table[:, i] for i in (1, 2, 3)))
        duplicates, sent = duplicates + again, max(sent, stated)
    needs_packets(found.records, str(path), "line of a reply", malformed)
    interval = options.interval or _USUAL_INTERVAL
    assumed = "as --interval says" if options.interval else "irtt's usual, is assumed; say otherwise with --interval"
    unknown = "" if sent else "packets after the last reply are unknown, and "
    notes = (
        f"the lines do not say when packets were sent: {interval:g} s between them, {assumed}",
        f"{unknown}on which way a packet was lost" + (" is not known" if sent else ""),
    )
    grid = found.whole(interval, first=0, last=max(found.last, sent - 1))
    rtt, up, down = grid.delays
    either = of_one_way(grid.outcome)
    directions = [PacketOutcomes(either, None if is_all_nan(delay) else delay) for delay in (up, down)]
    return Measurement(
        source=str(path), format="irtt", sent=grid.sent, uplink=directions[0], downlink=directions[1],
        round_trip=PacketOutcomes(grid.outcome, rtt), duplicates=duplicates + grid.duplicates,
        reordered=grid.reordered, malformed=malformed, notes=notes,
    )  # fmt: skip


def _table(block: Block, malformed: Malformed) -> tuple[Floats, int, int]:
    """Number and delays rtt, sd, rd [s] of each reply of a block, shape (n, 4).

    Then how many lines are of duplicates, and how many packets were sent by the table at the end, 0 if it is not there.
    """
    text, lines = block.text, len(block.starts)
    signs = np.flatnonzero(text == ord("="))
    at_seq = signs[is_preceded_by(text, signs, b"seq")]
    of_line = block.line_of(at_seq)
    begins = at_seq == block.starts[of_line] + 3  # at the beginning of its line, which a duplicate's is not
    table = np.full((lines, 4), np.nan)
    table[of_line[begins], 0] = numbers_at(text, at_seq[begins] + 1).values
    for column, name in enumerate(_NAMES, start=1):
        at = signs[is_preceded_by(text, signs, b" " + name)]
        table[block.line_of(at), column] = _durations(text, at + 1)
    whole = ~np.isnan(table[:, 0]) & ~np.isnan(table[:, 1])
    duplicates = sent = 0
    for i in np.flatnonzero(~whole).tolist():
        line = block.line(i)
        duplicates += line.startswith(b"DUP!")
        stated = _SENT.match(line)
        sent = sent if stated is None else int(stated[1])
        if line.strip() and not _OTHER.fullmatch(line):
            malformed.add(block.number + i, line)
    return table[whole], duplicates, sent


def _durations(text: Bytes, places: Places) -> Floats:
    """Durations of Go [s], as in 1.2ms or 1m2.5s, NaN for others."""
    negative = text[places] == ord("-")
    numbers = numbers_at(text, places + negative)
    unit = np.minimum(places + negative + numbers.length, len(text) - 1)
    first, second = text[unit], text[np.minimum(unit + 1, len(text) - 1)]
    scale = np.full(len(places), np.nan)
    scale[(first == ord("s"))] = 1.0
    scale[(first == ord("m")) & (second == ord("s"))] = 1e-3
    scale[(first == ord("u")) | (first == 0xC2)] = 1e-6  # the sign for micro has two bytes
    scale[first == ord("n")] = 1e-9
    values = numbers.values * scale
    for letter, seconds in ((ord("m"), 60.0), (ord("h"), 3600.0)):  # before them there are others
        longer = (first == letter) & (second >= ord("0")) & (second <= ord("9"))
        if longer.any():
            values[longer] = seconds * numbers.values[longer] + _durations(text, unit[longer] + 1)
    return np.asarray(np.where(negative, -values, values))


FORMAT = Format("irtt-text", "output of irtt client", 35, _matches, _read)
