"""Speed of the stability criteria: eigenvalue tests of A(k), a pose that is always 500 steps old, a map of margins.

The peers are what a person would write instead: numpy's eigenvalues of each matrix in a Python loop, of all matrices in
one call, and of the lifted system's dense block companion matrix.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.stability import kanayama_delay, lifted, paper
from agv_analysis.stability.linear_loop import kanayama_loop
from agv_analysis.stability.margin_map import margin_map, ranges_of
from agv_cloud.parameters import ControllerParameters
from agv_cloud.reference.reference import Reference
from benchmarks.comparison import Comparison

CONFIG = str(Path(__file__).parent.parent / "config" / "paper.yaml")
STEPS = 20_000
HELD = 10
"""n_ul in the eigenvalue tests."""
N = 500
POINTS = 100
"""Points of each axis of the map."""


def measure() -> list[Comparison]:
    """Each criterion against its peers; the aim is the project's."""
    scenario = load_scenario(CONFIG)
    gains, ts = scenario.controller, scenario.plant.ts
    reference = Reference(scenario.error_detector).first(STEPS)
    held = reference[np.maximum(np.arange(STEPS) - HELD, 0)]
    theta, theta_held, v_held = reference[:, 2], held[:, 2], held[:, 3]
    ours = _seconds(5, lambda: paper.spectral_radii(theta, theta_held, v_held, gains, ts))
    loop = _seconds(1, lambda: _one_by_one(theta, theta_held, v_held, gains, ts))
    batched = _seconds(3, lambda: _all_at_once(theta, theta_held, v_held, gains, ts))
    of_lifted = _seconds(5, lambda: kanayama_delay.spectral_radius(N, 1.0, 0.1, gains, ts))
    of_companion = _seconds(1, lambda: companion_radius(N, 1.0, 0.1, gains, ts))
    kx, periods = ranges_of(scenario, ("kx", "ts"), POINTS)
    of_map = _seconds(3, lambda: margin_map(scenario, ("kx", "ts"), kx, periods))
    one_by_one = _seconds(1, lambda: [_largest_n(scenario, kx) for kx in kx.tolist()]) * POINTS
    what, tests = "20 000 eigenvalue tests of A(k)", "tests/s"
    return [
        Comparison(what, STEPS / ours, "Python loop over numpy", STEPS / loop, tests, 20.0),
        Comparison(what, STEPS / ours, "numpy, all at once", STEPS / batched, tests),
        Comparison(
            f"constant n = {N}", of_lifted, f"dense {3 * (N + 1)} x {3 * (N + 1)}", of_companion, "s",
            smaller_is_better=True,
        ),
        Comparison(
            f"map of {POINTS} x {POINTS} points", of_map, f"constant n alone, point by point ({POINTS} of them)",
            one_by_one, "s", smaller_is_better=True,
        ),
    ]  # fmt: skip


def _largest_n(scenario: Scenario, kx: float) -> int | None:
    """Largest constant n at one point of the map, by bisection."""
    gains = dataclasses.replace(scenario.controller, kx=kx)
    return lifted.largest_n(kanayama_loop(np.ones(1), np.zeros(1), gains, scenario.plant.ts))


def _seconds(tries: int, work: Callable[[], object]) -> float:
    """Duration of the best of some tries."""
    best = math.inf
    for _ in range(tries):
        begun = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - begun)
    return best


def _one_by_one(theta: Floats, theta_held: Floats, v: Floats, gains: ControllerParameters, ts: float) -> list[float]:
    """The test step by step, each matrix as eq. 21 has it."""
    found, kx, ky, ktheta = [], gains.kx, gains.ky, gains.ktheta
    for th, th_n, v_n in zip(theta.tolist(), theta_held.tolist(), v.tolist(), strict=True):
        c, s, c_n, s_n = math.cos(th), math.sin(th), math.cos(th_n), math.sin(th_n)
        A = np.array([
            [1.0 - ts * kx * c * c_n, -ts * kx * c * s_n, -ts * s * v_n],
            [-ts * kx * s * c_n, 1.0 - ts * kx * s * s_n, ts * c * v_n],
            [ts * ky * s_n * v_n, -ts * ky * c_n * v_n, 1.0 - ts * ktheta * v_n],
        ])  # fmt: skip
        found.append(float(max(abs(np.linalg.eigvals(A)))))
    return found


def _all_at_once(theta: Floats, theta_held: Floats, v: Floats, gains: ControllerParameters, ts: float) -> Floats:
    """As `_one_by_one` with numpy's batched eigenvalues."""
    return np.asarray(np.abs(np.linalg.eigvals(paper.matrices(theta, theta_held, v, gains, ts))).max(axis=1))


def companion_radius(n: int, v_r: float, w_r: float, gains: ControllerParameters, ts: float) -> float:
    """Spectral radius of the dense block companion matrix of size 3 (n + 1)."""
    loop = kanayama_loop(np.array([v_r]), np.array([w_r]), gains, ts)
    return float(np.abs(np.linalg.eigvals(lifted.companion(loop, n))).max())


if __name__ == "__main__":
    for line in measure():
        print(f"{line.what}: {line.ours:.3g} {line.unit}, {line.ratio:.2f} x {line.peer_name} ({line.peer:.3g})")
