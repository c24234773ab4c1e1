"""Growth of second moments: the spectral radius of a linear map that is only known by what it does to them.

By Arnoldi's method: in the span of what the map does again and again to one set of moments it is a small matrix, whose
eigenvalue of largest modulus tends to that of the map much sooner than the map's powers do. Where two eigenvalues are
near each other (a loop that is critically damped has equal ones) powers take hundreds of laps. A map that keeps second
moments second moments has a positive eigenvalue that no other exceeds (Krein and Rutman).
Source: Saad, Numerical Methods for Large Eigenvalue Problems, 2011, chapter 6.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from agv_analysis.run import Floats

SETTLED = 1e-8
"""Change of the growth with one more application of the map, relative where it is above 1, at which it has settled."""

_MOST, _MOST_NUMBERS = 40, 20_000_000
"""Sets of moments that span the space, at most, and the numbers that they may have together."""

_RESTARTS = 3

_USUAL_STEPS = 2000
"""The tolerance is that of the growth over so many steps at least."""

_AS_LARGE = 1.0 - 1e-9
"""Of eigenvalues whose moduli differ by less the one with the largest real part is taken: theirs is real."""


def moment_growth(
    moments: tuple[Floats, ...], drive: Callable[[], float], steps: int, settled: float = SETTLED
) -> float:
    """Growth (logarithm) of second moments over the `steps` that `drive` sends them through; -inf if nothing is left.

    `drive` changes the `moments` in place, to be multiplied by exp(what it returns), and is linear in them. They are
    those to begin with, and are left as those that keep their proportions.
    """
    tolerance = settled * min(1.0, steps / _USUAL_STEPS)
    size = sum(part.size for part in moments)
    most = max(3, min(_MOST, size, _MOST_NUMBERS // size))
    growth = math.nan
    for _ in range(_RESTARTS):
        growth, has_settled = _arnoldi(moments, drive, most, settled, tolerance)
        if has_settled:
            break
    return growth


def _arnoldi(
    moments: tuple[Floats, ...], drive: Callable[[], float], most: int, settled: float, tolerance: float
) -> tuple[float, bool]:
    """The growth, and whether it has settled with `most` sets of moments."""
    begun = _flat(moments)
    basis, projected = [begun / np.linalg.norm(begun)], np.zeros((most + 1, most))
    growth, scale = math.nan, math.nan
    for m in range(most):
        _put(basis[m], moments)
        log_scale = drive()
        moved = _flat(moments)
        length = float(np.linalg.norm(moved))
        if m == 0:
            if not length > 0.0:  # a predictor leaves nothing of the error
                for part in moments:
                    part[:] = np.eye(*part.shape[1:])
                return -math.inf, True
            scale = log_scale + math.log(length)
        moved *= math.exp(min(log_scale - scale, 700.0))
        span = np.array(basis)
        for _ in range(2):  # once is not enough against rounding
            share = span @ moved
            projected[: m + 1, m] += share
            moved -= share @ span
        left = float(np.linalg.norm(moved))
        values, vectors = np.linalg.eig(projected[: m + 1, : m + 1])
        moduli = np.abs(values)
        i = int(np.argmax(np.where(moduli >= _AS_LARGE * moduli.max(), values.real, -math.inf)))
        before, growth = growth, scale + math.log(moduli[i]) if moduli[i] > 0.0 else -math.inf
        residual = left * float(abs(vectors[-1, i])) / max(float(moduli[i]), 1e-300)
        allowed = max(tolerance, settled * abs(growth))
        is_invariant = residual <= 1e-3 * allowed
        has_settled = is_invariant or (abs(growth - before) <= allowed and residual <= math.sqrt(settled))
        if has_settled or m == most - 1:
            found = vectors[:, i].real @ span
            _put(found * np.sign(found.sum()) / np.linalg.norm(found), moments)
            return growth, has_settled
        projected[m + 1, m] = left
        basis.append(moved / left)
    raise AssertionError("unreachable")


def _flat(moments: tuple[Floats, ...]) -> Floats:
    return np.concatenate([part.ravel() for part in moments])


def _put(values: Floats, moments: tuple[Floats, ...]) -> None:
    begin = 0
    for part in moments:
        part[:] = values[begin : begin + part.size].reshape(part.shape)
        begin += part.size
