"""Maps of margins and best gains against dense eigenproblems, explicit bursts and searches by hand."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from agv_analysis.link.markov_channel import Chain, bernoulli, gilbert_elliott
from agv_analysis.scenario import load_scenario
from agv_analysis.stability import joint_spectral_radius
from agv_analysis.stability.almost_sure import exponent_along, sample_losses
from agv_analysis.stability.gains import (
    best_almost_surely,
    best_for_bursts,
    best_for_delay,
    best_in_mean_square,
    best_kx,
    longest_expected_outage,
)
from agv_analysis.stability.linear_loop import kanayama_loop
from agv_analysis.stability.margin_map import margin_map
from agv_analysis.stability.margin_map_points import (
    LIMIT,
    Point,
    largest_delays,
    largest_repeated_burst,
    largest_repeated_bursts,
)
from agv_cloud.parameters import ControllerParameters
from agv_ros.errors import UserError

REPOSITORY = Path(__file__).parents[3]
SCENARIO = load_scenario(str(REPOSITORY / "config/paper.yaml"), ["error_detector.track=line"])
CANONICAL = Point(kx=25.0, ky=1.0, ktheta=2.0, ts=0.005, v=1.0, curvature=0.0)
Floats = NDArray[np.float64]


def point_at_random(random: np.random.Generator) -> Point:
    kx, ky, ktheta = 10.0 ** random.uniform([0.0, -1.0, -0.5], [2.0, 1.0, 1.0])
    return Point(kx, ky, ktheta, 0.02, random.uniform(0.2, 3.0), 0.0)


def step_by_hand(point: Point) -> tuple[Floats, Floats]:
    """F and G of the loop about its reference."""
    phi, step = point.ts * point.v * point.curvature, point.ts * point.v
    turn = np.array([[np.cos(phi), np.sin(phi), 0.0], [-np.sin(phi), np.cos(phi), 0.0], [0.0, 0.0, 1.0]])
    F = turn @ np.array([[1.0, 0.0, 0.0], [0.0, 1.0, step], [0.0, 0.0, 1.0]])
    gain = np.array([[point.ts * point.kx, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, step * point.ky, step * point.ktheta]])
    return F, -turn @ gain


def delayed_radius(point: Point, n: int) -> float:
    """Spectral radius of the whole block companion matrix."""
    F, G = step_by_hand(point)
    lifted = np.eye(3 * (n + 1), k=-3)
    lifted[:3, :3] = F
    lifted[:3, -3:] += G
    return float(np.abs(np.linalg.eigvals(lifted)).max())


def burst_radius(point: Point, n: int) -> float:
    """Spectral radius of a burst of n losses, driven step by step."""
    F, G = step_by_hand(point)
    error = np.eye(3)
    for _ in range(n + 1):
        error = F @ error + G
    return float(np.abs(np.linalg.eigvals(error)).max())


@pytest.mark.parametrize("curvature", [0.0, 0.1])
@pytest.mark.parametrize(("kx", "last"), [(5.0, 62), (25.0, 12), (250.0, 0), (401.0, -1)])
def test_the_canonical_delays(kx: float, last: int, curvature: float) -> None:
    assert largest_delays([CANONICAL._replace(kx=kx, curvature=curvature)]).tolist() == [last]


@pytest.mark.parametrize("curvature", [0.0, 2.0])
def test_delays_on_both_sides_of_the_border(curvature: float) -> None:
    random = np.random.default_rng(4)
    points = [point_at_random(random)._replace(curvature=curvature) for _ in range(60)]
    for point, n in zip(points, largest_delays(points).tolist(), strict=True):
        if n > 40:
            continue  # too large a matrix for a test
        assert n < 0 or delayed_radius(point, n) < 1.0
        assert delayed_radius(point, n + 1) > 1.0 - 1e-9


def test_repeated_bursts_on_both_sides_of_the_border() -> None:
    random = np.random.default_rng(5)
    for _ in range(80):
        point = point_at_random(random)
        n = largest_repeated_burst(point)
        for shorter in range(min(n, 60) + 1):
            assert burst_radius(point, shorter) < 1.0
        if n < 60:
            assert burst_radius(point, n + 1) > 1.0 - 1e-9


def test_repeated_bursts_on_curves_are_those_of_the_loop() -> None:
    """By bursts driven step by step, and by the linear loop of the same point."""
    random = np.random.default_rng(6)
    points = [point_at_random(random)._replace(curvature=float(random.uniform(-3.0, 3.0))) for _ in range(60)]
    points += [CANONICAL._replace(kx=5.0, curvature=curvature) for curvature in (0.0, 0.5, 2.0)]
    found = largest_repeated_bursts(points).tolist()
    for point, n in zip(points, found, strict=True):
        if n < 100:
            assert all(burst_radius(point, shorter) < 1.0 for shorter in range(n + 1))
            assert burst_radius(point, n + 1) > 1.0 - 1e-9
        gains = ControllerParameters(kx=point.kx, ky=point.ky, ktheta=point.ktheta)
        loop = kanayama_loop(np.array([point.v]), np.array([point.v * point.curvature]), gains, point.ts)
        refuted = joint_spectral_radius.first_refuted(loop, 1000)
        assert n == LIMIT if refuted is None else n == refuted - 1
    assert found[-3] == 78
    assert found[-1] < 78


def test_degenerate_points() -> None:
    deadbeat, free, parked = (
        CANONICAL._replace(kx=200.0), CANONICAL._replace(kx=0.0), CANONICAL._replace(v=0.0)
    )  # fmt: skip
    assert largest_delays([deadbeat, free, parked]).tolist() == [0, -1, 12]
    assert [largest_repeated_burst(point) for point in (deadbeat, free, parked)] == [0, -1, 14]
    without = CANONICAL._replace(ky=0.0)
    assert largest_delays([without]).tolist() == [-1]
    assert largest_repeated_burst(without) == -1
    backwards = CANONICAL._replace(v=-1.0)  # the law steers the wrong way
    assert delayed_radius(backwards, 0) > 1.0
    assert largest_delays([backwards]).tolist() == [-1]


def test_a_map_is_its_points() -> None:
    first, second = np.array([5.0, 25.0, 250.0]), np.array([0.0, 0.5])
    found = margin_map(SCENARIO, ("kx", "curvature"), first, second)
    expected = [
        largest_delays([CANONICAL._replace(kx=float(kx), curvature=float(c)) for c in second]).tolist() for kx in first
    ]
    assert found.margins["n_lifted"].tolist() == expected
    assert found.margins["n_bursts"].tolist() == [[78, 78], [14, 14], [0, 0]]


@pytest.mark.parametrize(("axes", "said"), [(("kx", "mass"), "no axis 'mass'"), (("kx", "kx"), "two different axes")])
def test_a_map_without_sense(axes: tuple[str, str], said: str) -> None:
    with pytest.raises(UserError, match=said):
        margin_map(SCENARIO, axes, np.ones(2), np.ones(2))


def test_the_command_writes_the_map(agv_ncs: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    table, picture = tmp_path / "map.csv", tmp_path / "map.png"
    status, said = agv_ncs(
        "stability", "config/paper.yaml", "--map", "ts,kx", "--points", "5", "--csv", table, "--picture", picture
    )
    assert status == 0, said
    rows = list(csv.DictReader(table.open(encoding="utf-8")))
    assert len(rows) == 25
    middle = rows[12]
    assert float(middle["kx"]) == pytest.approx(25.0)
    assert (middle["n_lifted"], middle["n_bursts"]) == ("12", "14")
    assert picture.read_bytes().startswith(b"\x89PNG")
    status, said = agv_ncs("stability", "config/paper.yaml", "--map", "kx")
    assert status == 1
    assert "two axes" in said


# -- best gains ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [0, 1, 3, 8])
def test_the_best_gain_for_a_delay(n: int) -> None:
    def radius(a: float) -> float:
        return float(np.abs(np.roots([1.0, -1.0, *[0.0] * (n - 1), a] if n else [1.0, a - 1.0])).max())

    best = best_for_delay(n)
    assert radius(best) == pytest.approx(n / (n + 1), abs=1e-6)
    assert all(radius(a) >= radius(best) - 1e-6 for a in np.linspace(0.01, 1.2, 400))


def test_the_best_gain_for_bursts() -> None:
    best, rate = best_for_bursts(5)
    # The shortest burst is the slowest to converge, the longest overshoots most: at the best they are equal.
    assert 1.0 - best == pytest.approx(rate, abs=1e-5)
    assert abs(1.0 - 6.0 * best) ** (1.0 / 6.0) == pytest.approx(rate, abs=1e-4)
    assert best_for_bursts(0) == pytest.approx((1.0, 0.0), abs=1e-5)


def second_moment_rate(a: float, p: float) -> float:
    """Rate of E[e^2] under independent losses, written out: moments (e^2, e h, h^2) of the error and the held one."""
    lost = np.array([[1.0, -2.0 * a, a * a], [0.0, 1.0, -a], [0.0, 0.0, 1.0]])
    received = np.array([[(1.0 - a) ** 2, 0.0, 0.0], [1.0 - a, 0.0, 0.0], [1.0, 0.0, 0.0]])
    return float(np.abs(np.linalg.eigvals((1.0 - p) * received + p * lost)).max())


@pytest.mark.parametrize("p", [0.05, 0.3, 0.8])
def test_the_best_gain_in_mean_square(p: float) -> None:
    best, rate = best_in_mean_square(bernoulli(p))
    assert rate == pytest.approx(second_moment_rate(best, p), abs=1e-9)
    assert all(second_moment_rate(a, p) >= rate - 1e-9 for a in np.linspace(0.001, 1.99, 500))


@pytest.mark.parametrize("chain", [bernoulli(0.0), bernoulli(0.3), bernoulli(0.9), gilbert_elliott(0.02, 0.05)])
def test_the_best_gain_almost_surely(chain: Chain) -> None:
    """Against the exponent of many gains within the tolerance, none of which is at a singular point."""

    def averaged(a: float) -> float:
        cells = 4000
        within = a * (0.9 + 0.2 * (np.arange(cells) + 0.5) / cells)
        probabilities = chain.burst_lengths()
        lengths = np.arange(1, len(probabilities) + 1)
        logs = [float(np.log(np.abs(1.0 - within * length)).mean()) for length in lengths]
        return float(probabilities @ logs / (probabilities @ lengths))

    best, rate = best_almost_surely(chain)
    assert math.isfinite(rate)
    assert rate == pytest.approx(averaged(best), abs=2e-3)
    assert all(averaged(float(a)) >= rate - 2e-3 for a in np.geomspace(0.002, 2.0, 80))


def test_the_exponent_itself_has_no_best_gain() -> None:
    """At 1/a = 1, 2, 3 it is -inf, and no finite exponent is below that."""
    assert [exponent_along(1.0 / length, bernoulli(0.3)) for length in (1, 2, 3)] == [-math.inf] * 3
    assert math.isfinite(best_almost_surely(bernoulli(0.3))[1])


def test_best_gains_in_their_units() -> None:
    found = {name: choice.kx for name, choice in best_kx(gilbert_elliott(0.02, 0.2), 0.005, 20_000).items()}
    assert found["no_outages"] == pytest.approx(200.0)
    assert found["delay"] == pytest.approx(200.0 * 5**5 / 6**6)
    assert found["bursts"] is not None
    assert found["mean_square"] is not None
    assert found["bursts"] < found["mean_square"] < 200.0


def test_without_losses_no_gain_is_best_for_outages() -> None:
    found = best_kx(bernoulli(0.0), 0.005, 20_000)
    assert found["mean_square"].kx == pytest.approx(200.0, rel=1e-4)
    assert found["bursts"].kx is None
    assert "loses nothing" in found["bursts"].words


@pytest.mark.parametrize("chain", [bernoulli(0.3), bernoulli(0.95), gilbert_elliott(0.02, 0.2)])
def test_what_a_best_gain_costs(chain: Chain) -> None:
    """Mean square along: E[L^2] / E[L] < 2 / a; outages of n slots, again and again: |1 - a (n + 1)| < 1."""
    lengths = np.arange(1, len(chain.burst_lengths()) + 1)
    ratio = float(chain.burst_lengths() @ lengths**2 / (chain.burst_lengths() @ lengths))
    for choice in best_kx(chain, 0.005, 20_000).values():
        assert choice.kx is not None
        a = 0.005 * choice.kx
        assert choice.is_usable == (ratio < 2.0 / a)
        assert ("not recommended" in choice.words) == (not choice.is_usable)
        assert abs(1.0 - a * (choice.survives + 1)) < 1.0 <= abs(1.0 - a * (choice.survives + 2)) + 1e-9
    assert best_kx(chain, 0.005, 20_000)["mean_square"].is_usable


@pytest.mark.parametrize("chain", [bernoulli(0.3), gilbert_elliott(0.02, 0.2)])
def test_the_gain_for_bursts_survives_the_longest_of_a_run(chain: Chain) -> None:
    """In 400 runs drawn here no more than about 5 % have a longer outage than it survives, and some come close."""
    n = longest_expected_outage(chain, 2000)
    assert n is not None
    assert best_kx(chain, 0.005, 2000)["bursts"].survives >= n
    longest = []
    for seed in range(400):
        lost = sample_losses(chain, 2000, seed)
        ends = np.flatnonzero(~np.append(np.insert(lost, 0, False), False))
        longest.append(int(np.diff(ends).max()) - 1)
    share = float(np.mean(np.array(longest) > n))
    assert share < 0.09
    assert float(np.mean(np.array(longest) > n - 2)) > 0.02


def test_outages_without_losses_and_without_end() -> None:
    assert longest_expected_outage(bernoulli(0.0), 1000) == 0
    assert longest_expected_outage(Chain(np.roll(np.eye(4), 1, axis=1), np.eye(4)[0]), 1000) == 3
    assert longest_expected_outage(bernoulli(1.0 - 1e-7), 10**9) is None
