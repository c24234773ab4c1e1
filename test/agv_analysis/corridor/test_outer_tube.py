"""The tube that no sequence of outages leaves, against intervals on a line and against the nonlinear loop itself."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agv_analysis.corridor.lap_loop import LapLoop, Outcomes
from agv_analysis.corridor.outage_sequences import worst_sequence
from agv_analysis.corridor.outer_tube import LONG, Tube, largest_n, outer_tube
from agv_analysis.corridor.second_order import nonlinear_tube
from agv_analysis.corridor.widths import Widths
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.scenario_loop import loop_on_lap
from test.agv_analysis.corridor.test_single_outage import TS, A, on_a_line, scenario


def of(half_width: float, *settings: str, lap: float = 10.0) -> tuple[LapLoop, LinearLoop]:
    chosen = scenario(*settings, lap=lap)
    return LapLoop(chosen, Widths(half_width, math.inf, math.inf)), loop_on_lap(chosen)


def tube_of(n: int, *settings: str, lap: float = 10.0, half_width: float = 2.0) -> tuple[LapLoop, LinearLoop, Tube]:
    loop, linear = of(half_width, *settings, lap=lap)
    found = outer_tube(loop, linear, n)
    assert found is not None
    return loop, linear, found


def interval_on_a_line(n: int, kx: float, speed: float) -> tuple[float, float]:
    """Smallest interval of x_e that holds 0 and with each error all that outages make of it, by going on to the end."""
    a, low, high = TS * kx, 0.0, 0.0
    for _ in range(5000):
        ends = [((1.0 - a * i) * e - a * speed * TS * i * (i - 1) / 2) for i in range(1, n + 2) for e in (low, high)]
        low, high = min(low, *ends), max(high, *ends)
    return low, high


@pytest.mark.parametrize(("n", "kx", "speed"), [(14, 25.0, 1.0), (5, 60.0, 1.7), (73, 5.0, 0.5)])
def test_along_a_line_it_is_the_smallest_interval(n: int, kx: float, speed: float) -> None:
    settings = f"controller.kx={kx}", f"error_detector.speed={speed}", "error_detector.track=line"
    _, _, found = tube_of(n, *settings)
    low, high = interval_on_a_line(n, kx, speed)
    assert found.bounds[:, 0].max() == pytest.approx(high, rel=1e-4, abs=1e-6)
    assert found.bounds[:, 1].max() == pytest.approx(-low, rel=1e-4)
    assert found.deviation == pytest.approx(max(high, -low), rel=1e-4)


def random_outcomes(rng: np.random.Generator, n: int, steps: int) -> Outcomes:
    """Outages of up to n slots, many of them of n or of none."""
    lengths = rng.choice([0, n, n - 1, *range(n)], size=steps)
    return np.concatenate([np.arange(length + 1) > 0 for length in lengths])[:steps]


@pytest.mark.parametrize(
    ("n", "settings"),
    [
        (14, ["error_detector.lap_time=40.0"]),
        (12, ["error_detector.track=eight", "error_detector.lap_time=60.0"]),
        (30, ["error_detector.policy=predict", "plant.speed_scale=1.1", "error_detector.lap_time=40.0"]),
    ],
    ids=["hold", "eight", "predict"],
)
def test_the_nonlinear_loop_stays_in_it(n: int, settings: list[str]) -> None:
    loop, linear, found = tube_of(n, *settings, half_width=1.0)
    nonlinear = nonlinear_tube(loop, linear, found)
    assert nonlinear is not None
    assert nonlinear.is_proved
    assert nonlinear.tube.n == n
    assert nonlinear.tube.deviation >= found.deviation
    rng = np.random.default_rng(1)
    sequences = [random_outcomes(rng, n, 500) for _ in range(12)]
    worst = worst_sequence(loop, n, sequences)
    assert worst.deviation <= nonlinear.tube.deviation <= 1.3 * worst.deviation


def test_what_is_proved_is_never_more_than_what_is_refuted() -> None:
    loop, linear = of(on_a_line(9) + 1e-6, "error_detector.track=line")
    n, found = largest_n(loop, linear, 14)
    assert n == 9  # nothing leads farther than the longest outage alone, see the interval
    assert found is not None
    assert found.largest_share <= 1.0
    assert interval_on_a_line(9, A / TS, 1.0)[0] == pytest.approx(-on_a_line(9))


def test_outages_that_let_errors_grow_have_no_tube() -> None:
    loop, linear = of(1.0, "error_detector.track=line")
    assert outer_tube(loop, linear, 16) is None


def test_fewer_receptions_leave_a_tube_that_is_hardly_narrower_and_the_largest_n_is_that_of_all() -> None:
    loop, linear = of(0.1, "error_detector.policy=predict", "plant.speed_scale=1.1", "error_detector.track=line")
    n, found = largest_n(loop, linear, 300)
    assert found is not None
    assert LONG < n < 300
    assert found.largest_share <= 1.0
    wider, few = outer_tube(loop, linear, n + n // 50 + 1), outer_tube(loop, linear, n, apart=5)
    assert wider is None or wider.largest_share > 1.0
    assert few is not None
    assert 0.95 * found.largest_share < few.largest_share <= found.largest_share


def test_behind_an_exact_predictor_there_is_nothing_to_bound() -> None:
    loop, linear = of(0.01, "error_detector.policy=predict")
    n, found = largest_n(loop, linear, 400)
    assert (n, found is not None) == (400, True)
