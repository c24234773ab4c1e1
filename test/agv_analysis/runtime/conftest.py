"""Fixtures of the tests of runs, recordings and replays."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from agv_analysis.recordings.recording import read_run
from agv_analysis.run import Run

SAMPLE = Path(__file__).parents[3] / "bags/sample"


@pytest.fixture(scope="session")
def sample() -> Run:
    return read_run(SAMPLE)


UntilSteps = Callable[..., None]


@pytest.fixture
def until_steps() -> Iterator[UntilSteps]:
    """Wait until loops that run in other processes, and are recorded, have gone on for so many steps."""
    rclpy = pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    from rosgraph_msgs.msg import Clock

    from agv_ros.endpoints import LOOP_QOS
    from agv_ros.executor import EXECUTORS, spin_for

    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("listener", context=context, use_global_arguments=False)
    executor = EXECUTORS["single"](context=context)
    executor.add_node(node)

    def until(condition: Callable[[], bool]) -> None:
        assert spin_for(executor, condition, 300.0)  # only there so that a hanging test ends

    def run(steps: int, *clocks: str) -> None:
        heard: Counter[str] = Counter()
        until(lambda: all(map(node.count_subscribers, clocks)))  # the recorders, which the loops wait for
        subscriptions = [
            node.create_subscription(Clock, clock, lambda _, clock=clock: heard.update([clock]), LOOP_QOS)
            for clock in clocks
        ]
        until(lambda: all(heard[clock] >= steps for clock in clocks))
        for subscription in subscriptions:
            node.destroy_subscription(subscription)

    yield run
    executor.shutdown()
    node.destroy_node()
    context.try_shutdown()
