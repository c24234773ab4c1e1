"""Mean square of both links for what the plant does where a command does not arrive.

A plant that holds its command, or stops, is that of `mean_square_two_links`. One that ramps down drives a share s_n of
the command u that it holds, of n steps ago:

    z(k+1) = A z + B s_n u + D h_now,    u(k+1) = u,    n <- n + 1    where the command is lost

so n is one more state of the channels' chain, up to the step at which the AGV stands. As where it stops, that the
command of the nominal motion is missing as well is a disturbance that does not depend on the error.
"""

from __future__ import annotations

import math

import numpy as np

from agv_analysis.link.joint_chain import JointChain
from agv_analysis.stability import mean_square_two_links
from agv_analysis.stability.linear_loop import LinearLoop
from agv_plant.downlink_policy import DOWNLINK_POLICIES, RAMP, share_of_command
from agv_plant.parameters import PlantParameters

_LONGEST_RAMP = 200
"""Steps of the longest ramp that is judged."""

_WORK, _FEWEST = 4e6, 50
"""Numbers to be moved over a lap behind a ramp, about, and the fewest places of the lap."""


def why_not(plant: PlantParameters) -> str:
    """Why there is no answer for a plant that loses commands; empty if there is one."""
    if plant.downlink_policy in mean_square_two_links.POLICIES:
        return ""
    if plant.downlink_policy != DOWNLINK_POLICIES[RAMP]:
        return f"computed for a plant that holds its command, stops or ramps down, not for {plant.downlink_policy}"
    if plant.policy_steps > _LONGEST_RAMP:
        return f"computed for a ramp of up to {_LONGEST_RAMP} steps, and it takes {plant.policy_steps:g}"
    return ""


def lap_growth(loop: LinearLoop, links: JointChain, plant: PlantParameters) -> float:
    """Growth (logarithm) of the second moments over a lap. Raises ValueError where `why_not` says so."""
    reason = why_not(plant)
    if reason:
        raise ValueError(reason)
    if plant.downlink_policy in mean_square_two_links.POLICIES:
        return mean_square_two_links.lap_growth(loop, links, stops=plant.downlink_policy == "zero")
    return _behind_ramp(loop, links, plant.policy_steps)


def _behind_ramp(loop: LinearLoop, links: JointChain, steps: float) -> float:
    """Growth over a lap for a plant that takes so many steps to a stand."""
    last = math.ceil(steps)
    aged = with_age_of_command(links, last)
    work = len(aged.transition) * (loop.size + loop.outputs + 2) ** 2
    thinned = loop.thinned(max(_FEWEST, round(_WORK / work)))
    shares = [share_of_command(n, RAMP, steps) for n in range(last + 1)]
    maps = [
        mean_square_two_links.step_maps(thinned, pose, n == 0, share=share)
        for pose in (True, False)
        for n, share in enumerate(shares)
    ]
    return mean_square_two_links.growth_of_maps(thinned, np.stack(maps, axis=1), aged) * (loop.steps / thinned.steps)


def with_age_of_command(links: JointChain, last: int) -> JointChain:
    """The chain of both links and of how many steps ago the command was sent that is held, `last` standing for more.

    A state is one of the links' and the age in this slot, 0 if its command is delivered. Outcomes: pose delivered and
    age 0 .. `last`, pose lost and age 0 .. `last`; shape (s, 2 (last + 1)).
    """
    ages = last + 1
    both, pose_alone, command_alone = links.outcomes.T[:3]
    heard = both + command_alone
    share = np.stack((heard, 1.0 - heard))  # of slots whose command is delivered, and lost
    with np.errstate(invalid="ignore", divide="ignore"):
        pose = np.nan_to_num(np.stack((both / share[0], pose_alone / share[1])))
    successors = [[int(t) for t in np.flatnonzero(row > 0.0)] for row in links.transition]
    begun = np.flatnonzero(heard > 0.0)
    states = [(int(s), 0) for s in begun] if len(begun) else [(0, min(1, last))]
    place = {state: i for i, state in enumerate(states)}
    moves: list[tuple[int, int, float]] = []
    for i, (s, n) in enumerate(states):  # which grows by those that follow
        for t in successors[s]:
            for lost, after in enumerate((0, min(n + 1, last))):
                if share[lost, t] > 0.0:
                    if (t, after) not in place:
                        place[t, after] = len(states)
                        states.append((t, after))
                    moves.append((i, place[t, after], float(links.transition[s, t] * share[lost, t])))
    transition, outcomes = np.zeros((len(states), len(states))), np.zeros((len(states), 2 * ages))
    for i, j, probability in moves:
        transition[i, j] += probability
    for i, (s, n) in enumerate(states):
        outcomes[i, n], outcomes[i, ages + n] = pose[min(n, 1), s], 1.0 - pose[min(n, 1), s]
    return JointChain(transition, outcomes)
