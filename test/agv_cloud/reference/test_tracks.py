"""Reference tracks: they close, have the size that they are said to have, and stop and turn where they should."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.special import j0

from agv_cloud.reference.tracks import J0_FIRST_ZERO, TRACKS, circle, eight, line, paper, warehouse

TS, N = 0.005, 20_000
LAPS = [16, 17, 27, 28, 39, 100, 101, 777, 1000, 1001, 4999, 20_000, 20_001]
CLOSED = [name for name in TRACKS if name != "line"]

Floats = NDArray[np.float64]


def speeds(name: str, n: int = N, ts: float = TS, speed: float = 1.0) -> Floats:
    """v_r and w_r of one lap, shape (n, 2)."""
    return np.array([TRACKS[name](k, n, ts, speed) for k in range(n)])


def driven(vw: Floats, ts: float = TS, heading: float = 0.0) -> Floats:
    """Postures of a lap by Euler's recursion as sums, shape (n + 1, 3)."""
    theta = heading + np.concatenate([[0.0], np.cumsum(ts * vw[:, 1])])
    steps = ts * vw[:, 0] * np.exp(1j * theta[:-1])
    z = np.concatenate([[0.0], np.cumsum(steps)])
    return np.column_stack([z.real, z.imag, theta])


@pytest.mark.parametrize("n", LAPS)
@pytest.mark.parametrize("name", CLOSED)
def test_a_lap_closes(name: str, n: int) -> None:
    end = driven(speeds(name, n))[-1]
    # The sums of the paper's oval converge faster than any power of n, but 17 samples are only so many.
    assert math.hypot(end[0], end[1]) < (1e-9 if n > 20 else 1e-7)
    turns = 0.0 if name == "eight" else 1.0
    assert end[2] == pytest.approx(2.0 * math.pi * turns, abs=1e-9)


@pytest.mark.parametrize("n", LAPS)
@pytest.mark.parametrize("name", TRACKS)
def test_laps_repeat(name: str, n: int) -> None:
    track = TRACKS[name]
    for k in {0, 1, n // 3, n // 2, n - 1}:
        for lap in (1, 2, 7):
            assert track(k + lap * n, n, TS, 1.0) == pytest.approx(track(k, n, TS, 1.0), abs=1e-9)


@pytest.mark.parametrize("name", TRACKS)
def test_speeds_are_finite_and_forward_at_every_step(name: str) -> None:
    vw = speeds(name)
    assert np.isfinite(vw).all()
    assert vw[:, 0].min() >= 0.0


@pytest.mark.parametrize("name", [name for name in TRACKS if name != "paper"])
def test_speed_scales_the_size_and_not_the_shape(name: str) -> None:
    slow, fast = driven(speeds(name, 1001)), driven(speeds(name, 1001, speed=2.5))
    assert fast[:, :2] == pytest.approx(2.5 * slow[:, :2], abs=1e-12)
    assert (fast[:, 2] == slow[:, 2]).all()


@pytest.mark.parametrize("name", CLOSED)
@pytest.mark.parametrize("ts", [1e-4, 0.1])
def test_the_period_does_not_change_where_a_lap_ends(name: str, ts: float) -> None:
    assert abs(driven(speeds(name, 1000, ts), ts)[-1, :2]).max() < 1e-9


# -- paper -----------------------------------------------------------------------------------------------------------


def test_the_paper_s_track_has_its_length_and_size() -> None:
    path = driven(speeds("paper"), heading=math.pi / 2)
    assert TS * speeds("paper")[:, 0].sum() == pytest.approx(100.0, abs=1e-9)
    width, height = np.ptp(path[:, :2], axis=0)
    # By a midpoint sum of two million terms over the continuous track.
    assert (width, height) == pytest.approx((18.07, 42.45), abs=0.005)


def test_the_paper_s_speeds_lie_in_the_range_of_its_figure() -> None:
    vw = speeds("paper")
    assert (vw[:, 0].min(), vw[:, 0].max()) == pytest.approx((0.5, 1.5), abs=1e-7)
    assert paper(0, N, TS, 1.0) == (0.5, 0.0)
    assert vw[:, 1].mean() * N * TS == pytest.approx(2.0 * math.pi, abs=1e-12)


def test_the_paper_s_track_is_the_one_in_continuous_time_to_a_centimetre() -> None:
    T = N * TS
    exact = solve_ivp(
        lambda t, X: (
            (1.0 - 0.5 * math.cos(8.0 * math.pi * t / T)) * math.cos(X[2]),
            (1.0 - 0.5 * math.cos(8.0 * math.pi * t / T)) * math.sin(X[2]),
            2.0 * math.pi / T * (1.0 - math.cos(4.0 * math.pi * t / T)),
        ),
        (0.0, T), (0.0, 0.0, math.pi / 2), method="DOP853", rtol=1e-12, atol=1e-12, t_eval=np.linspace(0.0, T, 101),
    ).y.T  # fmt: skip
    path = driven(speeds("paper"), heading=math.pi / 2)[:: N // 100]
    apart = np.hypot(*(path - exact)[:, :2].T).max()
    assert 1e-5 < apart < 1e-2


# -- line, circle, eight ---------------------------------------------------------------------------------------------


def test_a_line_is_straight() -> None:
    assert {line(k, N, TS, 2.0) for k in (0, 1, N, 5 * N)} == {(2.0, 0.0)}


def test_a_circle_has_its_radius() -> None:
    path = driven(speeds("circle"))
    radius = N * TS / (2.0 * math.pi)
    assert np.ptp(path[:, 0]) == pytest.approx(2.0 * radius, rel=1e-6)
    assert circle(123, N, TS, 3.0) == (3.0, 2.0 * math.pi / (N * TS))


def test_the_first_zero_of_bessel_s_function() -> None:
    assert brentq(j0, 2.0, 3.0, xtol=1e-15) == pytest.approx(J0_FIRST_ZERO, abs=1e-14)


def test_an_eight_turns_both_ways_and_crosses_itself_once() -> None:
    path = driven(speeds("eight", 2000), heading=0.0)
    w = speeds("eight", 2000)[:, 1]
    assert (np.diff(np.sign(w)) != 0).sum() == 2
    assert np.ptp(path[:, 2]) == pytest.approx(2.0 * J0_FIRST_ZERO, rel=1e-5)
    z = path[::10, 0] + 1j * path[::10, 1]
    assert crossings(z) == 1


def crossings(z: NDArray[np.complex128]) -> int:
    """How often the closed polygon of these points crosses itself, by trying every pair of sides."""
    sides = list(pairwise(z))
    count = 0
    for i, (a, b) in enumerate(sides):
        for c, d in sides[i + 2 : len(sides) - (i == 0)]:
            count += bool(side(a, b, c) * side(a, b, d) < 0.0 and side(c, d, a) * side(c, d, b) < 0.0)
    return count


def side(a: complex, b: complex, c: complex) -> float:
    return float(((b - a).conjugate() * (c - a)).imag)


@pytest.mark.parametrize("name", ["paper", "circle", "warehouse"])
def test_the_other_closed_tracks_do_not_cross_themselves(name: str) -> None:
    path = driven(speeds(name, 2000))[::10]
    assert crossings(path[:, 0] + 1j * path[:, 1]) == 0


# -- warehouse -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1000, 1001, 20_000, 20_001])
def test_a_warehouse_has_two_full_stops_half_a_lap_apart_on_its_straights(n: int) -> None:
    vw = speeds("warehouse", n)
    stopped = vw[:, 0] == 0.0
    assert (vw[stopped, 1] == 0.0).all()
    begins = np.flatnonzero(stopped & ~np.roll(stopped, 1))
    assert len(begins) == 2
    assert abs(begins[1] - begins[0] - n / 2) <= 1.0
    # 10 % of an aisle of 40 % of half a lap.
    assert stopped.sum() == pytest.approx(0.1 * 0.4 * n, abs=4.0)


@pytest.mark.parametrize("n", [16, 28, 99, 1000, 1001, 20_000])
def test_a_warehouse_has_four_right_angles(n: int) -> None:
    vw = speeds("warehouse", n)
    assert vw[:, 1].min() == 0.0
    turning = vw[:, 1] > 0.0
    begins = np.flatnonzero(turning & ~np.roll(turning, 1))
    ends = np.flatnonzero(turning & ~np.roll(turning, -1)) + 1
    assert len(begins) == len(ends) == 4
    for begin, end in zip(begins, ends, strict=True):
        assert TS * vw[begin:end, 1].sum() == pytest.approx(math.pi / 2, abs=1e-12)


def test_a_warehouse_s_corners_are_clothoids() -> None:
    vw = speeds("warehouse")
    w = vw[vw[:, 1] > 0.0][: int(0.15 * N / 2), 1]
    slope = np.diff(w)
    middle = len(slope) // 2
    assert slope[: middle - 1] == pytest.approx(slope[0], rel=1e-6)
    assert slope[middle + 1 :] == pytest.approx(-slope[0], rel=1e-6)
    assert w == pytest.approx(w[::-1], rel=1e-9)
    assert (vw[vw[:, 1] > 0.0, 0] == 1.0).all()


def test_a_warehouse_is_a_rectangle_of_which_one_side_is_the_aisle() -> None:
    path = driven(speeds("warehouse"))
    straight = speeds("warehouse")[:, 1] == 0.0
    headings = np.round(path[:-1, 2][straight] / (math.pi / 2), 9)
    assert set(headings % 4.0) == {0.0, 1.0, 2.0, 3.0}
    assert warehouse(0, N, TS, 1.0) == (1.0, 0.0)


def test_a_warehouse_brakes_without_jerks() -> None:
    v = speeds("warehouse")[:, 0]
    acceleration = np.diff(v) / TS
    # Half a cosine from 1 m/s to 0 within a tenth of the aisle of 20 s: at most pi / (2 * 2 s).
    assert abs(acceleration).max() == pytest.approx(math.pi / 4.0, rel=1e-3)
    assert abs(np.diff(acceleration)).max() / TS < 1.5


def test_an_eight_s_rate_is_that_of_its_closed_form() -> None:
    # theta(k) - theta(0) = j01 [sin(2 pi (k - 1/2) / N) + sin(pi / N)]: the sum of cosines.
    for n in (16, 101, 2000):
        theta = driven(speeds("eight", n))[:, 2]
        k = np.arange(n + 1)
        expected = J0_FIRST_ZERO * (np.sin(2.0 * np.pi * (k - 0.5) / n) + math.sin(math.pi / n))
        assert theta == pytest.approx(expected, abs=1e-9)
    assert eight(0, 100, TS, 1.0)[1] == pytest.approx(2.0 * J0_FIRST_ZERO * math.sin(math.pi / 100) / TS)
