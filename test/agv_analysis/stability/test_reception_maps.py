"""Maps from one reception to the next against the loop driven step by step."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_analysis.run import Floats
from agv_analysis.stability.linear_loop import LinearLoop, kanayama_loop
from agv_analysis.stability.reception_maps import burst_maps, reception_maps
from agv_cloud.parameters import ControllerParameters
from test.agv_analysis.stability.general_loops import KINDS, random_loop, step

TS = 0.005


def driven(loop: LinearLoop, first: int, length: int) -> Floats:
    """z after a burst from each unit vector, by the definition of the loop."""
    z, h = np.eye(loop.size), np.zeros((loop.outputs, loop.size))
    for k in range(first, first + length):
        z, h = step(loop, k, z, h, received=k == first)
    return z


def a_lap(steps: int) -> LinearLoop:
    random = np.random.default_rng(4)
    gains = ControllerParameters(kx=80.0, ky=4.0, ktheta=3.0)
    return kanayama_loop(random.uniform(0.0, 20.0, steps), random.uniform(-9.0, 9.0, steps), gains, TS)


def test_maps_of_bursts_that_run_over_the_end_of_the_lap() -> None:
    loop = a_lap(7)
    for length, M in enumerate(burst_maps(loop, 16), start=1):
        np.testing.assert_allclose(M, [driven(loop, k, length) for k in range(7)], atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rows", [1, 7])
def test_maps_of_any_loop(kind: str, rows: int) -> None:
    loop = random_loop(kind, 7, rows)
    for length, M in enumerate(burst_maps(loop, 9), start=1):
        np.testing.assert_allclose(M, [driven(loop, k, length) for k in range(rows)], atol=1e-12)
    received = np.array([2, 3, 7, 12, 13])
    truth = [driven(loop, first, length) for first, length in zip(received.tolist(), (1, 4, 5, 1, 8), strict=True)]
    np.testing.assert_allclose(reception_maps(loop, received, 21), truth, atol=1e-12)


def test_at_constant_speeds_they_are_a_power_and_a_sum() -> None:
    """M_L = F^L + sum of F^i G over i < L; along a line 1 - a L."""
    loop = kanayama_loop(np.ones(1), np.zeros(1), ControllerParameters(), TS)
    F, G = loop.F[0], loop.G[0]
    for length, M in enumerate(burst_maps(loop, 30), start=1):
        truth = np.linalg.matrix_power(F, length)
        truth = truth + sum(np.linalg.matrix_power(F, i) @ G for i in range(length))
        np.testing.assert_allclose(M[0], truth, atol=1e-12)
        assert M[0, 0, 0] == pytest.approx(1.0 - 0.125 * length, abs=1e-12)


@settings(deadline=None, derandomize=True, max_examples=40)
@given(st.sets(st.integers(0, 24), min_size=1), st.integers(0, 12))
def test_maps_between_given_receptions(steps: set[int], beyond: int) -> None:
    loop = a_lap(25)
    received = np.array(sorted(steps), dtype=np.int64)
    end = int(received[-1]) + 1 + beyond
    ends = [*received[1:].tolist(), end]
    truth = [driven(loop, begin, stop - begin) for begin, stop in zip(received.tolist(), ends, strict=True)]
    np.testing.assert_allclose(reception_maps(loop, received, end), truth, atol=1e-10)
