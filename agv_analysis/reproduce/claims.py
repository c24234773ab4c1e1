"""The claims of the paper's text, in its order: how each is measured, and what makes it hold."""

from __future__ import annotations

import functools
import math
from itertools import pairwise

import numpy as np

from agv_analysis.metrics.bands import SHARE
from agv_analysis.metrics.convergence import convergence
from agv_analysis.metrics.error_metrics import settling, sign_changes
from agv_analysis.reproduce import constant_delay
from agv_analysis.reproduce.claim import FAILS, HOLDS, PART, REMARK, Claim, Judgement, Values, holds_if
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

CLOSE = 0.05
"""What differs by less than this share is taken for equal: a figure is not read more exactly."""


# -- what is measured --------------------------------------------------------------------------------------------------


def _settling(runs: Runs, v_max: float, name: str = "") -> Values:
    return {f"{name}K_x = {kx:g} [steps]": runs.found(*gain(kx, v_max)).settle_1cm_steps for kx in GAINS}


def _spread(values: Values) -> float:
    """The slowest settling as a multiple of the fastest; inf where something did not settle."""
    steps = list(values.values())
    return math.inf if None in steps else max(steps) / min(steps)


def _closing(runs: Runs) -> Values:
    reference = runs.run(*gain(LOW)).reference
    return {
        "steps": len(reference),
        "gap of the last step [m]": float(np.hypot(*(reference[-1, :2] - reference[0, :2]))),
    }


def _discretisation(runs: Runs) -> Values:
    arc = runs.run(ON_TRACK, "plant.integration=arc")
    beside = np.hypot(*(arc.reference[:, :2] - arc.pose[:, :2]).T)
    return {"exact arcs, off the reference at most [m]": float(beside.max())}


def _zero_stays_zero(runs: Runs) -> Values:
    return {"off the reference at most [m]": runs.found(ON_TRACK).position.peak}


def _zero_under_outages(runs: Runs) -> Values:
    outages = ("relay.uplink.model=burst", "relay.uplink.n=5")
    return {"outages of 5 [m]": runs.found(ON_TRACK, *outages).position.peak}


def _error_rates(runs: Runs) -> Values:
    """Least-squares slope of the measured d theta_e/dt over the bracket of eq. 365, and over eq. 400."""
    run = runs.run("plant.initial_pose=[1.0, 0.0, 1.8]", "plant.duration=5.0")
    theta_e, v_r, gains = run.error[:, 2], run.reference[:, 3], run.scenario.controller
    rate = np.diff(theta_e) / run.ts
    printed = (v_r * (gains.ky * run.error[:, 1] + gains.ktheta * np.sin(theta_e)))[:-1]
    original = (run.reference[:, 4] - run.command[:, 1])[:-1]
    return {"of eq. 365": _slope(rate, printed), "of eq. 400": _slope(rate, original)}


def _slope(y: Floats, x: Floats) -> float:
    return float(x @ y / (x @ x))


def _without_outages(runs: Runs) -> Values:
    """Growth per step without outages."""
    reference = runs.run(*gain(LOW)).reference
    loops = {kx: loop_along(scenario(*gain(kx)), reference) for kx in GAINS}
    return {f"K_x = {kx:g}: growth": lifted.largest_radius(loop, 0) for kx, loop in loops.items()}


def _on_either_side_of_the_border(runs: Runs) -> Values:
    """How twins come closer, or part, on either side of K_x = 2 / T_s."""
    border = 2.0 / scenario().plant.ts
    return {
        f"K_x = {kx:g}: twins": _twins(*gain(kx), ON_TRACK, "plant.duration=10.0")
        for kx in (border - 1.0, border + 1.0)
    }


def _twins(*settings: str) -> float:
    """How far twins are apart in the end, as a multiple of what they were."""
    return float(simulate_batch([scenario(*settings)], [1], twins=True)["contraction"][0, 0])


def _outage_test(runs: Runs) -> Values:
    """The paper's test, and what becomes of the loop, with a pose that is 13 steps old, on a line."""
    settings = (*gain(MIDDLE), ON_TRACK, "error_detector.track=line")
    long, short, old = scenario(*settings, "plant.duration=20.0"), scenario(*settings, "plant.duration=5.0"), 13
    return {
        f"line, {old} outages: |lambda|": _largest_radius("line", old),
        f"pose {old} steps old: error after 4000 steps [m]": constant_delay.final_error(long, old),
        f"pose {old} steps old: twins after 1000": constant_delay.contraction(short, old),
    }


def _outages_on(track: str) -> Values:
    """The largest eigenvalue over a lap for ever more outages."""
    return {f"{n} outages: |lambda|": _largest_radius(track, n) for n in (0, 13, 200, 2000)}


def _outages_and_stability(runs: Runs) -> Values:
    short = scenario(*gain(MIDDLE), ON_TRACK, "error_detector.track=line", "plant.duration=5.0")
    return {f"pose {n} steps old: twins after 1000": constant_delay.contraction(short, n) for n in (0, 12, 13)}


def _largest_radius(track: str, n: int) -> float:
    wanted = scenario(*gain(MIDDLE), f"error_detector.track={track}")
    reference = reference_of(wanted.error_detector, steps_of(wanted))
    held = np.maximum(np.arange(len(reference)) - n, 0)
    theta, v_r = reference[:, 2], reference[:, 3]
    return float(paper.spectral_radii(theta, theta[held], v_r[held], wanted.controller, wanted.plant.ts).max())


def _deadbeat(runs: Runs) -> Values:
    kx = 1.0 / scenario().plant.ts
    run = runs.run(*gain(kx), "error_detector.track=line", "plant.duration=5.0")
    theta, v_r = run.pose[:1, 2], run.reference[:1, 3]
    eigenvalues = np.linalg.eigvals(paper.matrices(theta, theta, v_r, run.scenario.controller, run.ts)[0])
    return {
        "smallest |lambda|": float(np.abs(eigenvalues).min()),
        "to 1 cm [steps]": runs.found(*gain(kx), "error_detector.track=line", "plant.duration=5.0").settle_1cm_steps,
    }


def _final_errors(runs: Runs) -> Values:
    finals = [runs.found(*gain(kx, v_max)).position.final for v_max in LIMITS.values() for kx in GAINS]
    return {"largest of six runs at the end of the lap [m]": max(finals)}


def _start(runs: Runs) -> Values:
    found = runs.found(*gain(LOW))
    return {"y_r - y_c at k = 0 [m]": found.y.initial, "error along the AGV [m]": found.x_e.initial}


def _time_constants(runs: Runs) -> Values:
    """Time constant from the first step's decay of the error along the track, and 1/K_x."""
    found = {}
    for kx in GAINS:
        x_e = runs.run(*gain(kx)).error[:, 0]
        found[f"K_x = {kx:g} [ms]"] = -1e3 * scenario().plant.ts / math.log(abs(x_e[1] / x_e[0]))
    return found


def _oscillation(runs: Runs) -> Values:
    found = runs.found(*gain(HIGH))
    return {"overshoot": found.overshoot, "sign changes": found.y.sign_changes}


def _required_speed(runs: Runs) -> Values:
    v = runs.run(*gain(LOW)).command[:, 0]
    return {f"v({k}) [m/s]": float(v[k]) for k in (0, 1, 19)}


def _settling_of_many(runs: Runs) -> Values:
    """Settling for the paper's gains and beyond, up to where the loop is hardly stable; always simulated."""
    gains = (LOW, MIDDLE, 200.0, HIGH, 300.0, 390.0)
    short = "plant.duration=10.0"
    found = {kx: convergence(simulate(scenario(*gain(kx), short))) for kx in gains}
    return {f"K_x = {kx:g} [steps]": one.settle_1cm_steps for kx, one in found.items()}


def _settling_across(runs: Runs) -> Values:
    """Settling of 5 m in y on a line along x, where y is across the AGV; always simulated."""
    start = ("plant.initial_pose=[0.0, 5.0, 0.0]", "error_detector.track_start=[0.0, 0.0, 0.0]")
    settings = (*start, "error_detector.track=line", "plant.duration=30.0")
    found = {kx: convergence(simulate(scenario(*gain(kx), *settings))) for kx in GAINS}
    return {f"heading 0, K_x = {kx:g} [steps]": one.settle_1cm_steps for kx, one in found.items()}


def _required_at_start(runs: Runs) -> Values:
    return {"v(0) [m/s]": float(runs.run(*gain(LOW)).command[0, 0])}


def _faster_unlimited(runs: Runs) -> Values:
    return {**_settling(runs, math.inf, "unlimited, "), **_settling(runs, LIMIT, "limited, ")}


def _spreads(runs: Runs) -> Values:
    return {f"{name}: slowest / fastest": _spread(_settling(runs, v_max)) for name, v_max in LIMITS.items()}


def _similar(runs: Runs) -> Values:
    def errors(kx: float) -> Floats:
        run = runs.run(*gain(kx, LIMIT))
        return np.asarray(run.reference[:, 1] - run.pose[:, 1])

    apart = float(np.abs(errors(MIDDLE) - errors(HIGH)).max())
    return {**_settling(runs, LIMIT), "25 and 250 apart at most, of 5 m": apart / abs(float(errors(MIDDLE)[0]))}


def _damping(runs: Runs) -> Values:
    return {
        f"{name}, K_x = {kx:g}": runs.found(*gain(kx, v_max)).damping for name, v_max in LIMITS.items() for kx in GAINS
    }


def _limited_low(runs: Runs) -> Values:
    return {"damping": runs.found(*gain(LOW, LIMIT)).damping}


def _limited_high(runs: Runs) -> Values:
    changes = _command_oscillations(runs.run(*gain(HIGH, LIMIT)))
    return {"damping": runs.found(*gain(HIGH, LIMIT)).damping, "sign changes of v - v_r": changes}


def _more_oscillation(runs: Runs) -> Values:
    """Settling of the command for ever larger oscillations."""
    return _command_settlings(runs, HIGH, 300.0, 350.0)


def _command_settlings(runs: Runs, *gains: float) -> Values:
    """Settling of the command without a limit on it."""
    return {f"K_x = {kx:g} [steps]": _command_settling(runs.run(*gain(kx), "plant.duration=5.0")) for kx in gains}


def _command_settling(run: Run) -> int | None:
    """First step from which on |v - v_r| is below 2 % of its largest value; None if that did not happen."""
    d = np.abs(run.command[:, 0] - run.reference[:, 3])
    return settling(d, SHARE * float(d.max()))


def _of_three(runs: Runs) -> Values:
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


def _fastest_without_oscillation(v_max: float) -> Values:
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


def _critical_gains(runs: Runs) -> Values:
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


# -- how it is judged --------------------------------------------------------------------------------------------------


def _decreasing(values: Values) -> bool:
    steps = list(values.values())
    return None not in steps and all(a > b for a, b in pairwise(steps))


def _judge_outage_test(values: Values) -> Judgement:
    radius, _, twins = values.values()
    if radius >= 1.0 or twins < 1.0:
        return Judgement(HOLDS)
    return Judgement(FAILS, "all eigenvalues are below 1, yet the error grows without bound")


def _differ(values: Values) -> bool:
    """Do measured numbers differ by more than rounding?"""
    return bool(np.ptp(list(values.values())) > 1e-12)


def _judge_damping(values: Values) -> Judgement:
    expected = ["over", "critical", "under"]
    return holds_if(
        list(values.values()) == 2 * expected,
        "critical as far as a loop of first order can be: settled within 0.25 s after saturation, without oscillation",
    )


def _judge_required_speed(values: Values) -> Judgement:
    near = [abs(v + 25.0) < CLOSE * 25.0 for v in values.values()]
    if all(near):
        return Judgement(HOLDS)
    return Judgement(FAILS, "it decays by 1 - T_s K_x a step from the first one on")


def _judge_time_constants(values: Values) -> Judgement:
    error = max(abs(ms * kx / 1e3 - 1.0) for ms, kx in zip(values.values(), GAINS, strict=True))
    if error < CLOSE:
        return Judgement(HOLDS)
    remark = (
        "in discrete time -T_s / ln|1 - T_s K_x|: the larger K_x, the farther from 1/K_x; from 200 on it rises again"
    )
    return Judgement(REMARK if error < 4.0 * CLOSE else FAILS, remark)


def _judge_spreads(values: Values) -> Judgement:
    unlimited, limited = values.values()
    if limited > 0.1 * unlimited:
        return Judgement(FAILS)
    if limited <= 1.0 + CLOSE:
        return Judgement(HOLDS)
    return Judgement(PART, f"far less than without a limit, but the slowest still takes {limited:.2g} times as long")


def _judge_of_three(values: Values) -> Judgement:
    for name in LIMITS:
        steps = {key: value for key, value in values.items() if key.startswith(name) and isinstance(value, int)}
        if not steps or min(steps, key=lambda key: steps[key]) != f"{name}, K_x = {MIDDLE:g} [steps]":
            return Judgement(FAILS)
    return Judgement(HOLDS)


def _judge_optimum(values: Values) -> Judgement:
    best, steps, _, of_middle, _ = values.values()
    if best == MIDDLE:
        return Judgement(HOLDS)
    return Judgement(FAILS, f"by this rule itself {best:g} is the best of 5 .. 395: steps {steps} against {of_middle}")


def _judge_similar(values: Values) -> Judgement:
    *_, apart = values.values()
    steps = list(values.values())[1:3]
    if None in steps or apart > 0.1:
        return Judgement(FAILS)
    return holds_if(True, "" if apart < CLOSE else f"but for {apart:.0%} of the initial error")


def _increasing(values: Values) -> bool:
    steps = list(values.values())
    return None not in steps and all(a < b for a, b in pairwise(steps))


CLAIMS = (
    Claim(
        "error_to_zero", "II, V-A", "The feedback directs the error to zero as k goes to N.",
        _final_errors, lambda values: holds_if(max(values.values()) < 0.01),
    ),
    Claim(
        "discretisation", "III, eq. 20", "For a small T_s Euler's step approximates the motion of the AGV.",
        _discretisation, lambda values: holds_if(max(values.values()) < 0.01),
    ),
    Claim(
        "error_dynamics", "IV, eq. 365",
        "Substituting the control rule into eq. 400 gives eq. 365 (here: slope of d theta_e/dt over row 3).",
        _error_rates,
        lambda values: holds_if(
            abs(values["of eq. 365"] - 1.0) < CLOSE, "the bracket of row 3 needs a minus sign: a misprint"
        ),
    ),
    Claim(
        "stable_without_outages", "IV", "Without outages the control rule keeps the system stable (K_x = 5, 25, 250).",
        _without_outages, lambda values: holds_if(max(values.values()) < 1.0),
    ),
    Claim(
        "stable_for_any_gain", "IV", "Without outages it does so for any K_x above 0, as in continuous time.",
        _on_either_side_of_the_border,
        lambda values: holds_if(max(values.values()) < 1.0, "sampled, only while T_s K_x < 2: beyond it twins part"),
    ),
    Claim(
        "equilibrium", "IV", "At zero error the AGV stays on its reference, without outages.",
        _zero_stays_zero,
        lambda values: holds_if(max(values.values()) < 1e-9),  # the wire loses a last digit of the angle
    ),
    Claim(
        "equilibrium_under_outages", "IV", "Under outages, too, zero error is an equilibrium.",
        _zero_under_outages,
        lambda values: holds_if(
            max(values.values()) < 1e-9, "X_r(k) is compared with X_c(k - n), so the AGV runs ahead of its reference"
        ),
    ),
    Claim(
        "criterion_sufficient", "IV, eq. 55, 56; VI",
        "The loop is stable under n_ul outages if all eigenvalues of A(k) are below 1.",
        _outage_test, _judge_outage_test,
    ),
    Claim(
        "outages_decide", "VI", "Stability depends on the number of consecutive outages.",
        _outages_and_stability,
        lambda values: holds_if(min(values.values()) < 1.0 < max(values.values())),
    ),
    Claim(
        "eigenvalues_on_curves", "IV, eq. 55; VI", "The eigenvalues of A(k) depend on n_ul: on a curved track.",
        lambda runs: _outages_on("paper"),
        lambda values: holds_if(
            _differ(values),
            f"by {np.ptp(list(values.values())):.1g}: none comes to 1, however long the outage"
            if max(values.values()) < 1.0 else "",
        ),
    ),
    Claim(
        "eigenvalues_on_a_line", "IV, eq. 55; VI", "The eigenvalues of A(k) depend on n_ul: on a straight track.",
        lambda runs: _outages_on("line"),
        lambda values: holds_if(
            _differ(values), "theta_c(k) is theta_c(k - n) there, and n_ul enters through the turn between them alone"
        ),
    ),
    Claim(
        "criterion_necessary", "IV, eq. 56", "Stability needs 0 < |lambda|.",
        _deadbeat,
        lambda values: holds_if(
            values["smallest |lambda|"] > 1e-9 or values["to 1 cm [steps]"] is None,
            "an eigenvalue of 0 is the fastest convergence that there is (deadbeat, K_x = 1/T_s)",
        ),
    ),
    Claim(
        "lap", "V-A", "The track is traced in T = 100 s, N = T / T_s steps.",
        _closing, lambda values: holds_if(values["steps"] == 20000 and values["gap of the last step [m]"] < 0.01),
    ),
    Claim(
        "time_constant", "V-B", "1/K_x is the time constant at which the error decreases.",
        _time_constants, _judge_time_constants,
    ),
    Claim(
        "start", "V-B", "The AGV starts 5 m away from the reference in y, at k = 1.",
        _start,
        lambda values: holds_if(
            abs(abs(values["y_r - y_c at k = 0 [m]"]) - 5.0) < 1e-9,
            "k counts from 1 in Matlab, here from 0; the AGV is ahead, its error in y is along its heading",
        ),
    ),
    Claim(
        "faster_with_gain", "V-B", "K_x = 5, 25 and 250 take fewer and fewer steps until the AGV is back (unlimited).",
        lambda runs: _settling(runs, math.inf), lambda values: holds_if(_decreasing(values)),
    ),
    Claim(
        "faster_with_any_gain", "V-B", "The higher K_x, the fewer steps until the AGV is back (unlimited).",
        _settling_of_many,
        lambda values: holds_if(_decreasing(values), "only up to K_x = 1/T_s = 200, from where on it rises again"),
    ),
    Claim(
        "y_direction", "V-B, VI", "K_x is the parameter of an error in y-direction (here with the heading along x).",
        _settling_across,
        lambda values: holds_if(
            _decreasing(values), "it is that of an error along the AGV: across it, a higher K_x does not make it faster"
        ),
    ),
    Claim(
        "oscillation", "V-B", "At K_x = 250 the AGV oscillates before it returns (unlimited).",
        _oscillation, lambda values: holds_if(values["sign changes"] > 0),
    ),
    Claim(
        "required_speed_at_start", "V-B", "K_x = 5 requires v = -25 m/s at the start, k = 1.",
        _required_at_start,
        lambda values: holds_if(
            abs(values["v(0) [m/s]"] + 25.0) < CLOSE * 25.0, "the reference drives 0.5 m/s, which adds to K_x x_e"
        ),
    ),
    Claim(
        "required_speed", "V-B", "K_x = 5 requires v = -25 m/s from k = 1 to 20.",
        _required_speed, _judge_required_speed,
    ),
    Claim(
        "faster_unlimited", "V-B", "Without a limit on v the error converges in fewer steps.",
        _faster_unlimited,
        lambda values: holds_if(
            all(values[f"unlimited, {name}"] < values[f"limited, {name}"] for name in _gain_names())
        ),
    ),
    Claim(
        "limited_impact", "V-B, VI", "With |v| <= 6 m/s, K_x has no substantial impact on the convergence.",
        _spreads, _judge_spreads,
    ),
    Claim(
        "similar", "V-B", "With |v| <= 6 m/s, K_x = 25 and 250 show similar errors over time.",
        _similar, _judge_similar,
    ),
    Claim(
        "over_damped", "V-B", "With |v| <= 6 m/s, K_x = 5 is over-damped: v approaches v_r gradually.",
        _limited_low, lambda values: holds_if(values["damping"] == "over"),
    ),
    Claim(
        "slowest", "V-B", "With |v| <= 6 m/s, K_x = 5 takes the most steps.",
        lambda runs: _settling(runs, LIMIT), lambda values: holds_if(_decreasing(values)),
    ),
    Claim(
        "under_damped", "V-B", "With |v| <= 6 m/s, K_x = 250 is under-damped: v oscillates around v_r.",
        _limited_high,
        lambda values: holds_if(values["damping"] == "under" and values["sign changes of v - v_r"] > 0),
    ),
    Claim(
        "more_oscillation", "V-B", "The higher the oscillations of v, the longer it takes to converge.",
        _more_oscillation, lambda values: holds_if(_increasing(values)),
    ),
    Claim(
        "oscillation_is_slower", "V-B", "v converges in less steps without oscillation (25) than with it (250).",
        lambda runs: _command_settlings(runs, MIDDLE, HIGH),
        lambda values: holds_if(_increasing(values), "a small oscillation is faster than a gain that is too low"),
    ),
    Claim(
        "critical", "V-B, VI", "Critical damping is achieved at K_x = 25, with and without limit.",
        _damping, _judge_damping,
    ),
    Claim(
        "only_critical", "V-B, VI", "K_x = 25 is the gain of critical damping.",
        _critical_gains,
        lambda values: holds_if(
            set(values.values()) == {MIDDLE},
            "so is every other gain of a wide range: a loop of first order has no single one",
        ),
    ),
    Claim(
        "optimum_of_three", "V-B", "Of K_x = 5, 25 and 250, v converges fastest without oscillation at 25.",
        _of_three, _judge_of_three,
    ),
    Claim(
        "optimum", "VI", "The optimal K_x, whose v converges fastest without oscillation, is 25 (unlimited).",
        lambda runs: _fastest_without_oscillation(math.inf), _judge_optimum,
    ),
    Claim(
        "optimum_limited", "V-B, VI", "With |v| <= 6 m/s the optimal K_x is 25 as well.",
        lambda runs: _fastest_without_oscillation(LIMIT), _judge_optimum,
    ),
    Claim(
        "impact", "VI", "The gain matters more without a limit on v.",
        _spreads,
        lambda values: holds_if(values["unlimited: slowest / fastest"] > values["limited: slowest / fastest"]),
    ),
)  # fmt: skip
"""The claims of the paper's text, in its order."""


def _gain_names() -> list[str]:
    return [f"K_x = {kx:g} [steps]" for kx in GAINS]
