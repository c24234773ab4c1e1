"""Convergence metrics against closed forms of sequences that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agv_analysis.metrics.convergence import (
    body_errors,
    convergence,
    damping,
    error_metrics,
    settling,
    sign_changes,
    wrapped,
)
from agv_analysis.run import Run
from agv_analysis.scenario import parse_scenario
from agv_ros.errors import UserError

TS = 0.005
Floats = NDArray[np.float64]

finite = st.floats(-1e6, 1e6)
series = st.lists(finite, min_size=1, max_size=60).map(lambda values: np.array(values))


def geometric(first: float, ratio: float, steps: int) -> Floats:
    return np.array([first * ratio**k for k in range(steps)])


def steps_of(e: Floats) -> NDArray[np.int64]:
    return np.arange(len(e), dtype=np.int64)


@pytest.mark.parametrize("ratio", [0.975, 0.875, 0.5, -0.25])
def test_settling_of_a_geometric_error_is_the_logarithm(ratio: float) -> None:
    e = geometric(-5.0, ratio, 2000)
    metrics = error_metrics(steps_of(e), e, TS)
    assert metrics.settle_1cm_steps == math.ceil(math.log(0.01 / 5.0) / math.log(abs(ratio)))
    assert metrics.settle_2pct_steps == math.ceil(math.log(0.02) / math.log(abs(ratio)))


@pytest.mark.parametrize("ratio", [0.975, 0.5, -0.25, -0.9])
def test_integrals_of_a_geometric_error_are_those_of_the_series(ratio: float) -> None:
    e = geometric(3.0, ratio, 4000)
    metrics = error_metrics(steps_of(e), e, TS)
    assert metrics.iae == pytest.approx(TS * 3.0 / (1.0 - abs(ratio)), rel=1e-12)
    assert metrics.ise == pytest.approx(TS * 9.0 / (1.0 - ratio**2), rel=1e-12)


def test_an_alternating_error_overshoots_by_its_ratio() -> None:
    e = geometric(-5.0, -0.25, 50)  # -5, 1.25, -0.3125, 0.078, -0.0195, 0.0049: four changes beyond 1 cm
    metrics = error_metrics(steps_of(e), e, TS)
    assert metrics.overshoot == 0.25
    assert metrics.sign_changes == 4
    assert (metrics.initial, metrics.peak) == (-5.0, 5.0)


def test_without_an_initial_error_there_is_nothing_to_take_a_share_of() -> None:
    metrics = error_metrics(steps_of(np.zeros(100)), np.zeros(100), TS)
    assert metrics.settle_1cm_steps == 0
    assert metrics.settle_2pct_steps is None
    assert metrics.overshoot is None
    assert (metrics.iae, metrics.ise, metrics.peak, metrics.sign_changes) == (0.0, 0.0, 0.0, 0)


def test_a_run_shorter_than_the_settling_has_none() -> None:
    e = geometric(5.0, 0.975, 246)  # 246 steps: k = 0 .. 245
    assert error_metrics(steps_of(e), e, TS).settle_1cm_steps is None
    e = geometric(5.0, 0.975, 247)
    assert error_metrics(steps_of(e), e, TS).settle_1cm_steps == 246


def test_an_error_that_comes_back_has_not_settled_before() -> None:
    e = np.array([1.0, 0.0, 0.0, 0.5, 0.0, 0.0])
    assert error_metrics(steps_of(e), e, TS).settle_1cm_steps == 4
    assert error_metrics(steps_of(e), np.array([1.0, 0.0, 0.0, 0.0, 0.0, np.nan]), TS).settle_1cm_steps is None


def test_steps_count_from_the_first_step_recorded_and_over_gaps() -> None:
    e = np.array([1.0, 1.0, 0.0, 0.0])
    assert error_metrics(np.array([100, 101, 150, 151]), e, TS).settle_1cm_steps == 50


def test_an_error_beyond_the_range_of_numbers_is_infinite_not_an_exception() -> None:
    e = np.array([1.0, 1e200])
    assert error_metrics(steps_of(e), e, TS).ise == math.inf


@given(size=series, band=st.floats(0.0, 1e6))
@settings(deadline=None, derandomize=True)
def test_settling_is_what_the_definition_says(size: Floats, band: float) -> None:
    size = np.abs(size)
    stays = [k for k in range(len(size)) if all(value < band for value in size[k:])]
    assert settling(size, band) == (stays[0] if stays else None)


@given(e=series, band=st.floats(0.0, 1e3))
@settings(deadline=None, derandomize=True)
def test_sign_changes_are_those_of_the_samples_beyond_the_band(e: Floats, band: float) -> None:
    side, changes = 0, 0
    for value in e:
        now = 1 if value > band else -1 if value < -band else side
        changes += side * now < 0
        side = now
    assert sign_changes(e, band) == changes


@given(angle=st.floats(-1e3, 1e3))
@settings(deadline=None, derandomize=True)
def test_a_wrapped_angle_is_the_same_angle_in_its_interval(angle: float) -> None:
    (value,) = wrapped(np.array([angle]))
    assert -math.pi < value <= math.pi
    assert abs(math.remainder(value - angle, 2.0 * math.pi)) < 1e-12


def test_half_a_turn_counts_as_pi_not_minus_pi() -> None:
    assert wrapped(np.array([math.pi, -math.pi])).tolist() == [math.pi, math.pi]


def test_body_errors_are_a_rotation_by_the_heading() -> None:
    generator = np.random.default_rng(1)
    reference, pose = generator.normal(size=(50, 5)), generator.normal(size=(50, 3))
    ahead = (reference[:, 0] + 1j * reference[:, 1] - pose[:, 0] - 1j * pose[:, 1]) * np.exp(-1j * pose[:, 2])
    expected = np.column_stack([ahead.real, ahead.imag, reference[:, 2] - pose[:, 2]])
    np.testing.assert_allclose(body_errors(reference, pose), expected, atol=1e-14)


# -- damping ---------------------------------------------------------------------------------------------------------


def damping_of(d: Floats, v_max: float = math.inf, critical_time: float = 0.25) -> str | None:
    return damping(np.arange(0.0, len(d)) * TS, 1.0 + d, np.ones(len(d)), v_max, critical_time)


@pytest.mark.parametrize(("ratio", "expected"), [(0.975, "over"), (0.875, "critical"), (-0.25, "under")])
def test_damping_of_a_first_order_command(ratio: float, expected: str) -> None:
    assert damping_of(geometric(-25.0, ratio, 2000)) == expected


def test_the_border_between_critical_and_over_is_the_critical_time() -> None:
    d = geometric(-25.0, 0.9, 500)
    lasts = math.ceil(math.log(0.02) / math.log(0.9)) * TS
    assert damping_of(d, critical_time=lasts) == "critical"
    assert damping_of(d, critical_time=lasts - 0.5 * TS) == "over"


def test_time_counts_from_the_last_saturated_sample() -> None:
    saturated = np.full(200, -7.0)  # v = -6
    assert damping_of(np.concatenate([saturated, geometric(-7.0, 0.875, 500)]), v_max=6.0) == "critical"
    assert damping_of(np.concatenate([saturated, geometric(-7.0, 0.875, 500)])) == "over"
    assert damping_of(np.concatenate([saturated, geometric(-7.0, 0.975, 500)]), v_max=6.0) == "over"


def test_a_single_crossing_is_under_damped_and_one_inside_the_band_is_none() -> None:
    assert damping_of(np.array([10.0, 5.0, -0.3] + [0.0] * 100)) == "under"
    assert damping_of(np.array([10.0, 5.0, -0.1] + [0.0] * 100)) == "critical"


def test_commands_that_were_not_sent_are_left_out() -> None:
    d = geometric(-25.0, 0.875, 500)
    d[[3, 17, 499]] = np.nan
    assert damping_of(d) == "critical"
    assert damping_of(np.full(10, np.nan)) is None


def test_a_run_that_cannot_tell_has_no_damping() -> None:
    assert damping_of(np.zeros(100)) is None  # on the reference all the time
    assert damping_of(np.array([-25.0])) is None  # one step
    assert damping_of(geometric(-25.0, 0.975, 50)) is None  # unsettled, but 0.25 s are not over
    assert damping_of(geometric(-25.0, 0.975, 53)) == "over"


# -- a whole run -------------------------------------------------------------------------------------------------------


def straight_run(e: Floats, v: Floats) -> Run:
    """The AGV ahead of (0, 0) on the y axis by -e, heading along it, at constant speed of the reference."""
    steps = len(e)
    pose = np.column_stack([np.zeros(steps), -e, np.full(steps, math.pi / 2)])
    reference = np.column_stack([np.zeros((steps, 2)), np.full(steps, math.pi / 2), np.ones(steps), np.zeros(steps)])
    return Run(
        scenario=parse_scenario("controller: {ros__parameters: {kx: 25.0}}", "test"),
        k=steps_of(e),
        pose=pose,
        reference=reference,
        error=np.full((steps, 3), np.nan),
        command=np.column_stack([v, np.zeros(steps)]),
        n_ul=np.zeros(steps, dtype=np.int64),
        lost=np.zeros(steps, dtype=np.bool_),
        downlink_lost=np.zeros(steps, dtype=np.bool_),
    )


def test_global_and_body_errors_are_told_apart() -> None:
    e = geometric(-5.0, 0.875, 500)
    found = convergence(straight_run(e, 1.0 + 25.0 * e))
    assert found.settle_1cm_steps == found.y.settle_1cm_steps == 47
    assert found.settle_2pct_steps == 30
    assert found.overshoot == 0.0
    assert found.x_e.initial == pytest.approx(-5.0)  # the AGV looks along y: the error is along it
    assert found.y_e.peak < 1e-12
    assert found.theta_e.peak == 0.0
    assert found.position.initial == 5.0
    assert found.position.settle_1cm_steps == 47
    assert found.damping == "critical"


def test_one_step_is_a_run_and_none_is_not() -> None:
    found = convergence(straight_run(np.array([-5.0]), np.array([-124.0])))
    assert (found.settle_1cm_steps, found.overshoot, found.damping) == (None, 0.0, None)
    assert found.y.iae == pytest.approx(5.0 * TS)
    with pytest.raises(UserError, match="simulation: no step"):
        convergence(straight_run(np.zeros(0), np.zeros(0)))
