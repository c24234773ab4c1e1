"""What a loop asks, a link gives and classes say, in rows: for the terminal, and as tables for a document."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from agv_analysis.link.channel_fit import Estimate
from agv_analysis.requirements.class_check import Answer
from agv_analysis.requirements.link_availability import LinkAvailability
from agv_analysis.requirements.loop_requirements import LoopRequirements
from agv_analysis.requirements.offered_service import OnService
from agv_analysis.requirements.service_classes import ServiceClass
from agv_ros.counted import counted

Row = tuple[str, str]


def rows_of_loop(found: LoopRequirements) -> Iterator[Row]:
    """Name and value of each figure that a loop asks for."""
    reasons = found.reasons
    yield "Transfer interval", _ms(found.transfer_interval)
    if found.infeasible:
        yield "Everything else", f"nothing would do: {found.infeasible}"
        return
    ts, slots, corridor = found.transfer_interval, found.stable_slots, found.corridor
    stable = None if slots is None or slots < 0 else _slots(slots, ts)
    yield "Survival time, by stability", _said(stable, reasons, "survival_time_s")
    if corridor is not None:
        within = f"Survival time, within {corridor.half_width:g} m"
        yield within, _slots(corridor.any_sequence, ts)
        yield f"{within}, one outage alone", _slots(corridor.single, ts)
    latency = _ms(found.latency) if found.latency else None
    yield "Maximum latency, without losses", _said(latency, reasons, "latency_max_s")
    for delay, loss in found.delays:
        if delay > 0.0:
            yield f"Independent losses behind {_ms(delay)}", f"below {loss:.4g}"
    rate = f"below {found.loss_rate:.4g}" if found.loss_rate else None
    yield "Independent losses, without delay", _said(rate, reasons, "loss_rate_max")
    if found.mean_burst is not None:
        yield "Mean burst at the uplink's loss rate", _burst(found.mean_burst, found.transfer_interval)
    for loss, burst in found.bursts:
        yield f"Mean burst at a loss rate of {loss:g}", _burst(burst, found.transfer_interval)
    if found.mean_age is not None:
        yield "Mean age of the pose", f"below {_ms(found.mean_age)}"


def _slots(slots: int | None, ts: float) -> str:
    if slots is None:
        return "all that were tried"
    return "none: the AGV is outside without any" if slots < 0 else f"{_ms(slots * ts)} ({counted(slots, 'slot')})"


def _said(text: str | None, reasons: Mapping[str, str], name: str) -> str:
    reason = reasons.get(name, "")
    if text is None:
        return reason or "no answer"
    return f"{text}; {reason}" if reason else text


def _burst(burst: float | None, ts: float) -> str:
    if burst is None:
        return "none is short enough"
    return "any" if math.isinf(burst) else f"below {burst:.4g} slots ({_ms(burst * ts)})"


def rows_of_link(found: LinkAvailability) -> Iterator[Row]:
    """Name and value of each figure that a link gives."""
    yield "Availability", _share(found.availability)
    yield "Unavailability", _estimate(found.unavailability)
    yield "Mean time between failures", _estimate(found.mtbf, " s")
    yield "Loss rate", _estimate(found.loss_rate)
    if found.failures is not None and found.packets is not None:
        yield "Failures seen", f"{found.failures} in {counted(found.packets, 'packet')}"
    yield "Assumed", found.assumption


def _estimate(found: Estimate, unit: str = "") -> str:
    def text(value: float) -> str:
        return f"{value:.4g}{unit}" if math.isfinite(value) else "no end"

    if math.isinf(found.value) and math.isinf(found.low):
        return "no failure"
    interval = "" if found.low == found.high else f" ({text(found.low)} to {text(found.high)})"
    return ("none seen" if math.isinf(found.value) else text(found.value)) + interval


def _share(found: Estimate) -> str:
    """A share close to 1, with as many nines as it has, and three digits of what is missing."""

    def text(value: float) -> str:
        missing = 100.0 * (1.0 - value)
        digits = 2 - math.floor(math.log10(missing)) if missing > 0.0 else 0
        return f"{100.0 - missing:.{min(10, max(0, digits))}f} %"

    return text(found.value) + ("" if found.low == found.high else f" ({text(found.low)} to {text(found.high)})")


def rows_of_service(found: OnService) -> Iterator[Row]:
    """What the loop does on an offered service."""
    offered, channel = found.offered, found.channel
    yield "Outages while it is available", f"up to {_ms(offered.survival_time)} ({counted(found.slots, 'slot')})"
    if channel.failure is not None:
        yield (
            "A failure lasts, on average",
            f"{_ms(channel.failure)} longer" if math.isfinite(channel.failure) else "forever",
        )
    if (offered.availability, offered.mtbf, offered.loss_rate) != (None, None, None):
        yield "As a channel", channel.why
    yield "Does the loop hold?", f"{'yes' if found.holds else 'no'}: {found.why}"
    speed = found.speed_max
    yield "Largest speed, straight track", "no bound up to 50 m/s" if speed is None else f"{speed:.4g} m/s"
    period, best = found.interval_max, found.interval_best
    said = "none" if period is None else _ms(period)
    yield "Largest transfer interval", said if best is None else f"{said}; errors die out fastest at {_ms(best)}"
    if math.isfinite(found.deviation):
        yield "Corridor that it keeps in one outage", f"{found.deviation:.3g} m"
    if math.isfinite(found.deviation_any):
        yield "Corridor that it keeps in any that were tried", f"{found.deviation_any:.3g} m"
    if found.deviation_in_failure is not None and math.isfinite(found.deviation_in_failure):
        yield "How far it goes in a failure of mean length", f"{found.deviation_in_failure:.3g} m"
    if found.kx_max is not None and found.kx_best is not None:
        square = found.kx_best_mean_square
        often = "" if square is None else f", {square:.4g} 1/s in the mean square"
        yield "K_x", f"below {found.kx_max:.4g} 1/s; {found.kx_best:.4g} 1/s is best for such outages{often}"


def rows_of_classes(
    classes: Sequence[ServiceClass], enough: Mapping[str, Answer], met: Mapping[str, Answer]
) -> Iterator[tuple[str, str, str, str]]:
    """Name, source, would it do for the loop, does the link meet it."""
    for one in classes:
        yield one.name, one.source, ": ".join(enough[one.name]), ": ".join(met[one.name])


def markdown(sections: Mapping[str, Sequence[Sequence[str]]], heads: Mapping[str, Sequence[str]]) -> str:
    """Sections of rows as tables in Markdown, with the `heads` of those that have one."""
    text = ""
    for title, rows in sections.items():
        head = heads.get(title, ("",) * len(rows[0]))
        lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
        lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
        text += f"## {title}\n\n" + "\n".join(lines) + "\n\n"
    return text.rstrip("\n") + "\n"


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.4g} ms" if seconds < 10.0 else f"{seconds:.4g} s"
