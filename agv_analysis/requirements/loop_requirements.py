"""What a loop asks of its radio: survival time, latency, losses, bursts, age, from the criteria of stability.

The mapping to the terms of 3GPP TS 22.104: the transfer interval is T_s; the survival time is n T_s, n being the
longest outage of which any sequence is survived; the maximum end-to-end latency is the delay margin; the service is
unavailable while an outage exceeds the survival time, and reliability is the mean time between such failures. All of
the uplink, with commands that arrive at once. Within a corridor the survival time is shorter where outages that the
loop survives lead out of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from agv_analysis.link.markov_channel import chain_of
from agv_analysis.link.netem import to_netem
from agv_analysis.requirements.corridor_survival import CorridorSurvival, survival_in_corridor
from agv_analysis.requirements.loss_behind_delay import critical_loss_behind
from agv_analysis.scenario import Scenario
from agv_analysis.stability import floquet, joint_spectral_radius, lifted, mean_square
from agv_analysis.stability.criteria.any_outages import longest_for
from agv_analysis.stability.criteria.constant_age import LONGEST, LONGEST_PREDICTED
from agv_analysis.stability.error_dynamics import NoNominalMotionError
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.scenario_loop import loop_on_lap
from agv_plant.parameters import ChannelParameters
from agv_ros.counted import counted

LOSS_RATES = (0.001, 0.01, 0.05, 0.1, 0.3, 0.5)
"""At which the curve of bursts is computed."""

_SHOWN = (0.01, 0.1)
"""Of these the loss rates for which a line for netem is given."""

_DELAYS = (0.0, 0.25, 0.5, 0.75)
"""Shares of the largest delay at which the curve of losses behind a delay is computed."""

PLACES = 50
"""Places of the lap, at least, at which the curves are asked; speeds change little from one to the next."""


@dataclass(frozen=True)
class LoopRequirements:
    """What a loop asks; None where there is no bound or no answer, with the reason by the name of the figure."""

    transfer_interval: float
    """T_s [s]."""
    survival_slots: int | None
    """n, the longest outage [slots] of which any sequence is survived, by stability and within the corridor if there is
    one; -1: not even a loop without losses contracts, or stays within the corridor."""
    latency: float | None
    """Largest constant delay of the pose [s], without losses."""
    loss_rate: float | None
    """Probability of independent losses below which the mean square of the error dies out."""
    mean_burst: float | None
    """Mean burst [slots] below which it does at the loss rate of the scenario's uplink."""
    mean_age: float | None
    """Mean age of the pose [s] below which it does under independent losses."""
    bursts: tuple[tuple[float, float | None], ...] = ()
    """(loss rate, mean burst [slots] below which the mean square dies out; inf: any, None: none is short enough)."""
    delays: tuple[tuple[float, float], ...] = ()
    """(constant delay [s], independent losses that are taken on top of it)."""
    stable_slots: int | None = None
    """n by stability alone."""
    corridor: CorridorSurvival | None = None
    """What outages keep the AGV within its corridor; None if it has none."""
    infeasible: str = ""
    """Why the loop does not settle even without losses; then nothing is asked, since nothing would do."""
    reasons: dict[str, str] = field(default_factory=dict)

    @property
    def survival_time(self) -> float | None:
        """n T_s [s]; None where there is no bound."""
        return None if self.survival_slots is None else self.survival_slots * self.transfer_interval

    def netem(self) -> tuple[str, ...]:
        """Lines for netem a hair within the border, each of which the loop takes alone; none for what is unbounded."""
        channels = []
        if self.latency is not None and self.latency > 0.0:
            channels.append(ChannelParameters(delay=_rounded(self.latency)))
        if self.loss_rate is not None and 0.0 < self.loss_rate < 1.0:
            channels.append(ChannelParameters(model="bernoulli", p=_rounded(self.loss_rate)))
        for rate, burst in self.bursts:
            if rate in _SHOWN and burst is not None and math.isfinite(burst):
                r = 1.0 / _rounded(burst)
                p = _rounded(min(1.0, r * rate / (1.0 - rate)))
                channels.append(ChannelParameters(model="gilbert_elliott", p=p, r=round(r, 6)))
        return tuple(map(to_netem, channels))

    def to_json(self) -> dict[str, Any]:
        """The figures by name; SI units, null where there is no bound or no answer."""
        return {
            "transfer_interval_s": self.transfer_interval,
            "survival_time_s": self.survival_time,
            "survival_slots": self.survival_slots,
            "survival_slots_by_stability": self.stable_slots,
            "corridor": None if self.corridor is None else {
                "half_width_m": self.corridor.half_width,
                "n_single": self.corridor.single,
                "n_any": self.corridor.any_sequence,
            },
            "latency_max_s": self.latency,
            "loss_rate_max": self.loss_rate,
            "mean_burst_max": self.mean_burst,
            "age_mean_max_s": self.mean_age,
            "loss_rate_and_burst": [
                {"loss_rate": rate, "mean_burst_max": burst if burst is not None and math.isfinite(burst) else None,
                 "any_burst": burst == math.inf}
                for rate, burst in self.bursts
            ],
            "latency_and_loss": [{"latency_s": delay, "loss_rate_max": rate} for delay, rate in self.delays],
            "netem": list(self.netem()),
            "feasible": not self.infeasible,
            "infeasible_reason": self.infeasible or None,
            "reasons": dict(self.reasons),
        }  # fmt: skip


def _rounded(value: float) -> float:
    """A hair less, in three digits."""
    digits = 2 - math.floor(math.log10(value))
    return round(math.floor(value * 0.999 * 10.0**digits) / 10.0**digits, 12)


def require(scenario: Scenario) -> LoopRequirements:
    """What a scenario's loop asks of its radio by stability and within its corridor, whatever its links are.

    Raises TrackFileError if the track's file cannot be used, PartError if a part raises.
    """
    ts = scenario.plant.ts
    try:
        loop = loop_on_lap(scenario)
    except NoNominalMotionError as error:
        return LoopRequirements(ts, None, None, None, None, None, infeasible=str(error))
    reasons: dict[str, str] = {}
    stable = _survival(loop, reasons)
    corridor = survival_in_corridor(scenario, stable)
    longest = _longest_delay(loop)
    rate = _loss_rate(loop, reasons)
    return LoopRequirements(
        transfer_interval=ts,
        survival_slots=_smaller(stable, None if corridor is None else corridor.any_sequence),
        latency=_latency(loop, longest, reasons),
        loss_rate=rate,
        mean_burst=_mean_burst(scenario, loop, reasons),
        mean_age=None if rate is None or rate >= 1.0 else max(0.0, rate / (1.0 - rate)) * ts,
        bursts=_bursts(loop),
        delays=_losses_behind_delays(loop, longest, reasons),
        stable_slots=stable,
        corridor=corridor,
        reasons=reasons,
    )


def _smaller(one: int | None, other: int | None) -> int | None:
    """The smaller of two numbers of slots, None being no bound."""
    known = [slots for slots in (one, other) if slots is not None]
    return min(known) if known else None


def _survival(loop: LinearLoop, reasons: dict[str, str]) -> int | None:
    longest = longest_for(loop)
    slots, refuted = joint_spectral_radius.largest_n(loop, longest)
    if slots is None:
        reasons["survival_time_s"] = (
            f"no bound: every outage that was tried is survived, up to {counted(longest, 'slot')}"
        )
    elif slots < 0:
        reasons["survival_time_s"] = "the error does not contract even without outages"
    elif refuted is not None and refuted > slots + 1:
        reasons["survival_time_s"] = (
            f"proved up to {counted(slots, 'slot')}, refuted from {refuted} on, between them undecided"
        )
    return slots


def _longest_delay(loop: LinearLoop) -> int | None:
    """Largest constant delay [slots] that is taken; None: all that were tried."""
    return floquet.largest_constant_delay(
        loop, 0 if loop.is_exact else LONGEST_PREDICTED if loop.predicts else LONGEST
    )  # fmt: skip


def _latency(loop: LinearLoop, longest: int | None, reasons: dict[str, str]) -> float | None:
    """The delay margin [s]: between samples where it has a closed form, in whole slots else."""
    if longest is None:
        reasons["latency_max_s"] = "no bound: no delay that was tried is too long"
        return None
    if longest < 0:
        reasons["latency_max_s"] = "the error does not contract even without a delay"
        return 0.0
    if loop.closed_form is None or loop.predicts:
        return longest * loop.ts
    steps = min(lifted.critical_delay(loop), longest + 1.0)  # the track's curves may take less than its straight parts
    return max(float(longest), steps) * loop.ts


def _loss_rate(loop: LinearLoop, reasons: dict[str, str]) -> float | None:
    if loop.is_exact:
        reasons["loss_rate_max"] = "no bound: an exact prediction is as good as a fresh pose"
        return None
    found = mean_square.critical_loss(loop)
    if found < 0.0:
        reasons["loss_rate_max"] = "the mean square of the error does not die out even without losses"
        return 0.0
    if found >= 1.0:
        reasons["loss_rate_max"] = "no bound: no loss rate that was tried is too high"
        return None
    return found


def _mean_burst(scenario: Scenario, loop: LinearLoop, reasons: dict[str, str]) -> float | None:
    chain = chain_of(scenario.relay.uplink)
    if chain is None:
        reasons["mean_burst_max"] = f"the loss rate of the channel {scenario.relay.uplink.model} has no closed form"
        return None
    if not 0.0 < chain.loss_rate < 1.0 or loop.is_exact:
        reasons["mean_burst_max"] = "the scenario's uplink loses nothing, or everything: see loss_rate_and_burst"
        return None
    return _burst(loop, chain.loss_rate)


def _burst(loop: LinearLoop, rate: float) -> float | None:
    """Mean burst that is taken at a loss rate: inf if any is, None if none is short enough."""
    found = mean_square.critical_burst(loop.thinned(PLACES), rate)
    return None if found < 0.0 else found


def _bursts(loop: LinearLoop) -> tuple[tuple[float, float | None], ...]:
    return () if loop.is_exact else tuple((rate, _burst(loop, rate)) for rate in LOSS_RATES)


def _losses_behind_delays(
    loop: LinearLoop, longest: int | None, reasons: dict[str, str]
) -> tuple[tuple[float, float], ...]:
    """At the top speed, held; empty where there is no answer."""
    if loop.predicts:
        reasons["latency_and_loss"] = "computed for a pose that is held, not for one that is predicted"
        return ()
    if longest is None or longest < 0:
        return ()
    fastest = loop.frozen(int(np.argmax(np.abs(loop.v_r))))
    delays = sorted({round(share * longest) for share in _DELAYS})
    return tuple((delay * loop.ts, critical_loss_behind(fastest, delay)) for delay in delays)
