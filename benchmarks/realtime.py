"""Punctuality of the loop at 200 Hz in real time, against a bare rclpy timer in the same run."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from agv_analysis.scenario import load_scenario
from benchmarks.comparison import Comparison

CONFIG = str(Path(__file__).parent.parent / "config" / "paper.yaml")
SECONDS = 10.0


def measure() -> list[Comparison]:
    """|period - T_s| and missed deadlines of the plant's tick with the whole loop around it, and of a timer alone."""
    bare, loop = _bare_timer(), _loop()
    found = [
        Comparison(f"jitter {name}, whole loop", loop[f"jitter {name}"] * 1e6, "bare timer",
                   bare[f"jitter {name}"] * 1e6, "us", smaller_is_better=True)
        for name in ("p50", "p99", "max")
    ]  # fmt: skip
    missed = "missed deadlines"
    return [
        *found,
        Comparison(f"{missed} of {SECONDS / 0.005:.0f}", loop[missed], "bare timer", bare[missed], "",
                   smaller_is_better=True),
    ]  # fmt: skip


def _bare_timer() -> dict[str, float]:
    import rclpy
    from rclpy.clock import Clock, ClockType
    from rclpy.node import Node

    from agv_plant.deadline_monitor import DeadlineMonitor
    from agv_ros.executor import EXECUTORS, spin_for

    context = rclpy.Context()
    rclpy.init(context=context)
    node = Node("timer", context=context, use_global_arguments=False)
    executor = EXECUTORS["events"](context=context)
    executor.add_node(node)
    deadline_monitor = DeadlineMonitor(5_000_000)
    deadline_monitor.start(time.monotonic_ns())
    steady = Clock(clock_type=ClockType.STEADY_TIME)
    node.create_timer(0.005, lambda: deadline_monitor.tick(time.monotonic_ns()), clock=steady)
    spin_for(executor, lambda: False, SECONDS)
    executor.shutdown()
    node.destroy_node()
    context.try_shutdown()
    return deadline_monitor.summary()


def _loop() -> dict[str, float]:
    """Summary of the plant, from the diagnostics of a recorded run."""
    import tempfile

    from mcap.reader import make_reader
    from rclpy.serialization import deserialize_message

    from agv_analysis.runtime.recorder_node import TOPICS
    from agv_analysis.runtime.runner import run_in_process

    scenario = load_scenario(CONFIG, [f"plant.duration={SECONDS}", "plant.clock=realtime"])
    facts: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        outcome = run_in_process(scenario, bag, lambda _: None)
        if outcome.failure:
            raise RuntimeError(outcome.failure)
        with next(bag.glob("*.mcap")).open("rb") as file:
            for _, _, message in make_reader(file).iter_messages(topics=["/diagnostics"]):
                for status in deserialize_message(message.data, TOPICS["/diagnostics"]).status:
                    if status.name == "plant":
                        facts.update({value.key: value.value for value in status.values})
    names = ("jitter p50", "jitter p99", "jitter max", "missed deadlines")
    return {name: float(facts[f"{name} [s]" if name.startswith("jitter") else name]) for name in names}
