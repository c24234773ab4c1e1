"""Random numbers that are a pure function of (seed, stream name, k).

Counter-based (Philox 4x64): slot k owns the k-th counter value and so four numbers of its own, whatever was asked for
before, in whatever order, by whatever process. Only numpy's raw bit stream is used, whose values numpy guarantees
across versions, unlike those of `Generator.random` (NEP 19).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

R = TypeVar("R")

DRAWS = 4

_BLOCK = 64
"""Steps whose normal numbers are made at once: in real time that must take a negligible time."""


def uniforms(seed: int, stream: str, first: int, count: int) -> NDArray[np.float64]:
    """Numbers uniform in [0, 1) of the slots first .. first + count - 1, shape (count, DRAWS)."""
    key = int.from_bytes(hashlib.sha256(f"{seed}/{stream}".encode()).digest()[:16], "little")
    raw: NDArray[np.uint64] = np.random.Philox(key=key, counter=first).random_raw(count * DRAWS)
    # The top 53 bits fill a double's mantissa exactly.
    return np.asarray((raw >> np.uint64(11)) * 2.0**-53).reshape(count, DRAWS)


def normal_pair(u_radius: float, u_angle: float) -> tuple[float, float]:
    """Two independent standard normal numbers from two that are uniform in [0, 1).

    Source: Box and Muller, A note on the generation of random normal deviates, 1958.
    """
    radius, angle = math.sqrt(-2.0 * math.log(1.0 - u_radius)), 2.0 * math.pi * u_angle
    return radius * math.cos(angle), radius * math.sin(angle)


class InBlocks(Generic[R]):
    """Random numbers of single steps, a row each, made some at a time; whatever step was asked for before."""

    def __init__(self, make: Callable[[int, int], Sequence[R]], block: int) -> None:
        """`make` gives the rows of the steps first .. first + count - 1."""
        self._make, self._size = make, block
        self._first = -1
        self._block: Sequence[R] = ()

    def at(self, k: int) -> R:
        """The row of step k >= 0."""
        first = k - k % self._size
        if first != self._first:
            self._block, self._first = self._make(first, self._size), first
        return self._block[k - first]


Normal = tuple[float, float, float, float]


def normals_of(seed: int, stream: str) -> InBlocks[Normal]:
    """Standard normal numbers of one stream, DRAWS for each step."""

    def make(first: int, count: int) -> list[Normal]:
        rows = uniforms(seed, stream, first, count).tolist()
        return [(*normal_pair(a, b), *normal_pair(c, d)) for a, b, c, d in rows]

    return InBlocks(make, _BLOCK)
