"""Steps by slots: in which order poses, slots and commands come does not matter to what is answered."""

from __future__ import annotations

import itertools

import pytest

from agv_cloud.slot_stepping import SlotStepping
from agv_cloud.staleness.estimate import PoseEstimator
from agv_cloud.staleness.registry import STALENESS_POLICIES, number_of
from agv_ros.messages import DELIVERED, LOST, Slot, StampedPose
from agv_ros.stamps import Grid, OffGridError

GRID = Grid(1_000_000_000, 5_000_000)


def estimator(policy: str) -> PoseEstimator:
    number = number_of(policy)
    return PoseEstimator(STALENESS_POLICIES.find(policy), number, (), 0.005, False)


def pose(k: int) -> StampedPose:
    return StampedPose(GRID.stamp(k), float(k), 0.0, 0.0)


def steps_of(stepping: SlotStepping, of: PoseEstimator) -> list[tuple[int, int]]:
    found = []
    while (step := stepping.next(of)) is not None:
        assert step.pose == pose(step.taken)
        found.append((step.k, step.taken))
    return found


def test_a_slot_is_answered_once_its_pose_is_here_and_a_lost_one_by_the_pose_before() -> None:
    events: list[StampedPose | Slot] = [
        pose(0), Slot(GRID.stamp(0), GRID.stamp(0), DELIVERED), Slot(GRID.stamp(1), GRID.stamp(0), LOST),
    ]  # fmt: skip
    for order in itertools.permutations(events):
        if order.index(events[2]) < order.index(events[1]):  # each topic keeps its order
            continue
        stepping, found = SlotStepping(GRID), []
        for event in order:
            if isinstance(event, Slot):
                stepping.add_slot(event)
            else:
                stepping.add_pose(event)
            found += steps_of(stepping, estimator("hold"))
        assert found == [(0, 0), (1, 0)]


def test_slots_before_the_first_pose_are_counted() -> None:
    stepping = SlotStepping(GRID)
    stepping.add_slot(Slot(GRID.stamp(3), 0, LOST))
    assert steps_of(stepping, estimator("hold")) == []
    assert stepping.blind == 1


def test_a_pose_that_cannot_be_used_leaves_the_one_before() -> None:
    stepping = SlotStepping(GRID)
    stepping.add_pose(pose(0))
    stepping.add_slot(Slot(GRID.stamp(0), GRID.stamp(0), DELIVERED))
    stepping.add_slot(Slot(GRID.stamp(1), GRID.stamp(1), DELIVERED))
    assert steps_of(stepping, estimator("hold")) == [(0, 0)]
    stepping.reject_pose(GRID.stamp(1))
    assert steps_of(stepping, estimator("hold")) == [(1, 0)]


def test_a_prediction_waits_for_the_command_of_the_step_before_unless_the_next_slot_comes_first() -> None:
    stepping, predictor = SlotStepping(GRID), estimator("predict")
    stepping.add_pose(pose(0))
    for k in (0, 1):
        stepping.add_slot(Slot(GRID.stamp(k), GRID.stamp(0), LOST if k else DELIVERED))
    assert steps_of(stepping, predictor) == [(0, 0)]
    predictor.add_command(0, 1.0, 0.0)
    assert steps_of(stepping, predictor) == [(1, 0)]
    stepping.add_slot(Slot(GRID.stamp(2), GRID.stamp(0), LOST))
    assert steps_of(stepping, predictor) == []
    stepping.add_slot(Slot(GRID.stamp(3), GRID.stamp(0), LOST))
    assert steps_of(stepping, predictor) == [(2, 0)]


def test_a_stamp_beside_the_grid_is_no_step() -> None:
    with pytest.raises(OffGridError):
        SlotStepping(GRID).step_of(GRID.stamp(3) + 1)


def test_a_recording_that_is_played_again_from_its_middle_begins_a_run() -> None:
    """Without a step 0: after ten slots that are long past, the edge goes on with them."""
    stepping, of, answered = SlotStepping(GRID), estimator("hold"), []
    for _ in range(2):
        for k in range(1000, 1400):
            stepping.add_pose(pose(k))
            stepping.add_slot(Slot(GRID.stamp(k), GRID.stamp(k), DELIVERED))
            answered += [step for step, _ in steps_of(stepping, of)]
    assert answered == [*range(1000, 1400), *range(1010, 1400)]
    assert stepping.beginnings == 1
