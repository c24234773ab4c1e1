"""Messages of known layouts go from the chunk to their rows of a table in one compiled loop.

numpy does the same in a dozen calls for each topic of each chunk (`Table`), which is as fast as small bags need it;
compiled code takes a quarter of a second to be loaded, and a few seconds to be made the first time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags.checks import is_fraction
from agv_analysis.bags.layout import LEAD, Layout
from agv_analysis.bags.message_batch import Bytes, Ints, number
from agv_analysis.compiled.functions import HAS_NUMBA, compiled
from agv_ros.stamps import NS_PER_S

MAX_LAYOUTS = 32
"""Most layouts that a message is compared with."""


class Run(NamedTuple):
    """Bytes that lie side by side in the message and, just so, in the row."""

    source: int
    target: int
    size: int

    def is_before(self, other: Run) -> bool:
        """Does the other follow without a gap, in the message as in the row?"""
        return self.source + self.size == other.source and self.target + self.size == other.target


class Recipes(NamedTuple):
    """Layouts as numbers: how each is recognised, and what is copied where."""

    sizes: Ints
    """Bytes of the messages, shape (K,)."""
    checks: Ints
    """(offset, byte) pairs that a message must show, one layout after the other, shape (C, 2)."""
    first_check: Ints
    """Where those of each layout begin, and the end, shape (K + 1,)."""
    runs: Ints
    """(source, target, size), one layout after the other, shape (R, 3)."""
    first_run: Ints
    """Where those of each layout begin, and the end, shape (K + 1,)."""
    fractions: Ints
    """Where the nanoseconds of its stamps are, one layout after the other, shape (F,)."""
    first_fraction: Ints
    """Where those of each layout begin, and the end, shape (K + 1,)."""


def recipes(known: Sequence[tuple[int, Layout, Sequence[Run]]]) -> Recipes:
    """Recipes for layouts, each with the size of its messages and its runs."""
    checks = [_checks(layout) for _, layout, _ in known]
    runs = [[tuple(run) for run in runs] for _, _, runs in known]
    fractions = [_fractions(layout) for _, layout, _ in known]
    return Recipes(
        np.array([size for size, _, _ in known], np.int64),
        np.array([pair for pairs in checks for pair in pairs], np.int64).reshape(-1, 2),
        np.cumsum([0, *map(len, checks)]),
        np.array([run for some in runs for run in some], np.int64).reshape(-1, 3),
        np.cumsum([0, *map(len, runs)]),
        np.array([offset for some in fractions for offset in some], np.int64),
        np.cumsum([0, *map(len, fractions)]),
    )


def _checks(layout: Layout) -> list[tuple[int, int]]:
    """The bytes of the encapsulation and of the length words, with their offsets."""
    head = layout.head.to_bytes(2, "little")
    words = layout.lengths.astype(layout.order + "u4")
    pairs = [(LEAD + i, byte) for i, byte in enumerate(head)]
    for offset, word in zip(layout.guards.tolist(), words, strict=True):
        pairs += [(offset + i, byte) for i, byte in enumerate(word.tobytes())]
    return pairs


def _fractions(layout: Layout) -> list[int]:
    """Where the nanoseconds of stamps are in a message that can be copied in runs."""
    leaves = [leaf for leaf in layout.leaves if is_fraction(leaf.path, np.dtype(leaf.code))]
    return [leaf.offsets[0] + 4 * i for leaf in leaves for i in range(leaf.block or 1)]


def place(
    buffer: Bytes,
    starts: Ints,
    lengths: Ints,
    sizes: Ints,
    checks: NDArray[np.int64],
    first_check: Ints,
    runs: NDArray[np.int64],
    first_run: Ints,
    fractions: Ints,
    first_fraction: Ints,
    store: Bytes,
    row_size: int,
    row: int,
    clock: Ints,
) -> int:
    """Copy messages, of `lengths` from `starts` on, to rows of `store` from `row` on, up to one of unknown layout.

    `clock` holds the latest log time [ns] and how many messages have times that `check_times` would report: to look at
    them here costs next to nothing, while afterwards all rows have to come from memory once more. Returns how many
    messages were copied. Written to be compiled.
    """
    for i in range(len(starts)):
        begin, known = starts[i], -1
        for k in range(len(sizes)):
            if sizes[k] == lengths[i]:
                same = True
                for c in range(first_check[k], first_check[k + 1]):
                    if buffer[begin + checks[c, 0]] != checks[c, 1]:
                        same = False
                        break
                if same:
                    known = k
                    break
        if known < 0:
            return i
        to = (row + i) * row_size
        for r in range(first_run[known], first_run[known + 1]):
            source, target, size = begin + runs[r, 0], to + runs[r, 1], runs[r, 2]
            of_message, of_row = buffer[source : source + size], store[target : target + size]
            for j in range(size):  # ten times as fast as with the places added to each index
                of_row[j] = of_message[j]
        log_time = number(buffer, begin, 8)
        is_orderly = log_time > clock[0] and number(buffer, begin + 8, 8) >= 0
        for f in range(first_fraction[known], first_fraction[known + 1]):
            is_orderly = is_orderly and number(buffer, begin + fractions[f], 4) < NS_PER_S
        clock[0] = log_time
        if not is_orderly:
            clock[1] += 1
    return len(starts)


def compiled_place() -> Callable[..., Any] | None:
    """`place`, compiled; None where numba is not installed."""
    return compiled(place) if HAS_NUMBA else None
