"""Margins as a short table, in plain text."""

from __future__ import annotations

import math
from collections.abc import Iterator

from agv_analysis.scenario import Scenario
from agv_analysis.stability.margins import Margins, margins


def margin_rows(scenario: Scenario) -> Iterator[tuple[str, str]]:
    """Name and value of each margin of a scenario over its track, and what none of them knows of."""
    found = margins(scenario)
    yield from rows(found, scenario.plant.ts)
    if found.left_out:
        yield "Left out of all of these", ", ".join(found.left_out)


def rows(found: Margins, ts: float) -> Iterator[tuple[str, str]]:
    """Name and value of each margin, as text."""

    def told(value: float | None, name: str, text: str) -> str:
        reason = found.reasons.get(name)
        if value is None:
            return reason or "unknown"
        return text if reason is None else f"{text} ({reason})"

    def steps(n: int | None) -> str:
        if n is not None and n < 0:
            return "does not contract even without outages"
        return f"{n} steps ({n * ts * 1e3:g} ms)" if n is not None else ""

    yield "Paper's test, constant n_ul", told(found.n_paper, "n_max.paper", steps(found.n_paper))
    yield "Pose always n steps old", told(found.n_lifted, "n_max.lifted", steps(found.n_lifted))
    delay = "" if found.delay is None else f"{found.delay * 1e3:.4g} ms"
    yield "Delay margin, straight track", told(found.delay, "delay_margin", delay)
    yield "Any outages up to n", told(found.n_bursts, "n_max.bursts", steps(found.n_bursts))
    p = found.p_mean_square
    yield "Independent losses, mean square", told(p, "p_max.mean_square", _probability(p))
    p = found.p_almost_sure
    yield "Independent losses, almost surely", told(p, "p_max.almost_sure", _probability(p))
    rate = "" if found.loss_rate is None else f" at a loss rate of {found.loss_rate:.4g}"
    burst = found.burst_mean_square
    text = "" if burst is None else f"{burst:.4g} slots on average"
    yield f"Bursts, mean square{rate}", told(burst, "burst_max.mean_square", text)
    name = "both_links.mean_square_growth"
    if found.both_links is not None or "no answer" in found.reasons[name]:
        growth = 0.0 if found.both_links is None else found.both_links
        word = "dies out" if growth < 0.0 else "grows"
        text = f"E[e^2] {word}, times {math.exp(growth):.6g} a step"
        yield "Both links as they are, mean square", told(found.both_links, name, text)
    yield "What binds", "nothing" if found.binding is None else f"the error {found.binding} the track"


def _probability(p: float | None) -> str:
    return "" if p is None else f"below {p:.5g}"
