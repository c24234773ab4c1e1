"""Reliable channels against a writer and a reader that send, ask, send again and hold back, message by message."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_analysis.simulation.channel_outcomes import ChannelRealisation
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import Channel, on_air
from agv_plant.radio.delay import whole_slots
from agv_plant.radio.retransmission import AHEAD, GIVEN_UP, waits_of
from agv_ros.parameters import ParameterError

BURSTS: dict[str, Any] = {"model": "gilbert_elliott", "p": 0.05, "r": 0.1}


def passed_on(lost: list[bool], resend: int, history: int) -> list[int]:
    """Slot in which each message is passed on, -1 if never: a writer and a reader, slot by slot."""
    count = len(lost)
    here: dict[int, int] = {}
    asked: dict[int, int] = {}
    for now in range(count):
        if not lost[now]:
            here[now] = now
            for k in range(now):
                if k not in here and k not in asked:
                    asked[k] = now + resend  # the gap is seen; from then on it is sent again until it is here
        for k, due in asked.items():
            if k not in here and now >= due and not lost[now] and not (history and now - k >= history):
                here[k] = now
    found, held = [], 0
    for k in range(count):
        if k in here:
            held = max(held, here[k])
            found.append(held)
        else:
            found.append(-1)
    return found


@settings(deadline=None, derandomize=True, max_examples=60)
@given(st.lists(st.booleans(), min_size=1, max_size=60), st.integers(0, 5), st.integers(0, 8))
def test_waits_are_those_of_a_writer_and_a_reader(lost: list[bool], resend: int, history: int) -> None:
    lost = [*lost, *[False] * 20]
    expected = passed_on(lost, resend, history)[:-20]
    found = waits_of(np.array([*lost, *[False] * AHEAD]), resend, history)[: len(expected)]
    assert [k + wait if wait != GIVEN_UP else -1 for k, wait in enumerate(found.tolist())] == expected


@pytest.mark.parametrize(
    "settings_of",
    [
        {**BURSTS, "resend_after": 0.02}, {**BURSTS, "history": 10, "delay": 0.012}, {**BURSTS, "lifetime": 0.05},
        {"model": "bernoulli", "p": 0.5, "resend_after": 0.0}, {"schedule": "1: outage=0.2 every 1"},
        {"model": "perfect"},
    ],
)  # fmt: skip
def test_relay_and_simulation_see_the_same_channel(settings_of: dict[str, Any]) -> None:
    channel, steps, ts = ChannelParameters(reliable=True, **settings_of), 1500, 0.005
    relay, realisation = Channel(channel, 3, "uplink", ts), ChannelRealisation(3, steps, ts)
    lost, waits = realisation.outcomes(channel, "uplink"), realisation.link_inputs(channel, "uplink").waits
    outcomes = [relay.outcome(k) for k in range(steps)]
    assert [outcome.lost for outcome in outcomes] == lost.tolist()
    again = Channel(channel, 3, "uplink", ts)
    for k in [*range(0, steps, 7), 3, 700, 699]:  # in whatever order it is asked
        assert again.outcome(k) == outcomes[k]
        if not lost[k]:
            assert whole_slots(max(again.delays(k))) == waits[k]


def test_losses_become_late_bursts_in_order_and_a_short_history_loses_the_rest() -> None:
    channel = ChannelParameters(reliable=True, **BURSTS)
    steps, ts = 20_000, 0.005
    below = ChannelRealisation(1, steps, ts).outcomes(on_air(channel), "uplink")
    realisation = ChannelRealisation(1, steps, ts)
    assert 0.2 < below.mean() < 0.45
    assert not realisation.outcomes(channel, "uplink").any()
    arrivals = np.arange(steps) + np.asarray(realisation.link_inputs(channel, "uplink").waits)
    assert (np.diff(arrivals) >= 0).all()
    assert np.bincount(arrivals).max() > 20  # everything at once
    short = dataclasses.replace(channel, history=10)
    lost = realisation.outcomes(short, "uplink")
    assert 0.0 < lost.mean() < below.mean()
    assert not lost[~below].any()


def test_the_loop_on_dds_is_the_simulated_one(drive: Any) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    from agv_analysis.simulation import simulate

    run = drive(
        "relay.uplink.model=gilbert_elliott", "relay.uplink.p=0.05", "relay.uplink.r=0.1", "relay.uplink.reliable=true",
        "relay.uplink.history=20", "plant.duration=2.0",
    )  # fmt: skip
    simulated = simulate(run.scenario)
    assert run.lost.any()
    assert (run.uplink.delay > 5).any()
    assert (run.lost == simulated.lost).all()
    assert (run.n_ul == simulated.n_ul).all()
    assert abs(run.pose - simulated.pose).max() < 1e-9
    assert not run.unexplained


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"jitter": 0.01}, "set jitter and duplicate to 0"),
        ({"duplicate": 0.1}, "set jitter and duplicate to 0"),
        ({"schedule": "2: jitter=0.1"}, "set jitter and duplicate to 0"),
        ({"model": "rayleigh"}, "asks where the AGV is when it sends again"),
    ],
)
def test_what_cannot_be_is_refused(values: dict[str, Any], reason: str) -> None:
    with pytest.raises(ParameterError, match=reason):
        ChannelParameters(reliable=True, **values)
