"""Messages that are late, out of order or there twice: against a queue spelled out and against the lifted system."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import kstest

from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.simulation.channel_outcomes import ChannelRealisation
from agv_analysis.simulation.link_loop import LinkTrace, empty_trace, listen
from agv_analysis.stability.analysis import analyse
from agv_analysis.stability.margins import left_out
from agv_analysis.stability.verdict import ASYMPTOTIC, MEAN_SQUARE, UNSTABLE
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import Channel, losses
from agv_plant.radio.delay import EXPIRED, delay_in_slots, whole_slots
from agv_plant.radio.link import Link
from agv_ros.messages import DELAYED, DELIVERED, LOST, facts_in
from agv_ros.stamps import Grid
from test.agv_plant.radio.test_two_links import last_words

if TYPE_CHECKING:
    from agv_analysis.run import Run

GRID = Grid(1_000_000_000, 5_000_000)
TS = 0.005
JITTERY = ChannelParameters(model="bernoulli", p=0.2, delay=0.02, jitter=0.03, duplicate=0.3)


# -- how late --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("seconds", "slots"),
    [(0.0, 0), (1e-6, 1), (0.005, 1), (0.0051, 2), (0.0149, 3), (0.015, 3), (0.02, 4), (60.0, 12000)],
)
def test_a_delay_is_rounded_up_to_whole_slots(seconds: float, slots: int) -> None:
    assert whole_slots(delay_in_slots(0.3, seconds, 0.0, TS)) == slots
    assert blank_run(ChannelParameters(delay=seconds), 20).held.tolist() == [max(0, k - slots) for k in range(20)]


def test_jitter_is_uniform_around_the_delay() -> None:
    channel = Channel(ChannelParameters(delay=0.04, jitter=0.03), 1, "uplink", TS)
    found = [channel.delays(k)[0] * TS for k in range(1, 20_000)]
    assert kstest(found, "uniform", (0.01, 0.06)).pvalue > 1e-4


def test_no_message_comes_before_it_is_sent() -> None:
    channel = Channel(ChannelParameters(delay=0.01, jitter=0.03), 1, "uplink", TS)
    found = np.array([channel.delays(k)[0] for k in range(1, 20_000)])
    assert found.min() == 0.0
    assert abs(np.mean(found == 0.0) - 1.0 / 3.0) < 5.0 * math.sqrt(2.0 / 9.0 / len(found))


def test_copies_are_as_many_as_asked_for_and_have_delays_of_their_own() -> None:
    channel = Channel(JITTERY, 1, "uplink", TS)
    both = np.array([channel.delays(k) for k in range(1, 20_000)])
    twice = both[both[:, 1] >= 0.0]
    assert abs(len(twice) / len(both) - 0.3) < 5.0 * math.sqrt(0.3 * 0.7 / len(both))
    assert abs(np.corrcoef(twice.T)[0, 1]) < 5.0 / math.sqrt(len(twice))


# -- the queue -------------------------------------------------------------------------------------------------------

late = st.builds(
    ChannelParameters,
    model=st.just("bernoulli"), p=st.floats(0.0, 0.6), delay=st.floats(0.0, 0.05), jitter=st.floats(0.0, 0.05),
    duplicate=st.floats(0.0, 1.0), lifetime=st.sampled_from([math.inf, 0.001, 0.02, 0.05]),
)  # fmt: skip


@settings(deadline=None, derandomize=True, max_examples=60)
@given(late, st.integers(0, 1000))
def test_everything_arrives_in_its_slot_and_in_the_order_of_its_instants(c: ChannelParameters, seed: int) -> None:
    steps = 80
    link, channel = Link(Channel(c, seed, "uplink", TS), GRID), Channel(c, seed, "uplink", TS)
    sent = [(k + delay, k) for k in range(steps) if not channel.lost(k) for delay in channel.delays(k) if delay >= 0.0]
    freshest = 0
    for k in range(steps):
        slot, arrived = link.transmit(GRID.stamp(k), str(k).encode())
        due = [one for one in sent if whole_slots(one[0] - one[1]) + one[1] == k]
        assert [int(data) for data in arrived] == [j for _, j in sorted(due)]
        freshest = max([freshest, *(j for _, j in due)])
        wait = min((whole_slots(at - j) for at, j in sent if j == k), default=0)
        assert slot[:3] == (
            GRID.stamp(k), GRID.stamp(freshest), LOST if channel.lost(k) else DELAYED if wait else DELIVERED
        )  # fmt: skip
        assert facts_in(slot.note).get("delay", "0") == str(wait)


def test_what_would_be_too_old_never_comes() -> None:
    """Up to 20 ms, four slots: of delays uniform from 0 to 40 ms half is lost for that."""
    c = ChannelParameters(delay=0.02, jitter=0.02, lifetime=0.02)
    link, steps = Link(Channel(c, 1, "uplink", TS), GRID), 20_000
    ages, causes = [], []
    for k in range(steps):
        slot, arrived = link.transmit(GRID.stamp(k), str(k).encode())
        ages += [k - int(data) for data in arrived]
        causes.append(facts_in(slot.note).get("cause", ""))
    assert set(ages) == set(range(5))
    assert set(causes) == {"", EXPIRED}
    assert causes.count(EXPIRED) == link.expired == link.lost
    assert abs(link.expired / steps - 0.5) < 5.0 * math.sqrt(0.25 / steps)


def test_a_copy_may_come_in_time_where_the_message_does_not() -> None:
    c = ChannelParameters(delay=0.02, jitter=0.02, lifetime=0.02, duplicate=1.0)
    lost = losses(c, 1, "uplink", 20_000, TS)
    assert abs(lost.mean() - 0.25) < 5.0 * math.sqrt(0.25 * 0.75 / 20_000)
    assert np.array_equal(ChannelRealisation(1, 20_000, TS).outcomes(c, "uplink"), lost)


def test_a_new_run_hears_nothing_of_what_was_under_way() -> None:
    link = Link(Channel(ChannelParameters(delay=0.02), 1, "uplink", TS), GRID)
    first, second = ([link.transmit(GRID.stamp(k), bytes([k])).arrived for k in range(7)] for _ in range(2))
    assert first == second == [[b"\0"], [], [], [], [], [b"\1"], [b"\2"]]


def test_a_link_counts_the_late_ones_and_the_copies() -> None:
    link, channel = Link(Channel(JITTERY, 1, "uplink", TS), GRID), Channel(JITTERY, 1, "uplink", TS)
    for k in range(1000):
        link.transmit(GRID.stamp(k))
    kept = [channel.delays(k) for k in range(1000) if not channel.lost(k)]
    assert link.copies == sum(copy >= 0.0 for _, copy in kept)
    assert link.delayed == sum(min(delay for delay in both if delay >= 0.0) > 0.0 for both in kept)


def blank_run(c: ChannelParameters, steps: int, seed: int = 1) -> LinkTrace:
    trace = empty_trace(steps)
    listen(ChannelRealisation(seed, steps, TS).link_inputs(c, "uplink"), trace, [[0.0, 0.0]] * steps)
    return trace


@settings(deadline=None, derandomize=True, max_examples=30)
@given(late, st.integers(0, 1000))
def test_the_simulation_holds_what_the_receiver_holds(c: ChannelParameters, seed: int) -> None:
    link = Link(Channel(c, seed, "uplink", TS), GRID)
    said = [GRID.step(link.transmit(GRID.stamp(k)).slot.freshest_ns) for k in range(200)]
    assert blank_run(c, 200, seed).held.tolist() == said


# -- the loop --------------------------------------------------------------------------------------------------------

LINE = (
    "error_detector.track=line", "plant.initial_pose=[0.0, 0.01, 1.5707963267948966]", "error_detector.policy=align",
)  # fmt: skip


def companion(n: int, a: float) -> NDArray[np.float64]:
    """The lifted system along a straight track: e(k+1) = e(k) - a e(k-n)."""
    matrix = np.eye(n + 1, k=-1)
    matrix[0, 0] = 1.0
    matrix[0, n] -= a
    return matrix


@pytest.mark.parametrize("n", [0, 1, 3, 8, 12, 13, 20])
def test_a_constant_delay_is_the_lifted_system(n: int) -> None:
    """Along a straight track, error by error: x_e(k+1) = x_e(k) - T_s K_x x_e(k-n), and x_e(k-n) = x_e(0) before."""
    run = simulate(load_scenario("config/paper.yaml", [*LINE, f"relay.uplink.delay={n * TS}", "plant.duration=5.0"]))
    assert run.n_ul.tolist() == [min(k, n) for k in range(len(run))]
    error = run.reference[:, 1] - run.pose[:, 1]
    state, expected = np.full(n + 1, error[0]), []
    for _ in range(len(run)):
        expected.append(state[0])
        state = companion(n, 25.0 * TS) @ state
    assert error == pytest.approx(np.array(expected), rel=1e-9, abs=1e-13)


@pytest.mark.parametrize(("n", "contracts"), [(12, True), (13, False)])
def test_it_is_stable_up_to_the_lifted_limit(n: int, contracts: bool) -> None:
    """a < 2 sin(pi / (2 (2 n + 1))): 12 slots for K_x = 25; the growth is the companion's spectral radius."""
    assert (2.0 * math.sin(math.pi / (2.0 * (2.0 * n + 1.0))) > 25.0 * TS) == contracts
    run = simulate(load_scenario("config/paper.yaml", [*LINE, f"relay.uplink.delay={n * TS}", "plant.duration=25.0"]))
    error = np.abs(run.reference[:, 1] - run.pose[:, 1])
    first, last = error[1_000:2_000].max(), error[4_000:5_000].max()
    radius = np.abs(np.linalg.eigvals(companion(n, 25.0 * TS))).max()
    assert (radius < 1.0) == contracts
    assert math.log(last / first) / 3_000 == pytest.approx(math.log(radius), rel=0.02)


@pytest.mark.parametrize("n", [1, 7])
def test_a_downlink_s_delay_is_an_uplink_s(n: int) -> None:
    """The loop is as old either way, but that the first command is obeyed until the second comes."""
    up, down = (
        simulate(load_scenario("config/paper.yaml", [*LINE, f"relay.{link}.delay={n * TS}", "plant.duration=10.0"]))
        for link in ("uplink", "downlink")
    )
    assert up.n_dl is not None
    assert down.n_dl is not None
    assert np.array_equal(down.n_dl, up.n_ul)
    assert down.pose == pytest.approx(up.pose, rel=0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("delay", "word", "criterion"),
    [
        (("delay=0.06",), ASYMPTOTIC, "lifted"),
        (("delay=0.065",), UNSTABLE, "lifted"),
        (("delay=0.02", "jitter=0.01"), MEAN_SQUARE, "late_and_lost"),
        ((), ASYMPTOTIC, "bursts"),
    ],
)
def test_a_late_run_is_judged_by_the_lifted_system_or_its_ages(
    delay: tuple[str, ...], word: str, criterion: str
) -> None:
    late = (f"relay.uplink.{setting}" for setting in delay)
    scenario = load_scenario("config/paper.yaml", [*LINE, *late, "plant.duration=5.0"])
    found = analyse(simulate(scenario))
    assert (found.verdict.word, found.verdict.criterion) == (word, criterion)
    assert found.floquet is not None
    assert (found.floquet < 1.0) == (word != UNSTABLE)
    assert [name.split(" ")[0] for name in left_out(scenario)] == [f"relay.uplink.{one.split('=')[0]}" for one in delay]


def test_a_predictor_with_an_exact_model_does_not_mind() -> None:
    late, fresh = (
        simulate(load_scenario("config/paper.yaml", ["error_detector.policy=predict", "plant.duration=20.0", *delay]))
        for delay in (["relay.uplink.delay=0.1", "relay.uplink.jitter=0.05"], [])
    )
    assert late.n_ul.max() >= 20
    assert late.pose == pytest.approx(fresh.pose, rel=0.0, abs=1e-9)


# -- on DDS ----------------------------------------------------------------------------------------------------------


def test_what_comes_too_late_or_twice_is_put_aside_and_counted(drive: Callable[..., Run], tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    settings = ("delay=0.01", "jitter=0.03", "duplicate=0.4", "model=bernoulli", "p=0.1")
    run = drive(
        *(f"relay.{link}.{setting}" for link in ("uplink", "downlink") for setting in settings), "plant.duration=3.0",
        bag=tmp_path / "bag",
    )  # fmt: skip
    assert run.unexplained == {}
    held = run.k - run.n_ul
    said = last_words(tmp_path / "bag", "error_detector")
    relay = last_words(tmp_path / "bag", "relay")
    passed_on = int(relay["published /edge/pose"])
    assert said["outdated messages"] == str(passed_on - len(np.unique(held)))
    assert int(relay["uplink delayed"]) == np.count_nonzero(run.uplink.delay if run.uplink else ())
    assert int(relay["uplink duplicated"]) > 0
    assert any("repeat a step" in note for note in run.notes)
