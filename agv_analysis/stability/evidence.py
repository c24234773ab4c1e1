"""What is known of the loop of a run, or of a scenario, for the one word of `verdict`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping

import numpy as np

from agv_analysis.link.channel_fit import ChannelFit
from agv_analysis.link.markov_channel import chain_of
from agv_analysis.run import Run
from agv_analysis.scenario import Scenario
from agv_analysis.simulation import simulate
from agv_analysis.stability import joint_spectral_radius, mean_square
from agv_analysis.stability.criteria import CRITERIA
from agv_analysis.stability.criteria.any_outages import longest_for
from agv_analysis.stability.criteria.criterion import Judgement, RunFacts, has_late
from agv_analysis.stability.empirical import Twins, with_an_end
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.repeated_run import RepeatedRun, repeated_run
from agv_analysis.stability.verdict import Evidence

_TIMES_AS_FAR = 2.0
"""A recorded deviation may be this many times the simulated one, for what the model of the plant does not know."""

_TOLERANCE = 0.05
"""It may be this much [m] larger in any case."""

_NOISE = 6.0
"""Standard deviations of the measurement noise by which it may be larger."""


def judgements_of(facts: RunFacts) -> dict[str, Judgement]:
    """What each criterion that applies says of a run, by its key."""
    judged = {criterion.key: criterion.judge(facts) for criterion in CRITERIA}
    return {key: found for key, found in judged.items() if found is not None}


def evidence_of_run(facts: RunFacts, judgements: Mapping[str, Judgement]) -> Evidence:
    """Of a run, with what each criterion says of it."""
    run, missing = facts.run, sum(facts.run.unexplained.values())
    common = Evidence(
        n=facts.n, v_max=run.scenario.controller.v_max, infeasible=facts.infeasible, missing=missing
    )  # fmt: skip
    if not facts.is_feasible or missing:
        return common
    repeated = repeated_run(run, facts.loop)
    common = dataclasses.replace(common, repeated=repeated, contradictions=tuple(_contradictions(run, repeated)))
    if facts.is_late:
        return _of_late_messages(common, run, judgements)
    growth, both = judgements["mean_square"].detail
    if run.downlink_lost.any():
        return _of_both_links(common, run, both)
    n_bursts, _ = joint_spectral_radius.largest_n(facts.loop, longest_for(facts.loop, facts.n))
    burst_left = _burst_left(facts.fit, growth, facts.loop)
    return dataclasses.replace(common, n_bursts=n_bursts, growth=growth, burst_left=burst_left)


def evidence_of_scenario(scenario: Scenario, twins: Twins | None = None) -> Evidence:
    """Of a scenario: as of a run of it, a lap or all that it lasts, but with the channel known where it is a chain.

    `twins` are those that were simulated of it. Raises TrackFileError if the track's file cannot be used.
    """
    run = simulate(with_an_end(scenario))
    facts = RunFacts(run)
    found = evidence_of_run(facts, judgements_of(facts))
    found = dataclasses.replace(found, twins=None if twins is None else (twins.contracting, len(twins.contraction)))
    uplink, downlink = chain_of(scenario.relay.uplink), chain_of(scenario.relay.downlink)
    if not facts.is_feasible or facts.is_late or uplink is None or downlink is None or downlink.loss_rate > 0.0:
        return found
    growth = mean_square.lap_growth(facts.loop, uplink) / len(run)
    is_random = bool(np.any((uplink.delivery > 0.0) & (uplink.delivery < 1.0)) or np.any(
        (uplink.transition > 0.0) & (uplink.transition < 1.0)
    ))  # fmt: skip
    return dataclasses.replace(
        found, growth=growth, probability_stable=1.0 if growth < 0.0 else 0.0, seen="", is_unlimited=is_random,
        burst_left=None,
    )  # fmt: skip


def _of_late_messages(common: Evidence, run: Run, judgements: Mapping[str, Judgement]) -> Evidence:
    delay = _constant_delay(run)
    if delay is None:
        why = "messages were late, by no constant delay, which no criterion covers"
        return dataclasses.replace(common, not_covered=why)
    return dataclasses.replace(common, late_by=delay, lifted_radius=judgements["lifted"].detail)


def _of_both_links(common: Evidence, run: Run, growth: float | None) -> Evidence:
    if growth is None:
        policy = run.scenario.plant.downlink_policy
        why = f"commands were lost, and no criterion covers downlink policy {policy}"
        return dataclasses.replace(common, not_covered=why)
    return dataclasses.replace(common, growth=growth, growth_of="both_links")


def _constant_delay(run: Run) -> int | None:
    """Age of the pose in slots, if it is always the same, but for the beginning, and commands are there at once."""
    n = int(run.n_ul.max())
    is_direct = not (run.downlink_lost.any() or has_late(run.downlink))
    return n if is_direct and np.array_equal(run.n_ul, np.minimum(run.k, n)) else None


def _burst_left(fit: ChannelFit, growth: float, loop: LinearLoop) -> float | None:
    """By what factor the mean burst may grow at the fitted loss rate; None for a fit without bursts."""
    if fit.model != "gilbert_elliott" or growth >= 0.0 or fit.chain.loss_rate >= 1.0:
        return None
    critical = mean_square.critical_burst(loop, fit.chain.loss_rate)
    return critical / fit.mean_burst if np.isfinite(critical) else None


def _contradictions(run: Run, repeated: RepeatedRun | None) -> Iterator[str]:
    """How a recording contradicts what is known of the loop."""
    plant = run.scenario.plant
    if repeated is None or plant.slip_noise > 0.0 or not math.isfinite(repeated.largest_in_run):
        return
    later = slice(len(run) // 2, None)
    recorded = float(np.hypot(*(run.pose - run.reference[:, :3])[later, :2].T).max())
    allowed = _TIMES_AS_FAR * repeated.largest_in_run + _TOLERANCE + _NOISE * plant.noise_xy
    if not recorded <= allowed:
        yield (
            f"the AGV was up to {recorded:.3g} m off its track, in the simulation under the same losses up to "
            f"{repeated.largest_in_run:.3g} m: it is not driven by this law, these parameters or this model"
        )
