"""Mean square where poses are late as well as lost: the age of the pose as a Markov chain."""

from __future__ import annotations

from collections.abc import Iterable

from agv_analysis.json_values import finite
from agv_analysis.link.age_chain import AgeChain, age_chain_of, fitted_ages
from agv_analysis.stability import delayed_mean_square
from agv_analysis.stability.criteria.criterion import (
    Criterion,
    Judgement,
    Margin,
    RunFacts,
    ScenarioFacts,
    growth_text,
    has_late,
)
from agv_analysis.stability.linear_loop import LinearLoop
from agv_plant.parameters import RelayParameters
from agv_ros.counted import counted

_PLACES, _FEWEST, _WORK = 2000, 50, 2e7
"""Places of a lap at which a run is judged, at most and at least, and numbers to be moved over them, see `work`."""

_WORK_OF_CHANNEL = 2e8
"""The same for a channel that is known; of places as many as this allows."""

_NAME, _LABEL = "late_poses.mean_square_growth", "Late and lost poses as they are, mean square"


def growth_of_late_poses(facts: RunFacts) -> float | None:
    """Growth of E[e^2] per step under the chain of ages fitted to a run; None where it does not apply.

    It does where messages came late, by whatever delays; where commands were late or lost as well, their ages and those
    of the poses must add up.
    """
    run = facts.run
    if not (facts.is_feasible and (has_late(run.uplink) or has_late(run.downlink))):
        return None
    if (has_late(run.downlink) or run.downlink_lost.any()) and not facts.ages_add_up:
        return None
    if len(run) < 2 or int(run.k[-1] - run.k[0]) + 1 != len(run):
        return None
    return _growth(facts, slice(None))


def growths_of_halves(facts: RunFacts) -> tuple[float | None, float | None]:
    """The same under the chains fitted to either half of a run: where they differ in sign the run shows too little."""
    half = len(facts.run) // 2
    return _growth(facts, slice(0, half)), _growth(facts, slice(half, None))


def _growth(facts: RunFacts, rows: slice) -> float | None:
    ages = fitted_ages((facts.run.acting_age if facts.ages_add_up else facts.run.n_ul)[rows])
    loop = _thinned(facts.loop, ages, _WORK, _PLACES)
    return None if _why_not(loop, ages) else delayed_mean_square.lap_growth(loop, ages) / loop.steps


def _thinned(loop: LinearLoop, ages: AgeChain, work: float, places: int) -> LinearLoop:
    """The loop at `places` of its lap at most, and at as few of them as `work` allows, but not at fewer than 50."""
    share = work / max(1.0, delayed_mean_square.work(loop, ages))
    return loop.thinned(min(places, max(_FEWEST, round(share * loop.steps))))


def _why_not(loop: LinearLoop, ages: AgeChain) -> str:
    """Why there is no answer for a loop and its chain of ages; empty if there is one."""
    if delayed_mean_square.work(loop, ages) > delayed_mean_square.MOST_WORK:
        return f"poses may be {counted(ages.oldest, 'slot')} late, which would take too long to compute"
    return ""


def _judge(facts: RunFacts) -> Judgement | None:
    growth = growth_of_late_poses(facts)
    if growth is None:
        return None
    return Judgement(
        "Late and lost messages, mean square", growth < 0.0, f"{growth_text(growth)} under the chain of ages that fits",
        {"late_mean_square_stable": growth < 0.0, "late_mean_square_growth": finite(growth)}, growth,
    )  # fmt: skip


def growth_of_channel(loop: LinearLoop, relay: RelayParameters, ts: float) -> float | str:
    """Growth of E[e^2] per step of `loop` under the late uplink of a scenario; in words why there is no answer."""
    if relay.downlink.delays or relay.downlink.model != "perfect":
        return "commands are late or lost as well"
    ages = age_chain_of(relay.uplink, ts)
    if ages is None:
        return "losses with a memory and random delays, or a channel that is not a finite Markov chain"
    loop = _thinned(loop, ages, _WORK_OF_CHANNEL, loop.steps)
    return _why_not(loop, ages) or delayed_mean_square.lap_growth(loop, ages) / loop.steps


def _margins(facts: ScenarioFacts) -> Iterable[Margin]:
    relay, ts = facts.scenario.relay, facts.scenario.plant.ts
    if not relay.uplink.delays:
        yield Margin(_NAME, _LABEL, None, reason="the uplink delays nothing", shown=False)
        return
    found = growth_of_channel(facts.loop, relay, ts)
    if isinstance(found, str):
        yield Margin(_NAME, _LABEL, None, reason=f"no answer: {found}")
    else:
        yield Margin(_NAME, _LABEL, finite(found), growth_text(found))


CRITERION = Criterion(
    key="late_and_lost",
    order=65,
    title="Late and lost poses, mean square",
    asks="Does E[|e|^2] die out if poses are late as well as lost?",
    assumes="That the age of the pose is a Markov chain: any losses behind a constant delay, or independent losses and "
    "delays; of a run the ages that it shows. Commands arrive at once; of a run also late, if plant and edge hold.",
    judge=_judge,
    margins=_margins,
    margin_names=((_NAME, _LABEL),),
)
