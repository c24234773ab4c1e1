"""A first picture of a run: track, errors, speed, outages."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from agv_analysis.metrics.convergence import TOLERANCE
from agv_analysis.run import Floats, Run
from agv_ros.errors import UserError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SMALLEST = 1e-6
"""Errors [m] below this are drawn at it: a logarithm has no zero."""

REFERENCE, DRIVEN, LOST = "#7f7f7f", "#1f6fb4", "#d62728"


def draw(run: Run, path: Path) -> None:
    """Draw a run to a PNG, SVG or PDF file. Raises UserError if the file cannot be written."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 7.0), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(1.0, 1.4))
    _track(figure.add_subplot(grid[:, 0]), run)
    error = figure.add_subplot(grid[0, 1])
    speed = figure.add_subplot(grid[1, 1], sharex=error)
    age = figure.add_subplot(grid[2, 1], sharex=error)
    _error(error, run)
    _speed(speed, run)
    _age(age, run)
    for axes in (error, speed):
        axes.tick_params(labelbottom=False)
    try:
        figure.savefig(path, dpi=130)
    except (OSError, ValueError) as error_:
        raise UserError(f"{path}: cannot be drawn to: {error_}") from None


def _track(axes: Axes, run: Run) -> None:
    axes.plot(run.reference[:, 0], run.reference[:, 1], color=REFERENCE, lw=3.0, alpha=0.5, label="reference")
    x, y = within(run.pose[:, 0], run.reference[:, 0]), within(run.pose[:, 1], run.reference[:, 1])
    axes.plot(x, y, color=DRIVEN, lw=1.0, label="AGV")
    axes.plot(x[run.lost], y[run.lost], ".", color=LOST, ms=2.0, label="pose lost")
    axes.plot(x[0], y[0], "o", color=DRIVEN, ms=5.0)
    axes.set(xlabel="x [m]", ylabel="y [m]", title="Track")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(loc="best", fontsize="small")


def within(values: Floats, reference: Floats) -> Floats:
    """Values that lie within some laps of the reference; what is far away would shrink the track to a point."""
    reach = 2.0 * (np.ptp(reference) + 10.0)
    near = np.abs(values - np.mean(reference)) <= reach
    return np.where(near, values, np.nan)


def _error(axes: Axes, run: Run) -> None:
    e = run.reference[:, :2] - run.pose[:, :2]
    axes.plot(run.time, np.maximum(np.hypot(e[:, 0], e[:, 1]), SMALLEST), color=DRIVEN, lw=0.8, label="distance")
    axes.plot(run.time, np.maximum(np.abs(e[:, 1]), SMALLEST), color=REFERENCE, lw=0.6, label="|y_r - y_c|")
    axes.axhline(TOLERANCE, color="black", lw=0.7, ls="--")
    axes.set(yscale="log", ylabel="error [m]", title="Error (dashed: 1 cm), speed, outages")
    axes.legend(loc="upper right", fontsize="small")


def _speed(axes: Axes, run: Run) -> None:
    axes.plot(run.time, run.command[:, 0], color=DRIVEN, lw=0.8, label="v")
    axes.plot(run.time, run.reference[:, 3], color=REFERENCE, lw=1.2, label="v_r")
    v_max = run.scenario.controller.v_max
    if np.isfinite(v_max):
        for limit in (-v_max, v_max):
            axes.axhline(limit, color="black", lw=0.7, ls="--")
    axes.set_yscale("symlog", linthresh=2.0 * max(0.5, float(np.abs(run.reference[:, 3]).max())))
    axes.set(ylabel="speed [m/s]")
    axes.legend(loc="lower right", fontsize="small")


def _age(axes: Axes, run: Run) -> None:
    axes.step(run.time, run.n_ul, where="post", color=LOST, lw=0.6)
    axes.set(xlabel="time [s]", ylabel="n_ul [steps]", ylim=(0, max(1.0, 1.05 * float(run.n_ul.max()))))
