"""Speed of the batch simulator: closed-loop steps per second of the paper's loop with a third of the poses lost.

The peers are what a person would write instead, with the same metrics, each as good as its language allows: a plain
Python loop on local floats, numpy over many runs at once; and the paper's MATLAB, without metrics, run by Octave where
that is on the PATH.
"""

from __future__ import annotations

import dataclasses
import math
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import compiled
from agv_analysis.compiled.lane_rows import LANES
from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.simulation import simulate_batch
from agv_analysis.simulation.batch import cores
from agv_analysis.simulation.lanes import Group
from agv_analysis.simulation.loop import RunInputs, at_rest, statistics_of_two
from agv_analysis.simulation.single import settings_of
from agv_cloud.reference.reference import Reference
from agv_plant.radio.channel import losses
from benchmarks.comparison import Comparison

CONFIG = str(Path(__file__).parent.parent / "config" / "paper.yaml")
LOSS = 0.3
STEPS = 20_000
GAINS = np.linspace(5.0, 60.0, 40)
RATES = (LOSS, LOSS)
SEEDS = range(20)
UNIT = "steps/s"


def measure() -> list[Comparison]:
    """Batch simulator against its peers, per core, then over all cores; the aims are the project's."""
    scenarios = _scenarios()
    runs = len(scenarios) * len(SEEDS)
    simulate_batch(scenarios[:1], SEEDS, workers=1)  # compiles
    one = _rate(runs * STEPS, lambda: simulate_batch(scenarios, SEEDS, workers=1))
    everything = _rate(runs * STEPS, lambda: simulate_batch(scenarios, SEEDS))
    reference = Reference(scenarios[0].error_detector).first(STEPS)
    lost = losses(scenarios[-1].relay.uplink, 1, "uplink", STEPS)
    bare = _rate(len(GAINS) * STEPS, lambda: _kernel(scenarios[-len(GAINS) :], reference, lost))
    side_by_side = _rate(LANES * STEPS, _over_lanes(scenarios[-LANES:], reference, lost))
    plain = _rate(STEPS, lambda: _plain(reference.tolist(), lost.tolist(), 25.0))
    batched = _rate(2_000 * 1_000, lambda: _batched(reference[:1_000], 2_000))
    found = [
        Comparison("simulation, one core", one, "plain Python", plain, UNIT, 20.0),
        Comparison("simulation, one core", one, "numpy, 2000 runs at once", batched, UNIT),
        Comparison("sweep with its verdicts, one core", one, "bare loops, two runs at a time", bare, UNIT, 1.5),
        Comparison("sweep with its verdicts, one core", one, "bare loops, side by side", side_by_side, UNIT),
        Comparison(f"simulation, {cores()} cores", everything, "one core", one, UNIT, 0.9 * cores()),
    ]
    octave = _octave(reference, lost)
    return found if octave is None else [*found, Comparison("simulation, one core", one, "Octave", octave, UNIT)]


def _rate(steps: int, work: Callable[[], object]) -> float:
    """Steps per second of the best of five tries."""
    best = math.inf
    for _ in range(5):
        begun = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - begun)
    return steps / best


def _scenarios() -> list[Scenario]:
    """40 gains times 2 loss rates, every gain under the same outages."""
    base = load_scenario(CONFIG, ["relay.uplink.model=bernoulli"])
    relays = [dataclasses.replace(base.relay, uplink=dataclasses.replace(base.relay.uplink, p=p)) for p in RATES]
    controllers = [dataclasses.replace(base.controller, kx=float(kx)) for kx in GAINS]
    return [dataclasses.replace(base, relay=relay, controller=gains) for relay in relays for gains in controllers]


def _kernel(scenarios: list[Scenario], reference: NDArray[np.float64], lost: NDArray[np.bool_]) -> None:
    """As many laps as there are scenarios, two at a time, nothing around them."""
    laps, never = compiled(statistics_of_two), np.zeros_like(lost)
    start = at_rest(*scenarios[0].plant.initial_pose)
    cases = [RunInputs(lost, never, start, settings_of(scenario)) for scenario in scenarios]
    squares = np.zeros((2, len(lost)))
    for one, other in zip(cases[::2], cases[1::2], strict=True):
        laps(reference, one, other, *squares)


def _over_lanes(
    scenarios: list[Scenario], reference: NDArray[np.float64], lost: NDArray[np.bool_]
) -> Callable[[], None]:
    """A lap of LANES scenarios side by side, nothing around it."""
    never, start = np.zeros_like(lost), at_rest(*scenarios[0].plant.initial_pose)
    group = Group(reference, [RunInputs(lost, never, start, settings_of(scenario)) for scenario in scenarios])
    begun = group.rows([start] * len(scenarios))
    group.drive(begun.copy(), 0, STEPS)  # compiles
    return lambda: group.drive(begun.copy(), 0, STEPS)


def _plain(reference: list[list[float]], lost: list[bool], kx: float) -> tuple[float, ...]:
    """The loop and its metrics by hand, all in local variables; no test for overflow, which the simulator has."""
    sin, cos, sqrt, ts, ky, ktheta, v_max = math.sin, math.cos, math.sqrt, 0.005, 1.0, 2.0, math.inf
    x, y, theta = x_held, y_held, theta_held = 0.0, 5.0, math.pi / 2
    outside_1cm = outside_2pct = -1
    lowest, highest, iae, ise, farthest, square = math.inf, -math.inf, 0.0, 0.0, 0.0, 0.0
    n_ul = n_ul_max = n_ul_sum = 0
    for k, (x_r, y_r, theta_r, v_r, w_r) in enumerate(reference):
        e = y_r - y
        size = abs(e)
        if size >= 0.01:
            outside_1cm = k
        if size >= 0.1:
            outside_2pct = k
        if e < lowest:
            lowest = e
        if e > highest:
            highest = e
        iae += size
        ise += e * e
        square = (x_r - x) * (x_r - x) + e * e
        if square > farthest:
            farthest = square
        if lost[k]:
            n_ul += 1
            n_ul_sum += n_ul
            if n_ul > n_ul_max:
                n_ul_max = n_ul
        else:
            n_ul, x_held, y_held, theta_held = 0, x, y, theta
        dx, dy, c, s = x_r - x_held, y_r - y_held, cos(theta_held), sin(theta_held)
        theta_e = theta_r - theta_held
        v = v_r * cos(theta_e) + kx * (c * dx + s * dy)
        if v > v_max:
            v = v_max
        elif v < -v_max:
            v = -v_max
        w = w_r + v_r * (ky * (c * dy - s * dx) + ktheta * sin(theta_e))
        x, y, theta = x + ts * v * cos(theta), y + ts * v * sin(theta), theta + ts * w
    steps = len(lost)
    return (
        outside_1cm + 1, outside_2pct + 1, highest / 5.0, iae * ts, ise * ts, -lowest, e, sqrt(farthest), sqrt(square),
        n_ul_max, n_ul_sum / steps,
    )  # fmt: skip


def _batched(reference: NDArray[np.float64], runs: int) -> tuple[NDArray[np.float64], ...]:
    """As `_plain`, many runs side by side, one numpy operation for all of them."""
    generator, ts, kx, ky, ktheta = np.random.default_rng(1), 0.005, np.linspace(5.0, 60.0, runs), 1.0, 2.0
    x, y, theta = np.zeros(runs), np.full(runs, 5.0), np.full(runs, math.pi / 2)
    x_held, y_held, theta_held = x.copy(), y.copy(), theta.copy()
    outside_1cm, outside_2pct = np.full(runs, -1.0), np.full(runs, -1.0)
    lowest, highest, farthest = np.full(runs, math.inf), np.full(runs, -math.inf), np.zeros(runs)
    iae, ise, n_ul, n_ul_max, n_ul_sum = (np.zeros(runs) for _ in range(5))
    for k, (x_r, y_r, theta_r, v_r, w_r) in enumerate(reference.tolist()):
        e = y_r - y
        size = np.abs(e)
        outside_1cm[size >= 0.01] = k
        outside_2pct[size >= 0.1] = k
        np.minimum(lowest, e, out=lowest)
        np.maximum(highest, e, out=highest)
        iae += size
        ise += e * e
        np.maximum(farthest, (x_r - x) ** 2 + e * e, out=farthest)
        heard = generator.random(runs) >= LOSS
        n_ul += 1.0
        n_ul[heard] = 0.0
        n_ul_sum += n_ul
        np.maximum(n_ul_max, n_ul, out=n_ul_max)
        np.copyto(x_held, x, where=heard)
        np.copyto(y_held, y, where=heard)
        np.copyto(theta_held, theta, where=heard)
        dx, dy, c, s = x_r - x_held, y_r - y_held, np.cos(theta_held), np.sin(theta_held)
        theta_e = theta_r - theta_held
        v = v_r * np.cos(theta_e) + kx * (c * dx + s * dy)
        w = w_r + v_r * (ky * (c * dy - s * dx) + ktheta * np.sin(theta_e))
        x, y, theta = x + ts * v * np.cos(theta), y + ts * v * np.sin(theta), theta + ts * w
    return outside_1cm, outside_2pct, lowest, highest, iae * ts, ise * ts, farthest, n_ul_max, n_ul_sum


OCTAVE = """
data = dlmread("{table}"); Xr = data(:, 1:3)'; vr = data(:, 4)'; wr = data(:, 5)'; lost = data(:, 6)';
Ts = 0.005; Kx = 25; Ky = 1; Kt = 2; N = columns(Xr);
X = zeros(3, N + 1); X(:, 1) = [0; 5; pi / 2]; n = 0;
tic;
for k = 1:N
  if lost(k) n = n + 1; else n = 0; end
  Xh = X(:, k - n);
  Te = [cos(Xh(3)) sin(Xh(3)) 0; -sin(Xh(3)) cos(Xh(3)) 0; 0 0 1];
  e = Te * (Xr(:, k) - Xh);
  u = [vr(k) * cos(e(3)) + Kx * e(1); wr(k) + vr(k) * (Ky * e(2) + Kt * sin(e(3)))];
  J = [cos(X(3, k)) 0; sin(X(3, k)) 0; 0 1];
  X(:, k + 1) = X(:, k) + Ts * J * u;
end
printf("%.9f %.17g\\n", toc, X(2, N));
"""
"""The paper's equations as its MATLAB would have them, with the outdated pose of its eq. 16."""


def _octave(reference: NDArray[np.float64], lost: NDArray[np.bool_]) -> float | None:
    """Steps per second of the loop in Octave, None where there is none."""
    program = shutil.which("octave-cli") or shutil.which("octave")
    if program is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "table.txt"
        np.savetxt(table, np.column_stack([reference, lost]), fmt="%.17g")
        script = OCTAVE.replace("{table}", str(table))
        done = subprocess.run(
            [program, "--no-gui", "--norc", "--eval", script], capture_output=True, text=True, check=True
        )
    seconds, _ = map(float, done.stdout.split())
    return STEPS / seconds


if __name__ == "__main__":
    for line in measure():
        print(f"{line.what}: {line.ours:.3g} {line.unit}, {line.ratio:.2f} x {line.peer_name} ({line.peer:.3g})")
