"""How far an AGV strays from its reference, in metres, once its initial error has settled, and after which outage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from agv_analysis.json_values import finite
from agv_analysis.metrics.bands import TOLERANCE
from agv_analysis.metrics.initial_error import TWIN, InitialError
from agv_analysis.metrics.order_statistics import P99, not_exceeded
from agv_analysis.metrics.outages import Outage, longest_outage_between, outage_rows
from agv_analysis.run import Floats, Run
from agv_analysis.simulation.twin_on_reference import poses_without_losses
from agv_cloud.tracking_error import tracking_error

WORST = 5
"""So many of the largest deviations are listed."""

SMALLEST = 1e-3
"""Deviations below this [m] are not listed."""

DIVERGED = 1e5
"""An AGV that is farther than this [m] from its reference has diverged: how far it is says no more."""


@dataclass(frozen=True)
class Peak:
    """A local maximum of the distance to the reference; the stretch around it, above half of it, has no larger one."""

    seconds: float
    """When [s], from the first step of the run."""
    x: float
    """Where: the reference [m], in frame `map`."""
    y: float
    distance: float
    """Between AGV and reference [m]."""
    along: float
    """How far the AGV is ahead of the reference [m]."""
    across: float
    """How far it is to the left of the reference [m]."""
    from_lossless: float | None
    """Distance [m] to where the AGV would be without losses; None if the run cannot be simulated."""
    outage: Outage | None
    """The longest outage that acted from the beginning of the stretch to the peak; None if none did."""

    def to_json(self) -> dict[str, Any]:
        """The figures by name; SI units; null: unknown, or infinite."""
        return {
            "seconds": self.seconds,
            "x": self.x,
            "y": self.y,
            "distance": finite(self.distance),
            "along": finite(self.along),
            "across": finite(self.across),
            "from_lossless": finite(self.from_lossless),
            "link": None if self.outage is None else self.outage.link,
            "outage_slots": None if self.outage is None else self.outage.slots,
            "cause": None if self.outage is None else self.outage.cause or None,
        }


@dataclass(frozen=True)
class Deviation:
    """Distance between AGV and reference from the time on at which the initial error has settled."""

    since_seconds: float
    """From when on [s], from the first step of the run."""
    reason: str
    """Why this is not the time at which the initial error has settled; empty if it is."""
    largest: float
    """[m]"""
    p99: float
    """99 % of the steps are no farther than this [m]."""
    rms: float
    """Root mean square [m]."""
    worst: tuple[Peak, ...]
    """The largest peaks, the worst first; at most `WORST`, none below `SMALLEST`, none of a run that has diverged."""
    speed: float
    """Largest |v| that the controller asked for in the whole run [m/s]; NaN if it sent no command."""
    turn_rate: float
    """Largest |w| that it asked for [rad/s]."""

    @property
    def is_diverged(self) -> bool:
        """Was the AGV so far away that it does not matter how far?"""
        return not self.largest <= DIVERGED

    def to_json(self) -> dict[str, Any]:
        """The figures by name; SI units; null: infinite."""
        return {
            "deviation": {
                "max": finite(self.largest),
                "p99": finite(self.p99),
                "rms": finite(self.rms),
                "since_seconds": self.since_seconds,
                "reason": self.reason or None,
                "diverged": self.is_diverged,
                "worst": [peak.to_json() for peak in self.worst],
            },
            "speed": {"max": finite(self.speed), "turn_rate_max": finite(self.turn_rate)},
        }


def deviation(run: Run, initial: InitialError) -> Deviation:
    """Deviation of a run of at least one step, whose initial error became what `initial` says."""
    offset = run.pose[:, :2] - run.reference[:, :2]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    begin, reason = _begin(run, initial, distance)
    seen = distance[begin:]
    return Deviation(
        since_seconds=float(run.time[begin] - run.time[0]),
        reason=reason,
        largest=float(seen.max()),
        p99=not_exceeded(seen, P99),
        rms=root_mean_square(seen),
        worst=tuple(_peaks(run, initial, distance, begin)) if seen.max() <= DIVERGED else (),
        speed=_largest(run.command[:, 0]),
        turn_rate=_largest(run.command[:, 1]),
    )


def _begin(run: Run, initial: InitialError, distance: Floats) -> tuple[int, str]:
    """The row from which on a run shows its deviation, and why it is not the one at which the initial error settled."""
    if initial.has_nothing_to_settle:
        return 0, ""
    if initial.settle_1cm_steps is not None:
        return int(np.searchsorted(run.k, run.k[0] + initial.settle_1cm_steps)), ""
    near = np.flatnonzero(distance < TOLERANCE)
    if len(near) and initial.of != TWIN:
        why = "from the first step below 1 cm on, since it is not known when the initial error has settled"
        return int(near[0]), why
    return 0, "of the whole run, since its initial error does not settle"


def root_mean_square(values: Floats) -> float:
    """Of values of shape (N,), N >= 1; scaled, so that squares do not overflow."""
    largest = float(np.abs(values).max())
    if largest == 0.0 or not np.isfinite(largest):
        return largest
    return largest * float(np.sqrt(np.mean((values / largest) ** 2)))


def _largest(values: Floats) -> float:
    """Largest size of what was sent, NaN without anything."""
    sent = np.abs(values[np.isfinite(values)])
    return float(sent.max()) if len(sent) else float("nan")


def _peaks(run: Run, initial: InitialError, distance: Floats, begin: int) -> list[Peak]:
    """The largest peaks from row `begin` on."""
    lossless = poses_without_losses(run)[:, :2] if initial.of == TWIN else None
    outages = outage_rows(run)
    free = np.arange(len(distance)) >= begin
    found: list[Peak] = []
    while len(found) < WORST:
        row = int(np.argmax(np.where(free, distance, -1.0)))
        if not (free[row] and distance[row] >= SMALLEST):
            break
        first, last = _stretch(distance, row, begin)
        if free[first : last + 1].all():
            apart = None if lossless is None else float(np.hypot(*(run.pose[row, :2] - lossless[row])))
            found.append(_peak(run, row, float(distance[row]), apart, longest_outage_between(outages, first, row)))
        free[first : last + 1] = False
    return found


def _stretch(distance: Floats, row: int, begin: int) -> tuple[int, int]:
    """First and last row of the stretch around a peak in which the distance is above half of the peak's."""
    low = np.flatnonzero(~(distance[begin:row] > 0.5 * distance[row]))
    high = np.flatnonzero(~(distance[row:] > 0.5 * distance[row]))
    return begin + (int(low[-1]) + 1 if len(low) else 0), row + int(high[0]) - 1 if len(high) else len(distance) - 1


def _peak(run: Run, row: int, distance: float, apart: float | None, outage: Outage | None) -> Peak:
    reference = run.reference[row, :3].tolist()
    along, across, _ = tracking_error(*run.pose[row].tolist(), *reference)  # of the AGV, seen from the reference
    return Peak(
        seconds=float(run.time[row] - run.time[0]),
        x=reference[0],
        y=reference[1],
        distance=distance,
        along=along,
        across=across,
        from_lossless=apart,
        outage=outage,
    )
