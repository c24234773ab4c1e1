"""The JSON file of irtt client -o, gzipped or not.

Each member of `round_trips` has a number, what became of it (`lost`: false, true, true_up, true_down, as a string or as
a boolean), time stamps and delays in nanoseconds. true_up was lost on the way there, so nothing came that could be lost
on the way back; true: irtt does not know on which way. Without the word, or with null, a packet was received if it has
a round-trip time. Read some members at a time, so that a file may be of any size; by msgspec, where it is installed, at
four times the speed. Source: irtt-client(1), JSON format.
"""

from __future__ import annotations

import functools
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import HAS_NUMBA
from agv_analysis.link.formats.format import Format, Options
from agv_analysis.link.formats.irtt_shapes import Shapes, Trip
from agv_analysis.link.formats.text_columns import Progress, chunks
from agv_analysis.link.large_arrays import (
    Column,
    column_of,
    count_of,
    firsts_in_order,
    forget,
    is_all_nan,
    parts,
    reordered_by,
)
from agv_analysis.link.measurement import (
    LOST,
    NOT_SENT,
    RECEIVED,
    UNKNOWN,
    Malformed,
    Measurement,
    MeasurementError,
    PacketOutcomes,
)
from agv_analysis.link.packet_grid import count_on
from agv_analysis.run import Floats
from agv_ros.counted import counted

_BEGIN = re.compile(rb'"round_trips"\s*:\s*\[')
_TEXT = re.compile(rb'"(?:[^"\\]|\\.)*(?:"|\\?\Z)', re.DOTALL)
"""A string of JSON, which may be cut."""
_STATED = tuple(
    re.compile(rb'"%b"\s*:\s*(\d{1,18})(?![\d.eE])' % name) for name in (b"interval", b"duplicates", b"late_packets")
)
"""What irtt says before the round trips, which have none of them: replies that came twice, or behind a later one."""
_NS = 1e-9
_BATCH, _LARGE_BATCH = 1 << 16, 1 << 18
"""Bytes that are read at a time, more of members that are written alike: what becomes of them fits the cache."""

_MANY = 1 << 21
"""Bytes of a file from which on members that are written alike are looked for: that takes a while to begin."""

_LARGEST = 2**63
"""Numbers from here on are none of irtt's, which have 64 bits and a sign."""

_WAYS = {
    "false": (RECEIVED, RECEIVED, RECEIVED),
    "true": (UNKNOWN, UNKNOWN, LOST),
    "true_up": (LOST, NOT_SENT, LOST),
    "true_down": (RECEIVED, LOST, LOST),
    "": (UNKNOWN, UNKNOWN, UNKNOWN),
}
"""Outcomes of the uplink, of the downlink and of the whole by irtt's word; the last: it says nothing."""

_WORDS = {word: code for code, word in enumerate(_WAYS)} | {False: 0, True: 1, None: 4}


def _matches(head: bytes, path: Path) -> bool:
    return head.lstrip()[:1] == b"{" and (
        b'"round_trips"' in head or (b'"received_stats"' in head and b'"packets_sent"' in head)
        or (b'"open_timeouts"' in head and b'"system_info"' in head)
    )  # fmt: skip


class _Table:
    """The round trips so far, a column for each of `Trip`."""

    def __init__(self) -> None:
        self.seq, self.word = Column(np.int64), Column(np.int8)
        self.delays, self.stamps = [Column() for _ in range(3)], [Column() for _ in range(2)]
        self._begin: int | None = None
        """The first stamp of the clock that counts from 1970 [ns], from which on the others count."""

    def extend(self, trips: list[Trip]) -> None:
        if trips:
            seq, word, *times = zip(*trips, strict=True)
            wall = np.array([0 if math.isnan(at) else int(at) for at in times[-1]], dtype=np.int64)
            columns = np.array(times, dtype=np.float64).T
            self.extend_columns(np.array(seq, dtype=np.int64), np.array(word, dtype=np.int8), columns, wall)

    def extend_columns(
        self, seq: NDArray[np.int64], word: NDArray[np.int8], times: Floats, wall: NDArray[np.int64]
    ) -> None:
        """`times` [ns], shape (n, 5), the last of them as integers, shape (n,)."""
        times[~(np.abs(times) < _LARGEST)] = np.nan
        known = ~np.isnan(times[:, -1])
        if self._begin is None and known.any():
            self._begin = int(wall[known][0])
        times[known, -1] = wall[known] - (self._begin or 0)
        self.seq.extend(seq)
        self.word.extend(word)
        for i, column in enumerate((*self.delays, *self.stamps)):
            column.extend(times[:, i] * _NS)


def _read(path: Path, options: Options) -> Measurement:
    malformed, table, stated, number = Malformed(), _Table(), [0, 0, 0], 0
    decode, shapes = _decoder(), Shapes(_trip) if HAS_NUMBA and path.stat().st_size > _MANY else None
    size = _BATCH if shapes is None else _LARGE_BATCH
    for batch in _batches(path, options.progress, malformed, stated, size):
        if shapes is not None:
            batch, alike = _without_alike(batch, shapes, table)
            number += alike
            if not batch:
                continue
        trips = decode(batch)
        if trips is None:
            trips = []
            for member in _members(batch):
                trip = _trip(member)
                number += 1
                if trip is None:
                    malformed.add(number, member if isinstance(member, bytes) else json.dumps(member).encode())
                else:
                    trips.append(trip)
        else:
            number += len(trips)
        table.extend(trips)
    if not len(table.seq):
        why = "; ".join(malformed.sentences()) or "was irtt stopped before it wrote them?"
        raise MeasurementError(f"{path}: has no round trips: {why}")
    return _measurement(str(path), table, malformed, stated, options)


def _without_alike(batch: bytes, shapes: Shapes, table: _Table) -> tuple[bytes, int]:
    """What is left of a batch without the members that are written alike, which go into the table; how many they were.

    Of its beginning: behind the first member that has no shape nothing is looked for.
    """
    at, count = 0, 0
    while True:
        alike = shapes.read(batch, at)
        table.extend_columns(alike.seq, alike.word, alike.times, alike.wall)
        at, count = alike.end, count + len(alike.seq)
        if at >= len(batch) or not shapes.learn(batch, at):
            return batch[at:], count


def _batches(
    path: Path, progress: Progress | None, malformed: Malformed, stated: list[int], size: int
) -> Iterator[bytes]:
    """Members of `round_trips`, some at a time, with the commas between them. Into `stated` what `_STATED` says."""
    text, began = b"", False
    for chunk in chunks(path, progress, size):
        text += chunk
        if not began:
            begin = _BEGIN.search(text)
            if begin is None:
                continue
            before = [pattern.search(text, 0, begin.start()) for pattern in _STATED]
            stated[:] = [0 if one is None else int(one[1]) for one in before]
            text, began = text[begin.end() :], True
        end = _end(text)
        at = _last_begin(text) if end is None else end
        if text[:at].strip(b" \t\r\n,"):
            yield text[:at]
        text = text[at:]
        if end is not None:
            return
    if began and text.strip(b" \t\r\n,"):
        whole = [member for member in _members(text) if not isinstance(member, bytes)]
        if whole:
            yield json.dumps(whole)[1:-1].encode()
        malformed.add(0, f"the file ends within its round trips: {text[:40].decode('utf-8', 'replace')}".encode())


def _end(text: bytes) -> int | None:
    """Where the list of members ends: at the first closing bracket that closes none of theirs. Strings do not count."""
    if b"]" not in text:
        return None
    text, at = _TEXT.sub(lambda found: b" " * len(found[0]), text), -1
    while (at := text.find(b"]", at + 1)) >= 0:
        if text.count(b"[", 0, at) == text.count(b"]", 0, at):
            return at
    return None


def _last_begin(text: bytes) -> int:
    """Where the last member begins, which may not be whole: a brace behind a closing one; 0 if there is but one."""
    at = len(text)
    while (at := text.rfind(b"{", 0, at)) > 0:
        before = text[max(0, at - 256) : at].rstrip(b" \t\r\n")
        if before.endswith(b",") and before[:-1].rstrip(b" \t\r\n").endswith(b"}"):
            return at
    return 0


def _members(batch: bytes) -> Iterator[Any]:
    """Members one at a time; of what is none its bytes up to where another one may begin."""
    decoder, text, at = json.JSONDecoder(), batch.decode("utf-8", "replace"), 0
    while True:
        while at < len(text) and text[at] in " \t\r\n,":
            at += 1
        if at >= len(text):
            return
        try:
            member, at = decoder.raw_decode(text, at)
            yield member
        except (ValueError, RecursionError):  # no JSON, a number of thousands of digits, or nested too deeply
            following = _NEXT.search(text, at + 1)
            end = len(text) if following is None else following.start(1)
            yield text[at:end].encode()
            at = end


_NEXT = re.compile(r'\}\s*,\s*(\{\s*"seqno")')


def _trip(member: Any) -> Trip | None:
    """What a member says; None if it is not a round trip."""
    seqno = member.get("seqno") if isinstance(member, dict) else None
    if not isinstance(seqno, int) or not _is_number(seqno):
        return None
    word = member.get("lost", "")
    word = word.lower() if isinstance(word, str) else word
    if not isinstance(word, (str, bool, type(None))) or word not in _WORDS:
        return None
    delay = _part(member, "delay")
    sent = _part(member, "timestamps", "client", "send")
    rtt = _number(delay.get("rtt"))
    return (
        seqno, _word(_WORDS[word], rtt), _number(delay.get("send")), _number(delay.get("receive")), rtt,
        _number(sent.get("monotonic")), _whole(sent.get("wall")),
    )  # fmt: skip


def _part(member: Any, *names: str) -> dict[str, Any]:
    for name in names:
        member = member.get(name) if isinstance(member, dict) else None
    return member if isinstance(member, dict) else {}


def _is_number(value: Any) -> bool:
    """One that an integer of 64 bits may be near to: durations of irtt are no others."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and -_LARGEST < value < _LARGEST


def _number(value: Any) -> float:
    return float(value) if _is_number(value) else math.nan


def _whole(value: Any) -> float:
    """As `_number`, an integer if it is one."""
    return value if _is_number(value) else math.nan


def _word(code: int, rtt: float) -> int:
    """Without irtt's word a packet was received if it has a round-trip time."""
    return _WORDS["false"] if code == _WORDS[""] and not math.isnan(rtt) else code


@functools.cache
def _decoder() -> Callable[[bytes], list[Trip] | None]:
    """A function that decodes a batch of members as irtt writes them; None where one of them is another."""
    try:
        import msgspec
    except ImportError:
        return _decode_as_json

    nothing: Any = math.nan
    stamps = msgspec.defstruct("Stamps", [("monotonic", float, nothing), ("wall", int | float, nothing)], gc=False)
    delay = msgspec.defstruct("Delay", [(key, float, nothing) for key in ("send", "receive", "rtt")], gc=False)
    client = msgspec.defstruct("Client", [("send", stamps, msgspec.field(default_factory=stamps))])
    both = msgspec.defstruct("Both", [("client", client, msgspec.field(default_factory=client))])
    trip: Any = msgspec.defstruct("Trip", [
        ("seqno", int), ("lost", str | bool | None, ""), ("delay", delay, msgspec.field(default_factory=delay)),
        ("timestamps", both, msgspec.field(default_factory=both)),
    ])  # fmt: skip
    decoder = msgspec.json.Decoder(list[trip])

    def decode(batch: bytes) -> list[Trip] | None:
        try:
            found = decoder.decode(b"[" + batch.strip(b" \t\r\n,") + b"]")
            if not all(_is_number(one.seqno) for one in found):
                return None
            return [
                (one.seqno, _word(_WORDS[one.lost], one.delay.rtt), one.delay.send, one.delay.receive, one.delay.rtt,
                 one.timestamps.client.send.monotonic, _whole(one.timestamps.client.send.wall))
                for one in found
            ]  # fmt: skip
        except (msgspec.DecodeError, KeyError):
            return None

    return decode


def _decode_as_json(batch: bytes) -> list[Trip] | None:
    try:
        found = [_trip(member) for member in json.loads(b"[" + batch.strip(b" \t\r\n,") + b"]")]
    except (ValueError, RecursionError):
        return None
    return None if None in found else found  # type: ignore[return-value]


def _measurement(source: str, table: _Table, malformed: Malformed, stated: list[int], options: Options) -> Measurement:
    seq, word, notes = table.seq.values, table.word.values, []
    delays, stamps = [column.values for column in table.delays], [column.values for column in table.stamps]
    _, duplicates, reordered = stated
    kept = firsts_in_order(seq)
    if kept is not None:
        reordered += sum(
            int(np.count_nonzero(np.diff(kept[part.start : part.stop + 1]) < 0)) for part in parts(len(kept) - 1, kept)
        )
        duplicates += len(seq) - len(kept)
        seq, word = reordered_by(seq, kept), reordered_by(word, kept)
        delays, stamps = (
            [reordered_by(column, kept) for column in delays],
            [reordered_by(column, kept) for column in stamps],
        )
    up, down, whole = (
        column_of((codes[word[part]] for part in parts(len(word), word)), np.int8)
        for codes in np.array(list(_WAYS.values()), dtype=np.int8).T
    )
    missing = int(seq[-1] - seq[0]) + 1 - len(seq)
    if missing:
        notes.append(
            f"{counted(missing, 'number is', 'numbers are')} missing from the file, and what became of these "
            "packets is not known"
        )
    blind = count_of(word, lambda part: part == _WORDS["true"])
    if blind:
        notes.append(f"of {blind} lost packets irtt does not know on which way (lost is true): see --stats of irtt")
    untold = count_of(word, lambda part: part == _WORDS[""])
    if untold:
        notes.append(f"of {counted(untold, 'packet')} the file does not say what became of them")
    for delay, codes in zip(delays, (up, whole, whole), strict=True):
        forget(delay, codes, RECEIVED)
    found = [None if is_all_nan(delay) else delay for delay in delays]
    if found[0] is not None:
        notes.append("delays of each direction are as good as the two clocks agree")
    sent, said = _times(seq, stamps, options.interval or stated[0] * _NS)
    return Measurement(
        source=source, format="irtt", sent=sent, uplink=PacketOutcomes(up, found[0]),
        downlink=PacketOutcomes(down, found[1]), round_trip=PacketOutcomes(whole, found[2]), duplicates=duplicates,
        reordered=reordered, malformed=malformed, notes=(*notes, *said),
    )  # fmt: skip


def _times(seq: NDArray[np.int64], stamps: Iterable[Floats], interval: float) -> tuple[Floats, tuple[str, ...]]:
    """When packets were sent [s] since the first: by one of their clocks, else by their numbers, which is then said.

    The clock is the first one that most packets have a stamp of.
    """
    counted = [(count_of(clock, lambda part: ~np.isnan(part)), clock) for clock in stamps]
    known, clock = max(counted, key=lambda one: one[0])
    if known < 2:
        said = "" if interval else ": 1 s is assumed between them; say otherwise with --interval"
        times = (seq - seq[0]) * (interval or 1.0)
        return times, (f"the file does not say when packets were sent, and they are dated by their numbers{said}",)
    if known < len(clock):
        is_known = ~np.isnan(clock)
        clock = np.interp(seq.astype(np.float64), seq[is_known].astype(np.float64), clock[is_known])
    count_on(clock)
    return clock, ()


FORMAT = Format("irtt", "JSON of irtt client -o", 10, _matches, _read)
