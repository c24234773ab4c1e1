"""The lifted system: what if every pose were as old as the oldest?"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from agv_analysis.json_values import finite
from agv_analysis.scenario import Scenario
from agv_analysis.stability import floquet, lifted
from agv_analysis.stability.criteria.criterion import (
    PLACES_OF_LONG_LAP,
    Border,
    Criterion,
    Judgement,
    MapColumn,
    Margin,
    Row,
    RunFacts,
    ScenarioFacts,
    steps_text,
)
from agv_analysis.stability.first_border import stable_again
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.margin_map_points import LIMIT, largest_delays
from agv_analysis.stability.scenario_loop import straight_loop_of
from agv_plant.parameters import ChannelParameters
from agv_ros.counted import counted

LONGEST, LONGEST_PREDICTED = 10_000, 1000
"""Longest constant delay [steps] that is tried; shorter behind a predictor, where each takes longer."""

_ROUNDING = 1e-9
"""A delay this much [steps] over whole steps is whole."""

_PLACES = 100
"""Places of the track that are asked at once: all of them would take longer than the lap."""


def _judge(facts: RunFacts) -> Judgement | None:
    if not facts.is_feasible:
        return None
    radius = lifted.largest_radius(facts.loop.thinned(PLACES_OF_LONG_LAP), facts.n)
    return Judgement(
        f"Pose always {counted(facts.n, 'step')} old", radius < 1.0, f"lifted system, spectral radius {radius:.6g}",
        {"lifted_stable": radius < 1.0, "lifted_radius": finite(radius)}, radius,
    )  # fmt: skip


def _margins(facts: ScenarioFacts) -> Iterable[Margin]:
    name, label, loop = "n_max.lifted", "Pose always n steps old", facts.loop
    limit = 0 if loop.is_exact else LONGEST_PREDICTED if loop.predicts else LONGEST
    n = floquet.largest_constant_delay(loop, limit)
    if n is not None:
        yield Margin(name, label, n, steps_text(n, loop.ts), _longer_delays(loop, n, limit))
    elif loop.is_exact:
        yield Margin(name, label, None, reason="no bound: an exact prediction is as good as a fresh pose")
    else:
        reason = f"no bound: the lap contracts for every n that was tried, up to {limit}"
        yield Margin(name, label, None, reason=reason)
    yield _delay(loop)


def _longer_delays(loop: LinearLoop, n: int, limit: int) -> str:
    """What must be said of delays beyond the largest up to which all are stable; empty if none is stable again."""
    again = stable_again(lambda longer: floquet.is_stable_with_delay(loop, longer), n, limit) if n >= 0 else None
    if again is None:
        return ""
    first, last = again
    return f"not monotone: unstable from {n + 1} to {first - 1}, stable again from {first} to {last}"


def _delay(loop: LinearLoop) -> Margin:
    """Sampled delay margin on a straight track, in closed form."""
    name, label = "delay_margin", "Delay margin, straight track"
    if loop.predicts:
        reason = "no answer: between samples it is computed for a pose that is held; see n_max.lifted"
        return Margin(name, label, None, reason=reason)
    if loop.closed_form is None:
        reason = "no answer: between samples it is computed for Kanayama's law on a unicycle; see n_max.lifted"
        return Margin(name, label, None, reason=reason)
    steps = lifted.critical_delay(loop)
    if steps <= 0.0:
        return Margin(name, label, None, reason="not met: the error does not contract even without a delay")
    if math.isinf(steps):
        return Margin(name, label, None, reason="no bound: no delay is too long")
    return Margin(name, label, loop.ts * steps, f"{loop.ts * steps * 1e3:.4g} ms")


def _at_once(facts: RunFacts) -> Iterable[Row]:
    loop, n, label = facts.loop, facts.n, "Pose always that old"
    if loop.is_exact:
        yield label, "predicted: with an exact model as without outages"
    elif loop.is_constant or (loop.closed_form is not None and not loop.predicts):
        places = np.arange(0, loop.steps, max(1, loop.steps // _PLACES))  # quarters of a lap that are alike stay so
        radius = lifted.largest_radius(loop if loop.is_constant else loop.at(places), n)
        yield label, f"{'stable' if radius < 1.0 else 'unstable'}, spectral radius {radius:.5g}"
    if loop.closed_form is not None:
        but, delay = ", without the predictor" if loop.predicts else "", lifted.critical_delay(loop)
        yield "Straight track, delay", f"below {delay * loop.ts * 1e3:.4g} ms{but}" if delay > 0.0 else "none"


def _of_loop(loop: LinearLoop) -> int:
    found = floquet.largest_constant_delay(loop, LONGEST_PREDICTED if loop.predicts else LONGEST)
    return LIMIT if found is None else found


def _border(scenario: Scenario) -> float:
    """Age of each pose [steps] less the critical one along a straight track at 1 m/s.

    NaN where the age is not one constant delay of the uplink, and where the loop has no closed form.
    """
    uplink, downlink, loop = scenario.relay.uplink, scenario.relay.downlink, straight_loop_of(scenario)
    is_late_alone = uplink.delay > 0.0 and uplink.jitter == 0.0 and uplink.model == "perfect" and not uplink.schedule
    if not is_late_alone or downlink != ChannelParameters() or loop is None or loop.predicts:
        return math.nan
    if loop.closed_form is None:
        return math.nan
    return math.ceil(uplink.delay / scenario.plant.ts - _ROUNDING) - lifted.critical_delay(loop)


CRITERION = Criterion(
    key="lifted",
    order=20,
    title="Pose always n steps old",
    asks="Does a small error die out if every pose that the edge uses is n steps old?",
    assumes="A constant delay; outages make the age a sawtooth, which is less.",
    judge=_judge,
    margins=_margins,
    margin_names=(("n_max.lifted", "Pose always n steps old"), ("delay_margin", "Delay margin, straight track")),
    at_once=_at_once,
    border=Border("pose always n steps old", _border),
    map_column=MapColumn("n_lifted", "largest constant age of the pose", largest_delays, _of_loop),
)
