"""Distances, speeds and durations for people: the digits that they deserve, and no exponent."""

from __future__ import annotations

import math

import pytest

from agv_analysis.metrics.distance_text import at_most, metres, speed_text, three_digits
from agv_analysis.metrics.duration_text import duration_text, outage_text


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (0.0, "0 m"), (7.46e-14, "below 0.001 mm"), (2.05e-6, "0.00205 mm"), (1.37e-5, "0.0137 mm"),
        (0.0094, "0.0094 m"), (0.37178, "0.372 m"), (999.7, "1000 m"), (2563.0, "2560 m"), (28_030.0, "28000 m"),
        (1e6, "diverges"), (math.inf, "diverges"), (math.nan, "diverges"),
    ],
)  # fmt: skip
def test_a_distance_has_three_digits_and_no_exponent(value: float, said: str) -> None:
    assert metres(value) == said


def test_what_is_below_a_bound_is_not_at_most_below_it() -> None:
    assert at_most(0.5) == "at most 0.5 m"
    assert at_most(1e-9) == "below 0.001 mm"
    assert at_most(math.inf) == "diverges"


def test_speeds_that_no_agv_drives_are_no_numbers() -> None:
    assert speed_text(124.49) == "124 m/s"
    assert speed_text(1249.6) == "1250 m/s"
    assert speed_text(1.79e308) == speed_text(-1.79e308) == "diverges"


@pytest.mark.parametrize("value", [1e3, 12_345.0, 9.99e13])
def test_large_numbers_have_no_exponent(value: float) -> None:
    assert "e" not in three_digits(value)
    assert float(three_digits(value)) == pytest.approx(value, rel=5e-3)


def test_the_ends_of_an_interval_have_the_unit_of_its_middle() -> None:
    assert [duration_text(end, like=88.0) for end in (63.3, 126.6)] == ["63.3 s", "127 s"]  # 63.3 is no binary number
    assert [duration_text(end, like=624.0) for end in (60.0, 3600.0)] == ["1 min", "60 min"]


def test_long_outages_are_in_seconds() -> None:
    assert (outage_text(0.14), outage_text(1.5), outage_text(9.5), outage_text(99.995)) == (
        "140 ms", "1500 ms", "9.5 s", "100 s",
    )  # fmt: skip
