"""Messages of one topic that are JSON -> one structured array, its columns the values by their dotted paths.

JSON says no types: a column is what all of its values are. Where some messages lack a number it is NaN, so that whole
numbers are floats there; a column whose values are of several kinds is text.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags.bag_errors import UndecodableError
from agv_analysis.bags.layout import LOG_TIME, PUBLISH_TIME, length_path
from agv_analysis.bags.message_batch import Batch
from agv_analysis.bags.message_table import refuse_padding

_MAX_COLUMNS = 4096
_MAX_DEPTH = 32
_EXACT = 2**53
"""Whole numbers up to here are exact as floats."""

_Index = tuple[int, ...]


@dataclass
class _Column:
    """Values of one path: (row, index, value)."""

    dims: int
    """How many lists are around each value."""
    values: list[tuple[int, _Index, Any]] = field(default_factory=list)

    def array(self, count: int, path: str) -> NDArray[Any]:
        """All values, shape (count, longest list, ...)."""
        shape = tuple(1 + max(i[d] for _, i, _ in self.values) for d in range(self.dims)) if self.values else ()
        kind, fill, values = _common([value for _, _, value in self.values], path)
        is_whole = len(self.values) == count * int(np.prod(shape, dtype=np.int64))
        if kind in ("i8", "u8") and not is_whole and not self.dims:
            if max(map(abs, values), default=0) > _EXACT:
                raise UndecodableError(f"{path} has numbers beyond 2^53 and is not in every message")
            kind, fill = "f8", np.nan
        refuse_padding(count * int(np.prod(shape, dtype=np.int64)) * np.dtype(kind).itemsize, 16 * len(values), count)
        array = np.full((count, *shape), fill, kind)
        places = [(row, *index) for row, index, _ in self.values]
        if places:
            array[tuple(np.array(places).T)] = values
        return array


def _common(values: list[Any], path: str) -> tuple[str, Any, list[Any]]:
    """numpy's code for values of all these kinds, what fills gaps, and the values as that."""
    kinds = {type(value) for value in values}
    if kinds <= {bool}:
        return "?", False, values
    if kinds <= {bool, int}:
        for code in ("i8", "u8"):
            limits = np.iinfo(code)
            if limits.min <= min(values) and max(values) <= limits.max:
                return code, 0, values
        raise UndecodableError(f"{path} has whole numbers of more than 64 bits")
    if kinds <= {bool, int, float}:
        if any(isinstance(value, int) and abs(value) > _EXACT for value in values):
            raise UndecodableError(f"{path} has fractions and whole numbers beyond 2^53")
        return "f8", np.nan, [float(value) for value in values]
    texts = [(value if isinstance(value, str) else json.dumps(value)).encode() for value in values]
    return f"S{max(1, max(map(len, texts)))}", b"", texts


class JsonTable:
    """Columns of a topic: `log_time_ns`, `publish_time_ns`, and one for each value that a message has."""

    def __init__(self) -> None:
        self._times: list[tuple[int, int]] = []
        self._columns: dict[str, _Column] = {}
        self._rows: NDArray[np.void] | None = None
        self.misfits = 0
        """Messages that are not JSON objects."""
        self.first_misfit = ""
        self._misfit_times: list[int] = []

    is_orderly = False
    """Times are looked at when all messages are there."""

    def append(self, batch: Batch) -> None:
        """Take a batch. Raises UndecodableError if its values cannot become columns."""
        self._rows = None
        times = zip(batch.log_times.tolist(), batch.publish_times.tolist(), strict=True)
        for time, payload in zip(times, batch.payloads(), strict=True):
            try:
                content = json.loads(payload)
                if not isinstance(content, dict):
                    raise ValueError(f"a {type(content).__name__} where an object is expected")
            except (ValueError, RecursionError) as error:
                self.misfits += 1
                self._misfit_times.append(time[0])
                self.first_misfit = self.first_misfit or f"no JSON object: {error}"
                continue
            self._add(content, "", (), 0)
            self._times.append(time)

    def _add(self, content: Any, path: str, index: _Index, depth: int) -> None:
        if depth > _MAX_DEPTH:
            raise UndecodableError(f"its messages are nested more than {_MAX_DEPTH} deep")
        if isinstance(content, dict):
            for key, value in content.items():
                self._add(value, f"{path}.{_name(key)}" if path else _name(key), index, depth + 1)
        elif isinstance(content, list):
            self._value(length_path(path), index, len(content))
            for i, value in enumerate(content):
                self._add(value, path, (*index, i), depth + 1)
        elif content is not None:
            self._value(path, index, content)

    def _value(self, path: str, index: _Index, value: Any) -> None:
        if path.startswith("len(") and len(index):
            path += "[]" * len(index)  # the lengths of lists in lists
        column = self._columns.setdefault(path, _Column(len(index)))
        if column.dims != len(index):
            raise UndecodableError(f"{path} is a list in some of its messages and not in others")
        if len(self._columns) > _MAX_COLUMNS:
            raise UndecodableError(f"its messages have more than {_MAX_COLUMNS} values by name")
        column.values.append((len(self._times), index, value))

    @property
    def strange_times(self) -> NDArray[np.int64]:
        """Log times [ns] of the messages, if none of them is an object, as with lists of numbers; else empty."""
        return np.array([] if self._times else self._misfit_times, np.int64)

    @property
    def rows(self) -> NDArray[np.void]:
        """The messages so far, one row each. Raises UndecodableError if their values cannot become columns."""
        if self._rows is None:
            count = len(self._times)
            times = np.array(self._times, np.int64).reshape(-1, 2)
            arrays: dict[str, NDArray[Any]] = {LOG_TIME: times[:, 0], PUBLISH_TIME: times[:, 1]}
            arrays |= {path: column.array(count, path) for path, column in self._columns.items()}
            formats = [(array.dtype, array.shape[1:]) for array in arrays.values()]
            rows = np.empty(count, np.dtype({"names": list(arrays), "formats": formats}, align=True))
            for path, array in arrays.items():
                rows[path] = array
            self._rows = rows
        return self._rows


def _name(key: str) -> str:
    """A key as part of a path, in quotes if it could be taken for something else."""
    return json.dumps(key) if not key or "." in key or key in (LOG_TIME, PUBLISH_TIME) else key
