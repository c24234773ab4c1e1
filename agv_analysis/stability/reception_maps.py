"""Maps of the loop's state from one reception to the next: what a burst of losses makes of it.

    z(k+L) = M_L(k) z(k)   if step k was received and the next L - 1 were lost
    M_0 = I, N_0 = C,      M_{i+1} = F(k+i) M_i + G(k+i) N_i,      N_{i+1} = H(k+i) N_i + K(k+i) M_i

N z is what the edge takes for the error meanwhile. With the error that is held and nothing but it as the state, at
constant speeds, M_L = F^L + sum_{i<L} F^i G. Letters as in `linear_loop`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import compiled
from agv_analysis.run import Floats
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.products import assign, multiply, of_size_3


def burst_maps(loop: LinearLoop, longest: int, begins: NDArray[np.int64] | None = None) -> Iterator[Floats]:
    """M_L for L = 1 .. longest, each of shape (R, m, m); row k is that of a burst that begins at step k of the lap.

    Or only of the bursts that begin at the steps `begins`, shape (B,): then of shape (B, m, m).
    """
    first = np.arange(len(loop.F)) if begins is None else begins
    return _bursts(loop.F, loop.G, loop.H, loop.K, np.eye(loop.size), first, longest)


def burst_maps_in(loop: LinearLoop, basis: Floats, longest: int, begins: NDArray[np.int64]) -> Iterator[Floats]:
    """As `burst_maps`, of S z in place of z: S M_L inv(S), with an invertible `basis` S, shape (m, m)."""
    inverse, K = np.asarray(np.linalg.inv(basis), dtype=np.float64), loop.K
    F, G = np.ascontiguousarray(basis @ loop.F @ inverse), np.ascontiguousarray(basis @ loop.G)
    return _bursts(F, G, loop.H, None if K is None else np.ascontiguousarray(K @ inverse), inverse, begins, longest)


def _bursts(
    F: Floats, G: Floats, H: Floats | None, K: Floats | None, inverse: Floats, begins: NDArray[np.int64], longest: int
) -> Iterator[Floats]:  # fmt: skip
    """What `burst_maps` and `burst_maps_in` say; N_0 = C `inverse`."""
    m, q = G.shape[1:]
    M = np.array(np.broadcast_to(np.eye(m), (len(begins), m, m)), order="C")
    N = np.array(np.broadcast_to(inverse[:q], (len(begins), q, m)), order="C")
    for i in range(longest):
        compiled(_one_slot_on, of_size_3(F, G))(F, G, H, K, begins + i, M, N)
        yield M.copy()


def _one_slot_on(
    F: Floats, G: Floats, H: Floats | None, K: Floats | None, steps: NDArray[np.int64], M: Floats, N: Floats
) -> None:
    """M_i and N_i of bursts that have come to these steps, made M_(i+1) and N_(i+1), in place; None as elsewhere."""
    M_next, N_next = np.empty(M.shape[1:]), np.empty(N.shape[1:])
    for r in range(len(steps)):
        k = steps[r] % F.shape[0]
        multiply(F[k], M[r], False, M_next, False)
        multiply(G[k], N[r], False, M_next, True)
        if H is not None:
            multiply(H[k], N[r], False, N_next, False)
            if K is not None:
                multiply(K[k], M[r], False, N_next, True)
            assign(N_next, N[r])
        assign(M_next, M[r])


def reception_maps(loop: LinearLoop, received: NDArray[np.int64], end: int) -> Floats:
    """Maps of z from each reception to the next, and from the last to step `end`; shape (receptions, m, m).

    `received` holds the steps of the receptions, increasing; steps beyond the lap are those of further laps.
    """
    return interval_maps(loop, received, np.diff(np.append(received, end)))


def interval_maps(loop: LinearLoop, begins: NDArray[np.int64], lengths: NDArray[np.int64]) -> Floats:
    """Maps of z over intervals that begin with a reception at the steps `begins`, which need not follow each other.

    `lengths` in steps, >= 1, both of shape (n,); returns shape (n, m, m).
    """
    maps = np.empty((len(begins), loop.size, loop.size))
    drive = compiled(_fill_in_maps, of_size_3(loop.F, loop.G))
    drive(loop.F, loop.G, loop.H, loop.K, begins, lengths, maps)
    return maps


def _fill_in_maps(
    F: Floats,
    G: Floats,
    H: Floats | None,
    K: Floats | None,
    received: NDArray[np.int64],
    lengths: NDArray[np.int64],
    maps: Floats,
) -> None:
    """`maps` of `reception_maps`; H is None where it is the identity, K where it is zero."""
    size, outputs = G.shape[1], G.shape[2]
    M, M_next = np.empty((size, size)), np.empty((size, size))
    N, N_next = np.zeros((outputs, size)), np.empty((outputs, size))
    for r in range(len(received)):
        k = received[r] % len(F)
        assign(F[k], M)  # the first step begins with z = I, h = C
        for i in range(size):
            for j in range(outputs):
                M[i, j] += G[k, i, j]
        if H is not None:
            for i in range(outputs):
                for j in range(size):
                    N[i, j] = H[k, i, j] if j < outputs else 0.0
                    if K is not None:
                        N[i, j] += K[k, i, j]
        for _ in range(1, lengths[r]):
            k = k + 1 if k + 1 < len(F) else 0
            multiply(F[k], M, False, M_next, False)
            if H is None:
                for i in range(size):
                    for j in range(outputs):
                        M_next[i, j] += G[k, i, j]
            else:
                multiply(G[k], N, False, M_next, True)
                multiply(H[k], N, False, N_next, False)
                if K is not None:
                    multiply(K[k], M, False, N_next, True)
                assign(N_next, N)
            assign(M_next, M)
        assign(M, maps[r])
