"""A measurement as a link of the loop: which outcomes and delays either direction has, and a trace file of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agv_analysis.link.large_arrays import Column, column_of, count_of, is_all_nan, parts, release
from agv_analysis.link.measurement import LOST, NOT_SENT, RECEIVED, UNKNOWN, Measurement, PacketOutcomes
from agv_analysis.output_file import output_file
from agv_analysis.run import Floats
from agv_plant.channels.timed_trace import read_trace
from agv_ros.errors import UserError

UP, DOWN, HALF = "up", "down", "half"
ROUND_TRIPS = (UP, HALF, DOWN)
"""On which way a round trip lost its packet and its time, where that is all that is known.

up, down: all of it on this way; half: each way takes half the time, and the packet was lost on the way up. To the age
of the pose behind the command that acts only the sum matters, and criteria know late poses; so `up` is what is usual.
"""


class LinkOfLoop(NamedTuple):
    """What the loop's links did, packet by packet; shapes (N,)."""

    time: Floats
    """When each packet was sent [s]."""
    uplink_lost: np.ndarray[tuple[int], np.dtype[np.bool_]]
    uplink_delay: Floats | None
    """[s], NaN where unknown; None if it is not known at all."""
    downlink_lost: np.ndarray[tuple[int], np.dtype[np.bool_]] | None
    """None: nothing is known of the downlink, which is taken for perfect."""
    downlink_delay: Floats | None
    notes: tuple[str, ...]
    """What was assumed."""


def link_of_loop(measured: Measurement, rtt: str = UP) -> LinkOfLoop:
    """The links that a measurement is, `rtt` being one of ROUND_TRIPS.

    The client of the measurement is taken for the AGV. What is not known of a packet is what was known before it.
    """
    up, down, both = measured.uplink, measured.downlink, measured.round_trip
    delays, notes = (_delay(up), _delay(down)), list[str]()
    is_told = up is not None and up.is_told and (down is None or down.is_told)
    if not is_told and both is not None:
        up, down, said = _both_ways(up, down, both, rtt)
        if delays[0] is None or delays[1] is None:
            delays, share = _shares(both, rtt)
            said += f", {share}"
        notes.append(f"{said} (--rtt {rtt})")
    elif up is None or down is None:
        notes.append(f"nothing is known of the {'uplink' if up is None else 'downlink'}, which is taken for perfect")
    up_lost = np.zeros(measured.packets, dtype=np.bool_) if up is None else _held(up)
    down_lost = None if down is None else _held(down)
    found, early = [], 0
    for delay in delays:
        below = 0 if delay is None else count_of(delay, lambda part: part < 0.0)
        early += below
        found.append(_mapped(delay, lambda part: np.maximum(part, 0.0)) if below and delay is not None else delay)
    if early:
        notes.append(f"{early} delays are below 0, since the clocks do not agree: they count as 0")
    return LinkOfLoop(_increasing(measured.sent), up_lost, found[0], down_lost, found[1], tuple(notes))


def _both_ways(
    up: PacketOutcomes | None, down: PacketOutcomes | None, both: PacketOutcomes, rtt: str
) -> tuple[PacketOutcomes, PacketOutcomes, str]:
    """Outcomes of either way where not all are known, and that in words: what is known of a packet stays.

    A packet of which only the round trip is known to be lost was lost on the way that `rtt` says.
    """
    ups, downs = Column(np.int8), Column(np.int8)
    assumed = known_up = known_down = 0
    arrays = (both.outcome, None if up is None else up.outcome, None if down is None else down.outcome)
    for part in parts(len(both.outcome), *arrays):
        whole = both.outcome[part]
        going, coming = (
            np.where(whole == RECEIVED, RECEIVED, UNKNOWN if array is None else array[part]).astype(np.int8)
            for array in arrays[1:]
        )
        blind = (whole == LOST) & (going != LOST) & (coming != LOST)
        known_up += int(np.count_nonzero(going == LOST))
        known_down += int(np.count_nonzero(coming == LOST))
        assumed += int(np.count_nonzero(blind))
        going[blind], coming[blind] = (RECEIVED, LOST) if rtt == DOWN else (LOST, NOT_SENT)
        ups.extend(going)
        downs.extend(coming)
    way = "downlink's" if rtt == DOWN else "uplink's"
    said = f"only the round trip is known: its losses are taken for the {way}"
    if known_up or known_down:
        said = (
            f"{assumed} losses on a way that is not known are taken for the {way}, beside {known_up} that are known to "
            f"be the uplink's and {known_down} the downlink's"
        )
    return PacketOutcomes(ups.values), PacketOutcomes(downs.values), said


def beginning_of(link: LinkOfLoop, seconds: float) -> LinkOfLoop:
    """The packets of the first so many seconds, and the next one, so that the last of them holds until then."""
    end = int(np.searchsorted(link.time, seconds)) + 1

    def upto(values: Any) -> Any:
        return values if values is None else values[:end]

    return link._replace(
        time=link.time[:end], uplink_lost=link.uplink_lost[:end], uplink_delay=upto(link.uplink_delay),
        downlink_lost=upto(link.downlink_lost), downlink_delay=upto(link.downlink_delay),
    )  # fmt: skip


def _delay(packets: PacketOutcomes | None) -> Floats | None:
    return None if packets is None or packets.delay is None or is_all_nan(packets.delay) else packets.delay


def _mapped(values: Floats, function: Callable[[Floats], Floats]) -> Floats:
    """A function of each value of a large array, shape (N,)."""
    return column_of((function(values[part]) for part in parts(len(values), values)), np.float64)


def _shares(both: PacketOutcomes, rtt: str) -> tuple[tuple[Floats | None, Floats | None], str]:
    """Delays of both directions out of those of the round trip, and that in words."""
    delay = _delay(both)
    if delay is None:
        return (None, None), "its delay is not known"
    if rtt == HALF:
        half = _mapped(delay, lambda part: 0.5 * part)
        return (half, half), "and each way takes half its time"
    nothing = _mapped(delay, lambda part: np.where(np.isnan(part), np.nan, 0.0))
    return ((delay, nothing), "and all its time") if rtt == UP else ((nothing, delay), "and all its time")


def _held(packets: PacketOutcomes) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Lost or not, shape (N,); where that is not known, what it was before, received at the beginning."""
    outcome = packets.outcome

    def lost() -> Iterator[np.ndarray[tuple[int], np.dtype[np.bool_]]]:
        before = np.array([RECEIVED], dtype=np.int8)
        for part in parts(len(outcome), outcome):
            codes = np.append(before, outcome[part])
            last = np.maximum.accumulate(np.where(codes <= LOST, np.arange(len(codes)), 0))
            before = codes[last[-1:]]
            yield codes[last][1:] == LOST

    return column_of(lost(), np.bool_)


def _increasing(sent: Floats) -> Floats:
    """Times [s] that increase by a microsecond at least: stamps may be coarser than packets are apart."""

    def steps() -> Iterator[Floats]:
        return (np.diff(sent[part.start : part.stop + 1]) for part in parts(len(sent) - 1, sent))

    if not any(np.any(part < 1e-6) for part in steps()):
        return sent if sent[0] == 0.0 else _mapped(sent, lambda part: part - sent[0])

    def times() -> Iterator[Floats]:
        newest = np.zeros(1)
        yield newest
        for part in steps():
            found = np.cumsum(np.append(newest, np.maximum(part, 1e-6)))[1:]
            newest = found[-1:]
            yield found

    return column_of(times(), np.float64)


def of_trace(file: str, link: str, ts: float) -> Measurement:
    """What a file for the channel `trace` says of a link, as a measurement; a row without a time is a slot of `ts` [s].

    Raises TraceError for a file that cannot be used.
    """
    found = read_trace(file, link)
    sent = np.arange(len(found.lost), dtype=np.float64) * ts if found.time is None else found.time
    delay = None if found.delay is None else np.where(found.lost, np.nan, found.delay)
    packets = PacketOutcomes(np.where(found.lost, LOST, RECEIVED).astype(np.int8), delay)
    is_uplink = link != "downlink"
    return Measurement(
        file, "trace", sent, uplink=packets if is_uplink else None, downlink=None if is_uplink else packets
    )


def write_trace(path: Path, link: LinkOfLoop) -> None:
    """Write a file for the channel `trace`, with times. Raises UserError if it cannot be written."""
    columns: list[tuple[str, str]] = [("time", "%.6f"), ("uplink_lost", "%d")]
    if link.uplink_delay is not None:
        columns.append(("uplink_delay", "%.9g"))
    if link.downlink_lost is not None:
        columns.append(("downlink_lost", "%d"))
        if link.downlink_delay is not None:
            columns.append(("downlink_delay", "%.9g"))
    form = ",".join(how for _, how in columns)
    try:
        with open(output_file(path), "w", encoding="utf-8") as file:
            file.write(",".join(name for name, _ in columns) + "\n")
            for first in range(0, len(link.time), _ROWS):
                rows = _rows(link, slice(first, first + _ROWS), [name for name, _ in columns])
                file.write("\n".join([form % tuple(row) for row in rows.tolist()]) + "\n")
                release(*(getattr(link, name) for name, _ in columns))
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None


_ROWS = 65536
"""That are written together."""


def _rows(link: LinkOfLoop, part: slice, names: list[str]) -> Floats:
    """Rows of a trace's file, shape (n, names); delays of what was lost are NaN."""
    found = []
    for name in names:
        values = np.asarray(getattr(link, name)[part], dtype=np.float64)
        if name.endswith("_delay"):
            values = np.where(getattr(link, name.replace("_delay", "_lost"))[part], np.nan, values)
        found.append(values)
    return np.stack(found, axis=1)
