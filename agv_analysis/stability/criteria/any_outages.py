"""Any sequence of outages: the joint spectral radius of the maps from one reception to the next."""

from __future__ import annotations

import math
from collections.abc import Iterable

from agv_analysis.json_values import finite
from agv_analysis.link.markov_channel import renewal_chain
from agv_analysis.scenario import Scenario
from agv_analysis.stability import joint_spectral_radius
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
    change_text,
    steps_text,
)
from agv_analysis.stability.joint_spectral_radius import UNSTABLE, BurstVerdict
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.margin_map_points import LIMIT, largest_repeated_bursts
from agv_analysis.stability.scenario_loop import straight_loop_of
from agv_ros.counted import counted

LONGEST, LONGEST_PREDICTED = 1000, 200
"""Longest bursts [slots] that are tried; fewer behind a predictor, where nothing ends the search early."""

BURST = "burst"
"""The channel whose outages all have one length."""

ALONG, ACROSS = "along", "across"


def longest_for(loop: LinearLoop, seen: int = 0) -> int:
    """Longest bursts [slots] to try for a loop, of a run whose longest outage was `seen`."""
    return max(seen, LONGEST_PREDICTED) if loop.predicts else LONGEST


def largest_n(loop: LinearLoop, longest: int) -> tuple[int | None, int | None]:
    """As `joint_spectral_radius.largest_n`, of a very long lap at some of its steps."""
    return joint_spectral_radius.largest_n(loop.thinned(PLACES_OF_LONG_LAP), longest)


def _judge(facts: RunFacts) -> Judgement | None:
    if not facts.is_feasible or facts.run.is_late:  # then no fresh pose need end an outage
        return None
    found = joint_spectral_radius.verdict(facts.loop.thinned(PLACES_OF_LONG_LAP), facts.n)
    stable = {joint_spectral_radius.STABLE: True, UNSTABLE: False}.get(found.verdict)
    return Judgement(
        f"Any outages up to {counted(facts.n, 'slot')}", stable, _why(found),
        {
            "bursts_stable": stable is True,
            "bursts_verdict": found.verdict,
            "bursts_radius_lower": finite(found.lower),
            "bursts_radius_upper": finite(found.upper),
        },
        found,
    )  # fmt: skip


def _why(found: BurstVerdict) -> str:
    if found.verdict == joint_spectral_radius.STABLE:
        proof = "proved by a common norm" if found.certificate is not None else "of the one sequence without outages"
        return f"joint spectral radius at most {found.upper:.6g}, {proof}"
    if found.verdict == UNSTABLE:
        slots = counted(found.worst, "slot")
        return f"under outages of {slots}, again and again, errors grow by {change_text(found.lower - 1.0)}"
    return f"joint spectral radius at least {found.lower:.6g}"


def _margins(facts: ScenarioFacts) -> Iterable[Margin]:
    name, label, loop = "n_max.bursts", "Any outages up to n", facts.loop
    longest = longest_for(loop)
    n, refuted = largest_n(loop, longest)
    reason = ""
    if n is None:
        reason = f"no bound: every burst that was tried contracts, up to {counted(longest, 'slot')}"
    elif refuted is not None and refuted > n + 1:
        reason = f"proved up to {n}, refuted from {refuted} on, between them undecided"
    yield Margin(name, label, n, "" if n is None else steps_text(n, loop.ts), reason)
    binds = None if loop.predicts and n is None else binding(loop)
    yield Margin(
        "binding", "What binds", None, reason="nothing" if binds is None else f"the error {binds} the track",
        extra={"binding": binds}, shown=loop.closed_form is not None,
    )  # fmt: skip


def binding(loop: LinearLoop) -> str | None:
    """Which error bursts blow up first on a straight track at the lap's top speed: along it or across it.

    Behind a predictor the error along the track, since the model is wrong in that speed alone. None if neither ever
    does, or where no closed form says it.
    """
    if loop.closed_form is None:
        return None
    if loop.predicts:
        return ALONG
    along, across = joint_spectral_radius.largest_n_straight(loop)
    if along is None and across is None:
        return None
    return ALONG if across is None or (along is not None and along <= across) else ACROSS


def _at_once(facts: RunFacts) -> Iterable[Row]:
    loop = facts.loop
    if loop.closed_form is not None:
        along, across = joint_spectral_radius.largest_n_straight(loop)
        but = ", without the predictor" if loop.predicts else ""
        yield "Straight track, any outages", f"up to {_number(along)} along, {_number(across)} across{but}"
        binds = binding(loop)
        yield "What binds", "nothing" if binds is None else f"the error {binds} the track"


def _number(steps: int | None) -> str:
    if steps is None:
        return "any number"
    return "none" if steps < 0 else str(steps)


def _of_loop(loop: LinearLoop) -> int:
    refuted = joint_spectral_radius.first_refuted(loop, longest_for(loop))
    return LIMIT if refuted is None else refuted - 1


def _border(scenario: Scenario) -> float:
    """Outages of the channel `burst` [slots], less the longest that are survived along a straight track at 1 m/s.

    There a burst of n slots is survived while T_s K_x (n + 1) < 2. NaN for channels without a longest outage, and
    where the loop has no closed form.
    """
    uplink, loop = scenario.relay.uplink, straight_loop_of(scenario)
    comes_again = uplink.model == BURST and uplink.start_step < 0
    if not comes_again or renewal_chain(scenario.relay) is None or loop is None or loop.predicts:
        return math.nan
    if loop.closed_form is None:
        return math.nan
    _, across = joint_spectral_radius.largest_n_straight(loop)
    along = (uplink.n + 1) * loop.ts * loop.closed_form.kx - 2.0
    return along if across is None else max(along, uplink.n - across - 0.5)


CRITERION = Criterion(
    key="bursts",
    order=30,
    title="Any outages up to n slots",
    asks="Does a small error die out whatever outages of up to n slots come, in any order and forever?",
    assumes="That a fresh pose ends each outage.",
    judge=_judge,
    margins=_margins,
    margin_names=(("n_max.bursts", "Any outages up to n"),),
    at_once=_at_once,
    border=Border("any outages up to n", _border),
    map_column=MapColumn("n_bursts", "longest outage that may repeat", largest_repeated_bursts, _of_loop),
)
