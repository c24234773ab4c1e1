"""Linux' netem and a channel's parameters: the same figures, in its words.

`loss gemodel p r 1-h 1-k` is the channel gilbert_elliott, `loss random p` the channel bernoulli. netem writes per cent;
these are converted as decimal numbers, so that what goes out comes in again unchanged.

Source: tc-netem(8).
"""

from __future__ import annotations

import dataclasses
from decimal import Decimal, InvalidOperation

from agv_plant.parameters import ChannelParameters
from agv_ros.errors import UserError

_ALLOWED = "loss gemodel P [R [1-H [1-K]]] or loss random P, each a percentage from 0% to 100%"


class NetemError(UserError):
    """A line that netem would not take, or a channel that it does not have."""


def to_netem(channel: ChannelParameters) -> str:
    """What follows `tc qdisc ... netem` for this channel. Raises NetemError for a model that netem does not have."""
    if channel.model == "bernoulli":
        return f"loss random {_percent(_exact(channel.p))}"
    if channel.model == "gilbert_elliott":
        one = Decimal(1)
        figures = (_exact(channel.p), _exact(channel.r), one - _exact(channel.h), one - _exact(channel.k))
        return "loss gemodel " + " ".join(map(_percent, figures))
    raise NetemError(f"netem has no channel {channel.model}, only bernoulli and gilbert_elliott")


def from_netem(line: str, channel: ChannelParameters) -> ChannelParameters:
    """`channel` with the model and the figures of such a line; its other parameters stay. Raises NetemError.

    What the line leaves out is as in netem: p alone is independent losses (r = 1 - p), and the bad state loses all, the
    good state nothing.
    """
    words = line.split()
    figures = [_share(word, line) for word in words[2:]]
    if words[:2] == ["loss", "random"] and len(figures) == 1:
        return dataclasses.replace(channel, model="bernoulli", p=float(figures[0]))
    if words[:2] == ["loss", "gemodel"] and 1 <= len(figures) <= 4:
        one = Decimal(1)
        p, r, lost_bad, lost_good = figures + [one - figures[0], one, Decimal(0)][len(figures) - 1 :]
        return dataclasses.replace(
            channel, model="gilbert_elliott", p=float(p), r=float(r), h=float(one - lost_bad), k=float(one - lost_good)
        )
    raise NetemError(f"netem's losses must be {_ALLOWED}; got {line!r}")


def _exact(value: float) -> Decimal:
    """The shortest decimal number that reads as `value`: what somebody wrote."""
    return Decimal(repr(value))


def _percent(share: Decimal) -> str:
    text = format(share * 100, "f")
    return (text.rstrip("0").rstrip(".") if "." in text else text) + "%"


def _share(word: str, line: str) -> Decimal:
    try:
        share = Decimal(word.removesuffix("%")) / 100
    except InvalidOperation:
        share = Decimal(-1)
    if not (share.is_finite() and 0 <= share <= 1):
        raise NetemError(f"netem's losses must be {_ALLOWED}; got {word!r} in {line!r}")
    return share
