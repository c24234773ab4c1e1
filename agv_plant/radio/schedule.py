"""What changes in a channel while a run goes on: parameters that take other values, outages at given times.

    p=0.0; 20: p=0.1; 20: outage=0.3 every 5; 60: outage=0

Each entry holds from its time on [s since step 0], until another one says otherwise: a parameter that may change at run
time takes a value, or everything is lost for 0.3 s, once or again every 5 s. Times are rounded up to whole slots.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

from agv_plant.radio.delay import whole_slots
from agv_ros.parameters import Parameter, ParameterError

OUTAGE = "outage"
"""The word for a scripted outage, in a schedule and as the cause of a loss."""

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_ENTRY = re.compile(rf"(?:({_NUMBER})\s*:\s*)?(\w+)\s*=\s*({_NUMBER})(?:\s+every\s+({_NUMBER}))?")
_FORM = "TIME: NAME=VALUE or TIME: outage=SECONDS [every SECONDS], with ; between them"


class Outage(NamedTuple):
    """Everything is lost for `length` [s] from the time `at` on, and again every `period` [s]; 0: once."""

    at: float = 0.0
    length: float = 0.0
    period: float = 0.0


class Entry(NamedTuple):
    """From the time `at` [s] on: either a parameter's value, or an outage."""

    at: float
    name: str
    value: float | int
    outage: Outage


_LATEST = 1e9
"""Latest time [s] of an entry, and longest outage: 31 years."""


def parse_schedule(text: str, changeable: Mapping[str, Parameter]) -> tuple[Entry, ...]:
    """Entries of a schedule, by time; those of one time in the order of the text.

    Raises ParameterError for a text of another form, a parameter that is not `changeable` or out of its range, and an
    outage that is longer than its period.
    """
    entries = [_entry(part.strip(), changeable) for part in text.split(";") if part.strip()]
    return tuple(sorted(entries, key=lambda entry: entry.at))


def _entry(text: str, changeable: Mapping[str, Parameter]) -> Entry:
    found = _ENTRY.fullmatch(text)
    if found is None:
        raise ParameterError(f"schedule: must be {_FORM}; got {text!r}")
    at, name, value, period = float(found[1] or 0.0), found[2], float(found[3]), float(found[4] or 0.0)
    if not 0.0 <= at <= _LATEST:
        raise ParameterError(f"schedule: a time must be in [0, {_LATEST:g}] s, got {text!r}")
    if name == OUTAGE:
        if not 0.0 <= value <= _LATEST or not period <= _LATEST:
            raise ParameterError(f"schedule: an outage and its period must be in [0, {_LATEST:g}] s, got {text!r}")
        if found[4] is not None and not 0.0 < value <= period:
            raise ParameterError(f"schedule: an outage must be >= 0 s and no longer than its period, got {text!r}")
        return Entry(at, name, 0.0, Outage(at, value, period))
    if name not in changeable:
        raise ParameterError(f"schedule: {name!r} must be one of {', '.join((OUTAGE, *changeable))}; got {text!r}")
    if found[4] is not None:
        raise ParameterError(f"schedule: only an outage comes again, got {text!r}")
    if changeable[name].kind == "integer" and value.is_integer():
        return Entry(at, name, changeable[name].check("schedule", int(value)), Outage())
    return Entry(at, name, changeable[name].check("schedule", value), Outage())


def is_scripted(k: int, at: float, length: float, period: float, ts: float) -> bool:
    """Is slot k in an outage of `length` [s] that begins at `at` [s] and comes again every `period` [s], 0: never?"""
    since, slots = k - whole_slots(at / ts), whole_slots(length / ts)
    if period > 0.0:
        return since >= 0 and since % whole_slots(period / ts) < slots
    return 0 <= since < slots
