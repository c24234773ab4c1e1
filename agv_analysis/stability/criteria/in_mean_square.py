"""Mean square: does E[|e|^2] die out under random losses?"""

from __future__ import annotations

import math
from collections.abc import Iterable

from agv_analysis.json_values import finite
from agv_analysis.link import joint_chain
from agv_analysis.link.markov_channel import chain_of, renewal_chain, shortest_mean_burst, why_no_chain
from agv_analysis.scenario import Scenario
from agv_analysis.stability import mean_square, mean_square_downlink
from agv_analysis.stability.criteria.criterion import (
    Border,
    Criterion,
    Judgement,
    Margin,
    Row,
    RunFacts,
    ScenarioFacts,
    growth_text,
)
from agv_analysis.stability.first_border import not_monotone
from agv_analysis.stability.scenario_loop import straight_loop_of

NOT_MET = "not met: the error does not contract even without losses"


def growth_on_both_links(facts: RunFacts) -> float | None:
    """Growth of E[e^2] per step under both fitted channels; None if no command was lost, or for other policies.

    Where the recorded outcomes say that the links fail together, or by turns, they are one chain.
    """
    run, plant = facts.run, facts.run.scenario.plant
    if not run.downlink_lost.any() or mean_square_downlink.why_not(plant):
        return None
    links = joint_chain.fitted(run.lost, run.downlink_lost)
    if links is None:
        links = joint_chain.independent(facts.fit.chain, facts.downlink_fit.chain)
    return mean_square_downlink.lap_growth(facts.loop, links, plant) / len(run)


def _judge(facts: RunFacts) -> Judgement | None:
    if not facts.is_feasible:
        return None
    both = growth_on_both_links(facts)
    growth = mean_square.lap_growth(facts.loop, facts.fit.chain) / len(facts.run) if both is None else both
    if facts.run.is_late:
        values = {"mean_square_stable": None, "mean_square_growth": None}
        why = "no channel that is fitted to the losses explains how late poses and commands came"
        return Judgement("Mean square", None, why, values, (growth, both))
    links = "" if both is None else " of both links"
    return Judgement(
        "Mean square", growth < 0.0, f"{growth_text(growth)} under the fitted channel{links}",
        {"mean_square_stable": growth < 0.0, "mean_square_growth": finite(growth)}, (growth, both),
    )  # fmt: skip


def _margins(facts: ScenarioFacts) -> Iterable[Margin]:
    name, label = "p_max.mean_square", "Independent losses, mean square"
    found = mean_square.loss_borders(facts.loop)
    if not found:
        reason = f"no bound: the mean square dies out at every loss probability up to {mean_square.MOST_LOST}"
        yield Margin(name, label, None, reason=reason)
    elif found[0] == 0.0:
        yield Margin(name, label, None, reason=NOT_MET)
    else:
        yield Margin(name, label, found[0], f"below {found[0]:.5g}", not_monotone(found, 5))
    yield _burst(facts)
    yield _as_it_is(facts)


def _as_it_is(facts: ScenarioFacts) -> Margin:
    """Growth of E[e^2] under the scenario's uplink."""
    name, label, uplink = "uplink.mean_square_growth", "Uplink as it is, mean square", facts.scenario.relay.uplink
    chain = chain_of(uplink)
    if chain is None:
        return Margin(name, label, None, reason=f"no answer: the channel {uplink.model} {why_no_chain(uplink)}")
    if uplink.delays:
        return Margin(name, label, None, reason="no answer: poses are late as well", shown=False)
    growth = mean_square.lap_growth(facts.loop, chain) / facts.loop.steps
    return Margin(name, label, finite(growth), growth_text(growth))


def _burst(facts: ScenarioFacts) -> Margin:
    """The critical mean burst at the loss rate of the scenario's uplink."""
    name, label, uplink = "burst_max.mean_square", "Bursts, mean square", facts.scenario.relay.uplink
    chain = chain_of(uplink)
    if chain is None:
        reason = (
            f"no answer: the channel {uplink.model} {why_no_chain(uplink)}, so that its loss rate has no closed form"
        )
        return Margin(name, label, None, reason=reason, extra={"loss_rate": None})
    rate = chain.loss_rate
    extra, label = {"loss_rate": rate}, f"{label} at a loss rate of {rate:.4g}"
    if not 0.0 < rate < 1.0:
        reason = f"no answer: the scenario's uplink loses {'nothing' if rate == 0.0 else 'everything'}"
        return Margin(name, label, None, reason=reason, extra=extra)
    found = mean_square.burst_borders(facts.loop, rate)
    if not found:
        reason = "no bound: bursts of a million slots on average are not too long"
        return Margin(name, label, None, reason=reason, extra=extra)
    if found[0] == shortest_mean_burst(rate):
        reason = "not met: at this loss rate no burst is short enough"
        return Margin(name, label, None, reason=reason, extra=extra)
    return Margin(name, label, found[0], f"{found[0]:.4g} slots on average", not_monotone(found, 4), extra)


def _at_once(facts: RunFacts) -> Iterable[Row]:
    loop = facts.loop
    if loop.closed_form is not None:
        but = ", without the predictor" if loop.predicts else ""
        loss = -1.0 if loop.along_gain is None else mean_square.critical_loss_along(loop.along_gain)
        yield "Independent losses, mean square", f"below {loss:.4g}{but}" if loss > 0.0 else "none"


def _border(scenario: Scenario) -> float:
    """T_s K_x (E[n_ul] + 1/2) - 1 along a straight track; NaN where theory is silent."""
    chain, loop = renewal_chain(scenario.relay), straight_loop_of(scenario)
    if chain is None or loop is None or loop.along_gain is None or loop.predicts:
        return math.nan
    return loop.along_gain * (chain.mean_age + 0.5) - 1.0


CRITERION = Criterion(
    key="mean_square",
    order=40,
    title="Mean square",
    asks="Does E[|e|^2] die out under random losses?",
    assumes="That the channel is a finite Markov chain; of a run the one that is fitted to it.",
    judge=_judge,
    margins=_margins,
    margin_names=(
        ("p_max.mean_square", "Independent losses, mean square"),
        ("burst_max.mean_square", "Bursts, mean square"),
        ("uplink.mean_square_growth", "Uplink as it is, mean square"),
    ),
    at_once=_at_once,
    border=Border("mean square", _border),
)
