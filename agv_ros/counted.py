"""Counts in messages and on pages: `1 slot`, `2 slots`."""

from __future__ import annotations


def counted(count: float, one: str, many: str = "") -> str:
    """A count with what it counts, and the verb where that depends on it; `many` is by default `one` with an s.

    `counted(1, "message is", "messages are")` is `1 message is`. An integer has all its digits, a mean three at least.
    """
    number = f"{count:.3g}" if abs(count) < 1000.0 and count % 1.0 else f"{count:.0f}"
    return f"{number} {one if number == '1' else many or one + 's'}"
