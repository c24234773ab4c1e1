"""A map of margins as files: CSV and picture."""

from __future__ import annotations

import csv
from pathlib import Path

from agv_analysis.stability.margin_map import MarginMap, map_columns
from agv_ros.errors import UserError


def write_csv(path: Path, found: MarginMap) -> None:
    """One row a point: the two axes and the margins. Raises UserError if the file cannot be written."""
    try:
        with path.open("w", encoding="utf-8", newline="") as file:
            rows = csv.writer(file, lineterminator="\n")
            rows.writerow([*found.axes, *found.margins])
            for i, x in enumerate(found.first.tolist()):
                for j, y in enumerate(found.second.tolist()):
                    rows.writerow([x, y, *(int(n[i, j]) for n in found.margins.values())])
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None


def draw(path: Path, found: MarginMap) -> None:
    """A panel for each margin. Raises UserError if the file cannot be written or its kind is unknown."""
    from matplotlib.colors import SymLogNorm
    from matplotlib.figure import Figure

    columns = map_columns()
    figure = Figure(figsize=(5.0 * len(columns), 4.2), layout="constrained")
    for axes, column in zip(figure.subplots(1, len(columns), squeeze=False)[0], columns, strict=True):
        n = found.margins[column.name]
        mesh = axes.pcolormesh(
            found.second, found.first, n, norm=SymLogNorm(1.0, vmin=-1.0, vmax=max(10.0, float(n.max())))
        )
        axes.set(xlabel=found.labels[1], ylabel=found.labels[0], title=column.title)
        for values, scale in ((found.second, axes.set_xscale), (found.first, axes.set_yscale)):
            scale("log" if values.min() > 0.0 and values.max() >= 10.0 * values.min() else "linear")
        figure.colorbar(mesh, ax=axes)
    try:
        figure.savefig(path, dpi=150)
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be drawn: {error}") from None
