"""The AGV and the edge in DDS domains of their own: the relay is the only way between them, or the run fails."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")

import rclpy
from geometry_msgs.msg import PoseStamped, TwistStamped
from mcap.reader import make_reader

from agv_analysis.recordings.recording import read_run
from agv_analysis.runtime.processes import run_in_processes
from agv_analysis.runtime.runner import run_in_process
from agv_analysis.scenario import Scenario, load_scenario

if TYPE_CHECKING:
    from test.conftest import Drive

OUTAGES = str(Path(__file__).parents[1] / "config/outages.yaml")
Domains = tuple[int, int]


def scenario(domains: Domains, *settings: str) -> Scenario:
    agv, edge = domains
    return load_scenario(OUTAGES, [f"relay.plant_domain_id={agv}", f"relay.edge_domain_id={edge}", *settings])


@pytest.mark.parametrize("run", [run_in_process, run_in_processes])
def test_the_loop_is_the_same_through_two_domains(
    run: Callable[..., object], drive: Drive, two_domains: Domains, tmp_path: Path
) -> None:
    found = run(scenario(two_domains, "plant.duration=2.0"), tmp_path / "apart", lambda _: None)
    assert (found.failure, found.recording_failure) == ("", "")  # type: ignore[attr-defined]
    apart, together = read_run(tmp_path / "apart"), drive("plant.duration=2.0", config="outages")
    assert not apart.unexplained
    assert (apart.pose == together.pose).all()
    assert (apart.lost == together.lost).all()
    assert set(topics(tmp_path / "apart")) == set(topics(tmp_path / "bag"))


def topics(bag: Path) -> list[str]:
    with next(bag.glob("*.mcap")).open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return sorted(channel.topic for channel in summary.channels.values())


@pytest.fixture
def stranger(two_domains: Domains) -> Iterator[Callable[[int, type, str], None]]:
    """Publishes something in one of the two domains, while the test runs."""
    contexts, nodes = [], []

    def publish(side: int, kind: type, topic: str) -> None:
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=two_domains[side])
        contexts.append(context)
        nodes.append(rclpy.create_node("stranger", context=context, use_global_arguments=False))
        nodes[-1].create_publisher(kind, topic, 10)

    yield publish
    for context in contexts:
        context.try_shutdown()


@pytest.mark.parametrize(
    ("side", "kind", "topic"),
    [
        (1, PoseStamped, "agv/pose"), (1, PoseStamped, "edge/pose"),
        (0, TwistStamped, "edge/cmd_vel"), (0, TwistStamped, "agv/cmd_vel"),
    ],
)  # fmt: skip
def test_a_way_around_the_relay_fails_the_run(
    stranger: Callable[[int, type, str], None], two_domains: Domains, side: int, kind: type, topic: str
) -> None:
    stranger(side, kind, topic)
    # A run that is longer than the relay needs to find out, for it ends it then.
    found = run_in_processes(scenario(two_domains, "plant.duration=200.0"), None, lambda _: None)
    if topic == "agv/cmd_vel" and not found.failure.startswith("relay"):  # the plant may find it first
        assert found.failure == f"another relay publishes {topic}: use another namespace or ROS_DOMAIN_ID"
        return
    assert found.failure.startswith("relay ended: ")
    assert f"{topic} comes into domain {two_domains[side]} around the relay" in found.failure


def test_neither_side_sees_the_others_topics(two_domains: Domains) -> None:
    """What DDS itself says of each domain while the loop runs."""
    seen: list[set[str]] = [set(), set()]
    contexts = [rclpy.Context() for _ in two_domains]
    for context, domain in zip(contexts, two_domains, strict=True):
        rclpy.init(context=context, domain_id=domain)
    nodes = [rclpy.create_node("onlooker", context=context, use_global_arguments=False) for context in contexts]

    def look(_: int) -> None:
        for node, found in zip(nodes, seen, strict=True):
            found.update(name for name, _ in node.get_topic_names_and_types() if name.startswith(("/agv/", "/edge/")))

    try:
        found = run_in_process(scenario(two_domains, "plant.duration=30.0"), None, look)
    finally:
        for context in contexts:
            context.try_shutdown()
    assert found.failure == ""
    assert {name.split("/")[1] for name in seen[0]} == {"agv"}
    assert {name.split("/")[1] for name in seen[1]} == {"edge"}


# -- two hosts ---------------------------------------------------------------------------------------------------------


def test_edge_and_agv_on_two_hosts(two_hosts: tuple[list[str], list[str]], two_domains: Domains) -> None:
    """Plant and relay on one host, the edge's nodes on another: what crosses the cable is the edge's domain alone."""
    agv, edge = two_domains
    processes = []
    modules = [
        ("agv_cloud.controller_node", 1, edge), ("agv_cloud.error_detector_node", 1, edge),
        ("agv_plant.relay_node", 0, agv), ("agv_plant.plant_node", 0, agv),
    ]  # fmt: skip
    settings = {
        "wait_for_subscribers": "1",
        "plant_domain_id": str(agv),
        "edge_domain_id": str(edge),
        "duration": "2.0",
    }
    arguments = [word for name, value in settings.items() for word in ("-p", f"{name}:={value}")]
    try:
        for module, host, domain in modules:
            command = [sys.executable, "-m", module, "--ros-args", "--params-file", OUTAGES, *arguments]
            environment = {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
            processes.append(
                subprocess.Popen(
                    [*two_hosts[host], *command], env={**os.environ, **environment}, text=True,
                    stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                )
            )  # fmt: skip
        said, _ = processes[-1].communicate(timeout=120.0)
        assert processes[-1].returncode == 0, said
        assert "step 400 of 400" in said
    finally:
        for process in reversed(processes):
            process.terminate()
        for process in processes:
            process.communicate(timeout=60.0)
