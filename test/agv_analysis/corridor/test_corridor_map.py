"""A map's closed forms against the answers of single scenarios."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agv_analysis.corridor.corridor_map import N_ANY, P_HOUR, best_point, with_corridor
from agv_analysis.corridor.lap_loop import LapLoop
from agv_analysis.corridor.single_outage import single_outage
from agv_analysis.corridor.widths import Widths
from agv_analysis.stability.margin_map import margin_map
from agv_ros.errors import UserError
from test.agv_analysis.corridor.test_single_outage import scenario

CHOSEN = ["error_detector.track=line", "error_detector.corridor=0.1"]


def test_points_say_what_single_scenarios_say() -> None:
    base, gains, speeds = scenario(*CHOSEN), [5.0, 25.0], [0.5, 2.0]
    found = with_corridor(margin_map(base, ("kx", "v"), np.array(gains), np.array(speeds)), base)
    assert found.margins[N_ANY].shape == (2, 2)
    for i, kx in enumerate(gains):
        for j, v in enumerate(speeds):
            alone = scenario(*CHOSEN, f"controller.kx={kx}", f"error_detector.speed={v}")
            n = single_outage(LapLoop(alone, Widths(0.1, math.inf, math.inf))).n
            assert n is not None
            assert found.margins[N_ANY][i, j] == min(n, found.margins["n_bursts"][i, j])
            rate = 0.02 * 0.2 / 0.22 * 0.8**n  # of outages that are longer
            assert found.margins[P_HOUR][i, j] == pytest.approx(-math.expm1(-rate * 720_000))


def test_the_best_point_is_named() -> None:
    base, gains, periods = scenario(*CHOSEN), np.array([5.0, 25.0, 100.0]), np.array([0.005, 0.02])
    found = with_corridor(margin_map(base, ("kx", "ts"), gains, periods), base)
    row, column = divmod(int(np.argmin(found.margins[P_HOUR])), 2)
    said = best_point(found)
    assert f"kx = {gains[row]:.4g} 1/s, " in said
    assert (
        f"ts = {periods[column]:.4g} s: stays inside in any outages of up to {found.margins[N_ANY][row, column]} slots"
        in said
    )
    assert best_point(margin_map(base, ("kx", "ts"), gains, periods)) == ""
    small = with_corridor(margin_map(base, ("kx", "ts"), np.array([0.5]), np.array([0.0005])), base)
    assert 0.0 < small.margins[P_HOUR].item() < 1e-12
    assert best_point(small).endswith("leaves in an hour with a probability below 1e-12")


def test_without_a_closed_form_each_point_is_driven() -> None:
    """Along a line the plant that integrates along the arc is Euler's, but for the margins it has no closed form."""
    gains, speeds = np.array([5.0, 25.0]), np.array([0.5, 2.0])
    closed, driven = (
        with_corridor(margin_map(base, ("kx", "v"), gains, speeds), base).margins[N_ANY]
        for base in (scenario(*CHOSEN), scenario(*CHOSEN, "plant.integration=arc"))
    )
    np.testing.assert_array_equal(driven, closed)


def test_behind_a_predictor_an_outage_leads_as_far_as_the_model_errs() -> None:
    """delta v T_s n, nearly, while the AGV is told to drive at v but drives at (1 + delta) v."""
    base = scenario(*CHOSEN, "error_detector.policy=predict", "plant.speed_scale=1.1")
    found = with_corridor(margin_map(base, ("v", "curvature"), np.array([2.0]), np.array([0.0, 0.1])), base)
    speed = "error_detector.speed=2.0"
    alone = scenario(*CHOSEN, "error_detector.policy=predict", "plant.speed_scale=1.1", speed)
    straight, curved = found.margins[N_ANY][0].tolist()
    assert straight == single_outage(LapLoop(alone, Widths(0.1, math.inf, math.inf))).n
    assert straight == pytest.approx(0.1 / (0.1 * 2.0 * 0.005), rel=0.1)
    assert abs(curved - straight) < 20
    assert (found.margins[P_HOUR] < 1e-5).all()


def test_late_messages_are_refused_and_no_corridor_changes_nothing() -> None:
    some = np.array([5.0, 25.0])
    base = scenario("error_detector.track=line")
    of_margins = margin_map(base, ("kx", "ky"), some, some)
    assert with_corridor(of_margins, base) is of_margins
    with pytest.raises(UserError, match="outages alone"):
        with_corridor(of_margins, scenario(*CHOSEN, "relay.uplink.delay=0.01"))
