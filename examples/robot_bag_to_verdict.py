"""The recording of another robot, here of a simulated one: what was lost, and with its gains, is its loop stable?"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import agv_ncs

OUTAGES, PERIOD = Path(__file__).parents[1] / "config/outages.yaml", 20_000_000  # [ns]
SETTINGS = ("plant.ts=0.02", "controller.kx=5.0", "plant.duration=20.0", "plant.initial_pose=[0.2, 0.0, 1.57]")
KINDS = dict.fromkeys(("/odom", "/reference"), "nav_msgs/msg/Odometry") | {"/cmd_vel": "geometry_msgs/msg/Twist"}
TOPICS = {"pose": "/odom", "command": "/cmd_vel", "reference": "/reference"}
STORE = get_typestore(Stores.ROS2_JAZZY)
new: dict[str, Any] = {kind.rsplit("/", 1)[1]: STORE.types[kind] for kind in STORE.types}


def odometry(stamp: int, x: float, y: float, theta: float, v: float = 0.0, w: float = 0.0) -> Any:
    """Pose [m, m, rad] and speeds [m/s, rad/s] at the time `stamp` [ns] as a message."""
    header = new["Header"](new["Time"](*divmod(stamp, 10**9)), "odom")
    pose = new["Pose"](new["Point"](x, y, 0.0), new["Quaternion"](0.0, 0.0, np.sin(theta / 2), np.cos(theta / 2)))
    uncertain = new["PoseWithCovariance"](pose, np.zeros(36)), new["TwistWithCovariance"](twist(v, w), np.zeros(36))
    return new["Odometry"](header, "base_link", *uncertain)


def twist(v: float, w: float) -> Any:
    """Speeds [m/s, rad/s] as a message."""
    return new["Twist"](new["Vector3"](v, 0.0, 0.0), new["Vector3"](0.0, 0.0, w))


def record(run: agv_ncs.Run, path: Path) -> None:
    """Write a run to a bag in the form of rosbag2; a pose that was lost is not in it."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        known = {name: writer.add_connection(name, kind, typestore=STORE) for name, kind in KINDS.items()}
        for k, stamp in enumerate(range(10**9, 10**9 + len(run) * PERIOD, PERIOD)):
            sent = {"/reference": odometry(stamp, *run.reference[k]), "/cmd_vel": twist(*run.command[k])}
            for name, message in (sent if run.lost[k] else {"/odom": odometry(stamp, *run.pose[k]), **sent}).items():
                writer.write(known[name], stamp, STORE.serialize_cdr(message, KINDS[name]))


def main(out: Path) -> None:
    """Record, read without and with the gains, and write the report."""
    scenario = agv_ncs.load_scenario(OUTAGES, SETTINGS)
    record(agv_ncs.simulate(scenario), out / "robot")
    seen = agv_ncs.observe(agv_ncs.read_robot_recording(out / "robot", **TOPICS))
    print(f"{len(seen.run)} steps of {1e3 * seen.run.ts:g} ms, {seen.outages.loss_rate:.1%} of the poses lost")
    (out / "robot.yaml").write_text(scenario.to_yaml(), encoding="utf-8")  # its gains
    judged = agv_ncs.analyse(agv_ncs.read_robot_recording(out / "robot", **TOPICS, config=out / "robot.yaml"))
    print(f"longest outage {judged.n} slots, verdict {judged.verdict.word}: {judged.verdict.margin}")
    agv_ncs.write_report(judged, out / "robot.html")
    print(f"report: {out / 'robot.html'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(), help="directory for the bag and the report")
    main(parser.parse_args().out)
