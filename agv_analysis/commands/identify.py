"""`agv-ncs identify`: how a recorded robot follows its commands, and which gains that bears."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from agv_analysis.commands import OUTPUT, needs_ros, with_force, write_json
from agv_ros.counted import counted

if TYPE_CHECKING:
    from agv_analysis.identify.bearable_gains import BearableGains
    from agv_analysis.identify.fit import Interval
    from agv_analysis.identify.robot import IdentifiedRobot, IdentifiedSpeed
    from agv_analysis.recordings.robot_topics import RobotTopics


@click.command("identify", short_help="Find a robot's dead time, lag, gain and slip in a recording.")
@click.argument("bag", type=click.Path(path_type=Path))
@click.option("--pose-topic", help="The pose: Odometry, PoseWithCovarianceStamped, PoseStamped, or /tf.")
@click.option("--pose-frames", nargs=2, metavar="FIXED ROBOT", help="Of /tf: which frames, as map base_link.")
@click.option("--command-topic", help="The command: Twist, TwistStamped or AckermannDrive(Stamped).")
@click.option("--topics", type=click.Path(path_type=Path), help="YAML file with the topics: pose, command.")
@click.option(
    "--wheelbase", type=click.FloatRange(min=0.0, min_open=True), metavar="L",
    help="Of a car that is commanded by its steering angle [m].",
)  # fmt: skip
@click.option(
    "--params", "params_file", type=OUTPUT,
    help="Write the params file of a plant that behaves like this robot, for `agv-ncs stability` and the others.",
)  # fmt: skip
@click.option(
    "--live",
    "seconds",
    type=click.FloatRange(min=1.0),
    metavar="SECONDS",
    help="First record BAG, which must not exist, from the running robot for so long; Ctrl-C ends that earlier.",
)
@click.option("--json", "json_file", type=OUTPUT, help="Write what is printed to this file, too.")
@with_force
def command(
    bag: Path, pose_topic: str | None, pose_frames: tuple[str, str] | None, command_topic: str | None,
    topics: Path | None, wheelbase: float | None, params_file: Path | None, seconds: float | None,
    json_file: Path | None,
) -> None:  # fmt: skip
    """Say from the recording BAG of any robot how it follows its commands: dead time, lag, gain and slip of v and w.

    With 95 % intervals; then the largest gains that they bear. Topics are agv/pose and agv/cmd_vel unless named.

    \b
    Examples:
      agv-ncs identify robot --pose-topic /odom --command-topic /cmd_vel
      agv-ncs identify robot --pose-topic /odom --command-topic /cmd_vel --params robot.yaml --json robot.json
      agv-ncs identify bags/first
      agv-ncs identify bags/now --live 60 --pose-topic /odom --command-topic /cmd_vel
    """
    from rich.console import Console

    from agv_analysis.identify.bearable_gains import bearable_gains, robot_scenario
    from agv_analysis.identify.robot import identify_recording
    from agv_analysis.output_file import YAML_MARK, output_file
    from agv_analysis.recordings.robot_topics import read_topics
    from agv_ros.errors import UserError

    usual = (None, None) if topics is not None else ("/agv/pose", "/agv/cmd_vel")
    names = read_topics(topics, pose_topic or usual[0], command_topic or usual[1], None)
    if seconds is not None:
        _record(bag, names, seconds)
    with Console(stderr=True).status("fitting ..."):
        robot = identify_recording(bag, names, pose_frames, wheelbase)
        gains = bearable_gains(robot)
    for line in _lines(robot):
        click.echo(line)
    click.echo(_of_gains(gains))
    for note in robot.notes:
        click.echo(f"Note: {note}.")
    content: dict[str, Any] = {**robot.to_json(), "gains": None if gains is None else gains.to_json()}
    if json_file is not None:
        write_json(json_file, content)
    if params_file is None:
        return
    if gains is None or (scenario := robot_scenario(robot, gains)) is None:
        raise UserError(f"{params_file} is not written: it needs dead time, lag and gain of both v and w")
    try:
        output_file(params_file).write_text(YAML_MARK + scenario.to_yaml(), encoding="utf-8")
    except OSError as error:
        raise UserError(f"{params_file}: cannot be written: {error.strerror}") from None
    click.echo(f"params: {params_file}")
    turn = robot["w"].fit
    if turn is not None and not turn.gain.low <= 1.0 <= turn.gain.high:
        click.echo(
            f"Note: the plant of {params_file} turns as commanded, the robot {turn.gain.value:.4f} times as fast."
        )


def _record(bag: Path, names: RobotTopics, seconds: float) -> None:
    """Record the topics of pose and command of the running robot."""
    from rich.console import Console
    from rich.progress import Progress

    from agv_analysis.identify.robot import command_topic

    with needs_ros():
        from agv_analysis.runtime.topic_recorder_node import record_topics
    from agv_ros.discovery import discovery_note

    topics = [names.pose, command_topic(names)]
    click.echo(discovery_note(), err=True)
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task(f"recording {' and '.join(topics)}", total=seconds)
        counts = record_topics(bag, topics, seconds, lambda heard: progress.update(task, completed=heard))
    recorded = ", ".join(f"{counted(count, 'message')} of {topic}" for topic, count in zip(topics, counts, strict=True))
    click.echo(f"bag: {bag} ({recorded})")


def _lines(robot: IdentifiedRobot) -> list[str]:
    return [
        f"Poses every {robot.pose_period * 1e3:.3g} ms, commands every {robot.command_period * 1e3:.3g} ms (medians).",
        *(line for speed in robot.speeds for line in _of_speed(speed)),
    ]


def _of_speed(speed: IdentifiedSpeed) -> list[str]:
    """What is known of a speed, a line each."""
    title = f"{speed.named.key} ({speed.named.meaning})"
    if speed.fit is None:
        return [
            f"{title}: no number. {speed.reason[0].upper()}{speed.reason[1:]}{'' if speed.reason[-1] == '?' else '.'}"
        ]
    assert speed.slip is not None
    return [
        f"{title}, each with its 95 % interval:",
        f"  dead time {_text(speed.fit.dead_time, 1e3, 'ms')}",
        f"  lag       {_text(speed.fit.lag, 1e3, 'ms')}",
        f"  gain      {_text(speed.fit.gain, 1.0, '', 4)}",
        f"  slip      {_text(speed.slip, 100.0, '%', 2)}",
    ]


def _text(part: Interval, factor: float, unit: str, digits: int = 1) -> str:
    value, low, high = (f"{factor * x:.{digits}f}" for x in (part.value, part.low, part.high))
    return f"{value} ({low} to {high}) {unit}".rstrip()


def _of_gains(gains: BearableGains | None) -> str:
    if gains is None:
        return "Largest gains: no answer, they need dead time and lag of both v and w."
    return (
        f"Largest gains of Kanayama's law on a straight track at {gains.speed:.3g} m/s, with poses that are always "
        f"{gains.dead_time * 1e3:.4g} ms old and a lag of {gains.lag * 1e3:.4g} ms (upper ends), every "
        f"{gains.ts * 1e3:.4g} ms: K_x below {gains.kx:.3g} 1/s, K_theta below {gains.ktheta:.3g} 1/m with "
        "K_y = K_theta^2 / 4."
    )
