"""The row of figures at the head of the page: is it safe, how far, how sure."""

from __future__ import annotations

import math
from typing import NamedTuple

from agv_analysis.corridor.widths import widths_of
from agv_analysis.metrics.bands import TOLERANCE
from agv_analysis.metrics.confidence import percent
from agv_analysis.metrics.deviation import DIVERGED
from agv_analysis.watch.link_margin import NOT_COVERED, STABLE, UNSTABLE, LinkMargin
from agv_analysis.watch.live_loop import LOOK_BACK, LiveLoop
from agv_ros.counted import counted

_MOST_MISSED = 0.01
"""Share of missed deadlines above which losses alone do not say how old commands were."""

GOOD, FAIR, BAD = "good", "fair", "bad"


class LiveTile(NamedTuple):
    """One figure: what it is, its value, what goes with it, and whether that is good, fair or bad; empty: neither."""

    key: str
    label: str
    value: str
    note: str
    mood: str = ""


def live_tiles(loop: LiveLoop, margin: LinkMargin | None, deadlines: dict[str, str]) -> list[LiveTile]:
    """The figures of a loop now."""
    # The newest step is in no point yet. What is not known (NaN) stays so.
    _, now = loop.latest_deviation()
    largest = max(loop.recent_deviation(), now)
    return [
        _verdict(margin, deadlines), _deviation(loop, now, largest), _corridor(loop, largest), _losses(loop),
        _outage(loop, margin), _age(loop), _speed(loop), _deadlines(loop, deadlines),
    ]  # fmt: skip


def _verdict(margin: LinkMargin | None, deadlines: dict[str, str]) -> LiveTile:
    label = "Loop on this link"
    missed, steps = int(deadlines.get("missed deadlines", "0")), int(deadlines.get("step", "0"))
    if margin is not None and margin.word == STABLE and missed > _MOST_MISSED * steps:
        why = (
            f"{missed} of {counted(steps, 'deadline was', 'deadlines were')} missed: commands acted later than "
            "the losses say"
        )
        return LiveTile("word", label, NOT_COVERED, why, FAIR)
    if margin is None:
        return LiveTile("word", label, "…", "computing")
    if margin.probability_stable is None:
        return LiveTile("word", label, margin.word, margin.reason, BAD if margin.word == UNSTABLE else FAIR)
    mood = {STABLE: GOOD, UNSTABLE: BAD}.get(margin.word, FAIR)
    sure = f"in mean square, {percent(margin.probability_stable)} probable ({counted(margin.slots, 'slot')})"
    return LiveTile("word", label, margin.word, sure if margin.word == STABLE else f"stable {sure}", mood)


def _deviation(loop: LiveLoop, now: float, largest: float) -> LiveTile:
    settled = f"at most {metres(largest)} in the last {_seconds(loop)}"
    note = settled if not math.isnan(largest) else f"not below {metres(TOLERANCE)} since it began"
    return LiveTile("deviation", "Deviation now", metres(now), note)


def _seconds(loop: LiveLoop) -> str:
    points = len(loop.points) - max(0, loop.settled - loop.points_before)
    seen = points * loop.steps_per_point * loop.ts
    return f"{min(LOOK_BACK, max(seen, loop.ts)):.3g} s"


def metres(value: float) -> str:
    """A distance with a unit: to the millimetre, of larger ones four digits."""
    if math.isnan(value):
        return "not known"
    return "diverges" if value > DIVERGED else f"{_digits(value, 3)} m"


def _digits(value: float, decimals: int) -> str:
    """A number with so many decimals below ten, else with four digits."""
    if abs(value) < 10.0:
        return f"{round(value, decimals) + 0.0:.{decimals}f}"  # and never -0.00
    return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.2g}"


def _corridor(loop: LiveLoop, largest: float) -> LiveTile:
    widths = widths_of(loop.scenario.error_detector)
    if widths is None:
        return LiveTile("corridor", "Corridor", "none given", "error_detector.corridor")
    width = f"{widths.half_width:g} m"
    if math.isinf(widths.distance):
        return LiveTile("corridor", "Corridor", width, f"{widths.along:g} m along the track; not judged here")
    if math.isnan(largest):
        return LiveTile("corridor", "Corridor", width, "not judged: initial error")
    share = largest / widths.distance
    said = f"of it used in the last {_seconds(loop)}"
    if share > 1.0:
        used = f"{100.0 * share:.0f} %" if share < 10.0 else "more than ten times"
        return LiveTile("corridor", "Corridor", f"{width}: left", f"{used} {said}", BAD)
    return LiveTile("corridor", "Corridor", f"{width}: kept", f"{100.0 * share:.0f} % {said}", GOOD)


def _losses(loop: LiveLoop) -> LiveTile:
    if not loop.slots:
        return LiveTile("losses", "Lost updates", "none seen", "")
    skipped = f"; {counted(loop.skipped, 'slot')} not seen by this page" if loop.skipped else ""
    commands = f"; {loop.commands_lost} of {counted(loop.command_slots, 'command')}" if loop.commands_lost else ""
    note = f"{loop.lost} of {loop.slots} since {loop.first * loop.ts:g} s{commands}{skipped}"
    return LiveTile("losses", "Lost updates", f"{100.0 * loop.lost / loop.slots:.2f} %", note)


def _outage(loop: LiveLoop, margin: LinkMargin | None) -> LiveTile:
    longest = loop.longest_outage
    value, mood = f"{counted(longest, 'slot')} ({longest * loop.ts * 1e3:g} ms)", ""
    note = "guaranteed limit: not known"
    if margin is not None and margin.guaranteed is not None and margin.guaranteed >= 0:
        mood = GOOD if longest <= margin.guaranteed else FAIR
        note = f"guaranteed limit: {counted(margin.guaranteed, 'slot')}"
        if math.isinf(margin.guaranteed):
            note = "any length is survived"
    return LiveTile("outage", "Longest outage", value, note, mood)


def _age(loop: LiveLoop) -> LiveTile:
    age = loop.latest("age")
    if math.isnan(age):
        return LiveTile("age", "Age of information", "not known", "")
    steps = f"{counted(round(age), 'step')} of {loop.ts:g} s"
    return LiveTile("age", "Age of information", f"{age * loop.ts * 1e3:.0f} ms", steps)


def _speed(loop: LiveLoop) -> LiveTile:
    v, w = loop.latest("v"), loop.latest("w")
    if math.isnan(v):
        return LiveTile("speed", "Speed", "not known", "")
    return LiveTile("speed", "Speed", f"{_digits(v, 2)} m/s", f"turning at {_digits(w, 2)} rad/s")


def _deadlines(loop: LiveLoop, deadlines: dict[str, str]) -> LiveTile:
    missed, step = deadlines.get("missed deadlines"), deadlines.get("step", "0")
    if missed is not None:
        note = f"of {step}; jitter p99 {float(deadlines.get('jitter p99 [s]', 'nan')) * 1e3:.3g} ms"
        return LiveTile("deadlines", "Missed deadlines", missed, note, "" if missed == "0" else FAIR)
    if loop.scenario.plant.clock == "lockstep":
        return LiveTile("deadlines", "Missed deadlines", "none", "lockstep has no deadlines")
    return LiveTile("deadlines", "Missed deadlines", "not known", "no report of the plant yet")
