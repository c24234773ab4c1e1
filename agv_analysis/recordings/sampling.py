"""The sampling period of a robot, and which of its poses are missing, from their stamps alone."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from agv_analysis.recordings.jittered_steps import jittered_steps
from agv_analysis.recordings.messages_on_steps import Steps
from agv_analysis.run import Floats
from agv_ros.errors import UserError
from agv_ros.stamps import MAX_LEAP, NS_PER_S

_SAME_PERIOD = 0.01
"""Largest relative difference between the params file's period and the stamps' that goes without saying."""


_CLEAR = 0.35
"""Where no gap is further from whole periods than this [periods], each tells by itself how many it is."""


class Sampling(NamedTuple):
    """How the poses were sampled, from their stamps."""

    period: float
    """T_s [ns], such that all steps together last as long as the poses do: a median would drift away from the clock."""
    k: Steps
    """Step of each pose, shape (M,); 0 for the first."""
    deviations: Floats
    """How far each distance is from whole periods [ns], shape (M - 1,)."""


def sampling_of(stamps: Steps, where: str) -> Sampling:
    """Sampling of poses with increasing `stamps` [ns]; a gap of m periods is m steps, so m - 1 poses are lost.

    Where the stamps scatter by so much that gaps are not clear, all of them together tell their steps.

    Raises UserError if there are too few poses or a gap that no outage explains.
    """
    if len(stamps) < 3:
        raise UserError(f"{where}: {len(stamps)} poses with a stamp of their own; at least 3 are needed for a period")
    gaps = np.diff(stamps)
    period = period_of(gaps)
    steps = np.maximum(1, np.rint(gaps / period)).astype(np.int64)
    if steps.max() > MAX_LEAP or steps.sum() > MAX_LEAP + 100 * len(stamps):
        i = int(np.argmax(steps))
        raise UserError(
            f"{where}: a gap of {gaps[i] / NS_PER_S:g} s after the stamp {stamps[i] / NS_PER_S:.9f} s is {steps[i]} "
            f"periods of {period / NS_PER_S:g} s, and only {len(stamps)} poses are there: is it "
            "one recording, by one clock?"
        )
    k = np.concatenate(([0], np.cumsum(steps)))
    if np.abs(gaps / period - steps).max() > _CLEAR:
        k = jittered_steps(stamps, period)
        steps = np.diff(k)
    mean = float(stamps[-1] - stamps[0]) / float(k[-1])
    return Sampling(mean, k, gaps - steps * mean)


def period_of(gaps: Steps) -> float:
    """Median of the gaps [ns] that are one period long; of all gaps it would be too long if some poses are lost.

    Quantiles are values that occurred, so at least one gap is one period long. If more than half of the poses are
    lost, the first guess may be two periods.
    """
    period = _median(gaps)
    for _ in range(2):
        period = _median(gaps[np.rint(gaps / period) == 1.0])
    return period


def _median(gaps: Steps) -> float:
    return float(np.percentile(gaps, 50.0, method="inverted_cdf"))


def sampling_notes(sampling: Sampling, topic: str, ts: float | None) -> Iterator[str]:
    """What a reader must know of the sampling; `ts` [s] is that of a params file, None without one."""
    ms = 1e-6
    missing = int(sampling.k[-1]) + 1 - len(sampling.k)
    yield (
        f"{topic}: sampling period {sampling.period * ms:g} ms by the stamps; jitter "
        f"{np.std(sampling.deviations) * ms:.3g} ms, at most {np.abs(sampling.deviations).max() * ms:.3g} ms"
    )
    if missing:
        yield (
            f"{topic}: {missing} poses are missing between the stamps and count as lost; the pose there is interpolated"
        )
    if ts is not None and abs(sampling.period / NS_PER_S / ts - 1.0) > _SAME_PERIOD:
        yield f"the params file says ts = {ts:g} s, the stamps say {sampling.period / NS_PER_S:g} s; the stamps count"
