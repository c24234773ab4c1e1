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

from agv_analysis.compiled import compiled
from agv_analysis.run import Floats
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.products import multiply


def burst_maps(loop: LinearLoop, longest: int, begins: NDArray[np.int64] | None = None) -> Iterator[Floats]:
    """M_L for L = 1 .. longest, each of shape (R, m, m); row k is that of a burst that begins at step k of the lap.

    Or only of the bursts that begin at the steps `begins`, shape (B,): then of shape (B, m, m).
    """
    F, G, H, K = loop.F, loop.G, loop.H, loop.K
    rows, m, q = G.shape
    first = np.arange(rows) if begins is None else begins
    M = np.broadcast_to(np.eye(m), (len(first), m, m))
    N = np.broadcast_to(np.eye(q, m), (len(first), q, m))
    for i in range(longest):
        now = (first + i) % rows
        following = F[now] @ M
        if H is None:
            following[:, :, :q] += G[now]
        else:
            following += G[now] @ N
            N = H[now] @ N if K is None else H[now] @ N + K[now] @ M
        M = following
        yield M


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
    H = np.empty((0, loop.outputs, loop.outputs)) if loop.H is None else loop.H
    K = np.empty((0, loop.outputs, loop.size)) if loop.K is None else loop.K
    compiled(_fill_in_maps)(loop.F, loop.G, H, K, begins, lengths, maps)
    return maps


def _fill_in_maps(
    F: Floats, G: Floats, H: Floats, K: Floats, received: NDArray[np.int64], lengths: NDArray[np.int64], maps: Floats
) -> None:
    """`maps` of `reception_maps`; H has no row where it is the identity, K none where it is zero."""
    size, outputs = G.shape[1], G.shape[2]
    M, M_next = np.empty((size, size)), np.empty((size, size))
    N, N_next = np.zeros((outputs, size)), np.empty((outputs, size))
    for r in range(len(received)):
        k = received[r] % len(F)
        M[:] = F[k]  # the first step begins with z = I, h = C
        for i in range(size):
            for j in range(outputs):
                M[i, j] += G[k, i, j]
        if len(H) != 0:
            N[:, :outputs], N[:, outputs:] = H[k], 0.0
            if len(K) != 0:
                N += K[k]
        for _ in range(1, lengths[r]):
            k = k + 1 if k + 1 < len(F) else 0
            multiply(F[k], M, False, M_next, False)
            if len(H) == 0:
                for i in range(size):
                    for j in range(outputs):
                        M_next[i, j] += G[k, i, j]
            else:
                multiply(G[k], N, False, M_next, True)
                multiply(H[k], N, False, N_next, False)
                if len(K) != 0:
                    multiply(K[k], M, False, N_next, True)
                N[:] = N_next
            M[:] = M_next
        maps[r] = M
