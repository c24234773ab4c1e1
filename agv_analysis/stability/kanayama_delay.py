"""Kanayama's law on Euler's unicycle with a pose that is always n steps old, in closed form.

The error about the reference obeys e(k+1) = F e(k) + G e(k-n) (see `linearisation`). At speeds that do not change, its
solutions are z^k with det(z I - F - z^-n G) = 0, which is the characteristic polynomial of the 3 (n+1)-dimensional
block companion ("lifted") system. With a = T_s K_x, b = T_s v_r K_theta, c = T_s^2 v_r^2 K_y, phi = T_s w_r, u = z^-n:

    D(z) = (z cos phi - 1 + a u) [(z cos phi - 1) (z - 1 + b u) + c u] + z^2 sin^2 phi (z - 1 + b u)

The roots are searched for in sigma = z - 1, in which those near 1 keep their relative accuracy, by Newton's method; no
matrix of size 3 (n+1) is formed. On |z| = r the outdated term asks for |u| = r^-n, and |u| grows with the distance from
1; so the largest root of each of the three families (one along the track, two across it) lies on its first branches.

A parked AGV (v_r = 0) cannot move sideways or turn towards the track: the multiplier of what it cannot reach is exactly
1 whatever the gains. Such neutral multipliers are left out here; whether the lap as a whole contracts is for `floquet`.
"""

from __future__ import annotations

import cmath
import math
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats

Complexes = NDArray[np.complex128]

_ANGLES = (0.3, 0.8, 1.3, 1.57, 2.2, 3.0, 4.5, 7.0, 10.0)
"""Where to start: n times the angle of z. A root of the first branch has it below pi, of the second below 3 pi."""

_ITERATIONS = 60

_BLOCK = 8192
"""Roots that are searched for at a time: what becomes of them fits the cache."""


class KanayamaGains(Protocol):
    """Whatever has the gains of Kanayama's law: the controller's parameters, a point of a map."""

    @property
    def kx(self) -> float:
        """K_x [1/s]."""

    @property
    def ky(self) -> float:
        """K_y [1/m^2]."""

    @property
    def ktheta(self) -> float:
        """K_theta [1/m]."""


def spectral_radius(n: int, v_r: float, w_r: float, gains: KanayamaGains, ts: float) -> float:
    """Largest modulus of a multiplier for constant n at the speeds v_r [m/s], w_r [rad/s]; neutral ones left out."""
    return float(spectral_radii(n, np.array([v_r]), np.array([w_r]), gains, ts)[0])


def spectral_radii(n: int, v_r: Floats, w_r: Floats, gains: KanayamaGains, ts: float) -> Floats:
    """As `spectral_radius` for speeds of shape (N,), shape (N,)."""
    a = np.full(len(v_r), ts * gains.kx)
    b, c = ts * gains.ktheta * v_r, ts * ts * gains.ky * v_r * v_r
    return radii_of(np.full(len(v_r), float(n)), a, b, c, ts * w_r, v_r == 0.0)


def radii_of(n: Floats, a: Floats, b: Floats, c: Floats, phi: Floats, parked: NDArray[np.bool_]) -> Floats:
    """As `spectral_radius` for loops each of its own, by the numbers that D is made of; all of shape (N,)."""
    loop = _Loop.of(n, a, b, c, phi, parked)
    starts = _starts(loop)
    spread = _Loop(*(np.broadcast_to(values, starts.shape).ravel() for values in loop))
    flat, blocks = starts.ravel(), range(0, starts.size, _BLOCK)
    found = [_newton(flat[i : i + _BLOCK], _Loop(*(values[i : i + _BLOCK] for values in spread))) for i in blocks]
    sigma = np.concatenate(found or [flat]).reshape(starts.shape)
    return np.asarray(np.nanmax(np.abs(1.0 + sigma), axis=0, initial=0.0))


class _Loop(NamedTuple):
    """What D depends on, all of the same shape; cos1 = cos phi - 1, sin2 = sin^2 phi."""

    n: Floats
    a: Floats
    b: Floats
    c: Floats
    phi: Floats
    cos1: Floats
    sin2: Floats
    neutral: Floats
    """How many multipliers are 1 whatever the gains."""

    @classmethod
    def of(cls, n: Floats, a: Floats, b: Floats, c: Floats, phi: Floats, parked: NDArray[np.bool_]) -> _Loop:
        sin2 = np.sin(phi) ** 2
        neutral = np.where(parked, np.where(sin2 != 0.0, 1.0, 2.0), 0.0)
        return cls(n, a, b, c, phi, -2.0 * np.sin(0.5 * phi) ** 2, sin2, neutral)


def _newton(starts: Complexes, loop: _Loop) -> Complexes:
    """A root sigma of D for each start, without the neutral ones; NaN where none was found. All of shape (M,)."""
    found = np.full(starts.shape, np.nan, dtype=np.complex128)
    index, sigma = np.arange(len(starts)), starts
    with np.errstate(all="ignore"):
        for _ in range(_ITERATIONS):
            value, slope = _characteristic(sigma, loop)
            # Newton's step on D / sigma^neutral, whose roots are those of D without the neutral ones.
            step = np.where(value == 0.0, 0.0, value / (slope - loop.neutral * value / sigma))
            sigma = sigma - step
            close = np.abs(step) <= 1e-6 * np.abs(sigma)
            usable = close & ((sigma != 0.0) | (loop.neutral == 0.0))
            found[index[usable]] = sigma[usable]
            going = np.isfinite(sigma) & (np.abs(step) > 1e-14 * np.abs(sigma))
            if not going.any():
                break
            index, sigma, loop = index[going], sigma[going], _Loop(*(values[going] for values in loop))
    return found


def _characteristic(sigma: Complexes, loop: _Loop) -> tuple[Complexes, Complexes]:
    """D and dD/dz at z = 1 + sigma."""
    n, a, b, c, _, cos1, sin2, _ = loop
    z, cos = 1.0 + sigma, 1.0 + cos1
    u = np.exp(-n * np.log1p(sigma))
    du = -n * u / z
    turned, heading = cos * sigma + cos1, sigma + b * u
    dheading = 1.0 + b * du
    across, dacross = turned * heading + c * u, cos * heading + turned * dheading + c * du
    along, dalong = turned + a * u, cos + a * du
    value = along * across + z * z * sin2 * heading
    slope = dalong * across + along * dacross + sin2 * (2.0 * z * heading + z * z * dheading)
    return value, slope


def _starts(loop: _Loop) -> Complexes:
    """Where Newton's method starts, shape (starts, N): on the branches of each family, and near its slow real roots."""
    n, a, b, c, phi = loop.n, loop.a, loop.b, loop.c, loop.phi
    turn = np.exp(1j * phi)
    with np.errstate(all="ignore"):
        starts = []
        for angle in _ANGLES:
            direction = np.exp(1j * angle / (n + 1.0))
            sigma = direction - 1.0
            for u in (np.abs(sigma) / a, np.abs(sigma * sigma) / np.abs(b * sigma + c)):
                starts.append(u ** (-1.0 / (n + 1.0)) * direction - 1.0)
        # To first order u = 1 - n sigma, which leaves a linear equation along the track and a quadratic one across it.
        starts.append(-a / (1.0 - n * a) + 0j)
        p, q = b - n * c, 1.0 - n * b
        root = np.sqrt(p * p - 4.0 * q * c + 0j)
        starts += [-2.0 * c / (p + root), -2.0 * c / (p - root), (-p - root) / (2.0 * q)]
        value, slope = _characteristic(np.zeros(len(a), dtype=np.complex128), loop)
        starts.append(-value / slope)
        # A fast turn mixes along and across; then the slow roots are near exp(i phi).
        starts += [turn * np.exp(1j * angle / (n + 1.0)) - 1.0 for angle in (-2.0, -0.7, 0.0, 0.7, 2.0)]
    return np.array(starts)


def critical_delay_along(a: float) -> float:
    """Delay n in steps, a real number, below which z^n (z - 1) + a has all its roots inside the unit circle.

    From a = 2 sin(pi / (2 (2 n + 1))) (Levin and May, Theor. Popul. Biol. 9, 1976), a = T_s K_x. 0 for a >= 2, where no
    loop is stable, and for a = 0, where the error along the track stays as it is.
    """
    return 0.5 * (math.pi / (2.0 * math.asin(0.5 * a)) - 1.0) if 0.0 < a < 2.0 else 0.0


def critical_delay_across(v: float, gains: KanayamaGains, ts: float) -> float:
    """As `critical_delay_along`, across a straight track at the constant speed `v` [m/s]; inf when parked.

    On |z| = 1 the roots of (z-1)^2 + b u (z-1) + c u = 0, u = z^-n, need x = |z-1|^2 with x^2 = b (b - c) x + c^2. This
    has one positive solution, and the delay follows from the angles of z and u there. 0 where no loop is stable.
    """
    b, c = ts * gains.ktheta * v, ts * ts * gains.ky * v * v
    if v == 0.0:
        return math.inf
    if not 0.0 < c < b or 2.0 * b >= 4.0 + c:  # unstable without outages: the roots of sigma^2 + b sigma + c
        return 0.0
    p = 0.5 * b * (b - c)
    x = p + math.sqrt(p * p + c * c)
    if x >= 4.0:
        return 0.0
    angle = 2.0 * math.asin(0.5 * math.sqrt(x))
    sigma = complex(math.cos(angle), math.sin(angle)) - 1.0
    u = -sigma * sigma / (b * sigma + c)
    return (-cmath.phase(u) % (2.0 * math.pi)) / angle
