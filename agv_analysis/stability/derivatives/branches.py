"""Which branch the rows of dual numbers take together, and where a function is not differentiable.

A comparison on which all rows agree has an outcome. Otherwise `Split` or `Tie` end the call of the function, which
`evaluation` then calls again for some of the rows, or along one branch.
"""

from __future__ import annotations

import contextvars
import dataclasses
import linecache
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]

PACKAGE = f"{__name__.rpartition('.')[0]}."
"""What the names of this package's modules begin with."""

_TIES_EXPLORED = 4
"""Ties on one path through a function that are evaluated along both branches; further ones are reported as kinks."""


class Split(BaseException):
    """The rows disagree: those of the mask are to be evaluated apart from the others."""

    def __init__(self, mask: Mask) -> None:
        self.mask = mask


class Tie(BaseException):
    """In all rows both sides of a comparison are equal: to be evaluated along both branches."""

    def __init__(self, outcome: bool, where: str) -> None:
        self.outcome = outcome
        self.where = where


@dataclasses.dataclass
class Trial:
    """One call of the function for some rows."""

    rows: Rows
    forced: tuple[bool, ...]
    """Outcomes of its first ties."""
    ties: int = 0
    """Ties met so far."""
    kinks: list[tuple[str, Rows]] = dataclasses.field(default_factory=list)

    def outcome_of_tie(self, outcome: bool) -> bool:
        """Outcome of the next tie; raises Tie if it is to be looked at along both branches."""
        self.ties += 1
        if self.ties <= len(self.forced):
            return self.forced[self.ties - 1]
        if self.ties <= _TIES_EXPLORED:
            raise Tie(outcome, _where())
        self.kinks.append((_where(), self.rows))
        return outcome


TRIAL: contextvars.ContextVar[Trial | None] = contextvars.ContextVar("TRIAL", default=None)
"""The call that is under way, None outside of `jacobian`."""


def outcome_of(outcome: Mask, tied: Mask) -> bool:
    """Outcome of a comparison for all rows, of which some are tied; raises Split or Tie where there is none."""
    if tied.all():
        trial = TRIAL.get()
        return bool(outcome[0]) if trial is None else trial.outcome_of_tie(bool(outcome[0]))
    if tied.any():
        decide(tied)
    return decide(outcome)


def decide(outcome: Mask) -> bool:
    """The outcome of all rows; raises Split if they disagree."""
    if outcome.all():
        return True
    if not outcome.any():
        return False
    if TRIAL.get() is None:
        raise TypeError("a comparison of Duals whose rows disagree has no outcome: call the function by jacobian()")
    raise Split(outcome)


def report(mask: Mask) -> None:
    """Record rows at which the function is not differentiable."""
    trial = TRIAL.get()
    if trial is not None and mask.any():
        trial.kinks.append((_where(), trial.rows[mask]))


def report_singular(x: Floats, value: Floats, slope: Floats) -> None:
    """Record rows with a value at a finite x, but no finite slope: sqrt(0)."""
    finite = np.isfinite(slope)
    if not finite.all():
        report(np.isfinite(value) & ~finite & np.isfinite(x))


def _where() -> str:
    """Function and source line that called into this package or, from there, into numpy."""
    frame = sys._getframe(1)
    while frame.f_back is not None and str(frame.f_globals.get("__name__")).startswith((PACKAGE, "numpy.")):
        frame = frame.f_back
    code, line = frame.f_code, frame.f_lineno
    text = linecache.getline(code.co_filename, line).strip()
    return f"{code.co_name} ({Path(code.co_filename).name}:{line}): {text}"
