"""A recording as arrays: its topics as they were recorded, and the run that they make up, step by step."""

import argparse
import json
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import agv_ncs

SAMPLE = Path(__file__).parents[1] / "bags/sample"


def main(out: Path) -> None:
    """Read the sample of the repository both ways, write the figures as JSON, and draw the age of information."""
    bag = agv_ncs.read_bag(SAMPLE)
    for name, topic in bag.topics.items():
        print(f"{name}: {topic.count} of {topic.type}")
    poses = bag["/agv/pose"]  # a structured array, one row a message
    print(f"first pose: x {poses['pose.position.x'][0]} m, y {poses['pose.position.y'][0]} m")

    run = agv_ncs.read_recording(SAMPLE)
    print(f"run: {len(run)} steps of {1e3 * run.ts:g} ms, pose {run.pose.shape}, reference {run.reference.shape}")
    print(f"lost: {np.mean(run.lost):.1%} of the poses, the oldest in use is {run.n_ul.max()} steps old")

    axes = (figure := Figure(layout="constrained")).add_subplot(xlabel="time [s]", ylabel="age of the pose [steps]")
    axes.step(run.time, run.n_ul, where="post")
    figure.savefig(out / "bag_to_arrays.png")
    np.savez(out / "bag_to_arrays.npz", k=run.k, pose=run.pose, reference=run.reference, lost=run.lost, n_ul=run.n_ul)
    analysis = json.dumps(agv_ncs.analyse(run).to_json(), indent=2)
    (out / "bag_to_arrays.json").write_text(analysis + "\n", encoding="utf-8")
    print("written: " + ", ".join(str(out / f"bag_to_arrays.{ending}") for ending in ("png", "npz", "json")))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(), help="directory for what is written")
    main(parser.parse_args().out)
