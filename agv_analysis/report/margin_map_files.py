"""A map of margins as files: CSV and picture."""

from __future__ import annotations

import csv
from pathlib import Path

from agv_analysis.corridor.corridor_map import TITLES
from agv_analysis.output_file import output_file, save_figure
from agv_analysis.report.map_page import axis_in_words
from agv_analysis.scenario import Scenario
from agv_analysis.stability.margin_map import MarginMap, map_columns
from agv_ros.errors import UserError


def write_csv(path: Path, found: MarginMap) -> None:
    """One row a point: the two axes and the margins. Raises UserError if the file cannot be written."""
    try:
        with output_file(path).open("w", encoding="utf-8", newline="") as file:
            rows = csv.writer(file, lineterminator="\n")
            rows.writerow([*found.axes, *found.margins])
            for i, x in enumerate(found.first.tolist()):
                for j, y in enumerate(found.second.tolist()):
                    rows.writerow([x, y, *(n[i, j].item() for n in found.margins.values())])
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None


def draw(path: Path, found: MarginMap, scenario: Scenario) -> None:
    """A panel for each margin, its axes in words. Raises UserError if the file cannot be written."""
    from matplotlib.colors import Normalize, SymLogNorm
    from matplotlib.figure import Figure

    titles = {**{column.name: column.title for column in map_columns()}, **TITLES}
    up, across = (axis_in_words(scenario, axis) for axis in found.axes)
    figure = Figure(figsize=(5.0 * len(found.margins), 4.2), layout="constrained")
    for axes, (name, n) in zip(
        figure.subplots(1, len(found.margins), squeeze=False)[0], found.margins.items(), strict=True
    ):
        is_share = n.dtype.kind == "f"
        norm = Normalize(0.0, 1.0) if is_share else SymLogNorm(1.0, vmin=-1.0, vmax=max(10.0, float(n.max())))
        mesh = axes.pcolormesh(found.second, found.first, n, norm=norm)
        axes.set(xlabel=across, ylabel=up, title=titles[name])
        for values, scale in ((found.second, axes.set_xscale), (found.first, axes.set_yscale)):
            scale("log" if values.min() > 0.0 and values.max() >= 10.0 * values.min() else "linear")
        figure.colorbar(mesh, ax=axes, label="" if is_share else "slots")
    try:
        save_figure(figure, path, dpi=150)
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be drawn: {error}") from None
