"""The link emulator on real DDS: topics of any type, with the channel's very losses."""

from __future__ import annotations

import importlib
import re
import shlex
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

rclpy = pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist
from nav_msgs.msg import OccupancyGrid, Odometry
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image, LaserScan, TimeReference

from agv_plant.emulator_parameters import LinkEmulatorParameters
from agv_plant.link_emulator_node import LinkEmulatorNode
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import losses
from agv_ros.codec import decode_slot
from agv_ros.executor import EXECUTORS, spin_for
from agv_ros.messages import facts_in
from agv_ros.parameters import ParameterError, build

SENSOR = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=1000)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
COUNT = 200


class Radio:
    """An emulator and, around it, a robot and an edge in one node, or in one for each domain."""

    def __init__(self, domains: tuple[int, int] | None = None, **parameters: Any) -> None:
        ids = (None, None) if domains is None else domains
        self.contexts = [rclpy.Context() for _ in set(ids)]
        for context, domain in zip(self.contexts, dict.fromkeys(ids), strict=True):
            rclpy.init(context=context, domain_id=domain)
        nodes = [Node(f"side{i}", context=c, use_global_arguments=False) for i, c in enumerate(self.contexts)]
        self.robot, self.edge = nodes[0], nodes[-1]
        if domains is not None:
            parameters |= {"plant_domain_id": domains[0], "edge_domain_id": domains[1]}
        overrides = [Parameter(name.replace("__", "."), value=value) for name, value in parameters.items()]
        self.emulator = LinkEmulatorNode(
            parameter_overrides=overrides, context=self.contexts[0], use_global_arguments=False
        )
        self._executors = [EXECUTORS["single"](context=context) for context in self.contexts]
        for node in (*nodes, self.emulator, *self.emulator.sides):
            executor = next((e for e in self._executors if e.context is node.context), None)
            if executor is None:  # the emulator's own participant in the other domain
                executor = EXECUTORS["single"](context=node.context)
                self._executors.append(executor)
            executor.add_node(node)
        self._nodes = nodes

    def until(self, condition: Callable[[], bool], found: Callable[[], object] = lambda: "") -> None:
        """Run callbacks until the condition holds; a minute is only there so that a hanging test ends, with `found`."""
        deadline = time.monotonic() + 60.0
        while not condition():
            assert time.monotonic() < deadline, (found(), self.emulator.facts(), self.emulator.survived)
            for executor in self._executors:
                spin_for(executor, condition, 0.01 if len(self._executors) > 1 else 1.0)

    def publisher(self, kind: type, topic: str, qos: QoSProfile, on: Node | None = None) -> Any:
        """A publisher that the emulator hears."""
        publisher = (on or self.robot).create_publisher(kind, topic, qos)

        def is_connected() -> bool:
            nodes = (self.emulator, *self.emulator.sides)
            heard = [one for node in nodes for one in node.subscriptions if one.topic_name == publisher.topic_name]
            is_known = any(one.get_publisher_count() for one in heard)
            return is_known and publisher.get_subscription_count() > 0  # each of the other

        self.until(is_connected)
        return publisher

    def received(self, kind: type, topic: str, qos: QoSProfile, on: Node | None = None) -> list[bytes]:
        """What comes, serialised; once the emulator publishes it to this subscription."""
        found: list[bytes] = []
        where = on or self.edge
        subscription = where.create_subscription(kind, topic, found.append, qos, raw=True)
        name = where.resolve_topic_name(topic)

        def is_connected() -> bool:
            publishers = [one for node in (self.emulator, *self.emulator.sides) for one in node.publishers]
            is_known = any(one.topic_name == name and one.get_subscription_count() for one in publishers)
            return is_known and subscription.get_publisher_count() > 0  # each of the other

        self.until(is_connected)
        return found

    def close(self) -> None:
        for executor in self._executors:
            executor.shutdown()
        for node in (*self._nodes, self.emulator):
            node.destroy_node()
        for context in self.contexts:
            context.try_shutdown()


Make = Callable[..., Radio]


@pytest.fixture
def radio() -> Iterator[Make]:
    made: list[Radio] = []

    def make(*arguments: Any, **parameters: Any) -> Radio:
        made.append(Radio(*arguments, **parameters))
        return made[-1]

    yield make
    for one in made:
        one.close()


def scan(k: int) -> LaserScan:
    message = LaserScan()
    message.header.stamp.sec, message.ranges = 7, [float(k), 1.0, 2.0]
    return message


def lost_slots(count: int, stream: str = "uplink", **channel: Any) -> list[int]:
    """Messages 0 .. count - 1 that the channel loses; the first one takes slot 1."""
    found = losses(ChannelParameters(**channel), 1, stream, count + 1)
    return [k for k in range(count) if found[k + 1]]


GILBERT: dict[str, Any] = {"model": "gilbert_elliott", "p": 0.1, "r": 0.3}


def test_a_best_effort_scan_and_a_twist_meet_the_very_losses_of_their_channels(radio: Make) -> None:
    """Types that this package does not know; bytes as they were; verdicts, diagnostics and changes at run time."""
    made = radio(
        uplink__topics=["/scan"], downlink__topics=["/cmd_vel:=/robot/cmd_vel"], downlink__model="burst", downlink__n=1,
        **{f"uplink__{name}": value for name, value in GILBERT.items()},
    )  # fmt: skip
    scans = made.publisher(LaserScan, "/scan", SENSOR)  # the emulator was there before it
    twists = made.publisher(Twist, "/cmd_vel", RELIABLE, made.edge)
    came, commands = made.received(LaserScan, "/edge/scan", SENSOR), made.received(Twist, "/robot/cmd_vel", RELIABLE)
    verdicts = made.received(TimeReference, "uplink/verdict", RELIABLE)
    (info,) = made.edge.get_publishers_info_by_topic("/edge/scan")
    assert info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    made.until(lambda: bool(made.emulator.topics[0]._are_verdicts_heard))
    sent = [serialize_message(scan(k)) for k in range(COUNT)]
    for k in range(COUNT):
        scans.publish(sent[k])
        made.until(lambda k=k: len(verdicts) > k)  # type: ignore[misc]
    lost = lost_slots(COUNT, **GILBERT)
    assert 20 < len(lost) < 100
    made.until(lambda: len(came) == COUNT - len(lost))
    assert [bytes(data).rstrip(b"\0") for data in came] == [
        data.rstrip(b"\0") for k, data in enumerate(sent) if k not in lost
    ]
    slots = [decode_slot(bytes(data)) for data in verdicts]
    assert [k for k, slot in enumerate(slots) if slot.outcome == "lost"] == lost
    assert {facts_in(slot.note)["topic"] for slot in slots} == {"/scan"}
    assert facts_in(slots[lost[0]].note)["cause"] == "gilbert_elliott"
    assert [slot.freshest_ns == 0 for slot in slots] == [k in lost for k in range(COUNT)]
    for k in range(10):
        twists.publish(Twist())
        made.until(lambda k=k: made.emulator.topics[1].sent == k + 1)  # type: ignore[misc]
    made.until(lambda: len(commands) == 5)
    facts = made.emulator.facts()
    assert (facts["uplink lost"], facts["downlink lost"]) == (str(len(lost)), "5")
    assert (facts["/scan sent"], facts["/scan sent [byte]"]) == (str(COUNT), str(sum(map(len, sent))))
    request = SetParameters.Request(parameters=[Parameter("downlink.n", value=0).to_parameter_msg()])
    client = made.edge.create_client(SetParameters, "/link_emulator/set_parameters")
    made.until(client.service_is_ready)
    future = client.call_async(request)
    made.until(future.done)
    assert future.result().results[0].successful
    for _ in range(10):
        twists.publish(Twist())
    made.until(lambda: len(commands) == 15)


@pytest.mark.parametrize("one_fate", [True, False])
def test_topics_of_one_radio_share_its_slots_and_independent_ones_have_their_own(radio: Make, one_fate: bool) -> None:
    channel = {f"uplink__{name}": value for name, value in GILBERT.items()}
    made = radio(uplink__topics=["/scan", "odom"], uplink__one_fate=one_fate, **channel)
    publishers = [made.publisher(LaserScan, "/scan", SENSOR), made.publisher(Odometry, "odom", RELIABLE)]
    verdicts = made.received(TimeReference, "uplink/verdict", RELIABLE)
    made.until(lambda: bool(made.emulator.topics[0]._are_verdicts_heard))
    for k in range(60):
        publishers[k % 2].publish((LaserScan, Odometry)[k % 2]())
        made.until(lambda k=k: len(verdicts) > k)  # type: ignore[misc]
    found = [decode_slot(bytes(data)).outcome == "lost" for data in verdicts]
    if one_fate:
        assert [k for k, lost in enumerate(found) if lost] == lost_slots(60, **GILBERT)
        return
    for i, name in enumerate(("/scan", "odom")):
        own = lost_slots(30, f"uplink{name}", **GILBERT)
        assert [k for k, lost in enumerate(found[i::2]) if lost] == own


def test_latched_maps_are_state_and_cross_without_loss(radio: Make) -> None:
    made = radio(uplink__topics=["/map"], uplink__model="bernoulli", uplink__p=1.0)
    publisher = made.publisher(OccupancyGrid, "/map", LATCHED)
    publisher.publish(OccupancyGrid())
    made.until(lambda: made.emulator.topics[0].sent == 1)
    assert len(made.received(OccupancyGrid, "/edge/map", LATCHED)) <= 1
    late = made.received(OccupancyGrid, "/edge/map", LATCHED)
    made.until(lambda: len(late) == 1)


def test_a_best_effort_publisher_that_comes_later_is_heard_as_well(radio: Make) -> None:
    made = radio(uplink__topics=["/scan"])
    made.publisher(LaserScan, "/scan", RELIABLE)
    came = made.received(LaserScan, "/edge/scan", SENSOR)
    made.publisher(LaserScan, "/scan", SENSOR).publish(LaserScan())
    made.until(lambda: len(came) == 1)


def test_late_messages_come_in_the_order_of_their_instants_and_twice(radio: Make) -> None:
    made = radio(uplink__topics=["/scan"], uplink__delay=0.05, uplink__jitter=0.05, uplink__duplicate=1.0)
    scans, came = made.publisher(LaserScan, "/scan", RELIABLE), made.received(LaserScan, "/edge/scan", RELIABLE)
    verdicts = made.received(TimeReference, "uplink/verdict", RELIABLE)
    made.until(lambda: bool(made.emulator.topics[0]._are_verdicts_heard))
    for k in range(20):
        scans.publish(scan(k))
    made.until(lambda: len(came) == 40)
    assert made.emulator.is_settled()
    numbers = [rclpy.serialization.deserialize_message(bytes(data), LaserScan).ranges[0] for data in came]
    assert sorted(numbers) == sorted(2 * [float(k) for k in range(20)])
    assert numbers != sorted(numbers)  # sent at once, they overtake each other
    assert made.emulator.facts()["uplink duplicated"] == "20"
    waits = [slot.freshest_ns - slot.stamp_ns for slot in (decode_slot(bytes(data)) for data in verdicts)]
    assert all(0 <= ns <= 100_000_000 for ns in waits)


def test_two_domains_and_a_fleet_s_share_of_the_radio(radio: Make, two_domains: tuple[int, int]) -> None:
    """Names stay as they are, and nothing but the emulator joins the domains."""
    channel: dict[str, Any] = {"model": "shared", "vehicles": 3, "vehicle": 1, "blocks": 1}
    made = radio(two_domains, uplink__topics=["/image"], **{f"uplink__{name}": v for name, v in channel.items()})
    images, came = made.publisher(Image, "/image", RELIABLE), made.received(Image, "/image", RELIABLE)
    for k in range(30):
        images.publish(Image(data=bytes(1000)))
        made.until(lambda k=k: made.emulator.topics[0].sent == k + 1)  # type: ignore[misc]
    delivered = 30 - len(lost_slots(30, **channel))
    made.until(lambda: len(came) >= delivered, lambda: len(came))
    assert len(came) == delivered
    assert 15 < len(lost_slots(30, **channel)) < 25


def test_slots_by_period_are_of_time(radio: Make) -> None:
    """In the first slot, which lasts a minute, nothing is lost, however many messages come."""
    made = radio(
        uplink__topics=["/scan"], uplink__model="burst", uplink__n=5, uplink__start_step=2, uplink__period=60.0
    )
    scans, came = made.publisher(LaserScan, "/scan", RELIABLE), made.received(LaserScan, "/edge/scan", RELIABLE)
    for _ in range(20):
        scans.publish(LaserScan())
    made.until(lambda: len(came) == 20)


def test_a_type_that_is_not_installed_is_said_once_and_the_rest_crosses(
    radio: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = importlib.import_module

    def without_sensors(name: str, package: str | None = None) -> Any:
        if name == "sensor_msgs.msg":
            raise ImportError(name)
        return whole(name, package)

    made = radio(uplink__topics=["/scan", "/odom"])
    diagnostics: list[Any] = []
    made.edge.create_subscription(DiagnosticArray, "/diagnostics", diagnostics.append, RELIABLE)
    monkeypatch.setattr(importlib, "import_module", without_sensors)
    made.robot.create_publisher(LaserScan, "/scan", SENSOR)
    odometry, came = made.publisher(Odometry, "/odom", RELIABLE), made.received(Odometry, "/edge/odom", RELIABLE)
    odometry.publish(Odometry())
    made.until(lambda: len(came) == 1)
    made.until(lambda: "/scan does not cross" in {v.key for m in diagnostics for s in m.status for v in s.values})
    reason = made.emulator.facts()["/scan does not cross"]
    assert reason == (
        "the type sensor_msgs/msg/LaserScan is not installed here: install the package sensor_msgs, and source its "
        "workspace"
    )


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"uplink.topics": ("/a:=/a",)}, "uplink.topics: /a is called the same on both sides"),
        ({"uplink.topics": ("/a:=/b",), "downlink.topics": ("/b:=/c",)}, "/b would cross the link forever"),
        ({"uplink.topics": ("/a b",)}, "topics holds '/a b'"),
        ({"uplink.topics": ()}, "uplink.topics is a list of one or more strings"),
        ({"uplink.topics": ("/a",), "uplink.schedule": "20: p=0.1"}, "set its period"),
        ({"uplink.topics": ("/a",), "uplink.model": "rayleigh"}, "pose_topic is empty"),
    ],
)
def test_what_cannot_be_meant_is_refused(values: dict[str, Any], reason: str) -> None:
    with pytest.raises(ParameterError) as refused:
        build(LinkEmulatorParameters, values, "link_emulator")
    assert reason in str(refused.value)


def test_names_behind_the_radio() -> None:
    made = build(LinkEmulatorParameters, {"uplink.topics": ("/scan", "odom", "/a:=/b"), "downlink.topics": ("/cmd",)})
    assert made.uplink.ways("uplink", False) == [("/scan", "/edge/scan"), ("odom", "edge/odom"), ("/a", "/b")]
    assert made.downlink.ways("downlink", False) == [("/cmd", "/agv/cmd")]
    assert made.uplink.ways("uplink", True) == [("/scan", "/scan"), ("odom", "odom"), ("/a", "/b")]


def test_without_any_topic_it_says_how_to_name_some(start: Callable[..., Any], tmp_path: Path) -> None:
    status, said = start("agv_plant.link_emulator_node").end()
    assert status == 1
    assert said.splitlines()[-1].startswith("no topic crosses the link: name some, as in -p uplink.topics:=[/scan]")


def test_the_commands_of_the_page_start_an_emulator() -> None:
    """Each as a shell and ROS read it; their quotes are easily wrong."""
    page = (Path(__file__).parents[2] / "docs/link_emulator.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^    ros2 run agv_ncs link_emulator ((?:.*\\\n)*.*)$", page, re.MULTILINE)
    assert len(blocks) == 3
    for block in blocks:
        words = shlex.split(block.replace("\\\n", " "))
        context = rclpy.Context()
        rclpy.init(args=words, context=context)
        node = LinkEmulatorNode(context=context)
        crossing = [(topic.heard, topic.called) for topic in node.topics]
        node.destroy_node()
        context.try_shutdown()
        assert crossing[0] in (("/scan", "/edge/scan"), ("/camera/image_raw", "/edge/camera/image_raw"))
        assert len(crossing) == 1 or crossing[-1] == ("/edge/cmd_vel", "/cmd_vel")


def test_a_trace_with_times_needs_slots_that_have_a_length(radio: Make, tmp_path: Path) -> None:
    trace = tmp_path / "trace.csv"
    trace.write_text("time,lost\n0.0,0\n0.1,1\n")
    with pytest.raises(ParameterError, match=r"set uplink\.period"):
        radio(uplink__topics=["/scan"], uplink__model="trace", uplink__trace_file=str(trace))
