"""How much a scenario can take: the largest outage, loss probability and burst by each criterion, and what binds."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from agv_analysis.link.markov_channel import chain_of
from agv_analysis.scenario import Scenario
from agv_analysis.stability import (
    almost_sure,
    floquet,
    joint_spectral_radius,
    lifted,
    mean_square,
    mean_square_two_links,
    paper,
)
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.scenario_loop import lap_of, loop_along
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
    reasons: dict[str, str] = {}
    lap = lap_of(scenario)
    loop = loop_along(scenario, lap)
    n_paper = paper.largest_n(lap[:, 2], lap[:, 3], scenario.controller, loop.ts)
    if n_paper is None:
        reasons["n_max.paper"] = (
            "no bound: the test holds for every n, since it sees an outdated pose only by how far it has turned"
        )
    n_lifted = _largest_constant_delay(loop, reasons)
    longest = LONGEST_PREDICTED if loop.predicts else LONGEST
    n_bursts, refuted = joint_spectral_radius.largest_n(loop, longest)
    if n_bursts is None:
        reasons["n_max.bursts"] = f"no bound: every burst that was tried contracts, up to {longest} slots"
    elif refuted is not None and refuted > n_bursts + 1:
        reasons["n_max.bursts"] = f"proved up to {n_bursts}, refuted from {refuted} on, between them undecided"
    loss_rate, burst = _burst(scenario, loop, reasons)
    return Margins(
        n_paper=n_paper,
        n_lifted=n_lifted,
        n_bursts=n_bursts,
        p_mean_square=_p_mean_square(loop, reasons),
        p_almost_sure=_p_almost_sure(loop, reasons),
        loss_rate=loss_rate,
        burst_mean_square=burst,
        delay=_delay(loop, reasons),
        both_links=_both_links(scenario, loop, reasons),
        binding=_binding_of(loop, n_bursts),
        reasons=reasons,
        left_out=left_out(scenario),
    )


def _p_mean_square(loop: LinearLoop, reasons: dict[str, str]) -> float | None:
    name = "p_max.mean_square"
    found = _none_below_zero(mean_square.critical_loss(loop), name, reasons)
    if found is not None and found > mean_square.MOST_LOST:
        reasons[name] = f"no bound: the mean square dies out at every loss probability up to {mean_square.MOST_LOST}"
        return None
    return found


def _p_almost_sure(loop: LinearLoop, reasons: dict[str, str]) -> float | None:
    name = "p_max.almost_sure"
    found = almost_sure.critical_loss(loop)
    if found is not None:
        found = _none_below_zero(found, name, reasons)
    else:
        reasons[name] = "no bound: almost every run converges at every loss probability up to 0.999"
    gains = loop.closed_form
    if gains is not None and not loop.predicts and not loop.w_r.any() and almost_sure.is_degenerate(loop.ts * gains.kx):
        reasons.setdefault(
            name,
            "1 / (T_s K_x) is an integer: on a straight track some burst brings the error along it to 0 at one stroke",
        )
    return found


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


def _largest_constant_delay(loop: LinearLoop, reasons: dict[str, str]) -> int | None:
    limit = 0 if loop.is_exact else LONGEST_DELAY_PREDICTED if loop.predicts else LONGEST_DELAY
    found = floquet.largest_constant_delay(loop, limit)
    if found is None:
        reasons["n_max.lifted"] = (
            "no bound: an exact prediction is as good as a fresh pose"
            if loop.is_exact
            else f"no bound: the lap contracts for every n that was tried, up to {limit}"
        )
    return found


def _binding_of(loop: LinearLoop, n_bursts: int | None) -> str | None:
    """As `binding`; behind a predictor the error along the track, since the model is wrong in that speed alone."""
    if loop.closed_form is None:
        return None
    if loop.predicts:
        return None if n_bursts is None else ALONG
    return binding(loop)


def binding(loop: LinearLoop) -> str | None:
    """Which error bursts blow up first on a straight track at the lap's top speed: along it or across it.

    None if neither ever does, or where no closed form says it.
    """
    if loop.closed_form is None:
        return None
    along, across = joint_spectral_radius.largest_n_straight(loop)
    if along is None and across is None:
        return None
    if across is None or (along is not None and along <= across):
        return ALONG
    return ACROSS


def _delay(loop: LinearLoop, reasons: dict[str, str]) -> float | None:
    """Sampled delay margin [s] in closed form; None where no loop is stable or nothing can delay it too long."""
    name = "delay_margin"
    if loop.predicts:
        reasons[name] = "no answer: between samples it is computed for a pose that is held; see n_max.lifted"
        return None
    if loop.closed_form is None:
        reasons[name] = "no answer: between samples it is computed for Kanayama's law on a unicycle; see n_max.lifted"
        return None
    steps = lifted.critical_delay(loop)
    if steps <= 0.0:
        reasons[name] = "not met: the error does not contract even without a delay"
    elif math.isinf(steps):
        reasons[name] = "no bound: no delay is too long"
    else:
        return loop.ts * steps
    return None


def _burst(scenario: Scenario, loop: LinearLoop, reasons: dict[str, str]) -> tuple[float | None, float | None]:
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
    found = mean_square.critical_burst(loop, loss_rate)
    if math.isinf(found):
        reasons[name] = "no bound: bursts of a million slots on average are not too long"
        return loss_rate, None
    return loss_rate, _none_below_zero(found, name, reasons)


def _both_links(scenario: Scenario, loop: LinearLoop, reasons: dict[str, str]) -> float | None:
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
        links = mean_square_two_links.independent(uplink, downlink)
        return mean_square_two_links.lap_growth(loop, links, policy == "zero") / loop.steps
    return None


def _none_below_zero(margin: float, name: str, reasons: dict[str, str]) -> float | None:
    """The margin; None, with the reason, where the criterion is not met at all."""
    if margin >= 0.0:
        return margin
    reasons[name] = "not met: at this loss rate no burst is short enough" if "burst" in name else (
        "not met: the error does not contract even without losses"
    )  # fmt: skip
    return None
