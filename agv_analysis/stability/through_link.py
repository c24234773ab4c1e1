"""A loop driven through a measured link, packet by packet or as fitted: its word, how far it leaves its reference."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from agv_analysis.link.channel_fit import ChannelFit, Estimate, fit_channel
from agv_analysis.link.large_arrays import count_of, median_step, parts
from agv_analysis.link.link_figures import Spread
from agv_analysis.link.measured_trace import LinkOfLoop, beginning_of, write_trace
from agv_analysis.link.reception_intervals import Outcomes
from agv_analysis.metrics.outages import outage_lengths
from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.batch import simulate_batch
from agv_analysis.simulation.channel_outcomes import ChannelRealisation
from agv_analysis.stability.confidence.link_confidence import link_confidence
from agv_analysis.stability.empirical import with_an_end
from agv_analysis.stability.error_dynamics import NoNominalMotionError
from agv_analysis.stability.evidence import evidence_of_scenario
from agv_analysis.stability.scenario_loop import lap_of, loop_on_lap
from agv_analysis.stability.verdict import Verdict, decide
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.delay import whole_slots

_MOST_STEPS = 20_000
"""Steps of the run that is driven through a measured link, its beginning; the criteria judge _MOST_SLOTS."""

_MOST_SLOTS = 4_000_000
"""Slots of a measured link that are judged, from its beginning: what comes behind them is not kept in memory."""

_WINDOWS = 20
"""Most runs whose deviations are listed."""


@dataclass(frozen=True)
class ThroughLink:
    """What a loop does behind a link."""

    verdict: Verdict
    confidence: float | None
    """Probability of a stable loop given what was seen of the link; None where nothing is random."""
    deviations: Floats
    """Largest distance from the reference [m] of each run that begins on it, shape (n,), inf for one that diverges."""
    seconds: float
    """Length of a run [s]."""
    longest_slots: int
    """The longest uplink outage [slots]."""
    corridor: float = 0.0
    """Half-width of the corridor about the reference [m]; 0: there is none."""
    judged: float | None = None
    """How much of the measurement, from its beginning, is judged [s]; None: all of it."""

    @property
    def left(self) -> int:
        """Runs that left the corridor."""
        return int(np.count_nonzero(self.deviations > self.corridor)) if self.corridor else 0

    @property
    def leaves(self) -> Estimate:
        """Probability to leave the corridor in such a run, with its 95 % interval."""
        return Estimate.of(self.left, len(self.deviations))

    def to_json(self) -> dict[str, Any]:
        """`verdict`, `verdict_reason`, `confidence`, `deviation_max_m`, `deviation_median_m`, and of which runs."""
        largest, median = float(self.deviations.max()), float(np.median(self.deviations))
        return {
            **self.verdict.to_json(),
            "confidence": self.confidence,
            "deviation_max_m": largest if math.isfinite(largest) else None,
            "deviation_median_m": median if math.isfinite(median) else None,
            "runs": len(self.deviations),
            "run_s": self.seconds,
            "outage_max_slots": self.longest_slots,
            "judged_s": self.judged,
            "corridor": self._corridor_to_json(),
        }

    def _corridor_to_json(self) -> dict[str, Any] | None:
        if not self.corridor:
            return None
        leaves = self.leaves
        return {
            "half_width_m": self.corridor,
            "left": self.left,
            "p_run": {"value": leaves.value, "low": leaves.low, "high": leaves.high},
        }


def traced(scenario: Scenario, link: LinkOfLoop, file: Path) -> Scenario:
    """A scenario whose links are a trace, written to `file`. Raises UserError if that cannot be done."""
    write_trace(file, link)
    plain = ChannelParameters()
    up = replace(plain, model="trace", trace_file=str(file))
    down = up if link.downlink_lost is not None else plain
    return replace(scenario, relay=replace(scenario.relay, uplink=up, downlink=down, seed=1))


def without_delays(link: LinkOfLoop) -> LinkOfLoop:
    """The losses of a link alone."""
    down = link.downlink_lost
    return link._replace(
        uplink_delay=None, downlink_delay=None, downlink_lost=None if down is None or not down.any() else down
    )


def fitted_scenario(scenario: Scenario, link: LinkOfLoop, interval: float) -> Scenario:
    """A scenario whose links are the channels that fit the losses of each way, and delays as their median.

    A Gilbert channel fitted to packets every `interval` [s] is one of the loop's slots with outages and gaps as long.
    """
    slots = interval / scenario.plant.ts
    uplink = _fitted(link.uplink_lost, link.uplink_delay, slots)
    downlink = _fitted(link.downlink_lost, link.downlink_delay, slots)
    return replace(scenario, relay=replace(scenario.relay, uplink=uplink, downlink=downlink))


def _fitted(lost: Outcomes | None, delay: Floats | None, slots: float) -> ChannelParameters:
    """The channel that fits the outcomes of packets which are so many `slots` apart, None of one that is perfect."""
    late = None if delay is None else Spread.of(lambda: (delay[part] for part in parts(len(delay), delay)))
    found = ChannelParameters(delay=0.0 if late is None else late.percentiles[0])
    if lost is None or not count_of(lost, lambda part: part):
        return found
    return replace(found, **_in_slots(fit_channel(lost), slots))


def _in_slots(fit: ChannelFit, slots: float) -> dict[str, Any]:
    """Parameters of the fitted channel for slots of which a packet's interval has so many."""
    if fit.model == "bernoulli" and slots <= 1.0 + 1e-9:
        return {"model": "bernoulli", "p": fit.loss_rate.value}
    chain = fit.chain
    rate, burst = chain.loss_rate, max(1.0, chain.mean_burst * slots)
    if rate >= 1.0:
        return {"model": "bernoulli", "p": 1.0}
    r = 1.0 / burst
    return {"model": "gilbert_elliott", "p": min(1.0, r * rate / (1.0 - rate)), "r": r}


def through_trace(scenario: Scenario, link: LinkOfLoop, file: Path) -> ThroughLink:
    """The loop through the very link, with what a trace's file needs written to `file`.

    Raises UserError for what cannot be driven.
    """
    ended = with_an_end(scenario)
    ts = scenario.plant.ts
    span = float(link.time[-1]) + (median_step(link.time) if len(link.time) > 1 else ts)
    seconds = min(span, ended.plant.duration, _MOST_STEPS * ts)
    seconds = max(1, round(seconds / ts)) * ts
    windows = max(1, min(_WINDOWS, int(span / seconds + 1e-9)))
    slots = min(_MOST_SLOTS, max(1, whole_slots(span / ts)))
    found = traced(with_duration(ended, seconds), beginning_of(link, slots * ts), file)
    uplink = found.relay.uplink
    lost = ChannelRealisation(1, slots, ts).outcomes(uplink, "uplink")
    lengths = outage_lengths(np.arange(slots), lost)
    longest = int(lengths.max(initial=0))
    evidence = evidence_of_scenario(found)
    if evidence.link is not None:
        # Of the whole measurement, and not of the run alone.
        seen = link_confidence(loop_on_lap(found), np.arange(slots), lost, ts)
        evidence = replace(
            evidence, link=seen, growth=seen.growth, probability_stable=seen.probability_stable,
            n=max(longest, evidence.n),
        )  # fmt: skip
    corridor = scenario.error_detector.corridor
    deviations = deviations_of(found, windows)
    return ThroughLink(
        decide(evidence), evidence.confidence, deviations, seconds, longest, corridor,
        judged=slots * ts if span >= (slots + 1) * ts else None,
    )  # fmt: skip


def through_channel(scenario: Scenario, seeds: int = _WINDOWS) -> ThroughLink:
    """The loop through the channels that it has."""
    ended = with_an_end(scenario)
    evidence = evidence_of_scenario(ended)
    steps = round(ended.plant.duration / ended.plant.ts)
    lost = ChannelRealisation(ended.relay.seed, steps, ended.plant.ts).outcomes(ended.relay.uplink, "uplink")
    longest = int(outage_lengths(np.arange(steps), lost).max(initial=0))
    corridor = scenario.error_detector.corridor
    deviations = deviations_of(ended, seeds)
    return ThroughLink(decide(evidence), evidence.confidence, deviations, ended.plant.duration, longest, corridor)


def with_duration(scenario: Scenario, seconds: float) -> Scenario:
    """A scenario of another length."""
    return replace(scenario, plant=replace(scenario.plant, duration=seconds))


def deviations_of(scenario: Scenario, runs: int) -> Floats:
    """Largest distance from the reference [m] in each of so many runs that begin on it, shape (runs,)."""
    x, y, theta = lap_of(scenario)[0, :3].tolist()
    begun = replace(scenario, plant=replace(scenario.plant, initial_pose=(x, y, theta)))
    table = simulate_batch([begun], range(1, runs + 1))[0]
    peaks = np.asarray(table["position_peak"], dtype=np.float64)
    whole = table["steps"] >= round(scenario.plant.duration / scenario.plant.ts)
    return np.where(whole & np.isfinite(peaks), peaks, math.inf)


def is_feasible(scenario: Scenario) -> str:
    """Why the loop does not settle even without losses; empty if it does."""
    try:
        loop_on_lap(scenario)
    except NoNominalMotionError as error:
        return str(error)
    return ""
