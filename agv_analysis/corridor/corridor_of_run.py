"""What a run says of its corridor: what was seen, and what its loop does under the channel that fits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from agv_analysis.corridor.corridor import Corridor, corridor
from agv_analysis.corridor.outages_seen import RecordedOutages, recorded_outages
from agv_analysis.corridor.widths import Widths, widths_of
from agv_analysis.link.channel_fit import ChannelFit, Estimate
from agv_analysis.link.transitions import interval_of
from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.stability.analysis import GAINS_UNKNOWN, Observations
from agv_plant.parameters import ChannelParameters
from agv_ros.errors import UserError


@dataclass(frozen=True)
class CorridorOfRun:
    """What was seen, and what is to be expected."""

    widths: Widths
    seen: RecordedOutages
    expected: Corridor | None
    """None where the loop cannot be simulated: its gains or its track are not known, as the notes say."""
    channel: str
    """Under which channel, in words."""
    notes: tuple[str, ...]

    def rows(self) -> Iterator[tuple[str, str]]:
        """Name and value of each figure, in plain text."""
        if self.expected is not None:
            yield from self.expected.rows()
            yield "Under the channel", self.channel
        yield from self.seen.rows()

    def to_json(self) -> dict[str, Any]:
        """The figures by name; SI units, intervals of 95 %."""
        found = {"half_width": self.widths.half_width} if self.expected is None else self.expected.to_json()
        channel = self.channel or None
        return {**found, "channel": channel, "recorded": self.seen.to_json(), "notes": list(self.notes)}


def corridor_of_run(
    analysis: Observations, scenario: Scenario, is_known: bool, laps: int | None = None,
    progress: Callable[[str], None] = lambda what: None,
) -> CorridorOfRun | None:  # fmt: skip
    """Of a run and its scenario, which has the corridor; None if there is none. `is_known`: the channel is its own."""
    widths, fit, first = widths_of(scenario.error_detector), analysis.fit, analysis.convergence.initial
    if widths is None:
        return None
    expected, notes = None, []
    if analysis.run.gains_known:
        try:
            expected = corridor(scenario if is_known else with_fitted_channel(scenario, fit), laps, progress)
        except UserError as error:  # a recording may come without its track
            notes.append(f"only what was seen, for {error}")
    else:
        notes.append(f"only what was seen, for {GAINS_UNKNOWN}")
    if expected is not None:
        notes += expected.notes
    if expected is not None and not is_known:
        expected = _with_doubts(expected, fit)
        if not fit.goodness.fits:
            notes.append("the outages are not those of the fitted channel, so its probabilities are a guess")
        if not scenario.relay.uplink.is_direct:
            notes.append("the fitted channel knows no delay")
    settled = 0 if first.has_nothing_to_settle else first.settle_1cm_steps
    n_single = None if expected is None else expected.n_single
    seen = recorded_outages(analysis.run, widths, n_single, settled)
    channel = scenario.relay.uplink.model + (" of the scenario" if is_known else "")
    of_whom = "" if expected is None else channel if is_known else _fitted(fit)
    return CorridorOfRun(widths, seen, expected, of_whom, (*notes, *seen.warnings))


def with_fitted_channel(scenario: Scenario, fit: ChannelFit) -> Scenario:
    """The scenario with the uplink that fits a run, and without delays, which are not fitted."""
    p, r = fit.transitions.estimate
    uplink = ChannelParameters()
    if fit.model == "bernoulli":
        uplink = replace(uplink, model="bernoulli", p=fit.loss_rate.value)
    elif fit.model != "perfect":
        uplink = replace(uplink, model="gilbert_elliott", p=p, r=r)
    return replace(scenario, relay=replace(scenario.relay, uplink=uplink))


def _fitted(fit: ChannelFit) -> str:
    return f"{fit.model}, as fitted to the run"


def _with_doubts(found: Corridor, fit: ChannelFit) -> Corridor:
    """With intervals that know how well the channel is known: to first order, by the outages that are long enough.

    For a Gilbert channel the rate of outages of n slots or more is p r / (p + r) (1 - r)^(n - 1); n is what makes it
    the rate that was found.
    """
    rate, (p, r) = -np.log1p(-min(found.leaving.p_lap.value, 1.0 - 1e-12)), fit.transitions.estimate
    begins = p * r / (p + r)
    if fit.model == "perfect" or not (0.0 < rate < begins * 1e7 and 0.0 < r < 1.0 and fit.transitions.to_lost):
        return found

    def relative(of_p: Floats, of_r: Floats) -> Floats:
        return np.asarray(of_p * of_r / (of_p + of_r) / begins * ((1.0 - of_r) / (1.0 - r)) ** length)

    lap = len(found.lap)
    length = max(0.0, np.log(rate / lap / begins) / np.log1p(-r))
    low, high = interval_of(fit.transitions, relative)
    leaving, longer, shorter = found.leaving, 1.0 / min(low, 1.0), 1.0 / max(high, 1.0)
    mean = leaving.mean_time
    widened = replace(
        leaving,
        p_lap=_scaled(leaving.p_lap, low, high),
        p_hour=_scaled(leaving.p_hour, low, high),
        mean_time=None if mean is None else Estimate.about(mean.value, mean.low * shorter, mean.high * longer),
    )  # fmt: skip
    return replace(found, leaving=widened)


def _scaled(p: Estimate, low: float, high: float) -> Estimate:
    """A probability whose rate may be `low` to `high` times as large as its own interval says."""

    def times(value: float, factor: float) -> float:
        return float(-np.expm1(np.log1p(-value) * factor)) if value < 1.0 else 1.0

    return Estimate.about(p.value, times(p.low, min(1.0, low)), times(p.high, max(1.0, high)))
