"""What becomes of the error that a run begins with, apart from what outages do.

Under outages the error has two causes: that the AGV began beside its reference, and that it is driven by outdated
poses. A twin separates the first from the second: the same AGV, begun on the reference, under the same losses, ages,
noise and slip, in the simulation. What is left of the initial error is the difference between the two. A recording
that the simulation does not reproduce has no twin; there the initial error is the error until the first outage, and
what came later says nothing of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agv_analysis.metrics.bands import FORGOTTEN_STEPS, NEGLIGIBLE, SHARE, TOLERANCE, forgotten_below
from agv_analysis.metrics.error_metrics import settling_step, wrapped
from agv_analysis.run import Floats, Run

TWIN, UNTIL_FIRST_OUTAGE = "twin", "until_first_outage"
"""How the initial error is separated from what outages do."""

FARTHER = 2.0
"""Without a twin, and without an outage: beyond this multiple of the initial error it is not what the run shows."""

ON_REFERENCE = "the run begins on its reference: there is no initial error that could settle"
TURNED = "the run begins at its reference's place, only turned: there is no distance to take a share of"
STILL_THERE = "the run ends before its initial error has settled"


@dataclass(frozen=True)
class InitialError:
    """How the initial error of a run dies out; steps count from the run's first."""

    of: str
    """`twin` or `until_first_outage`: how it was told from what outages do."""
    settle_1cm_steps: int | None
    """First step from which on less than 1 cm is left of it; None if that was not seen."""
    settle_2pct_steps: int | None
    """First step from which on less than 2 % is left of it; None if that was not seen."""
    overshoot: float | None
    """How far it comes to the other side, along or across the AGV, as a share of the initial distance."""
    reason: str
    """Why one of these is None, empty if none is."""

    @property
    def has_nothing_to_settle(self) -> bool:
        """Did the run begin on its reference?"""
        return self.reason == ON_REFERENCE


def against_twin(run: Run, left: Floats) -> InitialError:
    """The initial error of a run of which `left`, shape (N, 3), is left at each step.

    `left` is where the twin is in the AGV's frame: along, across [m], turned [rad]; NaN after the twin has diverged.
    """
    return _judged(TWIN, run.k, until_forgotten(left), STILL_THERE)


def until_first_outage(run: Run, body: Floats, why: str) -> InitialError:
    """The initial error of a run without a twin, from the error in the AGV's frame, shape (N, 3).

    `why` says why it has no twin.
    """
    end = first_outage(run)
    if end == len(run):
        found = _judged(UNTIL_FIRST_OUTAGE, run.k, _with_wrapped_angle(body), STILL_THERE)
        return _unless_there_is_more(found, np.hypot(body[:, 0], body[:, 1]), why)
    cut = f"the first outage, at step {int(run.k[end])}, came before the initial error had settled, and {why}"
    # A loss in slot k has an effect from the pose of step k + 1 on.
    found = _judged(UNTIL_FIRST_OUTAGE, run.k[: end + 1], _with_wrapped_angle(body[: end + 1]), cut)
    if found.settle_2pct_steps is None and found.overshoot is not None:
        found = InitialError(found.of, found.settle_1cm_steps, None, None, cut)
    return _unless_there_is_more(found, np.hypot(body[: end + 1, 0], body[: end + 1, 1]), why)


_JITTER = 1
"""By receive time a pose may be so many steps old without having been late."""


def first_outage(run: Run) -> int:
    """Index of the first slot in which a message was lost or late, by its slot or by when it came; N: there is none."""
    late = np.zeros_like(run.lost) if run.n_dl is None else run.n_dl > 0
    if run.is_late:
        late = late | (run.command_age > _JITTER)
    disturbed = np.flatnonzero(run.lost | run.downlink_lost | (run.n_ul > 0) | late)
    return int(disturbed[0]) if len(disturbed) else len(run)


def until_forgotten(left: Floats) -> Floats:
    """What is left of an initial error, shape (N, 3), with zeros after it was forgotten.

    That is when it has been, in distance and in angle, below a hundredth of the narrower band for 40 steps: then the
    two AGVs have met, and if an unstable loop parts them again, that is another event.
    """
    size = np.hypot(left[:, 0], left[:, 1])
    limit = forgotten_below(float(size[0]))
    near = (size < limit) & (np.abs(left[:, 2]) < limit)
    far = np.flatnonzero(~near)
    lasts = np.diff(np.concatenate(([-1], far, [len(left)]))) - 1  # steps near, before each that is far
    stretches = np.flatnonzero(lasts >= FORGOTTEN_STEPS)
    if not len(stretches):
        return left
    found = np.array(left)
    begins = int(far[stretches[0] - 1]) + 1 if stretches[0] else 0
    found[begins + FORGOTTEN_STEPS :] = 0.0
    return found


def overshoot(left: Floats) -> float:
    """How far an initial error comes to the other side, along or across the AGV, over its initial size.

    `left` as of `against_twin`. A component that begins within 2 % of the whole has no other side.
    """
    begun, sides = left[0, :2], np.sign(left[0, :2])
    initial = float(np.sqrt(begun[0] * begun[0] + begun[1] * begun[1]))
    sides[np.abs(begun) <= SHARE * initial] = 0.0
    with np.errstate(invalid="ignore"):
        beyond = np.nanmax(-left[:, :2] * sides)
    return max(0.0, float(beyond)) / initial


def _with_wrapped_angle(body: Floats) -> Floats:
    return np.column_stack([body[:, :2], wrapped(body[:, 2])])


def _judged(of: str, k: NDArray[np.int64], left: Floats, if_unsettled: str) -> InitialError:
    with np.errstate(over="ignore"):
        size = np.sqrt(left[:, 0] * left[:, 0] + left[:, 1] * left[:, 1])
    if np.abs(left[0]).max() <= NEGLIGIBLE:
        return InitialError(of, None, None, None, ON_REFERENCE)
    to_1cm = settling_step(k, size, TOLERANCE)
    if size[0] <= NEGLIGIBLE:
        return InitialError(of, to_1cm, None, None, TURNED)
    to_2pct = settling_step(k, size, SHARE * float(size[0]))
    return InitialError(of, to_1cm, to_2pct, overshoot(left), if_unsettled if None in (to_1cm, to_2pct) else "")


def _unless_there_is_more(found: InitialError, size: Floats, why: str) -> InitialError:
    """Without a twin: an error that is larger later, or on the other side, than at first has another cause as well."""
    initial, farthest = float(size[0]), float(np.max(size))
    is_more = (farthest > FARTHER * initial and farthest >= TOLERANCE) or (found.overshoot or 0.0) > 1.0
    if found.has_nothing_to_settle or not is_more:
        return found
    said = (
        f"the run begins {initial:.2g} m away from its reference and is up to {farthest:.2g} m away later, so that it "
        f"shows more than its initial error, and {why}"
    )
    return InitialError(found.of, None, None, None, said)
