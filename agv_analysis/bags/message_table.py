"""Messages of one topic -> one structured array that grows as they come."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags.bag_errors import PaddingError, UndecodableError
from agv_analysis.bags.checks import check_times
from agv_analysis.bags.compiled_decoder import MAX_LAYOUTS, Run, compiled_place, recipes
from agv_analysis.bags.layout import LOG_TIME, PUBLISH_TIME, Index, Layout, Leaf, length_path
from agv_analysis.bags.message_batch import Batch, Bytes, Group, Ints, Layouts, values_at
from agv_analysis.bags.prefault import Prefault
from agv_analysis.bags.schema import PLACEHOLDER, STRING, Struct, is_wstring
from agv_ros.counted import counted

_MISFITS_BELIEVED = 100
"""After this many messages, none of which is of its type, the definition is not theirs."""

_PADDING_FREE = 64 * 2**20
_PADDING_FACTOR = 16
"""A table may take this many bytes, or this many times the bytes of its messages: since every row is as wide as the
longest string or sequence, one long message among many short ones could otherwise ask for any amount of memory."""

_UTF8_BYTES = {"u2": 3, "u4": 4}
"""Most bytes that a character of a wstring takes in UTF-8, by its own form."""

_MAX_ROOM = 2**30
"""Most bytes that are set aside for messages which are merely expected."""


def most_bytes(message_bytes: int) -> int:
    """How many bytes an array may take of messages of so many."""
    return max(_PADDING_FREE, _PADDING_FACTOR * message_bytes)


def longest_in_proportion(sizes: Mapping[int, int]) -> int | None:
    """The longest size [B] up to which messages fit into an array, if no more than one in a hundred is longer.

    `sizes`: how many messages there are of each size. A row is taken for as wide as twice its message.
    """
    longer, kept, kept_bytes = sum(sizes.values()), 0, 0
    total, found = longer, None
    for size in sorted(sizes):
        kept, kept_bytes, longer = kept + sizes[size], kept_bytes + size * sizes[size], longer - sizes[size]
        if kept * 2 * size <= most_bytes(kept_bytes) and 0 < longer <= max(1, total // 100):
            found = size
    return found


def refuse_padding(needed: int, message_bytes: int, rows: int) -> None:
    """Raise PaddingError if an array would take `needed` bytes, out of all proportion to its messages."""
    if needed > most_bytes(message_bytes):
        raise PaddingError(
            f"its strings or sequences differ so much in length that {counted(rows, 'message')} would take "
            f"{needed / 2**20:.0f} MiB as an array"
        )


@dataclass
class _Column:
    """What is known of a column so far."""

    code: str
    """numpy's code in this machine's byte order; S for strings."""
    dims: list[int]
    """Shape of a row's values; grows with the longest sequence."""
    width: int = 1
    """Bytes of a string; grows with the longest."""

    @property
    def format(self) -> Any:
        """As numpy.dtype wants it."""
        code = f"S{self.width}" if self.code == "S" else self.code
        return (code, tuple(self.dims)) if self.dims else code

    def fit(self, leaf: Leaf) -> None:
        """Make room for the values of a leaf."""
        if leaf.is_text:
            self.width = max(self.width, _UTF8_BYTES[leaf.code[1:]] * (leaf.block or 0))
        elif self.code == "S":
            self.width = max(self.width, int(leaf.code[1:]))
        inner = () if leaf.block is None or leaf.is_text else (leaf.block - 1,)
        self.fit_places([(*index, *inner) for index in leaf.indices])

    def fit_places(self, places: list[Index]) -> None:
        """Make room for values at `places`."""
        if self.dims:
            self.dims = [max(n, 1 + i) for n, i in zip(self.dims, np.max(places, axis=0).tolist(), strict=True)]


def _columns(kind: Struct, prefix: str = "", dims: tuple[int, ...] = ()) -> Iterator[tuple[str, _Column]]:
    """Columns of a type in the order of its members; no sequence has any elements yet."""
    for member in kind.members:
        path, inner = prefix + member.path, dims
        if member.is_sequence:
            yield length_path(path), _Column("u4", list(dims))
            inner = (*dims, 0)
        elif member.length is not None:
            inner = (*dims, member.length)
        if isinstance(member.element, Struct):
            yield from _columns(member.element, f"{path}.", inner)
        elif not path.endswith(PLACEHOLDER):
            is_text = member.element == STRING or is_wstring(member.element)
            yield path, _Column("S" if is_text else member.element, list(inner))


class Table:
    """Columns of a topic: `log_time_ns`, `publish_time_ns`, and one for each value of its type."""

    def __init__(
        self, kind: Struct, expected: int = 0, helper: Executor | None = None, longest: int | None = None
    ) -> None:
        """`expected`: messages to make room for; more may come. `longest`: bytes of the longest message that is taken.

        `helper` prepares memory; it is given where there are enough messages for this, and compiled code, to pay off.
        """
        self._columns = {LOG_TIME: _Column("i8", []), PUBLISH_TIME: _Column("i8", []), **dict(_columns(kind))}
        self._ragged = kind.has_sequences
        self._expected = expected
        self._fitted: set[int] = set()
        self._plans: dict[int, tuple[list[Run], list[Leaf]]] = {}
        self._dtype = self._make_dtype()
        self._store = np.empty(0, np.uint8)
        self._helper = helper
        self._prefault = Prefault(self._store, helper)
        self._capacity = 0
        self._count = 0
        self._message_bytes = 0
        self.layouts = Layouts(kind)
        self._longest = longest
        self.overlong = 0
        """Messages that were left out because they are longer than that."""
        self._place = compiled_place() if helper is not None and not self._ragged else None
        self._recipes = recipes([])
        self._known_layouts: dict[tuple[int, int], tuple[int, Layout]] = {}
        self._clock = np.array([-1, 0], np.int64)

    @property
    def rows(self) -> NDArray[np.void]:
        """The messages so far, one row each."""
        size = self._dtype.itemsize
        return self._store[: self._count * size].view(self._dtype)

    @property
    def misfits(self) -> int:
        """Messages that are not of the topic's type."""
        return self.layouts.misfits

    @property
    def first_misfit(self) -> str:
        """Why the first of them is not."""
        return self.layouts.first_misfit

    @property
    def is_orderly(self) -> bool:
        """Have the times of all messages been looked at as they came, and has `check_times` nothing to report?"""
        return self._place is not None and not self._clock[1]

    def append(self, batch: Batch) -> None:
        """Take a batch, except for those messages that are not of the table's type.

        Raises UndecodableError if none of the topic's messages is of its type, or if the array would grow out of all
        proportion to its messages.
        """
        if self._longest is not None:
            short = batch.sizes <= self._longest
            self.overlong += len(batch) - int(np.count_nonzero(short))
            batch = Batch(batch.buffer, batch.starts[short], batch.sizes[short])
        self._message_bytes += batch.total
        done = 0
        while self._place is not None and done < len(batch):
            rest = batch.after(done) if done else batch
            self._make_room(len(rest))
            placed = self._place(
                rest.buffer, rest.starts, rest.sizes, *self._recipes,
                self._store, self._dtype.itemsize, self._count, self._clock,
            )  # fmt: skip
            self._count += placed
            done += placed
            if done < len(batch):  # one of a layout that is not known yet
                self._append(batch.after(done, 1))
                done += 1
        if done < len(batch):
            self._append(batch.after(done))

    def _append(self, batch: Batch) -> None:
        """Take a batch, layout by layout."""
        groups = self.layouts.split(batch)
        for group in groups:
            self._widen(group.layout)
        first, number = self._count, sum(len(group.places) for group in groups)
        if first + number == 0 and self.layouts.misfits >= _MISFITS_BELIEVED:
            raise UndecodableError(f"its messages are not of its type: {self.layouts.first_misfit}")
        self._make_room(number)
        self._count += number
        new = self.rows[first:]
        if self._ragged:
            new[:] = self._blank()
        if len(groups) == 1:
            self._write(groups[0], new, slice(None))
        else:
            ranks = _ranks([group.places for group in groups], len(batch))
            for group in groups:
                self._write(group, new, ranks[group.places])
        if self._place is not None and number:
            self._learn(groups)
            self._look(new)

    def _learn(self, groups: list[Group]) -> None:
        """Teach the compiled decoder the layouts of these groups; without success if it cannot copy them all."""
        for group in groups:
            size = group.messages.shape[1]
            self._known_layouts[size, id(group.layout)] = (size, group.layout)
        plans = [self._plan(layout) for _, layout in self._known_layouts.values()]
        if any(leaves for _, leaves in plans) or len(plans) > MAX_LAYOUTS:
            self._place = None
            return
        known = zip(self._known_layouts.values(), plans, strict=True)
        self._recipes = recipes([(size, layout, runs) for (size, layout), (runs, _) in known])

    def _look(self, new: NDArray[np.void]) -> None:
        """Check the times of rows that the compiled decoder has not copied."""
        if new[LOG_TIME][0] <= self._clock[0] or check_times("", new).texts():
            self._clock[1] += 1
        self._clock[0] = new[LOG_TIME][-1]

    # -- storage -----------------------------------------------------------------------------------------------------

    def _make_dtype(self) -> np.dtype[np.void]:
        formats = [column.format for column in self._columns.values()]
        return np.dtype({"names": list(self._columns), "formats": formats}, align=True)

    def _widen(self, layout: Layout) -> None:
        """Make the columns wide enough for a layout."""
        if id(layout) in self._fitted:
            return
        self._fitted.add(id(layout))
        for leaf in layout.leaves:
            if leaf.path in self._columns:
                self._columns[leaf.path].fit(leaf)
        for path, counts in layout.counts.items():
            self._columns[length_path(path)].fit_places(list(counts))
        dtype = self._make_dtype()
        if dtype != self._dtype:
            self._move(dtype, self._count, self._capacity)
            self._plans.clear()

    def _make_room(self, number: int) -> None:
        """Make room for `number` more rows."""
        if self._count + number > self._capacity:
            self._move(self._dtype, self._count + number, max(2 * self._capacity, self._expected))
        self._prefault.reach((self._count + number) * self._dtype.itemsize)

    def _move(self, dtype: np.dtype[np.void], rows: int, room: int) -> None:
        """Move the rows to a new store for `rows` rows, or for `room` if that is more and not too much."""
        refuse_padding(rows * dtype.itemsize, self._message_bytes, rows)
        old = self.rows
        self._capacity = max(rows, min(room, _MAX_ROOM // dtype.itemsize))
        self._store = np.zeros(self._capacity * dtype.itemsize, np.uint8)  # what pads a row is zero, too
        self._prefault = Prefault(self._store, self._helper)
        self._dtype = dtype
        new = self.rows
        if old.dtype == dtype:
            new[:] = old
            return
        new[:] = self._blank()
        for name in old.dtype.names or ():
            place = (slice(None), *(slice(0, n) for n in old.dtype[name].shape))
            new[name][place] = old[name]

    def _blank(self) -> NDArray[np.void]:
        """A row without any value: NaN, zero, empty."""
        blank = np.zeros((), self._dtype)
        for name in self._dtype.names or ():
            if self._dtype[name].base.kind == "f":
                blank[name] = np.nan
        return blank

    # -- values ------------------------------------------------------------------------------------------------------

    def _plan(self, layout: Layout) -> tuple[list[Run], list[Leaf]]:
        """How to copy messages of a layout: what can be copied as runs of bytes, and the leaves that cannot."""
        runs: list[Run] = []
        others: list[Leaf] = []
        for leaf in layout.leaves:
            run = self._run(leaf)
            if run is None:
                if leaf.path in self._columns:
                    others.append(leaf)
            elif runs and runs[-1].is_before(run):
                runs[-1] = Run(runs[-1].source, runs[-1].target, run.source + run.size - runs[-1].source)
            else:
                runs.append(run)
        return runs, others

    def _run(self, leaf: Leaf) -> Run | None:
        """A leaf as bytes, None if its values are in another form than in the table."""
        column = self._dtype.fields.get(leaf.path) if self._dtype.fields else None
        if column is None or leaf.indices != [()] or leaf.is_text:
            return None
        kind, target, code = column[0], int(column[1]), np.dtype(leaf.code)
        if kind.kind == "S":  # what it does not fill is zero already
            return Run(leaf.offsets[0], target, code.itemsize)
        if kind.base != code or kind.shape != (() if leaf.block is None else (leaf.block,)):
            return None
        return Run(leaf.offsets[0], target, kind.itemsize)

    def _write(self, group: Group, new: NDArray[np.void], rows: slice | Ints) -> None:
        """Write the messages of a group to the rows `rows` of `new`."""
        if id(group.layout) not in self._plans:
            self._plans[id(group.layout)] = self._plan(group.layout)
        runs, leaves = self._plans[id(group.layout)]
        store, size = new.view(np.uint8), self._dtype.itemsize
        for source, target, length in runs:
            column = np.ndarray((len(new),), f"V{length}", store.data, target, (size,))
            column[rows] = values_at(group.messages, source, f"V{length}")
        for leaf in leaves:
            _write_leaf(new[leaf.path], rows, leaf, group.messages)
        for path, counts in group.layout.counts.items():
            lengths = new[length_path(path)]
            for index, count in counts.items():
                place = (rows, *index)
                lengths[place] = count


def _ranks(places: list[Ints], total: int) -> Ints:
    """Where each of `total` messages comes among those at `places`, which are the ones that are kept."""
    kept = np.zeros(total, np.int64)
    for some in places:
        kept[some] = 1
    return np.asarray(np.cumsum(kept) - 1)


def _write_leaf(column: NDArray[Any], rows: slice | Ints, leaf: Leaf, messages: Bytes) -> None:
    """Write the values of a leaf to the rows `rows` of a column."""
    block = () if leaf.block is None or leaf.is_text else (slice(0, leaf.block),)
    values = _values(messages, leaf)
    if leaf.is_text:
        values = _texts(values)
    if leaf.indices == [()]:
        place: tuple[Any, ...] = (rows, *block)
        column[place] = values[:, 0]
        return
    numbers = np.arange(len(column))[rows]
    place = (numbers[:, None], *np.array(leaf.indices).T[:, None, :], *block)
    column[place] = values


def _values(messages: Bytes, leaf: Leaf) -> NDArray[Any]:
    """All values of a leaf, shape (n, k) or, for blocks of b values, (n, k, b)."""
    n, size = messages.shape
    item = np.dtype(leaf.code).itemsize
    if leaf.block is None:
        windows: NDArray[Any] = np.ndarray((n, size - item + 1), leaf.code, messages.data, strides=(size, 1))
    else:
        shape = (n, size - item * leaf.block + 1, leaf.block)
        windows = np.ndarray(shape, leaf.code, messages.data, strides=(size, 1, item))
    return windows[:, leaf.offsets]


def _texts(characters: NDArray[Any]) -> NDArray[np.bytes_]:
    """Wide strings, shape (n, k, b), as UTF-8, shape (n, k).

    ROS's are UTF-16; what writes 4 bytes a character widens each half of a surrogate pair, or is true UTF-32.
    """
    n, k, length = characters.shape
    code = "<u2" if characters.max(initial=0) < 2**16 else "<u4"
    form = "utf-16-le" if code == "<u2" else "utf-32-le"
    rows = characters.reshape(-1, length).astype(code)
    texts = [row.tobytes().decode(form, "replace").encode() for row in rows]
    return np.array(texts, np.bytes_).reshape(n, k)
