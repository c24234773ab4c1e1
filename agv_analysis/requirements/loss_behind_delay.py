"""Independent losses behind a constant delay: how many a loop takes, by the norm of its response to the losses.

With a message of d slots ago received with probability s = 1 - p, what the edge holds is

    y(k) = p y(k-1) + s C z(k-d) + (theta(k) - s) v(k),    v(k) = C z(k-d) - y(k-1),    z(k+1) = F z(k) + G y(k)

theta(k) is 1 at a reception and 0 at a loss, so the losses are a white noise that multiplies v, with variance p s. The
loop is mean-square stable if and only if it is stable in the mean and

    p s  rho( mean over the unit circle of conj(T) (x) T ) < 1

where T is the transfer function from the noise to v. It costs the same for any delay, while the second moments grow
with the square of it (`delayed_mean_square`, against which a test holds this). Source: Willems and Blankenship,
Frequency domain stability criteria for stochastic systems, IEEE Trans. Autom. Control 16, 1971; Elia, Remote
stabilization over fading channels, Systems & Control Letters 54, 2005.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats
from agv_analysis.stability.linear_loop import LinearLoop

_POINTS = 1024
"""Frequencies on the unit circle that are asked in any case."""

_NEAR, _AROUND = 0.05, 200
"""A pole of the mean that is closer than this to the unit circle makes a peak, which gets so many frequencies more."""

_GRID = (1e-4, 1e-3, 0.01, 0.03, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.96, 0.99, 0.999, 0.9999)
"""Loss probabilities between which a border is looked for, from below."""

_BISECTIONS = 11

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
    poles = np.linalg.eigvals(_mean(loop, delay, p)).astype(np.complex128)
    if np.abs(poles).max() >= 1.0:
        return False
    return p == 0.0 or _gain(loop, delay, p, _angles(poles)) < 1.0


def _mean(loop: LinearLoop, delay: int, p: float) -> Floats:
    """The loop of the means: of (z(k), C z(k-1) .. C z(k-d), y(k-1)), shape (m + q (d + 1), m + q (d + 1))."""
    m, q = loop.size, loop.outputs
    size = m + q * (delay + 1)
    rows = np.eye(size)
    C, late, held = rows[:q], rows[:q] if delay == 0 else rows[size - 2 * q : size - q], rows[size - q :]
    y = p * held + (1.0 - p) * late
    window = np.concatenate((C, rows[m : size - 2 * q])) if delay else np.zeros((0, size))
    return np.concatenate((loop.F[0] @ rows[:m] + loop.G[0] @ y, window, y))


def _angles(poles: Complex) -> Floats:
    """Angles in (0, pi), denser where a pole is near the unit circle, with both ends; shape (n,), increasing."""
    found = [np.linspace(0.0, np.pi, _POINTS)]
    for pole in poles[(np.abs(poles) > 1.0 - _NEAR) & (poles.imag >= 0.0)]:
        wide = np.sinh(np.linspace(-12.0, 12.0, _AROUND))
        found.append(np.angle(pole) + (1.0 - np.abs(pole)) * wide)
    return np.unique(np.clip(np.concatenate(found), 1e-9, np.pi))  # at 0 the plant integrates


def _gain(loop: LinearLoop, delay: int, p: float, angles: Floats) -> float:
    """p s times the spectral radius of the mean of conj(T) (x) T; T at -angle is its conjugate."""
    q, zeta = loop.outputs, np.exp(1j * angles)[:, None, None]
    plant = np.linalg.solve(zeta * np.eye(loop.size) - loop.F[0], loop.G[0].astype(np.complex128)[None])[:, :q]
    late = zeta**-delay * plant
    inner = np.eye(q) * (1.0 - p / zeta) - (1.0 - p) * late
    T = np.linalg.solve(inner.transpose(0, 2, 1), (late - np.eye(q) / zeta).transpose(0, 2, 1)).transpose(0, 2, 1)
    weights = np.zeros(len(angles))
    steps = np.diff(angles)
    weights[:-1] += 0.5 * steps
    weights[1:] += 0.5 * steps
    products = np.einsum("k,kij,kmn->imjn", weights / np.pi, T.conj(), T, optimize=True).real
    return p * (1.0 - p) * float(np.abs(np.linalg.eigvals(products.reshape(q * q, q * q))).max())
