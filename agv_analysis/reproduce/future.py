"""The paper's future work: gains for the other errors, outages, and the criteria of stability against simulated twins.

Everything here is simulated. Twins are two AGVs that begin a micrometre apart and meet the same losses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from agv_analysis.metrics.convergence import convergence
from agv_analysis.reproduce import constant_delay, policies
from agv_analysis.reproduce.claim import Values
from agv_analysis.reproduce.claims import LIMITS, ON_TRACK
from agv_analysis.reproduce.policies import CLOSER, SEEDS
from agv_analysis.reproduce.report import Table
from agv_analysis.reproduce.runs import GAINS, gain, scenario
from agv_analysis.simulation import simulate, simulate_batch
from agv_analysis.simulation.batch import cores
from agv_analysis.simulation.reference import reference_of
from agv_analysis.simulation.single import steps_of
from agv_analysis.stability import joint_spectral_radius, lifted, mean_square, paper
from agv_analysis.stability.scenario_loop import loop_along

TO_1_CM = "to 1 cm [steps]"
SHARE_OF_K_THETA = "K_y / K_theta^2"
LARGEST = "largest error [m]"


def tables() -> Iterator[Table]:
    """The future work, part by part."""
    along = "Error along the track, 5 m: the fastest K_x beside the paper's"
    yield Table("gain_along", along, _gains_along(), 2, [TO_1_CM])
    rows = [*_gains_across("1 m across", (1.0, 0.0, 0.0)), *_gains_across("0.5 rad", (0.0, 0.0, 0.5))]
    across = "Errors across the track and of heading: the fastest K_y for each K_theta"
    yield Table("gains_across", across, rows, 2, [SHARE_OF_K_THETA])
    losses = "Independent losses, from 5 m: median of the integral of |y_r - y_c| over a lap; share of twins that part"
    yield Table("loss_probability", losses, _losses(), 2, _by_gain("[m s]"))
    yield Table("mean_burst", "20 % of the poses lost, by mean burst: the same", _mean_bursts(), 2, _by_gain("[m s]"))
    single = "One burst, from step 1 on: steps from 5 m to 2 %, overshoot"
    yield Table("single_burst", single, _single_bursts(), 2, _by_gain("[steps]"))
    limit = "K_x = 25, n lost after each received pose: what a limit on |v| makes of it"
    yield Table("limit", limit, _limits(), 1, [f"{name}: {LARGEST}" for name in LIMITS])
    yield from policy_tables()
    criteria = "Largest n [slots] that is stable, by criterion and by twins driven for a lap"
    compared = ["constant n", "constant n, twins", "bursts", "bursts, twins"]
    yield Table("criteria", criteria, _criteria(), 2, compared)


def policy_tables() -> Iterator[Table]:
    """Policies for outages, ranked."""
    title = "K_x = 25 on the track, one lap: staleness policies on the same outages"
    yield Table("staleness_policies", title, [*policies.edge()], 3, [policies.ERROR])
    title = "The same for outages of the downlink"
    yield Table("downlink_policies", title, [*policies.downlink()], 2, [policies.ERROR])


def _by_gain(quantity: str) -> list[str]:
    """The columns of a quantity, one a gain."""
    return [f"K_x = {kx:g} {quantity}" for kx in GAINS]


# -- gains -------------------------------------------------------------------------------------------------------------


def _gains_along() -> list[Values]:
    rows: list[Values] = []
    gains = sorted({*GAINS, *map(float, range(5, 400, 5))})
    for name, v_max in LIMITS.items():
        found = simulate_batch([scenario(*gain(kx, v_max), "plant.duration=10.0") for kx in gains], [1])[:, 0]
        steps = np.where(found["settle_1cm_steps"] < 0, np.iinfo(np.int64).max, found["settle_1cm_steps"])
        for index in (*map(gains.index, GAINS), int(np.argmin(steps))):
            rows.append({
                "speed": name,
                "K_x [1/s]": gains[index],
                TO_1_CM: _reached(found["settle_1cm_steps"][index]),
                "overshoot": float(found["overshoot"][index]),
            })  # fmt: skip
    return rows


def _reached(steps: int) -> int | None:
    return None if steps < 0 else int(steps)


def _gains_across(name: str, offset: tuple[float, float, float]) -> list[Values]:
    """For each K_theta the K_y, as a share of K_theta^2, with which both errors are gone first.

    Along the path the errors obey y'' + K_theta y' + K_y y = 0 to first order: critically damped at a share of 1/4.
    """
    start = [value + moved for value, moved in zip((0.0, 0.0, 0.5 * math.pi), offset, strict=True)]
    rows: list[Values] = []
    for ktheta in (2.0, 4.0, 8.0):
        tried = {
            share: settling_across(share * ktheta**2, ktheta, start) for share in np.arange(0.05, 1.01, 0.05).tolist()
        }
        best = min(tried, key=lambda share: _never_last(tried[share]))
        rows.append({
            "error": name,
            "K_theta [1/m]": ktheta,
            "K_y [1/m^2]": best * ktheta**2,
            SHARE_OF_K_THETA: best,
            "to 1 cm, 0.01 rad [steps]": tried[best],
        })  # fmt: skip
    return rows


def _never_last(steps: int | None) -> float:
    return math.inf if steps is None else steps


def settling_across(ky: float, ktheta: float, start: Sequence[float]) -> int | None:
    """First step from which on |y_e| stays below 1 cm and |theta_e| below 0.01 rad."""
    gains = (f"controller.ky={ky}", f"controller.ktheta={ktheta}")
    found = convergence(simulate(scenario(*gains, f"plant.initial_pose={list(start)}", "plant.duration=15.0")))
    steps = (found.y_e.settle_1cm_steps, found.theta_e.settle_1cm_steps)
    return None if None in steps else max(step for step in steps if step is not None)


# -- outages -----------------------------------------------------------------------------------------------------------


def _losses() -> list[Values]:
    points = {p: ("relay.uplink.model=bernoulli", f"relay.uplink.p={p}") for p in (0.0, 0.2, 0.4, 0.6, 0.8, 0.9)}
    return _converge("p", points)


def _mean_bursts() -> list[Values]:
    rate = 0.2
    points = {
        burst: (
            "relay.uplink.model=gilbert_elliott",
            f"relay.uplink.p={rate / (1.0 - rate) / burst}",
            f"relay.uplink.r={1.0 / burst}",
        )
        for burst in (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
    }
    return _converge("mean burst [slots]", points)


def _converge(name: str, points: Mapping[float, tuple[str, ...]]) -> list[Values]:
    """One row for each point and limit on the speed: by K_x the median of the IAE and the share of twins that part."""
    kinds = [(value, limit) for value in points for limit in LIMITS]
    wanted = [scenario(*gain(kx, LIMITS[limit]), *points[value]) for value, limit in kinds for kx in GAINS]
    found = simulate_batch(wanted, list(SEEDS), twins=True).reshape(len(kinds), len(GAINS), len(SEEDS))
    rows: list[Values] = []
    for (value, limit), by_gain in zip(kinds, found, strict=True):
        row: Values = {name: value, "speed": limit}
        for kx, runs in zip(GAINS, by_gain, strict=True):
            row[f"K_x = {kx:g} [m s]"] = float(np.median(runs["iae"]))
            row[f"K_x = {kx:g} part"] = float(np.mean(~(runs["contraction"] < CLOSER)))
        rows.append(row)
    return rows


def _single_bursts() -> list[Values]:
    rows: list[Values] = []
    for n in (5, 10, 20, 50, 100):
        outage = ("relay.uplink.model=burst", f"relay.uplink.n={n}", "relay.uplink.start_step=1")
        for limit, v_max in LIMITS.items():
            row: Values = {"n": n, "speed": limit}
            for kx in GAINS:
                found = convergence(simulate(scenario(*gain(kx, v_max), *outage, "plant.duration=10.0")))
                row[f"K_x = {kx:g} [steps]"] = found.y.settle_2pct_steps
                row[f"K_x = {kx:g} overshoot"] = found.y.overshoot
            rows.append(row)
    return rows


def _limits() -> list[Values]:
    rows: list[Values] = []
    for n in (10, 14, 16, 20, 40):
        row: Values = {"n": n}
        for limit, v_max in LIMITS.items():
            wanted = scenario(*gain(25.0, v_max), ON_TRACK, "relay.uplink.model=burst", f"relay.uplink.n={n}")
            found = simulate_batch([wanted], [1], twins=True)[0, 0]
            row[f"{limit}: {LARGEST}"] = float(found["position_peak"])
            row[f"{limit}: twins"] = "come closer" if found["contraction"] < CLOSER else "part"
        rows.append(row)
    return rows


# -- criteria ----------------------------------------------------------------------------------------------------------


def _criteria() -> list[Values]:
    loops = [(track, kx) for track in ("line", "paper") for kx in (*GAINS, 200.0)]
    with ThreadPoolExecutor(cores()) as pool:
        return list(pool.map(lambda loop: _criteria_at(*loop), loops))


def _criteria_at(track: str, kx: float) -> Values:
    settings = (*gain(kx), ON_TRACK, f"error_detector.track={track}")
    wanted, burst = scenario(*settings), (*settings, "relay.uplink.model=burst")
    reference = reference_of(wanted.error_detector, steps_of(wanted))
    loop = loop_along(wanted, reference)
    n_paper = paper.largest_n(reference[:, 2], reference[:, 3], wanted.controller, wanted.plant.ts)
    n_bursts, _ = joint_spectral_radius.largest_n(loop)
    n_constant = lifted.largest_n(loop)
    return {
        "track": track,
        "K_x [1/s]": kx,
        "paper's test": "any" if n_paper is None else n_paper,
        "constant n": n_constant,
        "constant n, twins": _largest(lambda n: constant_delay.contraction(wanted, n) < CLOSER, n_constant or 0),
        "bursts": n_bursts,
        "bursts, twins": _largest(lambda n: _contracts(*burst, f"relay.uplink.n={n}"), n_bursts or 0),
        "independent losses, mean square": mean_square.critical_loss(loop),
    }


def _contracts(*settings: str) -> bool:
    """Do twins on the track come closer?"""
    return bool(simulate_batch([scenario(*settings)], [1], twins=True)["contraction"][0, 0] < CLOSER)


def _largest(is_stable: Callable[[int], bool], guess: int) -> int:
    """Largest n that is stable, searched for from a guess on; -1 if not even 0 is."""
    n = max(0, guess)
    while n >= 0 and not is_stable(n):
        n -= 1
    while n >= 0 and is_stable(n + 1):
        n += 1
    return n
