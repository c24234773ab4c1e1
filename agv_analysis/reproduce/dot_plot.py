"""The tables of the future work as figures: a line for each row, a dot for each value in it.

As wide as a column of a paper, SVG and PNG, with the whole table as CSV beside them.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from agv_analysis.output_file import not_linked_out, save_figure
from agv_analysis.reproduce.claim import Values
from agv_analysis.reproduce.figures import STYLE, WIDTH
from agv_analysis.reproduce.report import DIVERGED, Table, text_of
from agv_ros.errors import UserError

_WIDE = 100.0
"""Ratio of the largest to the smallest positive value from which on the axis is logarithmic."""

_MARKERS = "os^Dv*"


def write(table: Table, folder: Path) -> None:
    """Write a table to `folder` as SVG, PNG and CSV. Raises UserError if that cannot be written to."""
    import matplotlib as mpl
    from matplotlib.figure import Figure as Canvas

    with mpl.rc_context(STYLE):
        canvas = Canvas(figsize=(WIDTH, 0.8 + 0.15 * len(table.rows) + 0.15 * len(table.drawn)), layout="constrained")
        _draw(canvas.add_subplot(), table)
        canvas.legend(loc="outside upper left", frameon=False)
        try:
            save_figure(canvas, folder / f"{table.key}.svg")
            save_figure(canvas, folder / f"{table.key}.png", dpi=300)
            _write_csv(table.rows, folder / f"{table.key}.csv")
        except OSError as error:
            raise UserError(f"{folder / table.key}: cannot be written: {error.strerror}") from None


def _draw(axes: Any, table: Table) -> None:
    """`axes` is a matplotlib Axes. What did not happen has no dot, what diverges an open one at the right edge."""
    shown: list[float] = []
    for marker, column in zip(_MARKERS, table.drawn, strict=False):
        values = [(value, i) for i, row in enumerate(table.rows) if (value := _number(row[column])) is not None]
        shown += [value for value, _ in values]
        (dots,) = axes.plot([x for x, _ in values], [i for _, i in values], marker, label=column, ms=4.0, alpha=0.8)
        beyond = [i for i, row in enumerate(table.rows) if text_of(row[column]) == "diverges"]
        if beyond:
            axes.set_xlabel("open, at the right edge: diverges", loc="right")
            at_edge = {
                "transform": axes.get_yaxis_transform(),
                "clip_on": False,
                "mfc": "none",
                "mec": dots.get_color(),
            }
            axes.plot([1.0] * len(beyond), beyond, marker, ms=4.0, **at_edge)
    names = list(table.rows[0])[: table.named]
    axes.set_yticks(range(len(table.rows)), [", ".join(text_of(row[name]) for name in names) for row in table.rows])
    axes.set_ylabel(", ".join(names), labelpad=6.0)
    axes.invert_yaxis()
    axes.grid(axis="y", lw=0.3)
    _scale(axes, shown)
    if axes.get_xlabel() and axes.get_xscale() != "linear":  # room between the largest value and the edge
        axes.set_xlim(right=10.0 * axes.get_xlim()[1])


def _scale(axes: Any, shown: list[float]) -> None:
    """A logarithmic axis, with few ticks, where the values differ much in size; about 0 it is linear."""
    from matplotlib.ticker import LogLocator, NullLocator, SymmetricalLogLocator

    sizes = [abs(value) for value in shown if value != 0.0]
    if not sizes or max(sizes) <= _WIDE * min(sizes):
        return
    if min(shown) > 0.0:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(numticks=5))
    else:
        smallest = max(min(sizes), 1e-4 * min(max(sizes), 1.0))
        axes.set_xscale("symlog", linthresh=smallest)
        locator = SymmetricalLogLocator(base=10.0, linthresh=smallest)
        locator.set_params(numticks=4)
        axes.xaxis.set_major_locator(locator)
        axes.set_xlim(left=0.0 if min(shown) >= 0.0 else None)
        axes.set_xticks([tick for tick in axes.get_xticks() if tick == 0.0 or abs(tick) > 10.0 * smallest])
    axes.xaxis.set_minor_locator(NullLocator())


def _number(value: object) -> float | None:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < DIVERGED
    return float(value) if is_number else None  # type: ignore[arg-type]


def _write_csv(rows: Sequence[Values], path: Path) -> None:
    with open(not_linked_out(path), "w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
