"""The tracking error against matrices, complex numbers and pictures."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_cloud.tracking_error import tracking_error

place = st.floats(-1e3, 1e3)
angle = st.floats(-50.0, 50.0)
posture = st.tuples(place, place, angle)


@settings(deadline=None, derandomize=True)
@given(posture, posture)
def test_the_matrix_form_of_the_paper(r: tuple[float, float, float], c: tuple[float, float, float]) -> None:
    # Equation 3: eps = T_e (X_r - X_c).
    theta = c[2]
    T_e = np.array(
        [[np.cos(theta), np.sin(theta), 0.0], [-np.sin(theta), np.cos(theta), 0.0], [0.0, 0.0, 1.0]], dtype=np.float64
    )
    expected = T_e @ (np.array(r) - np.array(c))
    assert tracking_error(*r, *c) == pytest.approx(tuple(expected), rel=1e-13, abs=1e-11)


@settings(deadline=None, derandomize=True)
@given(posture, posture)
def test_a_rotation_in_the_complex_plane(r: tuple[float, float, float], c: tuple[float, float, float]) -> None:
    seen = (complex(r[0], r[1]) - complex(c[0], c[1])) * cmath.exp(-1j * c[2])
    x_e, y_e, _ = tracking_error(*r, *c)
    assert complex(x_e, y_e) == pytest.approx(seen, rel=1e-13, abs=1e-11)
    assert math.hypot(x_e, y_e) == pytest.approx(math.dist(r[:2], c[:2]), rel=1e-13, abs=1e-11)


@pytest.mark.parametrize(
    ("reference", "agv", "error"),
    [
        ((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),  # the reference is ahead
        ((0.0, 1.0, 0.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),  # to the left
        ((0.0, 0.0, math.pi / 2), (0.0, 5.0, math.pi / 2), (-5.0, 0.0, 0.0)),  # the paper's start: AGV 5 m ahead
        ((3.0, 4.0, 1.0), (3.0, 4.0, 0.0), (0.0, 0.0, 1.0)),
        ((0.0, 0.0, 3.0 * math.pi), (0.0, 0.0, 0.0), (0.0, 0.0, 3.0 * math.pi)),  # turns are counted
    ],
)
def test_pictures(
    reference: tuple[float, float, float], agv: tuple[float, float, float], error: tuple[float, float, float]
) -> None:
    assert tracking_error(*reference, *agv) == pytest.approx(error, abs=1e-15)


@settings(deadline=None, derandomize=True)
@given(posture)
def test_no_error_is_exactly_none(x: tuple[float, float, float]) -> None:
    assert tracking_error(*x, *x) == (0.0, 0.0, 0.0)


@settings(deadline=None, derandomize=True)
@given(posture, posture, place, place, angle)
def test_it_does_not_depend_on_where_the_map_lies(
    r: tuple[float, float, float], c: tuple[float, float, float], dx: float, dy: float, turn: float
) -> None:
    def moved(p: tuple[float, float, float]) -> tuple[float, float, float]:
        z = complex(p[0], p[1]) * cmath.exp(1j * turn) + complex(dx, dy)
        return z.real, z.imag, p[2] + turn

    assert tracking_error(*moved(r), *moved(c)) == pytest.approx(tracking_error(*r, *c), abs=1e-9)
