"""What irtt client -r prints: a line a reply, with number, delays [ms], and whether it is a duplicate or late.

    seqno rtt receive_delay send_delay ipdv duplicate late        e.g. 3 1.204117 0.601 0.603 -0.010 0 0

NaN stands for what was not measured. A number without a line was lost, on which way is not known. Source: the raw mode
of irtt's client.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.rows import MOST_EXACT, parts_of_rows
from agv_analysis.link.large_arrays import is_all_nan
from agv_analysis.link.measurement import (
    Malformed,
    Measurement,
    PacketOutcomes,
    needs_packets,
    of_one_way,
)
from agv_analysis.link.packet_grid import PacketGrid

_COLUMNS = 7
_WANTED = (0, 1, 2, 3, 5)
"""Number, delays, duplicate."""
_USUAL_INTERVAL = 1.0
"""Time between packets that irtt takes without -i [s]."""


def _matches(head: bytes, path: Path) -> bool:
    for line in head.splitlines()[:20]:
        words = line.split()
        if len(words) == _COLUMNS and words[0].isdigit() and words[5] in (b"0", b"1"):
            return words[6] in (b"0", b"1", b"NaN")
    return False


def _read(path: Path, options: Options) -> Measurement:
    malformed, found, duplicates = Malformed(), PacketGrid(delays=3), 0
    for table in parts_of_rows(path, _COLUMNS, malformed, options.progress, _WANTED):
        is_numbered, again = np.abs(table[:, 0]) < MOST_EXACT, table[:, 4] == 1.0
        malformed.count += int(np.count_nonzero(~is_numbered))
        duplicates += int(np.count_nonzero(is_numbered & again))
        table = table[is_numbered & ~again]
        found.add(table[:, 0].astype(np.int64), tuple(1e-3 * table[:, i] for i in (3, 2, 1)))
    needs_packets(found.records, str(path), "line of a reply" if not duplicates else "reply that is not a duplicate")
    interval = options.interval or _USUAL_INTERVAL
    assumed = " between them, as --interval says" if options.interval else (
        " between them, irtt's usual, is assumed; say otherwise with --interval"
    )  # fmt: skip
    notes = [
        f"the lines do not say when packets were sent: {interval:g} s{assumed}",
        "packets after the last reply are unknown, and on which way a packet was lost",
    ]
    grid = found.whole(interval, first=0)
    up, down, rtt = grid.delays
    either = of_one_way(grid.outcome)
    directions = [PacketOutcomes(either, None if is_all_nan(delay) else delay) for delay in (up, down)]
    return Measurement(
        source=str(path), format="irtt -r", sent=grid.sent, uplink=directions[0], downlink=directions[1],
        round_trip=PacketOutcomes(grid.outcome, rtt), duplicates=duplicates + grid.duplicates,
        reordered=grid.reordered, malformed=malformed, notes=tuple(notes),
    )  # fmt: skip


FORMAT = Format("irtt-raw", "output of irtt client -r", 50, _matches, _read)
