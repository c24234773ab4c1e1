"""Staleness and downlink policies, ranked on the same outages: an AGV that begins on the track, simulated."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from agv_analysis.reproduce.claim import Values
from agv_analysis.reproduce.claims import ON_TRACK
from agv_analysis.reproduce.runs import gain, scenario
from agv_analysis.simulation import simulate_batch
from agv_cloud.staleness.registry import STALENESS_POLICIES
from agv_plant.downlink_policy import DOWNLINK_POLICIES

SEEDS = range(1, 21)

CLOSER = 0.5
"""Twins have come closer if a lap at least halves their distance; an error that only stays does not do that."""

OUTAGES = {
    "independent, 50 %": ("model=bernoulli", "p=0.5"),
    "bursts of 10, 20 %": ("model=gilbert_elliott", "p=0.025", "r=0.1"),
    "13 after each received": ("model=burst", "n=13"),
    "20 after each received": ("model=burst", "n=20"),
    "200 after each received": ("model=burst", "n=200"),
}

SCALES = (1.0, 1.1)
"""True over commanded speed: the predictor's model is exact, or 10 % wrong."""

PLANNED = 20
"""Commands that the downlink policy `buffer` has ahead."""

_SAYS_NOTHING = 1000.0
"""Where all twins part, a distance beyond this [m] depends on rounding: the loop diverges."""

ERROR = "farthest from the reference [m]"
PART = "twins part"


def edge() -> Iterator[Values]:
    """By outages on the uplink and the model's error: each staleness policy, the best first."""
    for name, outages in OUTAGES.items():
        for scale in SCALES:
            kept = (ON_TRACK, *(f"relay.uplink.{setting}" for setting in outages), f"plant.speed_scale={scale}")
            ranked = _ranked("error_detector.policy", STALENESS_POLICIES.names(), kept)
            yield from ({"uplink": name, "speed scale": scale, **row} for row in ranked)


def downlink() -> Iterator[Values]:
    """By outages on the downlink: each downlink policy, the best first."""
    for name, outages in OUTAGES.items():
        kept = (ON_TRACK, f"plant.plan_steps={PLANNED}", *(f"relay.downlink.{setting}" for setting in outages))
        yield from ({"downlink": name, **row} for row in _ranked("plant.downlink_policy", DOWNLINK_POLICIES, kept))


def _ranked(parameter: str, policies: Sequence[str], settings: tuple[str, ...]) -> list[Values]:
    """A row a policy; median of the seeds' largest distances, and the share of twins that do not come closer."""
    wanted = [scenario(*gain(25.0), *settings, f"{parameter}={policy}") for policy in policies]
    found = simulate_batch(wanted, list(SEEDS), twins=True)
    rows: list[Values] = []
    for policy, runs in zip(policies, found, strict=True):
        farthest, part = float(np.median(runs["position_peak"])), float(np.mean(~(runs["contraction"] < CLOSER)))
        if part == 1.0 and farthest > _SAYS_NOTHING:
            farthest = math.inf
        rows.append({"policy": policy, ERROR: farthest, PART: part})
    return sorted(rows, key=_rank)


def _rank(row: Values) -> tuple[float, float]:
    """Who parts comes last: on the track even an unstable loop may show no error."""
    part, error = row[PART], row[ERROR]
    assert isinstance(part, float)
    assert isinstance(error, float)
    return part, error
