"""Uniform random numbers that are a pure function of (seed, stream name, k).

Counter-based (Philox 4x64): slot k owns the k-th counter value and so four numbers of its own, whatever was asked for
before, in whatever order, by whatever process. Only numpy's raw bit stream is used, whose values numpy guarantees
across versions, unlike those of `Generator.random` (NEP 19).
"""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

DRAWS = 4


def uniforms(seed: int, stream: str, first: int, count: int) -> NDArray[np.float64]:
    """Numbers uniform in [0, 1) of the slots first .. first + count - 1, shape (count, DRAWS)."""
    key = int.from_bytes(hashlib.sha256(f"{seed}/{stream}".encode()).digest()[:16], "little")
    raw: NDArray[np.uint64] = np.random.Philox(key=key, counter=first).random_raw(count * DRAWS)
    # The top 53 bits fill a double's mantissa exactly.
    return np.asarray((raw >> np.uint64(11)) * 2.0**-53).reshape(count, DRAWS)
