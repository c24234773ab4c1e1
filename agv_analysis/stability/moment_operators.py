"""Operators on second moments X = E[x x'], as matrices on the distinct entries of a symmetric X.

X -> M X M' is M (x) M on vec X; of its rows and columns only those of the lower triangle are kept (elimination and
duplication matrices: Magnus and Neudecker, SIAM J. Alg. Disc. Meth. 1, 1980). n (n + 1) / 2 instead of n^2 entries.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats
from agv_analysis.stability.linear_loop import LinearLoop

_POINTS, _POINTS_OF_LARGE = 8, 4
"""Places of a lap at which a loop is looked at, of up to three states and of more."""

_LEAST_RADIUS = math.exp(-700.0)
"""Put in for nilpotent matrices, so that means and differences of logarithms stay finite."""

_GOLDEN = 0.5 * (5.0**0.5 - 1.0)


def places(loop: LinearLoop) -> NDArray[np.int64]:
    """Steps of a lap at which to look at the loop, shape (n,); step 0 if it never changes.

    Multiples of the golden section of the lap: equal parts would meet a lap of equal curves in the same phase again.

    Between them the loop changes slowly against the error's own motion, so that the mean growth at these places is that
    of the lap; tests hold it to `mean_square.lap_growth`.
    """
    if loop.is_constant:
        return np.zeros(1, dtype=np.int64)
    count = _POINTS if loop.size <= 3 else _POINTS_OF_LARGE
    return np.asarray(np.arange(count) * _GOLDEN % 1.0 * loop.steps, dtype=np.int64)


def symmetric_operator(M: Floats) -> Floats:
    """Matrix of X -> M X M' on the distinct entries: (..., r (r + 1) / 2, c (c + 1) / 2) for M of shape (..., r, c)."""
    (i, j), (p, q) = np.tril_indices(M.shape[-2]), np.tril_indices(M.shape[-1])
    one = M[..., i[:, None], p] * M[..., j[:, None], q]
    other = M[..., i[:, None], q] * M[..., j[:, None], p]
    return np.asarray(np.where(p == q, one, one + other))


@functools.cache
def leading_entries(size: int, part: int) -> NDArray[np.int64]:
    """Where the distinct entries of the leading part x part block stand among those of a size x size matrix."""
    i, j = np.tril_indices(size)
    return np.flatnonzero((i < part) & (j < part))


def log_radius(operators: Floats) -> Floats:
    """Logarithm of the spectral radius of each of a stack of matrices, shape (..., n, n); at least -700."""
    return np.asarray(np.log(np.maximum(np.abs(np.linalg.eigvals(operators)).max(axis=-1), _LEAST_RADIUS)))
