"""How much a scenario can take: the largest outage, loss probability and burst by each criterion, and what binds."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from agv_analysis.link.markov_channel import chain_of
from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.reference import reference_of
from agv_analysis.stability import (
    almost_sure,
    floquet,
    joint_spectral_radius,
    lifted,
    mean_square,
    mean_square_two_links,
    paper,
)
from agv_analysis.stability.linearisation import HELD, Edge
from agv_cloud.parameters import ControllerParameters
from agv_cloud.reference.reference import lap_steps
from agv_plant.parameters import ChannelParameters, PlantParameters
from agv_ros.parameters import SHARED, as_dict

ALONG, ACROSS = "along", "across"

LONGEST, LONGEST_PREDICTED = 1000, 200
"""Longest bursts [slots] that are tried; fewer behind a predictor, where nothing ends the search early."""

LONGEST_DELAY, LONGEST_DELAY_PREDICTED = 10_000, 1000
"""Longest constant delay [steps] that is tried; shorter behind a predictor, where each takes longer."""


_KNOWN_TO_CRITERIA = {
    *(f"plant.{name}" for name in SHARED),
    *(f"plant.{name}" for name in ("initial_pose", "integration", "clock", "duration", "speed_scale")),
    *(f"plant.{name}" for name in ("answer_timeout", "cmd_vel_timeout", "downlink_policy", "ramp_time", "seed")),
}
"""Parameters of the plant that criteria ask for, that do not matter to them, or only where commands are lost."""


@dataclass(frozen=True)
class Margins:
    """Margins of a loop on its track.

    None: there is no bound, or the criterion is not met at all; `reasons` says which. A number of steps of -1: the
    loop does not contract even if every pose is fresh.
    """

    n_paper: int | None
    """Largest constant n_ul for which the paper's test holds at every step of a lap."""
    n_lifted: int | None
    """Largest constant n_ul under which a lap contracts every small error."""
    n_bursts: int | None
    """Most consecutive losses, in any order, as often as nature likes, under which the loop is proved to contract."""
    p_mean_square: float | None
    """Probability of independent losses below which E[e^2] dies out."""
    p_almost_sure: float | None
    """Probability of independent losses below which almost every run converges."""
    loss_rate: float | None
    """Loss rate of the scenario's uplink, None for a channel without a closed form."""
    burst_mean_square: float | None
    """Mean burst [slots] at that loss rate, below which E[e^2] dies out."""
    delay: float | None
    """Largest constant delay of the pose [s] on a straight track at the track's largest speed, between samples too."""
    binding: str | None
    """Which error the bursts blow up first: `along` the track or `across` it."""
    both_links: float | None = None
    """Growth (logarithm, per step) of E[e^2] with both links as they are; None unless the downlink loses commands."""
    reasons: dict[str, str] = field(default_factory=dict)
    """Why a margin is None, by its name in `to_json`."""
    left_out: tuple[str, ...] = ()
    """What the scenario has and these margins do not know."""

    def disagreements(self) -> list[str]:
        """A sentence for each pair of criteria that say different things."""
        found = []
        if self.n_lifted is not None and (self.n_paper is None or self.n_paper > self.n_lifted):
            said = "any number" if self.n_paper is None else f"up to {self.n_paper}"
            found.append(
                f"the paper's test allows {said} of outages; a pose that is always {_steps(self.n_lifted + 1)} old "
                "makes the error grow"
            )
        if self.n_paper is not None and self.n_bursts is not None and self.n_paper < self.n_bursts:
            found.append(
                "the paper's test calls the loop unstable "
                + ("even without outages" if self.n_paper < 0 else f"beyond {self.n_paper} outages")
                + f"; it contracts under any outages of up to {self.n_bursts} slots"
            )
        if self.n_lifted is not None and self.n_bursts is not None and self.n_bursts > self.n_lifted:
            found.append(
                f"outages of up to {self.n_bursts} slots are survived, since a fresh pose follows each; a pose that is "
                f"always {_steps(self.n_lifted + 1)} old is not"
            )
        if (
            self.p_mean_square is not None
            and self.p_almost_sure is not None
            and self.p_almost_sure > self.p_mean_square
        ):
            found.append(
                f"between {self.p_mean_square:.4f} and {self.p_almost_sure:.4f} of independent losses almost every run "
                "converges, but the mean square of the error grows: rare long outages dominate it"
            )
        return found

    def to_json(self) -> dict[str, Any]:
        """The margins by name, beside each that is null its reason."""
        tree: dict[str, dict[str, Any]] = {
            "n_max": {"paper": self.n_paper, "lifted": self.n_lifted, "bursts": self.n_bursts},
            "p_max": {"mean_square": self.p_mean_square, "almost_sure": self.p_almost_sure},
            "burst_max": {"mean_square": self.burst_mean_square},
            "both_links": {"mean_square_growth": self.both_links},
        }
        for group, values in tree.items():
            for name in list(values):
                if f"{group}.{name}" in self.reasons:
                    values[f"{name}_reason"] = self.reasons[f"{group}.{name}"]
        return {
            **tree,
            **_with_reason("delay_margin", self.delay, self.reasons),
            "loss_rate": self.loss_rate,
            "binding": self.binding,
            "left_out": list(self.left_out),
            "disagreements": self.disagreements(),
        }


def _with_reason(name: str, value: float | None, reasons: dict[str, str]) -> dict[str, Any]:
    return {name: value} if name not in reasons else {name: value, f"{name}_reason": reasons[name]}


def _steps(n: int) -> str:
    return "1 step" if n == 1 else f"{n} steps"


def margins(scenario: Scenario) -> Margins:
    """Margins of a scenario over one lap of its track. Raises TrackFileError if the track's file cannot be used.

    They are those of the loop linearised about its reference: a limit on the speed bounds what is unstable, it does
    not stabilise it.
    """
    ts, gains, reasons = scenario.plant.ts, scenario.controller, {}
    reference = reference_of(scenario.error_detector, _lap(scenario))
    theta, v_r, w_r = reference[:, 2], reference[:, 3], reference[:, 4]
    n_paper = paper.largest_n(theta, v_r, gains, ts)
    if n_paper is None:
        reasons["n_max.paper"] = (
            "no bound: the test holds for every n, since it sees an outdated pose only by how far it has turned"
        )
    edge = Edge.of(scenario)
    true = edge.felt(gains)
    n_lifted = _largest_constant_delay(v_r, w_r, gains, ts, edge, reasons)
    longest = LONGEST_PREDICTED if edge.predicts else LONGEST
    n_bursts, refuted = joint_spectral_radius.largest_n(v_r, w_r, gains, ts, longest, edge)
    if n_bursts is None:
        reasons["n_max.bursts"] = f"no bound: every burst that was tried contracts, up to {longest} slots"
    elif refuted is not None and refuted > n_bursts + 1:
        reasons["n_max.bursts"] = f"proved up to {n_bursts}, refuted from {refuted} on, between them undecided"
    p_mean_square = _none_below_zero(mean_square.critical_loss(v_r, w_r, gains, ts, edge), "p_max.mean_square", reasons)
    if p_mean_square is not None and p_mean_square > mean_square.MOST_LOST:
        p_mean_square = None
        reasons["p_max.mean_square"] = (
            f"no bound: the mean square dies out at every loss probability up to {mean_square.MOST_LOST}"
        )
    p_almost_sure = almost_sure.critical_loss(v_r, w_r, gains, ts, edge=edge)
    if p_almost_sure is not None:
        p_almost_sure = _none_below_zero(p_almost_sure, "p_max.almost_sure", reasons)
    else:
        reasons["p_max.almost_sure"] = "no bound: almost every run converges at every loss probability up to 0.999"
    if almost_sure.is_degenerate(ts * gains.kx) and not np.any(w_r) and edge == HELD:
        reasons.setdefault(
            "p_max.almost_sure",
            "1 / (T_s K_x) is an integer: on a straight track some burst brings the error along it to 0 at one stroke",
        )
    loss_rate, burst = _burst(scenario, v_r, w_r, edge, reasons)
    return Margins(
        n_paper=n_paper,
        n_lifted=n_lifted,
        n_bursts=n_bursts,
        p_mean_square=p_mean_square,
        p_almost_sure=p_almost_sure,
        loss_rate=loss_rate,
        burst_mean_square=burst,
        delay=_delay(float(np.abs(v_r).max()), true, ts, edge, reasons),
        both_links=_both_links(scenario, v_r, w_r, edge, reasons),
        binding=_binding_of(edge, n_bursts, float(np.abs(v_r).max()), true, ts),
        reasons=reasons,
        left_out=left_out(scenario),
    )


def left_out(scenario: Scenario) -> tuple[str, ...]:
    """What a scenario has and no criterion but the empirical one knows, each as `node.parameter is value`."""
    values = {f"plant.{name}": value for name, value in as_dict(scenario.plant).items()}
    usual = {f"plant.{name}": value for name, value in as_dict(PlantParameters()).items()}
    found = [name for name in values if name not in _KNOWN_TO_CRITERIA and values[name] != usual[name]]
    links = {"uplink": scenario.relay.uplink, "downlink": scenario.relay.downlink}
    on_top = [
        f"relay.{link}.{name} is {value}"
        for link, channel in links.items()
        for name in ("delay", "jitter", "lifetime", "schedule")
        if (value := getattr(channel, name)) != getattr(ChannelParameters(), name)
    ]
    return (*(f"{name} is {values[name]}" for name in found), *on_top)


def _largest_constant_delay(
    v_r: Floats, w_r: Floats, gains: ControllerParameters, ts: float, edge: Edge, reasons: dict[str, str]
) -> int | None:
    limit = 0 if edge.is_exact else LONGEST_DELAY_PREDICTED if edge.predicts else LONGEST_DELAY
    found = floquet.largest_constant_delay(v_r, w_r, gains, ts, limit, edge)
    if found is None:
        reasons["n_max.lifted"] = (
            "no bound: an exact prediction is as good as a fresh pose"
            if edge.is_exact
            else f"no bound: the lap contracts for every n that was tried, up to {limit}"
        )
    return found


def _binding_of(edge: Edge, n_bursts: int | None, v: float, gains: ControllerParameters, ts: float) -> str | None:
    """As `binding`; behind a predictor the error along the track, since the model is wrong in that speed alone."""
    if edge.predicts:
        return None if n_bursts is None else ALONG
    return binding(v, gains, ts)


def binding(v: float, gains: ControllerParameters, ts: float) -> str | None:
    """Which error bursts blow up first at the speed `v` [m/s]: along or across the track; None if neither ever."""
    along = joint_spectral_radius.largest_n_along(ts * gains.kx)
    across = joint_spectral_radius.largest_n_across(v, gains, ts)
    if along is None and across is None:
        return None
    if across is None or (along is not None and along <= across):
        return ALONG
    return ACROSS


def _delay(v: float, gains: ControllerParameters, ts: float, edge: Edge, reasons: dict[str, str]) -> float | None:
    """Sampled delay margin [s] in closed form; None where no loop is stable or nothing can delay it too long."""
    steps = min(lifted.critical_delay_along(ts * gains.kx), lifted.critical_delay_across(v, gains, ts))
    if edge.predicts:
        reasons["delay_margin"] = "no answer: between samples it is computed for a pose that is held; see n_max.lifted"
    elif steps <= 0.0:
        reasons["delay_margin"] = "not met: the error does not contract even without a delay"
    elif math.isinf(steps):
        reasons["delay_margin"] = "no bound: no delay is too long"
    else:
        return ts * steps
    return None


def _lap(scenario: Scenario) -> int:
    """Steps of one lap; of a track from a file, those of the run."""
    steps = lap_steps(scenario.error_detector)
    if scenario.error_detector.track == "csv" and math.isfinite(scenario.plant.duration):
        steps = round(scenario.plant.duration / scenario.plant.ts)
    return max(1, steps)


def _burst(
    scenario: Scenario, v_r: Floats, w_r: Floats, edge: Edge, reasons: dict[str, str]
) -> tuple[float | None, float | None]:
    """Loss rate of the scenario's uplink, and the critical mean burst at it."""
    chain = chain_of(scenario.relay.uplink)
    loss_rate = None if chain is None else chain.loss_rate
    name = "burst_max.mean_square"
    if loss_rate is None:
        reasons[name] = f"no answer: the loss rate of the channel {scenario.relay.uplink.model} has no closed form"
        return None, None
    if not 0.0 < loss_rate < 1.0:
        reasons[name] = f"no answer: the scenario's uplink loses {'nothing' if loss_rate == 0.0 else 'everything'}"
        return loss_rate, None
    found = mean_square.critical_burst(loss_rate, v_r, w_r, scenario.controller, scenario.plant.ts, edge)
    if math.isinf(found):
        reasons[name] = "no bound: bursts of a million slots on average are not too long"
        return loss_rate, None
    return loss_rate, _none_below_zero(found, name, reasons)


def _both_links(scenario: Scenario, v_r: Floats, w_r: Floats, edge: Edge, reasons: dict[str, str]) -> float | None:
    """Growth per step with both links as the scenario has them, None where nothing is lost or nothing can be said."""
    name, policy = "both_links.mean_square_growth", scenario.plant.downlink_policy
    uplink, downlink = chain_of(scenario.relay.uplink), chain_of(scenario.relay.downlink)
    if downlink is not None and downlink.loss_rate == 0.0:
        reasons[name] = "the downlink loses nothing"
    elif uplink is None or downlink is None:
        reasons[name] = "no answer: a channel is no finite Markov chain"
    elif policy not in mean_square_two_links.POLICIES:
        reasons[name] = f"no answer: computed for a plant that holds its command or stops, not for {policy}"
    elif scenario.relay.downlink.correlation != 0.0:
        reasons[name] = "no answer: computed for links that lose independently of each other"
    else:
        growth = mean_square_two_links.lap_growth(
            v_r, w_r, scenario.controller, scenario.plant.ts, uplink, downlink, edge, policy == "zero"
        )
        return growth / len(v_r)
    return None


def _none_below_zero(margin: float, name: str, reasons: dict[str, str]) -> float | None:
    """The margin; None, with the reason, where the criterion is not met at all."""
    if margin >= 0.0:
        return margin
    reasons[name] = "not met: at this loss rate no burst is short enough" if "burst" in name else (
        "not met: the error does not contract even without losses"
    )  # fmt: skip
    return None
