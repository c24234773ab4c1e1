"""The claims of the paper's text, in its order: how each is measured, and what makes it hold."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from agv_analysis.reproduce import measurements
from agv_analysis.reproduce.claim import FAILS, HOLDS, PART, REMARK, Claim, Judgement, Values, holds_if
from agv_analysis.reproduce.measurements import HIGH, LIMITS, MIDDLE, ON_TRACK
from agv_analysis.reproduce.runs import GAINS, LIMIT

__all__ = ["CLAIMS", "LIMITS", "ON_TRACK"]

CLOSE = 0.05
"""What differs by less than this share is taken for equal: a figure is not read more exactly."""


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
        measurements.final_errors, lambda values: holds_if(max(values.values()) < 0.01),
    ),
    Claim(
        "discretisation", "III, eq. 15", "For a small T_s Euler's step approximates the motion of the AGV.",
        measurements.discretisation, lambda values: holds_if(max(values.values()) < 0.01),
    ),
    Claim(
        "error_dynamics", "IV, eq. 20",
        "Substituting the control rule into eq. 22 gives eq. 20 (here: slope of d theta_e/dt over row 3).",
        measurements.error_rates,
        lambda values: holds_if(
            abs(values["of eq. 20"] - 1.0) < CLOSE, "the bracket of row 3 needs a minus sign: a misprint"
        ),
    ),
    Claim(
        "stable_without_outages", "IV", "Without outages the control rule keeps the system stable (K_x = 5, 25, 250).",
        measurements.without_outages, lambda values: holds_if(max(values.values()) < 1.0),
    ),
    Claim(
        "stable_for_any_gain", "IV", "Without outages it does so for any K_x above 0, as in continuous time.",
        measurements.on_either_side_of_the_border,
        lambda values: holds_if(max(values.values()) < 1.0, "sampled, only while T_s K_x < 2: beyond it twins part"),
    ),
    Claim(
        "equilibrium", "IV", "At zero error the AGV stays on its reference, without outages.",
        measurements.zero_stays_zero,
        lambda values: holds_if(max(values.values()) < 1e-9),  # the wire loses a last digit of the angle
    ),
    Claim(
        "equilibrium_under_outages", "IV", "Under outages, too, zero error is an equilibrium.",
        measurements.zero_under_outages,
        lambda values: holds_if(
            max(values.values()) < 1e-9, "X_r(k) is compared with X_c(k - n), so the AGV runs ahead of its reference"
        ),
    ),
    Claim(
        "criterion_sufficient", "IV, eq. 21, 24; VI",
        "The loop is stable under n_ul outages if all eigenvalues of A(k) are below 1.",
        measurements.outage_test, _judge_outage_test,
    ),
    Claim(
        "outages_decide", "VI", "Stability depends on the number of consecutive outages.",
        measurements.outages_and_stability,
        lambda values: holds_if(min(values.values()) < 1.0 < max(values.values())),
    ),
    Claim(
        "eigenvalues_on_curves", "IV, eq. 21; VI", "The eigenvalues of A(k) depend on n_ul: on a curved track.",
        lambda runs: measurements.outages_on("paper"),
        lambda values: holds_if(
            _differ(values),
            f"by {np.ptp(list(values.values())):.1g}: none comes to 1, however long the outage"
            if max(values.values()) < 1.0 else "",
        ),
    ),
    Claim(
        "eigenvalues_on_a_line", "IV, eq. 21; VI", "The eigenvalues of A(k) depend on n_ul: on a straight track.",
        lambda runs: measurements.outages_on("line"),
        lambda values: holds_if(
            _differ(values), "theta_c(k) is theta_c(k - n) there, and n_ul enters through the turn between them alone"
        ),
    ),
    Claim(
        "criterion_necessary", "IV, eq. 24", "Stability needs 0 < |lambda|.",
        measurements.deadbeat,
        lambda values: holds_if(
            values["smallest |lambda|"] > 1e-9 or values["to 1 cm [steps]"] is None,
            "an eigenvalue of 0 is the fastest convergence that there is (deadbeat, K_x = 1/T_s)",
        ),
    ),
    Claim(
        "lap", "V-A", "The track is traced in T = 100 s, N = T / T_s steps.",
        measurements.closing,
        lambda values: holds_if(values["steps"] == 20000 and values["gap of the last step [m]"] < 0.01),
    ),
    Claim(
        "time_constant", "V-B", "1/K_x is the time constant at which the error decreases.",
        measurements.time_constants, _judge_time_constants,
    ),
    Claim(
        "start", "V-B", "The AGV starts 5 m away from the reference in y, at k = 1.",
        measurements.start,
        lambda values: holds_if(
            abs(abs(values["y_r - y_c at k = 0 [m]"]) - 5.0) < 1e-9,
            "k counts from 1 in Matlab, here from 0; the AGV is ahead, its error in y is along its heading",
        ),
    ),
    Claim(
        "faster_with_gain", "V-B", "K_x = 5, 25 and 250 take fewer and fewer steps until the AGV is back (unlimited).",
        lambda runs: measurements.settling_steps(runs, math.inf), lambda values: holds_if(_decreasing(values)),
    ),
    Claim(
        "faster_with_any_gain", "V-B", "The higher K_x, the fewer steps until the AGV is back (unlimited).",
        measurements.settling_of_many,
        lambda values: holds_if(_decreasing(values), "only up to K_x = 1/T_s = 200, from where on it rises again"),
    ),
    Claim(
        "y_direction", "V-B, VI", "K_x is the parameter of an error in y-direction (here with the heading along x).",
        measurements.settling_across,
        lambda values: holds_if(
            _decreasing(values), "it is that of an error along the AGV: across it, a higher K_x does not make it faster"
        ),
    ),
    Claim(
        "oscillation", "V-B", "At K_x = 250 the AGV oscillates before it returns (unlimited).",
        measurements.oscillation, lambda values: holds_if(values["sign changes"] > 0),
    ),
    Claim(
        "required_speed_at_start", "V-B", "K_x = 5 requires v = -25 m/s at the start, k = 1.",
        measurements.required_at_start,
        lambda values: holds_if(
            abs(values["v(0) [m/s]"] + 25.0) < CLOSE * 25.0, "the reference drives 0.5 m/s, which adds to K_x x_e"
        ),
    ),
    Claim(
        "required_speed", "V-B", "K_x = 5 requires v = -25 m/s from k = 1 to 20.",
        measurements.required_speed, _judge_required_speed,
    ),
    Claim(
        "faster_unlimited", "V-B", "Without a limit on v the error converges in fewer steps.",
        measurements.faster_unlimited,
        lambda values: holds_if(
            all(values[f"unlimited, {name}"] < values[f"limited, {name}"] for name in _gain_names())
        ),
    ),
    Claim(
        "limited_impact", "V-B, VI", "With |v| <= 6 m/s, K_x has no substantial impact on the convergence.",
        measurements.spreads, _judge_spreads,
    ),
    Claim(
        "similar", "V-B", "With |v| <= 6 m/s, K_x = 25 and 250 show similar errors over time.",
        measurements.similar, _judge_similar,
    ),
    Claim(
        "over_damped", "V-B", "With |v| <= 6 m/s, K_x = 5 is over-damped: v approaches v_r gradually.",
        measurements.limited_low, lambda values: holds_if(values["damping"] == "over"),
    ),
    Claim(
        "slowest", "V-B", "With |v| <= 6 m/s, K_x = 5 takes the most steps.",
        lambda runs: measurements.settling_steps(runs, LIMIT), lambda values: holds_if(_decreasing(values)),
    ),
    Claim(
        "under_damped", "V-B", "With |v| <= 6 m/s, K_x = 250 is under-damped: v oscillates around v_r.",
        measurements.limited_high,
        lambda values: holds_if(values["damping"] == "under" and values["sign changes of v - v_r"] > 0),
    ),
    Claim(
        "more_oscillation", "V-B", "The higher the oscillations of v, the longer it takes to converge.",
        measurements.more_oscillation, lambda values: holds_if(_increasing(values)),
    ),
    Claim(
        "oscillation_is_slower", "V-B", "v converges in less steps without oscillation (25) than with it (250).",
        lambda runs: measurements.command_settlings(runs, MIDDLE, HIGH),
        lambda values: holds_if(_increasing(values), "a small oscillation is faster than a gain that is too low"),
    ),
    Claim(
        "critical", "V-B, VI", "Critical damping is achieved at K_x = 25, with and without limit.",
        measurements.damping_classes, _judge_damping,
    ),
    Claim(
        "only_critical", "V-B, VI", "K_x = 25 is the gain of critical damping.",
        measurements.critical_gains,
        lambda values: holds_if(
            set(values.values()) == {MIDDLE},
            "so is every other gain of a wide range: a loop of first order has no single one",
        ),
    ),
    Claim(
        "optimum_of_three", "V-B", "Of K_x = 5, 25 and 250, v converges fastest without oscillation at 25.",
        measurements.of_three, _judge_of_three,
    ),
    Claim(
        "optimum", "VI", "The optimal K_x, whose v converges fastest without oscillation, is 25 (unlimited).",
        lambda runs: measurements.fastest_without_oscillation(math.inf), _judge_optimum,
    ),
    Claim(
        "optimum_limited", "V-B, VI", "With |v| <= 6 m/s the optimal K_x is 25 as well.",
        lambda runs: measurements.fastest_without_oscillation(LIMIT), _judge_optimum,
    ),
    Claim(
        "impact", "VI", "The gain matters more without a limit on v.",
        measurements.spreads,
        lambda values: holds_if(values["unlimited: slowest / fastest"] > values["limited: slowest / fastest"]),
    ),
)  # fmt: skip
"""The claims of the paper's text, in its order."""


def _gain_names() -> list[str]:
    return [f"K_x = {kx:g} [steps]" for kx in GAINS]
