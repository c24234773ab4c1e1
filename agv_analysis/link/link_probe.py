"""A link measured from both ends with packets like the loop's own, over UDP: no ROS, and nothing but Python needed.

The AGV's end sends a packet of a pose's size each sampling period; the edge's end answers each with one of a command's
size. Either has a number and the time of its end's monotonic clock. After the last packet the AGV's end asks for the
list of what arrived, so it is known of every packet on which way it was lost, and how late it was on its way up even if
the answer was lost.

The offset between the clocks is estimated from the packets with the smallest round-trip times, by a line over time, as
if both ways took the same time at least. What is not the same of both ways moves from one delay to the other.

An edge that listens answers its peer only: the first address that says hello, or the one it was told; a hello must come
back with a number that was sent to its address, answers are never longer than what they answer, and rate and duration
are bounded. Source of the offset: Mills, Network Time Protocol, RFC 5905, clause 8.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import select
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, field

HELLO, WELCOME, PACKET, ANSWER, ASK, LIST = range(1, 7)

_MAGIC = b"AGVP"
_HEADER = struct.Struct("!4sBQQ")
"""Magic, kind, number of the AGV's end, number of the edge's end."""
_PACKET = struct.Struct("!Iq")
"""Number of the packet, when it was sent [ns]."""
_ANSWER = struct.Struct("!Iqqq")
"""Number of the packet, when it was sent, received and answered [ns], by the clock of each."""
_HELLO = struct.Struct("!IIHH")
"""Number of packets, time between them [us], bytes of a packet and of an answer."""
_ASK = struct.Struct("!I")
_RECORD = struct.Struct("!Iq")

PORT = 47474

SMALLEST, LARGEST = max(_HEADER.size + _ANSWER.size, 53), 1400
"""Bytes of a packet."""

_RECORDS = (LARGEST - _HEADER.size - _ASK.size) // _RECORD.size
"""Of a list, in one packet."""

MOST_PACKETS, SHORTEST = 2_000_000, 500e-6
"""Packets of a measurement, and time between two of them [s]."""

_PATIENCE = 2.0
"""How long the AGV's end waits for a late answer, and each end for the other at its beginning and end [s]."""

_TRIES = 20

_SILENCE = 10.0
"""After so long without a packet [s] the edge's end takes another peer."""

_LINGER = 0.3
"""So long [s] the last list may be asked for again before the edge's end goes."""

_WINDOWS = 20
"""Parts of a measurement of which each gives its smallest round trip to the line of the clocks' offset."""


class ProbeError(ValueError):
    """A measurement that cannot be made; the text says why."""


@dataclass
class ProbeResult:
    """N packets, in the order in which they were sent; times [ns] are by the clock of the AGV's end unless said."""

    sent: list[int]
    """When each was sent, shape (N,)."""
    arrived: list[int | None]
    """When it arrived, by the clock of the edge's end; None: lost on its way up, shape (N,)."""
    answered: list[int | None]
    """When its answer was sent, by the clock of the edge's end; None: not known, shape (N,)."""
    returned: list[int | None]
    """When its answer arrived; None: lost on either way, shape (N,)."""
    is_listed: bool
    """Did the edge's end say what arrived? Else a packet without an answer was lost on either way."""
    wall: float
    """When the first was sent, in seconds since 1970."""
    duplicates: int = 0
    offset: tuple[float, float] = (0.0, 0.0)
    """Clock of the edge's end less that of the AGV's [ns]: at the first packet, and per ns since."""
    notes: list[str] = field(default_factory=list)

    def offset_at(self, instant: int) -> float:
        """Clock of the edge's end less that of the AGV's [ns]."""
        return self.offset[0] + self.offset[1] * (instant - self.sent[0])

    def uplink_delay(self, i: int) -> float | None:
        """Time under way of packet i [s]; None if it was lost."""
        arrived = self.arrived[i]
        return None if arrived is None else 1e-9 * (arrived - self.sent[i] - self.offset_at(self.sent[i]))

    def downlink_delay(self, i: int) -> float | None:
        """Time under way of the answer to packet i [s]; None if none came."""
        answered, returned = self.answered[i], self.returned[i]
        if answered is None or returned is None:
            return None
        return 1e-9 * (returned - answered + self.offset_at(returned))


def listen(
    port: int = PORT, host: str = "", peer: str | None = None, seconds: float = 3600.0, sessions: int | None = None,
    ready: Callable[[int], None] = lambda port: None,
) -> tuple[int, int]:  # fmt: skip
    """Answer the packets of one peer after another; returns how many were answered, and how many refused.

    Ends after so many seconds, or so many sessions. `ready` is called with the port that it listens on. Raises
    ProbeError if it cannot.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        try:
            udp.bind((host, port))
            allowed = None if peer is None else socket.gethostbyname(peer)
        except OSError as error:
            raise ProbeError(f"cannot listen on port {port}: {error.strerror or error}") from None
        ready(udp.getsockname()[1])
        edge, end = _Edge(allowed), time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            if sessions is not None and edge.finished >= sessions and edge.silence(time.monotonic()) > _LINGER:
                break
            if not select.select([udp], [], [], min(left, 0.1))[0]:
                edge.look(time.monotonic())
                continue
            data, address = udp.recvfrom(65536)
            reply = edge.reply(data, address, time.monotonic_ns())
            if reply:
                udp.sendto(reply, address)
        return edge.answered, edge.refused


class _Edge:
    """What the edge's end knows of its peer."""

    def __init__(self, allowed: str | None) -> None:
        self.answered = self.refused = self.finished = 0
        self._allowed = allowed
        self._address: tuple[str, int] | None = None
        self._numbers = (0, 0)
        self._secret = os.urandom(16)
        self._arrived: dict[int, int] = {}
        self._last = 0.0
        self._most, self._size = 0, SMALLEST
        self._is_told = True
        """Does the peer know what arrived, so that another one may come?"""

    def silence(self, now: float) -> float:
        """Time since the peer was heard last [s]."""
        return now - self._last

    def look(self, now: float) -> None:
        """Take another peer after a silence."""
        if self._address is not None and self.silence(now) > _SILENCE:
            self.finished += not self._is_told
            self._address, self._arrived, self._is_told = None, {}, True

    def reply(self, data: bytes, address: tuple[str, int], now_ns: int) -> bytes:
        """What to answer; nothing to anybody but the peer, and nothing to what is not a packet of a measurement."""
        self.look(1e-9 * now_ns)
        if len(data) < _HEADER.size or data[:4] != _MAGIC:
            self.refused += 1
            return b""
        _, kind, one, other = _HEADER.unpack_from(data)
        body = data[_HEADER.size :]
        is_stranger = self._address not in (None, address) and not (kind == HELLO and self._is_told)
        if is_stranger or (self._allowed is not None and address[0] != self._allowed):
            self.refused += 1
            return b""
        if kind == HELLO:
            return self._welcome(one, other, body, address, now_ns)
        if self._address != address or (one, other) != self._numbers:
            self.refused += 1
            return b""
        self._last = 1e-9 * now_ns
        if kind == PACKET and len(body) >= _PACKET.size:
            return self._answer(body, now_ns)
        return self._list(body, len(data)) if kind == ASK and len(body) >= _ASK.size else b""

    def _number(self, address: tuple[str, int], one: int) -> int:
        """What a hello from this address must bring back: no other address has received it."""
        said = f"{address[0]}/{address[1]}/{one}".encode()
        return int.from_bytes(hashlib.blake2b(said, key=self._secret, digest_size=8).digest(), "big")

    def _welcome(self, one: int, other: int, body: bytes, address: tuple[str, int], now_ns: int) -> bytes:
        number = self._number(address, one)
        if other == number and len(body) >= _HELLO.size and (one, number) != self._numbers:
            count, period, size, answer = _HELLO.unpack_from(body)
            is_fine = count <= MOST_PACKETS and period >= SHORTEST * 1e6 and SMALLEST <= answer <= size <= LARGEST
            if not is_fine:
                self.refused += 1
                return b""
            self._address, self._numbers, self._arrived = address, (one, number), {}
            self._most, self._size, self._last, self._is_told = count, answer, 1e-9 * now_ns, False
        return _HEADER.pack(_MAGIC, WELCOME, one, number)

    def _answer(self, body: bytes, now_ns: int) -> bytes:
        i, sent = _PACKET.unpack_from(body)
        if i >= self._most or len(body) + _HEADER.size < self._size:
            self.refused += 1
            return b""
        self._arrived.setdefault(i, now_ns)
        self.answered += 1
        head = _HEADER.pack(_MAGIC, ANSWER, *self._numbers)
        return (head + _ANSWER.pack(i, sent, now_ns, time.monotonic_ns())).ljust(self._size, b"\0")

    def _list(self, body: bytes, length: int) -> bytes:
        """What arrived from a number on, in their order; no longer than the question."""
        (first,) = _ASK.unpack_from(body)
        room = min(_RECORDS, (length - _HEADER.size - _ASK.size) // _RECORD.size)
        i, records = first, list[bytes]()
        while i < self._most and len(records) < room:
            if i in self._arrived:
                records.append(_RECORD.pack(i, self._arrived[i]))
            i += 1
        if i >= self._most and not self._is_told:
            self._is_told = True
            self.finished += 1
        return _HEADER.pack(_MAGIC, LIST, *self._numbers) + _ASK.pack(i) + b"".join(records)


def measure(
    host: str, port: int = PORT, count: int = 2000, interval: float = 0.005, size: int = 76, answer: int = 76,
    progress: Callable[[int], None] = lambda done: None,
) -> ProbeResult:  # fmt: skip
    """Measure the link to an edge that listens: `count` packets of `size` bytes every `interval` [s].

    Raises ProbeError if it does not answer, or for what is out of bounds.
    """
    size, answer = max(SMALLEST, size), max(SMALLEST, answer)
    size = max(size, answer)  # an answer is never longer than what it answers
    if not 1 <= count <= MOST_PACKETS:
        raise ProbeError(f"a measurement has 1 to {MOST_PACKETS} packets, got {count}")
    if not interval >= SHORTEST:
        raise ProbeError(f"packets must be {SHORTEST:g} s apart at least, got {interval:g} s")
    if size > LARGEST:
        raise ProbeError(f"a packet has {LARGEST} byte at most, got {size}")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        try:
            udp.connect((host, port))
        except OSError as error:
            raise ProbeError(f"{host}: {error.strerror or error}") from None
        numbers = _hello(udp, f"{host}:{port}", _HELLO.pack(count, round(interval * 1e6), size, answer))
        found = _send_all(udp, numbers, count, round(interval * 1e9), size, progress)
        found.is_listed = _ask_all(udp, numbers, found)
    if not found.is_listed:
        found.notes.append("the edge's end did not say what arrived: a packet without an answer was lost on either way")
    found.offset = _offset(found)
    return found


Numbers = tuple[int, int]


def _hello(udp: socket.socket, name: str, asked: bytes) -> Numbers:
    """Greet the edge's end, once to be told its number and once with it."""
    one, number = int.from_bytes(os.urandom(8), "big"), 0
    for step in range(2):
        for _ in range(_TRIES):
            _send(udp, (_HEADER.pack(_MAGIC, HELLO, one, number) + asked).ljust(64, b"\0"))
            reply = _receive(udp, WELCOME, one, time.monotonic() + _PATIENCE / 10.0)
            if reply is not None and (step == 0 or reply[0] == number):
                number = reply[0]
                break
        else:
            raise ProbeError(
                f"{name}: no answer: start `agv-ncs probe --listen` there, let UDP pass, or wait until it has "
                "done with another peer"
            )
    return one, number


def _send(udp: socket.socket, data: bytes) -> None:
    with contextlib.suppress(OSError):  # the network is down, or no process listens: lost, as on any other way
        udp.send(data)


def _receive(udp: socket.socket, kind: int, one: int, until: float) -> tuple[int, bytes] | None:
    """(Number of the edge's end, body) of the next message of a kind; None if none comes until then."""
    while (left := until - time.monotonic()) > 0.0:
        if not select.select([udp], [], [], left)[0]:
            return None
        try:
            data = udp.recv(65536)
        except OSError:
            time.sleep(min(0.01, left))
            continue
        if len(data) >= _HEADER.size and data[:4] == _MAGIC:
            _, got, to, number = _HEADER.unpack_from(data)
            if got == kind and to == one:
                return number, data[_HEADER.size :]
    return None


def _send_all(
    udp: socket.socket, numbers: Numbers, count: int, period: int, size: int, progress: Callable[[int], None]
) -> ProbeResult:
    head = _HEADER.pack(_MAGIC, PACKET, *numbers)
    sent = [0] * count
    arrived: list[int | None] = [None] * count
    answered: list[int | None] = [None] * count
    returned: list[int | None] = [None] * count
    found = ProbeResult(sent, arrived, answered, returned, False, time.time())
    begin = time.monotonic_ns() + 10_000_000
    for i in range(count):
        _take_answers(udp, numbers, found, begin + i * period)
        if i == 0:
            found.wall = time.time()
        sent[i] = time.monotonic_ns()
        _send(udp, (head + _PACKET.pack(i, sent[i])).ljust(size, b"\0"))
        progress(i + 1)
    _take_answers(udp, numbers, found, time.monotonic_ns() + round(_PATIENCE * 1e9), count)
    return found


def _take_answers(udp: socket.socket, numbers: Numbers, found: ProbeResult, until: int, all_of: int = 0) -> None:
    """Take what comes until an instant [ns], or until all have come."""
    while (left := until - time.monotonic_ns()) > 0:
        if all_of and found.returned[all_of - 1] is not None and None not in found.returned:
            return
        if not select.select([udp], [], [], 1e-9 * left)[0]:
            return
        now = time.monotonic_ns()
        try:
            data = udp.recv(65536)
        except OSError:
            continue
        if len(data) < _HEADER.size + _ANSWER.size or _HEADER.unpack_from(data) != (_MAGIC, ANSWER, *numbers):
            continue
        i, _, arrived, answered = _ANSWER.unpack_from(data, _HEADER.size)
        if i >= len(found.sent) or found.returned[i] is not None:
            found.duplicates += i < len(found.sent)
            continue
        found.arrived[i], found.answered[i], found.returned[i] = arrived, answered, now


def _ask_all(udp: socket.socket, numbers: Numbers, found: ProbeResult) -> bool:
    """Ask for the list of what arrived, until all of it is there."""
    first, tries = 0, 0
    head = _HEADER.pack(_MAGIC, ASK, *numbers)
    while first < len(found.sent):
        _send(udp, (head + _ASK.pack(first)).ljust(LARGEST, b"\0"))
        reply = _receive(udp, LIST, numbers[0], time.monotonic() + _PATIENCE / 10.0)
        if reply is None or len(reply[1]) < _ASK.size:
            tries += 1
            if tries >= _TRIES:
                return False
            continue
        tries, body = 0, reply[1]
        for at in range(_ASK.size, len(body) - _RECORD.size + 1, _RECORD.size):
            i, arrived = _RECORD.unpack_from(body, at)
            if i < len(found.sent) and found.arrived[i] is None:
                found.arrived[i] = arrived
        following = _ASK.unpack_from(body)[0]
        if following <= first:
            return False
        first = following
    return True


def _offset(found: ProbeResult) -> tuple[float, float]:
    """Offset of the clocks at the first packet [ns], and per ns, from the smallest round trips of parts of the time."""
    best: dict[int, tuple[int, int, float]] = {}
    for i, (sent, arrived, answered, returned) in enumerate(
        zip(found.sent, found.arrived, found.answered, found.returned, strict=True)
    ):
        if arrived is None or answered is None or returned is None:
            continue
        trip = (returned - sent) - (answered - arrived)
        window = i * _WINDOWS // len(found.sent)
        if window not in best or trip < best[window][0]:
            best[window] = trip, sent - found.sent[0], 0.5 * ((arrived - sent) + (answered - returned))
    if not best:
        found.notes.append("no packet came back: the clocks' offset is not known, and neither are delays")
        return 0.0, 0.0
    points = [(x, y) for _, x, y in best.values()]
    if len(points) < _WINDOWS // 2 or points[-1][0] - points[0][0] < 10e9:  # too short to tell a drift from noise
        return min(best.values())[2], 0.0
    mean_x, mean_y = (sum(values) / len(points) for values in zip(*points, strict=True))
    square = sum((x - mean_x) ** 2 for x, _ in points)
    slope = sum((x - mean_x) * (y - mean_y) for x, y in points) / square
    return mean_y - slope * mean_x, slope


COLUMNS = (
    "time", "seq", "sent_monotonic_ns", "sent_wall", "uplink_lost", "uplink_delay", "downlink_lost", "downlink_delay",
)  # fmt: skip


def rows_of(found: ProbeResult) -> list[str]:
    """Lines of a trace with times; `downlink_lost` is nan where nothing was sent on the way down."""
    has_offset = any(returned is not None for returned in found.returned)
    lines = [",".join(COLUMNS)]
    for i, sent in enumerate(found.sent):
        is_lost = found.arrived[i] is None
        is_unanswered = found.returned[i] is None
        up, down = (found.uplink_delay(i), found.downlink_delay(i)) if has_offset else (None, None)
        lost = ("nan", "nan") if is_unanswered and not found.is_listed else (
            str(int(is_lost)), "nan" if is_lost else str(int(is_unanswered))
        )  # fmt: skip
        cells = (
            f"{1e-9 * (sent - found.sent[0]):.9f}", str(i), str(sent),
            f"{found.wall + 1e-9 * (sent - found.sent[0]):.6f}", lost[0], _cell(up), lost[1], _cell(down),
        )  # fmt: skip
        lines.append(",".join(cells))
    return lines


def _cell(seconds: float | None) -> str:
    return "nan" if seconds is None else f"{max(0.0, seconds):.9f}"
