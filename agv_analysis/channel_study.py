"""What a channel does, before anyone drives through it: losses, bursts and ages, beside their closed form.

For a channel that is a Markov chain (T, g), with D = diag(1 - g) and pi the stationary distribution, the last j slots
are all lost with probability P(n_ul >= j) = pi D (T D)^(j-1) 1; the age's distribution follows by differences.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from agv_analysis.channel_fit import ChannelFit, fit_channel
from agv_analysis.outages import LinkOutages, Steps, Verdicts, ages, link_outages
from agv_analysis.run import Floats
from agv_analysis.simulation.verdicts import Air
from agv_analysis.stability.chain import Chain, chain_of
from agv_plant.parameters import ChannelParameters
from agv_ros.errors import UserError

DRAWN = 1000
"""Slots that the picture shows one by one."""


@dataclass(frozen=True)
class ChannelStudy:
    """Slots of a channel, and what they come to."""

    channel: ChannelParameters
    lost: Verdicts
    """Verdicts of the slots, True where lost, shape (N,)."""
    age: Steps
    """Slots since the last delivered one, shape (N,)."""
    outages: LinkOutages
    chain: Chain | None
    """The channel as a Markov chain; None if it is none."""

    @property
    def fit(self) -> ChannelFit:
        """The model that the slots themselves speak for."""
        return fit_channel(self.lost)

    @property
    def age_shares(self) -> Floats:
        """Share of slots with age 0, 1, 2, ..., up to the largest that occurred."""
        return np.asarray(np.bincount(self.age) / len(self.age))

    @property
    def expected_age_shares(self) -> Floats | None:
        """P(n_ul = j) in closed form, as long as `age_shares`; None for a channel that is no Markov chain."""
        return None if self.chain is None else age_distribution(self.chain, len(self.age_shares))

    def to_json(self) -> dict[str, Any]:
        """Figures by name; null where nothing is known or nothing is finite."""
        chain, expected = self.chain, self.expected_age_shares
        return {
            "model": self.channel.model,
            "slots": self.outages.slots,
            "lost": self.outages.lost,
            "loss_rate": self.outages.loss_rate,
            "mean_burst": self.outages.mean_burst,
            "longest": self.outages.longest,
            "histogram": {str(length): count for length, count in self.outages.histogram.items()},
            "mean_age": self.outages.age.mean,
            "age_shares": self.age_shares.tolist(),
            "closed_form": None if chain is None else {
                "loss_rate": chain.loss_rate,
                "mean_burst": chain.mean_burst,
                "mean_age": chain.mean_age if math.isfinite(chain.mean_age) else None,
                "age_shares": None if expected is None else expected.tolist(),
            },
        }  # fmt: skip


def study(channel: ChannelParameters, seed: int, link: str, slots: int, ts: float) -> ChannelStudy:
    """The first `slots` slots of a channel: those that a run with this seed meets on this link.

    Raises TraceError for a trace that cannot be used or must not be outrun.
    """
    lost = Air(seed, slots).verdicts(channel, link)
    k = np.arange(slots)
    age = ages(k, lost)
    return ChannelStudy(channel, lost, age, link_outages(k, lost, age, ts), chain_of(channel))


def age_distribution(chain: Chain, count: int) -> Floats:
    """P(n_ul = j) for j = 0 .. count - 1 in the long run, shape (count,)."""
    lost = 1.0 - chain.delivery
    beyond = [1.0]  # P(n_ul >= j)
    state = chain.stationary * lost
    for _ in range(count):
        beyond.append(float(state.sum()))
        state = state @ chain.transition * lost
    return -np.diff(np.array(beyond))


def fitted(lost: Verdicts, channel: ChannelParameters) -> ChannelParameters:
    """The model fitted to verdicts, as parameters of a channel; those that the fit does not know stay."""
    fit = fit_channel(lost)
    if fit.model == "gilbert_elliott" and fit.p is not None and fit.r is not None:
        return replace(channel, model=fit.model, p=fit.p.value, r=fit.r.value, h=0.0, k=1.0)
    return replace(channel, model=fit.model, p=fit.loss_rate.value)


COLUMNS = ("n_ul", "slots", "share", "closed_form")


def write_csv(path: Path, found: ChannelStudy) -> None:
    """Write the distribution of the age, a row an age; the last column is empty without a closed form.

    Raises UserError if the file cannot be written.
    """
    counts = np.bincount(found.age).tolist()
    expected = found.expected_age_shares
    closed = [""] * len(counts) if expected is None else expected.tolist()
    try:
        with open(path, "w", encoding="utf-8", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(COLUMNS)
            rows.writerows(zip(range(len(counts)), counts, found.age_shares.tolist(), closed, strict=True))
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None


def draw(path: Path, found: ChannelStudy) -> None:
    """Draw the age slot by slot, and its distribution beside the closed form. Raises UserError if that fails."""
    from matplotlib.figure import Figure

    from agv_analysis.picture import DRIVEN, LOST

    figure = Figure(figsize=(11.0, 4.0), layout="constrained")
    course, shares = figure.subplots(1, 2)
    course.step(np.arange(len(found.age))[:DRAWN], found.age[:DRAWN], where="post", color=LOST, lw=0.8)
    course.set(xlabel="slot k", ylabel="n_ul [slots]", title=f"{found.channel.model}: the first slots")
    measured, expected = found.age_shares, found.expected_age_shares
    shares.plot(np.flatnonzero(measured), measured[measured > 0.0], "o", color=DRIVEN, ms=3.0, label="these slots")
    if expected is not None:
        shares.plot(
            np.flatnonzero(expected > 0.0), expected[expected > 0.0], color="black", lw=0.8, label="closed form"
        )
    shares.set(yscale="log", xlabel="n_ul [slots]", ylabel="share of slots", title="Age of information")
    shares.legend(loc="best", fontsize="small")
    try:
        figure.savefig(path, dpi=130)
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be drawn to: {error}") from None
