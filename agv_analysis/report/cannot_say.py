"""What a recording cannot say, beside its verdict."""

from __future__ import annotations

from collections.abc import Iterator

from agv_analysis.corridor.corridor_of_run import CorridorOfRun
from agv_analysis.stability.analysis import GAINS_UNKNOWN, Analysis, Observations
from agv_analysis.stability.verdict import UNDECIDED, UNKNOWN
from agv_ros.counted import counted


def cannot_say(analysis: Observations, within: CorridorOfRun | None = None) -> Iterator[str]:
    """Questions that this run leaves open, each with the reason, in sentences without a full stop."""
    run, longest = analysis.run, analysis.outages.uplink.longest
    yield from _of_stability(analysis)
    link = analysis.evidence.link if isinstance(analysis, Analysis) else None
    if link is not None and link.record_seconds_more is not None:
        yield f"More surely how errors grow: that would take about {link.record_seconds_more:g} s more of recording"
    if run.source == "simulation":
        yield "How a real AGV on a real radio differs from this model: the run was simulated"
    elif longest:
        yield f"What follows an outage of more than {counted(longest, 'slot')}: none was seen"
    if analysis.deviation.reason:
        yield f"How far it strays once its start is over: the deviation is {analysis.deviation.reason}"
    if run.timing is not None and run.timing.unknown:
        yield f"When messages came: {run.timing.unknown}"
    if within is None:
        yield "Whether it stays in a corridor: none was given"
    else:
        for note in within.notes:
            yield f"Of the corridor: {note}"


def _of_stability(analysis: Observations) -> Iterator[str]:
    if analysis.run.unexplained:
        yield "Whether the loop is stable: messages are missing that no channel lost"
    elif not isinstance(analysis, Analysis):
        yield f"Whether the loop is stable: {GAINS_UNKNOWN}"
    elif analysis.verdict.word in (UNKNOWN, UNDECIDED):
        yield f"Whether the loop is stable: {analysis.verdict.reason}"
    else:
        yield "What another link would do: the verdict is for one that loses messages as this one did"
