"""Nested tuples in columns of rows, as `lane_memory` reads and writes them in compiled functions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LANES = 16
"""Runs side by side: four vectors of AVX2, two of AVX-512; enough for one to work while another waits for a sine."""


def rows_of(values: Sequence[Any]) -> Floats:
    """Rows, shape (n, LANES), with one of at most LANES like tuples in each column; the last one in those left over."""
    columns = list(_columns([*values, *[values[-1]] * (LANES - len(values))]))
    rows = np.empty((len(columns), LANES))
    words = rows.view(np.int64)
    for row, column in enumerate(columns):
        (rows if isinstance(column[0], float) else words)[row] = column
    return rows


def _columns(values: Sequence[Any]) -> Iterator[Sequence[float]]:
    """Each number of like tuples, that of all of them together."""
    if isinstance(values[0], tuple):
        for each in zip(*values, strict=True):
            yield from _columns(each)
    elif values[0] is not None:
        yield values


def rows_needed(value: Any) -> int:
    """Numbers in a nested tuple."""
    return sum(1 for _ in _columns([value]))


def tuples_in(rows: Floats, like: Any) -> list[Any]:
    """The tuples of all lanes, of the form of `like`."""
    words = rows.view(np.int64)
    kinds = (isinstance(number, float) for (number,) in _columns([like]))
    return _tuples(like, iter([(rows if is_float else words)[row].tolist() for row, is_float in enumerate(kinds)]))


def _tuples(like: Any, columns: Iterator[list[Any]]) -> list[Any]:
    """A tuple for each lane, from the numbers of each row."""
    if isinstance(like, tuple):
        parts = [_tuples(each, columns) for each in like]
        made: Callable[[Any], Any] = getattr(type(like), "_make", tuple)
        return [made(lane) for lane in zip(*parts, strict=True)] if parts else [like] * LANES
    return [None] * LANES if like is None else next(columns)
