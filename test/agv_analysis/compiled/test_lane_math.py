"""Sine and cosine of lanes against numpy's of 64 bits of mantissa, over all angles that lanes know."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agv_analysis.compiled.lane_math import LARGEST_ANGLE, cosine, sine

TURNS = np.arange(-4_000, 4_001) * (math.pi / 2)


def angles() -> list[float]:
    """[rad]; the neighbours of multiples of pi / 2 are where a reduction loses most."""
    drawn = np.random.default_rng(1)
    largest = math.floor(LARGEST_ANGLE / (math.pi / 2)) * (math.pi / 2)
    found = np.concatenate((
        drawn.uniform(-LARGEST_ANGLE, LARGEST_ANGLE, 20_000), drawn.uniform(-10.0, 10.0, 20_000),
        10.0 ** drawn.uniform(-300.0, 0.0, 2_000), TURNS, np.nextafter(TURNS, math.inf),
        drawn.integers(0, 600_000, 5_000) * (math.pi / 2), [0.0, largest, -LARGEST_ANGLE, LARGEST_ANGLE],
    ))  # fmt: skip
    return [float(angle) for angle in found if abs(angle) <= LARGEST_ANGLE]


@pytest.mark.skipif(np.finfo(np.longdouble).nmant < 63, reason="numpy's long double is no longer than a double here")
@pytest.mark.parametrize(("of_lanes", "exact"), [(sine, np.sin), (cosine, np.cos)], ids=["sine", "cosine"])
def test_the_error_is_below_two_units_in_the_last_place(of_lanes: object, exact: np.ufunc) -> None:
    assert callable(of_lanes)
    known = exact(np.array(angles(), dtype=np.longdouble))
    found = np.array([of_lanes(angle) for angle in angles()], dtype=np.longdouble)
    unit = np.spacing(np.abs(known.astype(np.float64)))
    assert float((np.abs(found - known) / unit).max()) < 2.0


@pytest.mark.parametrize("angle", [1.01 * LARGEST_ANGLE, -1e300, math.inf, math.nan])
def test_what_lanes_do_not_know_is_no_number(angle: float) -> None:
    assert math.isnan(sine(angle))
    assert math.isnan(cosine(angle))
