"""Calling a function with dual numbers: rows in groups that take the same path through it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from agv_analysis.stability.derivatives.branches import TRIAL, Floats, Mask, Rows, Split, Tie, Trial
from agv_analysis.stability.derivatives.copies import substitute
from agv_analysis.stability.derivatives.dual import NUMBER, Dual, Inputs, Scalar, constant, value_of


class Piece(NamedTuple):
    """Results at some rows: value of shape (n, outputs), derivative of shape (n, outputs, inputs)."""

    rows: Rows
    value: Floats
    derivative: Floats


class Sweep:
    """Evaluation of a function at groups of rows."""

    def __init__(
        self, function: Callable[..., Any], arguments: tuple[Any, ...], arrays: dict[int, Floats], inputs: Inputs
    ) -> None:
        self.name = getattr(function, "__qualname__", repr(function))
        self.kinks: dict[str, list[Rows]] = {}
        self._function = substitute(function)
        self._arguments = arguments
        self._arrays = arrays
        self._inputs = inputs

    def evaluate(self, rows: Rows, forced: tuple[bool, ...] = ()) -> list[Piece]:
        """Results at these rows, in pieces; `forced` are the outcomes of the first ties."""
        pending, pieces = [rows], []
        while pending:
            group = pending.pop()
            try:
                pieces.append(self._call(group, forced))
            except Split as split:
                pending += [group[~split.mask], group[split.mask]]
            except Tie as tie:
                pieces.append(self._along_both(group, forced, tie))
        return pieces

    def _call(self, rows: Rows, forced: tuple[bool, ...]) -> Piece:
        trial = Trial(rows, forced)
        token = TRIAL.set(trial)
        try:
            with np.errstate(all="ignore"):
                result = self._function(*self._arguments_at(rows))
        finally:
            TRIAL.reset(token)
        for where, at in trial.kinks:
            self._record(where, at)
        return self._piece(rows, list(self._outputs(result, result)))

    def _along_both(self, rows: Rows, forced: tuple[bool, ...], tie: Tie) -> Piece:
        """Results at tied rows for the outcome that the comparison has; where the other differs, there is a kink."""
        chosen = assembled(self.evaluate(rows, (*forced, tie.outcome)), self.name)
        try:
            other = assembled(self.evaluate(rows, (*forced, not tie.outcome)), self.name)
        except Exception:  # the other branch may be meant never to be taken here
            self._record(tie.where, rows)
            return chosen
        self._record(tie.where, chosen.rows[~_agree(chosen, other)])
        return chosen

    def _record(self, where: str, rows: Rows) -> None:
        if len(rows):
            self.kinks.setdefault(where, []).append(rows)

    def _arguments_at(self, rows: Rows) -> tuple[Any, ...]:
        position = -1

        def rebuilt(argument: Any) -> Any:
            nonlocal position
            if isinstance(argument, tuple):
                elements = [rebuilt(element) for element in argument]
                return argument._make(elements) if hasattr(argument, "_make") else tuple(elements)
            position += 1
            return self._dual(position, rows) if position in self._arrays else substitute(argument)

        return tuple(rebuilt(argument) for argument in self._arguments)

    def _dual(self, position: int, rows: Rows) -> Dual:
        value = self._arrays[position][rows]
        if position not in self._inputs:
            return constant(value)
        return Dual(value, np.ones((1, len(rows))), (self._inputs.index(position),))

    def _outputs(self, result: Any, whole: Any) -> Iterator[Scalar]:
        if isinstance(result, (Dual, *NUMBER)):
            yield result
        elif isinstance(result, (tuple, list, np.ndarray)):
            for element in result.tolist() if isinstance(result, np.ndarray) else result:
                yield from self._outputs(element, whole)
        else:
            raise TypeError(f"{self.name} must return a number or a tuple of numbers, got {whole!r}")

    def _piece(self, rows: Rows, outputs: list[Scalar]) -> Piece:
        value = np.empty((len(rows), len(outputs)))
        derivative = np.zeros((len(rows), len(outputs), len(self._inputs)))
        for i, output in enumerate(outputs):
            value[:, i] = value_of(output)
            if isinstance(output, Dual):
                for row, j in zip(output.derivative, output.inputs, strict=True):
                    derivative[:, i, j] = row
        return Piece(rows, value, derivative)


def assembled(pieces: list[Piece], name: str) -> Piece:
    """Pieces as one, in the order of their rows."""
    if len(pieces) == 1:
        return pieces[0]
    counts = sorted({piece.value.shape[1] for piece in pieces})
    if len(counts) > 1:
        raise TypeError(f"{name} must return as many numbers at all rows, got {' and '.join(map(str, counts))}")
    rows = np.concatenate([piece.rows for piece in pieces])
    order = np.argsort(rows, kind="stable")
    rank = np.empty_like(rows)
    rank[order] = np.arange(len(rows))
    value = np.empty((len(rows), *pieces[0].value.shape[1:]))
    derivative = np.empty((len(rows), *pieces[0].derivative.shape[1:]))
    ends = np.cumsum([len(piece.rows) for piece in pieces])
    for piece, at in zip(pieces, np.split(rank, ends[:-1]), strict=True):
        value[at], derivative[at] = piece.value, piece.derivative
    return Piece(rows[order], value, derivative)


def _agree(one: Piece, other: Piece) -> Mask:
    """Where are value and derivatives the same but for round-off? Shape (n,)."""
    if one.value.shape != other.value.shape:
        return np.zeros(len(one.rows), dtype=np.bool_)
    value = np.isclose(one.value, other.value, 1e-9, 1e-12, equal_nan=True).all(axis=1)
    derivative = np.isclose(one.derivative, other.derivative, 1e-9, 1e-12, equal_nan=True).all(axis=(1, 2))
    return np.asarray(value & derivative)
