"""What is of second order in an outage: bounds that no state of a tube exceeds, and the tubes that cover it."""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext

import numpy as np
import pytest

from agv_analysis.corridor.biases import biases
from agv_analysis.corridor.lap_loop import LapLoop, outage
from agv_analysis.corridor.outer_tube import LONG, Tube
from agv_analysis.corridor.second_order import measured_remainder, nonlinear_tube, proved_remainder
from agv_analysis.run import Floats
from agv_analysis.stability.derivatives.interval import NoBoundsError
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.reception_maps import burst_maps
from test.agv_analysis.corridor.test_outer_tube import tube_of

PARTS = 200
LOOPS = {
    "hold": (12, ["error_detector.lap_time=40.0"]),
    "hold on a figure of eight": (12, ["error_detector.track=eight", "error_detector.lap_time=60.0"]),
    "predict": (30, ["error_detector.policy=predict", "plant.speed_scale=1.1", "error_detector.lap_time=40.0"]),
    "align": (12, ["error_detector.policy=align", "error_detector.lap_time=40.0", "plant.speed_scale=0.9"]),
    "another law": (
        12, ["controller.law=state_feedback", "controller.state_feedback.kx=20.0", "error_detector.lap_time=40.0"],
    ),
}  # fmt: skip


def largest_difference(loop: LapLoop, linear: LinearLoop, tube: Tube, rng: np.random.Generator) -> Floats:
    """|Phi_i(z) - Phi_i(0) - M_i z| at random states of a tube, one from every seventh step of the lap.

    By the simulation and numpy; shape (S, n + 2, 3).
    """
    every, length = 7, tube.n + 2
    steps = np.arange(0, loop.steps, every)
    bounds, quarter = tube.bounds[steps % len(tube.bounds)], tube.template.quarter
    pairs = (0, 1, 1.0), (2, 2 + 2 * quarter, 1.0), (2 + quarter, 2 + 3 * quarter, tube.template.lever)
    share = rng.uniform(0.0, 1.0, (3, len(steps)))
    x, y, theta = (
        (bounds[:, one] * s - bounds[:, other] * (1.0 - s)) / unit
        for (one, other, unit), s in zip(pairs, share, strict=True)
    )
    cos, sin = np.cos(theta), np.sin(theta)
    displaced = np.column_stack((-cos * x - sin * y, sin * x - cos * y, -theta))
    _, paths = loop.excursions(outage(tube.n), every, offsets=displaced, kept=length, follow=False)
    _, of_none = loop.excursions(outage(tube.n), every, kept=length, follow=False)
    z = paths[:, 0] - of_none[:, 0]
    found = np.zeros((len(steps), length, 3))
    for i, M in enumerate(burst_maps(linear, length - 1, steps % len(linear.F)), start=1):
        found[:, i] = np.abs(paths[:, i] - of_none[:, i] - np.einsum("sjk,sk->sj", M, z))
    return found


@pytest.mark.parametrize("kind", LOOPS)
def test_no_state_of_a_tube_has_more_than_the_bound(kind: str) -> None:
    n, settings = LOOPS[kind]
    loop, linear, tube = tube_of(n, *settings, half_width=1.0)
    bound = proved_remainder(loop, linear, tube, biases(loop, linear, n), PARTS)
    rng = np.random.default_rng(5)
    part = np.arange(0, loop.steps, 7) * PARTS // loop.steps
    nearest = 0.0
    for _ in range(20):
        found = largest_difference(loop, linear, tube, rng)
        assert (found <= bound[part] + 1e-12).all()
        nearest = max(nearest, float((found / (bound[part] + 1e-9)).max()))
    assert nearest > (0.05 if bound.max() > 1e-6 else 0.0)  # the bound is not that of something else


def test_the_bound_shrinks_with_the_square_of_the_tube() -> None:
    loop, linear, tube = tube_of(12, "error_detector.lap_time=40.0", half_width=1.0)
    bias = biases(loop, linear, 12)
    whole, half = (
        proved_remainder(loop, linear, dataclasses.replace(tube, bounds=share * tube.bounds), bias, PARTS)
        for share in (1.0, 1e-3)
    )
    # Bilinear in the state and the bias of the outage, which does not shrink, and quadratic in the state.
    assert 0.0 < half.max() <= 1e-3 * whole.max()


@pytest.mark.parametrize("kind", LOOPS)
def test_the_tube_of_the_nonlinear_loop_is_proved_and_hardly_wider(kind: str) -> None:
    n, settings = LOOPS[kind]
    loop, linear, tube = tube_of(n, *settings, half_width=1.0)
    found = nonlinear_tube(loop, linear, tube)
    assert found is not None
    assert found.is_proved
    assert tube.deviation <= found.tube.deviation <= 1.15 * tube.deviation + 1e-5


def test_where_a_branch_is_open_it_is_measured() -> None:
    settings = "error_detector.lap_time=40.0", "plant.integration=arc"  # whose step has another form for small w
    loop, linear, tube = tube_of(12, *settings, half_width=1.0)
    with pytest.raises(NoBoundsError):
        proved_remainder(loop, linear, tube, biases(loop, linear, 12), PARTS)
    found = nonlinear_tube(loop, linear, tube)
    assert found is not None
    assert not found.is_proved
    assert measured_remainder(loop, linear, tube, biases(loop, linear, 12), PARTS).max() > 0.0


def test_a_limit_that_the_tube_reaches_is_no_linear_loop() -> None:
    """Within the limit there is a bound, at the limit none."""
    usual = "error_detector.lap_time=40.0", "error_detector.policy=align"
    fastest = float(tube_of(12, *usual)[0].lap[:, 3].max())
    for v_max, has_bound in ((2.0 * fastest, True), (1.01 * fastest, False)):
        loop, linear, tube = tube_of(12, *usual, f"controller.v_max={v_max}", half_width=1.0)
        wider = dataclasses.replace(tube, bounds=tube.bounds + 0.01)  # 25 / s times 0.01 m beyond the reference's speed
        with nullcontext() if has_bound else pytest.raises(NoBoundsError):
            proved_remainder(loop, linear, wider, biases(loop, linear, 12), PARTS)


def test_near_the_border_of_the_corridor_fewer_slots_are_proved() -> None:
    settings = "error_detector.lap_time=40.0"
    _, _, wide = tube_of(12, settings, half_width=1.0)
    loop, linear, tube = tube_of(12, settings, half_width=wide.deviation + 1e-6)
    found = nonlinear_tube(loop, linear, tube)
    assert found is not None
    assert found.is_proved
    assert found.tube.n == 11


def test_long_outages_have_none() -> None:
    settings = "error_detector.policy=predict", "plant.speed_scale=1.05", "error_detector.lap_time=40.0"
    loop, linear, tube = tube_of(LONG + 1, *settings)
    assert nonlinear_tube(loop, linear, tube) is None
