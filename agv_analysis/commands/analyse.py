"""`agv-ncs analyse`: a verdict from a recording."""

from __future__ import annotations

from pathlib import Path

import click

from agv_analysis.commands import (
    OUTPUT,
    corridor_json,
    corridor_settings,
    print_corridor,
    report_on,
    with_corridor,
    with_force,
    with_report,
    write_json,
)


@click.command("analyse", short_help="Judge a recording: is the loop stable, and why?")
@click.argument("bag", type=click.Path(path_type=Path))
@click.option("--json", "json_file", type=OUTPUT, help="Write what is printed to this file, too.")
@click.option(
    "--config", type=click.Path(path_type=Path), help="The run's params file, for a bag that does not carry it."
)
@click.option("--namespace", help="Which loop, for a bag of several.")
@click.option("--picture", type=OUTPUT, help="Where to draw; beside the recording by default.")
@click.option("--pose-topic", help="Another robot's pose: Odometry, PoseWithCovarianceStamped, PoseStamped, or /tf.")
@click.option("--pose-frames", nargs=2, metavar="FIXED ROBOT", help="Of /tf: which frames, as map base_link.")
@click.option("--command-topic", help="Another robot's command: Twist, TwistStamped or AckermannDrive(Stamped).")
@click.option("--reference-topic", help="Another robot's reference: Odometry or Path.")
@click.option("--track-file", type=click.Path(path_type=Path), help="Another robot's reference: CSV file with t, v, w.")
@click.option("--topics", type=click.Path(path_type=Path), help="YAML file with the topics: pose, command, reference.")
@with_corridor
@with_report
@with_force
def command(
    bag: Path, json_file: Path | None, config: Path | None, namespace: str | None, picture: Path | None,
    pose_topic: str | None, pose_frames: tuple[str, str] | None, command_topic: str | None,
    reference_topic: str | None, track_file: Path | None, topics: Path | None, report: Path | None,
    figures: Path | None, corridor_width: float | None, corridor_along: float | None, laps: int | None,
) -> None:  # fmt: skip
    """Say from the recording BAG whether the loop is stable, and why.

    \b
    Examples:
      agv-ncs analyse bags/first
      agv-ncs analyse bags/first --json first.json --picture first.png
      agv-ncs analyse bags/first --corridor 0.5
      agv-ncs analyse bags/first --report first.html --figures first
      agv-ncs analyse from_ros2_bag_record --config config/paper.yaml
      agv-ncs analyse robot --pose-topic /odom --command-topic /cmd_vel --reference-topic /plan
    """
    from agv_analysis.output_file import output_file
    from agv_analysis.recordings.other_robots import read_robot_run
    from agv_analysis.recordings.recording import read_run
    from agv_analysis.recordings.robot_topics import read_topics
    from agv_analysis.report.overview import draw
    from agv_analysis.report.table import print_table
    from agv_analysis.stability.analysis import analyse, observe

    where = picture or output_file(bag / "overview.png" if bag.is_dir() else bag.with_suffix(".png"))
    if any((pose_topic, command_topic, reference_topic, track_file, topics)):
        if namespace is not None:
            raise click.UsageError("--namespace chooses one of several loops; another robot's topics are named in full")
        names = read_topics(topics, pose_topic, command_topic, reference_topic)
        run = read_robot_run(bag, names, track_file, config, pose_frames)
    else:
        run = read_run(bag, config, namespace)
    analysis = analyse(run) if run.gains_known else observe(run)
    draw(run, where)
    print_table(analysis)
    scenario = run.scenario.with_settings(corridor_settings(corridor_width, corridor_along), "--corridor")
    within = print_corridor(analysis, scenario, False, laps)
    click.echo(f"bag:     {bag}\npicture: {where}")
    report_on(analysis, report, figures, within)
    if json_file is not None:
        write_json(json_file, {**analysis.to_json(), **corridor_json(within)})
