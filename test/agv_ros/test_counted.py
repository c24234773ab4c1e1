"""Counts with the noun that they count."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agv_ros.counted import counted


@pytest.mark.parametrize(
    ("count", "said"),
    [
        (0, "0 slots"), (1, "1 slot"), (2, "2 slots"), (1.0, "1 slot"), (1.25, "1.25 slots"), (158_504, "158504 slots"),
        (-1, "-1 slots"), (math.inf, "inf slots"), (1234.5, "1234 slots"), (float(np.float64(14.0)), "14 slots"),
    ],
)  # fmt: skip
def test_one_is_singular(count: float, said: str) -> None:
    assert counted(count, "slot") == said


def test_the_verb_goes_with_the_noun() -> None:
    assert [counted(count, "loss is", "losses are") for count in (1, 3)] == ["1 loss is", "3 losses are"]
