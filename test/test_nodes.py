"""Single nodes on real DDS: parameters, bad messages, signals, missing peers, real time."""

from __future__ import annotations

import functools
import gc
import math
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

rclpy = pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import TimeReference
from trajectory_msgs.msg import MultiDOFJointTrajectory

from agv_cloud.controller_node import ControllerNode
from agv_cloud.error_detector_node import ErrorDetectorNode
from agv_plant.plant_node import PlantNode
from agv_plant.relay_node import RelayNode
from agv_plant.vehicle.unicycle import arc_step
from agv_ros.endpoints import LOOP_QOS
from agv_ros.errors import UserError
from agv_ros.executor import EXECUTORS, spin_for
from agv_ros.node import LoopNode
from agv_ros.speeds_codec import SpeedsAhead, encode_speeds

if TYPE_CHECKING:
    from test.conftest import Start

STORE = get_typestore(Stores.ROS2_JAZZY)

NODES: dict[str, type[LoopNode[Any]]] = {
    "agv_plant.plant_node": PlantNode,
    "agv_plant.relay_node": RelayNode,
    "agv_cloud.error_detector_node": ErrorDetectorNode,
    "agv_cloud.controller_node": ControllerNode,
}


class Bench:
    """Nodes under test and a probe beside them, in a context and an executor of their own."""

    def __init__(self, executor: str, domain_id: int | None = None) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain_id)
        self.executor = EXECUTORS[executor](context=self.context)
        self.probe = Node("probe", context=self.context, use_global_arguments=False)
        self.executor.add_node(self.probe)
        self.nodes: list[Node] = [self.probe]

    def add(self, kind: Callable[..., LoopNode[Any]], **parameters: Any) -> Any:
        alone = {"wait_for_subscribers": 0} | parameters
        overrides = [Parameter(name.replace("__", "."), value=value) for name, value in alone.items()]
        node = kind(parameter_overrides=overrides, context=self.context, use_global_arguments=False)
        self.executor.add_node(node)
        self.nodes.append(node)
        return node

    def until(self, condition: Callable[[], bool]) -> None:
        """Run callbacks until the condition holds; a minute is only there so that a hanging test ends."""
        assert spin_for(self.executor, condition, 60.0)

    def until_count(self, messages: list[Any], count: int) -> None:
        """Run callbacks until so many messages are there."""
        self.until(lambda: len(messages) == count)

    def call(self, kind: Any, name: str, request: Any) -> Any:
        client = self.probe.create_client(kind, name)
        self.until(client.service_is_ready)
        future = client.call_async(request)
        self.until(future.done)
        return future.result()

    def publisher(self, kind: Any, topic: str) -> Any:
        publisher = self.probe.create_publisher(kind, topic, LOOP_QOS)
        self.until(lambda: publisher.get_subscription_count() > 0)
        return publisher

    def received(self, kind: Any, topic: str) -> list[Any]:
        messages: list[Any] = []
        self.probe.create_subscription(kind, topic, messages.append, LOOP_QOS)
        self.until(lambda: self.probe.count_publishers(topic) > 0)
        return messages

    def close(self) -> None:
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()
        gc.collect()  # a node that was refused while it was made: its error holds it, and others would still see it
        self.context.try_shutdown()


@pytest.fixture(params=["events", "single"])
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    made = Bench(request.param)
    yield made
    made.close()


@pytest.fixture
def lone_bench() -> Iterator[Bench]:
    made = Bench("single")
    yield made
    made.close()


# -- parameters -------------------------------------------------------------------------------------------------------


def set_parameter(bench: Bench, node: str, name: str, value: Any) -> Any:
    request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
    return bench.call(SetParameters, f"/{node}/set_parameters", request).results[0]


def test_gains_change_while_the_controller_runs(bench: Bench) -> None:
    controller = bench.add(ControllerNode)
    assert set_parameter(bench, "controller", "kx", 7.5).successful
    assert controller.settings.kx == 7.5


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("kx", -1.0, "kx out of range Min: 0.0, Max: 1000000.0"),
        ("kx", math.inf, "kx out of range Min: 0.0, Max: 1000000.0"),
        ("v_max", math.nan, "v_max out of range Min: 0.0, Max: inf, value: nan"),
        ("v_max", 0.0, "controller.v_max must be in (0, inf], got 0.0"),
        ("kx", 25, "DOUBLE"),
        ("ts", 0.01, "read-only"),
    ],
)
def test_a_refused_value_is_refused_with_the_reason_and_changes_nothing(
    bench: Bench, name: str, value: Any, reason: str
) -> None:
    controller = bench.add(ControllerNode)
    before = controller.settings
    result = set_parameter(bench, "controller", name, value)
    assert not result.successful
    assert reason in result.reason
    assert controller.settings == before


def test_loss_parameters_change_while_the_relay_runs(bench: Bench) -> None:
    relay = bench.add(RelayNode, uplink__model="bernoulli")
    assert set_parameter(bench, "relay", "uplink.p", 1.0).successful
    assert not set_parameter(bench, "relay", "uplink.p", 1.5).successful
    poses, slots = bench.publisher(PoseStamped, "agv/pose"), bench.received(TimeReference, "edge/slot")
    for k in range(2):
        poses.publish(pose(k))
    bench.until(lambda: len(slots) == 2)
    assert [slot.source for slot in slots] == ["delivered", "lost"]  # slot 0 never is
    assert relay.settings.uplink.p == 1.0


def test_parameters_are_described_with_unit_and_range(bench: Bench) -> None:
    bench.add(ControllerNode)
    request = DescribeParameters.Request(names=["kx", "v_max"])
    kx, v_max = bench.call(DescribeParameters, "/controller/describe_parameters", request).descriptors
    assert "[1/s]" in kx.description
    assert (kx.floating_point_range[0].from_value, kx.floating_point_range[0].to_value) == (0.0, 1e6)
    assert "(0, inf]" in v_max.additional_constraints


@pytest.mark.parametrize(
    ("kind", "parameters", "names"),
    [
        (PlantNode, {"ts": -0.005}, ["plant.ts", "-0.005", "[1e-06, 10]"]),
        (PlantNode, {"ts": math.nan}, ["plant.ts", "nan"]),
        (PlantNode, {"initial_pose": [0.0, 1.0]}, ["plant.initial_pose", "3 finite numbers"]),
        (RelayNode, {"uplink__model": "carrier_pigeon"}, ["relay.uplink.model", "carrier_pigeon", "gilbert_elliott"]),
        (RelayNode, {"uplink__p": 1.5}, ["relay.uplink.p", "1.5", "[0, 1]"]),
        (ErrorDetectorNode, {"track": "moebius"}, ["error_detector.track", "moebius", "warehouse"]),
        (ErrorDetectorNode, {"track": "csv", "track_file": "/no/such.csv"}, ["/no/such.csv"]),
        (ControllerNode, {"kx": math.inf}, ["controller.kx", "inf"]),
        (ControllerNode, {"kx": 25}, ["controller.kx", "25.0"]),
        (ControllerNode, {"kx": "fast"}, ["controller.kx", "fast"]),
    ],
)
def test_a_wrong_parameter_stops_the_node_from_being_made(
    lone_bench: Bench, kind: type[LoopNode[Any]], parameters: dict[str, Any], names: list[str]
) -> None:
    with pytest.raises(UserError) as refused:
        lone_bench.add(kind, **parameters)
    for name in names:
        assert name in str(refused.value)
    assert "\n" not in str(refused.value)


def test_qos_can_be_overridden(bench: Bench) -> None:
    bench.add(
        ControllerNode,
        **{"qos_overrides.__edge__cmd_vel.publisher.reliability".replace("__", "/"): "best_effort"},
    )
    bench.until(lambda: bench.probe.count_publishers("edge/cmd_vel") == 1)
    info = bench.probe.get_publishers_info_by_topic("edge/cmd_vel")[0]
    assert info.qos_profile.reliability.short_key == "best_effort"
    bench.add(RelayNode)
    bench.until(lambda: bench.probe.count_publishers("edge/pose") == 1)  # another topic of the same process
    info = bench.probe.get_publishers_info_by_topic("edge/pose")[0]
    assert info.qos_profile.reliability.short_key == "reliable"


def test_best_effort_sensors_are_heard_whenever_they_come(bench: Bench) -> None:
    """Odometry as drivers publish it, by SensorDataQoS; before the edge was there, and after it."""
    first = bench.probe.create_publisher(Odometry, "edge/pose", qos_profile_sensor_data)
    parameters: dict[str, Any] = {"trigger": "timer", "ts": 0.02, "track": "line", "pose_type": "odometry"}
    bench.add(ErrorDetectorNode, begin="first_pose", **parameters)
    bench.until(lambda: first.get_subscription_count() == 1)
    errors = bench.received(Odometry, "edge/error")
    odometry = Odometry()
    odometry.header.stamp.sec, odometry.pose.pose.orientation.w = 1, 1.0
    first.publish(odometry)
    bench.until(lambda: len(errors) > 3)
    controller = bench.add(ControllerNode)
    later = bench.probe.create_publisher(Odometry, "edge/error", qos_profile_sensor_data)
    bench.until(lambda: later.get_subscription_count() == 1)
    assert controller.rejected == {}


def test_an_offer_that_does_not_fit_is_said_once_with_the_parameter_that_mends_it(bench: Bench) -> None:
    deadline = {"qos_overrides./edge/error.subscription.deadline": 100_000_000}
    bench.add(ControllerNode, **{name.replace(".", "__"): value for name, value in deadline.items()})
    logged: list[Any] = []
    bench.probe.create_subscription(Log, "/rosout", logged.append, 100)
    bench.probe.create_publisher(Odometry, "edge/error", LOOP_QOS)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    for _ in range(2):
        bench.probe.create_subscription(TwistStamped, "edge/cmd_vel", lambda _: None, latched)

    def said(words: str) -> list[str]:
        return [entry.msg for entry in logged if entry.name == "controller" and words in entry.msg]

    bench.until(lambda: len(said("/edge/error: ")) == 1 and len(said("/edge/cmd_vel: ")) == 1)
    assert said("/edge/error: ")[0].endswith("set the parameter qos_overrides./edge/error.subscription.deadline to 0")
    assert "qos_overrides./edge/cmd_vel.publisher.durability to what it asks for" in said("/edge/cmd_vel: ")[0]


def test_missed_deadlines_are_counted(bench: Bench) -> None:
    deadline = {"qos_overrides./edge/error.subscription.deadline": 20_000_000}
    controller = bench.add(ControllerNode, **{name.replace(".", "__"): value for name, value in deadline.items()})
    often = QoSProfile(depth=1, deadline=Duration(nanoseconds=20_000_000))
    publisher = bench.probe.create_publisher(Odometry, "edge/error", often)
    bench.until(lambda: publisher.get_subscription_count() == 1)
    publisher.publish(Odometry())
    bench.until(lambda: controller._inputs[0].missed_deadlines > 2)


def test_a_policy_that_there_is_not_is_refused(lone_bench: Bench) -> None:
    wrong = {"qos_overrides./edge/error.subscription.reliability": "perhaps"}
    with pytest.raises(UserError, match=r"/edge/error: Unexpected QoS override for policy `reliability`: `perhaps`"):
        lone_bench.add(ControllerNode, **{name.replace(".", "__"): value for name, value in wrong.items()})


# -- messages ---------------------------------------------------------------------------------------------------------


def pose(k: int, x: float = 0.0, y: float = 0.0) -> PoseStamped:
    message = PoseStamped()
    message.header.frame_id = "map"
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(1_000_000_000 + 5_000_000 * k, 1_000_000_000)
    message.pose.position.x, message.pose.position.y = x, y
    message.pose.orientation.w = 1.0
    return message


def rejected(diagnostics: list[Any], node: str, topic: str) -> int:
    """How many messages of a topic the node says that it rejected."""
    counts = [
        int(value.value)
        for message in diagnostics
        for status in message.status
        for value in status.values
        if status.name == node and value.key == f"rejected {topic}"
    ]
    return max(counts, default=0)


def test_a_nan_pose_is_rejected_and_counted_and_the_loop_goes_on(bench: Bench) -> None:
    bench.add(RelayNode)
    bench.add(ErrorDetectorNode, track="line", track_start=[0.0, 0.0, 0.0])
    errors, diagnostics = bench.received(Odometry, "edge/error"), bench.received(DiagnosticArray, "/diagnostics")
    poses = bench.publisher(PoseStamped, "agv/pose")
    bench.until(lambda: bench.probe.count_subscribers("edge/pose") + bench.probe.count_subscribers("edge/slot") == 2)
    poses.publish(pose(0, x=-1.0))
    poses.publish(pose(1, x=math.nan))
    poses.publish(pose(2, x=-3.0))
    bench.until(lambda: len(errors) == 3)
    # The line runs at 1 m/s: 5 mm a step. Step 1 is answered from the pose of step 0, the last good one.
    assert [error.pose.pose.position.x for error in errors] == pytest.approx([1.0, 1.005, 3.01])
    bench.until(lambda: rejected(diagnostics, "error_detector", "edge/pose") == 1)


def test_a_nan_error_is_rejected_by_the_controller(bench: Bench) -> None:
    controller = bench.add(ControllerNode)
    commands = bench.received(TwistStamped, "edge/cmd_vel")
    errors = bench.publisher(Odometry, "edge/error")
    for x in (math.nan, 2.0):
        message = Odometry()
        message.header.stamp.sec = 1
        message.pose.pose.position.x, message.pose.pose.orientation.w = x, 1.0
        errors.publish(message)
    bench.until(lambda: len(commands) == 1)
    assert commands[0].twist.linear.x == 50.0
    assert controller.rejected == {"edge/error": 1}


def test_a_nan_command_is_rejected_and_the_agv_keeps_the_last_good_one(bench: Bench) -> None:
    plant = bench.add(PlantNode, initial_pose=[0.0, 0.0, 0.0], duration=0.02)
    poses = bench.received(PoseStamped, "agv/pose")
    commands, slots = bench.publisher(TwistStamped, "agv/cmd_vel"), bench.publisher(TimeReference, "agv/slot")
    for k, v in enumerate((2.0, math.nan, 1.0)):
        bench.until_count(poses, k + 1)
        command, slot = TwistStamped(), TimeReference()
        command.header.stamp = slot.header.stamp = slot.time_ref = pose(k).header.stamp
        command.twist.linear.x, slot.source = v, "delivered"
        commands.publish(command)
        slots.publish(slot)
    bench.until(lambda: len(poses) == 4)
    assert [message.pose.position.x for message in poses] == pytest.approx([0.0, 0.01, 0.02, 0.025])
    assert plant.rejected == {"agv/cmd_vel": 1}


def test_stamps_off_the_grid_are_rejected(bench: Bench) -> None:
    relay = bench.add(RelayNode)
    slots, poses = bench.received(TimeReference, "edge/slot"), bench.publisher(PoseStamped, "agv/pose")
    wrong = pose(1)
    wrong.header.stamp.nanosec += 1
    poses.publish(wrong)
    poses.publish(pose(2))
    bench.until(lambda: len(slots) == 1)
    assert relay.rejected == {"agv/pose": 1}


def wild(message: Any, sec: int, nanosec: int) -> Any:
    message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
    return message


def test_wild_stamps_are_rejected_and_the_loop_goes_on(bench: Bench) -> None:
    """No stamp that a message can carry ends a node, or makes it take those that follow for outdated."""
    relay, edge = bench.add(RelayNode), bench.add(ErrorDetectorNode, track="line", track_start=[0.0, 0.0, 0.0])
    controller = bench.add(ControllerNode)
    commands = bench.received(TwistStamped, "agv/cmd_vel")
    kinds = {
        "agv/pose": PoseStamped, "edge/pose": PoseStamped, "edge/slot": TimeReference, "edge/error": Odometry,
        "edge/cmd_vel": TwistStamped,
    }  # fmt: skip
    publishers = {topic: bench.publisher(kind, topic) for topic, kind in kinds.items()}
    poses = publishers["agv/pose"]
    for k in range(3):
        poses.publish(pose(k))
    bench.until_count(commands, 3)
    stamps = ((2**31 - 1, 2**32 - 1), (-(2**31), 0), (0, 0), (11, 25_000_000))  # the last is 2005 steps ahead
    for topic, kind in kinds.items():
        for sec, nanosec in stamps:
            publishers[topic].publish(wild(kind(), sec, nanosec))
    bench.until(lambda: relay.rejected["agv/pose"] == edge.rejected["edge/slot"] == len(stamps))
    # The controller, which has no clock, answers what it can; what it answers is rejected in its turn.
    bench.until(lambda: controller.rejected["edge/error"] > 0 and relay.rejected["edge/cmd_vel"] > len(stamps))
    for k in range(3, 6):
        poses.publish(pose(k))
    bench.until_count(commands, 6)


def test_a_parameter_of_no_known_type_does_not_end_a_node(bench: Bench) -> None:
    controller = bench.add(ControllerNode)
    client = bench.probe.create_client(SetParameters, "/controller/set_parameters")
    bench.until(client.service_is_ready)
    request = SetParameters.Request(parameters=[Parameter("kx", value=7.5).to_parameter_msg()])
    request.parameters[0].value.type = 99
    client.call_async(request)
    bench.until(lambda: sum(controller.survived.values()) == 1)
    assert set_parameter(bench, "controller", "kx", 7.5).successful


def test_another_publisher_of_a_node_s_topic_is_named(bench: Bench) -> None:
    bench.add(RelayNode)
    diagnostics = bench.received(DiagnosticArray, "/diagnostics")
    bench.probe.create_publisher(TimeReference, "edge/slot", LOOP_QOS)

    def said() -> set[str]:
        values = (value for message in diagnostics for status in message.status for value in status.values)
        return {value.value for value in values if value.key == "other publishers /edge/slot"}

    bench.until(lambda: said() == {"/probe"})


def test_a_plant_does_not_begin_beside_a_second_controller(bench: Bench) -> None:
    for node in (bench.probe, bench.add(ControllerNode)):
        node.create_publisher(TwistStamped, "edge/cmd_vel", LOOP_QOS)
    plant = bench.add(PlantNode, clock="realtime", wait_for_subscribers=1)
    bench.received(PoseStamped, "agv/pose")
    bench.until(lambda: plant.finished)
    assert plant.failure == "another controller publishes edge/cmd_vel: use another namespace or ROS_DOMAIN_ID"


def test_in_lockstep_an_answer_to_a_later_step_is_rejected(bench: Bench) -> None:
    plant = bench.add(PlantNode, initial_pose=[0.0, 0.0, 0.0], duration=0.01)
    poses = bench.received(PoseStamped, "agv/pose")
    commands, slots = bench.publisher(TwistStamped, "agv/cmd_vel"), bench.publisher(TimeReference, "agv/slot")

    def answer(k: int) -> None:
        command, slot = TwistStamped(), TimeReference()
        command.header.stamp = slot.header.stamp = slot.time_ref = pose(k).header.stamp
        slot.source = "delivered"
        commands.publish(command)
        slots.publish(slot)

    bench.until_count(poses, 1)
    answer(10)
    bench.until(lambda: plant.rejected == {"agv/cmd_vel": 1, "agv/slot": 1})
    for k in range(2):
        bench.until_count(poses, k + 1)
        answer(k)
    bench.until(lambda: plant.finished)
    assert plant.failure == ""


# -- an edge with a clock of its own ----------------------------------------------------------------------------------


def stamp_ns_of(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def on_its_own(bench: Bench, **parameters: Any) -> tuple[Any, Any, list[Any], list[Any]]:
    """An error detector with a timer, where its poses come from, its errors, and the age of what they rest on."""
    detector = bench.add(
        ErrorDetectorNode, trigger="timer", ts=0.02, track="line", track_start=[0.0, 0.0, 0.0], **parameters
    )
    kind = Odometry if parameters.get("pose_type") == "odometry" else PoseStamped
    errors, ages = bench.received(Odometry, "edge/error"), bench.received(TimeReference, "edge/age")
    return detector, bench.publisher(kind, "edge/pose"), errors, ages


def test_without_slots_the_edge_steps_by_its_clock_and_records_the_age_of_its_pose(bench: Bench) -> None:
    detector, poses, errors, ages = on_its_own(bench)
    first = pose(0, x=-1.0)
    poses.publish(first)
    bench.until(lambda: len(errors) > 20 and len(ages) > 20)

    def is_taken() -> bool:
        """Is a later pose at the edge? Its stamp is the time that the edge takes for the AGV's."""
        later = pose(0, x=-2.0)
        later.header.stamp = errors[-1].header.stamp
        poses.publish(later)
        return bool(ages[-1].time_ref != first.header.stamp)

    bench.until(is_taken)
    bench.until(lambda: len(ages) == len(errors))
    stamps = [stamp_ns_of(error.header.stamp) for error in errors]
    assert all((ns - 1_000_000_000) % 20_000_000 == 0 for ns in stamps)
    assert stamps == sorted(set(stamps))
    for error, age in zip(errors, ages, strict=True):
        assert age.header.stamp == error.header.stamp
        assert age.source == "timer"
        k = (stamp_ns_of(error.header.stamp) - 1_000_000_000) // 20_000_000
        held = -1.0 if age.time_ref == first.header.stamp else -2.0
        assert error.pose.pose.position.x == pytest.approx(0.02 * k - held)
    assert float(detector.facts()["oldest pose [s]"]) >= 0.2


def test_a_pose_without_a_stamp_is_refused_and_the_edge_waits_for_one_that_has_one(bench: Bench) -> None:
    detector, poses, errors, _ = on_its_own(bench, begin="first_pose")
    for _ in range(5):
        poses.publish(wild(pose(0, x=100.0), 0, 0))
    bench.until(lambda: detector.rejected == {"edge/pose": 5})
    assert errors == []
    poses.publish(pose(0, x=-1.0))
    bench.until(lambda: len(errors) > 0)
    assert errors[0].pose.pose.position.x == pytest.approx(1.0)


def test_a_stamp_from_the_future_is_counted_and_not_believed(bench: Bench) -> None:
    detector, poses, errors, _ = on_its_own(bench)
    for k in (0, 10**6, 10**7):
        poses.publish(pose(k))
    bench.until(lambda: detector.facts()["stamps in the future"] == "2")
    bench.until(lambda: len(errors) > 5)
    assert stamp_ns_of(errors[-1].header.stamp) < 1_000_000_000 + 5_000_000 * 10**6
    assert detector.facts()["beginnings"] == "1"


def test_odometry_of_a_robot_whose_clock_nobody_knows(bench: Bench) -> None:
    detector, odometry, errors, ages = on_its_own(bench, pose_type="odometry", begin="first_pose")
    message = Odometry()
    message.header.stamp.sec, message.header.stamp.nanosec = 1_700_000_000, 123_456_789
    message.pose.pose.position.x, message.pose.pose.orientation.w = -1.0, 1.0
    odometry.publish(message)
    bench.until(lambda: len(errors) > 3 and len(ages) > 3)
    k = (stamp_ns_of(errors[-1].header.stamp) - 1_700_000_000_123_456_789) // 20_000_000
    assert errors[-1].pose.pose.position.x == pytest.approx(1.0 + 0.02 * k)
    assert detector.failure == ""


def test_a_clock_that_cannot_be_the_run_s_is_said(bench: Bench) -> None:
    detector, poses, _, _ = on_its_own(bench)
    late = pose(0)
    late.header.stamp.sec = 2_100_000_000
    poses.publish(late)
    bench.until(lambda: detector.finished)
    assert "start_time = 1 s: set it, or set error_detector.begin to first_pose" in detector.failure


# -- somebody else's robot ---------------------------------------------------------------------------------------------


class Robot(Node):
    """Stands in for a robot behind diff_drive_controller, with its conventions and a clock that is not ours.

    Odometry in frame `odom` every 100 ms; commands stamped, or not; it halts when the newest is older than 0.5 s by its
    clock, or has come from the future, and takes one without a stamp for one of now. With the type of tf2_msgs, or of
    one in its place, it says on /tf where `base_link` is in `odom`. Source: ros2_controllers, diff_drive_controller
    (Jazzy), parameters cmd_vel_timeout, use_stamped_vel and enable_odom_tf.
    """

    PERIOD = 0.1
    TIMEOUT_NS = 500_000_000
    CLOCK_AHEAD_NS = 3_000_000_000

    def __init__(self, context: Any, is_stamped: bool, tf_type: Any = None) -> None:
        super().__init__("robot", context=context, use_global_arguments=False)
        self.x = self.y = self.theta = 0.0
        self._command = (0, 0.0, 0.0)
        self._moved_ns = self._now_ns()
        self.halts = self.driven = 0
        self._odometry = self.create_publisher(Odometry, "diff_drive_controller/odom", 10)
        self._transforms = None if tf_type is None else self.create_publisher(tf_type, "/tf", 100)
        kind, take = (TwistStamped, self._take_stamped) if is_stamped else (Twist, self._take)
        self.create_subscription(kind, "diff_drive_controller/cmd_vel", take, 10)
        self.create_timer(self.PERIOD, self._move)

    def _now_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds) + self.CLOCK_AHEAD_NS

    def _take_stamped(self, command: TwistStamped) -> None:
        stamp_ns = stamp_ns_of(command.header.stamp) or self._now_ns()
        self._command = (stamp_ns, command.twist.linear.x, command.twist.angular.z)

    def _take(self, command: Twist) -> None:
        self._command = (self._now_ns(), command.linear.x, command.angular.z)

    def _move(self) -> None:
        stamp_ns, v, w = self._command
        if not 0 <= self._now_ns() - stamp_ns <= self.TIMEOUT_NS:
            v = w = 0.0
            self.halts += 1
        else:
            self.driven += 1
        now_ns = self._now_ns()  # it moves on while a busy machine does not call
        elapsed, self._moved_ns = 1e-9 * (now_ns - self._moved_ns), now_ns
        self.x, self.y, self.theta = arc_step(self.x, self.y, self.theta, v, w, elapsed)
        message = Odometry()
        message.header.frame_id, message.child_frame_id = "odom", "base_link"
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(now_ns, 1_000_000_000)
        message.pose.pose.position.x, message.pose.pose.position.y = self.x, self.y
        message.pose.pose.orientation.z = math.sin(0.5 * self.theta)
        message.pose.pose.orientation.w = math.cos(0.5 * self.theta)
        message.twist.twist.linear.x, message.twist.twist.angular.z = v, w
        if self._transforms is not None:
            self._transforms.publish(self._transform(message))
        self._odometry.publish(message)

    def _transform(self, odometry: Odometry) -> bytes:
        """The same on /tf, by another library's tf2_msgs."""
        make = STORE.types
        time = make["builtin_interfaces/msg/Time"](odometry.header.stamp.sec, odometry.header.stamp.nanosec)
        turn = odometry.pose.pose.orientation
        transform = make["geometry_msgs/msg/Transform"](
            translation=make["geometry_msgs/msg/Vector3"](self.x, self.y, 0.0),
            rotation=make["geometry_msgs/msg/Quaternion"](0.0, 0.0, turn.z, turn.w),
        )
        stamped = make["geometry_msgs/msg/TransformStamped"](
            header=make["std_msgs/msg/Header"](time, odometry.header.frame_id),
            child_frame_id=odometry.child_frame_id, transform=transform,
        )  # fmt: skip
        return bytes(STORE.serialize_cdr(make["tf2_msgs/msg/TFMessage"]([stamped]), "tf2_msgs/msg/TFMessage"))


EDGE_OF_A_ROBOT = {"ts": 0.1, "track": "line", "speed": 0.4, "track_start": [0.0, 0.3, 0.0]}
ROBOT_S_TOPICS = ["-r", "edge/pose:=diff_drive_controller/odom", "-r", "edge/cmd_vel:=diff_drive_controller/cmd_vel"]


@pytest.mark.parametrize("through_the_relay", [False, True], ids=["direct", "relay"])
@pytest.mark.parametrize("command_type", ["twist_stamped", "twist"])
def test_the_edge_drives_a_robot_that_is_not_ours_and_it_halts_without_the_edge(
    bench: Bench, command_type: str, through_the_relay: bool
) -> None:
    robot = Robot(bench.context, command_type == "twist_stamped")
    bench.executor.add_node(robot)
    bench.nodes.append(robot)
    remapped = {} if through_the_relay else {"cli_args": ["--ros-args", *ROBOT_S_TOPICS]}
    if through_the_relay:
        to_the_robot = [topic.replace("edge/", "agv/") for topic in ROBOT_S_TOPICS]
        relay = bench.add(
            functools.partial(RelayNode, cli_args=["--ros-args", *to_the_robot]), ts=0.1, stamps="any",
            pose_type="odometry", command_type=command_type, uplink__model="bernoulli", uplink__p=0.2,
            downlink__model="bernoulli", downlink__p=0.2,
        )  # fmt: skip
        command_type = "twist_stamped"
    controller = bench.add(
        functools.partial(ControllerNode, **remapped), ts=0.1, command_type=command_type, kx=2.0, ky=10.0, ktheta=6.0,
        v_max=1.0,
    )  # fmt: skip
    detector = bench.add(
        functools.partial(ErrorDetectorNode, **remapped), trigger="timer", begin="first_pose", pose_type="odometry",
        **EDGE_OF_A_ROBOT,
    )  # fmt: skip
    errors = bench.received(Odometry, "edge/error")
    bench.until(lambda: robot.driven > 10 and abs(robot.y - 0.3) < 0.02)  # it has found the line 0.3 m beside it
    bench.until(lambda: abs(errors[-1].pose.pose.position.x) < 0.1)  # and goes along with the reference
    if through_the_relay:
        assert relay.rejected == {}
        bench.until(lambda: min(relay.uplink.lost, relay.downlink.lost) > 0)
    assert robot.x > 0.0
    assert controller.rejected == detector.rejected == {}
    # The edge's clock minus the robot's, plus the least delay: some 3 s behind.
    assert float(detector.facts()["clock offset [s]"]) >= -3.0
    bench.executor.remove_node(controller)
    halts = robot.halts
    bench.until(lambda: robot.halts > halts + 5)
    stands_at = robot.x
    bench.until(lambda: robot.halts > halts + 10)
    assert robot.x == stands_at


# -- real time --------------------------------------------------------------------------------------------------------


def test_in_real_time_the_agv_stops_without_commands_and_goes_on_when_they_return(bench: Bench) -> None:
    plant = bench.add(
        PlantNode, clock="realtime", ts=0.01, cmd_vel_timeout=0.1, duration=math.inf, initial_pose=[0.0, 0.0, 0.0]
    )
    commands = bench.publisher(TwistStamped, "agv/cmd_vel")
    bench.until(lambda: plant.k > 20)
    assert plant.state.x == 0.0  # it stands still before the first command

    def drive() -> None:
        command = TwistStamped()
        stamp_ns = plant.grid.stamp(plant.k)
        command.header.stamp.sec, command.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        command.twist.linear.x = 1.0
        commands.publish(command)

    drive()
    bench.until(lambda: plant.facts()["stops without command"] == "1")
    stopped_at = plant.state.x
    assert stopped_at == pytest.approx(0.1, abs=0.0201)  # for the 100 ms of the timeout, at 1 m/s
    k = plant.k
    bench.until(lambda: plant.k > k + 20)
    assert plant.state.x == stopped_at
    drive()
    bench.until(lambda: plant.state.x > stopped_at)
    assert int(float(plant.facts()["missed deadlines"])) >= 0
    assert float(plant.facts()["jitter max [s]"]) >= float(plant.facts()["jitter p50 [s]"]) >= 0.0


def test_in_real_time_the_agv_plays_its_plan_and_then_stands_still(bench: Bench) -> None:
    plant = bench.add(
        PlantNode, clock="realtime", ts=0.01, cmd_vel_timeout=10.0, duration=math.inf, initial_pose=[0.0, 0.0, 0.0],
        plan_steps=19, downlink_policy="buffer",
    )  # fmt: skip
    plans = bench.publisher(MultiDOFJointTrajectory, "agv/plan")
    bench.until(lambda: plant.k > 20)

    def is_driving() -> bool:
        """On a busy machine a plan may be over before it is heard: then another one."""
        plan = SpeedsAhead(plant.grid.stamp(plant.k), tuple((1.0 + step, 0.0) for step in range(20)))
        plans.publish(encode_speeds(plan, plant.grid.ts_ns, "base_link"))
        return bool(plant.state.x > 0.0)

    bench.until(is_driving)

    def stands() -> bool:
        """Is the newest plan over, and with it the AGV's motion?"""
        x, k = plant.state.x, plant.k
        bench.until(lambda: plant.k > k + 30)
        return bool(plant.state.x == x)

    bench.until(stands)
    x, k = plant.state.x, plant.k
    bench.until(lambda: plant.k > k + 30)
    assert plant.state.x == x > 0.0


# -- processes --------------------------------------------------------------------------------------------------------


@pytest.fixture
def heeded_hangup() -> Iterator[None]:
    """Processes that a test starts heed SIGHUP, even where the tests themselves run under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("heeded_hangup")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
@pytest.mark.parametrize("module", [*NODES, "agv_analysis.runtime.recorder_node"])
def test_a_waiting_node_ends_cleanly_on_signals(
    start: Start, lone_bench: Bench, tmp_path: Path, module: str, number: int
) -> None:
    parameters = ["-p", "answer_timeout:=60.0", "-p", "wait_for_subscribers:=5", "-p", f"bag:={tmp_path / 'bag'}"]
    node = start(module, "--ros-args", *parameters)
    lone_bench.until(lambda: lone_bench.probe.count_publishers("/diagnostics") == 1)
    node.process.send_signal(number)
    status, said = node.end()
    assert "Traceback" not in said
    if module == "agv_plant.plant_node":  # its run was to have a length
        name = signal.Signals(number).name
        assert (status, said.splitlines()[-1]) == (1, f"plant was stopped by {name} at step 0 of 20000")
    else:
        assert status == 0


def test_lockstep_names_the_missing_peer(start: Start, two_domains: tuple[int, int]) -> None:
    """Three loops, each in a domain of its own, wait at the same time."""
    topics = {"relay": "edge/slot", "error_detector": "edge/error"}
    waiting = {}
    for domain, running, silent in (
        (None, (), "relay"),
        (two_domains[0], ("relay",), "error_detector"),
        (two_domains[1], ("relay", "error_detector"), "controller"),
    ):
        env = os.environ | ({} if domain is None else {"ROS_DOMAIN_ID": str(domain)})
        onlooker = Bench("events", domain)
        for name in running:
            start(next(module for module in NODES if name in module), env=env)
            onlooker.until(functools.partial(onlooker.probe.count_publishers, topics[name]))
        onlooker.close()
        waiting[silent] = start("agv_plant.plant_node", "--ros-args", "-p", "start_timeout:=4.0", env=env)
    for silent, plant in waiting.items():
        status, said = plant.end()
        assert status == 1
        assert said.splitlines()[-1] == (
            "the loop has not begun within 4 s: /agv/pose has fewer listeners than it waits for (1): "
            f"is the {silent} running?"
        )
        assert "Traceback" not in said


def test_nodes_that_are_started_again_go_on_and_the_recording_tells(start: Start, tmp_path: Path) -> None:
    from agv_analysis.recordings.recording import read_run

    params = tmp_path / "params.yaml"
    params.write_text("plant: {ros__parameters: {duration: 20.0, answer_timeout: 60.0}}")
    arguments = ["--ros-args", "--params-file", str(params), "-p", "wait_for_subscribers:=2"]
    bag = ["-p", f"bag:={tmp_path / 'bag'}", "-p", f"params_file:={params}", "-p", "stop_timeout:=30.0"]
    recorder = start("agv_analysis.runtime.recorder_node", *arguments, *bag, "-p", "log_time:=stamp")
    modules = {kind.rpartition(".")[2].removesuffix("_node"): kind for kind in NODES}
    running = {node: start(module, *arguments) for node, module in modules.items()}
    again = {"controller": 600, "error_detector": 1800, "relay": 3000}
    for name, k in again.items():
        running["plant"].wait_for(f"step {k} of")
        running[name].process.send_signal(signal.SIGTERM)
        assert running[name].end()[0] == 0
        assert running["plant"].process.poll() is None  # a node that is stopped leaves the loop, and does not end it
        running[name] = start(modules[name], *arguments)
    status, said = running["plant"].end(120.0)
    assert (status, "Traceback" in said) == (0, False)
    for node in (*(running[other] for other in running if other != "plant"), recorder):
        node.process.send_signal(signal.SIGTERM)
        status, said = node.end()
        assert (status, "Traceback" in said) == (0, False)
    assert "started again: controller, error_detector, relay" in said
    run = read_run(tmp_path / "bag")
    assert len(run) == 4000
    assert abs(run.reference[-1, 1] - run.pose[-1, 1]) < 0.01
    notes = sorted(note for note in run.notes if "was started again" in note)
    assert [note.partition(" ")[0] for note in notes] == sorted(again)


@pytest.mark.parametrize(("name", "topic"), [("error_detector", "edge/error"), ("relay", "edge/slot")])
def test_a_node_that_is_started_again_in_an_outage_goes_on_with_the_pose_before_it(
    start: Start, lone_bench: Bench, name: str, topic: str
) -> None:
    """All is lost from step 500 on, so nothing but that pose can be what the answers rest on."""
    lost = ["-p", "uplink.model:=burst", "-p", "uplink.start_step:=500", "-p", "uplink.n:=1000000"]
    arguments = {"relay": lost, "error_detector": ["-p", "policy:=align"], "controller": []}
    modules = {kind.rpartition(".")[2].removesuffix("_node"): kind for kind in NODES}
    running = {node: start(modules[node], "--ros-args", *settings) for node, settings in arguments.items()}
    for published in ("edge/slot", "edge/error", "edge/cmd_vel"):
        lone_bench.until(functools.partial(lone_bench.probe.count_publishers, published))
    plant = start("agv_plant.plant_node", "--ros-args", "-p", "duration:=.inf", "-p", "answer_timeout:=60.0")
    plant.wait_for("step 2000 of")
    running[name].process.send_signal(signal.SIGTERM)
    assert running[name].end()[0] == 0
    answers: list[Any] = []  # the plant waits, so none comes before the node is there again
    kind = Odometry if topic == "edge/error" else TimeReference
    lone_bench.probe.create_subscription(kind, topic, answers.append, LOOP_QOS)
    start(modules[name], "--ros-args", *arguments[name])
    lone_bench.until(lambda: len(answers) > 100)
    plant.process.send_signal(signal.SIGTERM)
    status, said = plant.end()
    assert (status, "Traceback" in said) == (0, False)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("-p", "kx:=25"), "controller.kx is a double, got the integer 25: write 25.0"),
        (("--params-file", "/no/such.yaml"), "/no/such.yaml: cannot be read: No such file or directory"),
    ],
)
def test_a_node_that_cannot_start_says_so_in_one_line_and_on_rosout(
    start: Start, lone_bench: Bench, arguments: tuple[str, ...], said: str
) -> None:
    logged: list[Any] = []
    lone_bench.probe.create_subscription(Log, "/rosout", logged.append, 10)
    node = start("agv_cloud.controller_node", "--ros-args", *arguments)
    lone_bench.until(lambda: any((entry.name, entry.msg) == ("controller", said) for entry in logged))
    status, output = node.end()
    assert (status, output.splitlines()) == (1, [said])


def test_help_names_the_topics_and_parameters_that_nodes_have(bench: Bench) -> None:
    from agv_analysis.runtime.executables import NODE_MODULES
    from agv_analysis.runtime.node_help import ABOUT, NODE_SCHEMAS, help_text
    from agv_ros.parameters import parameters_of

    assert ABOUT.keys() == NODE_SCHEMAS.keys() == NODE_MODULES.keys()
    for kind in NODES.values():
        node = bench.add(kind)
        about, of_node = ABOUT[node.get_name()], (node.get_name(), node.get_namespace())
        for topics, find in (
            (about.hears, node.get_subscriber_names_and_types_by_node),
            (about.publishes, node.get_publisher_names_and_types_by_node),
        ):
            found = {f"{name} {kinds[0]}" for name, kinds in find(*of_node)}
            assert {f"/{topic.lstrip('/')}" for topic in topics} <= found
        text = help_text(node.get_name())
        assert [name for name in parameters_of(NODE_SCHEMAS[node.get_name()]) if f"  {name} " not in text] == []


def test_help_starts_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    from agv_analysis.runtime.executables import run_node_of

    run_node_of("plant", ["--help"])
    said = capsys.readouterr().out
    assert said.startswith("plant: The AGV")
    assert "cmd_vel_timeout [s] = 0.5" in said


def test_a_node_that_waits_says_for_whom(lone_bench: Bench) -> None:
    """A recorder alone is not a listener for whom a loop begins; any other node is."""
    controller = lone_bench.add(ControllerNode, wait_for_subscribers=1)
    (output,) = (one for one in controller.outputs if one.topic == "/edge/cmd_vel")
    recorder = Node("recorder", context=lone_bench.context, use_global_arguments=False)
    lone_bench.nodes.append(recorder)
    recorder.create_subscription(TwistStamped, "edge/cmd_vel", lambda _: None, LOOP_QOS)
    lone_bench.until(lambda: controller.count_subscribers("edge/cmd_vel") == 1)
    assert not output.is_heard(1)
    assert controller.count_subscribers("edge/error") == 0
    lone_bench.probe.create_subscription(TwistStamped, "edge/cmd_vel", lambda _: None, LOOP_QOS)
    lone_bench.until(lambda: controller.count_subscribers("edge/error") == 1)
    assert output.is_heard(1)
