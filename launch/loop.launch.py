"""The whole loop, and a recorder if a bag is named.

    ros2 launch agv_ncs loop.launch.py params_file:=config/paper.yaml bag:=bags/first

Arguments are listed by `ros2 launch agv_ncs loop.launch.py --show-args`. The launch ends when the plant ends.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PACKAGE = "agv_ncs"


def generate_launch_description() -> LaunchDescription:
    default_params = PathJoinSubstitution([FindPackageShare(PACKAGE), "config", "paper.yaml"])
    params_file, bag, namespace = (LaunchConfiguration(name) for name in ("params_file", "bag", "namespace"))
    recorded = PythonExpression(["'", bag, "' != ''"])
    # Each node waits until this many hear it, its peer and a recorder if there is one: no first message is lost.
    listeners = PythonExpression(["2 if '", bag, "' else 1"])

    def node(name: str, **arguments: object) -> Node:
        return Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=namespace,
            output="screen",
            parameters=[params_file, {"wait_for_subscribers": listeners}],
            **arguments,
        )

    return LaunchDescription(
        [
            DeclareLaunchArgument("params_file", default_value=default_params, description="parameters of all nodes"),
            DeclareLaunchArgument("bag", default_value="", description="directory to record to; empty: no recording"),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of all nodes"),
            Node(
                package=PACKAGE,
                executable="recorder",
                name="recorder",
                namespace=namespace,
                output="screen",
                parameters=[
                    {name: ParameterValue(LaunchConfiguration(name), value_type=str) for name in ("bag", "params_file")}
                ],
                condition=IfCondition(recorded),
            ),
            *(node(name) for name in ("controller", "error_detector", "relay")),
            node("plant", on_exit=Shutdown(reason="the plant has ended")),
        ]
    )
