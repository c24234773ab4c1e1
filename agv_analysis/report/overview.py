"""A first picture of a run: track, error, speed and age of the pose on one sheet."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from agv_analysis.output_file import save_figure
from agv_analysis.report.matplotlib_figures import draw_panel
from agv_analysis.report.panels import age, distance, speed, track
from agv_analysis.run import Run
from agv_ros.errors import UserError

_ABOVE_LEGEND = 24.0
"""From axes to their title, with two rows of a legend between [points]."""


def draw(run: Run, path: Path) -> None:
    """Draw a run to a PNG, SVG or PDF file. Raises UserError if the file cannot be written."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 7.0), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(1.0, 1.4))
    from_above, *over_time = (figure.add_subplot(cell) for cell in (grid[:, 0], grid[0, 1], grid[1, 1], grid[2, 1]))
    draw_panel(from_above, track(run))
    from_above.lines[0].set(linewidth=3.0, alpha=0.5)
    from_above.plot(*run.pose[0, :2], "ko", ms=4.0)  # where the AGV starts
    for axes, panel in zip(over_time, (distance(run), replace(speed(run), y_range=None), age(run)), strict=True):
        axes.sharex(over_time[-1])
        draw_panel(axes, panel)
    for axes in over_time[:-1]:
        axes.tick_params(labelbottom=False)
        axes.set_xlabel("")
    of_speed = over_time[1]
    of_speed.set_yscale("symlog", linthresh=2.0 * max(0.5, float(np.abs(run.reference[:, 3]).max())))
    for axes, title in ((from_above, "Track"), (over_time[0], "Error, speed, age of the pose")):
        axes.set_title(title, pad=_ABOVE_LEGEND)
    try:
        save_figure(figure, path, dpi=130)
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be drawn to: {error}") from None
