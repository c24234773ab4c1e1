"""The losses of a run, again and again: what they do to a small error, about the reference and about the motion."""

from __future__ import annotations

import numpy as np

from agv_analysis.json_values import finite
from agv_analysis.run import Run
from agv_analysis.stability import driven_motion, floquet, variable_delay
from agv_analysis.stability.criteria.criterion import Criterion, Judgement, RunFacts, change_text, has_late


def _judge(facts: RunFacts) -> Judgement | None:
    of_losses, of_motion = _contractions(facts) if facts.is_feasible else (None, None)
    values = {"floquet_multiplier_per_step": of_losses, "contraction_per_step": of_motion}
    if of_losses is None:
        return Judgement("Recorded losses", None, "", values)
    why = f"errors {_per_step(of_losses)}"
    if of_motion is not None:
        why += f"; about the driven motion they {_per_step(of_motion)}"
    return Judgement("Recorded losses", of_losses < 1.0, why, values, (of_losses, of_motion))


def _per_step(factor: float) -> str:
    """A growth factor per step in words."""
    return f"{'grow' if factor > 1.0 else 'shrink'} by {change_text(factor - 1.0)}"


def _contractions(facts: RunFacts) -> tuple[float | None, float | None]:
    """Growth factors per step from the first pose received on: about the reference, and about the driven motion."""
    run, loop = facts.run, facts.loop
    if facts.is_late:
        return _late_contraction(facts), None
    first = int(np.argmin(run.lost))
    steps = len(run) - first
    if run.lost[first] or int(run.k[-1] - run.k[first]) + 1 != steps:
        return None, None
    with np.errstate(all="ignore"):
        of_losses = floquet.drop_sequence(loop.at(np.arange(first, len(run))), run.lost[first:], 1)
        per_step = finite(float(np.exp(of_losses[0] / steps)))
        of_motion = driven_motion.growth(run, first)
    return per_step, None if of_motion is None else finite(float(np.exp(of_motion / steps)))


def _late_contraction(facts: RunFacts) -> float | None:
    """Growth factor per step about the reference from the first step on; None for what `variable_delay` cannot say."""
    run, loop = facts.run, facts.loop
    is_whole = run.k[0] == 0 and int(run.k[-1]) + 1 == len(run)
    commands_wait = has_late(run.downlink) or run.downlink_lost.any()
    if loop.predicts or not is_whole or (commands_wait and not facts.ages_add_up) or not _held_its_command(run):
        return None
    with np.errstate(all="ignore"):
        growth = variable_delay.age_sequence(loop, run.acting_age if facts.ages_add_up else run.command_age)
    return finite(float(np.exp(growth / len(run))))


def _held_its_command(run: Run) -> bool:
    """Did the AGV act on the newest command that it had, however old? Then its age adds to that of the pose behind it.

    Of another robot that is taken for granted.
    """
    plant = run.scenario.plant
    if run.n_dl_received is None or not run.is_late or not run.seed_known:
        return True
    oldest = int(run.n_dl_received.max())
    return oldest == 0 or (plant.downlink_policy == "hold" and oldest * run.ts <= plant.cmd_vel_timeout)


CRITERION = Criterion(
    key="recorded_losses",
    order=70,
    title="Recorded losses",
    asks="What does the run's own sequence of losses do to a small error, if it comes again and again?",
    assumes="Nothing of the channel; it says of this one run only.",
    judge=_judge,
)
