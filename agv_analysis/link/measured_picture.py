"""A measured link drawn: delays and losses over time, outages by length, the delay's distribution."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from agv_analysis.link.link_figures import LinkFigures
from agv_analysis.output_file import output_file
from agv_ros.errors import UserError

_MOST_POINTS = 20_000


def draw_link(path: Path, found: LinkFigures) -> None:
    """Draw to a file. Raises UserError if that fails."""
    from matplotlib.figure import Figure

    from agv_analysis.report.matplotlib_figures import COLOURS
    from agv_analysis.report.panels import DRIVEN, LOST, OTHER

    measured, whole = found.measured, found.whole
    figure = Figure(figsize=(11.0, 7.0), layout="constrained")
    grid = figure.add_gridspec(2, 2)
    course, outages, delays = (figure.add_subplot(place) for place in (grid[0, :], grid[1, 0], grid[1, 1]))
    packets = measured.whole
    step = max(1, measured.packets // _MOST_POINTS)
    if packets.delay is not None:
        course.plot(measured.sent[::step], 1e3 * packets.delay[::step], ".", ms=1.5, color=COLOURS[DRIVEN])
    lost = measured.sent[packets.lost]
    marks = lost[:: max(1, len(lost) // _MOST_POINTS)]
    course.plot(
        marks, np.zeros(len(marks)), "|", color=COLOURS[LOST], ms=10.0, transform=course.get_xaxis_transform(),
        clip_on=False, label=f"lost ({len(lost)})",
    )  # fmt: skip
    for time in found.change_times:
        course.axvline(time, color=COLOURS[OTHER], lw=0.8)
    course.set(
        xlabel="time [s]", ylabel="delay [ms]", title=f"{Path(measured.source).name}: {whole.name.replace('_', ' ')}"
    )
    course.legend(loc="upper right", fontsize="small")
    if len(whole.outages):
        ordered = np.sort(whole.outages)[::-1]
        outages.step(1e3 * ordered, np.arange(1, len(ordered) + 1), where="post", color=COLOURS[LOST])
        outages.set(xscale="log", yscale="log", xlim=(5e2 * ordered[-1], 2e3 * ordered[0]))
    outages.set(xlabel="length [ms]", ylabel="outages at least as long", title="Outages")
    for direction in found.directions.values():
        values = getattr(measured, direction.name).delay
        if values is not None and not np.isnan(values).all():
            known = np.sort(values[~np.isnan(values)])
            beyond = 1.0 - np.arange(len(known)) / len(known)
            thin = np.unique(np.concatenate((np.arange(0, len(known), max(1, len(known) // 2000)), [len(known) - 1])))
            delays.plot(1e3 * known[thin], beyond[thin], label=direction.name.replace("_", " "))
    if delays.lines:
        delays.set(yscale="log")
        delays.legend(loc="upper right", fontsize="small")
    delays.set(xlabel="delay [ms]", ylabel="share of packets at least as late", title="Delay")
    try:
        figure.savefig(output_file(path), dpi=130)
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be drawn to: {error}") from None
