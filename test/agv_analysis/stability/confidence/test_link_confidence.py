"""How sure a recording makes a mean-square verdict, against links whose truth is known in another way.

K_x = 25 on a line, T_s = 5 ms: a = 1/8, and E[e^2] dies out if and only if E[L^2] / E[L] < 16 for independent intervals
between receptions, that is, a mean age below 7.5.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.link.markov_channel import Chain, gilbert_elliott
from agv_analysis.link.transitions import count_transitions
from agv_analysis.scenario import load_scenario
from agv_analysis.stability import mean_square
from agv_analysis.stability.confidence.gilbert_growth import gilbert_growths
from agv_analysis.stability.confidence.growth_posterior import SURE, GrowthPosterior
from agv_analysis.stability.confidence.interval_growth import interval_growth
from agv_analysis.stability.confidence.link_confidence import LinkConfidence, link_confidence
from agv_analysis.stability.linear_loop import LinearLoop, kanayama_loop
from agv_analysis.stability.scenario_loop import loop_on_lap
from agv_cloud.parameters import ControllerParameters
from test.agv_analysis.link.recorded_outcomes import Outcomes, gap_and_outage, gilbert, series

REPOSITORY = Path(__file__).parents[4]
TS = 0.005


def line(kx: float = 25.0, predicts: bool = False) -> LinearLoop:
    gains = ControllerParameters(kx=kx, ky=1.0, ktheta=2.0)
    return kanayama_loop(np.ones(20_000), np.zeros(20_000), gains, TS, predicts)


LINE = line()

PARKED = kanayama_loop(np.zeros(1), np.zeros(1), ControllerParameters(kx=25.0, ky=1.0, ktheta=2.0), TS)
"""Only the error along the track, for tests of many recordings."""


def judge(lost: Outcomes, loop: LinearLoop = LINE) -> LinkConfidence:
    found = link_confidence(loop, np.arange(len(lost)), lost, TS)
    assert 0.0 <= found.probability_stable <= 1.0
    assert found.growth_interval[0] <= found.growth <= found.growth_interval[1]
    assert found.record_seconds_more is None or 0.0 < found.record_seconds_more < math.inf
    return found


def lap(*settings: str) -> LinearLoop:
    return loop_on_lap(load_scenario(str(REPOSITORY / "config/paper.yaml"), settings))


# -- the growth, against the recursion over a whole lap ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "tolerance"),
    [((), 1e-3), (("controller.kx=5.0",), 1e-3), (("error_detector.track=eight",), 1e-3), (("plant.lag=0.1",), 1e-3)],
)
def test_growths_of_many_channels_are_those_of_the_recursion(settings: tuple[str, ...], tolerance: float) -> None:
    """Of contraction about 0.01 a step; a few places stand for a lap of 20 000 steps."""
    loop, channels = lap(*settings), [(0.01, 0.1), (0.001, 0.01), (0.002, 0.003)]
    found = gilbert_growths(loop, *np.array(channels).T)
    exact = [mean_square.lap_growth(loop, gilbert_elliott(p, r)) / loop.steps for p, r in channels]
    assert found == pytest.approx(exact, abs=tolerance)


def test_without_a_model_the_growth_is_that_of_the_whole_lap_as_well() -> None:
    """A limit on the turn rate leaves the error as it is on parts of the lap, which a few places hardly see.

    -1.155e-3 is the growth of the second moments of the loop's 16 states in the map's frame, from differences of a
    simulation of its own along the lap, for this channel: bad and good slots in turn, half of the time each, lost with
    0.8 in a bad one.
    """
    loop = lap(
        "error_detector.policy=predict", "error_detector.speed=0.5", "plant.speed_scale=1.3", "plant.w_max=0.1",
        "controller.v_max=0.9", "controller.kx=53.757", "controller.ky=0.564058", "controller.ktheta=0.572384",
    )  # fmt: skip
    rng, bad, lost = np.random.default_rng(3), False, np.zeros(20_000, dtype=np.bool_)
    for k in range(len(lost)):
        lost[k] = bad and rng.random() < 0.8
        bad = not bad or rng.random() < 0.5
    found = judge(lost, loop)
    assert found.method in ("renewal", "dependent intervals")
    assert found.growth == pytest.approx(-1.155e-3, rel=0.05)
    assert found.probability_stable > 0.9


@pytest.mark.parametrize("predicts", [False, True])
def test_on_a_line_growths_are_exact(predicts: bool) -> None:
    gains = ControllerParameters(kx=25.0, ky=1.0, ktheta=2.0)
    loop = kanayama_loop(np.ones(10), np.zeros(10), gains, TS, predicts, speed_scale=1.3)
    for p, r in ((0.01, 0.1), (0.3, 0.02), (0.9, 0.9)):
        exact = mean_square.lap_growth(loop, gilbert_elliott(p, r)) / loop.steps
        assert gilbert_growths(loop, np.array([p]), np.array([r])) == pytest.approx([exact], abs=1e-6)


def test_intervals_of_a_gilbert_channel_give_its_growth() -> None:
    """Without a model, from 400 000 slots, and by the channel's own recursion."""
    p, r = 0.05, 0.05
    received = np.flatnonzero(~gilbert(p, r, 400_000, 1, seed=1)[0])
    lengths = np.diff(received)
    found = interval_growth(LINE, lengths, int(lengths.max()), dependent=False)
    exact = mean_square.lap_growth(LINE, gilbert_elliott(p, r)) / LINE.steps
    assert found.growth == pytest.approx(exact, rel=0.1)
    assert found.probability_stable == float((lengths**2).sum() / lengths.sum() < 16.0)


# -- how often a word is given, and how often it is right --------------------------------------------------------------


@pytest.mark.no_cover
@pytest.mark.parametrize("seconds", [2, 10, 30, 100])
def test_an_unstable_channel_is_hardly_ever_called_stable(seconds: int) -> None:
    """p = 0.001, r = 0.01: mean age 9.09 > 7.5."""
    recordings = gilbert(0.001, 0.01, 200 * seconds, 40, seed=seconds)
    assert sum(judge(lost, PARKED).probability_stable >= SURE for lost in recordings) <= 2


@pytest.mark.no_cover
def test_a_channel_with_room_is_called_stable_after_ten_seconds() -> None:
    """p = 0.01, r = 0.1: mean age 0.91."""
    assert sum(judge(lost).probability_stable >= SURE for lost in gilbert(0.01, 0.1, 2000, 40, seed=1)) >= 38


@pytest.mark.no_cover
@pytest.mark.parametrize(
    ("p", "r", "slots", "most"),
    [(0.001, 0.01, 20_000, 0.98), (0.01, 0.1, 2000, 0.98), (0.05, 0.95, 600, 0.98), (0.001, 0.01, 2000, 1.0)],
)
def test_intervals_of_the_growth_cover(p: float, r: float, slots: int, most: float) -> None:
    """Truth by the channel's own recursion; the last holds two outages."""
    truth = mean_square.lap_growth(PARKED, gilbert_elliott(p, r))
    k, recordings = np.arange(slots), gilbert(p, r, slots, 300, seed=9)
    found = [GrowthPosterior(PARKED, count_transitions(k, lost)).interval for lost in recordings]
    assert 0.92 <= np.mean([low <= truth <= high for low, high in found]) <= most


# -- links that change, repeat, or are no Gilbert channel -------------------------------------------------------------


def test_the_worst_segment_decides() -> None:
    rng = np.random.default_rng(0)
    found = judge(rng.random(20_000) < np.where(np.arange(20_000) < 14_000, 0.05, 0.97))
    assert [segment.word for segment in found.segments] == ["stable", "unstable"]
    assert abs(found.segments[1].begin - 14_000) <= 5
    assert found.probability_stable <= 1.0 - SURE
    assert found.growth > 0.0
    assert "from 70" in found.reason
    assert found.to_json()["stationarity"]["change_points"] == [found.segments[1].begin]


def test_outages_that_repeat_are_judged_by_their_own_period() -> None:
    """0.2 s lost every 1 s: 0.875^160 |1 - 41/8| a period along the track; a fitted Gilbert channel is unstable."""
    lost = np.resize(gap_and_outage(160, 40), 20_000)
    for loop in (LINE, lap()):
        found = judge(lost, loop)
        assert (found.method, found.worst.word) == ("periodic", "stable")
    assert mean_square.lap_growth(LINE, gilbert_elliott(1 / 160, 1 / 40)) > 0.0


@pytest.mark.parametrize("n", [1, 7, 14, 15, 40])
def test_bursts_after_each_reception(n: int) -> None:
    """|1 - (n + 1) / 8| < 1 up to n = 14; 15 is the border itself, and no contraction."""
    lost = np.resize(np.arange(n + 1) > 0, 20_000)
    assert judge(lost).worst.word == ("stable" if n <= 14 else "unstable")


def two_kinds(share: float, long: int) -> Callable[[np.random.Generator], Outcomes]:
    """A quarter of receptions is followed by an outage, a `share` of which lasts `long` slots, the others 1."""
    return lambda rng: series(
        lambda: gap_and_outage(rng.geometric(0.25), long if rng.random() < share else 1), 20_000
    )  # fmt: skip


@pytest.mark.parametrize(("long", "word"), [(60, "unstable"), (20, "stable")])
def test_intervals_that_no_gilbert_channel_makes(long: int, word: str) -> None:
    """E[(1 - L/8)^2] by hand, gaps of at least one reception included in the weights."""
    moment = 0.75 * (7 / 8) ** 2 + 0.25 * (0.95 * (6 / 8) ** 2 + 0.05 * (1 - (long + 1) / 8) ** 2)
    assert (moment > 1.0) == (word == "unstable")
    for seed in range(5):
        found = judge(two_kinds(0.05, long)(np.random.default_rng(seed)))
        assert (found.method, found.worst.word) == ("renewal", word)
        assert not found.goodness.fits


def modulated(p: float, r: float, good: float, bad: float) -> Callable[[np.random.Generator], Outcomes]:
    """Independent losses of 0.1 % for `good` slots on average, a Gilbert channel for `bad` slots, in turns."""

    def part(rng: np.random.Generator) -> Outcomes:
        slots = int(rng.geometric(1 / bad))
        burst = gilbert(p, r, slots, 1, int(rng.integers(1 << 30)))[0]
        return np.concatenate((rng.random(rng.geometric(1 / good)) < 0.001, burst))

    return lambda rng: series(lambda: part(rng), 20_000)


def pareto(p: float, alpha: float) -> Callable[[np.random.Generator], Outcomes]:
    """Gaps geometric, outages with P(x) ~ x^-alpha: no second moment for alpha < 2."""
    return lambda rng: series(
        lambda: gap_and_outage(rng.geometric(p), math.ceil(rng.random() ** (-1 / alpha))), 20_000
    )  # fmt: skip


def drift(first: float, last: float) -> Callable[[np.random.Generator], Outcomes]:
    p = np.linspace(first, last, 20_000)

    def outcomes(rng: np.random.Generator) -> Outcomes:
        lost: Outcomes = rng.random(20_000) < p
        return lost

    return outcomes


def blocked_and_fading(rng: np.random.Generator) -> Outcomes:
    """Gilbert p = 0.001, r = 0.01, and independent losses of 5 % beside it."""
    lost: Outcomes = gilbert(0.001, 0.01, 20_000, 1, int(rng.integers(1 << 30)))[0] | (rng.random(20_000) < 0.05)
    return lost


@pytest.mark.no_cover
@pytest.mark.parametrize(
    "link",
    [
        pareto(0.01, 1.5), pareto(0.05, 1.8), drift(0.5, 0.97), drift(0.0, 0.95), modulated(0.95, 0.05, 2000, 600),
        modulated(0.95, 0.05, 2000, 150), blocked_and_fading, two_kinds(0.02, 100),
    ],
)  # fmt: skip
def test_no_unstable_link_of_another_kind_is_called_stable(link: Callable[[np.random.Generator], Outcomes]) -> None:
    found = [judge(link(np.random.default_rng(seed))).probability_stable for seed in range(8)]
    assert sum(probability >= SURE for probability in found) == 0


def test_the_modulated_links_are_unstable() -> None:
    """The jump system of both states of both channels, for the test above."""
    for bad in (600.0, 150.0):
        a, b = np.array([[0.999, 0.001], [0.999, 0.001]]), np.array([[0.05, 0.95], [0.05, 0.95]])
        enter_a, enter_b = np.tile([0.999, 0.001], (2, 1)), np.tile([0.05, 0.95], (2, 1))
        T = np.block([[(1 - 1 / 2000) * a, enter_b / 2000], [enter_a / bad, (1 - 1 / bad) * b]])
        assert mean_square.lap_growth(LINE, Chain(T, np.array([1.0, 0.0, 1.0, 0.0]))) > 0.0


@pytest.mark.no_cover
@pytest.mark.parametrize(
    "link",
    [
        lambda rng: series(lambda: gap_and_outage(rng.geometric(0.02), rng.integers(1, 31)), 20_000),
        lambda rng: series(lambda: gap_and_outage(157 + rng.integers(7), 37 + rng.integers(7)), 20_000),
        two_kinds(0.05, 20), drift(0.0, 0.3),
    ],
)  # fmt: skip
def test_stable_links_of_another_kind_are_called_stable(link: Callable[[np.random.Generator], Outcomes]) -> None:
    """Outages of up to 30 slots: E[L^2] / E[L] = 7.3; 0.2 s lost about every second: 9.2."""
    found = [judge(link(np.random.default_rng(seed))).probability_stable for seed in range(8)]
    assert sum(probability >= SURE for probability in found) >= 7


# -- recordings that say little ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("received", "lost", "received_after", "word"),
    [
        (20_000, 0, 0, "stable"), (400, 0, 0, "undecided"), (2000, 0, 0, "undecided"), (0, 20_000, 0, "unstable"),
        (0, 5, 0, "undecided"), (1, 0, 0, "undecided"), (1950, 50, 0, "undecided"), (1997, 3, 0, "undecided"),
        (500, 200, 300, "undecided"), (10_000, 3, 9997, "stable"), (14_000, 6000, 0, "unstable"),
    ],
)  # fmt: skip
def test_one_outage_or_none(received: int, lost: int, received_after: int, word: str) -> None:
    outcomes = np.repeat([False, True, False], [received, lost, received_after])
    found = judge(outcomes)
    assert found.worst.word == word
    assert found.method == "gilbert"
    assert (found.record_seconds_more is None) or word == "undecided"


def test_an_outage_until_the_end_after_many_short_ones_is_not_green() -> None:
    rng = np.random.default_rng(5)
    assert judge(np.concatenate((rng.random(14_000) < 0.05, np.ones(6000, dtype=bool)))).probability_stable < 0.5


def test_how_much_longer_to_record_shrinks_as_the_recording_grows() -> None:
    more = [judge(np.zeros(slots, dtype=bool)).record_seconds_more for slots in (400, 1000, 2000, 4000)]
    assert all(value is not None for value in more)
    total = [200 * value + slots for value, slots in zip(more, (400, 1000, 2000, 4000), strict=True) if value]
    assert max(total) < 1.5 * min(total)  # all name about the same length
    assert judge(np.zeros(int(1.2 * max(total)), dtype=bool)).worst.word == "stable"


def test_a_loop_that_is_unstable_without_losses_is_never_green() -> None:
    """K_x = 450: a = 2.25."""
    for lost in (np.zeros(2000, dtype=bool), gilbert(0.01, 0.1, 2000, 1, seed=0)[0]):
        assert judge(lost, line(kx=450.0)).worst.word == "unstable"


@pytest.mark.parametrize("p", [0.0, 0.01, 0.5])
def test_a_deadbeat_loop(p: float) -> None:
    """K_x = 200 along the track alone: one reception brings the error to 0; stable up to p = 1/3."""
    lost = np.random.default_rng(0).random(5000) < p
    loop = kanayama_loop(np.zeros(1), np.zeros(1), ControllerParameters(kx=200.0, ky=1.0, ktheta=2.0), TS)
    found = judge(lost, loop)
    assert math.isfinite(found.growth)
    assert (found.worst.word == "unstable") == (p > 1 / 3)


def test_losses_leave_nothing_behind_an_exact_predictor() -> None:
    loop = line(predicts=True)
    assert judge(gilbert(0.5, 0.01, 2000, 1, seed=0)[0], loop).worst.word == "stable"
    assert judge(np.ones(2000, dtype=bool), loop).worst.word == "unstable"


def test_steps_missing_from_the_recording_are_neither_lost_nor_received() -> None:
    k = np.concatenate((np.arange(1000), np.arange(1400, 2400)))
    lost = np.zeros(2000, dtype=bool)
    lost[990:1000] = True
    found = link_confidence(LINE, k, lost, TS)
    assert (found.worst.begin, found.worst.end) == (0, 2399)
    assert "at least 10 slots" in found.reason


def test_the_same_recording_gets_the_same_numbers() -> None:
    lost = gilbert(0.001, 0.01, 4000, 1, seed=2)[0]
    assert judge(lost).to_json() == judge(lost).to_json()


@pytest.mark.parametrize(("k", "lost", "ts"), [([], [], TS), ([0, 1], [True], TS), ([0], [False], 0.02)])
def test_arguments_that_do_not_go_together(k: list[int], lost: list[bool], ts: float) -> None:
    with pytest.raises(ValueError, match="must"):
        link_confidence(LINE, np.array(k, dtype=np.int64), np.array(lost, dtype=bool), ts)
