"""Both links of a recorded run on DDS: a correlated downlink, and what the relay says of them in its diagnostics."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from agv_analysis.simulation.single import simulate
from agv_plant.radio.channel import losses

if TYPE_CHECKING:
    from test.conftest import Drive


def last_words(bag: Path, node: str) -> dict[str, str]:
    """The last diagnostics of a node in a bag."""
    found: dict[str, str] = {}
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        connections = [c for c in reader.connections if c.topic == "/diagnostics"]
        for connection, _, data in reader.messages(connections):
            (status,) = reader.deserialize(data, connection.msgtype).status  # type: ignore[attr-defined]
            if status.name == node:
                found = {value.key: value.value for value in status.values}
    return found


def test_nodes_lose_on_a_correlated_downlink_what_the_simulation_loses(drive: Drive, tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    run = drive(
        "relay.uplink.model=gilbert_elliott", "relay.uplink.p=0.05", "relay.uplink.r=0.2",
        "relay.downlink.model=gilbert_elliott", "relay.downlink.p=0.05", "relay.downlink.r=0.2",
        "relay.downlink.correlation=0.9", "plant.duration=5.0", bag=tmp_path / "bag",
    )  # fmt: skip
    relay = run.scenario.relay
    assert (run.downlink_lost == losses(relay.downlink, relay.seed, "downlink", len(run))).all()
    simulated = simulate(run.scenario)
    assert (simulated.downlink_lost == run.downlink_lost).all()
    assert abs(simulated.pose - run.pose).max() < 1e-9

    said = last_words(tmp_path / "bag", "relay")
    for link, lost in (("uplink", run.lost), ("downlink", run.downlink_lost)):
        outages = [sum(1 for _ in group) for value, group in groupby(lost.tolist()) if value]
        assert said[f"{link} sent"] == str(len(run))
        assert said[f"{link} lost"] == str(lost.sum())
        assert said[f"{link} loss rate"] == f"{lost.mean():.6f}"
        assert said[f"{link} longest outage [slots]"] == str(max(outages))


def test_a_parameter_changed_at_run_time_is_in_the_diagnostics() -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node
    from rclpy.parameter import Parameter

    from agv_plant.relay_node import RelayNode
    from agv_ros.endpoints import LOOP_QOS
    from agv_ros.executor import spin_for

    context = rclpy.Context()
    rclpy.init(context=context)
    executor = SingleThreadedExecutor(context=context)
    alone = Parameter("wait_for_subscribers", value=0)
    relay = RelayNode(parameter_overrides=[alone], context=context, use_global_arguments=False)
    probe = Node("probe", context=context, use_global_arguments=False)
    heard: list[DiagnosticArray] = []
    probe.create_subscription(DiagnosticArray, "/diagnostics", heard.append, LOOP_QOS)
    for node in (relay, probe):
        executor.add_node(node)
    try:
        assert spin_for(executor, lambda: probe.count_publishers("/diagnostics") == 1, 60.0)
        assert spin_for(executor, lambda: relay.count_subscribers("/diagnostics") == 1, 60.0)
        (result,) = relay.set_parameters([Parameter("uplink.p", value=0.25)])
        assert result.successful
        assert spin_for(executor, lambda: bool(heard), 60.0)
        said = {value.key: value.value for value in heard[-1].status[0].values}
        assert said["changed uplink.p"] == "0.0 -> 0.25 after step 0"
        relay.set_parameters([Parameter("uplink.p", value=0.25)])
        assert not relay.set_parameters([Parameter("uplink.p", value=2.0)])[0].successful
        assert [key for key in said if key.startswith("changed ")] == ["changed uplink.p"]
    finally:
        executor.shutdown()
        for node in (relay, probe):
            node.destroy_node()
        context.try_shutdown()
