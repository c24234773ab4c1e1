"""What the explorer answers to a setting: the lap simulated anew, as figures, and what it tells, as text."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from agv_analysis.corridor.corridor import NOT_ALONE
from agv_analysis.corridor.lap_loop import LapLoop
from agv_analysis.corridor.single_outage import FEW_PLACES, LONGEST, roughly
from agv_analysis.corridor.widths import Widths, widths_of
from agv_analysis.metrics.convergence import convergence
from agv_analysis.metrics.deviation import Deviation, deviation
from agv_analysis.metrics.distance_text import at_most, metres
from agv_analysis.metrics.outages import outage_lengths
from agv_analysis.report.panels import LIMIT, OTHER, PINNED, REFERENCE, Panel, age, distance, speed, track
from agv_analysis.report.plotly import figure
from agv_analysis.report.table import deviation_sizes
from agv_analysis.run import Run
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.single import simulate
from agv_analysis.stability.criteria import CRITERIA
from agv_analysis.stability.criteria.criterion import RunFacts
from agv_ros.counted import counted
from agv_ros.parameters import SHARED

MOST_POINTS = 1200
"""Points of a line: the lowest and the highest of each pixel or two."""

_MOST_MARKERS = 100
"""Each of them costs a drawing more than twenty points of a line."""


class Response(NamedTuple):
    """What the page shows."""

    track: dict[str, Any]
    time: dict[str, Any]
    rows: list[tuple[str, str, str]]
    """Name, value, and that of the pinned setting, empty without one."""
    badge: dict[str, str]
    """What the badge says at once, by the name of its part: deviation, when, losses, outage."""


def respond(scenario: Scenario, pinned: Scenario | None = None) -> Response:
    """Simulate a scenario and, beside it, a pinned one that meets the same outages. Raises UserError as `simulate`."""
    run = simulate(scenario)
    other, values_of_other = (None, None) if pinned is None else _kept(with_channel_of(pinned, scenario))
    first = beside(track(run), None if other is None else track(other))
    over_time = [beside(panel(run), None if other is None else panel(other)) for panel in (distance, speed, age)]
    strays = deviation(run, convergence(run).initial)
    values = list(summary_rows(run, strays))
    others = values_of_other or {}
    return Response(
        track=figure([first], MOST_POINTS, markers=_MOST_MARKERS, is_tight=False),
        time=figure(over_time, MOST_POINTS),
        rows=[(name, value, others.get(name, "")) for name, value in values],
        badge=_badge(run, strays),
    )


def _badge(run: Run, strays: Deviation) -> dict[str, str]:
    lengths = outage_lengths(run.k, run.lost)
    longest = int(lengths.max(initial=0))
    worst = next(iter(strays.worst), None)
    return {
        "deviation": metres(strays.largest),
        "when": strays.reason if worst is None else f"at {worst.seconds:g} s",
        "losses": f"{100.0 * float(run.lost.mean()):.3g} %",
        "outage": f"longest outage {counted(longest, 'slot')} ({longest * run.ts * 1e3:g} ms)",
    }


@functools.lru_cache(maxsize=4)
def _kept(scenario: Scenario) -> tuple[Run, dict[str, str]]:
    """A run and the values that it tells: those of a pinned setting do not change while another one is moved."""
    run = simulate(scenario)
    return run, dict(summary_rows(run))


def with_channel_of(pinned: Scenario, scenario: Scenario) -> Scenario:
    """The pinned scenario on the channel, and with the seed, of another one: slot by slot the same is lost."""
    own = {name: getattr(pinned.relay, name) for name in SHARED}
    return dataclasses.replace(pinned, relay=dataclasses.replace(scenario.relay, **own))


def beside(panel: Panel, pinned: Panel | None) -> Panel:
    """A panel with the first line of another run's in it that is neither reference nor limit."""
    shown = tuple(line for line in panel.lines if line.role != OTHER)
    if pinned is not None:
        line = next(line for line in pinned.lines if line.role not in (REFERENCE, LIMIT))
        shown += (dataclasses.replace(line, name="pinned", role=PINNED),)
        # A logarithmic panel has a range only where a run diverges: it holds what does not, too.
        both = panel.y_range or pinned.y_range if panel.log else _both(panel.y_range, pinned.y_range)
        panel = dataclasses.replace(panel, y_range=both)
    return dataclasses.replace(panel, lines=shown)


def _both(one: tuple[float, float] | None, other: tuple[float, float] | None) -> tuple[float, float] | None:
    """A range that holds two others; None is everything."""
    return None if one is None or other is None else (min(one[0], other[0]), max(one[1], other[1]))


def summary_rows(run: Run, strays: Deviation | None = None) -> Iterator[tuple[str, str]]:
    """What a run tells, and what the criteria say at once; the rest is left to the criteria for the whole lap.

    `strays`: the run's deviation, where it is known already.
    """
    facts = RunFacts(run)
    e = np.hypot(*(run.reference[:, :2] - run.pose[:, :2]).T)
    late = float(e[-max(1, len(e) // 10) :].max())
    yield "Error in the last tenth", "; ".join((at_most(late), *run.notes))
    yield "Deviation", deviation_sizes(strays or deviation(run, convergence(run).initial))
    yield "Oldest pose", f"{counted(facts.n, 'step')} ({facts.n * run.ts * 1e3:g} ms)"
    if not facts.is_feasible:
        yield "Without losses", facts.infeasible
        return
    for criterion in CRITERIA:
        yield from criterion.at_once(facts)
    widths = widths_of(run.scenario.error_detector)
    if widths is not None:
        yield "One outage in the corridor", _rough_outage(run, widths)


def _rough_outage(run: Run, widths: Widths) -> str:
    """Longest single outage within a corridor, from some places of the lap, in words."""
    relay = run.scenario.relay
    if not (relay.uplink.is_direct and relay.downlink.is_direct):
        return f"no answer: {NOT_ALONE}"
    n = roughly(LapLoop(run.scenario, widths))
    if n is None:
        return f"any up to {LONGEST} slots, from {FEW_PLACES} places of the lap"
    if n < 0:
        return "none: the AGV is outside without any"
    return f"about {counted(n, 'slot')} ({n * run.ts * 1e3:g} ms), from {FEW_PLACES} places of the lap"
