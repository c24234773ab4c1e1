"""Messages that should be in a recording, since no channel lost them, and are not."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from agv_analysis.recordings.messages_on_steps import NOTHING, OnSteps, Steps, stamps_of
from agv_analysis.recordings.slot_outcomes import reasons
from agv_ros.messages import DELAYED, DELIVERED
from agv_ros.stamps import Grid


def unexplained(on_steps: Mapping[str, OnSteps], grid: Grid) -> dict[str, int]:
    """Messages by topic that should be in the recording, since no channel lost them, and are not.

    Each message of a step follows from the one before it in the loop: a slot from the pose, the forwarded pose from a
    slot that says `delivered`, or `delayed` and until when, the error from a slot behind which a pose is held, and so
    on. The last step may have been under way when the recording ended, and does not count.
    """
    poses = on_steps["agv/pose"].k
    first = max((messages.k[0] for messages in on_steps.values() if len(messages.k)), default=0) if poses[0] else 0
    expected = {
        "agv/pose": np.arange(first, poses[-1] + 1),
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
    return {topic: count for topic, count in missing.items() if count}


def _passed_on(slots: OnSteps, last: int) -> Steps:
    """Steps whose messages a link has passed on before step `last`."""
    source, delay = slots.messages["source"], reasons(slots.messages["header.frame_id"]).delay
    came = (source == DELIVERED.encode()) | ((source == DELAYED.encode()) & (slots.k + delay < last))
    return np.asarray(slots.k[came])


def _where(messages: OnSteps, condition: Callable[[NDArray[np.void]], NDArray[np.bool_]]) -> Steps:
    return messages.k[condition(messages.messages)]
