"""A channel's outcomes as a function of the slot alone."""

from __future__ import annotations

import dataclasses

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_plant.channels.registry import MODELS
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import Channel, losses

STEPS = 9000  # more than two blocks of random numbers

parameters = st.one_of(
    st.builds(ChannelParameters, model=st.just("bernoulli"), p=st.floats(0.0, 1.0)),
    st.builds(
        ChannelParameters,
        model=st.just("gilbert_elliott"),
        p=st.floats(0.0, 1.0),
        r=st.floats(0.0, 1.0),
        h=st.floats(0.0, 1.0),
        k=st.floats(0.0, 1.0),
    ),
    st.builds(ChannelParameters, model=st.just("burst"), n=st.integers(0, 50), start_step=st.integers(-1, 50)),
)
seeds = st.integers(0, 2**62)
questions = st.lists(st.one_of(st.integers(0, 60), st.integers(4090, 4100), st.integers(0, STEPS - 1)), max_size=25)


@pytest.mark.no_cover
@settings(deadline=None, derandomize=True, max_examples=60)
@given(parameters, seeds, questions)
def test_outcomes_do_not_depend_on_what_was_asked_before(c: ChannelParameters, seed: int, asked: list[int]) -> None:
    channel = Channel(c, seed, "uplink")
    outcomes = losses(c, seed, "uplink", max(asked, default=0) + 1)
    for k in [*asked, *asked[-1:], *asked[-1:]]:
        assert channel.lost(k) == outcomes[k]


@pytest.mark.no_cover
@settings(deadline=None, derandomize=True, max_examples=20)
@given(parameters, seeds)
def test_each_outcome_alone_is_that_of_the_whole_run(c: ChannelParameters, seed: int) -> None:
    whole = losses(c, seed, "uplink", 40)
    assert [Channel(c, seed, "uplink").lost(k) for k in range(40)] == whole.tolist()
    assert (losses(c, seed, "uplink", 17) == whole[:17]).all()


@settings(deadline=None, derandomize=True)
@given(parameters, seeds)
def test_a_run_begins_with_the_agv_known_to_the_edge(c: ChannelParameters, seed: int) -> None:
    assert Channel(c, seed, "uplink").lost(0) is False


def test_no_slots() -> None:
    assert losses(ChannelParameters(), 1, "uplink", 0).shape == (0,)


@pytest.mark.parametrize("model", MODELS)
def test_changed_parameters_hold_from_the_next_slot_on(model: str) -> None:
    before = ChannelParameters(model=model, p=0.3, r=0.3, n=2)
    after = dataclasses.replace(before, p=0.0, r=1.0, n=0)
    channel = Channel(before, 1, "uplink")
    first = [channel.lost(k) for k in range(100)]
    channel.parameters = after
    assert first == losses(before, 1, "uplink", 100).tolist()
    assert channel.lost(99) == first[99]
    # At most the outage that is running is still to end.
    assert not any(channel.lost(k) for k in range(101, 200))


@pytest.mark.parametrize(
    "c",
    [
        ChannelParameters(model="gilbert_elliott", p=0.01, r=0.3),
        ChannelParameters(model="gilbert_elliott", p=0.0005, r=0.001, h=0.2, k=0.9),
        ChannelParameters(model="gilbert_elliott", p=0.3, r=0.3),  # both states change in the same slots, forever
        ChannelParameters(model="gilbert_elliott", p=0.01, r=0.3, schedule="200: p=0.3"),
        ChannelParameters(model="bernoulli", p=0.3),
    ],
)
def test_a_slot_far_ahead_has_the_outcome_of_the_whole_run(c: ChannelParameters) -> None:
    outcomes = losses(c, 3, "uplink", 60_000)
    for first in range(30_000, 60_000, 3_001):
        channel = Channel(c, 3, "uplink")
        assert [channel.lost(k) for k in range(first, min(60_000, first + 20))] == outcomes[first : first + 20].tolist()


def test_a_slot_hours_ahead_does_not_take_the_slots_before_it() -> None:
    """A hundred million of them, which would take half an hour."""
    channel = Channel(ChannelParameters(model="gilbert_elliott", p=0.01, r=0.3), 3, "uplink")
    assert channel.outcome(10**8).lost in (True, False)
    assert channel.outcome(5) == Channel(channel.parameters, 3, "uplink").outcome(5)
