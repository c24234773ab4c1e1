"""A map's closed forms against the answers of single scenarios."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agv_analysis.corridor.corridor_map import N_ANY, P_HOUR, with_corridor
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


def test_what_has_no_closed_form_is_refused_and_no_corridor_changes_nothing() -> None:
    some = np.array([5.0, 25.0])
    base = scenario("error_detector.track=line")
    of_margins = margin_map(base, ("kx", "ky"), some, some)
    assert with_corridor(of_margins, base) is of_margins
    with pytest.raises(UserError, match="Kanayama"):
        with_corridor(of_margins, scenario(*CHOSEN, "plant.lag=0.1"))
