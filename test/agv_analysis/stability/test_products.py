"""Small matrix operations of the compiled loops, against numpy's."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agv_analysis.compiled.functions import compiled
from agv_analysis.run import Floats
from agv_analysis.stability.products import assign, divide, largest_entry

MATRIX = np.random.default_rng(1).standard_normal((3, 4))


def test_assign_copies_the_leading_part() -> None:
    target = np.full((2, 4), 9.0)
    compiled(assign)(MATRIX, target)
    np.testing.assert_array_equal(target, MATRIX[:2])


def test_divide_divides_in_place_to_the_last_bit() -> None:
    matrix = MATRIX.copy()
    compiled(divide)(matrix, 3.0)
    np.testing.assert_array_equal(matrix, MATRIX / 3.0)


@pytest.mark.parametrize(
    "matrix",
    [MATRIX, np.zeros((2, 2)), np.array([[math.nan, 5.0]]), np.array([[5.0, math.nan]]), np.array([[-math.inf, 1.0]])],
    ids=["random", "zero", "NaN first", "NaN last", "infinite"],
)
def test_largest_entry_is_numpy_s(matrix: Floats) -> None:
    np.testing.assert_equal(float(compiled(largest_entry)(matrix)), float(np.abs(matrix).max()))
