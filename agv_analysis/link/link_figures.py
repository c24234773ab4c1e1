"""What a measured link comes to: losses with intervals that know bursts, outages, delays, jitter, a fitted channel."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.link.change_points import Stationarity, stationarity
from agv_analysis.link.channel_fit import ChannelFit, Estimate, fit_channel
from agv_analysis.link.large_arrays import column_of, count_of, order_statistics, parts, taken
from agv_analysis.link.markov_channel import chain_of
from agv_analysis.link.measurement import LOST, UNKNOWN, LossRates, Measurement, PacketOutcomes, Setting
from agv_analysis.link.reception_intervals import Outcomes, Steps, series_of
from agv_analysis.link.resampling import weights
from agv_analysis.metrics.confidence import CONFIDENCE
from agv_analysis.metrics.outages import ages
from agv_analysis.run import Floats
from agv_plant.parameters import ChannelParameters
from agv_ros.parameters import as_dict

PERCENTILES = (50, 95, 99)

UPLINK, DOWNLINK, ROUND_TRIP = "uplink", "downlink", "round_trip"


def _rank(percent: int, count: int) -> int:
    """Place in the order of so many values of the smallest one that so many per cent do not exceed."""
    return max(0, -(-percent * count // 100) - 1)


@dataclass(frozen=True)
class Spread:
    """Percentiles of times [s]; values that occurred."""

    mean: float
    percentiles: tuple[float, ...]
    """At PERCENTILES."""
    largest: float
    count: int

    @classmethod
    def of(cls, values: Callable[[], Iterable[Floats]]) -> Spread | None:
        """Of values, given in parts as often as they are asked for, NaN left out; None if nothing is left."""

        def known() -> Iterator[Floats]:
            return (part[~np.isnan(part)] for part in values())

        count, total, largest = 0, 0.0, -math.inf
        for part in known():
            count, total = count + len(part), total + float(part.sum())
            largest = max(largest, float(part.max(initial=-math.inf)))
        if not count:
            return None
        percentiles = order_statistics(known, [_rank(q, count) for q in PERCENTILES])
        return cls(total / count, tuple(percentiles), largest, count)

    @classmethod
    def of_counts(cls, counts: NDArray[np.int64], unit: float) -> Spread:
        """Of values 0, 1, 2 ... `unit`s, each of which occurred so often."""
        count, upto = int(counts.sum()), np.cumsum(counts)
        found = [unit * float(np.searchsorted(upto, _rank(q, count) + 1)) for q in PERCENTILES]
        mean = unit * float(counts @ np.arange(len(counts))) / count
        return cls(mean, tuple(found), unit * float(np.flatnonzero(counts)[-1]), count)

    def to_json(self) -> dict[str, float]:
        """`mean_s`, `p50_s`, `p95_s`, `p99_s`, `max_s`."""
        named = {f"p{q}_s": value for q, value in zip(PERCENTILES, self.percentiles, strict=True)}
        return {"mean_s": self.mean, **named, "max_s": self.largest}


class DirectionFigures:
    """One direction, or the round trip, of packets sent at times [s], shape (N,)."""

    def __init__(self, name: str, packets: PacketOutcomes, sent: Floats, interval: float) -> None:
        """`interval`: from one packet to the next [s], mostly."""
        self.name, self._interval = name, interval
        self._packets, self._sent = packets, sent

    @cached_property
    def k(self) -> Steps:
        """Numbers of the packets of which the outcome is known, shape (n,)."""
        outcome = self._packets.outcome
        known = (part.start + np.flatnonzero(outcome[part] <= LOST) for part in parts(len(outcome), outcome))
        return column_of(known, np.int64)

    @cached_property
    def lost(self) -> Outcomes:
        """Which of these were lost, shape (n,)."""
        outcome = self._packets.outcome
        known = (outcome[part][outcome[part] <= LOST] == LOST for part in parts(len(outcome), outcome))
        return column_of(known, np.bool_)

    @cached_property
    def count(self) -> int:
        """Packets of which the outcome is known."""
        return count_of(self._packets.outcome, lambda part: part <= LOST)

    @cached_property
    def is_told(self) -> bool:
        """Is it known of every packet that was sent this way what became of it?"""
        return self._packets.is_told

    @cached_property
    def count_lost(self) -> int:
        """Packets that were lost for certain."""
        return count_of(self._packets.outcome, lambda part: part == LOST)

    @cached_property
    def count_unknown(self) -> int:
        """Packets of which the file does not tell whether they were lost on this way."""
        return count_of(self._packets.outcome, lambda part: part == UNKNOWN)

    @cached_property
    def fit(self) -> ChannelFit:
        """A channel fitted to the outcomes that are known."""
        return fit_channel(self.lost, self.k)

    @property
    def loss_rate(self) -> Estimate | None:
        """Share of the packets that was lost, None where the file cannot tell.

        Its interval knows bursts. Where nothing was lost nothing is known of bursts: then it is that of independent
        packets, one-sided.
        """
        if not self.is_told:
            return None
        if not self.count_lost:
            return Estimate(0.0, 0.0, 1.0 - (1.0 - CONFIDENCE) ** (1.0 / self.count))
        return self.fit.loss_rate

    @cached_property
    def outages(self) -> Floats:
        """How long each outage was [s]: from the first packet lost to the next one received, shape (m,).

        One that is open at the end lasts at least to the end of its last packet's interval.
        """
        k = self.k
        begins, lengths, is_lost = series_of(k, self.lost)
        begins, ends = begins[is_lost], (begins + lengths)[is_lost]
        closed, begun = (taken(self._sent, taken(k, np.minimum(at, len(k) - 1))) for at in (ends, begins))
        closed[ends == len(k)] = self._sent[k[-1]] + self._interval
        return np.asarray(closed - begun)

    @property
    def longest(self) -> float:
        """The longest outage [s], 0 if there was none."""
        return float(self.outages.max(initial=0.0))

    @cached_property
    def age(self) -> Spread | None:
        """How old the freshest packet is that has come, by the losses alone [s]; None where the file cannot tell."""
        if not self.is_told or not self.count:
            return None
        k, lost = self.k, self.lost
        counts, newest = np.zeros(0, dtype=np.int64), k[:1]
        for part in parts(len(k), k, lost):
            found = ages(np.append(newest, k[part]), np.append(False, lost[part]))[1:]
            newest = k[part][-1:] - found[-1:]
            more = np.bincount(found, minlength=len(counts))
            more[: len(counts)] += counts
            counts = more
        return Spread.of_counts(counts, self._interval)

    @cached_property
    def delay(self) -> Spread | None:
        """Time under way [s] of what was received; None if it is not known."""
        delay = self._packets.delay
        return None if delay is None else Spread.of(lambda: (delay[part] for part in parts(len(delay), delay)))

    @cached_property
    def jitter(self) -> Spread | None:
        """By how much the delay differs from one packet to the next, in absolute value [s]."""
        delay = self._packets.delay
        if delay is None:
            return None

        def steps() -> Iterator[Floats]:
            return (np.abs(np.diff(delay[part.start : part.stop + 1])) for part in parts(len(delay) - 1, delay))

        return Spread.of(steps)

    def to_json(self) -> dict[str, Any]:
        """The figures by name; `loss_rate` is null where the file cannot tell."""
        return {
            "packets": self.count,
            "lost": self.count_lost,
            "unknown": self.count_unknown,
            "loss_rate": _estimate(self.loss_rate),
            "outages": len(self.outages) if self.is_told else None,
            "outage_max_s": self.longest if self.is_told else None,
            "outage_mean_s": float(self.outages.mean()) if self.is_told and len(self.outages) else None,
            "age": None if self.age is None else self.age.to_json(),
            "delay": None if self.delay is None else self.delay.to_json(),
            "jitter": None if self.jitter is None else self.jitter.to_json(),
        }


class LinkFigures:
    """A measured link, packet by packet."""

    def __init__(self, measured: Measurement) -> None:
        self.measured = measured
        interval = measured.interval
        named = {UPLINK: measured.uplink, DOWNLINK: measured.downlink, ROUND_TRIP: measured.round_trip}
        self.directions = {
            name: DirectionFigures(name, packets, measured.sent, interval)
            for name, packets in named.items()
            if packets is not None
        }
        """By name, those that the file has."""

    @property
    def whole(self) -> DirectionFigures:
        """The round trip, or the one direction that was measured."""
        return next(self.directions[name] for name in (ROUND_TRIP, UPLINK, DOWNLINK) if name in self.directions)

    @property
    def fitted(self) -> DirectionFigures:
        """What a channel is fitted to: the uplink, or where the file does not tell it, the round trip."""
        uplink = self.directions.get(UPLINK)
        return uplink if uplink is not None and uplink.is_told else self.whole

    @cached_property
    def stationarity(self) -> Stationarity:
        """Did the link change while it was measured?"""
        return stationarity(self.fitted.k, self.fitted.lost)

    @property
    def change_times(self) -> list[float]:
        """When it changed, in seconds since the first packet."""
        return [float(self.measured.sent[k]) for k in self.stationarity.change_points]

    def to_json(self) -> dict[str, Any]:
        """The figures by name; SI units; null where the file cannot tell."""
        measured, whole, fit = self.measured, self.whole, self.fitted.fit
        return {
            "source": measured.source,
            "format": measured.format,
            "packets": measured.packets,
            "lost": whole.count_lost,
            "span_s": measured.span,
            "interval_s": measured.interval,
            **{
                name: self.directions[name].to_json() if name in self.directions else _untold()
                for name in (UPLINK, DOWNLINK, ROUND_TRIP)
            },
            "outage_max_s": whole.longest,
            "delay": {"of": whole.name, **(dict.fromkeys(_KEYS) if whole.delay is None else whole.delay.to_json())},
            "jitter": {"of": whole.name, **(dict.fromkeys(_KEYS) if whole.jitter is None else whole.jitter.to_json())},
            "duplicates": measured.duplicates,
            "reordered": measured.reordered,
            "malformed": measured.malformed.count,
            "fit": {"of": self.fitted.name, **_fit(fit)},
            "stationarity": {**self.stationarity.to_json(), "change_times_s": self.change_times},
            "notes": [*measured.notes, *measured.malformed.sentences()],
        }


_KEYS = ("mean_s", *(f"p{q}_s" for q in PERCENTILES), "max_s")


def _untold() -> dict[str, Any]:
    """Of a direction that the file does not tell."""
    return dict.fromkeys(
        (
            "packets",
            "lost",
            "unknown",
            "loss_rate",
            "outages",
            "outage_max_s",
            "outage_mean_s",
            "age",
            "delay",
            "jitter",
        )
    )


def _estimate(found: Estimate | None) -> dict[str, float] | None:
    return None if found is None else {"value": found.value, "low": found.low, "high": found.high}


def _fit(fit: ChannelFit) -> dict[str, Any]:
    """The fitted channel, with the names of the relay's parameters."""
    return {
        "model": fit.model,
        "p": _estimate(fit.p),
        "r": _estimate(fit.r),
        "mean_burst": fit.mean_burst if math.isfinite(fit.mean_burst) else None,
        "loss_rate": _estimate(fit.loss_rate),
        "p_value": fit.p_value,
        "goodness": fit.goodness.to_json(),
    }


def rate_of(found: LossRates) -> Estimate:
    """Loss rate of counted losses; its interval by intervals drawn anew, since packets are not independent.

    Of fewer than eight intervals there is none but [0, 1].
    """
    share = float(found.lost.sum() / found.packets.sum())
    if len(found.packets) < 8:
        return Estimate.about(share, 0.0, 1.0)
    drawn = weights(len(found.packets))
    rates = (drawn @ found.lost) / (drawn @ found.packets)
    return Estimate.about(share, *(float(value) for value in np.quantile(rates, [0.0225, 0.9775])))


def rates_to_json(found: LossRates) -> dict[str, Any]:
    """The figures of counted losses by name, null for all that counts do not tell."""
    rate = {"loss_rate": _estimate(rate_of(found)), "packets": int(found.packets.sum()), "lost": int(found.lost.sum())}
    ways = (UPLINK, DOWNLINK) if found.is_uplink else (DOWNLINK, UPLINK)
    return {
        "source": found.source,
        "format": found.format,
        "packets": int(found.packets.sum()),
        "lost": int(found.lost.sum()),
        "span_s": float(found.end[-1] - found.begin[0]),
        "interval_s": None,
        ways[0]: {**_untold(), **rate},
        ways[1]: _untold(),
        ROUND_TRIP: _untold(),
        "outage_max_s": None,
        "delay": dict.fromkeys(("of", *_KEYS)),
        **_of_packets(),
        "intervals": [
            {"begin_s": begin, "end_s": end, "packets": packets, "lost": lost}
            for begin, end, packets, lost in zip(
                *(column.tolist() for column in (found.begin, found.end, found.packets, found.lost)), strict=True
            )
        ],
        "no_trace_because": found.refusal,
        "notes": list(found.notes),
    }


def _of_packets() -> dict[str, Any]:
    """What only packets, one by one, would tell: nothing."""
    unknown = dict.fromkeys(("duplicates", "reordered", "malformed", "fit", "stationarity"))
    return {"jitter": dict.fromkeys(("of", *_KEYS)), **unknown}


def setting_to_json(found: Setting) -> dict[str, Any]:
    """What an emulator was set to, as a channel, with the keys of a measurement; null for what only that would tell."""
    changed = ("model", "p", "r", "h", "k", "delay", "jitter", "duplicate")
    values, chain = as_dict(found.channel), chain_of(found.channel)
    rate = None if chain is None else {"value": chain.loss_rate, "low": chain.loss_rate, "high": chain.loss_rate}
    return {
        "source": found.source,
        "format": found.format,
        "packets": None,
        "lost": None,
        "span_s": None,
        "interval_s": None,
        UPLINK: {**_untold(), "loss_rate": rate, "delay": _delays_set(found.channel)},
        DOWNLINK: _untold(),
        ROUND_TRIP: _untold(),
        "outage_max_s": None,
        "delay": {"of": UPLINK, **_delays_set(found.channel)},
        **_of_packets(),
        "notes": [],
        "channel": {name: values[name] for name in changed},
        "exact": not found.differences,
        "differences": list(found.differences),
    }


def _delays_set(channel: ChannelParameters) -> dict[str, float]:
    """Percentiles of a delay that is uniform in delay +- jitter, but not below 0 [s]."""
    delay, jitter = channel.delay, channel.jitter
    late = [max(0.0, delay + jitter * (q / 50.0 - 1.0)) for q in PERCENTILES]
    mean = delay if jitter <= delay else (delay + jitter) ** 2 / (4.0 * jitter)
    return Spread(mean, tuple(late), delay + jitter, 0).to_json()
