"""What is known of the loop of a run, or of a scenario, for the one word of `verdict`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from agv_analysis.link import joint_chain
from agv_analysis.link.channel_fit import ChannelFit
from agv_analysis.link.joint_chain import JointChain
from agv_analysis.link.markov_channel import Chain, chain_of, gilbert_elliott
from agv_analysis.link.periodic_outages import period_of, scripted_outages
from agv_analysis.metrics.deviation import DIVERGED
from agv_analysis.metrics.distance_text import metres
from agv_analysis.run import Run
from agv_analysis.scenario import Scenario
from agv_analysis.simulation import simulate
from agv_analysis.stability import lifted, mean_square, mean_square_downlink
from agv_analysis.stability.confidence.link_confidence import LinkConfidence, link_confidence
from agv_analysis.stability.confidence.segment_confidence import growth_of_period
from agv_analysis.stability.criteria import CRITERIA
from agv_analysis.stability.criteria.any_outages import largest_n, longest_for
from agv_analysis.stability.criteria.criterion import PLACES_OF_LONG_LAP, Judgement, RunFacts, has_late
from agv_analysis.stability.criteria.late_and_lost import growth_of_channel, growths_of_halves
from agv_analysis.stability.driven_commands import DrivenCommands, driven_commands, scenarios_of
from agv_analysis.stability.empirical import with_an_end
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.repeated_run import RepeatedRun, is_disturbed, repeated_run
from agv_analysis.stability.verdict import GREEN, MEAN_SQUARE, SURE, UNSTABLE, Evidence, Verdict, decide, weakest
from agv_cloud.reference.reference import lap_steps
from agv_ros.counted import counted

_TIMES_AS_FAR = 2.0
"""A recorded deviation may be this many times the simulated one, for what the model of the plant does not know."""

_TOLERANCE = 0.05
"""It may be this much [m] larger in any case."""

_PLACES = 2000
"""Places of the lap, at least, at which it is asked how much longer outages may become."""


class Judgements(Mapping[str, Judgement]):
    """What each criterion that applies says of a run, by its key; a criterion is asked when it is looked up."""

    def __init__(self, facts: RunFacts) -> None:
        self._facts = facts
        self._judge = {criterion.key: criterion.judge for criterion in CRITERIA}
        self._found: dict[str, Judgement | None] = {}

    def __getitem__(self, key: str) -> Judgement:
        if key not in self._found:
            self._found[key] = self._judge[key](self._facts)
        found = self._found[key]
        if found is None:
            raise KeyError(key)
        return found

    def __iter__(self) -> Iterator[str]:
        return (key for key in self._judge if key in self)

    def __len__(self) -> int:
        return sum(1 for _ in self)


def verdict_of_run(facts: RunFacts, evidence: Evidence) -> Verdict:
    """The word on a run. Where parameters were changed while it went on, the worst of its parts decides."""
    run, parts = facts.run, scenarios_of(facts.run)
    if len(parts) == 1 or evidence.missing:
        return decide(evidence)
    ends = [*(k for k, _ in parts[1:]), int(run.k[-1]) + 1]
    found = []
    for (begin, scenario), end in zip(parts, ends, strict=True):
        rows = slice(*np.searchsorted(run.k, (begin, end)))
        part = RunFacts(replace(run.part(rows), scenario=scenario, parameter_changes=()))
        word = decide(evidence_of_run(part, Judgements(part)))
        where = f"parameters were changed, and from {begin * run.ts:g} s to {end * run.ts:g} s"
        found.append(replace(word, reason=f"{where}: {word.reason}"))
    return weakest(found)


def evidence_of_run(facts: RunFacts, judgements: Mapping[str, Judgement]) -> Evidence:
    """Of a run, with what each criterion says of it; of one whose parameters were changed with those of its beginning.

    Raises PartError if a part raises.
    """
    return _with_margin(_evidence(facts, judgements), facts, judgements)


def _evidence(facts: RunFacts, judgements: Mapping[str, Judgement]) -> Evidence:
    """All that decides the word."""
    run, missing = facts.run, sum(facts.run.unexplained.values())
    common = replace(_common(facts), missing=missing)
    if not facts.is_feasible or missing:
        return common
    driven, repeated = driven_commands(run), repeated_run(run, facts.loop)
    contradictions = tuple(_contradictions(run, driven, repeated))
    common = replace(common, driven=driven, repeated=repeated, contradictions=contradictions)
    return _under_links_as_seen(common, facts, judgements)


def _common(facts: RunFacts) -> Evidence:
    nominal = facts.loop.nominal if facts.is_feasible else None
    return Evidence(
        n=facts.n,
        v_max=facts.run.scenario.controller.v_max,
        beside_reference=0.0 if nominal is None else float(np.hypot(nominal[:, 0], nominal[:, 1]).max()),
        is_disturbed=is_disturbed(facts.run.scenario.plant),
        infeasible=facts.infeasible,
    )


def _under_links_as_seen(common: Evidence, facts: RunFacts, judgements: Mapping[str, Judgement]) -> Evidence:
    """With the growth under the links, as far as the run shows them."""
    run = facts.run
    if facts.is_late:
        return _of_late_messages(common, facts, judgements)
    if run.downlink_lost.any():
        return _of_both_links(common, facts, judgements)
    if _loses_nothing(run):
        return _with_growth(common, float(judgements["mean_square"].detail[0]))
    link = link_confidence(facts.loop, run.k, run.lost, run.ts)
    return replace(common, growth=link.growth, link=link, probability_stable=link.probability_stable)


def _with_margin(evidence: Evidence, facts: RunFacts, judgements: Mapping[str, Judgement]) -> Evidence:
    """With what only a green word asks for, and what takes longest: which outages any sequence may have, and longer."""
    if not _asks_for_outages(evidence):
        return evidence
    if facts.loop.closed_form is None and not facts.loop.is_constant:  # half a minute for a number beside the word
        found = _with_longest(evidence, facts, judgements)
    else:
        n_bursts, _ = largest_n(facts.loop, longest_for(facts.loop, facts.n))
        found = replace(evidence, n_bursts=n_bursts)
    if evidence.link is None or decide(found).word != MEAN_SQUARE:
        return found
    return replace(found, burst_left=_burst_left(facts.fit, evidence.link, facts.loop))


def _with_longest(evidence: Evidence, facts: RunFacts, judgements: Mapping[str, Judgement]) -> Evidence:
    """With whether outages of up to the longest one are survived in any order, which only a green word asks for."""
    if not _asks_for_outages(evidence):
        return evidence
    return replace(evidence, n_bursts=facts.n if judgements["bursts"].stable else -1, is_least=True)


def _asks_for_outages(evidence: Evidence) -> bool:
    is_of_outages = evidence.growth is not None and evidence.growth_of == "mean_square"
    return is_of_outages and decide(evidence).word in GREEN


def _loses_nothing(run: Run) -> bool:
    """Is it known that the uplink loses nothing, and not only seen? The relay passes everything on."""
    uplink = run.scenario.relay.uplink
    is_perfect = uplink.model == "perfect" and not uplink.schedule and not run.parameter_changes
    return is_perfect and run.seed_known and not run.lost.any()


def evidence_of_scenario(
    scenario: Scenario, twins: tuple[int, int] | None = None, with_margin: bool = True
) -> Evidence:
    """Of a scenario: as of a run over a lap of its track, but with the channel known where it is a chain.

    `twins`: how many of how many simulated runs of it contract the distance of twins. Without the margin, `n_bursts`
    only says whether the longest outage is survived, and nothing is simulated that cannot change the word: that takes a
    fraction of a second.

    Raises TrackFileError if the track's file cannot be used.
    """
    facts = RunFacts(simulate(_to_judge(scenario)))
    judgements, common = Judgements(facts), replace(_common(facts), twins=twins)
    if not facts.is_feasible:
        return common
    found = _under_links(common, facts, judgements)
    if not with_margin and math.isinf(found.v_max) and decide(found).word == UNSTABLE:
        return found
    found = replace(found, repeated=repeated_run(facts.run, facts.loop))
    if with_margin:
        return _with_margin(found, facts, judgements)
    return replace(found, n_bursts=-1, is_least=True) if found.is_unlimited else _with_longest(found, facts, judgements)


def _to_judge(scenario: Scenario) -> Scenario:
    """The scenario over a lap, as its margins take it; over all that it lasts where a run has to show its links."""
    relay, lasts = scenario.relay, scenario.plant.duration
    lap = lap_steps(scenario.error_detector) * scenario.plant.ts
    are_known = chain_of(relay.uplink) is not None and chain_of(relay.downlink) is not None
    if scenario.error_detector.track == "csv" or (lap < lasts < math.inf and not are_known):
        return with_an_end(scenario)
    return replace(scenario, plant=replace(scenario.plant, duration=lap))


def _under_links(common: Evidence, facts: RunFacts, judgements: Mapping[str, Judgement]) -> Evidence:
    """With the growth under the links of a scenario; as a run of it shows them where one is not a finite chain."""
    run, relay, plant = facts.run, facts.run.scenario.relay, facts.run.scenario.plant
    uplink, downlink = chain_of(relay.uplink), chain_of(relay.downlink)
    if facts.is_late and _constant_delay(facts) is None:
        of_channel = growth_of_channel(facts.loop, relay, run.ts)
        if isinstance(of_channel, float):
            return _with_growth(replace(common, is_unlimited=True), of_channel, "late_and_lost")
    scripted = scripted_outages(relay.uplink, run.ts)
    if scripted is not None and downlink is not None and downlink.loss_rate == 0.0 and not facts.is_late:
        return _with_growth(replace(common, n=int(scripted.sum())), growth_of_period(facts.loop, scripted))
    if facts.is_late or uplink is None or downlink is None:
        return _under_links_as_seen(common, facts, judgements)
    if downlink.loss_rate == 0.0:
        growth = mean_square.lap_growth(facts.loop, uplink) / len(run)
        return _with_growth(replace(common, is_unlimited=_is_random(uplink)), growth)
    if mean_square_downlink.why_not(plant):
        return _of_both_links(common, facts, judgements)
    links = joint_chain.correlated(uplink, downlink, relay.downlink.correlation)
    both = mean_square_downlink.lap_growth(facts.loop, links, plant) / len(run)
    return _with_growth(common, both, "both_links")


def _is_random(chain: Chain) -> bool:
    chances = np.concatenate((chain.transition.ravel(), chain.delivery))
    return bool(np.any((chances > 0.0) & (chances < 1.0)))


def _of_late_messages(common: Evidence, facts: RunFacts, judgements: Mapping[str, Judgement]) -> Evidence:
    run, delay = facts.run, _constant_delay(facts)
    if delay is not None:
        radius = lifted.largest_radius(facts.loop.thinned(PLACES_OF_LONG_LAP), delay)
        unsure = _left_open_by_losses(facts)
        probability = 0.5 if unsure else 1.0
        return replace(
            common, n=delay, late_by=delay, lifted_radius=radius, probability_stable=probability, seen=unsure
        )  # fmt: skip
    late, of_ages = judgements.get("late_and_lost"), judgements["recorded_losses"].stable
    if late is not None and not run.is_late:
        growth = late.detail
        agree = all(half is not None and half * growth > 0.0 for half in growths_of_halves(facts))
        unsure = _left_open_by_losses(facts) if agree else "the halves of the run do not agree"
        if has_late(run.downlink) and of_ages is not (growth < 0.0):  # ages that add up are not a chain of their own
            unsure = "the chain of ages and this sequence of ages do not agree"
        return _with_growth(common, growth, "late_and_lost", unsure)
    why = "messages were late, by no constant delay, which no criterion covers"
    if has_late(run.downlink):
        why = "commands were late, which no criterion covers"
    if run.is_late:
        why = "poses or commands came later than their slots say, which no criterion covers"
    if of_ages is not None:
        why += f"; under this sequence of ages a small error {'shrinks' if of_ages else 'grows'}"
    return replace(common, not_covered=why)


def _left_open_by_losses(facts: RunFacts) -> str:
    """Why a late run cannot be called stable, if its losses alone, without their delays, do not allow it."""
    run = facts.run
    if _loses_nothing(run) or run.downlink_lost.any():
        return ""
    alone = link_confidence(facts.loop, run.k, run.lost, run.ts)
    return "" if alone.probability_stable >= SURE else f"of the losses alone, without their delays: {alone.reason}"


def _with_growth(common: Evidence, growth: float, growth_of: str = "mean_square", unsure: str = "") -> Evidence:
    """With a growth that is sure, unless something speaks against it."""
    probability = 0.5 if unsure else 1.0 if growth < 0.0 else 0.0
    return replace(common, growth=growth, growth_of=growth_of, probability_stable=probability, seen=unsure)


def _constant_delay(facts: RunFacts) -> int | None:
    """Age of the pose behind the acting command in slots, if it is always the same, but for the beginning."""
    run = facts.run
    commands_wait = has_late(run.downlink) or run.downlink_lost.any()
    if commands_wait and not facts.ages_add_up:
        return None
    age = run.acting_age if commands_wait else run.command_age
    n = int(age.max())
    return n if np.array_equal(age, np.minimum(run.k, n)) else None


def _of_both_links(common: Evidence, facts: RunFacts, judgements: Mapping[str, Judgement]) -> Evidence:
    """Sure is what holds at both ends of the intervals of the fitted channels."""
    run, (_, growth) = facts.run, judgements["mean_square"].detail
    plant = run.scenario.plant
    if growth is None:
        why = f"commands were lost, and no criterion covers downlink policy {plant.downlink_policy}"
        if reason := mean_square_downlink.why_not(plant):
            why += f", {reason}"
        return replace(common, not_covered=why, goes_on=_goes_on(run))

    def growth_under(links: JointChain) -> float:
        return mean_square_downlink.lap_growth(facts.loop, links, plant) / len(run)

    if joint_chain.fitted(run.lost, run.downlink_lost) is None:
        end = -1 if growth < 0.0 else 0
        others = [joint_chain.independent(*(_at_end(fit, end) for fit in (facts.fit, facts.downlink_fit)))]
    else:  # links that fail together have no intervals of their own
        halves = np.array_split(np.arange(len(run)), 2)
        found = (joint_chain.fitted(run.lost[rows], run.downlink_lost[rows]) for rows in halves)
        others = [links for links in found if links is not None]
    is_sure = bool(others) and all(growth_under(links) * growth > 0.0 for links in others)
    unsure = "" if is_sure else "too few outages of both links were seen to say whether the mean square dies out"
    return _with_growth(common, growth, "both_links", unsure)


def _goes_on(run: Run) -> float:
    """How probable it is that the outcomes of both links repeat as they did, exactly; 0 where they did not.

    As of outages that repeat on one link: sure after ten periods.
    """
    periods = [period_of(run.k, lost) if lost.any() else 1 for lost in (run.lost, run.downlink_lost)]
    if any(period is None for period in periods):
        return 0.0
    times = len(run) // math.lcm(*(period for period in periods if period is not None))
    return (times + 0.5) / (times + 1.0) if times > 1 else 0.0


def _at_end(fit: ChannelFit, end: int) -> Chain:
    """The fitted channel at the better end of its intervals (0), or at the worse one (-1)."""
    p = 0.0 if fit.p is None else (fit.p.low, fit.p.high)[end]
    r = 1.0 if fit.r is None else (fit.r.high, fit.r.low)[end]
    return gilbert_elliott(p, max(r, 1e-6))


def _burst_left(fit: ChannelFit, link: LinkConfidence, loop: LinearLoop) -> float | None:
    """By what factor the mean burst may grow at the fitted loss rate; None where no such channel describes the link."""
    is_described = fit.model == "gilbert_elliott" and fit.goodness.fits and len(link.segments) == 1
    if not is_described or link.growth >= 0.0 or fit.chain.loss_rate >= 1.0:
        return None
    critical = mean_square.critical_burst(loop.thinned(_PLACES), fit.chain.loss_rate)
    return critical / fit.mean_burst if np.isfinite(critical) else None


def _contradictions(run: Run, driven: DrivenCommands, repeated: RepeatedRun | None) -> Iterator[str]:
    """How a recording contradicts what is known of the loop, or leaves out what a judgement needs."""
    timing = run.timing
    if driven.differs:
        yield driven.sentence
    if timing is not None and timing.unknown and timing.missed_deadlines:
        yield (
            f"{counted(timing.missed_deadlines, 'deadline was', 'deadlines were')} missed, and how old the "
            "commands were by then is not known"
        )
    if repeated is None:
        yield "steps are missing from the recording, so that the loop cannot be simulated under its losses"
        return
    if not math.isfinite(repeated.largest_in_run):
        return
    later = slice(len(run) // 2, None)
    recorded = float(np.hypot(*(run.pose - run.reference[:, :3])[later, :2].T).max())
    if min(recorded, repeated.largest_in_run) > DIVERGED:  # how far is a matter of rounding
        return
    allowed = _TIMES_AS_FAR * repeated.largest_in_run + _TOLERANCE
    if not recorded <= allowed:
        far = "diverged" if recorded > DIVERGED else f"was up to {metres(recorded)} off its track"
        yield (
            f"the AGV {far}, in the simulation under the same losses it was up to "
            f"{metres(repeated.largest_in_run)} off: it is not driven by this law, these parameters or this model"
        )
