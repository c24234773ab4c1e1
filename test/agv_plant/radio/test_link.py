"""A link: what the receiver behind a channel holds after each slot, and what the link counts."""

from __future__ import annotations

from itertools import groupby

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import Channel, losses
from agv_plant.radio.link import Link
from agv_ros.messages import DELIVERED, LOST
from agv_ros.stamps import Grid, OffGridError
from test.agv_plant.radio.test_channel import parameters

GRID = Grid(1_000_000_000, 5_000_000)


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


def test_a_second_run_has_the_same_outcomes_and_holds_nothing_of_the_first() -> None:
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
