"""A measured link drawn: delays and losses over time, outages by length, the delay's distribution."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from agv_analysis.link.large_arrays import is_all_nan, parts, sizes_and_counts, taken
from agv_analysis.link.link_figures import LinkFigures
from agv_analysis.link.measurement import LOST as LOST_PACKET
from agv_analysis.output_file import save_figure
from agv_analysis.run import Floats
from agv_ros.errors import UserError

_MOST_POINTS = 20_000


def draw_link(path: Path, found: LinkFigures) -> None:
    """Draw to a file. Raises UserError if that fails."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogFormatter

    from agv_analysis.report.matplotlib_figures import COLOURS
    from agv_analysis.report.panels import DRIVEN, LOST, OTHER

    measured, whole = found.measured, found.whole
    figure = Figure(figsize=(11.0, 7.0), layout="constrained")
    grid = figure.add_gridspec(2, 2)
    course, outages, delays = (figure.add_subplot(place) for place in (grid[0, :], grid[1, 0], grid[1, 1]))
    packets = measured.whole
    shown = np.arange(0, measured.packets, max(1, measured.packets // _MOST_POINTS))
    if packets.delay is not None:
        times, shown_delays = taken(measured.sent, shown), taken(packets.delay, shown)
        course.plot(times, 1e3 * shown_delays, ".", ms=1.5, color=COLOURS[DRIVEN])
    outcome = packets.outcome
    lost = np.concatenate(
        [part.start + np.flatnonzero(outcome[part] == LOST_PACKET) for part in parts(len(outcome), outcome)]
    )
    marks = taken(measured.sent, lost[:: max(1, len(lost) // _MOST_POINTS)])
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
        outages.xaxis.set_major_formatter(LogFormatter())
        outages.xaxis.set_minor_formatter(LogFormatter())  # 20, as powers of ten would not fit beside each other
    outages.set(xlabel="length [ms]", ylabel="outages at least as long", title="Outages")
    for direction in found.directions.values():
        values = getattr(measured, direction.name).delay
        if values is not None and not is_all_nan(values):
            delays.plot(*_beyond(values), label=direction.name.replace("_", " "))
    if delays.lines:
        delays.set(yscale="log")
        delays.legend(loc="upper right", fontsize="small")
    delays.set(xlabel="delay [ms]", ylabel="share of packets at least as late", title="Delay")
    try:
        save_figure(figure, path, dpi=130)
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be drawn to: {error}") from None


def _beyond(delay: Floats) -> tuple[Floats, Floats]:
    """Delays [ms], increasing, and the share of the packets that came at least as late; NaN is left out."""

    def known() -> Iterator[Floats]:
        for part in parts(len(delay), delay):
            yield np.maximum(delay[part][~np.isnan(delay[part])], 0.0)

    sizes, counts = sizes_and_counts(known)
    upto = np.cumsum(counts)
    return 1e3 * sizes, 1.0 - (upto - counts) / upto[-1]
