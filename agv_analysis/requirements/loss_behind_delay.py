"""Independent losses behind a constant delay: how many a loop takes, by the norm of its response to the losses.

With a message of d slots ago received with probability s = 1 - p, what the edge holds is

    y(k) = p y(k-1) + s C z(k-d) + (theta(k) - s) v(k),    v(k) = C z(k-d) - y(k-1),    z(k+1) = F z(k) + G y(k)

theta(k) is 1 at a reception and 0 at a loss, so the losses are a white noise that multiplies v, with variance p s. The
loop is mean-square stable if and only if it is stable in the mean and

    p s  rho( mean over the unit circle of conj(T) (x) T ) < 1

where T is the transfer function from the noise to v. Stability in the mean is read off the winding of the
characteristic polynomial along the unit circle (the argument principle), whose phase also says where the circle has to
be looked at closely. All of it costs about the same for any delay, while second moments grow with the square of it
(`delayed_mean_square`, against which a test holds this). Source: Willems and Blankenship,
Frequency domain stability criteria for stochastic systems, IEEE Trans. Autom. Control 16, 1971; Elia, Remote
stabilization over fading channels, Systems & Control Letters 54, 2005.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats
from agv_analysis.stability.linear_loop import LinearLoop

_FIRST, _LAST = 1e-6, np.pi
"""The half circle that is looked at [rad]: at 0 the plant integrates, and the other half is its mirror image."""

_POINTS, _PER_SLOT = 512, 8
"""Angles that are asked at first, so many for each slot of the delay at least."""

_TURN = 0.1
"""The phase turns by less than this from one angle to the next [rad], else there are more angles between them."""

_ROUNDS, _MOST = 40, 50_000
"""How often angles are halved, and how many there may be: beyond, a root is on the circle, which is not stable."""

_GRID = (1e-4, 1e-3, 0.01, 0.03, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.96, 0.99, 0.999, 0.9999)
"""Loss probabilities between which a border is looked for, from below."""

_BISECTIONS = 12

Complex = NDArray[np.complex128]


def critical_loss_behind(loop: LinearLoop, delay: int) -> float:
    """Loss probability up to which a loop that stays as it is takes losses behind a delay of so many slots.

    0 if it does not take the delay itself, 1 if it takes all that are tried. For a loop that holds its pose and is the
    same at every step. Raises ValueError for another.
    """
    if not loop.is_constant or loop.predicts:
        raise ValueError(
            "losses behind a delay are judged for a loop that is the same at every step and holds its pose"
        )
    low = 0.0
    if not _is_stable(loop, delay, low):
        return low
    for high in _GRID:
        if not _is_stable(loop, delay, high):
            break
        low = high
    else:
        return 1.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _is_stable(loop, delay, middle) else (low, middle)
    return low


def _is_stable(loop: LinearLoop, delay: int, p: float) -> bool:
    """Does E[|z|^2] die out behind this delay, with this loss probability?"""
    angles, turned = _circle(loop, delay, p)
    # All m + q (d + 1) roots are inside if the polynomial winds as often about 0; z^(q (d + 1)) is left out of it.
    if round(turned / np.pi) != loop.size:
        return False
    return p == 0.0 or _gain(loop, delay, p, angles) < 1.0


def _circle(loop: LinearLoop, delay: int, p: float) -> tuple[Floats, float]:
    """Angles in (0, pi], denser where a root is near, and by how much the polynomial's phase turns over them [rad].

    The turn is NaN where a root is on the circle.
    """
    angles = np.union1d(
        np.linspace(_FIRST, _LAST, max(_POINTS, _PER_SLOT * delay)), np.geomspace(_FIRST, 0.1, 64)
    )  # fmt: skip
    values = _characteristic(loop, delay, p, angles)
    for _ in range(_ROUNDS):
        turns = np.angle(values[1:] * values[:-1].conj())
        wide = np.flatnonzero(np.abs(turns) > _TURN)
        if not len(wide):
            return angles, float(turns.sum())
        if len(angles) > _MOST:
            break
        between = 0.5 * (angles[wide] + angles[wide + 1])
        values = np.insert(values, wide + 1, _characteristic(loop, delay, p, between))
        angles = np.insert(angles, wide + 1, between)
    return angles, np.nan


def _characteristic(loop: LinearLoop, delay: int, p: float, angles: Floats) -> Complex:
    """det(zI - F) det(inner) on the unit circle, shape (n,): the means' characteristic polynomial but for a power."""
    zeta = np.exp(1j * angles)
    open_loop = np.linalg.det(zeta[:, None, None] * np.eye(loop.size) - loop.F[0])
    return np.asarray(open_loop * np.linalg.det(_inner(loop, delay, p, zeta)[0]), dtype=np.complex128)


def _inner(loop: LinearLoop, delay: int, p: float, zeta: Complex) -> tuple[Complex, Complex]:
    """I (1 - p / z) - s z^-d H and z^-d H, H being the transfer function from y to C z; shapes (n, q, q)."""
    q, z = loop.outputs, zeta[:, None, None]
    plant = np.linalg.solve(z * np.eye(loop.size) - loop.F[0], loop.G[0].astype(np.complex128)[None])[:, :q]
    late = z**-delay * plant
    return np.eye(q) * (1.0 - p / z) - (1.0 - p) * late, late


def _gain(loop: LinearLoop, delay: int, p: float, angles: Floats) -> float:
    """p s times the spectral radius of the mean of conj(T) (x) T; T at -angle is its conjugate."""
    q, zeta = loop.outputs, np.exp(1j * angles)
    inner, late = _inner(loop, delay, p, zeta)
    v = late - np.eye(q) / zeta[:, None, None]
    T = np.linalg.solve(inner.transpose(0, 2, 1), v.transpose(0, 2, 1)).transpose(0, 2, 1)
    weights = np.zeros(len(angles))
    steps = np.diff(angles)
    weights[:-1] += 0.5 * steps
    weights[1:] += 0.5 * steps
    products = np.einsum("k,kij,kmn->imjn", weights / np.pi, T.conj(), T, optimize=True).real
    return p * (1.0 - p) * float(np.abs(np.linalg.eigvals(products.reshape(q * q, q * q))).max())
