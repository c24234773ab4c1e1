"""The error of a step without any message: the reference, and what it is compared with."""

from __future__ import annotations

import pytest

from agv_cloud.error_detection import ErrorDetection
from agv_cloud.parameters import ErrorDetectorParameters
from agv_cloud.reference.path_reference import PathReference
from agv_cloud.reference.reference import Reference
from agv_cloud.step import EdgeStep
from agv_ros.messages import StampedPose
from agv_ros.parts import PartError

LINE = ErrorDetectorParameters(track="line", speed=0.5, track_start=(0.0, 0.0, 0.0), plan_steps=2)


def step(k: int, taken: int, x: float = 0.0, y: float = 0.0) -> EdgeStep:
    return EdgeStep(k, taken, StampedPose(0, x, y, 0.0))


def test_a_pose_off_the_track_gives_the_error_in_its_frame() -> None:
    detection, reference = ErrorDetection(LINE), Reference(LINE)
    found = detection.detect(step(4, 4, y=1.0))
    assert found.eps == pytest.approx((reference[4].x, -1.0, 0.0))
    assert found.target == found.reference == reference[4]
    assert detection.speeds_ahead(4, found.held) == ((0.5, 0.0),) * 3


def test_hold_compares_an_outdated_pose_with_the_reference_of_now() -> None:
    found = ErrorDetection(LINE).detect(step(9, 4))
    assert found.eps[0] == pytest.approx(Reference(LINE)[9].x)


def test_before_the_first_path_the_agv_is_to_stand_where_it_is() -> None:
    detection = ErrorDetection(ErrorDetectorParameters(track="path", speed=1.0))
    found = detection.detect(step(0, 0, x=3.0, y=4.0))
    assert found.eps == (0.0, 0.0, 0.0)
    assert (found.target.v, found.target.w, found.reference.x) == (0.0, 0.0, 3.0)
    reference = detection.reference
    assert isinstance(reference, PathReference)
    reference.take([(3.0, 4.0), (9.0, 4.0)])
    assert detection.detect(step(1, 1, x=3.0, y=4.0)).target.v == pytest.approx(1.0)


def test_a_policy_that_raises_is_named_with_its_step(monkeypatch: pytest.MonkeyPatch) -> None:
    detection = ErrorDetection(LINE)

    def broken(*_: object) -> None:
        raise ZeroDivisionError("no such pose")

    monkeypatch.setattr(detection.estimator, "at", broken)
    with pytest.raises(PartError, match="raises ZeroDivisionError: no such pose, at step 7"):
        detection.detect(step(7, 7))
