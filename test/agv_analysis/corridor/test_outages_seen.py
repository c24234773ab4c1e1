"""What a recording proves of a corridor, on outages that are made up and on those of the simulation."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.corridor.corridor_of_run import corridor_of_run, with_fitted_channel
from agv_analysis.corridor.outages_seen import geometric_tail, recorded_outages
from agv_analysis.corridor.widths import Widths, widths_of
from agv_analysis.link.channel_fit import fit_channel
from agv_analysis.simulation import simulate
from agv_analysis.stability.analysis import observe
from test.agv_analysis.corridor.test_single_outage import scenario

WIDE = Widths(0.25, np.inf, np.inf)


def test_without_a_violation_the_bound_is_exact() -> None:
    run = simulate(scenario("plant.duration=30.0", "error_detector.corridor=100.0"))
    widths = widths_of(run.scenario.error_detector)
    assert widths is not None
    found = recorded_outages(run, widths, 300, settled=300)
    assert (found.left, found.warnings) == (0, ())
    assert (1.0 - found.at_most) ** found.outages == pytest.approx(0.05)  # as likely as not to be seen


def test_violations_are_counted_by_outage() -> None:
    run = simulate(scenario("plant.duration=10.0", "relay.uplink.model=burst", "relay.uplink.n=40",
                            "relay.uplink.start_step=1000"))  # fmt: skip
    found = recorded_outages(run, WIDE, 22, settled=300)
    assert (found.outages, found.left) == (1, 1)
    assert found.at_most == 1.0
    assert "rests on 1" in found.warnings[0]
    none = recorded_outages(run, WIDE, 22, settled=1500)
    assert (none.outages, none.at_most, none.tail) == (0, 1.0, None)


def test_the_tail_holds_the_truth_as_often_as_its_interval_says() -> None:
    rng, hits = np.random.default_rng(3), 0
    for _ in range(100):
        found, _ = geometric_tail(rng.geometric(0.2, 200), 40)
        hits += found.low <= 0.8**39 <= found.high
    assert 90 <= hits <= 99


def test_the_fitted_channel_takes_the_place_of_the_radio() -> None:
    run = simulate(scenario("plant.duration=50.0", "relay.uplink.jitter=0.01"))
    uplink = with_fitted_channel(run.scenario, fit_channel(run.lost, run.k)).relay.uplink
    assert (uplink.model, uplink.jitter) == ("gilbert_elliott", 0.0)
    assert uplink.p == pytest.approx(0.02, abs=0.006)
    assert uplink.r == pytest.approx(0.2, abs=0.05)


def test_a_recording_on_the_command_line(agv_ncs, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    """The sample has 45 outages, of which none leads outside."""
    out = tmp_path / "corridor.json"
    picture = tmp_path / "picture.png"
    status, said = agv_ncs(
        "analyse", "bags/sample", "--corridor", "0.12", "--laps", "10", "--json", out, "--picture", picture
    )
    assert status == 0
    found = json.loads(out.read_text())["corridor"]
    assert (found["half_width"], found["n_single"], found["recorded"]["left"]) == (0.12, 15, 0)
    assert found["recorded"]["p_outage_at_most"] == pytest.approx(1.0 - 0.05 ** (1 / 45))
    assert 0.0 < found["p_lap_interval"][0] < found["p_lap"] <= found["p_lap_interval"][1] <= 1.0
    said = " ".join(said.split())
    assert "0 of 45 outages led outside, at most" in said
    assert "% of the half-width was used" in said
    assert "at most 6.44 % of all outages lead outside" in said  # 1 - 0.05^(1/45)
    status, said = agv_ncs("analyse", "bags/sample", "--corridor", "0")
    assert status == 2
    assert "'--corridor'" in said


def test_without_gains_only_what_was_seen_is_said() -> None:
    chosen = scenario("plant.duration=10.0", "error_detector.corridor=0.25")
    run = dataclasses.replace(simulate(chosen), gains_known=False)
    found = corridor_of_run(observe(run), chosen, is_known=False)
    assert found is not None
    assert found.expected is None
    said = found.to_json()
    assert (said["half_width"], said["channel"]) == (0.25, None)
    assert said["recorded"]["outages"] == found.seen.outages > 10
    assert "gains are not known" in said["notes"][0]
    assert [name for name, _ in found.rows()] == ["Seen in the run", "Proved by the run"]
