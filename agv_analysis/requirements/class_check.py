"""Classes of radio service against a link and a loop: is it met, and would it do?"""

from __future__ import annotations

import math
from collections.abc import Iterable

from agv_analysis.link.channel_fit import Estimate
from agv_analysis.metrics.duration_text import duration_text
from agv_analysis.requirements.availability import packets_for
from agv_analysis.requirements.link_availability import LinkAvailability
from agv_analysis.requirements.loop_requirements import LoopRequirements
from agv_analysis.requirements.service_classes import ServiceClass

YES, NO, CANNOT_TELL = "yes", "no", "cannot tell"

Answer = tuple[str, str]
"""YES, NO or CANNOT_TELL, and why."""


def meets(wanted: ServiceClass, link: LinkAvailability | None) -> Answer:
    """Does a link give what a class asks, where a failure is an outage that the loop does not survive?

    Figures of the class that are not asked of a link's losses and delays (data rates, sizes) are left out.
    """
    if link is None:
        return CANNOT_TELL, "the link has no figures"
    answers = []
    if wanted.availability is not None:
        answers.append(_at_most("unavailability", link.unavailability, 1.0 - wanted.availability, link))
    if wanted.mtbf_s is not None:
        answers.append(_at_least(link.mtbf, wanted.mtbf_s, link))
    if wanted.largest_loss is not None:
        answers.append(_at_most("loss rate", link.loss_rate, wanted.largest_loss, link))
    if wanted.latency_s is not None:
        answers.append(_latency(link.latency, wanted.latency_s))
    return _all(answers)


def would_do(offered: ServiceClass, loop: LoopRequirements) -> Answer:
    """Would a service of this class be enough for a loop, but for the failures that the class itself allows?"""
    if loop.infeasible:
        return NO, "the loop does not settle even without losses"
    answers: list[Answer] = []
    if offered.latency_s is not None:
        limit = loop.latency
        fine = limit is None or offered.latency_s <= limit
        answers.append((YES if fine else NO, f"latency {_ms(offered.latency_s)} against {_bound(limit)}"))
    if offered.survival_time_s is not None:
        limit = loop.survival_time
        fine = limit is None or offered.survival_time_s <= limit
        answers.append((YES if fine else NO, f"outages up to {_ms(offered.survival_time_s)} against {_bound(limit)}"))
    elif offered.largest_loss is not None:
        rate = loop.loss_rate
        fine = rate is None or offered.largest_loss < rate
        said = f"losses {offered.largest_loss:.4g} against {'no bound' if rate is None else format(rate, '.4g')}"
        answers.append((YES if fine else NO, f"{said}, if they are independent"))
    else:
        answers.append((CANNOT_TELL, "the class does not say how long outages may last"))
    return _all(answers)


def _all(answers: Iterable[Answer]) -> Answer:
    """No if one is, cannot tell if one cannot, else yes; with the reasons for it."""
    found = list(answers)
    if not found:
        return CANNOT_TELL, "the class has no figure that could be compared"
    for word in (NO, CANNOT_TELL):
        reasons = [why for answer, why in found if answer == word]
        if reasons:
            return word, "; ".join(reasons)
    return YES, "; ".join(why for _, why in found)


def _at_most(name: str, seen: Estimate, limit: float, link: LinkAvailability) -> Answer:
    said = f"{name} {seen.value:.4g}" + (f" ({seen.low:.4g} to {seen.high:.4g})" if seen.low < seen.high else "")
    said += f", at most {limit:.4g}"
    if seen.high <= limit * (1.0 + 1e-9):
        return YES, said
    if seen.low > limit:
        return NO, said
    return CANNOT_TELL, said + ("" if seen.value else _how_much_longer(link, limit))


def _at_least(seen: Estimate, limit: float, link: LinkAvailability) -> Answer:
    said = f"mean time between failures {duration_text(seen.value)}" if math.isfinite(seen.value) else "no failure"
    upto = duration_text(seen.high) if math.isfinite(seen.high) else "no end"
    said += f" ({duration_text(seen.low)} to {upto})" if seen.low < seen.high else ""
    said += f", at least {duration_text(limit)}"
    if seen.low >= limit or seen.high < limit:
        return (YES if seen.low >= limit else NO), said
    # A share h of the packets that fail makes a mean time of interval (1 - h) / h between failures.
    more = "" if link.interval is None else _how_much_longer(link, link.interval / (limit + link.interval))
    return CANNOT_TELL, said + ("" if math.isfinite(seen.value) else more)


def _how_much_longer(link: LinkAvailability, share: float) -> str:
    """How many packets without a failure show that no larger share of them fails."""
    if link.packets is None or not share > 0.0:
        return ""
    needed = packets_for(1.0 - share)
    time = "" if link.interval is None else f", {_duration((needed - link.packets) * link.interval)} more"
    return f": to show it takes {_grouped(needed)} clean packets at 95 %, and there are {_grouped(link.packets)}{time}"


def _grouped(count: int) -> str:
    return f"{count:,}".replace(",", " ")


def _duration(seconds: float) -> str:
    for unit, length in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * length:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds:.3g} s"


def _latency(seen: float | None, limit: float) -> Answer:
    if seen is None:
        return CANNOT_TELL, "the link's delay is not known"
    return (YES if seen <= limit else NO), f"latency {_ms(seen)}, at most {_ms(limit)}"


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.4g} ms"


def _bound(limit: float | None) -> str:
    return "no bound" if limit is None else _ms(limit)
