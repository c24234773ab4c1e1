"""The link from both ends: real sockets on loopback, a relay that loses what it is told to, two hosts on a cable."""

from __future__ import annotations

import contextlib
import json
import os
import select
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.link.formats import read_link
from agv_analysis.link.link_figures import LinkFigures
from agv_analysis.link.link_probe import SMALLEST, ProbeError, listen, measure, rows_of
from agv_analysis.link.measurement import Measurement
from agv_plant.channels.timed_trace import read_trace

AgvNcs = Callable[..., tuple[int, str]]
PACKET, ANSWER = 3, 4
"""Kinds of the protocol."""


@contextlib.contextmanager
def listening(peer: str | None = None) -> Iterator[tuple[int, list[tuple[int, int]]]]:
    """The port of an edge that answers one session, and where it says what it did."""
    ports: list[int] = []
    is_ready, done = threading.Event(), list[tuple[int, int]]()

    def ready(port: int) -> None:
        ports.append(port)
        is_ready.set()

    def serve() -> None:
        done.append(listen(0, "127.0.0.1", peer, seconds=20.0, sessions=1, ready=ready))

    thread = threading.Thread(target=serve)
    thread.start()
    assert is_ready.wait(10.0)
    yield ports[0], done
    thread.join(30.0)
    assert not thread.is_alive()


class Lossy:
    """A relay on loopback that drops packets of known numbers, of each direction."""

    def __init__(self, port: int, up: set[int], down: set[int]) -> None:
        self.drop = {PACKET: up, ANSWER: down}
        self._front = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._front.bind(("127.0.0.1", 0))
        self._back = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._back.connect(("127.0.0.1", port))
        self.port = self._front.getsockname()[1]
        self._ends, self._stop = os.pipe()
        self._thread = threading.Thread(target=self._pass_on)
        self._thread.start()

    def _pass_on(self) -> None:
        client = None
        while True:
            ends = {one.fileno(): one for one in (self._front, self._back)}
            ready = select.select([*ends, self._ends], [], [])[0]
            if self._ends in ready:
                return
            for one in (ends[ready_one] for ready_one in ready):
                data, address = one.recvfrom(65536)
                if one is self._front:
                    client = address
                if data[4] in self.drop and int.from_bytes(data[21:25], "big") in self.drop[data[4]]:
                    continue
                if one is self._front:
                    self._back.send(data)
                elif client is not None:
                    self._front.sendto(data, client)

    def close(self) -> None:
        os.write(self._stop, b"x")
        self._thread.join()
        for one in (self._front, self._back):
            one.close()
        for end in (self._ends, self._stop):
            os.close(end)


def test_what_is_lost_on_which_way_is_known_exactly(tmp_path: Path) -> None:
    up, down = {3, 4, 5, 60, 99}, {10, 11, 70, 98}
    with listening() as (port, done):
        relay = Lossy(port, up, down)
        try:
            found = measure("127.0.0.1", relay.port, count=100, interval=0.001)
        finally:
            relay.close()
    assert found.is_listed
    assert {i for i, arrived in enumerate(found.arrived) if arrived is None} == up
    assert {i for i, returned in enumerate(found.returned) if returned is None} == up | down
    assert done == [(100 - len(up), 0)]
    path = tmp_path / "probe.csv"
    path.write_text("\n".join(rows_of(found)) + "\n")
    measured = read_link(path)
    assert isinstance(measured, Measurement)
    figures = LinkFigures(measured).to_json()
    assert figures["packets"] == 100
    assert figures["uplink"]["loss_rate"]["value"] == pytest.approx(0.05)
    assert figures["downlink"]["loss_rate"]["value"] == pytest.approx(4 / 95)
    assert figures["interval_s"] == pytest.approx(0.001, rel=0.5)
    # Both clocks are one: the delays of both ways are small, and none is negative by more than rounding.
    assert 0.0 <= figures["uplink"]["delay"]["p50_s"] < 0.5
    assert abs(found.offset[0]) < 0.5e9
    trace = read_trace(str(path), "downlink")
    lost = set(np.flatnonzero(trace.lost).tolist())
    assert lost == down | {99}  # its last packet was not sent at all, and is what the one before it was
    assert set(np.flatnonzero(read_trace(str(path), "uplink").lost).tolist()) == up


def test_nobody_but_the_peer_is_answered() -> None:
    with listening(peer="127.0.0.1") as (port, done), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.bind(("127.0.0.2", 0))
        for data in (
            b"",
            b"hello",
            b"AGVP",
            b"AGVP\x01" + bytes(60),
            b"AGVP\x03" + bytes(60),
            b"AGVP\x05" + bytes(1300),
        ):
            stranger.sendto(data, ("127.0.0.1", port))
        assert not select.select([stranger], [], [], 0.2)[0]
        measure("127.0.0.1", port, count=20, interval=0.001)
        assert not select.select([stranger], [], [], 0.0)[0]
    assert done == [(20, 6)]


def test_an_answer_is_never_longer_than_what_it_answers() -> None:
    """So an edge that listens makes no attack on others larger; and a made-up sender gets no session."""
    with listening() as (port, _), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.connect(("127.0.0.1", port))
        hello = b"AGVP\x01" + bytes(8 + 8)
        for length in (21, 33, 64):
            other.send(hello.ljust(length, b"\0"))
            assert select.select([other], [], [], 5.0)[0]
            assert len(other.recv(65536)) <= length
        for kind in (PACKET, 5):  # without the number that was told
            other.send((b"AGVP" + bytes([kind]) + bytes(16)).ljust(1400, b"\0"))
        assert not select.select([other], [], [], 0.2)[0]
        measure("127.0.0.1", port, count=5, interval=0.001, size=SMALLEST)


@pytest.mark.parametrize(
    ("more", "complaint"),
    [({"count": 0}, "1 to 2000000 packets"), ({"interval": 1e-5}, "0.0005 s apart"), ({"size": 5000}, "1400 byte")],
)
def test_rate_and_size_are_bounded(more: dict[str, float], complaint: str) -> None:
    with pytest.raises(ProbeError, match=complaint):
        measure("127.0.0.1", 9, **more)  # type: ignore[arg-type]


# -- two hosts ---------------------------------------------------------------------------------------------------------

Hosts = tuple[list[str], list[str]]
"""Commands' beginnings that run them on the AGV's host and on the edge's."""


def on(host: list[str], *words: str) -> None:
    """Run a command there; the test is skipped, with the reason, where the machine has no such thing."""
    done = subprocess.run([*host, *words], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"{' '.join(words[:6])}: {done.stderr.strip()}")


def cable(host: list[str]) -> str:
    """The device at a host's end of the cable."""
    shown = subprocess.run([*host, "ip", "-o", "link"], capture_output=True, text=True, check=True).stdout
    return next(line.split(": ")[1].split("@")[0] for line in shown.splitlines() if "@" in line)


def lose(host: list[str], kind: int, low: int) -> None:
    """From here on a host gets no messages of a kind with packet numbers that end in the byte `low`."""
    if shutil.which("tc") is None:
        pytest.skip("needs tc")
    device = cable(host)
    on(host, "ip", "link", "add", "nowhere", "type", "veth", "peer", "name", "further")
    on(host, "ip", "link", "set", "nowhere", "up")
    on(host, "tc", "qdisc", "add", "dev", device, "ingress")
    payload = 20 + 8  # behind the headers of IP and UDP
    match = [
        word
        for place, value in ((payload + 4, kind), (payload + 24, low))
        for word in ("match", "u8", hex(value), "0xff", "at", str(place))
    ]
    away = ("action", "mirred", "egress", "redirect", "dev", "nowhere")
    on(host, "tc", "filter", "add", "dev", device, "parent", "ffff:", "protocol", "ip", "u32", *match, *away)


RELAY = """
import heapq, json, select, socket, sys, time
drop, late = json.loads(sys.argv[1]), json.loads(sys.argv[2])
front, back = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
front.bind(("", 47475))
back.connect(("127.0.0.1", 47474))
client, queue, count = None, [], 0
print("ready", flush=True)
while True:
    wait = None if not queue else max(0.0, queue[0][0] - time.monotonic())
    for one in select.select([front, back], [], [], wait)[0]:
        data, address = one.recvfrom(65536)
        client = address if one is front else client
        kind, number = str(data[4]), int.from_bytes(data[21:25], "big")
        if number in drop.get(kind, ()):
            continue
        begin, end, seconds = late.get(kind, (0, 0, 0.0))
        count += 1
        at = time.monotonic() + (seconds if begin <= number < end else 0.0)
        heapq.heappush(queue, (at, count, data, one is front))
    while queue and queue[0][0] <= time.monotonic():
        _, _, data, is_up = heapq.heappop(queue)
        back.send(data) if is_up else front.sendto(data, client)
"""
"""Between the cable and the edge's end: drops messages of a kind by their numbers, and delays those of a range."""


@contextlib.contextmanager
def relay_at(host: list[str], drop: dict[int, list[int]], late: dict[int, tuple[int, int, float]]) -> Iterator[None]:
    relay = subprocess.Popen(
        [*host, sys.executable, "-c", RELAY, json.dumps(drop), json.dumps(late)], stdout=subprocess.PIPE
    )
    try:
        assert relay.stdout is not None
        assert relay.stdout.readline() == b"ready\n"
        yield
    finally:
        relay.terminate()
        relay.communicate()


def probed(hosts: Hosts, path: Path, duration: float, port: int = 47474) -> Measurement:
    """What the command measures from one host to the other."""
    agv, edge = hosts
    cli = [sys.executable, "-m", "agv_analysis.cli", "probe"]
    listener = subprocess.Popen([*edge, *cli, "--listen", "--seconds", "60"], stdout=subprocess.PIPE)
    try:
        assert listener.stdout is not None
        assert b"listening" in listener.stdout.readline()
        words = ("10.213.0.2", "--duration", str(duration), "--interval", "0.002", "--trace", str(path))
        subprocess.run([*agv, *cli, *words, "--port", str(port)], check=True, capture_output=True)
    finally:
        listener.terminate()
        listener.communicate()
    found = read_link(path)
    assert isinstance(found, Measurement)
    return found


def test_between_two_hosts_what_the_kernel_drops_is_known_exactly(two_hosts: Hosts, tmp_path: Path) -> None:
    lose(two_hosts[1], PACKET, 7)
    lose(two_hosts[0], ANSWER, 9)
    found = probed(two_hosts, tmp_path / "link.csv", 1.2)
    assert found.packets == 600
    assert found.uplink is not None
    assert found.downlink is not None
    assert np.flatnonzero(found.uplink.lost).tolist() == [7, 263, 519]
    assert np.flatnonzero(found.downlink.lost).tolist() == [9, 265, 521]
    figures = LinkFigures(found).to_json()
    assert figures["uplink"]["loss_rate"]["value"] == pytest.approx(3 / 600)
    assert figures["downlink"]["loss_rate"]["value"] == pytest.approx(3 / 597)


def test_between_two_hosts_what_a_relay_drops_and_delays_is_known_each_way(two_hosts: Hosts, tmp_path: Path) -> None:
    """Where the kernel has no netem: losses exactly, and a delay of one way is that way's, and at least as long."""
    up, down = [3, 4, 5, 6, 250, 599], [10, 11, 340]
    late = {PACKET: (200, 300, 0.03), ANSWER: (400, 500, 0.02)}
    with relay_at(two_hosts[1], {PACKET: up, ANSWER: down}, late):
        found = probed(two_hosts, tmp_path / "link.csv", 1.2, port=47475)
    assert found.packets == 600
    assert found.uplink is not None
    assert found.downlink is not None
    assert np.flatnonzero(found.uplink.lost).tolist() == up
    assert np.flatnonzero(found.downlink.lost).tolist() == down
    figures = LinkFigures(found).to_json()
    assert figures["uplink"]["loss_rate"]["value"] == pytest.approx(6 / 600)
    assert figures["downlink"]["loss_rate"]["value"] == pytest.approx(3 / 594)
    assert found.uplink.delay is not None
    assert found.downlink.delay is not None
    for delay, other, (begin, end, seconds) in (
        (found.uplink.delay, found.downlink.delay, late[PACKET]),
        (found.downlink.delay, found.uplink.delay, late[ANSWER]),
    ):
        # Whatever else the machine does, none is early, and the fastest ones of the other way are not late.
        assert np.nanmin(delay[begin:end]) > 0.9 * seconds
        assert np.nanmin(other[begin:end]) < 0.5 * seconds


def test_between_two_hosts_with_netem(two_hosts: Hosts, tmp_path: Path) -> None:
    if shutil.which("tc") is None:
        pytest.skip("needs tc")
    agv = two_hosts[0]
    on(agv, "tc", "qdisc", "add", "dev", cable(agv), "root", "netem", "delay", "20ms", "loss", "20%")
    figures = LinkFigures(probed(two_hosts, tmp_path / "link.csv", 4.0)).to_json()
    assert figures["uplink"]["loss_rate"]["value"] == pytest.approx(0.2, abs=0.06)
    assert figures["downlink"]["loss_rate"]["value"] < 0.01
    both = figures["uplink"]["delay"]["p50_s"] + figures["downlink"]["delay"]["p50_s"]
    assert both == pytest.approx(0.02, abs=0.01)


# -- the command -------------------------------------------------------------------------------------------------------


def test_the_command(tmp_path: Path, agv_ncs: AgvNcs) -> None:
    path = tmp_path / "link.csv"
    with listening() as (port, _):
        status, said = agv_ncs(
            "probe", "127.0.0.1", "--port", port, "--duration", "0.1", "--interval", "0.002", "--trace", path
        )  # fmt: skip
    assert status == 0, said
    assert "50 packets, 0 lost on the way up, 0 on the way down" in said
    assert len(path.read_text().splitlines()) == 51
    status, said = agv_ncs("probe")
    assert status == 2
    assert "give either --listen or the HOST that listens" in said
