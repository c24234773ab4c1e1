"""What a criterion of stability is: what it asks, what it says of a run, how much it lets a scenario take.

A criterion is one module of this folder with a `CRITERION` in it; nothing else has to be changed for a new one. The
terminal, JSON, report, explorer, sweep and map show what is there. What it needs to know it takes from the facts of a
run or of a scenario, each computed once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.channel_fit import ChannelFit, fit_channel
from agv_analysis.metrics.outages import Outages, outages
from agv_analysis.run import Floats, LinkSlots, Run
from agv_analysis.scenario import Scenario
from agv_analysis.stability.error_dynamics import NoNominalMotionError
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.scenario_loop import lap_of, loop_of_run, loop_on_lap
from agv_ros.counted import counted

PLACES_OF_LONG_LAP = 20_000
"""Steps, at least, that are asked of a lap that has more: one of 100 s at 5 ms has so many."""


class RunFacts:
    """A run, and what several criteria ask of it."""

    def __init__(self, run: Run, found: Outages | None = None, fit: ChannelFit | None = None) -> None:
        self.run = run
        self.outages = outages(run) if found is None else found
        self._fit = fit
        self.infeasible = ""
        """Why the loop has no motion about which it could be judged; empty if it has one."""
        self._loop: LinearLoop | None = None
        try:
            self._loop = loop_of_run(run)
        except NoNominalMotionError as error:
            self.infeasible = str(error)

    @property
    def is_feasible(self) -> bool:
        """Does the loop without losses settle?"""
        return self._loop is not None

    @property
    def loop(self) -> LinearLoop:
        """The loop to first order over the run's steps. Raises NoNominalMotionError if there is none."""
        if self._loop is None:
            raise NoNominalMotionError(self.infeasible)
        return self._loop

    @property
    def n(self) -> int:
        """Age of the oldest pose behind a command that acted in the run [steps], by receive time if that is known."""
        return self.outages.n_max

    @property
    def is_late(self) -> bool:
        """Did messages arrive in a later slot than their own, by what the slots say or by when they came?"""
        return has_late(self.run.uplink) or has_late(self.run.downlink) or self.run.is_late

    @property
    def ages_add_up(self) -> bool:
        """Does the AGV act on `Run.acting_age`: do plant and edge hold the newest that they have, however old?"""
        return not self.loop.predicts and self.run.scenario.plant.downlink_policy == "hold"

    @cached_property
    def fit(self) -> ChannelFit:
        """The uplink as fitted to the run."""
        return fit_channel(self.run.lost, self.run.k) if self._fit is None else self._fit

    @cached_property
    def downlink_fit(self) -> ChannelFit:
        """The downlink as fitted to the run."""
        return fit_channel(self.run.downlink_lost, self.run.k)


def has_late(link: LinkSlots | None) -> bool:
    """Did messages of this link arrive in a later slot than their own?"""
    return link is not None and bool(link.delay.any())


class ScenarioFacts:
    """A scenario, and what several criteria ask of it.

    Raises TrackFileError if the track's file cannot be used.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.lap: Floats = lap_of(scenario)
        """X_r(k) and its speeds over one lap: x, y, theta, v_r, w_r, shape (N, 5)."""
        self.infeasible = ""
        """Why there is no loop to ask; empty if there is one."""
        self._loop: LinearLoop | None = None
        try:
            self._loop = loop_on_lap(scenario)
        except NoNominalMotionError as error:
            self.infeasible = str(error)

    @property
    def loop(self) -> LinearLoop:
        """The loop to first order over one lap. Raises NoNominalMotionError if there is none."""
        if self._loop is None:
            raise NoNominalMotionError(self.infeasible)
        return self._loop


@dataclass(frozen=True)
class Judgement:
    """What a criterion says of a run."""

    label: str
    """What was asked, in words: `Pose always 28 steps old`."""
    stable: bool | None
    """Does the error die out? None where the criterion cannot decide."""
    why: str
    """The reason in words, with its numbers."""
    values: Mapping[str, Any] = field(default_factory=dict)
    """Figures by their key in JSON."""
    detail: Any = None
    """What other criteria and pages may want to know beside this."""


@dataclass(frozen=True)
class Margin:
    """How much a scenario can take by a criterion, or why there is no number."""

    name: str
    """Place in JSON: `n_max.lifted`."""
    label: str
    """In words: `Pose always n steps old`."""
    value: float | int | None
    text: str = ""
    """The value with its unit."""
    reason: str = ""
    """Why there is no value, or what must be known of it."""
    extra: Mapping[str, Any] = field(default_factory=dict)
    """Further figures by their key in JSON."""
    shown: bool = True
    """Is it worth a row of a table?"""

    @property
    def words(self) -> str:
        """The value as a table has it."""
        if self.value is None:
            return self.reason or "unknown"
        return f"{self.text} ({self.reason})" if self.reason else self.text


@dataclass(frozen=True)
class Border:
    """Where a criterion changes its mind in a sweep, from a function of the scenario: negative where it is stable."""

    name: str
    value: Callable[[Scenario], float]


@dataclass(frozen=True)
class MapColumn:
    """Margins over a grid of loops at constant speed."""

    name: str
    """Column of the CSV file."""
    title: str
    of_points: Callable[[Sequence[Any]], NDArray[np.int64]]
    """Of loops that have a closed form, all at once: `margin_map.Point`s."""
    of_loop: Callable[[LinearLoop], int]
    """Of any loop."""


Row = tuple[str, str]
"""Name and value, in plain text."""


def nothing(_: Any) -> Iterable[Any]:
    """A criterion that has nothing of the kind."""
    return ()


@dataclass(frozen=True)
class Criterion:
    """One criterion."""

    key: str
    order: int
    """Place among the others, from the statement that asks for least to the one that asks for most."""
    title: str
    asks: str
    """Its question in a sentence, for the documentation."""
    assumes: str
    """What it assumes, in a sentence."""
    judge: Callable[[RunFacts], Judgement | None] = lambda _: None
    """What it says of a run; None where it does not apply."""
    margins: Callable[[ScenarioFacts], Iterable[Margin]] = nothing
    margin_names: tuple[tuple[str, str], ...] = ()
    """Name and label of each of its margins, for a loop of which none can be computed."""
    at_once: Callable[[RunFacts], Iterable[Row]] = nothing
    """What is known in a few milliseconds, for a page on which a slider moves."""
    border: Border | None = None
    map_column: MapColumn | None = None


def steps_text(n: int, ts: float) -> str:
    """A number of steps that a scenario can take, with its time."""
    return "does not contract even without outages" if n < 0 else f"{counted(n, 'step')} ({n * ts * 1e3:g} ms)"


def growth_text(growth: float) -> str:
    """What becomes of the mean square with this growth (logarithm, per step)."""
    return f"E[e^2] {'dies out, shrinks' if growth < 0.0 else 'grows'} by {change_text(math.expm1(growth))}"


def change_text(share: float) -> str:
    """By what share something changes at each step, in per cent: without more digits than the share deserves."""
    change = 100.0 * abs(share)
    return f"{change:{'.2g' if change < 99.5 else '.3g'}} % per step"
