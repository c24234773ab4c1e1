"""A studied channel as files: the distribution of its age as CSV, and a picture."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from agv_analysis.link.channel_study import ChannelStudy
from agv_analysis.output_file import output_file, save_figure
from agv_ros.errors import UserError

DRAWN = 1000
"""Slots that the picture shows one by one."""

COLUMNS = ("n_ul", "slots", "share", "closed_form")


def write_csv(path: Path, found: ChannelStudy) -> None:
    """Write the distribution of the age, a row an age; the last column is empty without a closed form.

    Raises UserError if the file cannot be written.
    """
    counts = np.bincount(found.age).tolist()
    expected = found.expected_age_shares
    closed = [""] * len(counts) if expected is None else expected.tolist()
    try:
        with open(output_file(path), "w", encoding="utf-8", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(COLUMNS)
            rows.writerows(zip(range(len(counts)), counts, found.age_shares.tolist(), closed, strict=True))
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None


def draw(path: Path, found: ChannelStudy) -> None:
    """Draw the age slot by slot, and its distribution beside the closed form. Raises UserError if that fails."""
    from matplotlib.figure import Figure

    from agv_analysis.report.matplotlib_figures import COLOURS
    from agv_analysis.report.panels import DRIVEN, LOST

    figure = Figure(figsize=(11.0, 4.0), layout="constrained")
    course, shares = figure.subplots(1, 2)
    course.step(np.arange(len(found.age))[:DRAWN], found.age[:DRAWN], where="post", color=COLOURS[LOST], lw=0.8)
    course.set(xlabel="slot k", ylabel="n_ul [slots]", title=f"{found.channel.model}: the first slots")
    measured, expected = found.age_shares, found.expected_age_shares
    occurred, colour = np.flatnonzero(measured), COLOURS[DRIVEN]
    shares.plot(occurred, measured[occurred], "o", color=colour, ms=3.0, label="these slots")
    if expected is not None:
        shares.plot(
            np.flatnonzero(expected > 0.0), expected[expected > 0.0], color="black", lw=0.8, label="closed form"
        )
    shares.set(yscale="log", xlabel="n_ul [slots]", ylabel="share of slots", title="Age of information")
    shares.legend(loc="best", fontsize="small")
    try:
        save_figure(figure, path, dpi=130)
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be drawn to: {error}") from None
