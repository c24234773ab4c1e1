"""What people write for netem, as a channel of ours: exact where ours can, else the nearest, with the difference said.

A line may be options alone (`loss 5% 25% delay 20ms`), a command (`tc qdisc add dev eth0 root netem ...`) or what
`tc qdisc show` prints. Correlated losses, `loss p rho`, compare x' = (1 - rho) u + rho x with p, u uniform: x is not
uniform, so netem's loss rate is not p. The Gilbert channel with the loss rate and the mean burst of that recursion,
computed on a grid, stands for it. `loss state` with p13 and p31 alone is a Gilbert channel; with more it has four
states, and the Gilbert channel with its loss rate and mean burst stands for it.

Source: tc-netem(8); get_crandom and loss_4state in Linux' net/sched/sch_netem.c.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Sequence
from decimal import Decimal

import numpy as np

from agv_analysis.link.markov_channel import Chain, bursty
from agv_analysis.link.netem import NetemError
from agv_plant.parameters import ChannelParameters

_SECONDS = {
    **dict.fromkeys(("s", "sec", "secs"), Decimal(1)), **dict.fromkeys(("ms", "msec", "msecs"), Decimal("1e-3")),
    **dict.fromkeys(("us", "usec", "usecs", ""), Decimal("1e-6")),
    **dict.fromkeys(("ns", "nsec", "nsecs"), Decimal("1e-9")),
}  # fmt: skip
"""What a unit of time is worth [s]; without one netem takes a number for microseconds."""

_NUMBER = r"(\d+\.?\d*(?:e-?\d+)?|\.\d+(?:e-?\d+)?)"
_PERCENT = re.compile(rf"{_NUMBER}%?", re.IGNORECASE)
_TIME = re.compile(rf"{_NUMBER}([a-z]*)", re.IGNORECASE)
_LABELS = ("p", "r", "1-h", "1-k", "p13", "p31", "p32", "p23", "p14", "random", "ecn")
_SKIPPED = {"limit": 1, "seed": 1, "ecn": 0}
"""Options that say nothing of a single message of the loop, and how many words follow them."""

_PLACES = {"dev": 1, "root": 0, "parent": 1, "handle": 1, "refcnt": 1}
"""What `tc qdisc show` prints of where a qdisc is, and how many words follow."""

_GRID = 1000


class _Line:
    """The words of a line, one after the other."""

    def __init__(self, line: str) -> None:
        self.text = line
        words = line.replace("\\\n", " ").split()
        if "netem" in words:
            words = words[words.index("netem") + 1 :]
            while words and (words[0] in _PLACES or words[0].endswith(":")):
                del words[: 1 + _PLACES.get(words[0], 0)]
        self.words = words

    def take(self) -> str:
        return self.words.pop(0)

    def shares(self) -> list[Decimal]:
        """Percentages that follow as shares, labels between them left out; exactly as they are written."""
        found = list[Decimal]()
        while self.words:
            number = _PERCENT.fullmatch(self.words[0])
            if number is not None:
                share = Decimal(number[1]) / 100
                if share > 1:
                    raise NetemError(f"netem: a percentage must be from 0% to 100%, got {self.words[0]!r}")
                found.append(share)
            elif self.words[0] not in _LABELS:
                break
            self.words.pop(0)
        return found

    def times(self) -> list[float]:
        """Times [s] that follow."""
        found: list[float] = []
        while self.words and self._is_time():
            number = _TIME.fullmatch(self.take())
            assert number is not None
            found.append(float(Decimal(number[1]) * _SECONDS[number[2].lower()]))
            if not math.isfinite(found[-1]):
                raise NetemError(f"netem: no delay is as long as {number[0][:40]!r}")
        return found

    def _is_time(self) -> bool:
        number = _TIME.fullmatch(self.words[0])
        return number is not None and number[2].lower() in _SECONDS


def read_netem(line: str, channel: ChannelParameters) -> tuple[ChannelParameters, tuple[str, ...]]:
    """`channel` as a line of netem has it, and a sentence for each difference. Raises NetemError.

    Its other parameters stay. What the line leaves out is as in netem: of gemodel p alone is independent losses
    (r = 1 - p), the bad state loses all and the good one nothing; without `loss` nothing is lost, without `delay`
    nothing is late, without `duplicate` nothing comes twice.
    """
    words, differences = _Line(line), list[str]()
    found = dataclasses.replace(channel, model="perfect", delay=0.0, jitter=0.0, duplicate=0.0)
    known = set[_Reader]()
    while words.words:
        word = words.take()
        if word in _READERS:
            reader = _READERS[word]
            if reader in known:
                raise NetemError(f"netem takes {word} once, in {line.strip()!r}")
            known.add(reader)
            found = reader(words, found, differences)
        elif word in _SKIPPED:
            del words.words[: _SKIPPED[word]]
        else:
            raise NetemError(
                f"netem has no {word!r}, in {line.strip()!r}: known are {', '.join((*_READERS, *_SKIPPED))}"
            )
    if not known:
        raise NetemError(f"{line.strip()!r} sets nothing of a channel: known are {', '.join(_READERS)}")
    return found, tuple(differences)


def is_netem(text: str) -> bool:
    """Does a text look like a line for netem?"""
    words = text.split()
    while len(words) > 2 and words[0] in _SKIPPED:
        del words[: 1 + _SKIPPED[words[0]]]
    if not words or len(text) > 2000:
        return False
    return "netem" in words or (
        words[0] in _READERS and len(words) > 1 and bool(re.match(r"[0-9.]|gemodel|state|random", words[1]))
    )


def _loss(line: _Line, channel: ChannelParameters, differences: list[str]) -> ChannelParameters:
    kind = line.take() if line.words and line.words[0] in ("gemodel", "state", "random") else "random"
    shares = line.shares()
    if not shares:
        raise NetemError(f"netem: loss needs a percentage, in {line.text.strip()!r}")
    _most(shares, {"gemodel": 4, "state": 5, "random": 2}[kind], f"loss {kind}", line)
    if kind == "gemodel":
        figures = (*shares, *(1 - shares[0], Decimal(1), Decimal(0))[len(shares) - 1 :])
        p, r, h, k = figures[0], figures[1], 1 - figures[2], 1 - figures[3]
        return dataclasses.replace(channel, model="gilbert_elliott", p=float(p), r=float(r), h=float(h), k=float(k))
    if kind == "state":
        return _states(shares, channel, differences)
    probability, correlation = (*map(float, shares), 0.0)[:2]
    if correlation >= 1.0:
        raise NetemError(
            f"netem: losses that are correlated by 100% are all or none, forever, in {line.text.strip()!r}"
        )
    if correlation == 0.0:
        return dataclasses.replace(channel, model="bernoulli", p=probability)
    rate, burst = correlated_loss(probability, correlation)
    differences.append(
        f"loss {probability:.6g} with correlation {correlation:.6g}: netem's own recursion loses {rate:.4g} of the "
        f"packets, {burst:.4g} in a row on average; the Gilbert channel of these two figures stands for it"
    )
    return _gilbert(rate, burst, channel)


def _most(shares: Sequence[Decimal], count: int, what: str, line: _Line) -> None:
    if len(shares) > count:
        raise NetemError(f"netem: {what} takes {count} percentages at most, got {len(shares)} in {line.text.strip()!r}")


def _states(shares: Sequence[Decimal], channel: ChannelParameters, differences: list[str]) -> ChannelParameters:
    usual = (1 - shares[0], Decimal(0), Decimal(1), Decimal(0))
    p13, p31, p32, p23, p14 = map(float, (*shares, *usual[len(shares) - 1 :]))
    if p32 == 0.0 and p14 == 0.0:  # then there is no burst with receptions in it, and no loss outside of one
        return dataclasses.replace(channel, model="gilbert_elliott", p=p13, r=p31, h=0.0, k=1.0)
    chain = four_states(p13, p31, p32, p23, p14)
    differences.append(
        f"loss state has four states, which lose {chain.loss_rate:.4g}, {chain.mean_burst:.4g} in a row on average; "
        "the Gilbert channel of these two figures stands for it"
    )
    return _gilbert(chain.loss_rate, chain.mean_burst, channel)


def _gilbert(rate: float, burst: float, channel: ChannelParameters) -> ChannelParameters:
    if rate in (0.0, 1.0):
        return dataclasses.replace(channel, model="bernoulli", p=rate)
    T = bursty(rate, max(1.0, burst)).transition
    return dataclasses.replace(channel, model="gilbert_elliott", p=float(T[0, 1]), r=float(T[1, 0]), h=0.0, k=1.0)


def four_states(p13: float, p31: float, p32: float, p23: float, p14: float) -> Chain:
    """netem's loss state as a chain: received in a gap, received in a burst, lost in a burst, lost in a gap.

    A transition and the packet it decides come together in netem; a state here is the one after the transition.
    """
    T = np.array([
        [1.0 - p13 - p14, 0.0, p13, p14],
        [0.0, 1.0 - p23, p23, 0.0],
        [p31, p32, 1.0 - p31 - p32, 0.0],
        [1.0, 0.0, 0.0, 0.0],
    ])  # fmt: skip
    return Chain(np.clip(T, 0.0, 1.0), np.array([1.0, 1.0, 0.0, 0.0]))


def correlated_loss(p: float, rho: float) -> tuple[float, float]:
    """Loss rate and mean burst of x' = (1 - rho) u + rho x, a packet being lost where x < p; on a grid of x."""
    x = (np.arange(_GRID) + 0.5) / _GRID
    edges = np.arange(_GRID + 1) / _GRID
    below = np.clip((edges[None, :] - rho * x[:, None]) / (1.0 - rho), 0.0, 1.0)
    T = np.diff(below, axis=1)  # from a cell to each other
    # Stationary: density T = density, of sum 1; the ones make the singular system regular.
    density = np.linalg.solve(T.T - np.eye(_GRID) + 1.0, np.ones(_GRID))
    is_lost = np.clip(p * _GRID - np.arange(_GRID), 0.0, 1.0)  # the share of the cell that is below p
    rate = float(density @ is_lost)
    ends = float((density * is_lost) @ T @ (1.0 - is_lost))
    return rate, rate / ends if ends > 0.0 else 1.0


def _delay(line: _Line, channel: ChannelParameters, differences: list[str]) -> ChannelParameters:
    times = line.times()
    if not 1 <= len(times) <= 2:
        raise NetemError(f"netem: delay needs a time, as in delay 20ms, in {line.text.strip()!r}")
    shares = line.shares()
    delay, jitter = (*times, 0.0)[:2]
    if shares and shares[0] > 0.0:
        differences.append(f"delays are correlated by {shares[0]:.6g} in netem, and independent of each other here")
    shape = ""
    if line.words[:1] == ["distribution"]:
        line.take()
        shape = line.take() if line.words else ""
    if shape and shape != "uniform" and jitter > 0.0:
        # netem's tables have the standard deviation `jitter`, a uniform delay +- w has w / sqrt(3).
        jitter = math.sqrt(3.0) * jitter
        differences.append(
            f"the {shape} distribution of delays is a uniform one here, with its mean and standard deviation: "
            f"{1e3 * delay:.6g} ms +- {1e3 * jitter:.4g} ms"
        )
    return dataclasses.replace(channel, delay=delay, jitter=jitter)


def _duplicate(line: _Line, channel: ChannelParameters, differences: list[str]) -> ChannelParameters:
    shares = line.shares()
    if not shares:
        raise NetemError(f"netem: duplicate needs a percentage, in {line.text.strip()!r}")
    if len(shares) > 1 and shares[1] > 0.0:
        differences.append("duplicates are correlated in netem, and independent of each other here")
    return dataclasses.replace(channel, duplicate=float(shares[0]))


def _corrupt(line: _Line, channel: ChannelParameters, differences: list[str]) -> ChannelParameters:
    share = (*line.shares(), Decimal(0))[0]
    differences.append(
        f"corrupt {share:.6g}: a packet with a wrong bit fails its checksum, which is a loss more; it is left out here"
    )
    return channel


def _reorder(line: _Line, channel: ChannelParameters, differences: list[str]) -> ChannelParameters:
    share = (*line.shares(), Decimal(0))[0]
    if line.words[:1] == ["gap"]:
        del line.words[:2]
    differences.append(
        f"reorder {share:.6g}: netem sends this share of the packets without the delay; here all have it, and overtake "
        "each other only by jitter"
    )
    return channel


def _gap(line: _Line, channel: ChannelParameters, differences: list[str]) -> ChannelParameters:
    if line.words:
        line.take()
    differences.append("gap: netem sends one packet in so many without the delay; here all have it")
    return channel


def _rate(line: _Line, channel: ChannelParameters, differences: list[str]) -> ChannelParameters:
    rate = line.take() if line.words else ""
    while line.words and re.fullmatch(r"-?\d+|packetoverhead|cellsize|celloverhead", line.words[0]):
        line.take()  # numbers, which `tc qdisc show` names
    differences.append(f"rate {rate}: a packet takes its length over the rate longer in netem; left out here")
    return channel


def _slot(line: _Line, channel: ChannelParameters, differences: list[str]) -> ChannelParameters:
    while line.words and line.words[0] not in _READERS:
        line.take()
    differences.append("slot: netem sends packets in bunches; left out here")
    return channel


_Reader = Callable[[_Line, ChannelParameters, "list[str]"], ChannelParameters]

_READERS: dict[str, _Reader] = {
    "loss": _loss, "drop": _loss, "delay": _delay, "latency": _delay, "duplicate": _duplicate, "corrupt": _corrupt,
    "reorder": _reorder, "gap": _gap, "rate": _rate, "slot": _slot,
}  # fmt: skip
