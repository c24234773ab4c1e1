"""Arrays that may be larger than memory: columns that go on in a file, and figures of what is looked at part by part.

Theory of operation. A column that grows beyond `_IN_MEMORY` bytes moves to a temporary file without a name, which is
mapped into memory. Code that goes through a large array does so in `parts`, and gives back after each what the mapping
holds (`release`): the process then has some MB of it at a time, whatever its length. The pages are those of a file, of
which the system keeps as many as it has room for.
"""

from __future__ import annotations

import mmap
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from agv_analysis.run import Floats

PART = 1 << 17
"""Values that are looked at together."""

_IN_MEMORY = 1 << 22
"""Bytes of a column beyond which it is in a file."""

_LEAST, _MORE = 4096, 8
"""Values that a column has room for, and the share of them by which it grows in memory; in a file it doubles."""

_PLACES = 1 << 12
"""Places all over an array that are looked at together."""

_BITS = 16
"""Of a value that are looked at in one pass over all of them."""


class Column:
    """Values that come in parts, and are never there twice."""

    def __init__(self, dtype: DTypeLike = np.float64) -> None:
        self._values: NDArray[Any] = np.zeros(0, dtype=dtype)
        self._count = 0
        self._file: Any = None

    def __len__(self) -> int:
        return self._count

    def extend(self, values: NDArray[Any]) -> None:
        """Put values at the end."""
        begin = self._count
        self.reach(begin + len(values))
        self._values[begin : self._count] = values
        release(self._values)

    def reach(self, count: int) -> None:
        """Have so many values at least, further ones being 0."""
        if count > len(self._values):
            room = max(count, _LEAST, len(self._values) + len(self._values) // _MORE)
            if room * self._values.itemsize > _IN_MEMORY:
                self._go_on_in_file(max(count, 2 * len(self._values)))
            else:
                self._values.resize(room, refcheck=False)  # in place, where the system can
        self._count = max(self._count, count)

    def _go_on_in_file(self, room: int) -> None:
        """Have room for so many values in a file, which takes no space where nothing was written."""
        before = self._values if self._file is None else None
        self._file = self._file or tempfile.TemporaryFile(prefix="agv_ncs_")  # noqa: SIM115  # as long as the column
        size, dtype = room * self._values.itemsize, self._values.dtype
        self._file.truncate(size)
        self._values = np.frombuffer(mmap.mmap(self._file.fileno(), size), dtype=dtype)
        if before is not None:
            self._values[: len(before)] = before

    @property
    def values(self) -> NDArray[Any]:
        """Those so far, shape (n,): not a copy, and to be asked for again when more have come."""
        return self._values[: self._count]


def column_of(parts: Iterable[NDArray[Any]], dtype: DTypeLike) -> NDArray[Any]:
    """Parts of an array as one, shape (n,)."""
    found = Column(dtype)
    for part in parts:
        found.extend(part)
    return found.values


def release(*arrays: NDArray[Any] | None) -> None:
    """Give back the memory of those of the arrays that are in a file; their values stay."""
    for array in arrays:
        owner: Any = array
        while isinstance(owner, np.ndarray):
            owner = owner.base
        owner = owner.obj if isinstance(owner, memoryview) else owner
        if isinstance(owner, mmap.mmap):
            owner.madvise(mmap.MADV_DONTNEED)


def parts(count: int, *arrays: NDArray[Any] | None, size: int = PART) -> Iterator[slice]:
    """Slices of so many values, one after the other; after each the arrays are released."""
    for first in range(0, count, size):
        yield slice(first, min(first + size, count))
        release(*arrays)


def taken(array: NDArray[Any], places: NDArray[np.int64]) -> NDArray[Any]:
    """The values at some places of an array, which increase, shape (n,)."""
    found = np.empty(len(places), dtype=array.dtype)
    for part in parts(len(places), array, size=_PLACES):
        found[part] = array[places[part]]
    return found


def reordered_by(array: NDArray[Any], places: NDArray[np.int64]) -> NDArray[Any]:
    """The values at some places of an array, in whatever order, shape (n,); quick where neighbours mostly stay so."""
    return column_of((array[places[part]] for part in parts(len(places), array, places)), array.dtype)


def is_increasing(array: NDArray[Any]) -> bool:
    """Is no value less than the one before it?"""
    return not any(
        np.any(array[part.start + 1 : part.stop + 1] < array[part]) for part in parts(len(array) - 1, array)
    )  # fmt: skip


def places_in_order(array: NDArray[Any]) -> NDArray[np.int64]:
    """The places of the values of an array in their order, equal ones in that of the array; none is NaN; shape (n,).

    Of a large array those values are sorted together that lie between two of a sample's.
    """
    count = len(array)
    if count <= _TOGETHER:
        return np.argsort(array, kind="stable")
    sample = np.sort(np.concatenate([array[part][::_SAMPLED] for part in parts(count, array)]))
    bounds = np.unique(sample[:: _TOGETHER // _SAMPLED][1:])
    found = Column(np.int64)
    for i in range(len(bounds) + 1):
        at = places_of(array, lambda part, i=i: np.searchsorted(bounds, part, side="right") == i)  # type: ignore[misc]
        found.extend(at[np.argsort(taken(array, at), kind="stable")])
    return found.values


def firsts_in_order(numbers: NDArray[Any]) -> NDArray[np.int64] | None:
    """The places of different numbers in order, of equal ones the first, shape (n,); None: they are so already."""
    if all(
        np.all(numbers[part.start + 1 : part.stop + 1] > numbers[part]) for part in parts(len(numbers) - 1, numbers)
    ):
        return None
    order = places_in_order(numbers)
    ordered = reordered_by(numbers, order)
    fresh = (
        order[part][
            np.append(part.start == 0 or ordered[part.start - 1] != ordered[part.start], np.diff(ordered[part]) > 0)
        ]
        for part in parts(len(order), order, ordered)
    )
    return column_of(fresh, np.int64)


def places_of(array: NDArray[Any], holds: Callable[[NDArray[Any]], NDArray[np.bool_]]) -> NDArray[np.int64]:
    """The places of those values of an array of which something holds, increasing, shape (n,)."""
    at = (part.start + np.flatnonzero(holds(array[part])) for part in parts(len(array), array))
    return column_of(at, np.int64)


_TOGETHER, _SAMPLED = 1 << 20, 1 << 6
"""Values that are sorted together, about, and of how many one is looked at to find where to part them."""


def all_of(array: NDArray[Any], holds: Callable[[NDArray[Any]], NDArray[np.bool_]]) -> bool:
    """Does something hold of all values of an array?"""
    return all(bool(holds(array[part]).all()) for part in parts(len(array), array))


def count_of(array: NDArray[Any], holds: Callable[[NDArray[Any]], NDArray[np.bool_]]) -> int:
    """Of how many values of an array does something hold?"""
    return sum(int(np.count_nonzero(holds(array[part]))) for part in parts(len(array), array))


def is_all_nan(array: Floats) -> bool:
    """Is no value known?"""
    return all_of(array, np.isnan)


def forget(array: Floats, outcome: NDArray[np.int8], but: int) -> None:
    """In place: NaN where an outcome is another one, both of shape (N,)."""
    for part in parts(len(array), array, outcome):
        np.copyto(array[part], np.nan, where=outcome[part] != but)


def order_statistics(values: Callable[[], Iterable[Floats]], ranks: Sequence[int]) -> list[float]:
    """The values at these places of the order of many, from 0 on; `values` gives them in parts, again and again.

    None of them is NaN. Bit by bit, from the most significant ones down: those of a float sort as an unsigned number
    does once negative ones are turned about.
    """
    prefixes, below = [0] * len(ranks), [0] * len(ranks)
    for shift in range(64 - _BITS, -1, -_BITS):
        counts = {prefix: np.zeros(1 << _BITS, dtype=np.int64) for prefix in prefixes}
        for part in values():
            keys = _sorting_as_floats(part) >> np.uint64(shift)
            for prefix, found in counts.items():
                of_prefix = keys if shift == 64 - _BITS else keys[keys >> np.uint64(_BITS) == np.uint64(prefix)]
                low = (of_prefix & np.uint64((1 << _BITS) - 1)).astype(np.int64)
                found += np.bincount(low, minlength=1 << _BITS)
        for i, rank in enumerate(ranks):
            upto = np.cumsum(counts[prefixes[i]])
            digit = int(np.searchsorted(upto, rank - below[i], side="right"))
            below[i] += int(upto[digit - 1]) if digit else 0
            prefixes[i] = (prefixes[i] << _BITS) | digit
    return _as_floats(np.array(prefixes, dtype=np.uint64)).tolist()  # type: ignore[no-any-return]


def sizes_and_counts(values: Callable[[], Iterable[Floats]]) -> tuple[Floats, NDArray[np.int64]]:
    """Of values >= 0, none of them NaN, in parts: sizes, increasing, and how many have each; to 0.4 % of a size."""
    counts = np.zeros(1 << (_BITS + 4), dtype=np.int64)
    shift = np.uint64(64 - _BITS - 4)
    for part in values():
        counts += np.bincount((_sorting_as_floats(part) >> shift).astype(np.int64), minlength=len(counts))
    found = np.flatnonzero(counts)
    return _as_floats(found.astype(np.uint64) << shift), counts[found]


def median_step(times: Floats) -> float:
    """Median of the differences of neighbours, shape (n,), n >= 2."""
    count = len(times) - 1

    def steps() -> Iterator[Floats]:
        return (np.diff(times[part.start : part.stop + 1]) for part in parts(count, times))

    return sum(order_statistics(steps, [(count - 1) // 2, count // 2])) / 2.0


_SIGN = np.uint64(1 << 63)


def _sorting_as_floats(values: Floats) -> NDArray[np.uint64]:
    bits = np.ascontiguousarray(values, dtype=np.float64).view(np.uint64)
    return np.where(bits & _SIGN, ~bits, bits | _SIGN)


def _as_floats(keys: NDArray[np.uint64]) -> Floats:
    return np.where(keys & _SIGN, keys ^ _SIGN, ~keys).view(np.float64)
