"""What the radio channel did to a run: losses, outages, age of information."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import LinkSlots, Run
from agv_ros.errors import UserError

Steps = NDArray[np.int64]
Outcomes = NDArray[np.bool_]


@dataclass(frozen=True)
class Age:
    """Age of information over a run, in steps: how old the freshest message is that the receiver holds."""

    mean: float
    p50: int
    p99: int
    max: int
    ts: float
    """Sampling period T_s [s]."""

    @property
    def seconds(self) -> tuple[float, float, float, float]:
        """Mean, p50, p99 and maximum [s]."""
        return self.mean * self.ts, self.p50 * self.ts, self.p99 * self.ts, self.max * self.ts


@dataclass(frozen=True)
class LinkOutages:
    """Outages of one direction of the link; an outage is a series of consecutive lost slots."""

    slots: int
    lost: int
    histogram: dict[int, int]
    """Number of outages by their length in slots, ascending, one still open at the end counted with what was seen."""
    open_slots: int
    """Length of the outage that was still open when the run ended, 0 if there was none."""
    age: Age
    """Steps since the freshest message that the receiver holds was sent: 0 at a reception."""
    age_received: Age | None = None
    """The same by receive time, where the timing of the run was not what its slots say."""

    @property
    def loss_rate(self) -> float:
        """Share of slots that were lost."""
        return self.lost / self.slots

    @property
    def count(self) -> int:
        """Number of outages."""
        return sum(self.histogram.values())

    @property
    def longest(self) -> int:
        """Slots of the longest outage, 0 if there was none."""
        return max(self.histogram, default=0)

    @property
    def mean_burst(self) -> float:
        """Mean length of an outage in slots, 0 if there was none."""
        return self.lost / self.count if self.count else 0.0


@dataclass(frozen=True)
class Outages:
    """Outages of both directions."""

    uplink: LinkOutages
    """The poses on their way to the edge; its age is n_ul."""
    downlink: LinkOutages
    """The commands on their way to the AGV."""
    command_age: Age | None = None
    """Age of the pose behind the command that acted, where the timing of the run was not what its slots say."""

    @property
    def loss_rate(self) -> float:
        """Share of uplink slots that were lost."""
        return self.uplink.loss_rate

    @property
    def n_ul_max(self) -> int:
        """Largest number of steps since the freshest pose that the edge held, by the slots."""
        return self.uplink.age.max

    @property
    def n_max(self) -> int:
        """The same of the pose behind the command that acted, by receive time where that is more."""
        return max(self.n_ul_max, 0 if self.command_age is None else self.command_age.max)


def outages(run: Run) -> Outages:
    """Outages of a run. Raises UserError if the run has no step.

    The ages are those that the slots say, beside them those by receive time where the run's timing was another; that of
    the downlink follows from its outcomes where it is not recorded.
    Where steps are missing from a recording an outage ends, since the outcomes of those slots are unknown.
    """
    if not len(run):
        raise UserError(f"{run.source}: no step of the loop in it, so no outage: record at least one")
    n_dl = ages(run.k, run.downlink_lost) if run.n_dl is None else run.n_dl
    return Outages(
        uplink=_as_received(link_outages(run.k, run.lost, run.n_ul, run.ts), run.n_ul_received, run),
        downlink=_as_received(link_outages(run.k, run.downlink_lost, n_dl, run.ts), run.n_dl_received, run),
        command_age=age_statistics(run.command_age, run.ts) if run.is_late else None,
    )


def _as_received(link: LinkOutages, age: Steps | None, run: Run) -> LinkOutages:
    """With the ages by receive time, if the run has them and they are not what the slots say."""
    if age is None or not run.is_late:
        return link
    return replace(link, age_received=age_statistics(age, run.ts))


def loss_causes(link: LinkSlots | None) -> dict[str, int]:
    """Lost slots of a link by what lost them, the most frequent first; empty where no slot says why."""
    if link is None:
        return {}
    causes, counts = np.unique(link.cause[link.cause != ""], return_counts=True)
    order = np.argsort(-counts, kind="stable")
    return dict(zip(causes[order].tolist(), counts[order].tolist(), strict=True))


def link_outages(k: Steps, lost: Outcomes, age: Steps, ts: float) -> LinkOutages:
    """Outages of one link from its slots `k`, their outcomes and the age after each, shape (N,), N >= 1."""
    lengths = outage_lengths(k, lost)
    values, counts = np.unique(lengths, return_counts=True)
    return LinkOutages(
        slots=len(lost),
        lost=int(np.count_nonzero(lost)),
        histogram=dict(zip(values.tolist(), counts.tolist(), strict=True)),
        open_slots=int(lengths[-1]) if lost[-1] else 0,
        age=age_statistics(age, ts),
    )


def age_statistics(age: Steps, ts: float) -> Age:
    """Statistics of ages in steps, shape (N,), N >= 1; percentiles are values that occurred."""
    p50, p99 = np.percentile(age, [50.0, 99.0], method="inverted_cdf")
    return Age(float(np.mean(age)), int(p50), int(p99), int(np.max(age)), ts)


def outage_lengths(k: Steps, lost: Outcomes) -> Steps:
    """Length of each series of consecutive lost slots, in the order of time; `k` and `lost` have shape (N,)."""
    goes_on = lost & _follows_lost(k, lost)
    begins, ends = np.flatnonzero(lost & ~goes_on), np.flatnonzero(lost & ~np.append(goes_on[1:], False)[: len(lost)])
    return np.asarray(ends - begins + 1, dtype=np.int64)


def outage_begins(k: Steps, lost: Outcomes) -> Steps:
    """Index of the first slot of each of these series."""
    return np.asarray(np.flatnonzero(lost & ~_follows_lost(k, lost)), dtype=np.int64)


@dataclass(frozen=True)
class Outage:
    """A series of consecutive lost slots of one link."""

    link: str
    """`uplink` or `downlink`."""
    k: int
    """Step of its first slot."""
    slots: int
    cause: str
    """What lost its first message: the channel's model, or `outage` if its schedule says so; empty if unknown."""


class OutageRows(NamedTuple):
    """All outages of one link of a run, each array of shape (M,), in the order of time."""

    link: str
    begins: Steps
    """Rows of their first slots."""
    k: Steps
    """Steps of these."""
    lengths: Steps
    causes: list[str]
    """As `Outage.cause`."""


def outage_rows(run: Run) -> tuple[OutageRows, OutageRows]:
    """The outages of a run, of the uplink and of the downlink."""

    def of(link: str, lost: Outcomes, why: LinkSlots | None) -> OutageRows:
        begins = outage_begins(run.k, lost)
        causes = [""] * len(begins) if why is None else why.cause[begins].tolist()
        return OutageRows(link, begins, run.k[begins], outage_lengths(run.k, lost), causes)

    return of("uplink", run.lost, run.uplink), of("downlink", run.downlink_lost, run.downlink)


def longest_outage_between(outages: Iterable[OutageRows], first: int, last: int) -> Outage | None:
    """The longest of `outages`, the first link's of equal ones, that acts in the rows `first` to `last` of their run.

    A loss in slot k acts on the pose of step k + 1. None if none acts.
    """
    found = None
    for one in outages:
        acting = np.flatnonzero((one.begins < last) & (one.begins + one.lengths >= first))
        if len(acting):
            i = acting[np.argmax(one.lengths[acting])]
            if found is None or one.lengths[i] > found.slots:
                found = Outage(one.link, int(one.k[i]), int(one.lengths[i]), str(one.causes[i]))
    return found


def is_unbroken(k: Steps) -> bool:
    """Do slots `k`, increasing, follow each other without a gap?"""
    return not len(k) or int(k[-1]) - int(k[0]) == len(k) - 1


def _follows_lost(k: Steps, lost: Outcomes) -> Outcomes:
    """Is the slot before each one known, and lost?"""
    before = lost[:-1] if is_unbroken(k) else lost[:-1] & (np.diff(k) == 1)
    return np.concatenate(([False], before))[: len(lost)]


def ages(k: Steps, lost: Outcomes) -> Steps:
    """Steps since the last slot that was not lost, shape (N,); before the first such one, since the beginning."""
    received = np.where(lost, k[0] if len(k) else 0, k)
    return np.asarray(k - np.maximum.accumulate(received), dtype=np.int64)
