"""Durations in words."""

from __future__ import annotations

import math

import pytest

from agv_analysis.metrics.duration_text import duration_text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0213, "0.0213 s"), (119.0, "119 s"), (120.0, "2 min"), (7200.0, "2 h"), (86400.0, "24 h"),
        (6.048e5, "7 days"), (1e9, "31.7 years"), (math.inf, "any time"),
    ],
)  # fmt: skip
def test_the_unit_is_the_largest_of_which_there_are_two(seconds: float, text: str) -> None:
    assert duration_text(seconds) == text
