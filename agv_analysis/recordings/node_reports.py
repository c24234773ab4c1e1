"""What nodes say of themselves on /diagnostics over a run."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from agv_analysis.recordings.messages_on_steps import stamps_of


def reports_of(diagnostics: NDArray[np.void], node: str) -> dict[str, list[float]]:
    """Numbers that a node reported, by their key, in the order of the reports' stamps; others are passed over.

    `node`: its name as in the reports, `agv_1/plant`.
    """
    found: dict[str, list[float]] = {}
    for row in np.argsort(stamps_of(diagnostics), kind="stable").tolist():
        message = diagnostics[row]
        for i in range(int(message["len(status)"])):
            if message["status.name"][i].decode("utf-8", "replace").strip("/") != node.strip("/"):
                continue
            for key, value in zip(message["status.values.key"][i], message["status.values.value"][i], strict=True):
                number = _number(value)
                if key and math.isfinite(number):
                    found.setdefault(key.decode("utf-8", "replace"), []).append(number)
    return found


def total(counts: list[float]) -> int:
    """Where a count ends that begins anew with each process of a node: the sum of what each of them counted."""
    ends = [before for before, after in pairwise(counts) if after < before]
    return round(sum(ends) + counts[-1])


def _number(value: bytes) -> float:
    try:
        return float(value)
    except ValueError:
        return math.nan
