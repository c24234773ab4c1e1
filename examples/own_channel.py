"""Your own channel: handovers, in which the link is interrupted for a fixed time. How long may that be?

A channel is a function of the slot k, of random numbers of this slot and of its own state; equal questions get equal
answers, so all runs of a seed meet the same handovers.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import agv_ncs

PAPER = Path(__file__).parents[1] / "config/paper.yaml"
LENGTHS = range(8, 25, 2)
SEEDS = range(1, 11)


def handover(channel: Any, k: int, u: Sequence[float], state: int) -> tuple[bool, int]:
    """Is slot k lost, and how many slots after it still are: an interruption begins with probability p in a slot."""
    p, length = channel.arguments
    if state > 0:
        return True, state - 1
    return (True, int(length) - 1) if u[0] < p else (False, 0)


def main(out: Path) -> None:
    """Simulate interruptions of several lengths under ten seeds each, beside the limit that is guaranteed."""
    agv_ncs.register_channel("handover", handover)
    on_track = ["plant.initial_pose=[0.0, 0.0, 1.5707963267948966]", "relay.uplink.model=handover"]
    scenarios = [
        agv_ncs.load_scenario(PAPER, [*on_track, f"relay.uplink.arguments=[0.2, {length}.0]"]) for length in LENGTHS
    ]
    table = agv_ncs.simulate_batch(scenarios, SEEDS, twins=True)
    limit = agv_ncs.margins(agv_ncs.load_scenario(PAPER)).n_bursts
    unstable = np.count_nonzero(~(table["contraction"] < 1.0), axis=1)
    for length, count in zip(LENGTHS, unstable, strict=True):
        print(f"interruptions of {5 * length} ms: {count} of {len(SEEDS)} runs are unstable")
    print(f"guaranteed in any order: up to {limit} slots ({5 * (limit or 0)} ms)")
    axes = (figure := Figure(layout="constrained")).add_subplot(xlabel="interruption [slots]", ylabel="unstable runs")
    axes.plot(LENGTHS, unstable, "o-")
    if limit is not None:
        axes.axvline(limit, ls="--", color="0.5", label="guaranteed limit")
    axes.legend()
    figure.savefig(out / "own_channel.png")
    print(f"figure: {out / 'own_channel.png'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(), help="directory for the figure")
    main(parser.parse_args().out)
