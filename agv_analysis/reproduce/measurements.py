"""How the claims of the paper's text are measured."""

from __future__ import annotations

import functools
import math

import numpy as np

from agv_analysis.metrics.bands import SHARE
from agv_analysis.metrics.convergence import convergence
from agv_analysis.metrics.error_metrics import settling, sign_changes
from agv_analysis.reproduce import constant_delay
from agv_analysis.reproduce.claim import Values
from agv_analysis.reproduce.runs import GAINS, LIMIT, Runs, gain, scenario
from agv_analysis.run import Floats, Run
from agv_analysis.simulation import simulate, simulate_batch
from agv_analysis.simulation.reference import reference_of
from agv_analysis.simulation.single import steps_of
from agv_analysis.stability import lifted, paper
from agv_analysis.stability.scenario_loop import loop_along

LOW, MIDDLE, HIGH = GAINS
LIMITS = {"unlimited": math.inf, "limited": LIMIT}

ON_TRACK = "plant.initial_pose=[0.0, 0.0, 1.5707963267948966]"
"""The AGV starts on its reference."""


def settling_steps(runs: Runs, v_max: float, name: str = "") -> Values:
    """Steps until less than 1 cm is left, for each of the gains; `name` stands before theirs."""
    return {f"{name}K_x = {kx:g} [steps]": runs.found(*gain(kx, v_max)).settle_1cm_steps for kx in GAINS}


def _spread(values: Values) -> float:
    """The slowest settling as a multiple of the fastest; inf where something did not settle."""
    steps = list(values.values())
    return math.inf if None in steps else max(steps) / min(steps)


def closing(runs: Runs) -> Values:
    """Does the track close, and after how many steps?"""
    reference = runs.run(*gain(LOW)).reference
    return {
        "steps": len(reference),
        "gap of the last step [m]": float(np.hypot(*(reference[-1, :2] - reference[0, :2]))),
    }


def discretisation(runs: Runs) -> Values:
    """What Euler differs by from exact arcs over a lap."""
    arc = runs.run(ON_TRACK, "plant.integration=arc")
    beside = np.hypot(*(arc.reference[:, :2] - arc.pose[:, :2]).T)
    return {"exact arcs, off the reference at most [m]": float(beside.max())}


def zero_stays_zero(runs: Runs) -> Values:
    """An AGV that begins on its reference, without outages."""
    return {"off the reference at most [m]": runs.found(ON_TRACK).position.peak}


def zero_under_outages(runs: Runs) -> Values:
    """The same with outages."""
    outages = ("relay.uplink.model=burst", "relay.uplink.n=5")
    return {"outages of 5 [m]": runs.found(ON_TRACK, *outages).position.peak}


def error_rates(runs: Runs) -> Values:
    """Least-squares slope of the measured d theta_e/dt over the bracket of eq. 20, and over eq. 22."""
    run = runs.run("plant.initial_pose=[1.0, 0.0, 1.8]", "plant.duration=5.0")
    theta_e, v_r, gains = run.error[:, 2], run.reference[:, 3], run.scenario.controller
    rate = np.diff(theta_e) / run.ts
    printed = (v_r * (gains.ky * run.error[:, 1] + gains.ktheta * np.sin(theta_e)))[:-1]
    original = (run.reference[:, 4] - run.command[:, 1])[:-1]
    return {"of eq. 20": _slope(rate, printed), "of eq. 22": _slope(rate, original)}


def _slope(y: Floats, x: Floats) -> float:
    return float(x @ y / (x @ x))


def without_outages(runs: Runs) -> Values:
    """Growth per step without outages."""
    reference = runs.run(*gain(LOW)).reference
    loops = {kx: loop_along(scenario(*gain(kx)), reference) for kx in GAINS}
    return {f"K_x = {kx:g}: growth": lifted.largest_radius(loop, 0) for kx, loop in loops.items()}


def on_either_side_of_the_border(runs: Runs) -> Values:
    """How twins come closer, or part, on either side of K_x = 2 / T_s."""
    border = 2.0 / scenario().plant.ts
    return {
        f"K_x = {kx:g}: twins": _twins(*gain(kx), ON_TRACK, "plant.duration=10.0")
        for kx in (border - 1.0, border + 1.0)
    }


def _twins(*settings: str) -> float:
    """How far twins are apart in the end, as a multiple of what they were."""
    return float(simulate_batch([scenario(*settings)], [1], twins=True)["contraction"][0, 0])


def outage_test(runs: Runs) -> Values:
    """The paper's test, and what becomes of the loop, with a pose that is 13 steps old, on a line."""
    settings = (*gain(MIDDLE), ON_TRACK, "error_detector.track=line")
    long, short, old = scenario(*settings, "plant.duration=20.0"), scenario(*settings, "plant.duration=5.0"), 13
    return {
        f"line, {old} outages: |lambda|": _largest_radius("line", old),
        f"pose {old} steps old: error after 4000 steps [m]": constant_delay.final_error(long, old),
        f"pose {old} steps old: twins after 1000": constant_delay.contraction(short, old),
    }


def outages_on(track: str) -> Values:
    """The largest eigenvalue over a lap for more and more outages."""
    return {f"{n} outages: |lambda|": _largest_radius(track, n) for n in (0, 13, 200, 2000)}


def outages_and_stability(runs: Runs) -> Values:
    """Twins with ever older poses."""
    short = scenario(*gain(MIDDLE), ON_TRACK, "error_detector.track=line", "plant.duration=5.0")
    return {f"pose {n} steps old: twins after 1000": constant_delay.contraction(short, n) for n in (0, 12, 13)}


def _largest_radius(track: str, n: int) -> float:
    wanted = scenario(*gain(MIDDLE), f"error_detector.track={track}")
    reference = reference_of(wanted.error_detector, steps_of(wanted))
    held = np.maximum(np.arange(len(reference)) - n, 0)
    theta, v_r = reference[:, 2], reference[:, 3]
    return float(paper.spectral_radii(theta, theta[held], v_r[held], wanted.controller, wanted.plant.ts).max())


def deadbeat(runs: Runs) -> Values:
    """The gain 1/T_s."""
    kx = 1.0 / scenario().plant.ts
    run = runs.run(*gain(kx), "error_detector.track=line", "plant.duration=5.0")
    theta, v_r = run.pose[:1, 2], run.reference[:1, 3]
    eigenvalues = np.linalg.eigvals(paper.matrices(theta, theta, v_r, run.scenario.controller, run.ts)[0])
    return {
        "smallest |lambda|": float(np.abs(eigenvalues).min()),
        "to 1 cm [steps]": runs.found(*gain(kx), "error_detector.track=line", "plant.duration=5.0").settle_1cm_steps,
    }


def final_errors(runs: Runs) -> Values:
    """What is left at the end of the lap."""
    finals = [runs.found(*gain(kx, v_max)).position.final for v_max in LIMITS.values() for kx in GAINS]
    return {"largest of six runs at the end of the lap [m]": max(finals)}


def start(runs: Runs) -> Values:
    """The first step."""
    found = runs.found(*gain(LOW))
    return {"y_r - y_c at k = 0 [m]": found.y.initial, "error along the AGV [m]": found.x_e.initial}


def time_constants(runs: Runs) -> Values:
    """Time constant from the first step's decay of the error along the track, and 1/K_x."""
    found = {}
    for kx in GAINS:
        x_e = runs.run(*gain(kx)).error[:, 0]
        found[f"K_x = {kx:g} [ms]"] = -1e3 * scenario().plant.ts / math.log(abs(x_e[1] / x_e[0]))
    return found


def oscillation(runs: Runs) -> Values:
    """The error for the highest gain."""
    found = runs.found(*gain(HIGH))
    return {"overshoot": found.overshoot, "sign changes": found.y.sign_changes}


def required_speed(runs: Runs) -> Values:
    """The command for the lowest gain at three steps."""
    v = runs.run(*gain(LOW)).command[:, 0]
    return {f"v({k}) [m/s]": float(v[k]) for k in (0, 1, 19)}


def settling_of_many(runs: Runs) -> Values:
    """Settling for the paper's gains and beyond, up to where the loop is hardly stable; always simulated."""
    gains = (LOW, MIDDLE, 200.0, HIGH, 300.0, 390.0)
    short = "plant.duration=10.0"
    found = {kx: convergence(simulate(scenario(*gain(kx), short))) for kx in gains}
    return {f"K_x = {kx:g} [steps]": one.settle_1cm_steps for kx, one in found.items()}


def settling_across(runs: Runs) -> Values:
    """Settling of 5 m in y on a line along x, where y is across the AGV; always simulated."""
    start = ("plant.initial_pose=[0.0, 5.0, 0.0]", "error_detector.track_start=[0.0, 0.0, 0.0]")
    settings = (*start, "error_detector.track=line", "plant.duration=30.0")
    found = {kx: convergence(simulate(scenario(*gain(kx), *settings))) for kx in GAINS}
    return {f"heading 0, K_x = {kx:g} [steps]": one.settle_1cm_steps for kx, one in found.items()}


def required_at_start(runs: Runs) -> Values:
    """Its first command."""
    return {"v(0) [m/s]": float(runs.run(*gain(LOW)).command[0, 0])}


def faster_unlimited(runs: Runs) -> Values:
    """Settling with and without a limit on the speed."""
    return {**settling_steps(runs, math.inf, "unlimited, "), **settling_steps(runs, LIMIT, "limited, ")}


def spreads(runs: Runs) -> Values:
    """How much the gain matters, with and without a limit on the speed."""
    return {f"{name}: slowest / fastest": _spread(settling_steps(runs, v_max)) for name, v_max in LIMITS.items()}


def similar(runs: Runs) -> Values:
    """Settling under the limit, and how far two gains are apart."""

    def errors(kx: float) -> Floats:
        run = runs.run(*gain(kx, LIMIT))
        return np.asarray(run.reference[:, 1] - run.pose[:, 1])

    apart = float(np.abs(errors(MIDDLE) - errors(HIGH)).max())
    return {**settling_steps(runs, LIMIT), "25 and 250 apart at most, of 5 m": apart / abs(float(errors(MIDDLE)[0]))}


def damping_classes(runs: Runs) -> Values:
    """Damping for each gain and limit."""
    return {
        f"{name}, K_x = {kx:g}": runs.found(*gain(kx, v_max)).damping for name, v_max in LIMITS.items() for kx in GAINS
    }


def limited_low(runs: Runs) -> Values:
    """The lowest gain under the limit."""
    return {"damping": runs.found(*gain(LOW, LIMIT)).damping}


def limited_high(runs: Runs) -> Values:
    """The highest gain under the limit."""
    changes = _command_oscillations(runs.run(*gain(HIGH, LIMIT)))
    return {"damping": runs.found(*gain(HIGH, LIMIT)).damping, "sign changes of v - v_r": changes}


def more_oscillation(runs: Runs) -> Values:
    """Settling of the command for larger and larger oscillations."""
    return command_settlings(runs, HIGH, 300.0, 350.0)


def command_settlings(runs: Runs, *gains: float) -> Values:
    """Settling of the command without a limit on it."""
    return {f"K_x = {kx:g} [steps]": _command_settling(runs.run(*gain(kx), "plant.duration=5.0")) for kx in gains}


def _command_settling(run: Run) -> int | None:
    """First step from which on |v - v_r| is below 2 % of its largest value; None if that did not happen."""
    d = np.abs(run.command[:, 0] - run.reference[:, 3])
    return settling(d, SHARE * float(d.max()))


def of_three(runs: Runs) -> Values:
    """Settling of the command for the paper's gains that do not oscillate; None for those that do."""
    found: Values = {}
    for name, v_max in LIMITS.items():
        for kx in GAINS:
            run = runs.run(*gain(kx, v_max))
            steps = _command_settling(run)
            found[f"{name}, K_x = {kx:g} [steps]"] = "oscillates" if _command_oscillations(run) else steps
    return found


@functools.cache
def _scan(v_max: float) -> tuple[Run, ...]:
    """Runs with K_x = 5, 10 .. 395; always simulated."""
    return tuple(simulate(scenario(*gain(float(kx), v_max), "plant.duration=5.0")) for kx in range(5, 400, 5))


def fastest_without_oscillation(v_max: float) -> Values:
    """Of K_x = 5, 10 .. 395 the one whose command settles first without oscillating."""
    calm = [run for run in _scan(v_max) if not _command_oscillations(run)]
    best = min(calm, key=lambda run: math.inf if (steps := _command_settling(run)) is None else steps)
    (middle,) = (run for run in calm if run.scenario.controller.kx == MIDDLE)
    return {
        "fastest K_x [1/s]": best.scenario.controller.kx,
        "its command settles in [steps]": _command_settling(best),
        "its error is below 1 cm after [steps]": convergence(best).settle_1cm_steps,
        "K_x = 25: command [steps]": _command_settling(middle),
        "K_x = 25: error [steps]": convergence(middle).settle_1cm_steps,
    }


def critical_gains(runs: Runs) -> Values:
    """The smallest and the largest of K_x = 5, 10 .. 395 whose command is critically damped."""
    found: Values = {}
    for name, v_max in LIMITS.items():
        critical = [run.scenario.controller.kx for run in _scan(v_max) if convergence(run).damping == "critical"]
        found[f"{name}: from K_x [1/s]"] = min(critical, default=None)
        found[f"{name}: to K_x [1/s]"] = max(critical, default=None)
    return found


def _command_oscillations(run: Run) -> int:
    """How often v - v_r changes its sign beyond 2 % of its largest value."""
    d = run.command[:, 0] - run.reference[:, 3]
    return sign_changes(d, SHARE * float(np.abs(d).max()))
