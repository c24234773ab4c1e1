"""The row of figures under a report's sentence: verdict, deviation, corridor, losses, longest outage, speed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from agv_analysis.corridor.corridor_of_run import CorridorOfRun
from agv_analysis.metrics.confidence import percent_after_of
from agv_analysis.metrics.distance_text import DIVERGES, metres, speed_text, three_digits
from agv_analysis.metrics.duration_text import outage_text
from agv_analysis.stability.analysis import Analysis, Observations
from agv_analysis.stability.verdict import GREEN, SURE
from agv_ros.counted import counted


class Tile(NamedTuple):
    """One figure: what it is, its value, and what goes with it in some words."""

    key: str
    label: str
    value: str
    note: str


def tiles(analysis: Observations, within: CorridorOfRun | None = None) -> Iterator[Tile]:
    """The figures of a run that are asked for first."""
    run, up, deviation = analysis.run, analysis.outages.uplink, analysis.deviation
    yield Tile("word", "Verdict", *_word(analysis))
    worst = next(iter(deviation.worst), None)
    when = "" if worst is None else f"at {worst.seconds:g} s"
    if worst is not None and worst.outage is not None:
        when += f", after an outage of {counted(worst.outage.slots, 'slot')}"
    yield Tile("deviation", "Worst deviation", metres(deviation.largest), when or deviation.reason)
    yield Tile("corridor", "Corridor", *_corridor(within))
    on_average = " on average" if up.count > 1 else ""
    outages = (
        f"{counted(up.count, 'outage')}, {counted(up.mean_burst, 'slot')}{on_average}" if up.count else "no outage"
    )
    yield Tile("losses", "Lost updates", f"{100.0 * up.loss_rate:.3g} %", outages)
    longest = f"{counted(up.longest, 'slot')} ({outage_text(up.longest * run.ts)})" if up.count else "none"
    yield Tile("outage", "Longest outage", longest, _guaranteed(analysis))
    if np.isfinite(deviation.speed):
        top = speed_text(deviation.speed)
        asked = "" if top == DIVERGES else f"asked for at most, turning at {three_digits(deviation.turn_rate)} rad/s"
        yield Tile("speed", "Top speed", top, asked)
    else:
        yield Tile("speed", "Top speed", "not recorded", "")


def _word(analysis: Observations) -> tuple[str, str]:
    if analysis.run.unexplained:
        return "none", "messages are missing"
    if not isinstance(analysis, Analysis):
        return "none", "the gains are not known"
    return analysis.verdict.word, how_sure(analysis)


def how_sure(analysis: Analysis) -> str:
    """How probable a stable loop is; empty where that is not asked, or where no losses make the loop what it is."""
    confidence = analysis.evidence.confidence
    if confidence is None or (confidence >= SURE and analysis.verdict.word not in GREEN):
        return ""
    return confidence_text(confidence)


def confidence_text(probability: float) -> str:
    """How probable a stable loop is given the losses that were seen."""
    return f"stable with a probability {percent_after_of(probability or math.ulp(0.0))}"


def _corridor(within: CorridorOfRun | None) -> tuple[str, str]:
    if within is None:
        return "none given", "--corridor D asks for it"
    seen, width = within.seen, f"{within.widths.half_width:g} m"
    if seen.left:
        return width, f"left after {seen.left} of {counted(seen.outages, 'outage')}"
    if not seen.largest <= 1.0:
        return width, "left"
    return width, f"kept: at most {100.0 * seen.largest:.0f} % of it was used"


def _guaranteed(analysis: Observations) -> str:
    """Which outages are survived in any order."""
    if not isinstance(analysis, Analysis) or analysis.run.unexplained:
        return "guaranteed limit: not known"
    evidence = analysis.evidence
    if analysis.verdict.word in GREEN and evidence.growth is not None and evidence.growth_of == "mean_square":
        if evidence.n_bursts is None:
            return "guaranteed limit: none, any length is survived"
        if evidence.n_bursts < 0:
            return "guaranteed limit: not known"
        return f"guaranteed limit: {'at least ' if evidence.is_least else ''}{counted(evidence.n_bursts, 'slot')}"
    bursts = analysis.judgements.get("bursts")
    if bursts is None:
        return "guaranteed limit: not known"
    if bursts.stable is None:
        return "guaranteed limit: undecided"
    return "any sequence up to this length is survived" if bursts.stable else "too long if they come again and again"
