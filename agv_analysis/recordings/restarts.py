"""Nodes that were started again in the middle of a recording, as their diagnostics tell it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from agv_ros.messages import PUBLISHED
from agv_ros.stamps import NS_PER_S, Grid

TOPIC = "/diagnostics"

_REPORTS = f"{PUBLISHED}{TOPIC}".encode()
"""Key of a node's count of its own reports, which starts again with each process."""


def restarts(diagnostics: NDArray[np.void], namespace: str, grid: Grid) -> Iterator[str]:
    """A sentence for each node of `namespace` that more than one process was, one after the other."""
    reports: dict[str, list[tuple[int, int]]] = {}
    for message in diagnostics:
        stamp_ns = int(message["header.stamp.sec"]) * NS_PER_S + int(message["header.stamp.nanosec"])
        for name, number in _counts(message):
            if name.rpartition("/")[0] == namespace.strip("/"):
                reports.setdefault(name, []).append((number, stamp_ns))
    for name, found in sorted(reports.items()):
        processes = max(Counter(number for number, _ in found).values())
        if processes > 1:
            first = sorted(stamp_ns for number, stamp_ns in found if number == min(found)[0])[1 - processes :]
            steps = ", ".join(str(max(0, (stamp_ns - grid.start_ns) // grid.ts_ns)) for stamp_ns in first)
            yield f"{name} was started again in the middle of the run: its reports start again at step {steps}"


def _counts(message: np.void) -> Iterator[tuple[str, int]]:
    """Name and count of own reports of each node in a message of diagnostics."""
    statuses = int(message["len(status)"])
    for i in range(statuses):
        keys, values = message["status.values.key"][i], message["status.values.value"][i]
        for key, value in zip(keys, values, strict=True):
            if key == _REPORTS and value.isdigit():
                yield message["status.name"][i].decode("utf-8", "replace"), int(value)
