"""The verdict on a run in one sentence, for people who do not know the criteria."""

from __future__ import annotations

from agv_analysis.metrics.distance_text import metres
from agv_analysis.metrics.duration_text import outage_text
from agv_analysis.stability.analysis import GAINS_UNKNOWN, Analysis, Observations
from agv_analysis.stability.criteria import CRITERIA
from agv_analysis.stability.verdict import (
    ASYMPTOTIC,
    BESIDE,
    BOUNDED,
    GREEN,
    INFEASIBLE,
    MEAN_SQUARE,
    SIMULATION,
    UNDECIDED,
    UNKNOWN,
    Evidence,
)
from agv_ros.counted import counted


def sentence(analysis: Observations) -> str:
    """The verdict in one sentence for people who do not know the criteria."""
    if analysis.run.unexplained:
        return "This recording proves nothing: messages are missing that no channel lost."
    if not isinstance(analysis, Analysis):
        return f"Whether the loop is stable cannot be said: {GAINS_UNKNOWN}."
    verdict, met = analysis.verdict, _met(analysis)
    if verdict.word in GREEN and analysis.evidence.beside_reference > BESIDE:
        beside = f"The AGV settles up to {metres(analysis.evidence.beside_reference)} beside its track"
        return f"{beside}; no update was lost." if _oldest(analysis) == 0 else f"{beside}, under {met} as well."
    if verdict.word == MEAN_SQUARE and analysis.run.downlink_lost.any():
        return (
            "The AGV keeps to its track on radio links like these, which lose commands as well, but not in every case."
        )
    if verdict.word == ASYMPTOTIC and _oldest(analysis) == 0:
        return "The AGV keeps to its track; no update was lost."
    if verdict.word == ASYMPTOTIC and _is_late(analysis):
        return f"The AGV keeps to its track with {met}."
    if verdict.word == ASYMPTOTIC:
        return f"The AGV keeps to its track under {met}, or shorter ones, in any order."
    if verdict.word == MEAN_SQUARE:
        return _in_mean_square(analysis, met)
    if verdict.word in (UNKNOWN, UNDECIDED):
        return f"Whether the loop is stable cannot be said: {verdict.reason}."
    if verdict.word == INFEASIBLE:
        return f"The AGV does not keep to its track even on a perfect link: {analysis.infeasible}."
    repeated, is_lossless = analysis.evidence.repeated, _oldest(analysis) == 0 and not analysis.run.downlink_lost.any()
    if verdict.criterion == SIMULATION or is_lossless or (repeated is not None and not repeated.settles):
        return f"The AGV does not keep to its track: {verdict.reason}."
    if verdict.word == BOUNDED:
        return f"The AGV does not settle on its track under {met}; only its speed limit keeps it near."
    return f"The AGV does not keep to its track: {met} are too much for these gains."


def in_short(analysis: Observations) -> str:
    """The verdict in half a line, for people who know the criteria."""
    if analysis.run.unexplained:
        return "messages are missing that no channel lost"
    if not isinstance(analysis, Analysis):
        return GAINS_UNKNOWN
    return _in_short(analysis) + beside_track(analysis.verdict.word, analysis.evidence)


def beside_track(word: str, evidence: Evidence) -> str:
    """How far beside its track a stable loop drives even without losses, where that is far; else empty."""
    if word not in GREEN or not evidence.beside_reference > BESIDE:
        return ""
    return f", but {metres(evidence.beside_reference)} beside the track"


def _in_short(analysis: Analysis) -> str:
    n, n_bursts, word = analysis.n, analysis.evidence.n_bursts, analysis.verdict.word
    if word == ASYMPTOTIC and n == 0:
        return "stable; no update was lost"
    if word == ASYMPTOTIC and _is_late(analysis):
        return f"stable with poses {counted(n, 'step')} old"
    if word == MEAN_SQUARE and n_bursts is not None and n > n_bursts:
        return f"stable in mean square; not guaranteed for the longest outage seen ({n})"
    return in_words(word, n)


def in_words(word: str, n: int) -> str:
    """A verdict's word in half a line, of a loop whose longest outage is `n` slots."""
    return {
        ASYMPTOTIC: f"stable under any outages of up to {counted(n, 'slot')}" if n else "stable without losses",
        MEAN_SQUARE: "stable in mean square",
        BOUNDED: "not stable; bounded by the speed limit alone",
        UNDECIDED: "undecided; too little was seen of the link",
        INFEASIBLE: "infeasible; the loop does not settle even without losses",
        UNKNOWN: "unknown",
    }.get(word, "unstable; the error grows")


def by_what(criterion: str) -> str:
    """What decided a verdict, in words."""
    titles = {one.key: one.title[0].lower() + one.title[1:] for one in CRITERIA}
    return (titles | _OTHER_EVIDENCE).get(criterion, criterion)


_OTHER_EVIDENCE = {
    SIMULATION: "simulation of the nonlinear loop",
    "nominal_motion": "motion without losses",
    "recording": "what the recording lacks or contradicts",
    "confidence": "how much was seen of the link",
    "v_max": "limit on the speed",
    "none": "no criterion",
}
"""What decides a verdict beside the criteria, by its name in JSON."""


def _in_mean_square(analysis: Analysis, met: str) -> str:
    n_bursts = analysis.evidence.n_bursts
    if n_bursts is None or analysis.n <= n_bursts:
        return f"The AGV keeps to its track on a radio link like this one; the worst that it met were {met}."
    return (
        f"The AGV keeps to its track on a radio link like this one, but not in every case: {met}, again and again, "
        "would drive it away from its track."
    )


def _is_late(analysis: Observations) -> bool:
    """Were the poses behind commands older than outages explain, because messages were delayed?"""
    return _oldest(analysis) > analysis.outages.uplink.longest and not analysis.run.downlink_lost.any()


def _oldest(analysis: Observations) -> int:
    """Age of the oldest pose behind a command that acted [steps]."""
    return max(analysis.n, analysis.evidence.n) if isinstance(analysis, Analysis) else analysis.n


def _met(analysis: Observations) -> str:
    """The worst that the run has met."""
    oldest = _oldest(analysis)
    age = outage_text(oldest * analysis.run.ts)
    if _is_late(analysis):
        return f"poses up to {counted(oldest, 'step')} ({age}) old"
    if analysis.run.downlink_lost.any():
        return "losses on both links, of poses and of commands,"
    return f"outages of {analysis.n} lost updates in a row ({age})"
