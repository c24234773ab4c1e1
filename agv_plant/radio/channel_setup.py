"""A channel prepared for a run: its segments between changes, and its model's table of the floor."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

from agv_plant.channels.coverage_hole import rows_of as holes
from agv_plant.channels.rayleigh import rows_of as waves
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.delay import whole_slots
from agv_plant.radio.schedule import OUTAGE, Outage

UPLINK = "uplink"
"""The stream with which a correlated channel has its random numbers or its field in common."""


class Segment(NamedTuple):
    """Slots in which a channel does not change: from slot `first` on."""

    first: int
    channel: ChannelParameters
    outage: Outage


def segments_of(channel: ChannelParameters, ts: float) -> tuple[Segment, ...]:
    """A channel cut where its schedule changes it; the first segment begins with slot 0."""
    found = [Segment(0, channel, Outage())]
    for at, name, value, outage in channel.entries:
        first, last = whole_slots(at / ts), found[-1]
        changed = (
            last._replace(first=first, outage=outage)
            if name == OUTAGE
            else last._replace(first=first, channel=_with(last.channel, name, value))
        )
        found = [*(found[:-1] if last.first == first else found), changed]
    return tuple(found)


def _with(channel: ChannelParameters, name: str, value: float) -> ChannelParameters:
    replace: Callable[..., ChannelParameters] = dataclasses.replace
    return replace(channel, **{name: value})


def spatial_table_of(channel: ChannelParameters, seed: int, stream: str) -> list[list[float]]:
    """The table of the floor of a channel's model: rows of five numbers.

    `correlation` is the coefficient of correlation between the complex gains of a fading downlink and uplink.
    """
    if channel.model == "rayleigh":
        shared = channel.correlation**2 if stream != UPLINK else 0.0
        own = waves(seed, stream, channel.carrier, 1.0 - shared) if shared < 1.0 else []
        return [*own, *(waves(seed, UPLINK, channel.carrier, shared) if shared > 0.0 else [])]
    return holes(channel.hole_circles, channel.hole_polygons)


def levels_of(channel: ChannelParameters) -> tuple[float, float]:
    """The two numbers of a placed model that may change while it runs."""
    return (channel.margin, 0.0) if channel.model == "rayleigh" else (channel.p, channel.hole_loss)
