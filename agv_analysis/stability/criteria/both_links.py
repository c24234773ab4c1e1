"""Mean square where commands are lost as well as poses, with the links as a scenario has them."""

from __future__ import annotations

from collections.abc import Iterable

from agv_analysis.json_values import finite
from agv_analysis.link import joint_chain
from agv_analysis.link.markov_channel import chain_of
from agv_analysis.stability import mean_square_downlink
from agv_analysis.stability.criteria.criterion import Criterion, Margin, ScenarioFacts, growth_text


def _margins(facts: ScenarioFacts) -> Iterable[Margin]:
    name, label = "both_links.mean_square_growth", "Both links as they are, mean square"
    relay, plant = facts.scenario.relay, facts.scenario.plant
    uplink, downlink = chain_of(relay.uplink), chain_of(relay.downlink)
    if downlink is not None and downlink.loss_rate == 0.0:
        yield Margin(name, label, None, reason="the downlink loses nothing", shown=False)
        return
    reason = ""
    if uplink is None or downlink is None:
        reason = "no answer: a channel is not a finite Markov chain"
    elif why := mean_square_downlink.why_not(plant):
        reason = f"no answer: {why}"
    if reason or uplink is None or downlink is None:
        yield Margin(name, label, None, reason=reason)
        return
    links = joint_chain.correlated(uplink, downlink, relay.downlink.correlation)
    growth = mean_square_downlink.lap_growth(facts.loop, links, plant) / facts.loop.steps
    yield Margin(name, label, finite(growth), growth_text(growth))


CRITERION = Criterion(
    key="both_links",
    order=60,
    title="Both links, mean square",
    asks="Does E[|e|^2] die out if commands are lost as well as poses?",
    assumes="Links that are finite Markov chains, apart or with common random numbers; a plant that holds, stops or "
    "ramps down.",
    margins=_margins,
    margin_names=(("both_links.mean_square_growth", "Both links as they are, mean square"),),
)
