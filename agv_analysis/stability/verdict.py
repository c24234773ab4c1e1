"""One word on a loop from all that is known of it: the one function that all commands and pages ask.

The words, from the strongest statement to the weakest:

- `asymptotic`: whatever outages no longer than the longest of the run come, the error dies out;
- `mean-square`: under the channel that was seen E[e^2] dies out, though some sequence of outages would not be survived;
- `bounded`: neither, but under the limit on the speed the error stays bounded, as ten minutes of simulation show;
- `undecided`: too little was seen of the link to say whether the loop is stable on it;
- `unknown`: no criterion covers what was recorded, or the recording contradicts what is known of the loop;
- `unstable`: the error grows;
- `infeasible`: the loop does not settle even without losses.

The first two are green, and are said only where all evidence agrees: the loop settles without losses; the recorded
commands are those of the control law; a stable loop is at least 95 % probable given the losses that were seen; the
nonlinear loop under these losses forgets where it began and does not drift; the recorded deviations are those of the
simulation. Evidence to the contrary wins over the criteria and is the reason given.

Outages end with a fresh pose; where messages are late none is. A constant delay is judged by the lifted system, other
ages by the growth under them. The Floquet multiplier of the run's own losses stands beside the word and does not enter
it: a run that is short, or ends inside an outage, may have a multiplier above 1 in a loop that contracts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from agv_analysis.metrics.deviation import DIVERGED
from agv_analysis.metrics.distance_text import metres
from agv_analysis.stability.confidence.link_confidence import LinkConfidence
from agv_analysis.stability.driven_commands import DrivenCommands
from agv_analysis.stability.repeated_run import RepeatedRun
from agv_ros.counted import counted

ASYMPTOTIC, MEAN_SQUARE, BOUNDED, UNSTABLE = "asymptotic", "mean-square", "bounded", "unstable"
UNDECIDED = "undecided"
"""For a link of which too little was seen."""
UNKNOWN = "unknown"
"""For a run that no criterion covers, or that contradicts what is known of its loop."""
INFEASIBLE = "infeasible"
"""For a loop that does not settle even without losses."""

GREEN = (ASYMPTOTIC, MEAN_SQUARE)
"""Words that say that a loop is stable."""

WORDS = (ASYMPTOTIC, MEAN_SQUARE, UNDECIDED, UNKNOWN, BOUNDED, UNSTABLE, INFEASIBLE)
"""From the best to the worst."""

SIMULATION = "simulation"
"""The criterion of a word that the simulation of the nonlinear loop decided."""

SURE = 0.95
"""A green word needs at least this probability of a stable loop, `unstable` at most 1 less this."""

BESIDE = 0.05
"""A loop that stays further [m] from its reference than this says so beside a green word."""

_SURE_OF_RUNS = 0.9
"""Share of simulated runs, at least, that must contract; a few end inside an outage."""


@dataclass(frozen=True)
class Verdict:
    """The word, the evidence that decided it, the margin in words, and the reason in a sentence."""

    word: str
    criterion: str
    margin: str
    reason: str = ""

    def to_json(self) -> dict[str, str]:
        """The word, what decided it, and why, by name."""
        return {"verdict": self.word, "verdict_criterion": self.criterion, "verdict_reason": self.reason}


@dataclass(frozen=True)
class Evidence:
    """What is known of a loop under its losses; the defaults say nothing against a green word."""

    n: int = 0
    """The longest outage, or the oldest pose [slots]."""
    n_bursts: int | None = None
    """The longest outages that are proved to be survived in any order [slots]; None: all."""
    is_least: bool = False
    """Is `n_bursts` what is known to be survived, and nothing known beyond?"""
    is_unlimited: bool = False
    """Have outages no longest one, so that no proof for outages up to `n` covers the link?"""
    growth: float | None = None
    """Growth (logarithm, per step) of E[e^2] under the links; None if no criterion covers them."""
    growth_of: str = "mean_square"
    """The criterion that `growth` comes from: mean_square, both_links, or one for late messages."""
    burst_left: float | None = None
    """By what factor outages may become longer on average before `growth` is positive; None: unknown or no bound."""
    not_covered: str = ""
    """Why `growth` is None."""
    goes_on: float = 0.0
    """Where no criterion covers the links: how probable it is that their outcomes repeat exactly as they did."""
    late_by: int | None = None
    """The constant age of each pose [slots], if all were late by the same; then `lifted_radius` decides."""
    lifted_radius: float = 0.0
    """Spectral radius of the lifted system for `late_by`."""
    probability_stable: float = 1.0
    """Of a stable loop, given the losses that were seen; 1 or 0 where the channel is known."""
    link: LinkConfidence | None = None
    """What the recorded outcomes say of the loop, and how surely; None where the link is known or was not judged."""
    seen: str = ""
    """Why nothing is sure, where there is no `link` that says so."""
    v_max: float = math.inf
    """Limit on the speed [m/s]."""
    beside_reference: float = 0.0
    """Largest distance [m] from the reference of the motion to which the loop settles without losses."""
    is_disturbed: bool = False
    """Does measurement noise or slip keep the AGV moving about that motion, which the criteria know nothing of?"""
    infeasible: str = ""
    """Why the loop does not settle even without losses."""
    missing: int = 0
    """Messages that are missing from the recording although no channel lost them."""
    driven: DrivenCommands | None = None
    """The recorded commands against the control law; None where nothing was judged."""
    contradictions: tuple[str, ...] = ()
    """How the recording contradicts what is known of the loop, a sentence each."""
    repeated: RepeatedRun | None = None
    """The nonlinear loop under these losses again and again; None where it could not be driven."""
    twins: tuple[int, int] | None = None
    """How many simulated runs of how many contract the distance of twins."""

    @property
    def confidence(self) -> float | None:
        """Probability of a stable loop, given the losses that were seen; None where it was not asked."""
        return self.probability_stable if self.growth is not None or self.late_by is not None else None

    def to_json(self) -> dict[str, Any]:
        """How sure the word is, by name: a growth that is known has an interval without width."""
        if self.link is not None:
            return self.link.to_json()
        is_known = self.growth is not None and math.isfinite(self.growth) and self.probability_stable in (0.0, 1.0)
        return {
            "confidence": self.confidence,
            "growth_interval": [self.growth, self.growth] if is_known else None,
            "record_seconds_more": None,
            "stationarity": None,
        }


def decide(evidence: Evidence) -> Verdict:
    """The word on a loop."""
    if evidence.missing:
        reason = (
            f"{counted(evidence.missing, 'message is', 'messages are')} missing from the recording that no "
            "channel lost: it proves nothing"
        )
        return Verdict(UNKNOWN, "recording", f"unknown: {reason}", reason)
    if evidence.infeasible:
        return Verdict(INFEASIBLE, "nominal_motion", f"none: {evidence.infeasible}", evidence.infeasible)
    if evidence.contradictions:
        reason = evidence.contradictions[0]
        return Verdict(UNKNOWN, "recording", f"unknown: {reason}", reason)
    word = _by_criteria(evidence)
    against = _against_stability(evidence)
    if word.word in (*GREEN, UNDECIDED, UNKNOWN) and against:
        return _not_stable(evidence, SIMULATION, against)
    return replace(word, reason=word.reason + _where(evidence)) if word.word in GREEN else word


def _where(evidence: Evidence) -> str:
    """How far from its reference a stable loop drives, where that is far."""
    where, repeated = "", evidence.repeated
    if evidence.beside_reference > BESIDE:
        where += f"; even without losses it drives up to {metres(evidence.beside_reference)} beside its reference"
    if evidence.is_disturbed and repeated is not None and repeated.largest_in_run > BESIDE:
        where += (
            f"; noise and slip are left out of this: simulated with them the AGV is up to "
            f"{metres(repeated.largest_in_run)} off in the second half of the run"
        )
    return where


def weakest(verdicts: Sequence[Verdict]) -> Verdict:
    """The worst of several verdicts, the first of its kind."""
    return max(verdicts, key=lambda verdict: WORDS.index(verdict.word))


def _by_criteria(evidence: Evidence) -> Verdict:
    """The word by the linear criteria and by how much was seen of the link."""
    if evidence.late_by is not None:
        return _late(evidence, evidence.late_by)
    if evidence.growth is None and evidence.goes_on >= SURE and evidence.repeated is not None:
        return _repeating(evidence)
    if evidence.growth is None:
        return Verdict(UNKNOWN, "none", f"unknown: {evidence.not_covered}", evidence.not_covered)
    if evidence.probability_stable <= 1.0 - SURE:
        return _not_stable(evidence, evidence.growth_of, _grows(evidence))
    if evidence.probability_stable < SURE:
        return _undecided(evidence)
    is_survived = evidence.n_bursts is None or evidence.n <= evidence.n_bursts
    if evidence.growth >= 0.0:
        return _not_stable(evidence, evidence.growth_of, _grows(evidence))
    if evidence.growth_of == "mean_square" and is_survived and not evidence.is_unlimited:
        reason = f"any sequence of outages of up to {counted(evidence.n, 'slot')} is survived"
        if evidence.n == 0:
            reason = "no update was lost, and the error dies out"
        sure = f"; {_of_link(evidence)}" if evidence.link is not None else ""
        return Verdict(ASYMPTOTIC, "bursts", _limit(evidence), reason + sure)
    return _mean_square(evidence)


def _repeating(evidence: Evidence) -> Verdict:
    """By the simulation alone, which drives what will come; if that is not stable it says so as of any other word."""
    why = "the outcomes of the links repeat exactly, and simulated under them the error dies out"
    return Verdict(MEAN_SQUARE, SIMULATION, f"{why}; no criterion covers other outcomes", why)


def _mean_square(evidence: Evidence) -> Verdict:
    link = "both links" if evidence.growth_of == "both_links" else "this link"
    reason = _of_link(evidence) or f"under {link} the mean square of the error dies out"
    if evidence.growth_of == "both_links":
        margin = "commands were lost as well; under both links the mean square of the error dies out"
    elif evidence.growth_of != "mean_square":
        margin = "messages were late; under ages like these the mean square of the error dies out"
    else:
        margin = _limit(evidence)
        if evidence.burst_left is not None:
            margin += f"; outages may become {evidence.burst_left:.3g} times as long on average"
    return Verdict(MEAN_SQUARE, evidence.growth_of, margin, reason)


def _late(evidence: Evidence, steps: int) -> Verdict:
    age = f"each pose is {counted(steps, 'step')} old when its command acts"
    if evidence.lifted_radius < 1.0 and evidence.probability_stable < SURE:
        return _undecided(evidence)
    if evidence.lifted_radius < 1.0:
        shrinks = f"{age}, and the error shrinks"
        return Verdict(ASYMPTOTIC, "lifted", f"{shrinks}; `agv-ncs stability` says how old it may be", shrinks)
    return _not_stable(evidence, "lifted", f"{age}, and the error grows")


def _undecided(evidence: Evidence) -> Verdict:
    reason = _of_link(evidence) or evidence.seen or f"a stable loop is {evidence.probability_stable:.0%} probable"
    return Verdict(UNDECIDED, "confidence", f"unknown: {reason}", reason)


def _of_link(evidence: Evidence) -> str:
    return "" if evidence.link is None else evidence.link.reason


def _not_stable(evidence: Evidence, criterion: str, why: str) -> Verdict:
    """Bounded, where a limit on the speed keeps the error from growing in the simulation; else unstable."""
    repeated = evidence.repeated
    if math.isinf(evidence.v_max) or repeated is None or not repeated.stays:
        return Verdict(UNSTABLE, criterion, f"none: {why}", why)
    only = (
        f"only the limit on the speed bounds the error, at {metres(repeated.largest_deviation)} in "
        f"{repeated.seconds:.0f} s of simulation"
    )
    return Verdict(
        BOUNDED, SIMULATION if criterion == SIMULATION else "v_max", f"none: {only}; {why}", f"{only}; {why}"
    )


def _grows(evidence: Evidence) -> str:
    repeated = evidence.repeated
    if repeated is not None and not repeated.settles:  # then it is not the link
        return _even_without_losses(repeated)
    if evidence.growth_of == "both_links":
        return "commands are lost as well, and under both links the mean square of the error grows"
    if evidence.growth_of != "mean_square":
        return "messages are late, and under ages like these the mean square of the error grows"
    if evidence.link is not None:
        return evidence.link.reason
    if evidence.n == 0 and not evidence.is_unlimited:
        return "a small error grows even without losses"
    return "under this link the mean square of the error grows"


def _limit(evidence: Evidence) -> str:
    """The longest outage that was seen, and that which is survived in any order."""
    seen = f"longest outage: {evidence.n}"
    if evidence.is_unlimited:
        seen = "outages of such a link have no longest one"
    if evidence.n_bursts is None:
        return f"{seen}; outages of any length are survived"
    if evidence.is_least and evidence.n_bursts < 0:
        return f"{seen}; not proved to be survived in any order"
    return f"{seen}; guaranteed limit: {'at least ' if evidence.is_least else ''}{evidence.n_bursts}"


def _even_without_losses(repeated: RepeatedRun) -> str:
    """What a loop does that does not settle even without losses."""
    return f"simulated without any loss {repeated.unsettled or 'the loop does not settle on its nominal motion'}"


def _against_stability(evidence: Evidence) -> str:
    """What the simulation of the nonlinear loop says against a stable one; empty if nothing."""
    repeated, twins = evidence.repeated, evidence.twins
    if repeated is not None:
        if not repeated.settles:
            return _even_without_losses(repeated)
        if not repeated.stays:
            far = f"the deviation grows, to {metres(repeated.largest_deviation)} after {repeated.seconds:.0f} s"
            becomes = "the AGV diverges" if repeated.largest_deviation > DIVERGED else far
            return f"simulated under these losses again and again {becomes}"
        if not repeated.meets:
            return "simulated under these losses, an AGV that begins on the track and this one do not come together"
    if twins is not None and twins[0] < _SURE_OF_RUNS * twins[1]:
        return f"neighbouring trajectories converge in {twins[0]} of {twins[1]} simulated runs only"
    return ""
