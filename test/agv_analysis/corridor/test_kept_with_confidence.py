"""The narrowest corridor and the largest speed that laps keep, against quantiles that are known and against theory."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agv_analysis.corridor.kept_with_confidence import kept_with_confidence, quantile
from agv_ros.errors import UserError
from test.agv_analysis.corridor.test_single_outage import on_a_line, scenario


@pytest.mark.parametrize("share", [0.5, 0.95])
def test_intervals_of_quantiles_hold_them_as_often_as_they_say(share: float) -> None:
    rng, hits = np.random.default_rng(1), 0
    for _ in range(200):
        found = quantile(rng.random(200), share)
        hits += found.low <= share <= found.high
        assert found.low <= found.value <= found.high
    assert 184 <= hits <= 199


def test_the_narrowest_corridor_and_the_largest_speed_go_together() -> None:
    """On a line the deviation goes with the speed: both differ by the same factor from what is asked."""
    chosen = scenario("error_detector.track=line", "error_detector.corridor=0.25", lap=4.0)
    found = kept_with_confidence(chosen, 0.8, laps=60)
    assert found.speed is not None
    assert found.width.low <= found.width.value <= found.width.high
    assert found.speed == pytest.approx(0.25 / found.width.value, rel=0.06)  # bisected to a factor of 16^(2/128)


def test_what_hardly_any_lap_shows_is_found_by_splitting(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a line: the length of the outages of which one comes in 1e5 laps, and how far one of them leads."""
    chosen = scenario("error_detector.track=line", "error_detector.corridor=0.25", lap=4.0)
    monkeypatch.setattr("agv_analysis.corridor.kept_with_confidence._STEPS", 0)  # the speed alone takes a minute
    found = kept_with_confidence(chosen, 1.0 - 1e-5)
    longest = 1.0 + math.log(1e-5 / 800 / (0.02 * 0.2 / 0.22)) / math.log(0.8)
    assert found.width.value == pytest.approx(on_a_line(1) * longest * (longest + 1.0) / 2.0, rel=0.1)
    assert found.width.low <= found.width.value <= found.width.high <= 1.2 * found.width.low
    assert found.laps is None


def test_what_cannot_be_asked_is_refused() -> None:
    for settings, confidence in (([], 0.9), (["error_detector.corridor=0.1", "relay.uplink.delay=0.01"], 0.999)):
        with pytest.raises(UserError, match=r"corridor|confidence"):
            kept_with_confidence(scenario(*settings), confidence, laps=5)
    of_paper = kept_with_confidence(scenario("error_detector.corridor=0.1", lap=4.0), 0.5, laps=5)
    assert "speeds of its own" in of_paper.speed_reason
