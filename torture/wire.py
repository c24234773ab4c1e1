"""Messages that no node of a loop would send, on all of its topics: does each node go on, and the run end as asked?"""

from __future__ import annotations

import math
import random
import re
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import rclpy
from rclpy.node import Node
from rclpy.serialization import serialize_message

from agv_analysis.recordings.recording import read_run
from agv_analysis.runtime.recorder_node import TOPICS
from agv_ros.endpoints import LOOP_QOS
from agv_ros.errors import UserError

_ATTACKED = (
    "agv/pose",
    "edge/pose",
    "edge/slot",
    "edge/error",
    "edge/cmd_vel",
    "agv/cmd_vel",
    "agv/slot",
    "/diagnostics",
)
_START_NS, _TS_NS = 1_000_000_000, 5_000_000
_STAMP = struct.Struct("<iI")
_STAMP_AT = 4
"""Where the stamp of a message with a header is: after the encapsulation."""


class Attacked(NamedTuple):
    """What came of a run under attack."""

    sent: int
    by_kind: dict[str, int]
    faults: list[str]
    said: str


def _far_stamp(message: bytes, chance: random.Random) -> bytes:
    sec, nanosec = chance.choice([
        (2**31 - 1, 2**32 - 1), (2**31 - 1, 999_999_999), (-(2**31), 0), (0, 0), (-1, 5), (1, 2**32 - 1),
        divmod(_START_NS + chance.randrange(3000, 10**8) * _TS_NS, 10**9),
        (1, chance.randrange(10**9)),
    ])  # fmt: skip
    return message[:_STAMP_AT] + _STAMP.pack(sec, nanosec) + message[_STAMP_AT + 8 :]


def _past_stamp(message: bytes, chance: random.Random) -> bytes:
    """One of the first steps: outdated by the time that it comes."""
    sec, nanosec = divmod(_START_NS + chance.randrange(1, 5) * _TS_NS, 10**9)
    return message[:_STAMP_AT] + _STAMP.pack(sec, nanosec) + message[_STAMP_AT + 8 :]


def _numbers(message: bytes, chance: random.Random) -> bytes:
    """Numbers that are none, in a message of the far past."""
    value = struct.pack("<d", chance.choice([math.nan, math.inf, -math.inf, 1e308]))
    body = message[20:]
    return _past_stamp(message[:20] + value * (len(body) // 8) + body[: len(body) % 8], chance)


def _cut(message: bytes, chance: random.Random) -> bytes:
    return message[: chance.randrange(4, len(message))]


def _random_bytes(message: bytes, chance: random.Random) -> bytes:
    return message[:4] + chance.randbytes(chance.randrange(0, 500))


def _long_name(message: bytes, chance: random.Random) -> bytes:
    length = chance.choice([10**4, 10**6])
    return _far_stamp(message[:12] + struct.pack("<I", length) + b"a" * (length - 1) + b"\0" + message[16:], chance)


KINDS: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "far stamp": _far_stamp, "past stamp": _past_stamp, "numbers": _numbers, "cut": _cut, "random bytes": _random_bytes,
    "long name": _long_name,
}  # fmt: skip


def attack(seed: int, clock: str, attacks: int, folder: Path, params: str, steps: int = 4000) -> Attacked:
    """Run the params file in processes and send attacks while it runs, 2 ms apart at least."""
    command = [sys.executable, "-m", "agv_analysis.cli", "run", params, "--processes", "--clock", clock]
    command += ["--duration", str(steps * _TS_NS / 1e9), "--bag", str(folder / "bag")]
    chance, context = random.Random(seed), rclpy.Context()
    rclpy.init(context=context)
    attacker = Node("attacker", context=context, use_global_arguments=False, enable_rosout=False)
    runner = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    by_kind = dict.fromkeys(KINDS, 0)
    try:
        sent = 0
        deadline = time.monotonic() + 60.0
        while runner.poll() is None and not _is_recorded(folder / "bag") and time.monotonic() < deadline:
            time.sleep(0.01)  # nodes of another loop would be taken for those of this one while it comes up
        publishers = {topic: attacker.create_publisher(TOPICS[topic], topic, LOOP_QOS) for topic in _ATTACKED}
        while sent < attacks and runner.poll() is None:
            topic, kind = chance.choice(_ATTACKED), chance.choice([*KINDS])
            publishers[topic].publish(KINDS[kind](_sound(TOPICS[topic]), chance))
            by_kind[kind] += 1
            sent += 1
            time.sleep(0.002)
        said, _ = runner.communicate(timeout=300.0)
    finally:
        if runner.poll() is None:
            runner.kill()
            runner.wait()
        attacker.destroy_node()
        context.try_shutdown()
    return Attacked(sent, by_kind, list(_faults(runner.returncode, said, steps, folder / "bag")), said)


def _sound(kind: type) -> bytes:
    """A message of a type, with the header that it has."""
    message: Any = kind()
    if hasattr(message, "header"):
        message.header.frame_id = "map"
    return bytes(serialize_message(message))


def _is_recorded(bag: Path) -> bool:
    return any(file.stat().st_size > 5000 for file in bag.glob("*.mcap"))


def _faults(status: int, said: str, steps: int, bag: Path) -> list[str]:
    found = []
    if "Traceback" in said:
        found.append("said a traceback")
    done = re.search(r"^(\d+) steps", said, re.MULTILINE)
    if done is None or int(done[1]) != steps:
        found.append(f"ended after {done[1] if done else 'no'} steps, with status {status}")
    try:
        run = read_run(bag)
        if len(run) < 0.95 * steps:
            found.append(f"only {len(run)} steps in the bag")
    except UserError as error:
        found.append(f"bag: {error}")
    return found
