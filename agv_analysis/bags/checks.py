"""Whether the times of a topic's messages can be what they claim to be."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags.findings import Findings
from agv_analysis.bags.layout import LOG_TIME, PUBLISH_TIME
from agv_ros.stamps import NS_PER_S


def check_times(topic: str, rows: NDArray[np.void]) -> Findings:
    """Report times that run backwards, duplicate messages, and impossible stamps."""
    findings = Findings()
    log_time = np.ascontiguousarray(rows[LOG_TIME])  # one pass over the rows instead of four
    steps = np.diff(log_time)
    if not (steps > 0).all():
        _report(findings, f"{topic}: message logged before the one that it follows", steps < 0)
        _report(findings, f"{topic}: message that is there twice", _repeated(rows, log_time, steps))
    if min(log_time.min(initial=0), rows[PUBLISH_TIME].min(initial=0)) < 0:
        impossible = (log_time < 0) | (rows[PUBLISH_TIME] < 0)
        _report(findings, f"{topic}: message with a log or publish time after the year 2262", impossible)
    for name in rows.dtype.names or ():
        if is_fraction(name, rows.dtype[name].base) and rows[name].max(initial=0) >= NS_PER_S:
            _report(findings, f"{topic}: {name} of a second or more", rows[name] >= NS_PER_S)
    return findings


def is_fraction(path: str, kind: np.dtype[Any]) -> bool:
    """Are values of this path and type the nanoseconds of stamps?"""
    return path.endswith(".nanosec") and kind == np.dtype("u4")


def _report(findings: Findings, what: str, affected: NDArray[np.bool_]) -> None:
    count = int(np.count_nonzero(affected))
    if count:
        findings.add(what, count)


def _repeated(rows: NDArray[np.void], log_time: NDArray[np.int64], steps: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which messages equal, to the last bit, another one of the same log time? They lie side by side when sorted."""
    order = np.argsort(log_time, kind="stable") if (steps < 0).any() else np.arange(len(rows))
    same = np.flatnonzero(np.diff(log_time[order]) == 0)
    if not len(same):
        return np.zeros(0, np.bool_)
    earlier, later = rows[order[same]], rows[order[same + 1]]
    equal = np.ones(len(same), np.bool_)
    for name in rows.dtype.names or ():
        before, after = earlier[name], later[name]
        if before.dtype.kind == "f":  # a NaN equals itself here
            before, after = before.view(f"u{before.itemsize}"), after.view(f"u{after.itemsize}")
        different = before != after
        equal &= ~different.reshape(len(same), -1).any(axis=1)
    return equal
