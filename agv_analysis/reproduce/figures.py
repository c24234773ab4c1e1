"""The paper's figures: track and reference speed; tracks, y error and speed by K_x, unlimited and with |v| <= 6 m/s.

Each is one column of a paper wide, as SVG (letters drawn as paths, so no font is missing anywhere) and PNG, with what
is drawn as CSV beside it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agv_analysis.output_file import not_linked_out, save_figure
from agv_analysis.report.matplotlib_figures import legend_above
from agv_analysis.reproduce.runs import GAINS, LIMIT, Runs, gain
from agv_analysis.run import Floats, Run
from agv_ros.errors import UserError

WIDTH = 3.5
"""Width of a column of the paper's class, IEEEtran [in]."""

SHOWN = 400
"""Steps of the error and the speed that are drawn: all that happens happens in the first 2 s."""

STYLE: Any = {"font.size": 8.0, "svg.fonttype": "path", "svg.hashsalt": "agv_ncs"}
"""Of every figure: small letters, drawn as paths, and the same bytes for the same data."""

_WIDTHS = (2.6, 1.7, 0.8)
"""Of the lines [pt]: where curves lie on one another the lower ones are seen."""


@dataclass(frozen=True)
class Figure:
    """Curves over one another; `x` and `y` of each by its label, shapes (N,)."""

    name: str
    x_label: str
    y_label: str
    curves: dict[str, tuple[Floats, Floats]]
    is_map: bool = False
    """Are both axes of the same scale?"""
    linear_to: float = math.inf
    """Size beyond which the y axis is logarithmic."""
    where: str = ""
    """Which figure of the paper it is, and its caption, as in `Fig. 3a: tracks`; in the title of the files."""

    @property
    def file_name(self) -> str:
        """Name of its files without ending: `fig_3a_unlimited_tracks`."""
        number = self.where.partition(":")[0].removeprefix("Fig. ")
        return f"fig_{number}_{self.name}"


def figures(runs: Runs) -> Iterator[Figure]:
    """The figures of the paper, in its order."""
    reference = runs.run(*gain(GAINS[0])).reference
    curve = {"X_r": (reference[:, 0], reference[:, 1])}
    yield Figure("track", "x [m]", "y [m]", curve, is_map=True, where="Fig. 2a: AGV reference track")
    time = runs.run(*gain(GAINS[0])).time
    curve = {"v_r": (time, reference[:, 3])}
    yield Figure(
        "reference_speed",
        "time [s]",
        "reference velocity v_r [m/s]",
        curve,
        where="Fig. 2b: reference translational velocity",
    )
    for name, v_max, letters in (("unlimited", math.inf, "abc"), ("limited", LIMIT, "def")):
        tracks_of, error_of, speed_of = (f"Fig. 3{letter}: " for letter in letters)
        by_gain = {f"K_x = {kx:g} 1/s": runs.run(*gain(kx, v_max)) for kx in GAINS}
        tracks = {label: (run.pose[:, 0], run.pose[:, 1]) for label, run in by_gain.items()}
        yield Figure(f"{name}_tracks", "x [m]", "y [m]", tracks, is_map=True, where=f"{tracks_of}tracks, {name} speed")
        errors = _begin(by_gain, _y_error)
        of_error = f"{error_of}error in y, {name} speed"
        yield Figure(f"{name}_y_error", "time step k", "error in y, y_r - y_c [m]", errors, where=of_error)
        speeds = _begin(by_gain, lambda run: run.command[:, 0])
        linear_to = 10.0 if math.isinf(v_max) else math.inf
        of_speed = f"{speed_of}translational velocity, {name}"
        yield Figure(
            f"{name}_speed",
            "time step k",
            "translational velocity v [m/s]",
            speeds,
            linear_to=linear_to,
            where=of_speed,
        )


def _y_error(run: Run) -> Floats:
    return np.asarray(run.reference[:, 1] - run.pose[:, 1])


def _begin(by_gain: dict[str, Run], quantity: Callable[[Run], Floats]) -> dict[str, tuple[Floats, Floats]]:
    return {label: (run.k[:SHOWN].astype(np.float64), quantity(run)[:SHOWN]) for label, run in by_gain.items()}


def write(figure: Figure, folder: Path) -> None:
    """Write a figure to `folder` as SVG, PNG and CSV. Raises UserError if that cannot be written to."""
    import matplotlib as mpl
    from matplotlib.figure import Figure as Canvas

    with mpl.rc_context(STYLE):
        canvas = Canvas(figsize=(WIDTH, WIDTH if figure.is_map else 0.65 * WIDTH), layout="constrained")
        axes = canvas.add_subplot()
        for width, (label, (x, y)) in zip(_WIDTHS, figure.curves.items(), strict=False):
            axes.plot(x, y, label=label, lw=width)
        axes.set(xlabel=figure.x_label, ylabel=figure.y_label)
        if figure.is_map:
            axes.set_aspect("equal", adjustable="datalim")
        if math.isfinite(figure.linear_to):
            axes.set_yscale("symlog", linthresh=figure.linear_to)
        if len(figure.curves) > 1:
            legend_above(axes, columns=len(figure.curves), handlelength=1.2)
        try:
            save_figure(canvas, folder / f"{figure.file_name}.svg", figure.where)
            save_figure(canvas, folder / f"{figure.file_name}.png", figure.where, dpi=300)
            _write_csv(figure, folder / f"{figure.file_name}.csv")
        except OSError as error:
            raise UserError(f"{folder / figure.file_name}: cannot be written: {error.strerror}") from None


def _write_csv(figure: Figure, path: Path) -> None:
    """A pair of columns for each curve, in full precision."""
    names = [f"{label}: {axis}" for label in figure.curves for axis in (figure.x_label, figure.y_label)]
    columns = [values.tolist() for curve in figure.curves.values() for values in curve]
    with open(not_linked_out(path), "w", encoding="utf-8", newline="") as file:
        file.write(",".join(names) + "\n")
        file.writelines(",".join(map(repr, row)) + "\n" for row in zip(*columns, strict=True))
