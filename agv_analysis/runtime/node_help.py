"""What `--help` of an executable prints: what it is, its topics and its parameters. Nothing is started for it."""

from __future__ import annotations

from typing import NamedTuple

from agv_analysis.runtime.parameters import RecorderParameters
from agv_analysis.scenario import SCHEMAS
from agv_plant.emulator_parameters import LinkEmulatorParameters
from agv_ros.parameters import parameters_of


class About(NamedTuple):
    """What a node is, and the topics that it has with its default parameters."""

    what: str
    hears: tuple[str, ...]
    publishes: tuple[str, ...]


_SLOT, _POSE, _COMMAND = (
    "sensor_msgs/msg/TimeReference",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/TwistStamped",
)
_CLOCK_MODE = "clock_mode diagnostic_msgs/msg/KeyValue"
_ERROR, _DIAGNOSTICS = "nav_msgs/msg/Odometry", "/diagnostics diagnostic_msgs/msg/DiagnosticArray"

ABOUT = {
    "plant": About(
        "The AGV: publishes its pose, executes the commands that arrive, and keeps the loop's clock.",
        (f"agv/cmd_vel {_COMMAND}", f"agv/slot {_SLOT}"),
        (f"agv/pose {_POSE}", f"agv/{_CLOCK_MODE}", "/clock rosgraph_msgs/msg/Clock", _DIAGNOSTICS),
    ),
    "relay": About(
        "The radio link between the AGV and the edge: forwards, delays or loses each message, reproducibly.",
        (f"agv/pose {_POSE}", f"agv/{_CLOCK_MODE}", f"edge/cmd_vel {_COMMAND}"),
        (f"edge/pose {_POSE}", f"edge/slot {_SLOT}", f"edge/{_CLOCK_MODE}", f"agv/cmd_vel {_COMMAND}",
         f"agv/slot {_SLOT}", _DIAGNOSTICS),
    ),
    "error_detector": About(
        "At the edge: compares the reference with the freshest pose that has come.",
        (f"edge/pose {_POSE}", f"edge/slot {_SLOT}", f"edge/{_CLOCK_MODE}"),
        (f"edge/error {_ERROR}", "edge/reference nav_msgs/msg/Path", _DIAGNOSTICS),
    ),
    "controller": About(
        "At the edge: answers each tracking error with a command.",
        (f"edge/error {_ERROR}",),
        (f"edge/cmd_vel {_COMMAND}", _DIAGNOSTICS),
    ),
    "recorder": About(
        "Writes every message of the loop into a rosbag2 directory, and says whether all are there.",
        (f"agv/pose {_POSE}", f"edge/pose {_POSE}", f"edge/slot {_SLOT}", f"edge/error {_ERROR}",
         f"edge/cmd_vel {_COMMAND}", f"agv/cmd_vel {_COMMAND}", f"agv/slot {_SLOT}", _DIAGNOSTICS),
        (_DIAGNOSTICS,),
    ),
    "link_emulator": About(
        "A radio link for topics of any type: loses, delays or doubles their messages, reproducibly.",
        (),
        (f"uplink/verdict {_SLOT}", f"downlink/verdict {_SLOT}", _DIAGNOSTICS),
    ),
}  # fmt: skip

NODE_SCHEMAS: dict[str, type] = {**SCHEMAS, "recorder": RecorderParameters, "link_emulator": LinkEmulatorParameters}
"""All executables, with the schema of their parameters."""


def help_text(name: str) -> str:
    """What `--help` prints of the executable `name`."""
    about = ABOUT[name]
    lines = [
        f"{name}: {about.what}", "", f"  ros2 run agv_ncs {name} --ros-args [--params-file FILE] [-p PARAMETER:=VALUE] "
        "[-r TOPIC:=OTHER] [--log-level LEVEL]", "",
        "Topics that it hears:", *(f"  {topic}" for topic in about.hears), "",
        "Topics that it publishes:", *(f"  {topic}" for topic in about.publishes), "", "Parameters:",
    ]  # fmt: skip
    for known in parameters_of(NODE_SCHEMAS[name]).values():
        unit = f" [{known.unit}]" if known.unit else ""
        default = list(known.default) if isinstance(known.default, tuple) else known.default
        changes = ", changes at run time" if known.runtime else ""
        lines.append(f"  {known.name}{unit} = {default!r}, {known.allowed}{changes}: {known.description}")
    return "\n".join(lines)
