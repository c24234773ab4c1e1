"""What the nodes and the recorder of a run are started with, from its scenario."""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from agv_analysis.runtime.parameters import RecorderParameters
from agv_analysis.scenario import SCHEMAS, Scenario
from agv_plant.radio.channel import check_length
from agv_ros.errors import UserError
from agv_ros.parameters import LoopParameters, parameters_of
from agv_ros.stamps import LATEST_NS, NS_PER_S

PATIENCE = 15.0
"""How long [s] a run that is interrupted waits for its recorder, if there is one that lags: nothing shall be lost.

DDS says only every 3 s that a message is there which a busy reader has missed.
"""


_LEAST_WINDOW = parameters_of(LoopParameters)["stamp_window"].low or 0.0
"""Shortest `stamp_window` [s]."""


def scenario_that_waits(scenario: Scenario, recorded: bool) -> Scenario:
    """The scenario with nodes that wait for each other, and for the recorder.

    Raises TraceError as the nodes would, and UserError if they would wait forever.
    """
    if scenario.error_detector.trigger == "timer" and scenario.plant.clock == "lockstep":
        raise UserError(
            "error_detector.trigger is timer, but plant.clock is lockstep, in which the plant waits for an answer to "
            "each of its steps: set plant.clock=realtime"
        )
    end = scenario.plant.start_time + scenario.plant.duration
    if math.isfinite(end) and end * NS_PER_S > LATEST_NS:
        raise UserError(
            f"plant.start_time + plant.duration is {end:g} s, and a stamp of ROS ends at {LATEST_NS / NS_PER_S:.0f} s: "
            "shorten plant.duration, or set it to .inf"
        )
    steps = scenario.plant.duration / scenario.plant.ts
    relay = scenario.relay
    for link, channel in (("uplink", relay.uplink), ("downlink", relay.downlink)):
        check_length(channel, relay.seed, link, steps, relay.ts)
    met = {"wait_for_subscribers": 1 + recorded, "stop_timeout": PATIENCE if recorded else scenario.plant.stop_timeout}
    if scenario.plant.clock == "lockstep":  # in which each step follows the one before it
        met["stamp_window"] = max(_LEAST_WINDOW, scenario.plant.ts)
    nodes = {name: dataclasses.replace(getattr(scenario, name), **met) for name in SCHEMAS}
    if scenario.error_detector.hears_commands and not scenario.plant.plan_steps:
        nodes["controller"] = dataclasses.replace(nodes["controller"], wait_for_subscribers=2 + recorded)
    return Scenario(**nodes)


class OnDisk(NamedTuple):
    """What a recorder does with the disk."""

    fsync: bool = RecorderParameters.fsync
    if_unwritable: str = RecorderParameters.if_unwritable


AS_USUAL = OnDisk()


def recording_of(scenario: Scenario, bag: Path, params: Path, on_disk: OnDisk) -> RecorderParameters:
    """What the recorder of a scenario is to do; `params` is the file of its parameters."""
    log_time = "stamp" if scenario.plant.clock == "lockstep" else "receive"
    return RecorderParameters(
        bag=str(bag), params_file=str(params), log_time=log_time, stop_timeout=PATIENCE,
        plant_domain_id=scenario.relay.plant_domain_id, edge_domain_id=scenario.relay.edge_domain_id,
        fsync=on_disk.fsync, if_unwritable=on_disk.if_unwritable,
    )  # fmt: skip


@contextmanager
def params_file(scenario: Scenario) -> Iterator[Path]:
    """A file with the scenario's parameters, for as long as it is needed."""
    with tempfile.TemporaryDirectory(prefix="agv_ncs_") as folder:
        path = Path(folder) / "params.yaml"
        path.write_text(scenario.to_yaml(), encoding="utf-8")
        yield path
