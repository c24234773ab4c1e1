"""How well this machine keeps the loop's period: the loop on DDS in real time, or a timer where there is no ROS."""

from __future__ import annotations

import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agv_plant.deadline_monitor import DeadlineMonitor
from agv_ros.errors import UserError
from agv_ros.stamps import to_nanoseconds

PERIOD = 0.005
"""The paper's sampling period [s]."""


@dataclass(frozen=True)
class TimedLoop:
    """What a loop of some seconds has shown."""

    what: str
    steps: int
    jitter: dict[str, float]
    """|period - T_s| [s] at p50, p99 and at most, and the deadlines that were missed."""
    round_trip: dict[str, float] | None
    """From a pose to the command that answers it [s], at p50, p99 and at most; None without ROS."""
    failure: str = ""

    def to_json(self) -> dict[str, Any]:
        """As the JSON file has it."""
        jitter = {name.replace(" ", "_"): value for name, value in self.jitter.items()}
        return {"what": self.what, "steps": self.steps, "period": PERIOD, **jitter} | {
            "round_trip": self.round_trip,
            "failure": self.failure,
        }


def on_timer(seconds: float) -> TimedLoop:
    """Wake up every period for some seconds, as the plant's timer does."""
    steps, period_ns = max(1, round(seconds / PERIOD)), to_nanoseconds(PERIOD)
    monitor, begin, number = DeadlineMonitor(period_ns, steps), time.monotonic_ns(), 0
    monitor.start(begin)
    while number < steps:
        time.sleep(max(0, begin + (number + 1) * period_ns - time.monotonic_ns()) * 1e-9)
        number = max(number + 1, monitor.tick(time.monotonic_ns()))
    return TimedLoop("a timer, without ROS", steps, monitor.summary(), None)


def on_dds(seconds: float) -> TimedLoop:
    """Drive the paper's loop in real time on DDS, on this host only, in a namespace of its own.

    Raises ImportError where there is no ROS.
    """
    from agv_analysis.runtime.runner import run_fleet
    from agv_analysis.scenario import SCHEMAS, parse_scenario

    name, said = f"doctor_{os.getpid()}", os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE")
    settings = [f"plant.duration={seconds}", *(f"{node}.ts={PERIOD}" for node in SCHEMAS)]
    settings += [f"{node}.frame_prefix={name}/" for node in SCHEMAS]  # beside other robots' frames on /tf
    scenario = parse_scenario("plant: {ros__parameters: {clock: realtime}}", settings=settings)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"  # read by the context that the run makes
    try:
        with tempfile.TemporaryDirectory(prefix="agv_ncs_doctor_") as folder:
            (outcome,) = run_fleet({name: scenario}, Path(folder) / "bags", lambda _: None)
            return _as_recorded(Path(folder) / "bags" / name, f"/{name}", outcome.steps, outcome.failure)
    except UserError as error:
        return TimedLoop("the loop on DDS", 0, {}, None, str(error))
    finally:
        if said is None:
            del os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"]
        else:
            os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = said


def _as_recorded(bag: Path, namespace: str, steps: int, failure: str) -> TimedLoop:
    """Jitter of the poses and the time to their commands, by the instants at which they were recorded."""
    from agv_analysis.bags import read_bag
    from agv_analysis.bags.layout import LOG_TIME
    from agv_analysis.recordings.messages_on_steps import stamps_of

    found = read_bag(bag)
    poses, commands = found[f"{namespace}/agv/pose"], found[f"{namespace}/agv/cmd_vel"]
    monitor = DeadlineMonitor(to_nanoseconds(PERIOD))
    instants = poses[LOG_TIME]
    monitor.start(int(instants[0]))
    for instant in instants[1:]:
        monitor.tick(int(instant))
    _, asked, answered = np.intersect1d(stamps_of(poses), stamps_of(commands), return_indices=True)
    taken = (commands[LOG_TIME][answered] - poses[LOG_TIME][asked]) * 1e-9
    quantiles = dict(zip(("p50", "p99", "max"), np.percentile(taken, [50.0, 99.0, 100.0]).tolist(), strict=True))
    return TimedLoop("the loop on DDS", steps, monitor.summary(), quantiles if len(taken) else None, failure)
