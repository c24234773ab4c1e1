"""The whole loop, and a recorder if a bag is named.

    ros2 launch agv_ncs loop.launch.py params_file:=config/paper.yaml bag:=bags/first

Arguments are listed by `ros2 launch agv_ncs loop.launch.py --show-args`. The launch ends when the plant ends, or when
any of its nodes fails; then its exit status is 1. With a namespace, clock and diagnostics are in it, too, so that any
number of vehicles run in one domain.
"""

from __future__ import annotations

import os

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable, Shutdown
from launch.conditions import IfCondition
from launch.events.process import ProcessExited
from launch.substitutions import EnvironmentVariable, LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PACKAGE = "agv_ncs"
DISCOVERY_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"

# Each vehicle has a clock of its own, and a recorder waits for the nodes of its own loop. Without a namespace these
# are the usual names.
OWN_TOPICS = [("/clock", "clock"), ("/diagnostics", "diagnostics")]


def generate_launch_description() -> LaunchDescription:
    default_params = PathJoinSubstitution([FindPackageShare(PACKAGE), "config", "paper.yaml"])
    params_file, bag, namespace = (LaunchConfiguration(name) for name in ("params_file", "bag", "namespace"))
    recorded = PythonExpression(["'", bag, "' != ''"])
    # Each node waits until this many hear it, its peer and a recorder if there is one: no first message is lost.
    listeners = PythonExpression(["2 if '", bag, "' else 1"])

    def node(name: str, parameters: list[object], **arguments: object) -> Node:
        return Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=namespace,
            output="screen",
            remappings=OWN_TOPICS,
            parameters=parameters,
            on_exit=lambda event, context: ended(name, event, context),
            **arguments,
        )

    of_loop = [params_file, {"wait_for_subscribers": listeners}]
    of_recorder = [{name: ParameterValue(LaunchConfiguration(name), value_type=str) for name in ("bag", "params_file")}]
    return LaunchDescription(
        [
            DeclareLaunchArgument("params_file", default_value=default_params, description="parameters of all nodes"),
            DeclareLaunchArgument("bag", default_value="", description="directory to record to; empty: no recording"),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of all nodes"),
            DeclareLaunchArgument(
                "discovery_range",
                default_value=EnvironmentVariable(DISCOVERY_RANGE, default_value="LOCALHOST"),
                description="who finds the nodes; LOCALHOST: this host alone, SUBNET: every host of the network",
            ),
            SetEnvironmentVariable(DISCOVERY_RANGE, LaunchConfiguration("discovery_range")),
            OpaqueFunction(function=refuse_missing_params_file),
            node("recorder", of_recorder, condition=IfCondition(recorded)),
            *(node(name, of_loop) for name in ("controller", "error_detector", "relay", "plant")),
        ]
    )


def refuse_missing_params_file(context: LaunchContext) -> None:
    """A file that is not there would only be warned of, and the nodes would run with their defaults."""
    path = LaunchConfiguration("params_file").perform(context)
    if not os.path.isfile(path):  # noqa: PTH113
        raise FileNotFoundError(f"params_file:={path}: there is no such file")


def ended(name: str, event: ProcessExited, context: LaunchContext) -> list[Shutdown]:
    """What follows the end of a node. Its error is raised: only so has the launch an exit status other than 0."""
    if event.returncode:
        raise RuntimeError(f"the {name} ended with status {event.returncode}: it has said above why")
    if name == "plant" and not context.is_shutdown:
        return [Shutdown(reason="the plant has ended")]
    return []
