"""The fitted channel and the verdict on a run, against known channels, scipy, and runs on both sides of each border."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agv_analysis.link.channel_fit import fit_channel
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.stability.analysis import Analysis, analyse
from agv_analysis.stability.repeated_run import RepeatedRun
from agv_analysis.stability.verdict import Evidence, decide
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


STAYS = RepeatedRun(600.0, settles=True, meets=True, stays=True, largest_deviation=0.3, largest_in_run=0.2)
DRIFTS = dataclasses.replace(STAYS, stays=False, largest_deviation=40.0)


@pytest.mark.parametrize(
    ("evidence", "word", "margin"),
    [
        (Evidence(n=10, n_bursts=14, growth=-0.1), "asymptotic", "longest outage: 10; guaranteed limit: 14"),
        (Evidence(n=14, n_bursts=14, growth=-0.1), "asymptotic", "longest outage: 14; guaranteed limit: 14"),
        (
            Evidence(n=10, n_bursts=None, growth=-0.1),
            "asymptotic",
            "outages of any length are survived",
        ),
        (
            Evidence(n=15, n_bursts=14, growth=-0.1, burst_left=2.0),
            "mean-square",
            "longest outage: 15; guaranteed limit: 14; outages may become 2 times",
        ),
        (Evidence(n=10, n_bursts=14, growth=-0.1, is_unlimited=True), "mean-square", "no longest one"),
        (Evidence(n=15, n_bursts=14, growth=0.1, v_max=6.0, repeated=STAYS), "bounded", "limit on the speed"),
        (Evidence(n=15, n_bursts=14, growth=0.1, v_max=6.0, repeated=DRIFTS), "unstable", "mean square"),
        (Evidence(n=15, n_bursts=14, growth=0.1, v_max=6.0), "unstable", "mean square"),
        (Evidence(n=15, n_bursts=14, growth=0.1), "unstable", "mean square of the error grows"),
        (Evidence(n=5, growth_of="both_links", growth=-0.1), "mean-square", "commands were lost"),
        (Evidence(n=5, growth=None, not_covered="it is not recorded"), "unknown", "it is not recorded"),
        (Evidence(n=6, late_by=6, lifted_radius=0.9), "asymptotic", "6 steps old"),
        (Evidence(n=6, late_by=6, lifted_radius=1.1), "unstable", "6 steps old"),
    ],
)
def test_the_strongest_statement_that_holds(evidence: Evidence, word: str, margin: str) -> None:
    found = decide(evidence)
    assert found.word == word
    assert margin in found.margin
    assert found.reason


GREEN_SO_FAR = Evidence(n=10, n_bursts=14, growth=-0.1, repeated=STAYS)


@pytest.mark.parametrize(
    ("against", "word", "reason"),
    [
        ({"missing": 3}, "unknown", "3 messages are missing"),
        ({"infeasible": "it falls behind"}, "infeasible", "it falls behind"),
        ({"contradictions": ("driven with K_x = 50",)}, "unknown", "driven with K_x = 50"),
        ({"probability_stable": 0.94}, "undecided", "a stable loop is 94% probable"),
        ({"probability_stable": 0.5, "seen": "one outage"}, "undecided", "one outage"),
        ({"probability_stable": 0.04}, "unstable", "mean square"),
        ({"repeated": DRIFTS}, "unstable", "deviation grows"),
        ({"repeated": dataclasses.replace(STAYS, settles=False)}, "unstable", "without any loss"),
        ({"repeated": dataclasses.replace(STAYS, settles=False), "v_max": 2.0}, "bounded", "without any loss"),
        ({"repeated": dataclasses.replace(STAYS, meets=False)}, "unstable", "do not come together"),
        ({"repeated": DRIFTS, "probability_stable": 0.5}, "unstable", "deviation grows"),
        ({"twins": (3, 20)}, "unstable", "3 of 20"),
    ],
)
def test_any_evidence_to_the_contrary_wins_over_a_green_word(against: dict[str, Any], word: str, reason: str) -> None:
    assert decide(GREEN_SO_FAR).word == "asymptotic"
    assert decide(dataclasses.replace(GREEN_SO_FAR, probability_stable=0.95, twins=(19, 20))).word == "asymptotic"
    found = decide(dataclasses.replace(GREEN_SO_FAR, **against))
    assert found.word == word
    assert reason in found.reason


BURST_16 = ("relay.uplink.model=burst", "relay.uplink.n=16", "error_detector.track=line", "plant.duration=20.0")


def test_runs_on_both_sides_of_the_border_of_bursts() -> None:
    """K_x = 25 on a line: 14 lost in a row contract by |1 - 15/8| = 7/8 a burst, 16 grow by |1 - 17/8| = 9/8."""
    stable = of(*BURST_16, "relay.uplink.n=14")
    assert stable.verdict.word == "asymptotic"
    assert stable.verdict.margin == "longest outage: 14; guaranteed limit: 14"
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
    found = of(*lossy, "plant.ramp_time=5.0", "plant.duration=5.0")
    assert found.verdict.word == "unknown"
    assert "computed for a ramp of up to 200 steps, and it takes 1000" in found.verdict.margin


def test_a_perfect_channel() -> None:
    found = of("plant.duration=10.0")
    assert (found.verdict.word, found.verdict.margin) == ("asymptotic", "longest outage: 0; guaranteed limit: 14")
    assert found.to_json()["channel_fit"]["model"] == "perfect"
    assert found.contraction is not None
    assert found.contraction < 1.0
