"""The fitted channel and the verdict on a run, against known channels, scipy, and runs on both sides of each border."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.link.channel_fit import fit_channel
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.stability.analysis import Analysis, analyse
from agv_analysis.stability.verdict import judge
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import losses

REPOSITORY = Path(__file__).parents[3]


def of(*settings: str) -> Analysis:
    return analyse(simulate(load_scenario(str(REPOSITORY / "config/paper.yaml"), settings)))


# -- the fit ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("p", "r"), [(0.02, 0.2), (0.3, 0.1), (0.5, 0.9)]
)  # longer, much longer and shorter bursts than independent losses have
def test_the_fit_finds_the_channel_that_made_the_losses(p: float, r: float) -> None:
    """In 40 runs 95 % intervals miss at most a few times: more than 8 of 80 has probability 0.01 at 95 %."""
    missed = 0
    for seed in range(40):
        fit = fit_channel(losses(ChannelParameters(model="gilbert_elliott", p=p, r=r), seed, "uplink", 5000))
        assert fit.model == "gilbert_elliott"
        assert fit.p is not None
        assert fit.r is not None
        missed += not fit.p.low <= p <= fit.p.high
        missed += not fit.r.low <= r <= fit.r.high
    assert missed <= 8


@pytest.mark.no_cover
def test_independent_losses_are_seldom_called_bursty() -> None:
    """At a significance of 1 %, 8 or more false alarms in 200 have probability 0.001."""
    channel = ChannelParameters(model="bernoulli", p=0.3)
    fits = [fit_channel(losses(channel, seed, "uplink", 3000)) for seed in range(200)]
    assert sum(fit.model == "gilbert_elliott" for fit in fits) < 8
    p_values = np.array([fit.p_value for fit in fits])
    assert 0.35 < np.mean(p_values) < 0.65  # uniform in [0, 1]


def test_the_likelihood_ratio_is_that_of_scipy() -> None:
    """The G-test of the 2 x 2 table of transitions is the same likelihood ratio."""
    stats = pytest.importorskip("scipy.stats")
    lost = losses(ChannelParameters(model="gilbert_elliott", p=0.2, r=0.6), 3, "uplink", 400)
    table = [[np.sum((lost[:-1] == a) & (lost[1:] == b)) for b in (False, True)] for a in (False, True)]
    expected = stats.chi2_contingency(table, correction=False, lambda_="log-likelihood").pvalue
    assert fit_channel(lost).p_value == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("lost", "model", "rate"),
    [([False] * 50, "perfect", 0.0), ([True] * 50, "bernoulli", 1.0), ([False], "perfect", 0.0)],
)
def test_runs_that_say_little(lost: list[bool], model: str, rate: float) -> None:
    fit = fit_channel(np.array(lost))
    assert (fit.model, fit.loss_rate.value, fit.p_value) == (model, rate, None)
    assert fit.loss_rate.low <= rate <= fit.loss_rate.high


# -- the verdict ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "word", "margin"),
    [
        ((10, 14, -0.1, None, math.inf), "asymptotic", "4 more consecutive outages"),
        ((13, 14, -0.1, None, math.inf), "asymptotic", "1 more consecutive outage"),
        ((14, 14, -0.1, None, math.inf), "asymptotic", "0 more consecutive outages"),
        ((10, None, -0.1, None, math.inf), "asymptotic", "any number of more consecutive outages"),
        ((15, 14, -0.1, 2.0, math.inf), "mean-square", "by 1; outages may become 2 times"),
        ((15, 14, 0.1, None, 6.0), "bounded", "limit on the speed"),
        ((15, 14, 0.1, None, math.inf), "unstable", "mean square grows"),
    ],
)
def test_the_strongest_statement_that_holds(
    arguments: tuple[int, int | None, float, float | None, float], word: str, margin: str
) -> None:
    found = judge(*arguments)
    assert found.word == word
    assert margin in found.margin


BURST_16 = ("relay.uplink.model=burst", "relay.uplink.n=16", "error_detector.track=line", "plant.duration=20.0")


def test_runs_on_both_sides_of_the_border_of_bursts() -> None:
    """K_x = 25 on a line: 14 lost in a row contract by |1 - 15/8| = 7/8 a burst, 16 grow by |1 - 17/8| = 9/8."""
    stable = of(*BURST_16, "relay.uplink.n=14")
    assert stable.verdict.word == "asymptotic"
    assert stable.verdict.margin.startswith("0 more")
    assert stable.floquet == pytest.approx(max(0.875 ** (1 / 15), _across(15)), rel=1e-6)
    unstable = of(*BURST_16)
    assert unstable.verdict.word == "unstable"
    assert unstable.floquet == pytest.approx((9 / 8) ** (1 / 17), rel=2e-3)  # the last burst is cut short
    assert unstable.paper is not None
    assert unstable.paper.stable  # the blind spot


def _across(length: int) -> float:
    """Growth per step across a line at 1 m/s with bursts of `length` slots, by brute force."""
    F, G = np.array([[1.0, 0.005], [0.0, 1.0]]), -0.005 * np.array([[0.0, 0.0], [1.0, 2.0]])
    M = np.eye(2)
    for _ in range(length):
        M = F @ M + G
    return float(np.abs(np.linalg.eigvals(M)).max() ** (1 / length))


def test_a_limited_speed_bounds_what_would_grow() -> None:
    found = of(*BURST_16, "controller.v_max=6.0")
    assert found.verdict.word == "bounded"
    assert found.convergence.position.peak < 20.0


@pytest.mark.parametrize(("p", "word"), [(0.5, "mean-square"), (0.95, "unstable")])
def test_random_losses_on_both_sides_of_the_mean_square_border(p: float, word: str) -> None:
    """p* = 0.88235 for K_x = 25."""
    found = of("relay.uplink.model=bernoulli", f"relay.uplink.p={p}", "error_detector.track=line")
    assert found.fit.model == "bernoulli"
    assert found.mean_square_growth is not None
    assert (found.mean_square_growth < 0.0) == (word == "mean-square")
    # 20 000 slots at 50 % have outages of 12 to 20: only beyond 14 is the sequence not survived whatever comes.
    assert found.verdict.word == (word if found.n > 14 else "asymptotic")


@pytest.mark.parametrize(("p", "word"), [(0.6, "mean-square"), (0.95, "unstable")])
def test_losses_on_both_links_are_judged_together(p: float, word: str) -> None:
    """Each link alone is stable up to 0.88 at K_x = 25; test_stability_both_links drives twins on both sides."""
    lossy = ("relay.{}.model=bernoulli", f"relay.{{}}.p={p}")
    settings = [setting.format(link) for link in ("uplink", "downlink") for setting in lossy]
    found = of(*settings, "error_detector.track=line", "plant.duration=20.0")
    assert (found.verdict.word, found.verdict.criterion) == (word, "both_links")


def test_a_downlink_policy_that_no_criterion_covers() -> None:
    lossy = ("relay.downlink.model=bernoulli", "relay.downlink.p=0.3", "plant.downlink_policy=ramp")
    found = of(*lossy, "plant.duration=5.0")
    assert found.verdict.word == "unknown"
    assert "ramp" in found.verdict.margin


def test_a_perfect_channel() -> None:
    found = of("plant.duration=10.0")
    assert (found.verdict.word, found.verdict.margin) == ("asymptotic", "14 more consecutive outages")
    assert found.to_json()["channel_fit"]["model"] == "perfect"
    assert found.contraction is not None
    assert found.contraction < 1.0
