"""Corridors in sweeps: each point says what the scenario alone says."""

from __future__ import annotations

from functools import partial

from agv_analysis.corridor.corridor import corridor
from agv_analysis.sweep import CORRIDOR_COLUMNS
from agv_analysis.sweep.collect import collect
from agv_analysis.sweep.corridors import best_for_corridor, has_corridor, with_corridors
from agv_analysis.sweep.execute import on_this_machine
from agv_analysis.sweep.plan import Sweep, axis_of, varied
from test.agv_analysis.corridor.test_single_outage import scenario


def test_each_point_says_what_its_scenario_says() -> None:
    base = scenario("error_detector.track=line", "plant.duration=1.0", "error_detector.corridor=0.1", lap=4.0)
    sweep = Sweep(base, (axis_of("controller.kx", [10.0, 25.0]),), 1)
    rows, complete = collect(sweep, None, partial(on_this_machine, sweep), lambda _: None)
    assert complete
    assert has_corridor(sweep)
    found = with_corridors(sweep, rows, laps=60)
    assert [row["n_single"] for row in found] == [27, 17]  # a v T_s n (n + 1) / 2 <= 0.1
    alone = corridor(varied(base, sweep.axes, [25.0]), laps=60, proved=False)
    assert alone is not None
    assert found[1]["p_hour"] == alone.leaving.p_hour.value
    assert found[1]["p_lap_low"] <= found[1]["p_lap"] <= found[1]["p_lap_high"]
    assert set(CORRIDOR_COLUMNS) <= set(found[0])
    assert best_for_corridor(sweep, found) is found[0]
    assert found[0]["p_lap"] < found[1]["p_lap"]


def test_a_corridor_may_be_varied() -> None:
    with_axis = Sweep(scenario(), (axis_of("error_detector.corridor", [0.1, 0.2]),), 1)
    assert has_corridor(with_axis)
    assert not has_corridor(Sweep(scenario(), (axis_of("error_detector.corridor", [0.0, 0.2]),), 1))
    assert not has_corridor(Sweep(scenario(), (axis_of("controller.kx", [5.0]),), 1))
    assert best_for_corridor(with_axis, []) is None


def test_a_metric_of_a_corridor_needs_one(agv_ncs, tmp_path) -> None:  # type: ignore[no-untyped-def]
    status, said = agv_ncs(
        "sweep", "config/outages.yaml", "--set", "plant.duration=0.1", "--vary", "controller.kx=5,25", "--metric",
        "p_hour", "--no-verdicts", "--out", tmp_path / "out",
    )  # fmt: skip
    assert status == 1
    assert "--corridor" in said
    assert not (tmp_path / "out").exists()  # before anything is simulated
