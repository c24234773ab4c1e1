"""The recorder: every message of the loop into a rosbag2 directory, as it came over the wire."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import ParameterEvent
from rclpy.duration import Duration, Infinite
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import TimeReference
from trajectory_msgs.msg import MultiDOFJointTrajectory

from agv_analysis.bags.message_definitions import schema_of
from agv_analysis.bags.rosbag2_metadata import TopicInfo
from agv_analysis.bags.writer import NODES_NAME, RESTART, BagWriter
from agv_analysis.runtime.parameter_client_node import ParameterClient
from agv_analysis.runtime.parameters import RecorderParameters
from agv_analysis.scenario import load_scenario, metadata_of
from agv_analysis.version import version
from agv_ros.codec import stamp_of
from agv_ros.counted import counted
from agv_ros.executor import run_node
from agv_ros.messages import PUBLISHED
from agv_ros.node import ENDED, LoopNode
from agv_ros.ros_yaml import dump
from agv_ros.stamps import NS_PER_S, to_nanoseconds

TOPICS: dict[str, type] = {
    "/clock": Clock,
    "agv/pose": PoseStamped,
    "agv/ground_truth": PoseStamped,
    "edge/pose": PoseStamped,
    "edge/slot": TimeReference,
    "edge/age": TimeReference,
    "edge/error": Odometry,
    "edge/reference_pose": PoseStamped,
    "edge/horizon": MultiDOFJointTrajectory,
    "edge/cmd_vel": TwistStamped,
    "edge/plan": MultiDOFJointTrajectory,
    "agv/cmd_vel": TwistStamped,
    "agv/plan": MultiDOFJointTrajectory,
    "agv/slot": TimeReference,
    "/diagnostics": DiagnosticArray,
    "/parameter_events": ParameterEvent,
}
"""What is recorded. The loop's names are relative: a recorder records the loop of its own namespace."""

_FLUSH_PERIOD = 0.08
"""How often [s] messages of a loop in real time are written: a recorder that is killed takes two of them along."""

_DIAGNOSTICS = list(TOPICS).index("/diagnostics")
"""Its number; a fleet's recorders know it under other names."""

_PARAMETER_EVENTS = list(TOPICS).index("/parameter_events")

_POSE = list(TOPICS).index("agv/pose")

PUBLISHERS = {"plant": "agv/pose", "relay": "edge/slot", "error_detector": "edge/error", "controller": "edge/cmd_vel"}
"""The topic by which each node of the loop is known, whatever it is called."""


class RecorderNode(LoopNode[RecorderParameters]):
    """Writes raw messages and holds the count against what the nodes say that they have published."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("recorder", RecorderParameters, **node_options)
        settings = self.settings
        self.summary = ""
        self._published: dict[str, Counter[str]] = {}
        self._published_before: Counter[str] = Counter()
        """By processes of nodes that were started again since."""
        self._again: Counter[str] = Counter()
        self._running: set[str] = set()
        self._ended_ns: dict[str, int] = {}
        """Stamp of the last step of nodes that have ended."""
        self._begun_again: dict[str, list[int]] = {}
        """From which stamp on nodes of the loop have been other processes."""
        agv, edge = self.in_domain(settings.plant_domain_id), self.in_domain(settings.edge_domain_id)
        everywhere = [agv] if edge is agv else [agv, edge]
        one = {topic: [edge] if topic.startswith("edge/") else [agv] for topic in TOPICS}
        sides = [*(one | {"/diagnostics": everywhere, "/parameter_events": everywhere}).values()]
        self._parameters_of = {node: ParameterClient(one[topic][0], topic) for node, topic in self.asked().items()}
        self._newest_ns = 0
        self._first_ns: int | None = None
        """Stamp of the first pose that was recorded."""
        self._names = [self.resolve_topic_name(topic) for topic in TOPICS]
        describe = [
            self._describer(topic, kind, where)
            for topic, kind, where in zip(self._names, TOPICS.values(), sides, strict=True)
        ]
        self._by_stamp = settings.log_time == "stamp"
        self._writer = BagWriter(Path(settings.bag), describe, self.about(), self._by_stamp, settings.fsync)
        self._broken = ""
        """Why the bag cannot be written any more."""
        self._unwritten = 0
        """Messages that came after that."""
        self._now_ns: Callable[[int], int] = (
            (lambda stamp_ns: stamp_ns) if self._by_stamp else (lambda _: time.time_ns())
        )
        for number, (topic, kind) in enumerate(TOPICS.items()):
            for side in sides[number]:
                self.input(kind, topic, self._receiver(number), on=side)
        self.poll(self._ask)
        self.create_timer(_FLUSH_PERIOD, self._flush, clock=self._steady)

    def asked(self) -> dict[str, str]:
        """Nodes whose parameters are asked for, each with a topic that it publishes."""
        return PUBLISHERS

    def about(self) -> dict[str, str]:
        """What is embedded in the bag. Raises UserError."""
        return _about(self.settings.params_file)

    def _receiver(self, number: int) -> Callable[[bytes], None]:
        write, now_ns = self._write, self._now_ns

        def record(data: bytes) -> None:
            stamp_ns = self._newest_ns = max(0, stamp_of(data))  # MCAP knows no time before 0
            write(number, data, now_ns(stamp_ns), stamp_ns)

        def record_diagnostics(data: bytes) -> None:
            record(data)
            self._note(deserialize_message(data, DiagnosticArray))

        def record_change(data: bytes) -> None:
            if self._is_change(deserialize_message(data, ParameterEvent)):
                # It has the time of a clock that is not the loop's, which would put it behind all that follows.
                write(number, data, now_ns(self._newest_ns), self._newest_ns)

        def record_pose(data: bytes) -> None:
            record(data)
            if self._first_ns is None:
                self._first_ns = stamp_of(data)

        special = {_DIAGNOSTICS: record_diagnostics, _PARAMETER_EVENTS: record_change, _POSE: record_pose}
        return special.get(number, record)

    def _write(self, number: int, data: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        if self._broken:
            self._unwritten += 1
            return
        try:
            self._writer.write(number, data, log_time_ns, publish_time_ns)
        except OSError as error:
            self._give_up(error)

    def _flush(self) -> None:
        """Write what has come, if time matters; where a loop is in lockstep, the number of messages does."""
        if self._broken or (self._by_stamp and not self._is_realtime()):
            return
        try:
            self._writer.write_older()
        except OSError as error:
            self._give_up(error)

    def _is_realtime(self) -> bool:
        plant = self._parameters_of.get("plant")
        return plant is not None and (plant.values or {}).get("clock") == "realtime"

    def _give_up(self, error: OSError) -> None:
        """The bag cannot be written any more: end, or only count from now on."""
        self._broken = (
            f"{self.settings.bag}: cannot be written any more: {error.strerror}; what is in it by then can be read"
        )
        self._writer.abandon()
        if self.settings.if_unwritable == "end":
            self.fail(self._broken)
        else:
            self.get_logger().warning(f"{self._broken}; the loop goes on without being recorded")

    def _describer(self, topic: str, kind: type, sides: Sequence[Node]) -> Callable[[], TopicInfo]:
        module = kind.__module__.split(".")
        type_name = f"{module[0]}/{module[1]}/{kind.__name__}"
        schema = schema_of(type_name)  # now, not in the middle of a run in real time

        def describe() -> TopicInfo:
            publishers = [
                info
                for side in sides
                for info in side.get_publishers_info_by_topic(topic)
                if info.topic_type == type_name  # others may publish another type under the same name
            ]
            offered = [_qos(info.qos_profile) for info in publishers]
            distinct = [qos for i, qos in enumerate(offered) if qos not in offered[:i]]
            type_hash = str(publishers[0].topic_type_hash) if publishers else ""
            if topic == self._names[_PARAMETER_EVENTS] and not self._writer.counts[_PARAMETER_EVENTS]:
                distinct = []  # every node publishes it, so it would be in every bag, without any message
            return TopicInfo(topic, type_name, schema, type_hash, distinct)

        return describe

    # -- parameters of the nodes -------------------------------------------------------------------------------------

    def _ask(self) -> bool:
        """Ask the nodes that have appeared; has each said its parameters?"""
        answered = [client.ask() for client in self._parameters_of.values()]
        return all(answered)

    def _ask_again(self, name: str, stamp_ns: int) -> None:
        """A node has been started again, and has made its first report at this stamp: what are its parameters now?"""
        for node, client in self._parameters_of.items():
            if client.name == f"/{name}":
                ended_ns = self._ended_ns.pop(name, None)
                self._begun_again.setdefault(node, []).append(stamp_ns if ended_ns is None else ended_ns + 1)
                client.ask_again()
                self.poll(self._ask)

    def _is_change(self, event: ParameterEvent) -> bool:
        """Did a node of the loop change a parameter? What it declared at its start, it says when it is asked."""
        return bool(event.changed_parameters) and any(
            client.name == event.node for client in self._parameters_of.values()
        )

    def _said(self) -> dict[str, str]:
        """What the nodes said of their parameters, as a params file, and what they are called."""
        answered = {node: client for node, client in self._parameters_of.items() if client.values is not None}
        params = {node: {"ros__parameters": client.values} for node, client in answered.items()}
        said = {"params": dump(params), **{node: client.name for node, client in answered.items()}}
        restarts = [
            (begun_ns, node, values)
            for node, begun in self._begun_again.items()
            for number, begun_ns in enumerate(begun, start=1)
            if (values := self._parameters_of[node].again.get(number)) is not None
        ]
        for i, (begun_ns, node, values) in enumerate(sorted(restarts, key=lambda restart: restart[0]), start=1):
            said |= {
                f"{RESTART}{i}_from": str(begun_ns), f"{RESTART}{i}_params": dump({node: {"ros__parameters": values}}),
            }  # fmt: skip
        return said

    # -- completeness ------------------------------------------------------------------------------------------------

    def _note(self, diagnostics: DiagnosticArray) -> None:
        stamp_ns = diagnostics.header.stamp.sec * NS_PER_S + diagnostics.header.stamp.nanosec
        own = self.get_fully_qualified_name().lstrip("/")
        for status in diagnostics.status:
            # What the recorder rejects, it says; it need not end before itself, nor need others' nodes.
            if status.name == own or status.name.rpartition("/")[0] != own.rpartition("/")[0]:
                continue
            facts = {value.key: value.value for value in status.values}
            counts = {
                key.removeprefix(PUBLISHED): int(value)
                for key, value in facts.items()
                if key.startswith(PUBLISHED) and value.isdecimal()
            }
            if counts:
                before = self._published.get(status.name, Counter())
                goes_on = before and status.name not in self._running and ENDED not in facts
                if goes_on or any(before[topic] > count for topic, count in counts.items()):  # another process
                    self._published_before += before
                    self._again[status.name] += 1
                    self._ask_again(status.name, stamp_ns)
                if ENDED in facts:
                    self._ended_ns[status.name] = stamp_ns
                self._published[status.name] = Counter(counts)
                (self._running.discard if ENDED in facts else self._running.add)(status.name)

    def missing(self) -> dict[str, int]:
        """Messages by topic that nodes say they have published and that are not here."""
        published = sum(self._published.values(), self._published_before)
        recorded = dict(zip(self._names, self._writer.counts, strict=True))
        return {topic: published[topic] - count for topic, count in recorded.items() if published[topic] > count}

    def is_settled(self) -> bool:
        """Is everything here that was published? Only nodes that have ended have said all that they published."""
        return not self._running and (bool(self._broken) or not self.missing())

    def has_all_of(self, nodes: int) -> bool:
        """Is everything here, after this number of nodes has ended? Before, messages may still be on their way."""
        is_said = bool(self._broken) or not any(client.is_waiting for client in self._parameters_of.values())
        return len(self._published) >= nodes and self.is_settled() and is_said

    def _topics_without_messages(self) -> list[str]:
        """Topics of the loop of which nothing has come though others have, and their publishers have been seen."""
        counts = dict(zip(TOPICS, self._writer.counts, strict=True))
        known = {topic: self._parameters_of[node].name for node, topic in self.asked().items()}
        if not any(counts[topic] for topic in known):
            return []
        return [self.resolve_topic_name(topic) for topic, name in known.items() if name and not counts[topic]]

    def _silent_nodes(self) -> list[str]:
        """Nodes of the loop that have been seen, and have said nothing on /diagnostics."""
        seen = [client.name.lstrip("/") for client in self._parameters_of.values() if client.name]
        return [name for name in seen if self._published and name not in self._published]

    def _began_late(self) -> str:
        """What to do, if the first pose that is here is not the loop's first one."""
        return _LATE if self._first_ns is None or self._first_ns > self._start_ns() else ""

    def _start_ns(self) -> int:
        """Stamp of the loop's step 0, as the plant said it."""
        values = self._parameters_of["plant"].values if "plant" in self._parameters_of else None
        return to_nanoseconds((values or {}).get("start_time", self.settings.start_time))

    def close(self) -> None:
        """Finish the bag and say what is in it."""
        if self._broken:
            self.failure = self._broken + f"; {counted(self._unwritten, 'message')} came later" * (self._unwritten > 0)
            return
        missing = self.missing()
        try:
            if any(client.values is not None for client in self._parameters_of.values()):
                self._writer.add_metadata(NODES_NAME, self._said())
            self._writer.close()
        except OSError as error:
            self._give_up(error)
            self.failure = self._broken
            return
        self.summary = f"{sum(self._writer.counts)} messages"
        unheard = self._topics_without_messages()
        if missing:
            lost = ", ".join(f"{count} of {topic}" for topic, count in missing.items())
            self.failure = f"{self.settings.bag}: the recording is not complete, missing: {lost}{self._began_late()}"
        elif unheard:
            self.failure = (
                f"{self.settings.bag}: the recording is not complete, there is not one message of "
                f"{', '.join(unheard)}{_LATE}"
            )
        elif self._running:
            self.summary += f"; these nodes did not say that they ended: {', '.join(sorted(self._running))}"
        elif self._published:
            self.summary += ", everything that was published"
        else:
            self.summary += "; no node of the loop said how many it published"
        if self._again:
            self.summary += f"; started again: {', '.join(sorted(self._again))}"
        if self._silent_nodes():
            self.summary += f"; these nodes said nothing of what they published: {', '.join(self._silent_nodes())}"
        self.get_logger().info(f"{self.settings.bag}: {self.summary}")


_LATE = ": it began after the loop did; start the recorder first, or set wait_for_subscribers to 2 on the loop's nodes"


def _about(params_file: str) -> dict[str, str]:
    """What is embedded in the bag: version, and the run's parameters and seed if they are known. Raises UserError."""
    return metadata_of(load_scenario(params_file)) if params_file else {"version": version()}


def _qos(profile: QoSProfile) -> dict[str, Any]:
    """A QoS profile as rosbag2 writes it down."""
    return {
        "history": profile.history.short_key,
        "depth": profile.depth,
        "reliability": profile.reliability.short_key,
        "durability": profile.durability.short_key,
        "deadline": _duration(profile.deadline),
        "lifespan": _duration(profile.lifespan),
        "liveliness": profile.liveliness.short_key,
        "liveliness_lease_duration": _duration(profile.liveliness_lease_duration),
        "avoid_ros_namespace_conventions": profile.avoid_ros_namespace_conventions,
    }


def _duration(duration: Duration) -> dict[str, int]:
    # rclpy's Infinite is 2^63 - 1 ns; rosbag2 knows the same instant.
    sec, nsec = divmod(Infinite.nanoseconds if duration == Infinite else duration.nanoseconds, 1_000_000_000)
    return {"sec": sec, "nsec": nsec}


def main(args: Sequence[str] | None = None) -> None:
    """Entry point of the executable `recorder`."""
    run_node(RecorderNode, args)


if __name__ == "__main__":
    main()
