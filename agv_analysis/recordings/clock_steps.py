"""Clocks that were set while a recording was made, and clocks that differ, by what log times say of the stamps."""

from __future__ import annotations

import numpy as np

from agv_analysis.recordings.messages_on_steps import Steps
from agv_ros.stamps import NS_PER_S

_LEAST_NS = NS_PER_S // 5
"""A clock that is kept by NTP is slewed below this [ns]; what is more is set. Jitter of a link rarely lasts so long."""

_WINDOW, _HORIZON = 20, 400
"""Messages before and after a step, at least, and of how many of them the least delay is taken."""


def clock_steps(stamps: Steps, log_times: Steps) -> list[tuple[int, int]]:
    """Rows from which on the clock of the stamps has been set, each with by how much [ns]; shapes (M,).

    Own delay and offset of the clocks are log time minus stamp. Late messages raise it for a while, an outage changes
    nothing; only a clock that was set changes its least value over the messages before and after. Where log times are
    no times of reception (equal to the stamps, or of a simulation at another rate) nothing is found.
    """
    delays = log_times - stamps
    found: list[tuple[int, int]] = []
    candidates = np.flatnonzero(np.abs(np.diff(delays)) > _LEAST_NS) + 1
    if len(candidates) > len(stamps) // _WINDOW:  # log times and stamps have nothing to do with each other
        return []
    for row in candidates.tolist():
        before, after = delays[max(0, row - _HORIZON) : row], delays[row : row + _HORIZON]
        if min(len(before), len(after)) < _WINDOW:
            continue
        step = int(before.min() - after.min())
        is_own_gap = abs(int(stamps[row] - stamps[row - 1])) > _LEAST_NS
        if abs(step) > _LEAST_NS and is_own_gap and np.median(np.abs(after - after.min())) < abs(step) / 2:
            found.append((row, step))
    return found


def other_clock(stamps: Steps, log_times: Steps, of_stamps: Steps, of_log_times: Steps) -> int:
    """How far [ns] the clock of one topic's stamps is ahead of another's, by their least delays.

    0 if it may be the same: up to 0.2 s can be the way of a message.
    """
    ahead = int((of_log_times - of_stamps).min() - (log_times - stamps).min())
    return ahead if abs(ahead) > _LEAST_NS else 0
