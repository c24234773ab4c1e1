"""Borders of stability that are crossed more than once, against dense matrices asked point by point."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.link.markov_channel import Chain, bernoulli, bursty
from agv_analysis.run import Floats
from agv_analysis.scenario import load_scenario
from agv_analysis.stability import floquet, lifted, mean_square
from agv_analysis.stability.first_border import borders, last_stable, not_monotone, spread, stable_again
from agv_analysis.stability.linear_loop import LinearLoop, kanayama_loop
from agv_analysis.stability.margins import margins
from agv_cloud.parameters import ControllerParameters

PAPER = str(Path(__file__).parents[3] / "config/paper.yaml")

# Gains, true over commanded speed, v, w of loops that turn stable again beyond their first border.
PREDICTED = [
    (38.32, 0.938, 0.554, 2.22, 2.722, 1.241),
    (152.255, 1.413, 7.31, 1.593, 2.741, 3.143),
    (80.219, 5.843, 0.931, 1.678, 0.261, 3.379),
]
HELD = (15.992, 0.167, 18.514, 1.8, 0.231, 3.091)


def loop_of(numbers: tuple[float, ...], predicts: bool = True) -> LinearLoop:
    kx, ky, ktheta, scale, v, w = numbers
    gains = ControllerParameters(kx=kx, ky=ky, ktheta=ktheta)
    return kanayama_loop(np.array([v]), np.array([w]), gains, 0.005, predicts, scale)


def dense_radius(loop: LinearLoop, chain: Chain) -> float:
    """Growth of the second moments a step, by their whole matrix, written out state by state."""
    q = loop.outputs
    F, G = loop.F[0], loop.G[0]
    H = np.eye(q) if loop.H is None else loop.H[0]
    received = np.block([[F + G, np.zeros((q, q))], [H, np.zeros((q, q))]])
    lost = np.block([[F, G], [np.zeros((q, q)), H]])
    squares = [g * np.kron(received, received) + (1.0 - g) * np.kron(lost, lost) for g in chain.delivery]
    whole = np.block([[chain.transition[i, j] * squares[i] for i in range(len(squares))] for j in range(len(squares))])
    return float(np.abs(np.linalg.eigvals(whole)).max())


def signs_agree(found: tuple[float, ...], values: Floats, stable: list[bool]) -> bool:
    """Stable up to the first border, unstable up to the second, and so on?"""
    return stable == [int(np.searchsorted(found, value)) % 2 == 0 for value in values]


@pytest.mark.parametrize("numbers", PREDICTED)
def test_losses_that_are_harmless_again(numbers: tuple[float, ...]) -> None:
    loop = loop_of(numbers)
    found = mean_square.loss_borders(loop)
    assert len(found) == 2
    p = 1.0 - np.geomspace(1.0, 1.2e-4, 60)
    assert signs_agree(found, p, [dense_radius(loop, bernoulli(float(x))) < 1.0 for x in p])
    assert mean_square.critical_loss(loop) == found[0]


@pytest.mark.parametrize(("numbers", "predicts"), [(HELD, False), (PREDICTED[2], True)])
def test_bursts_that_are_harmless_again(numbers: tuple[float, ...], predicts: bool) -> None:
    loop, rate = loop_of(numbers, predicts), 0.3
    found = mean_square.burst_borders(loop, rate)
    assert len(found) >= 2
    bursts = np.geomspace(1.0, 4.0 * found[0], 40)
    assert signs_agree(found, bursts, [dense_radius(loop, bursty(rate, float(x))) < 1.0 for x in bursts])
    assert mean_square.critical_burst(loop, rate) == found[0]


@pytest.mark.parametrize(
    "numbers", [(39.917, 0.661, 0.654, 2.089, 1.942, 1.32), (115.516, 2.873, 0.374, 2.192, 2.931, 3.304)]
)
def test_delays_that_are_harmless_again(numbers: tuple[float, ...]) -> None:
    loop = loop_of(numbers)

    def by_the_whole_matrix(n: int) -> bool:
        return bool(np.abs(np.linalg.eigvals(lifted.companion(loop, n))).max() < 1.0 - 1e-12)

    truth = [by_the_whole_matrix(n) for n in range(56)]
    last = truth.index(False) - 1
    assert floquet.largest_constant_delay(loop, 55) == last
    again = stable_again(lambda n: floquet.is_stable_with_delay(loop, n), last, 55)
    assert again is not None
    assert not any(truth[last + 1 : again[0]])
    assert all(truth[again[0] : again[1] + 1])


def test_a_window_between_two_values_of_the_grid_is_found() -> None:
    """A peak of which the grid sees the flanks only: (x - 0.47)^2 < 0.0004, zero at 0.45 and 0.49."""
    found = borders(lambda x: 0.0004 - (x - 0.47) ** 2, np.linspace(0.0, 1.0, 11).tolist())
    assert found == pytest.approx((0.45, 0.49), abs=1e-8)
    assert borders(lambda x: 0.5 - x, [0.0, 1.0]) == (0.0,)
    assert borders(lambda x: x - 2.0, [0.0, 1.0]) == ()
    assert borders(lambda x: x - 0.5, [0.0, 1.0]) == pytest.approx((0.5,))


@pytest.mark.parametrize("guess", [0.0, 8.0, 30.0, 90.0])
def test_a_search_for_the_last_is_not_led_astray_by_a_window(guess: float) -> None:
    """Unstable from 13 to 20 and from 61 on, wherever the search begins."""
    assert last_stable(lambda n: n < 13 or 20 < n < 61, guess, 100) == 12
    assert stable_again(lambda n: n < 13 or 20 < n < 61, 12, 100) == (21, 60)
    assert stable_again(lambda n: n < 13, 12, 100) is None
    assert last_stable(lambda n: not 13 <= n <= 20, guess, 100) == 12


def test_numbers_asked_lie_close() -> None:
    asked = spread(5000)
    assert asked[:9] == list(range(9))
    assert max(b / a for a, b in itertools.pairwise(asked[8:])) < 1.15
    assert 5000 / asked[-1] < 1.15


def test_what_is_said_of_it() -> None:
    assert not_monotone((0.9,), 4) == ""
    assert not_monotone((0.9, 0.95), 4) == "not monotone: unstable between 0.9 and 0.95, stable again beyond 0.95"
    assert not_monotone((0.9, 0.95, 0.99), 4).endswith("stable again between 0.95 and 0.99")


def test_the_margins_say_it_of_a_whole_track() -> None:
    """At constant speeds the whole matrix of the loop of the same gains decides."""
    found = margins(load_scenario(PAPER, [
        "error_detector.track=circle", "error_detector.policy=predict", "plant.speed_scale=2.03", "controller.kx=57.3",
        "controller.ky=0.52", "controller.ktheta=2.90", "error_detector.speed=1.45",
    ]))  # fmt: skip
    p = found.p_mean_square
    assert p == pytest.approx(0.9903, abs=1e-3)
    assert found.reasons["p_max.mean_square"].startswith("not monotone: unstable between 0.990")
    assert found.to_json()["p_max"]["mean_square_reason"] == found.reasons["p_max.mean_square"]
