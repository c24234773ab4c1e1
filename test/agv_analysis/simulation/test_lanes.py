"""Runs side by side against the same runs one by one, and the vector instructions that they are for."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.compiled import functions as compiled
from agv_analysis.compiled.lane_rows import LANES
from agv_analysis.metrics.order_statistics import not_exceeded, not_exceeded_in_columns
from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.simulation import batch, simulate, simulate_batch
from agv_analysis.simulation.lanes import choices_of, drive, fits_lanes
from agv_analysis.simulation.single import settings_of

ROOT = Path(__file__).parents[3]
PAPER = str(ROOT / "config" / "paper.yaml")
LOSSY = (
    "relay.uplink.model=gilbert_elliott", "relay.uplink.p=0.05", "relay.uplink.r=0.2", "relay.downlink.model=bernoulli",
    "relay.downlink.p=0.1", "plant.duration=20.0",
)  # fmt: skip


def scenarios(*settings: str, gains: tuple[float, ...] = (5.0, 25.0, 60.0)) -> list[Scenario]:
    return [load_scenario(PAPER, [*LOSSY, f"controller.kx={kx}", *settings]) for kx in gains]


def one_by_one(monkeypatch: pytest.MonkeyPatch, wanted: list[Scenario], seeds: list[int], twins: bool) -> batch.Table:
    """The table of the same runs, none of them in a lane."""
    with monkeypatch.context() as alone:
        alone.setattr(batch, "HAS_NUMBA", False)  # which is asked for lanes alone
        return simulate_batch(wanted, seeds, twins=twins)


@pytest.mark.parametrize(
    "settings",
    [(), ("error_detector.policy=predict", "plant.integration=arc", "error_detector.integration=arc")],
    ids=["the paper", "predict along arcs"],
)
def test_side_by_side_and_one_by_one_agree(monkeypatch: pytest.MonkeyPatch, settings: tuple[str, ...]) -> None:
    pytest.importorskip("numba")
    wanted, seeds = scenarios(*settings), [1, 2, 3, 4, 5, 6, 7]  # more than one group, the last one not full
    table, expected = simulate_batch(wanted, seeds, twins=True), one_by_one(monkeypatch, wanted, seeds, True)
    assert table["contraction"].max() < 0.1
    for name in batch.STATISTICS.names or ():
        np.testing.assert_allclose(table[name], expected[name], rtol=1e-9, atol=1e-9, err_msg=name)
    assert table.tobytes() != expected.tobytes()  # or the test compares one way with itself


def test_a_run_does_not_depend_on_the_lanes_beside_it() -> None:
    few, many = scenarios(gains=(25.0,)), scenarios(gains=(5.0, 12.0, 25.0, 1e6, 60.0))
    assert simulate_batch(many, [3, 4])[2].tobytes() == simulate_batch(few, [3, 4])[0].tobytes()


def test_what_diverges_is_what_it_is_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    wild = ("plant.ts=10.0", "error_detector.lap_time=1000.0", "plant.duration=5000.0")
    wanted = [load_scenario(PAPER, [*wild, f"controller.kx={kx}"]) for kx in (0.05, 1.0, 2.0)]
    table, expected = simulate_batch(wanted, [1], twins=True), one_by_one(monkeypatch, wanted, [1], True)
    assert table["steps"].tolist() == expected["steps"].tolist()
    ended = table["steps"] < 500
    assert ended.any()
    assert table[ended].tobytes() == expected[ended].tobytes()


def test_a_reference_that_turns_beyond_the_sine_of_lanes_is_not_for_them() -> None:
    reference = np.zeros((3, 5))
    assert fits_lanes(reference)
    reference[1, 2] = 1e6
    assert not fits_lanes(reference)
    reference[1, 2] = math.nan
    assert not fits_lanes(reference)


def test_the_loop_over_lanes_is_vectorised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    binding = pytest.importorskip("llvmlite.binding")
    if not binding.get_host_cpu_features().get("avx2"):
        pytest.skip("no AVX2 here")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))  # what is read from a cache has no assembly
    compiled._compiled_over_lanes.cache_clear()
    (scenario,) = scenarios(gains=(25.0,))
    simulate_batch([scenario], [1])
    choices = choices_of(settings_of(scenario))
    assert choices is not None
    (text,) = compiled.compiled_over_lanes(drive, choices).inspect_asm().values()  # type: ignore[attr-defined]
    compiled._compiled_over_lanes.cache_clear()
    assert len(re.findall(r"\bv(mul|fmadd\w*)pd\b.*%[yz]mm", text)) > 40


def test_what_a_share_of_a_column_does_not_exceed_is_found_beside_others() -> None:
    drawn = np.random.default_rng(2)
    for steps in (1, 31, 32, 200, 3_000):
        values = drawn.exponential(size=(steps, LANES)) ** 4
        values[: steps // 3] *= 100.0  # early on all is larger, so that a guess by the rest is wrong
        first = drawn.integers(0, steps, LANES).tolist()
        expected = [not_exceeded(values[begun:, lane], 0.99) for lane, begun in enumerate(first)]
        assert not_exceeded_in_columns(values, first, 0.99) == expected


def test_a_run_of_a_lane_is_the_run_that_is_simulated_alone() -> None:
    (scenario,) = scenarios(gains=(25.0,))
    row = simulate_batch([scenario], [6])[0, 0]
    run = simulate(dataclasses.replace(scenario, relay=dataclasses.replace(scenario.relay, seed=6)))
    offset = run.reference[:, :2] - run.pose[:, :2]
    assert row["final"] == pytest.approx(offset[-1, 1], abs=1e-9)
    assert row["position_peak"] == pytest.approx(np.hypot(*offset.T).max(), rel=1e-9)
    assert row["n_ul_max"] == run.n_ul.max()
