"""What a loop does within a corridor: which outages it survives there, and how often it leaves."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from agv_analysis.corridor import outer_tube as tubes
from agv_analysis.corridor.lap_loop import LapLoop
from agv_analysis.corridor.leaving import Leaving, chain_alone, is_random, leaving
from agv_analysis.corridor.outage_sequences import WorstSequence, largest_n
from agv_analysis.corridor.outer_tube import Tube, applies_to
from agv_analysis.corridor.rms_deviation import RmsDeviation, rms_deviation
from agv_analysis.corridor.second_order import NonlinearTube, nonlinear_tube
from agv_analysis.corridor.single_outage import LONGEST, SingleOutage, roughly, single_outage
from agv_analysis.corridor.stationary_deviation import StationaryDeviation, stationary_deviation
from agv_analysis.corridor.widths import Widths, widths_of
from agv_analysis.json_values import finite
from agv_analysis.link.channel_fit import Estimate
from agv_analysis.metrics.confidence import computed, percent
from agv_analysis.metrics.distance_text import at_most, metres
from agv_analysis.metrics.duration_text import duration_text, outage_text
from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.stability import joint_spectral_radius
from agv_analysis.stability.error_dynamics import NoNominalMotionError
from agv_ros.counted import counted

_PLACES = 500
"""Places of the lap, at least, at which it is asked behind a predictor which repeated outages let an error grow."""

_DIVERGED = 1e3
"""Share of a corridor beyond which a loop without losses is not at any place."""

LOOKS_AHEAD = "the law looks ahead, so that the loop's errors are not the AGV's deviation"

NOT_ALONE = "messages are delayed, or lost depending on the place, so that outages alone do not describe the link"

_NEVER_SETTLES = "the loop does not settle even without losses"

_NOT_ASKED = "not asked for"

_LONGEST_ANY = 500
"""Longest outages that are tried in sequences."""


@dataclass(frozen=True)
class Corridor:
    """The answers of a scenario."""

    widths: Widths
    ts: float
    """Sampling period T_s [s]."""
    single: SingleOutage | None
    """None where outages alone are not what the loop meets; `reason` says why."""
    sequence: WorstSequence | None
    """The sequence of outages that leaves the corridor first, or that comes nearest to it."""
    n_any: int | None
    """Largest n for which no sequence of outages of up to n slots was found that leaves; None: with all that were
    tried."""
    n_any_reason: str
    linear_tube: Tube | None
    """The tube of the linear loop for the largest n with which it stays inside, see `outer_tube`; None: there is none,
    or it was not computed: `tube_reason` says why."""
    nonlinear: NonlinearTube | None
    """The tube of the nonlinear loop, see `second_order`; None where none was found that stays inside."""
    tube_reason: str
    stationary: StationaryDeviation | None
    """Stationary deviation of the linear loop, by its second moments; None: not computed, `rms.reason` says why."""
    rms: RmsDeviation
    leaving: Leaving
    lap: Floats
    """X_r(k) and its speeds over a lap: x, y, theta, v_r, w_r, shape (N, 5)."""
    reason: str = ""
    notes: tuple[str, ...] = ()

    @property
    def n_single(self) -> int | None:
        """Longest single outage [slots] from anywhere on the lap with which the AGV stays inside; -1: not without any.

        None: it did with all that were tried, or nothing is known.
        """
        return None if self.single is None else self.single.n

    @property
    def tube(self) -> Tube | None:
        """The tube of the nonlinear loop where it is proved, else that of the linear one."""
        return _proving(self.linear_tube, self.nonlinear)

    @property
    def n_any_proved(self) -> int | None:
        """Largest n for which that tube stays inside, whatever outages of up to n slots come.

        -1: not even without outages; None: not computed, `tube_reason` says why.
        """
        if self.tube is not None:
            return self.tube.n
        return None if self.tube_reason or self.single is None else -1

    @property
    def in_short(self) -> str:
        """How far the AGV strays, in a line: what is proved of it, and how often it leaves the corridor."""
        leaves = f"leaves {_widths(self.widths)} with a probability of {probability(self.leaving.p_lap)} a lap"
        if self.rms.value is None:
            return leaves
        return f"{f'RMS {metres(self.rms.value)}' if math.isfinite(self.rms.value) else 'diverges'}; {leaves}"

    def rows(self) -> Iterator[tuple[str, str]]:
        """Name and value of each figure, in plain text."""
        yield "Corridor", _widths(self.widths)
        if self.single is None:
            yield "Outages within it", f"no answer: {self.reason}"
        else:
            yield "Longest single outage", self._single(self.single)
            yield "Outages in any order", self._any()
            if self.tube_reason != _NOT_ASKED:
                yield "The same, proved", self._proved()
        yield "RMS deviation", str(self.rms)
        yield "Probability to leave", self._probability()
        yield "Mean time to leave", _time(self.leaving.mean_time)

    def _single(self, found: SingleOutage) -> str:
        if found.n is None:
            return f"all up to {LONGEST} slots stay inside, {at_most(found.deviation)} off"
        if found.n < 0:
            return "none: the AGV is outside without any"
        where = f"({found.x:.3g}, {found.y:.3g}) m, {found.step * self.ts:.4g} s into the lap"
        length = f"{counted(found.n, 'slot')} ({outage_text(found.n * self.ts)})"
        return f"{length}, which leads {metres(found.deviation)} off at most; worst at {where}"

    def _any(self) -> str:
        if self.n_any is None:
            return f"no sequence was found that leaves it ({self.n_any_reason})"
        if self.n_any < 0:
            return "none: the AGV is outside without any"
        return f"up to {counted(self.n_any, 'slot')} no sequence was found that leaves it; {self.n_any_reason}"

    def _proved(self) -> str:
        linear, nonlinear = self.linear_tube, self.nonlinear
        if linear is None:
            return f"no n ({self.tube_reason})" if self.tube_reason else "not even without outages"
        by_linear = f"{counted(linear.n, 'slot')} by the linear loop, {at_most(linear.deviation)} off"
        if nonlinear is None:
            return f"{by_linear}; what is of second order could not be covered"
        covering = f"{counted(nonlinear.tube.n, 'slot')}, {at_most(nonlinear.tube.deviation)} off"
        if nonlinear.is_proved:
            return covering
        return f"{by_linear}; with what is of second order, which was measured, {covering}"

    def _probability(self) -> str:
        lap, hour = self.leaving.p_lap, self.leaving.p_hour
        return f"{probability(lap)} a lap, {in_an_hour(lap, hour)} an hour (by {self.leaving.method})"

    def to_json(self) -> dict[str, Any]:
        """The figures by name; SI units, intervals of 95 %."""
        found, sequence, single = self.leaving, self.sequence, self.single
        return {
            "half_width": self.widths.half_width,
            "half_width_along": finite(min(self.widths.distance, self.widths.along)),
            "n_single": self.n_single,
            "n_single_reason": self._why_no_single(),
            "single_deviation": None if single is None else finite(single.deviation),
            "worst_place": None if single is None else {
                "step": single.step, "time_s": single.step * self.ts, "x": single.x, "y": single.y,
            },
            "n_any": self.n_any,
            "n_any_reason": self.n_any_reason or None,
            "worst_sequence": None if sequence is None else {
                "outages": sequence.lengths, "step": sequence.step, "deviation": finite(sequence.deviation),
            },
            "n_any_proved": self.n_any_proved,
            "n_any_proved_reason": self.tube_reason or None,
            "tube_deviation": None if self.tube is None else self.tube.deviation,
            "n_any_linear": None if self.linear_tube is None else self.linear_tube.n,
            "n_any_proved_of": self._proved_of(),
            "tube_deviation_second_order": None if self.nonlinear is None else self.nonlinear.tube.deviation,
            **self.rms.to_json(),
            "rms_along": None if self.stationary is None else finite(self.stationary.rms_along),
            "rms_across": None if self.stationary is None else finite(self.stationary.rms_across),
            **_estimates("p_lap", found.p_lap),
            **_estimates("p_hour", found.p_hour),
            **_estimates("mean_time_s", found.mean_time),
            "method": found.method,
            "laps": len(found.largest),
            "notes": list(self.notes),
        }  # fmt: skip

    def _proved_of(self) -> str | None:
        if self.tube is None:
            return None
        return "the linear loop" if self.tube is self.linear_tube else "the nonlinear loop"

    def _why_no_single(self) -> str | None:
        if self.single is None:
            return self.reason
        return f"all that were tried, up to {LONGEST} slots, stay inside" if self.single.n is None else None


def corridor(
    scenario: Scenario, laps: int | None = None, progress: Callable[[str], None] = lambda what: None,
    proved: bool = True,
) -> Corridor | None:  # fmt: skip
    """What a scenario's loop does within its corridor; None if it has none.

    `laps` are simulated, or as many as usual; without `proved` there is no tube. Raises TrackFileError if the track's
    file cannot be used, PartError if a part raises.
    """
    widths = widths_of(scenario.error_detector)
    if widths is None:
        return None
    loop, single, sequence, n_any, why, reason = LapLoop(scenario, widths), None, None, None, "", ""
    tube, nonlinear, why_no_tube = None, None, "" if proved else _NOT_ASKED
    if not (scenario.relay.uplink.is_direct and scenario.relay.downlink.is_direct):
        reason = NOT_ALONE
    elif not loop.loss_free_share < _DIVERGED:
        reason = _NEVER_SETTLES
    else:
        progress("single outages")
        single = single_outage(loop)
        progress("sequences of outages")
        n_any, sequence, why = _any_outages(loop, single)
        if proved:
            progress("a tube for any outages")
            tube, nonlinear, why_no_tube = _tubes(loop, _longest_any(single) if n_any is None else n_any)
    progress("laps")
    # Noise and slip are not part of what is proved.
    covering = None if scenario.plant.is_noisy or scenario.plant.slip_noise > 0.0 else _proving(tube, nonlinear)
    n_proved = None if covering is None else covering.n
    found = leaving(loop, single, laps, lambda done: progress(counted(done, "lap")), n_proved)
    progress("the RMS deviation")
    stationary, why_not = _stationary(loop)
    rms = rms_deviation(loop, chain_alone(scenario), stationary, why_not, found)
    return Corridor(
        widths, loop.ts, single, sequence, n_any, why, tube, nonlinear, why_no_tube, stationary, rms, found, loop.lap,
        reason, (*_notes(loop, single), *rms.notes()),
    )  # fmt: skip


def rough_tube(loop: LapLoop) -> tuple[Tube | None, str]:
    """The tube of the linear loop for any outages up to n, n no more than `roughly` a single one may have; a remark.

    Without a tube the remark says why. No sequences are tried before it, so that it comes in a second or two.
    """
    relay = loop.scenario.relay
    if not (relay.uplink.is_direct and relay.downlink.is_direct):
        return None, f"no tube: {NOT_ALONE}"
    if not loop.loss_free_share < _DIVERGED:
        return None, f"no tube: {_NEVER_SETTLES}"
    n = roughly(loop)
    tube, _, why = _tubes(loop, _LONGEST_ANY if n is None else min(n, _LONGEST_ANY), second_order=False)
    if tube is None:
        return None, f"no tube: {why or 'it is left without any outage'}"
    return tube, "of the linear loop"


def _any_outages(loop: LapLoop, single: SingleOutage) -> tuple[int | None, WorstSequence | None, str]:
    """Largest n at which no sequence was found that leaves, the worst sequence, and why it is that n."""
    if single.n == -1:
        return -1, None, "the AGV is outside without any"
    longest = _longest_any(single)
    # Where an error stays without outages, too, as across the track of a parked AGV, they are not what keeps it.
    growing = _growing(loop, longest) or None
    n, sequence = largest_n(loop, longest if growing is None else min(longest, growing - 1))
    if growing is not None and n == growing - 1:
        return (
            n,
            sequence,
            f"with outages of {counted(growing, 'slot')}, again and again, a small error does not die out",
        )
    if single.n is None and n == longest:
        return None, sequence, f"tried up to {counted(longest, 'slot')}"
    if n == single.n:
        return n, sequence, "no more than of a single one"
    return n, sequence, f"outages of {_turns(sequence.lengths)} slots leave"


def _longest_any(single: SingleOutage) -> int:
    return _LONGEST_ANY if single.n is None else min(single.n, _LONGEST_ANY)


def _proving(linear: Tube | None, nonlinear: NonlinearTube | None) -> Tube | None:
    """The tube of the nonlinear loop where it is proved, else that of the linear one."""
    return nonlinear.tube if nonlinear is not None and nonlinear.is_proved else linear


def _tubes(loop: LapLoop, longest: int, second_order: bool = True) -> tuple[Tube | None, NonlinearTube | None, str]:
    """The tubes of the linear loop and, if asked for, of the nonlinear one for the largest n; why there is none."""
    if loop.scenario.controller.steps_ahead:
        return None, None, LOOKS_AHEAD
    try:
        linear = loop.linear
    except NoNominalMotionError as error:
        return None, None, str(error)
    if not applies_to(linear):
        return None, None, "computed for loops without states beside the pose, on a track that is driven"
    _, tube = tubes.largest_n(loop, linear, longest)
    return tube, nonlinear_tube(loop, linear, tube) if tube is not None and second_order else None, ""


def _stationary(loop: LapLoop) -> tuple[StationaryDeviation | None, str]:
    """The stationary deviation, or why it is not computed."""
    chain, scenario = chain_alone(loop.scenario), loop.scenario
    if not is_random(scenario):
        return None, "nothing is random"
    if chain is None:
        return None, "the uplink is not a Markov chain of losses alone"
    if scenario.plant.slip_noise > 0.0:
        return None, "slip is random"
    if scenario.controller.steps_ahead:
        return None, LOOKS_AHEAD
    try:
        return stationary_deviation(loop, loop.linear, chain), ""
    except NoNominalMotionError as error:
        return None, str(error)


def _turns(lengths: list[int]) -> str:
    one, other = lengths[0], lengths[1]
    return f"{one}" if one == other else f"{one} and {other}"


def _growing(loop: LapLoop, longest: int) -> int | None:
    """Smallest n up to `longest` whose repetition lets a small error grow; None if none does, or if it is not known."""
    try:
        linear = loop.linear
    except NoNominalMotionError:
        return None
    if linear.is_exact:  # an outage leaves nothing that could grow
        return None
    return joint_spectral_radius.first_refuted(linear.thinned(_PLACES) if linear.predicts else linear, longest)


def _notes(loop: LapLoop, single: SingleOutage | None) -> Iterator[str]:
    share, policy = loop.loss_free_share, loop.scenario.error_detector.policy
    if 1.0 < share < _DIVERGED:
        yield f"without any outage the AGV uses {share:.3g} times the half-width: no outage can be survived in it"
    elif single is not None and single.n == 0 and policy == "hold":
        yield (
            "a single lost pose leads outside: an outdated pose is compared with the reference of now "
            "(error_detector.policy is hold), which align and predict do not do"
        )


def _widths(widths: Widths) -> str:
    if math.isfinite(widths.distance):
        return f"{widths.distance:g} m about the reference"
    return f"{widths.across:g} m across the track, {widths.along:g} m along it"


def probability(p: Estimate) -> str:
    """A probability with its interval; of an event that is rare for sure not in per cent."""
    if p.low == p.high:
        return f"{p.value:.4g}" if 0.0 < p.value < 0.001 else percent(p.value)
    if p.value < 0.001 and 0.0 < p.high < 0.001:
        return f"{p.value:.3g} ({p.low:.3g} .. {p.high:.3g})"
    if p.low > 0.999:
        return "above 99.9 %"
    return f"{percent(p.value)} ({percent(p.low)} .. {percent(p.high)})"


def in_an_hour(lap: Estimate, hour: Estimate) -> str:
    """The probability of an hour, which floats round to 1 where that of a lap is not."""
    return computed(hour.value) if hour.low == 1.0 and lap.low < 1.0 else probability(hour)


def _time(mean: Estimate | None) -> str:
    if mean is None:
        return "it never leaves"
    if not math.isfinite(mean.value):
        return f"more than {duration_text(mean.low)}"
    if mean.low == mean.high:
        return duration_text(mean.value)
    low, high = (duration_text(end, like=mean.value) for end in (mean.low, mean.high))
    return f"{duration_text(mean.value)} ({low} .. {high})"


def _estimates(name: str, found: Estimate | None) -> dict[str, Any]:
    if found is None:
        return {name: None, f"{name}_interval": None}
    return {name: finite(found.value), f"{name}_interval": [finite(found.low), finite(found.high)]}
