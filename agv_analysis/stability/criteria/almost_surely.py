"""Almost surely: does the error die out in every run but a set of probability 0?"""

from __future__ import annotations

import math
from collections.abc import Iterable

from agv_analysis.link.markov_channel import renewal_chain
from agv_analysis.scenario import Scenario
from agv_analysis.stability import almost_sure
from agv_analysis.stability.criteria.criterion import Border, Criterion, Margin, ScenarioFacts
from agv_analysis.stability.criteria.in_mean_square import NOT_MET
from agv_analysis.stability.scenario_loop import straight_loop_of

_NAME, _LABEL = "p_max.almost_sure", "Independent losses, almost surely, linear"


def _margins(facts: ScenarioFacts) -> Iterable[Margin]:
    loop, reason = facts.loop, ""
    p = almost_sure.critical_loss(loop)
    if p is None:
        reason = "no bound: almost every run converges at every loss probability up to 0.999"
    elif p < 0.0:
        p, reason = None, NOT_MET
    yield Margin(_NAME, _LABEL, p, "" if p is None else f"below {p:.5g}", reason)


def _border(scenario: Scenario) -> float:
    """The exponent E[log|1 - T_s K_x L|] / E[L] along a straight track; NaN where theory is silent."""
    chain, loop = renewal_chain(scenario.relay), straight_loop_of(scenario)
    if chain is None or loop is None or loop.along_gain is None or loop.predicts:
        return math.nan
    return almost_sure.exponent_along(loop.along_gain, chain)


CRITERION = Criterion(
    key="almost_sure",
    order=50,
    title="Almost surely, linear",
    asks="Does a small error die out in every run but a set of probability 0?",
    assumes="The linear loop; far from the reference `hold` leaves its range long before.",
    margins=_margins,
    margin_names=((_NAME, _LABEL),),
    border=Border("almost surely", _border),
)
