"""A channel's verdicts as a function of the slot alone, and what the receiver behind it holds."""

from __future__ import annotations

import dataclasses
from itertools import groupby

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_plant.channels import MODELS
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.link import Channel, Link, losses
from agv_ros.messages import DELIVERED, LOST
from agv_ros.stamps import Grid, OffGridError

GRID = Grid(1_000_000_000, 5_000_000)
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
def test_verdicts_do_not_depend_on_what_was_asked_before(c: ChannelParameters, seed: int, asked: list[int]) -> None:
    channel = Channel(c, seed, "uplink")
    verdicts = losses(c, seed, "uplink", max(asked, default=0) + 1)
    for k in [*asked, *asked[-1:], *asked[-1:]]:
        assert channel.lost(k) == verdicts[k]


@pytest.mark.no_cover
@settings(deadline=None, derandomize=True, max_examples=20)
@given(parameters, seeds)
def test_each_verdict_alone_is_that_of_the_whole_run(c: ChannelParameters, seed: int) -> None:
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


# -- the link --------------------------------------------------------------------------------------------------------


def link(c: ChannelParameters) -> Link:
    return Link(Channel(c, 1, "uplink"), GRID)


@settings(deadline=None, derandomize=True, max_examples=60)
@given(parameters, st.integers(1, 200))
def test_the_freshest_stamp_is_that_of_the_last_delivery(c: ChannelParameters, steps: int) -> None:
    lost = losses(c, 1, "uplink", steps)
    radio = link(c)
    for k in range(steps):
        slot = radio.transmit(GRID.stamp(k)).slot
        delivered = np.flatnonzero(~lost[: k + 1])
        assert slot[:3] == (GRID.stamp(k), GRID.stamp(int(delivered[-1])), LOST if lost[k] else DELIVERED)


@settings(deadline=None, derandomize=True, max_examples=60)
@given(parameters, st.lists(st.integers(0, 30), min_size=1, max_size=40))
def test_a_late_or_repeated_message_makes_nothing_older(c: ChannelParameters, order: list[int]) -> None:
    lost = losses(c, 1, "uplink", 31)
    radio, freshest = link(c), 0
    for k in order:
        if not lost[k]:
            freshest = GRID.stamp(k) if k == 0 else max(freshest, GRID.stamp(k))
        assert radio.transmit(GRID.stamp(k)).slot[:3] == (GRID.stamp(k), freshest, LOST if lost[k] else DELIVERED)


def test_before_the_first_delivery_nothing_is_held() -> None:
    radio = link(ChannelParameters(model="burst", n=5, start_step=3))
    assert [radio.transmit(GRID.stamp(k)).slot.freshest_ns for k in (3, 4, 8)] == [0, 0, GRID.stamp(8)]


def test_what_is_sent_again_in_an_outage_brings_the_freshest_again() -> None:
    radio = link(ChannelParameters(model="burst", n=5, start_step=3))
    arrived = [radio.transmit(GRID.stamp(k), str(k).encode()).arrived for k in (0, 1, 2, 3, 4, 4, 4, 5, 5)]
    assert arrived == [[b"0"], [b"1"], [b"2"], [], [], [b"2"], [b"2"], [], [b"2"]]
    late = link(ChannelParameters(delay=0.01))
    arrived = [late.transmit(GRID.stamp(k), str(k).encode()).arrived for k in (0, 1, 1, 2, 3)]
    assert arrived == [[b"0"], [], [b"0"], [], [b"1", b"1"]]


def test_a_second_run_has_the_same_verdicts_and_holds_nothing_of_the_first() -> None:
    radio = link(ChannelParameters(model="bernoulli", p=0.5))
    first, second = ([radio.transmit(GRID.stamp(k)) for k in range(100)] for _ in range(2))
    assert first == second


@pytest.mark.parametrize("stamp_ns", [0, GRID.start_ns - GRID.ts_ns, GRID.start_ns + 1, GRID.stamp(5) - 1])
def test_a_message_beside_the_grid_takes_no_slot(stamp_ns: int) -> None:
    radio = link(ChannelParameters(model="bernoulli", p=0.5))
    undisturbed = link(ChannelParameters(model="bernoulli", p=0.5))
    for k in range(20):
        with pytest.raises(OffGridError):
            radio.transmit(stamp_ns)
        assert radio.transmit(GRID.stamp(k)) == undisturbed.transmit(GRID.stamp(k))


@settings(deadline=None, derandomize=True, max_examples=60)
@given(parameters, st.integers(1, 200))
def test_a_link_counts_what_became_of_its_messages(c: ChannelParameters, steps: int) -> None:
    lost = losses(c, 1, "uplink", steps)
    radio = link(c)
    for k in range(steps):
        radio.transmit(GRID.stamp(k))
    runs = [sum(1 for _ in group) for value, group in groupby(lost.tolist()) if value]
    assert (radio.sent, radio.lost, radio.longest) == (steps, lost.sum(), max(runs, default=0))
