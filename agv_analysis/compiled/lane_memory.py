"""Tuples in rows of numbers, one lane a column: how a function that is compiled over lanes reads and writes its state.

Rows are an array of float64, shape (n, LANES): each number of a nested tuple, in the order of its fields, has a row of
its own, so that the same number of neighbouring lanes lies side by side, as vector instructions want it. Whole numbers
and truth values are stored as integers of 64 bits in the same place. `None` and empty tuples take no row.

Imported where numba is installed, by `compiled`; `lane_rows` has the same for Python.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from numba.core.cgutils import ir  # llvmlite's, which numba brings
from numba.core.types import Boolean, none, void
from numba.core.types.containers import BaseTuple
from numba.extending import intrinsic

from agv_analysis.compiled.lane_rows import LANES

_WORD = ir.IntType(64)


def _places(builder: Any, rows: Any, first: Any, lane: Any) -> Callable[[int, Any], Any]:
    """Where numbers are, from row `first` on; LANES is a constant, so that LLVM knows that rows do not overlap."""
    begin = builder.gep(rows.data, [builder.mul(first, ir.Constant(_WORD, LANES))])

    def place(row: int, kind: Any) -> Any:
        at = builder.gep(begin, [builder.add(ir.Constant(_WORD, row * LANES), lane)])
        return builder.bitcast(at, kind.as_pointer())

    return place


@intrinsic
def load_lane(_: Any, rows: Any, first: Any, lane: Any, like: Any) -> Any:
    """Of rows: a tuple of the type of `like` from the rows first, first + 1, ... of a lane."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        place = _places(builder, array, arguments[1], arguments[2])
        count = iter(range(1 << 30))

        def built(kind: Any) -> Any:
            if isinstance(kind, BaseTuple):
                return context.make_tuple(builder, kind, [built(each) for each in kind.types])
            if kind == none:
                return context.get_dummy_value()
            is_flag = isinstance(kind, Boolean)
            stored = _WORD if is_flag else context.get_data_type(kind)
            value = builder.load(place(next(count), stored))
            return builder.icmp_unsigned("!=", value, ir.Constant(_WORD, 0)) if is_flag else value

        return built(signature.return_type)

    return like(rows, first, lane, like), code


@intrinsic
def store_lane(_: Any, rows: Any, first: Any, lane: Any, value: Any, zero: Any) -> Any:
    """The numbers of a tuple into the rows first, first + 1, ... of a lane.

    `zero`, which LLVM does not know to be 0, is exclusively or'ed to all. Else LLVM would see where a number is stored
    as it was loaded, and leave this store out in some lanes, by masked stores, which are many times slower.
    """

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        place = _places(builder, array, arguments[1], arguments[2])
        for row, (kind, number) in enumerate(_numbers(builder, signature.args[3], arguments[3])):
            is_flag = isinstance(kind, Boolean)
            word = builder.zext(number, _WORD) if is_flag else builder.bitcast(number, _WORD)
            builder.store(builder.xor(word, arguments[4]), place(row, _WORD))
        return context.get_dummy_value()

    return void(rows, first, lane, value, zero), code


def _numbers(builder: Any, kind: Any, value: Any) -> Iterator[tuple[Any, Any]]:
    """The numbers of a nested tuple, each with its type."""
    if isinstance(kind, BaseTuple):
        for place, each in enumerate(kind.types):
            yield from _numbers(builder, each, builder.extract_value(value, place))
    elif kind != none:
        yield kind, value
