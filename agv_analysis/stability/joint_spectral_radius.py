"""Arbitrary bursts: between two receptions up to n_max updates are lost, in any order and as often as nature likes.

The state goes from one reception to the next by one of the maps M_1 .. M_L, L = n_max + 1 (`reception_maps`), so the
loop is a switched system and stable if the joint spectral radius of the maps is below 1. It is bounded from both sides:

- below, by what one sequence does: a lap driven with bursts of equal length, for each length;
- above, by a norm x' P x common to all maps (a certificate, found by the ellipsoid method) and the worst growth of that
  norm over a lap among all sequences, which is the largest weight of a path and so exact dynamic programming.

Both are given as growth per step, over a lap that is driven again and again with the speeds that it has; speeds may
change inside a burst. A parked AGV can keep the certificate from falling for a while: the lap as a whole decides.

On a straight track at constant speed each repeated burst has a closed form. Along the track M_L = 1 - a L, so L a < 2;
across it, from the characteristic polynomial of M_L: (L + 1) T_s v K_y < 2 K_theta and
L T_s v (2 K_theta - T_s v K_y) < 4.

Literature: Liberzon, Switching in Systems and Control, 2003; Jungers, The Joint Spectral Radius, 2009.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import compiled
from agv_analysis.run import Floats
from agv_analysis.simulation.batch import cores
from agv_analysis.stability.kanayama_delay import KanayamaGains
from agv_analysis.stability.linear_loop import MARGINAL, LinearLoop
from agv_analysis.stability.products import log_spectral_radius, multiply
from agv_analysis.stability.reception_maps import burst_maps, burst_maps_in

STABLE = "stable"
UNSTABLE = "unstable"
UNDECIDED = "undecided"

_APART = 1e-12
"""Entries of a step's matrix up to which it does not couple two states."""

_ENOUGH = 500
"""Losses in a row beyond which a burst is only tried if none of up to so many grows."""

_ASKED, _ROUNDS = 24, 6
"""Maps that a common norm is searched for at a time, and how often others are added to them, if P has many entries."""


@dataclass(frozen=True)
class BurstVerdict:
    """Is the loop stable for arbitrary bursts of up to `n_max` lost updates?"""

    n_max: int
    verdict: str
    """stable (proved), unstable (a sequence that does not die out was found) or undecided."""
    lower: float
    """Largest growth per step that a sequence was found to have: a lower bound on the joint spectral radius."""
    upper: float
    """Upper bound on it, inf where no common norm was searched for or found."""
    worst: int
    """Burst length (lost updates) whose repetition gives `lower`."""
    certificate: Floats | None
    """P of the common norm z' P z behind `upper`, shape (m, m)."""


def verdict(loop: LinearLoop, n_max: int) -> BurstVerdict:
    """Verdict for arbitrary bursts of up to `n_max` >= 0 losses on a lap.

    Bursts of more than `_ENOUGH` losses are only tried where no shorter one refutes: the maps of a lap take memory.
    """
    asked = 0 if loop.is_exact else n_max  # behind an exact predictor outages leave nothing of their own
    growth = list(_repeated_growths(loop, min(asked, _ENOUGH) + 1))
    if asked > _ENOUGH and max(growth) <= MARGINAL:
        growth = list(_repeated_growths(loop, asked + 1))
    worst = int(np.argmax(growth))
    lower = math.exp(growth[worst])
    if growth[worst] > MARGINAL:
        return BurstVerdict(n_max, UNSTABLE, lower, math.inf, worst, None)
    upper, certificate = _upper_bound(loop, asked)
    return BurstVerdict(n_max, STABLE if upper < 1.0 else UNDECIDED, lower, upper, worst, certificate)


def _upper_bound(loop: LinearLoop, n_max: int) -> tuple[float, Floats | None]:
    """Upper bound on the growth per step under bursts up to `n_max`, and P of the norm behind it, if one is found."""
    certificate = _common_norm(_sample(loop, n_max + 1), _along(loop))
    bound = math.inf if certificate is None else math.exp(_worst_growth(loop, n_max + 1, certificate))
    if n_max == 0 and bound >= 1.0:  # without losses there is one sequence only, whose growth is the bound
        return math.exp(next(_repeated_growths(loop, 1))), None
    return bound, certificate


def largest_n(loop: LinearLoop, limit: int = 1000) -> tuple[int | None, int | None]:
    """(largest n_max that is proved stable, smallest n that is proved unstable) on a lap.

    The first is -1 if not even a loop without losses is proved stable, the second None if there is none up to `limit`;
    both None: stable up to `limit`. They are neighbours unless what lies between them is undecided.
    """
    limit = 0 if loop.is_exact else limit  # an outage leaves nothing that its absence would not
    refuted = first_refuted(loop, limit)
    proved, beyond = -1, limit + 1 if refuted is None else refuted
    attempt = beyond - 1  # just below what is refuted: nearly always proved at once
    while proved < beyond - 1:
        if _upper_bound(loop, attempt)[0] < 1.0:
            proved = attempt
        else:
            beyond = attempt
        attempt = (proved + beyond) // 2
    return (None if proved == limit else proved), refuted


def first_refuted(loop: LinearLoop, limit: int) -> int | None:
    """Smallest n whose repetition does not die out, None if there is none up to `limit`."""
    return next((n for n, growth in enumerate(_repeated_growths(loop, limit + 1)) if growth > MARGINAL), None)


def largest_n_straight(loop: LinearLoop) -> tuple[int | None, int | None]:
    """(along, across): largest n whose repetition contracts on a straight track at the lap's top speed.

    -1 if not even a loop without losses contracts, None if there is no limit. For a loop with a closed form.
    """
    if loop.closed_form is None:
        raise ValueError("bursts on a straight track have a closed form for Kanayama's law on Euler's unicycle alone")
    along = largest_n_along(loop.ts * loop.closed_form.kx)
    return along, largest_n_across(loop.top_speed, loop.closed_form, loop.ts)


def largest_n_along(a: float) -> int | None:
    """Largest n with (n + 1) a < 2, a = T_s K_x; -1 if there is none, None (no limit) for a = 0, which is marginal."""
    return None if a == 0.0 else max(-1, math.ceil(2.0 / a) - 2)


def largest_n_across(v: float, gains: KanayamaGains, ts: float) -> int | None:
    """Largest n whose repetition contracts across a straight track at the constant speed `v` > 0 [m/s].

    -1 if not even a loop without losses contracts, None if there is no limit.
    """
    step, ky, ktheta = ts * v, gains.ky, gains.ktheta
    if step <= 0.0 or ky == 0.0 or ktheta == 0.0:
        return -1
    longest = 2.0 * ktheta / (step * ky) - 1.0
    if 2.0 * ktheta > step * ky:
        longest = min(longest, 4.0 / (step * (2.0 * ktheta - step * ky)))
    return max(-1, math.ceil(longest) - 2)


def _repeated_growths(loop: LinearLoop, longest: int) -> Iterator[float]:
    """Growth (logarithm, per step) of the sequence that repeats bursts of L steps, for L = 1 .. longest.

    The last burst of a lap is cut short by its end.
    """
    steps, shorter = len(loop.F), [np.broadcast_to(np.eye(loop.size), loop.F.shape)]
    for length, M in enumerate(burst_maps(loop, longest), start=1):
        if steps == 1:
            yield log_spectral_radius(M) / length
            continue
        shorter.append(M)
        whole, rest = divmod(steps, length)
        factors = M[: whole * length : length] if whole else M[:0]
        if rest:
            factors = np.concatenate((factors, shorter[rest][whole * length :][:1]))
        yield log_spectral_radius(factors) / steps


def _sample(loop: LinearLoop, longest: int) -> Floats:
    """Maps of all burst lengths from a few dozen steps at which the AGV moves, shape (M, m, m)."""
    if loop.is_constant:
        return np.concatenate(list(burst_maps(loop, longest)))
    moving = np.flatnonzero(np.abs(loop.v_r) > 0.05 * loop.top_speed)
    moving = moving[:: max(1, len(moving) // 48)]
    return np.concatenate(list(burst_maps(loop, longest, moving)))


def _along(loop: LinearLoop) -> NDArray[np.bool_]:
    """Which states go with x_e where the AGV moves and turns least, shape (m,): the drive's speed, say, if it lags."""
    along: NDArray[np.bool_] = np.arange(loop.size) == 0
    if loop.size <= 3:
        return along
    k = 0 if loop.is_constant else int(np.argmin(np.abs(loop.v_r) + np.abs(loop.w_r)))
    coupling = np.abs(loop.F[k]) > _APART
    coupling[:, : loop.outputs] |= np.abs(loop.G[k]) > _APART
    coupling |= coupling.T | np.eye(loop.size, dtype=np.bool_)
    for _ in range(loop.size):
        along = np.asarray(coupling[along].any(axis=0), dtype=np.bool_)
    return along


def _common_norm(maps: Floats, along: NDArray[np.bool_]) -> Floats | None:
    """P > 0 with M' P M < P for each of the maps, shape (M, m, m); None if the search ends without one.

    The ellipsoid method with deep cuts (Bland, Goldfarb and Todd, Oper. Res. 29, 1981) over the entries of P. First P
    without terms that couple the states `along` the track with the others is searched for: it is a norm that never
    grows while the AGV is parked. Where P has many entries, a few of the maps that span them all, and those that the P
    found for these does not shrink, are asked.
    """
    size = maps.shape[-1]
    entries = [(i, j) for i in range(size) for j in range(i, size)]
    apart = [(i, j) for i, j in entries if along[i] == along[j]]
    asked = np.arange(len(maps)) if size <= 3 else np.arange(0, len(maps), max(1, len(maps) // _ASKED))
    for free in (apart, entries) if len(apart) < len(entries) else (entries,):
        for _ in range(_ROUNDS):
            found = _ellipsoid(maps[asked], free)
            if found is None:
                break
            growing = np.flatnonzero(_log_norms(maps, found) >= 0.0) if len(asked) < len(maps) else asked[:0]
            if not len(growing):
                return found
            asked = np.union1d(asked, growing[:: max(1, len(growing) // _ASKED)])
    return None


def _ellipsoid(maps: Floats, entries: list[tuple[int, int]]) -> Floats | None:
    n, size = len(entries), maps.shape[-1]
    basis = np.zeros((n, size, size))
    for entry, (i, j) in zip(basis, entries, strict=True):
        entry[i, j] = entry[j, i] = 1.0
    centre, shape = np.array([float(i == j) for i, j in entries]), 100.0 * np.eye(n)
    for _ in range(150 * n):
        cut = _violation(maps, np.tensordot(centre, basis, 1))
        if cut is None:
            return np.asarray(np.tensordot(centre, basis, 1))
        outer, depth = cut
        slope = np.tensordot(basis, outer, 2)
        width = math.sqrt(max(0.0, float(slope @ shape @ slope)))
        if n == 1 or depth >= width:
            return None
        deep = (1.0 + n * depth / width) / (n + 1.0)
        direction = shape @ slope / width
        centre = centre - deep * direction
        shape = (n * n / (n * n - 1.0)) * (1.0 - (depth / width) ** 2) * (
            shape - 2.0 * deep / (1.0 + depth / width) * np.outer(direction, direction)
        )  # fmt: skip
    return None


def _violation(maps: Floats, P: Floats) -> tuple[Floats, float] | None:
    """(W, depth) with trace(W P) = depth >= 0 although every solution has trace(W P) < 0; None if P is a solution."""
    values, vectors = np.linalg.eigh(P)
    if values[0] <= 1e-9 * values[-1]:
        x = vectors[:, 0]
        return -np.outer(x, x), float(max(0.0, -values[0]))
    differences = np.swapaxes(maps, 1, 2) @ P @ maps - P
    worst = int(_largest_eigenvalues(differences).argmax())
    values, vectors = np.linalg.eigh(differences[worst])
    if values[-1] < 0.0:
        return None
    x = vectors[:, -1]
    y = maps[worst] @ x
    return np.outer(y, y) - np.outer(x, x), float(values[-1])


def _worst_growth(loop: LinearLoop, longest: int, P: Floats) -> float:
    """Upper bound on the growth (logarithm, per step) of sqrt(x' P x) for any sequence of bursts up to `longest` steps.

    With V(k) the largest growth from step k to the end of the lap, V(k) = max_L [log norm of M_L(k) + V(k + L)]. For
    any values W assumed beyond the end, max_k V(k) - W(k) bounds the growth of a lap (Collatz-Wielandt, max-plus).
    """
    log_norms = _log_norms_of_bursts(loop, longest, P)
    if loop.is_constant:
        return float((log_norms[0] / np.arange(1, longest + 1)).max())
    log_norms = np.tile(log_norms, (-(-longest // loop.steps), 1))
    steps = len(log_norms)
    V = np.zeros(steps + longest)
    for _ in range(2):
        beyond = V[steps:].copy()
        compiled(_heaviest_paths)(log_norms, V)
        growth = float((V[:longest] - beyond).max())
        V[steps:] = V[:longest] - V[0]
    return growth / steps


def _heaviest_paths(weights: Floats, V: Floats) -> None:
    """V[k] = max_L weights[k, L - 1] + V[k + L], from the last row of the weights, shape (K, longest), to the first."""
    for k in range(weights.shape[0] - 1, -1, -1):
        largest = -math.inf
        for i in range(weights.shape[1]):
            largest = max(largest, weights[k, i] + V[k + 1 + i])
        V[k] = largest


def _log_norms_of_bursts(loop: LinearLoop, longest: int, P: Floats) -> Floats:
    """`_log_norms` of `burst_maps`, shape (R, longest); the steps of the lap are shared out among threads."""
    root = np.linalg.cholesky(P).T
    log_norms = np.empty((len(loop.F), longest))

    def fill_in(begins: NDArray[np.int64]) -> None:
        for i, inner in enumerate(burst_maps_in(loop, root, longest, begins)):
            log_norms[begins, i] = _log_euclidean_norms(inner)

    parts = np.array_split(np.arange(len(loop.F)), min(cores(), len(loop.F)))
    with ThreadPoolExecutor(len(parts)) as pool:
        list(pool.map(fill_in, parts))
    return log_norms


def _log_norms(maps: Floats, P: Floats) -> Floats:
    """Logarithm of the norm of each map, shape (N, m, m), in the vector norm sqrt(x' P x); shape (N,)."""
    root = np.linalg.cholesky(P).T
    return _log_euclidean_norms(root @ maps @ np.linalg.inv(root))


def _log_euclidean_norms(maps: Floats) -> Floats:
    """Logarithm of the largest singular value of each map, shape (N, m, m); shape (N,)."""
    squares = np.empty(len(maps))
    if maps.shape[-1] == 3:
        compiled(_fill_in_squares)(maps, squares)
    else:
        squares[:] = np.linalg.eigvalsh(np.swapaxes(maps, 1, 2) @ maps)[:, -1]
    with np.errstate(divide="ignore"):  # a burst that leaves nothing of the error: -inf
        return np.asarray(0.5 * np.log(np.maximum(squares, 0.0)))


def _fill_in_squares(maps: Floats, squares: Floats) -> None:
    """Square of the largest singular value of each of the maps, shape (N, 3, 3)."""
    S = np.empty((3, 3))
    for k in range(len(maps)):
        multiply(maps[k], maps[k], True, S, False)
        squares[k] = _largest_eigenvalue(S)


def _largest_eigenvalues(S: Floats) -> Floats:
    """Largest eigenvalue of symmetric matrices of shape (N, m, m)."""
    if S.shape[-1] != 3:
        return np.asarray(np.linalg.eigvalsh(S)[:, -1])
    found = np.empty(len(S))
    compiled(_fill_in_eigenvalues)(np.ascontiguousarray(S), found)
    return found


def _fill_in_eigenvalues(S: Floats, largest: Floats) -> None:
    """The largest eigenvalue of each of symmetric matrices S, shape (N, 3, 3)."""
    for k in range(len(S)):
        largest[k] = _largest_eigenvalue(S[k])


def _largest_eigenvalue(S: Floats) -> float:
    """The largest eigenvalue of a symmetric matrix of shape (3, 3), by Smith's closed form (CACM 4, 1961)."""
    p, q, r = S[0, 1], S[0, 2], S[1, 2]
    mean = (S[0, 0] + S[1, 1] + S[2, 2]) / 3.0
    a, b, c = S[0, 0] - mean, S[1, 1] - mean, S[2, 2] - mean
    spread = math.sqrt((a * a + b * b + c * c + 2.0 * (p * p + q * q + r * r)) / 6.0)
    det = a * (b * c - r * r) - p * (p * c - r * q) + q * (p * r - b * q)
    cos3 = min(1.0, max(-1.0, det / max(2.0 * spread * spread * spread, 1e-300)))
    return float(mean + 2.0 * spread * math.cos(math.acos(cos3) / 3.0))
