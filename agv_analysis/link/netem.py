"""A channel's parameters in the words of Linux' netem; `netem_text` reads them.

`loss gemodel p r 1-h 1-k` is the channel gilbert_elliott, `loss random p` the channel bernoulli; `delay time jitter`
and `duplicate p` come on top of it. netem writes per cent and milliseconds; these are converted as decimal numbers, so
that what goes out comes in again unchanged.

Source: tc-netem(8).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from decimal import Decimal

from agv_plant.parameters import ChannelParameters
from agv_ros.errors import UserError


class NetemError(UserError):
    """A line that netem would not take, or a channel that it does not have."""


def to_netem(channel: ChannelParameters) -> str:
    """What follows `tc qdisc ... netem` for this channel. Raises NetemError for what netem does not have."""
    for name, usual in (("schedule", ""), ("lifetime", math.inf), ("reliable", False)):
        if getattr(channel, name) != usual:
            raise NetemError(f"netem has no {name}; the channel's is {getattr(channel, name)}")
    clauses = [*_delay(channel), *_loss(channel), *_duplicate(channel)]
    if not clauses:
        raise NetemError("netem has no channel perfect, only bernoulli and gilbert_elliott, late ones and doubled ones")
    return " ".join(clauses)


def _loss(channel: ChannelParameters) -> Iterator[str]:
    if channel.model == "bernoulli":
        yield f"loss random {_percent(_exact(channel.p))}"
    elif channel.model == "gilbert_elliott":
        one = Decimal(1)
        figures = (_exact(channel.p), _exact(channel.r), one - _exact(channel.h), one - _exact(channel.k))
        yield "loss gemodel " + " ".join(map(_percent, figures))
    elif channel.model != "perfect":
        raise NetemError(f"netem has no channel {channel.model}, only bernoulli and gilbert_elliott")


def _delay(channel: ChannelParameters) -> Iterator[str]:
    if channel.delay + channel.jitter > 0.0:
        jitter = f" {_milliseconds(channel.jitter)}" if channel.jitter > 0.0 else ""
        yield f"delay {_milliseconds(channel.delay)}{jitter}"


def _duplicate(channel: ChannelParameters) -> Iterator[str]:
    if channel.duplicate > 0.0:
        yield f"duplicate {_percent(_exact(channel.duplicate))}"


def _exact(value: float) -> Decimal:
    """The shortest decimal number that reads as `value`: as a person would write it."""
    return Decimal(repr(value))


def _percent(share: Decimal) -> str:
    text = format(share * 100, "f")
    return (text.rstrip("0").rstrip(".") if "." in text else text) + "%"


def _milliseconds(seconds: float) -> str:
    text = format(_exact(seconds) * 1000, "f")
    return (text.rstrip("0").rstrip(".") if "." in text else text) + "ms"
