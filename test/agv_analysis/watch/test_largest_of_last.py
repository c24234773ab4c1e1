"""The largest of the last values, against the maximum of the values themselves."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from agv_analysis.watch.largest_of_last import LargestOfLast


@given(st.lists(st.one_of(st.floats(allow_nan=False), st.just(math.nan))), st.integers(min_value=1, max_value=5))
def test_it_is_the_maximum_of_the_last_values_without_those_that_are_not_known(values: list[float], count: int) -> None:
    series = LargestOfLast(count)
    for i, value in enumerate(values):
        series.add(value)
        known = [value for value in values[max(0, i + 1 - count) : i + 1] if not math.isnan(value)]
        assert series.value == max(known) if known else math.isnan(series.value)
