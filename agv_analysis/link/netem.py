"""Linux' netem and a channel's parameters: the same figures, in its words.

`loss gemodel p r 1-h 1-k` is the channel gilbert_elliott, `loss random p` the channel bernoulli; `delay time jitter`
and `duplicate p` come on top of it. netem writes per cent and milliseconds; these are converted as decimal numbers, so
that what goes out comes in again unchanged.

Source: tc-netem(8).
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator
from decimal import Decimal, InvalidOperation

from agv_plant.parameters import ChannelParameters
from agv_ros.errors import UserError

_ALLOWED = (
    "loss gemodel P [R [1-H [1-K]]] or loss random P, delay TIME [JITTER] and duplicate P, each P a percentage from 0% "
    "to 100%, times in s, ms or us"
)

_CLAUSES = ("loss", "delay", "duplicate")

_SECONDS = {"s": Decimal(1), "ms": Decimal("1e-3"), "us": Decimal("1e-6"), "": Decimal("1e-6")}
"""What a unit of time is worth [s]; without one netem takes a number for microseconds."""


class NetemError(UserError):
    """A line that netem would not take, or a channel that it does not have."""


def to_netem(channel: ChannelParameters) -> str:
    """What follows `tc qdisc ... netem` for this channel. Raises NetemError for what netem does not have."""
    for name, usual in (("schedule", ""), ("lifetime", math.inf)):
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


def from_netem(line: str, channel: ChannelParameters) -> ChannelParameters:
    """`channel` with the model and the figures of such a line; its other parameters stay. Raises NetemError.

    What the line leaves out is as in netem: p alone is independent losses (r = 1 - p), and the bad state loses all, the
    good state nothing; without `loss` nothing is lost, without `delay` nothing is late, without `duplicate` nothing
    comes twice.
    """
    clauses = _clauses(line)
    found = dataclasses.replace(channel, model="perfect", delay=0.0, jitter=0.0, duplicate=0.0)
    for name, words in clauses.items():
        if name == "loss":
            found = _lossy(words, line, found)
        elif name == "delay" and 1 <= len(words) <= 2:
            delay, jitter = [*(_seconds(word, line) for word in words), 0.0][:2]
            found = dataclasses.replace(found, delay=delay, jitter=jitter)
        elif name == "duplicate" and len(words) == 1:
            found = dataclasses.replace(found, duplicate=float(_share(words[0], line)))
        else:
            raise _refused(line)
    return found


def _clauses(line: str) -> dict[str, list[str]]:
    """A line's words by what they belong to."""
    clauses: dict[str, list[str]] = {}
    words: list[str] | None = None
    for word in line.split():
        if word in _CLAUSES and word not in clauses:
            words = clauses[word] = []
        elif words is None or word in _CLAUSES:
            raise _refused(line)
        else:
            words.append(word)
    if not clauses:
        raise _refused(line)
    return clauses


def _lossy(words: list[str], line: str, channel: ChannelParameters) -> ChannelParameters:
    figures = [_share(word, line) for word in words[1:]]
    if words[:1] == ["random"] and len(figures) == 1:
        return dataclasses.replace(channel, model="bernoulli", p=float(figures[0]))
    if words[:1] == ["gemodel"] and 1 <= len(figures) <= 4:
        one = Decimal(1)
        p, r, lost_bad, lost_good = figures + [one - figures[0], one, Decimal(0)][len(figures) - 1 :]
        return dataclasses.replace(
            channel, model="gilbert_elliott", p=float(p), r=float(r), h=float(one - lost_bad), k=float(one - lost_good)
        )
    raise _refused(line)


def _refused(line: str) -> NetemError:
    return NetemError(f"netem's line must be {_ALLOWED}; got {line!r}")


def _exact(value: float) -> Decimal:
    """The shortest decimal number that reads as `value`: as a person would write it."""
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
        raise NetemError(f"netem's line must be {_ALLOWED}; got {word!r} in {line!r}")
    return share


def _milliseconds(seconds: float) -> str:
    text = format(_exact(seconds) * 1000, "f")
    return (text.rstrip("0").rstrip(".") if "." in text else text) + "ms"


def _seconds(word: str, line: str) -> float:
    found = re.fullmatch(r"([0-9.]+)(s|ms|us)?", word)
    try:
        if found is not None:
            return float(Decimal(found[1]) * _SECONDS[found[2] or ""])
    except InvalidOperation:
        pass
    raise NetemError(f"netem's line must be {_ALLOWED}; got {word!r} in {line!r}")
