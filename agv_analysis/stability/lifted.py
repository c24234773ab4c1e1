"""Constant outdatedness: the pose that the edge uses is always n steps old.

At speeds that do not change the loop is then a linear system with a delay, whose multipliers are the eigenvalues of a
block companion ("lifted") matrix of size m + q n. Kanayama's law on Euler's unicycle has them in closed form at each
speed of the track (`kanayama_delay`); any other loop is asked for what a whole lap does (`floquet`).
"""

from __future__ import annotations

import math

import numpy as np

from agv_analysis.run import Floats
from agv_analysis.stability import floquet
from agv_analysis.stability.first_border import last_stable
from agv_analysis.stability.kanayama_delay import critical_delay_across, critical_delay_along, spectral_radii
from agv_analysis.stability.linear_loop import LinearLoop
from agv_cloud.parameters import ControllerParameters


def largest_radius(loop: LinearLoop, n: int) -> float:
    """Largest spectral radius at any speed of the lap, held forever, for a pose that is always `n` steps old.

    In closed form where there is one; else the growth factor per step over the lap. An exact prediction is as good as
    a fresh pose.
    """
    n = 0 if loop.is_exact else n
    gains = _gains(loop)
    if gains is None:
        return math.exp(floquet.constant_delay(loop, n) / loop.steps)
    v, w = distinct_speeds(loop.v_r, loop.w_r)
    return float(spectral_radii(n, v, w, gains, loop.ts).max())


def largest_n(loop: LinearLoop, limit: int = 100_000) -> int | None:
    """Largest n up to which every speed of the lap, held forever, is stable; -1: not even 0, None: over `limit`.

    The closed forms for a straight track say where to look, the spectral radius at the lap's speeds decides. Without a
    closed form the lap as a whole decides, as of `floquet.largest_constant_delay`.
    """
    gains = _gains(loop)
    if gains is None:
        return floquet.largest_constant_delay(loop, limit)
    v, w = distinct_speeds(loop.v_r, loop.w_r)
    return last_stable(
        lambda n: float(spectral_radii(n, v, w, gains, loop.ts).max()) < 1.0, min(critical_delay(loop), limit), limit
    )


def worst_step(loop: LinearLoop, n: int) -> int:
    """A step of the lap whose speeds, held forever, are the worst for a pose that is always `n` steps old.

    In closed form where there is one; else the fastest step.
    """
    gains = _gains(loop)
    if gains is None:
        return int(np.argmax(np.abs(loop.v_r)))
    _, first = np.unique(_speeds(loop.v_r, loop.w_r), axis=0, return_index=True)
    radii = spectral_radii(0 if loop.is_exact else n, loop.v_r[first], loop.w_r[first], gains, loop.ts)
    return int(first[np.argmax(radii)])


def companion(loop: LinearLoop, n: int) -> Floats:
    """The lifted system of a loop that is the same at every step, for a pose that is always `n` steps old.

    Of (z(k), h(k-1) .. h(k-n)) where the pose is held, of (z(k), nu(k-1) .. nu(k-n)) behind a predictor (see
    `floquet`): shape (m + q n, m + q n).
    """
    m, q = loop.size, loop.outputs
    z, *past = np.split(np.eye(m + q * n), range(m, m + q * n, q)) if n else [np.eye(m)]
    now, h = z[:q], past[-1] if past else z[:q]
    if loop.P_h is not None and loop.innovation is not None:
        E_z, E_h = (E[0] for E in loop.innovation)
        window = np.zeros_like(now)
        for nu in reversed(past):
            window = loop.P_h[0] @ window + nu
        h = z[:q] - window
        now = E_z @ z + E_h @ h
    return np.asarray(np.concatenate((loop.F[0] @ z + loop.G[0] @ h, *([now, *past[:-1]] if n else []))))


def _gains(loop: LinearLoop) -> ControllerParameters | None:
    """The gains of the closed form, where it holds of an outdated pose as well."""
    return None if loop.predicts and not loop.is_exact else loop.closed_form


def critical_delay(loop: LinearLoop) -> float:
    """Delay in steps, a real number, below which a held pose leaves the loop stable on a straight track at top speed.

    For a loop with a closed form.
    """
    gains = loop.closed_form
    if gains is None:
        raise ValueError("the critical delay between samples is known for Kanayama's law on Euler's unicycle alone")
    along, across = critical_delay_along(loop.ts * gains.kx), critical_delay_across(loop.top_speed, gains, loop.ts)
    return min(along, across)


def distinct_speeds(v_r: Floats, w_r: Floats) -> tuple[Floats, Floats]:
    """The pairs of speeds of a track without repetitions; +-w_r are one, for left and right are alike."""
    pairs = np.unique(_speeds(v_r, w_r), axis=0)
    return pairs[:, 0], pairs[:, 1]


def _speeds(v_r: Floats, w_r: Floats) -> Floats:
    return np.asarray(np.column_stack((v_r, np.abs(w_r))).round(12))
