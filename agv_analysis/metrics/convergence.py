"""How a run's error converges: settling and overshoot of the initial error, integrals, how the command is damped.

A run judges itself only as far as it goes: an error that has settled when the run ends may leave its band afterwards.
What a run cannot say is None, with a reason: the share of an initial error of zero, the settling that did not happen,
the damping of a command that did not move or that ended too early.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from agv_analysis.json_values import finite
from agv_analysis.metrics.bands import CRITICAL_TIME, NEGLIGIBLE, SHARE, TOLERANCE
from agv_analysis.metrics.error_metrics import (
    ErrorMetrics,
    body_errors,
    error_metrics,
    settling,
    sign_changes,
    wrapped,
)
from agv_analysis.metrics.initial_error import (
    InitialError,
    against_twin,
    first_outage,
    until_first_outage,
    until_forgotten,
)
from agv_analysis.metrics.last_excursion import LastExcursion, last_excursion
from agv_analysis.run import Floats, Run
from agv_analysis.simulation.twin_on_reference import twin_on_reference
from agv_ros.errors import UserError

__all__ = [
    "CRITICAL_TIME", "NEGLIGIBLE", "SHARE", "TOLERANCE", "Convergence", "ErrorMetrics", "body_errors", "convergence",
    "damping", "error_metrics", "settling", "sign_changes", "wrapped",
]  # fmt: skip


@dataclass(frozen=True)
class Convergence:
    """Convergence of one run.

    Settling, overshoot and damping are those of the initial error, apart from what outages do. The metrics of the
    single errors are of all that happened. The paper plots the global y error and writes of the one in the AGV's frame:
    here are both, apart. All errors are the true ones at each step, X_r(k) - X_c(k), not those that the edge computed
    from an outdated pose.
    """

    y: ErrorMetrics
    """y_r - y_c in frame `map` [m], the error of the paper's figures."""
    x_e: ErrorMetrics
    """Error along the AGV [m], in its frame."""
    y_e: ErrorMetrics
    """Error across the AGV [m], in its frame."""
    theta_e: ErrorMetrics
    """Error of heading [rad], in (-pi, pi]."""
    position: ErrorMetrics
    """Distance between AGV and reference [m]; it has no sign, hence neither overshoot nor changes of sign."""
    initial: InitialError
    """What becomes of the error that the run began with."""
    damping: str | None
    """Damping class of the command: `over`, `critical`, `under`; None if the run cannot tell."""
    excursion: LastExcursion | None
    """The last time that the AGV was 1 cm or more away from its reference; None if it never was."""
    max_error_after_settling: float | None
    """Largest distance [m] from settle_1cm_steps on, or of the whole run if it began on its reference."""

    @property
    def settle_1cm_steps(self) -> int | None:
        """First step from which on less than 1 cm is left of the initial error."""
        return self.initial.settle_1cm_steps

    @property
    def settle_2pct_steps(self) -> int | None:
        """First step from which on less than 2 % is left of the initial error."""
        return self.initial.settle_2pct_steps

    @property
    def overshoot(self) -> float | None:
        """How far the initial error comes to the other side, as a share of its size."""
        return self.initial.overshoot

    def to_json(self) -> dict[str, Any]:
        """The figures by name; SI units; null: the run cannot say, or the number is infinite."""
        return {
            "settle_1cm_steps": self.settle_1cm_steps,
            "settle_2pct_steps": self.settle_2pct_steps,
            "overshoot": finite(self.overshoot),
            "damping": self.damping,
            "convergence_of": self.initial.of,
            "convergence_reason": self.initial.reason or None,
            "last_excursion_seconds": None if self.excursion is None else self.excursion.seconds,
            "last_excursion_after": None if self.excursion is None else self.excursion.after,
            "initial_error": finite(self.position.initial),
            "final_error": finite(self.position.final),
            "max_error": finite(self.position.peak),
            "max_error_after_settling": finite(self.max_error_after_settling),
            "iae": finite(self.y.iae),
            "ise": finite(self.y.ise),
        }


def convergence(run: Run, critical_time: float = CRITICAL_TIME) -> Convergence:
    """Convergence of a run. Raises UserError if the run has no step.

    `critical_time` [s] is the border between a critically and an over-damped command, see `damping`.
    """
    if not len(run):
        raise UserError(f"{run.source}: no step of the loop in it, so nothing converges: record at least one")
    true = run.reference[:, :3] - run.pose
    body = body_errors(run.reference, run.pose)
    distance = np.hypot(true[:, 0], true[:, 1])
    initial, damped, left = _of_initial_error(run, body, critical_time)
    return Convergence(
        y=error_metrics(run.k, true[:, 1], run.ts),
        x_e=error_metrics(run.k, body[:, 0], run.ts),
        y_e=error_metrics(run.k, body[:, 1], run.ts),
        theta_e=error_metrics(run.k, wrapped(body[:, 2]), run.ts),
        position=error_metrics(run.k, distance, run.ts),
        initial=initial,
        damping=damped,
        excursion=last_excursion(run, distance, left),
        max_error_after_settling=_after_settling(run, initial, distance),
    )


def _of_initial_error(
    run: Run, body: Floats, critical_time: float
) -> tuple[InitialError, str | None, Floats | None]:  # fmt: skip
    """What becomes of the initial error, how the command answers to it, and how much [m] is left of it, if known."""
    v_max, v = run.scenario.controller.v_max, run.command[:, 0]
    twin = twin_on_reference(run)
    if isinstance(twin, str):
        end = first_outage(run)
        damped = damping(run.time[:end], v[:end], run.reference[:end, 3], v_max, critical_time)
        return until_first_outage(run, body, twin), damped, None
    left = body_errors(twin.pose, run.pose)
    damped = damping(run.time, v, twin.speed, v_max, critical_time)
    x, y, _ = until_forgotten(left).T
    return against_twin(run, left), damped, np.hypot(x, y)


def _after_settling(run: Run, initial: InitialError, distance: Floats) -> float | None:
    """Largest distance after the initial error has settled."""
    if initial.has_nothing_to_settle:
        return float(distance.max())
    if initial.settle_1cm_steps is None:
        return None
    return float(distance[run.k - run.k[0] >= initial.settle_1cm_steps].max())


def damping(time: Floats, v: Floats, v_r: Floats, v_max: float, critical_time: float = CRITICAL_TIME) -> str | None:
    """Damping class of a command v(k) [m/s] around the reference's speed v_r(k), at the times t_k [s]; shapes (N,).

    With d = v - v_r and b = 2 % of max |d|: `under` if d goes from beyond b on one side of zero to beyond b on the
    other; else `critical` if d settles to within b at most `critical_time` [s] after the last saturated sample
    (|v| = v_max) or, where nothing was saturated, after the first; else `over`. The loop along the track is of first
    order (pole 1 - T_s K_x), where the textbook's damping ratio has no meaning; hence this operational definition.

    Samples without a command (NaN) are left out. None if d is zero throughout, or if the run ends, unsettled, before
    `critical_time` is over.
    """
    sent = np.isfinite(v)
    with np.errstate(over="ignore"):
        time, v, d = time[sent], v[sent], v[sent] - v_r[sent]
    band = SHARE * float(np.max(np.abs(d), initial=0.0))
    if band == 0.0:
        return None
    if sign_changes(d, band):
        return "under"
    settled = settling(np.abs(d), band)
    saturated = np.flatnonzero(np.abs(v[:settled]) >= v_max)
    free = float(time[saturated[-1]] if len(saturated) else time[0])
    lasts = float(time[-1] if settled is None else time[settled]) - free
    if lasts > critical_time:
        return "over"
    return None if settled is None else "critical"
