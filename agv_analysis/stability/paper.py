"""The paper's test: eigenvalues of A(k) (eq. 21) at every step, |lambda| < 1 (eq. 24).

A(k) sums the Jacobians of X_c(k+1) with respect to X_c(k) and to X_c(k-n): it treats the outdated pose as if it were
the current one. With mu = 1 - lambda and Delta = theta_c(k) - theta_c(k-n) its characteristic polynomial is

    mu^3 - (a cos Delta + b) mu^2 + (a b + c) cos Delta mu - a c = 0,  a = T_s K_x, b = T_s v K_theta, c = T_s^2 v^2 K_y

with v = v_r(k-n). So the outdated pose enters through Delta alone, and on a straight track not at all. The literal
eq. 21 has the commanded speed nu(k-n) instead of v_r(k-n) in A(3,2); `v_literal` keeps that form.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import compiled
from agv_analysis.run import Floats
from agv_cloud.parameters import ControllerParameters


def matrices(
    theta: Floats,
    theta_held: Floats,
    v_held: Floats,
    gains: ControllerParameters,
    ts: float,
    v_literal: Floats | None = None,
) -> Floats:
    """A(k) of eq. 21, shape (N, 3, 3).

    theta = theta_c(k) and theta_held = theta_c(k-n) [rad], v_held = v_r(k-n) [m/s], all of shape (N,); v_literal =
    nu(k-n) [m/s] where A(3,2) shall be as printed.
    """
    cos, sin, cos_held, sin_held = np.cos(theta), np.sin(theta), np.cos(theta_held), np.sin(theta_held)
    v_32 = v_held if v_literal is None else v_literal
    A = np.empty((len(theta), 3, 3))
    A[:, 0, 0] = 1.0 - ts * gains.kx * cos * cos_held
    A[:, 0, 1] = -ts * gains.kx * cos * sin_held
    A[:, 0, 2] = -ts * sin * v_held
    A[:, 1, 0] = -ts * gains.kx * sin * cos_held
    A[:, 1, 1] = 1.0 - ts * gains.kx * sin * sin_held
    A[:, 1, 2] = ts * cos * v_held
    A[:, 2, 0] = ts * gains.ky * sin_held * v_held
    A[:, 2, 1] = -ts * gains.ky * cos_held * v_32
    A[:, 2, 2] = 1.0 - ts * gains.ktheta * v_held
    return A


def spectral_radii(
    theta: Floats,
    theta_held: Floats,
    v_held: Floats,
    gains: ControllerParameters,
    ts: float,
    v_literal: Floats | None = None,
) -> Floats:
    """Spectral radius of A(k), shape (N,); arguments as of `matrices`.

    From the characteristic cubic in mu = 1 - lambda, whose small roots keep their relative accuracy.
    """
    cos, sin, cos_held, sin_held = np.cos(theta), np.sin(theta), np.cos(theta_held), np.sin(theta_held)
    v_32 = v_held if v_literal is None else v_literal
    a, b = ts * gains.kx, ts * gains.ktheta * v_held
    cos_delta = cos * cos_held + sin * sin_held
    across = ts * ts * gains.ky * v_held
    second = (a * b) * cos_delta + across * (cos * cos_held * v_32 + sin * sin_held * v_held)
    third = a * across * (cos_held**2 * v_32 + sin_held**2 * v_held)
    return _largest_distance_from_one(a * cos_delta + b, second, third)


def largest_n(theta: Floats, v_r: Floats, gains: ControllerParameters, ts: float) -> int | None:
    """Largest n_ul for which the test holds at every step of a lap driven on the reference, and for all smaller ones.

    Heading theta [rad] and speed v_r [m/s] of the reference, shape (N,); for k < n the edge holds X_c(0). -1 if it
    fails even without outages, None if it holds for every n up to the lap's end.

    For a pose held at step j the test fails at the steps k at which |theta(k) - theta(j)| is at least a critical angle.
    """
    if not np.all(_holds_without_outages(v_r, gains, ts)):
        return -1
    found = int(compiled(_widest)(np.ascontiguousarray(theta), _critical_angles(v_r, gains, ts)))
    return None if found == len(theta) else found


def _widest(theta: Floats, critical: Floats) -> int:
    """Largest n for which no heading is a critical angle away from one at most n steps before; N if none ever is.

    In one pass, over a window that shrinks at each pair that fails. What of the steps before decides, the least
    theta + critical and the largest theta - critical in the window, is kept in two queues (Lemire, Streaming
    maximum-minimum filter, 2006).
    """
    above, below = theta + critical, theta - critical
    least, largest = np.empty(len(theta), np.int64), np.empty(len(theta), np.int64)
    least_from = least_to = largest_from = largest_to = 0
    n, first = len(theta), 0
    for k in range(len(theta)):
        while least_to > least_from and above[least[least_to - 1]] >= above[k]:
            least_to -= 1
        while largest_to > largest_from and below[largest[largest_to - 1]] <= below[k]:
            largest_to -= 1
        least[least_to] = largest[largest_to] = k
        least_to, largest_to = least_to + 1, largest_to + 1
        first = max(first, k - n)
        while True:
            while least_from < least_to and least[least_from] < first:
                least_from += 1
            while largest_from < largest_to and largest[largest_from] < first:
                largest_from += 1
            if least_from < least_to and theta[k] >= above[least[least_from]]:
                first = least[least_from] + 1
            elif largest_from < largest_to and theta[k] <= below[largest[largest_from]]:
                first = largest[largest_from] + 1
            else:
                break
            n = k - first
    return n


def _holds_without_outages(v: Floats, gains: ControllerParameters, ts: float) -> NDArray[np.bool_]:
    """Whether the test holds for Delta = 0: the cubic is (mu - a) (mu^2 - b mu + c), asked by Jury's criterion."""
    a, b, c = ts * gains.kx, ts * gains.ktheta * v, ts * ts * gains.ky * v * v
    return np.asarray((0.0 < a < 2.0) & (c > 0.0) & (c < b) & (b < 2.0 + 0.5 * c))


def _critical_angles(v: Floats, gains: ControllerParameters, ts: float) -> Floats:
    """Smallest |Delta| at which A(k) has an eigenvalue of modulus 1, for v = v_r(k-n); inf if there is none.

    With q = cos Delta the coefficients of the cubic are linear in q. An eigenvalue is -1 where it vanishes at mu = 2; a
    pair is on the unit circle where the pair's sum in mu equals its product, which leaves a quadratic equation in q.
    """
    a, b, c = ts * gains.kx, ts * gains.ktheta * v, ts * ts * gains.ky * v * v
    s, d = a * b + c, a * c
    p2, p1, p0 = s * (s - a), a * d - 2.0 * s * d - b * s, d * (d + b + 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(p1 * p1 - 4.0 * p2 * p0)
        pairs = 2.0 * p0 / np.array([-p1 - root, -p1 + root])
        total = s * pairs - d
        pairs[~((total > 0.0) & (total < 4.0))] = np.nan  # the roots of such a pair are real
        cosines = np.vstack((pairs, (8.0 - 4.0 * b - d) / (4.0 * a - 2.0 * s)))
    nearest = np.where(np.abs(cosines) <= 1.0, cosines, -2.0).max(axis=0)
    return np.where(nearest >= -1.0, np.arccos(np.maximum(nearest, -1.0)), np.inf)


def _largest_distance_from_one(t: Floats, s: Floats, d: Floats) -> Floats:
    """max |1 - mu| over the roots of mu^3 - t mu^2 + s mu - d."""
    real = _real_root(t, s, d)
    # The other two are the roots of mu^2 - total mu + product. Dividing the cubic from its high end loses the small
    # roots to rounding where `real` is large, from its low end where it is small.
    large = np.abs(real) ** 3 > np.abs(d)
    with np.errstate(divide="ignore", invalid="ignore"):
        product = np.where(large, d / real, s - real * (t - real))
        total = np.where(large & (real != 0.0), (s - product) / real, t - real)
    half = 0.5 * total
    discriminant = half * half - product
    root = np.sqrt(np.abs(discriminant))
    outer = half + np.copysign(root, half)
    with np.errstate(divide="ignore", invalid="ignore"):
        inner = np.where(outer != 0.0, product / outer, 0.0)
    of_pair = np.where(
        discriminant < 0.0,
        np.hypot(1.0 - half, root),
        np.maximum(np.abs(1.0 - outer), np.abs(1.0 - inner)),
    )
    return np.asarray(np.maximum(np.abs(1.0 - real), of_pair))


def _real_root(t: Floats, s: Floats, d: Floats) -> Floats:
    """An outer real root of mu^3 - t mu^2 + s mu - d.

    Newton's method from beyond the outer root on the side where the value at the inflection says that it lies; it
    converges from there without overshooting (Kahan, To Solve a Real Cubic Equation, 1986).
    """
    x = t / 3.0
    value, slope = ((x - t) * x + s) * x - d, s - t * x
    reach = 1.324718 * np.maximum(np.cbrt(np.abs(value)), np.sqrt(np.maximum(-slope, 0.0)))
    x = x - np.copysign(reach, value)
    for _ in range(60):
        slope = (3.0 * x - 2.0 * t) * x + s
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.where(slope != 0.0, (((x - t) * x + s) * x - d) / slope, 0.0)
        x = x - step
        if np.all(np.abs(step) <= 1e-15 * np.abs(x)):
            break
    return np.asarray(x)
