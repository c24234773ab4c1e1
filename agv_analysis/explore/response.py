"""What the explorer answers to a setting: the lap simulated anew, as figures, and what it tells, as text."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from agv_analysis.metrics.outages import outages
from agv_analysis.report.panels import LIMIT, OTHER, REFERENCE, Panel, age, distance, speed, track
from agv_analysis.report.plotly import figure
from agv_analysis.run import Run
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.single import simulate
from agv_analysis.stability import joint_spectral_radius, lifted, mean_square, paper
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.margins import binding
from agv_analysis.stability.scenario_loop import loop_of_run
from agv_ros.parameters import SHARED

_MOST_POINTS = 1200
"""Points of a line: the lowest and the highest of each pixel or two."""

_MOST_DOTS = 100
"""Each of them costs a drawing more than twenty points of a line."""

LATER = "see the margins of the lap"
"""For what takes longer than a move may."""

_PLACES = 100
"""Places of the track at which the lifted system is asked: all of them would take longer than the lap."""


class Response(NamedTuple):
    """What the page shows."""

    track: dict[str, Any]
    time: dict[str, Any]
    rows: list[tuple[str, str, str]]
    """Name, value, and that of the pinned setting, empty without one."""


def respond(scenario: Scenario, pinned: Scenario | None = None) -> Response:
    """Simulate a scenario and, beside it, a pinned one that meets the same outages. Raises UserError as `simulate`."""
    run = simulate(scenario)
    other, values_of_other = (None, None) if pinned is None else _kept(with_channel_of(pinned, scenario))
    first = beside(track(run), None if other is None else track(other))
    over_time = [beside(panel(run), None if other is None else panel(other)) for panel in (distance, speed, age)]
    values = list(summary_rows(run))
    others = values_of_other or [""] * len(values)
    return Response(
        track=figure([first], _MOST_POINTS, dots=_MOST_DOTS),
        time=figure(over_time, _MOST_POINTS),
        rows=[(name, value, second) for (name, value), second in zip(values, others, strict=True)],
    )


@functools.lru_cache(maxsize=4)
def _kept(scenario: Scenario) -> tuple[Run, list[str]]:
    """A run and the values that it tells: those of a pinned setting do not change while another one is moved."""
    run = simulate(scenario)
    return run, [value for _, value in summary_rows(run)]


def with_channel_of(pinned: Scenario, scenario: Scenario) -> Scenario:
    """The pinned scenario on the channel, and with the seed, of another one: slot by slot the same is lost."""
    own = {name: getattr(pinned.relay, name) for name in SHARED}
    return dataclasses.replace(pinned, relay=dataclasses.replace(scenario.relay, **own))


def beside(panel: Panel, pinned: Panel | None) -> Panel:
    """A panel with the first line of another run's in it that is neither reference nor limit."""
    shown = tuple(line for line in panel.lines if line.role != OTHER)
    if pinned is not None:
        line = next(line for line in pinned.lines if line.role not in (REFERENCE, LIMIT))
        shown += (dataclasses.replace(line, name="pinned", role=OTHER),)
    return dataclasses.replace(panel, lines=shown)


def summary_rows(run: Run) -> Iterator[tuple[str, str]]:
    """What a run tells, and the margins that are computed at once: those of a straight track in closed form.

    A loop without closed forms is left to the criteria for the whole lap.
    """
    loop, n = loop_of_run(run), outages(run).n_ul_max
    e = np.hypot(*(run.reference[:, :2] - run.pose[:, :2]).T)
    late = float(e[-max(1, len(e) // 10) :].max())
    yield "Error in the last tenth", "; ".join((f"at most {late:.3g} m", *run.notes))
    yield "Oldest pose", f"{n} steps ({n * run.ts * 1e3:g} ms)"
    yield "Paper's test", _of_paper(run)
    yield "Pose always that old", _of_lifted(loop, n)
    if loop.closed_form is not None:
        yield from _of_a_straight_track(loop)


def _of_lifted(loop: LinearLoop, n: int) -> str:
    """Is the loop stable if every pose is as old as the oldest? Where a word on that does not take long."""
    if loop.is_exact:
        return "predicted: with an exact model as without outages"
    if not loop.is_constant and (loop.predicts or loop.closed_form is None):
        return LATER
    places = np.arange(0, loop.steps, max(1, loop.steps // _PLACES))  # quarters of a lap that are alike stay so
    radius = lifted.largest_radius(loop if loop.is_constant else loop.at(places), n)
    return f"{'stable' if radius < 1.0 else 'unstable'}, spectral radius {radius:.5g}"


def _of_a_straight_track(loop: LinearLoop) -> Iterator[tuple[str, str]]:
    """Margins on a straight track at the lap's top speed, of a loop with a closed form."""
    but = ", without the predictor" if loop.predicts else ""
    along, across = joint_spectral_radius.largest_n_straight(loop)
    yield "Straight track, any outages", f"up to {_n(along)} along, {_n(across)} across{but}"
    delay = lifted.critical_delay(loop)
    yield "Straight track, delay", f"below {delay * loop.ts * 1e3:.4g} ms{but}" if delay > 0.0 else "none"
    loss = -1.0 if loop.along_gain is None else mean_square.critical_loss_along(loop.along_gain)
    yield "Independent losses, mean square", f"below {loss:.4g}{but}" if loss > 0.0 else "none"
    binds = binding(loop)
    yield "What binds", "nothing" if binds is None else f"the error {binds} the track"


def _of_paper(run: Run) -> str:
    """The largest n for which the paper's test holds on the track as far as it was driven."""
    theta, v_r = run.reference[:, 2], run.reference[:, 3]
    n = paper.largest_n(theta, v_r, run.scenario.controller, run.ts)
    if n is None:
        return "holds for any number of outages"
    return "fails even without outages" if n < 0 else f"holds for up to {n} outages in a row"


def _n(steps: int | None) -> str:
    if steps is None:
        return "any number"
    return "none" if steps < 0 else str(steps)
