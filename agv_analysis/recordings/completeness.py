"""Messages that should be in a recording, since no channel lost them, and are not."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from agv_analysis.recordings.messages_on_steps import NOTHING, OnSteps, Steps, stamps_of
from agv_analysis.recordings.slot_outcomes import reasons
from agv_ros.counted import counted
from agv_ros.errors import UserError
from agv_ros.messages import DELAYED, DELIVERED
from agv_ros.stamps import NS_PER_S, Grid

_FEWEST_STAMPS = 4
"""Fewer do not tell a sampling period."""


def unexplained(on_steps: Mapping[str, OnSteps], grid: Grid) -> dict[str, int]:
    """Messages by topic that should be in the recording, since no channel lost them, and are not.

    Each message of a step follows from the one before it in the loop: a slot from the pose, the forwarded pose from a
    slot that says `delivered`, or `delayed` and until when, the error from a slot behind which a pose is held, and so
    on. The last step may have been under way when the recording ended, and does not count.
    """
    poses = on_steps["agv/pose"].k
    first = max((messages.k[0] for messages in on_steps.values() if len(messages.k)), default=0) if poses[0] else 0
    expected = {
        "agv/pose": poses,
        "edge/slot": poses,
        "edge/pose": _passed_on(on_steps["edge/slot"], poses[-1]),
        "edge/error": _where(on_steps["edge/slot"], lambda slots: stamps_of(slots, "time_ref") >= grid.start_ns),
        "edge/cmd_vel": on_steps["edge/error"].k,
    }
    if len(on_steps.get("edge/age", NOTHING).k):
        expected["edge/error"] = on_steps["edge/age"].k
    if len(on_steps.get("edge/reference_pose", NOTHING).k):
        expected["edge/reference_pose"] = on_steps["edge/error"].k
    if len(on_steps.get("agv/ground_truth", NOTHING).k):
        expected["agv/ground_truth"] = poses
    if "agv/slot" in on_steps:
        expected["agv/slot"] = on_steps["edge/cmd_vel"].k
        expected["agv/cmd_vel"] = _passed_on(on_steps["agv/slot"], poses[-1])
    missing = {
        topic: int(np.count_nonzero(~on_steps[topic].at(k[(k >= first) & (k < poses[-1])])[1]))
        for topic, k in expected.items()
        if topic in on_steps
    }
    missing["agv/pose"] = int(poses[-1] - first) - int(np.count_nonzero((poses >= first) & (poses < poses[-1])))
    return {topic: count for topic, count in missing.items() if count}


def _passed_on(slots: OnSteps, last: int) -> Steps:
    """Steps whose messages a link has passed on before step `last`."""
    source, delay = slots.messages["source"], reasons(slots.messages["header.frame_id"]).delay
    came = (source == DELIVERED.encode()) | ((source == DELAYED.encode()) & (slots.k + delay < last))
    return np.asarray(slots.k[came])


def _where(messages: OnSteps, condition: Callable[[NDArray[np.void]], NDArray[np.bool_]]) -> Steps:
    return messages.k[condition(messages.messages)]


def refuse_other_grid(on_steps: Mapping[str, OnSteps], stamps: Mapping[str, Steps], grid: Grid, source: str) -> None:
    """Raise UserError if poses and slots were not recorded with the sampling period of `grid`.

    `stamps` [ns] are those of all messages by topic, in any order. One message lost now and then leaves most pairs of
    neighbours a period apart; another period does not.
    """
    apart = {_usual_spacing(stamps[topic]) for topic in ("agv/pose", "edge/slot")}
    if len(apart) == 1 and (found := apart.pop()) not in (None, grid.ts_ns):
        raise UserError(
            f"{source}: plant.ts is {grid.ts_ns / NS_PER_S:g} s in the parameters, but poses and slots are recorded "
            f"every {found / NS_PER_S:g} s: name the params file of this run with --config"
        )
    for topic in ("agv/pose", "edge/slot"):
        off, count = on_steps[topic].off_grid, len(stamps[topic])
        if off > count / 2:
            raise UserError(
                f"{source}: {off} of {counted(count, 'message')} of {topic} are not on the grid of "
                "plant.start_time + k * "
                f"plant.ts = {grid.start_ns / NS_PER_S:g} s + k * {grid.ts_ns / NS_PER_S:g} s: name the params file of "
                "this run with --config"
            )


def _usual_spacing(stamps: Steps) -> int | None:
    """Distance [ns] of more than half of the neighbouring stamps; None if there is no such distance."""
    if len(stamps) < _FEWEST_STAMPS:
        return None
    spacings, counts = np.unique(np.diff(np.unique(stamps)), return_counts=True)
    if not len(counts) or 2 * counts.max() <= counts.sum():
        return None
    return int(spacings[np.argmax(counts)])
