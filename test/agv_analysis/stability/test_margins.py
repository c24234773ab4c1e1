"""Margins of scenarios against the closed forms and the published figures."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agv_analysis.scenario import load_scenario
from agv_analysis.stability.criteria.any_outages import binding
from agv_analysis.stability.criteria.criterion import Margin
from agv_analysis.stability.empirical import Twins
from agv_analysis.stability.linear_loop import kanayama_loop
from agv_analysis.stability.margins import Margins, margins
from agv_cloud.parameters import ControllerParameters

REPOSITORY = Path(__file__).parents[3]


def of(*settings: str, config: str = "paper") -> Margins:
    return margins(load_scenario(str(REPOSITORY / f"config/{config}.yaml"), settings))


@pytest.mark.parametrize("track", ["paper", "line"])
@pytest.mark.parametrize(
    ("kx", "lifted", "bursts", "p"), [(5.0, 62, 78, 0.97531), (25.0, 12, 14, 0.88235), (250.0, 0, 0, 0.23077)]
)
def test_the_canonical_scenario(track: str, kx: float, lifted: int, bursts: int, p: float) -> None:
    found = of(f"controller.kx={kx}", f"error_detector.track={track}")
    assert (found.n_lifted, found.n_bursts) == (lifted, bursts)
    assert found.p_mean_square == pytest.approx(p, abs=1e-5)
    assert found.binding == "along"
    if track == "line":
        assert found.n_paper is None
        assert "turned" in found.reasons["n_max.paper"]
    else:
        assert found.n_paper is not None
        assert found.n_paper > 2000
    assert any("paper's test allows" in sentence for sentence in found.disagreements())


def test_the_critical_burst_at_the_scenarios_loss_rate() -> None:
    """Along the track pi B < 1/a - 1/2; p = 0.02, r = 0.2: pi = 1/11."""
    found = of("error_detector.track=line", config="outages")
    assert found.loss_rate == pytest.approx(1.0 / 11.0)
    assert found.burst_mean_square == pytest.approx(7.5 * 11.0, rel=1e-5)


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        (["relay.uplink.model=perfect"], "loses nothing"),
        (["relay.uplink.p=0.0"], "loses nothing"),
        (["relay.uplink.model=bernoulli", "relay.uplink.p=1.0"], "loses everything"),
    ],
)
def test_no_burst_to_speak_of(settings: list[str], reason: str) -> None:
    found = of(*settings, "error_detector.track=line", config="outages")
    assert found.burst_mean_square is None
    assert reason in found.reasons["burst_max.mean_square"]


def test_a_parked_agv_and_a_deadbeat_loop_contract_although_the_paper_s_test_says_otherwise() -> None:
    parked = of("error_detector.track=warehouse")
    assert (parked.n_paper, parked.n_bursts) == (-1, 14)
    assert any("calls the loop unstable" in sentence for sentence in parked.disagreements())
    deadbeat = of("controller.kx=200.0", "error_detector.track=line")
    assert (deadbeat.n_lifted, deadbeat.n_bursts) == (0, 0)
    assert deadbeat.p_mean_square == pytest.approx(1.0 / 3.0)  # (2 - 1) / (2 + 1)


def test_a_gain_beyond_the_loop_s_reach() -> None:
    """T_s K_x > 2 overshoots by more than it corrects."""
    found = of("controller.kx=401.0", "error_detector.track=line")
    assert (found.n_lifted, found.n_bursts, found.p_mean_square, found.p_almost_sure) == (-1, -1, None, None)
    for name in ("p_max.mean_square", "p_max.almost_sure"):
        assert "even without losses" in found.reasons[name]
    assert found.to_json()["p_max"]["mean_square_reason"] == found.reasons["p_max.mean_square"]


def test_without_a_gain_along_the_track_nothing_is_proved() -> None:
    found = of("controller.kx=0.0", "error_detector.track=line")
    assert found.n_bursts == -1
    assert found.n_lifted == -1


def test_the_delay_margin() -> None:
    """Along the track a = 2 sin(pi / (2 (2 n + 1))) at the margin; K_x = 25: n = 12.06 samples of 5 ms."""
    found = of("error_detector.track=line")
    assert found.delay is not None
    n = found.delay / 0.005
    assert 2.0 * math.sin(math.pi / (2.0 * (2.0 * n + 1.0))) == pytest.approx(0.125)
    assert math.floor(n) == found.n_lifted == 12


@pytest.mark.parametrize(
    ("setting", "reason"),
    [("error_detector.policy=predict", "held"), ("controller.kx=401.0", "even without"), ("controller.kx=0.0", "even")],
)
def test_without_a_delay_margin_there_is_a_reason(setting: str, reason: str) -> None:
    found = of("error_detector.track=line", setting).to_json()
    assert found["delay_margin"] is None
    assert reason in found["delay_margin_reason"]


def test_what_binds() -> None:
    """Along L T_s K_x < 2, across about L T_s v min(2 / K_theta, 2 K_theta / K_y)^-1 < 1."""

    def found(v: float, by: ControllerParameters) -> str | None:
        return binding(kanayama_loop(np.array([v]), np.zeros(1), by, 0.005))

    assert found(1.0, ControllerParameters()) == "along"
    assert found(20.0, ControllerParameters(kx=0.5)) == "across"


def test_the_command(agv_ncs: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    path = tmp_path / "margins.json"
    status, said = agv_ncs("stability", "config/outages.yaml", "--set", "error_detector.track=line", "--json", path)
    assert status == 0
    found: dict[str, Any] = json.loads(path.read_text())
    assert found["n_max"]["paper"] is None
    assert found["n_max"]["paper_reason"]
    assert (found["n_max"]["lifted"], found["n_max"]["bursts"], found["binding"]) == (12, 14, "along")
    assert found["p_max"].keys() >= {"mean_square", "almost_sure"}
    assert found["burst_max"]["mean_square"] == pytest.approx(82.5, rel=1e-4)
    assert "14 steps (70 ms)" in said
    assert said.count("They disagree:") == len(found["disagreements"]) >= 2
    assert found["best_kx"]["almost_sure"] > 0.0
    assert "integer" in found["best_kx"]["almost_sure_reason"]
    assert (found["verdict"], found["confidence"], found["feasible"]) == ("mean-square", 1.0, True)
    growth = found["uplink"]["mean_square_growth"]
    assert found["growth_interval"] == pytest.approx([growth, growth], rel=1e-6)
    unknown = {"record_seconds_more", "stationarity", "channel_fit"}  # of a channel that is known
    assert [found[name] for name in sorted(unknown)] == [None] * 3


def test_a_trace_has_no_best_gain_and_says_why(agv_ncs: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    trace, path = tmp_path / "lost.csv", tmp_path / "margins.json"
    trace.write_text("lost\n1\n0\n1\n")
    settings = ("error_detector.track=line", "relay.uplink.model=trace", f"relay.uplink.trace_file={trace}")
    status, said = agv_ncs(
        "stability", "config/paper.yaml", *(word for setting in settings for word in ("--set", setting)), "--json", path
    )
    assert status == 0, said
    found: dict[str, Any] = json.loads(path.read_text())
    assert found["best_kx"] is None
    assert "trace" in found["best_kx_reason"]
    assert "closed form" in found["burst_max"]["mean_square_reason"]
    assert found["n_max"]["bursts"] == 14
    assert found["stationarity"] is not None
    assert found["channel_fit"]["goodness"].keys() >= {"fits"}


def test_a_trace_is_one_run_whatever_the_seed(agv_ncs: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    trace, path = tmp_path / "lost.csv", tmp_path / "margins.json"
    trace.write_text("lost\n1\n0\n1\n")
    settings = ("error_detector.track=line", "plant.duration=20.0", f"relay.uplink.trace_file={trace}")
    words = ["--set", "relay.uplink.model=trace", *(word for s in settings for word in ("--set", s))]
    status, said = agv_ncs("stability", "config/paper.yaml", *words, "--json", path)
    assert status == 0, said
    assert "1 run, which contracts to" in " ".join(said.split())
    assert json.loads(path.read_text())["empirical"]["different_runs"] == 1
    status, said = agv_ncs("stability", "config/paper.yaml", *words, "--set", "plant.noise_xy=0.001", "--json", path)
    assert status == 0, said
    assert "neighbouring trajectories converge in 20 of 20 runs" in " ".join(said.split())
    assert json.loads(path.read_text())["empirical"]["different_runs"] == 20  # by their noise


def test_which_loss_rate_to_design_with() -> None:
    """The mean square's, unless twins contract only up to less."""
    found = of("error_detector.track=line")
    said = found.recommendation
    assert said.startswith("the mean square, independent losses below 0.8824")
    assert "14 slots" in said
    assert found.to_json()["recommendation"] == said

    def with_twins(p: float) -> str:
        border = Margin("p_max.twins", "twins", p)
        return dataclasses.replace(found, found={**found.found, "p_max.twins": border}).recommendation

    assert "most simulated runs converge up to 0.93" in with_twins(0.93)
    assert with_twins(0.7).startswith("a loss rate below 0.7, up to which most simulated runs converge")
    assert of("error_detector.track=line", "controller.kx=401.0").recommendation == ""


def test_twins_that_do_not_contract_are_a_disagreement() -> None:
    """Only where the links as they are let E[e^2] die out; a tenth may fail."""
    found = of("error_detector.track=line", "relay.uplink.model=bernoulli", "relay.uplink.p=0.5")
    assert found.to_json()["uplink"]["mean_square_growth"] < 0.0

    def said(*contraction: float, by: Margins = found, steps: int = 20_000) -> list[str]:
        sentences = dataclasses.replace(by, twins=Twins(np.array(contraction), None, steps)).disagreements()
        return [sentence for sentence in sentences if "neighbouring" in sentence]

    assert len(said(2.0)) == len(said(0.5, 0.5, 2.0, math.inf)) == 1
    assert "converge in 2 of 4 simulated runs" in said(0.5, 0.5, 2.0, math.inf)[0]
    assert not said(*[0.5] * 9, 2.0)
    assert not said(2.0, steps=100)  # E[e^2] has not died out after half a second
    growing = of("error_detector.track=line", "relay.uplink.model=bernoulli", "relay.uplink.p=0.95")
    assert not said(2.0, by=growing)


def test_best_gains_are_those_of_a_held_pose(agv_ncs: Callable[..., tuple[int, str]]) -> None:
    settings = ("error_detector.track=line", "error_detector.policy=predict")
    status, said = agv_ncs("stability", "config/paper.yaml", *(word for s in settings for word in ("--set", s)))
    assert status == 0, said
    assert "Best K_x For any aim no answer: computed for a pose that is held" in " ".join(said.split())
