"""Sine and cosine as polynomials: what `math.sin` and `math.cos` are where functions are compiled over lanes.

A call of a library's sine cannot be vectorised; polynomials of plain numbers, without a branch, can. The angle is
reduced to the nearest multiple of pi / 2 with pi / 2 in three parts (Cody and Waite, Software Manual for the Elementary
Functions, 1980), of which the first two have so few bits that their multiples are exact. What is left, at most pi / 4,
goes into Taylor's series as far as the last bit needs them. The error is below 2 units in the last place for all angles
up to `LARGEST_ANGLE`; beyond it, the result is NaN.
"""

from __future__ import annotations

import math

LARGEST_ANGLE = 1e6
"""[rad]; a run that turns farther is not one for lanes."""

_TO_INTEGER = 1.5 * 2.0**52
"""Added and taken away again, it rounds to the nearest integer, as numbers of this size have no fraction."""

# pi / 2 in parts of 33, 33 and 53 bits: multiples of the first two by an integer below 2**20 are exact.
_FIRST = float.fromhex("0x1.921fb544p0")
_SECOND = float.fromhex("0x1.0b4611a6p-34")
_THIRD = float.fromhex("0x1.3198a2e037073p-69")

_S3, _S5, _S7, _S9, _S11, _S13, _S15, _S17 = ((-1.0) ** n / math.factorial(2 * n + 1) for n in range(1, 9))
_C4, _C6, _C8, _C10, _C12, _C14, _C16 = ((-1.0) ** n / math.factorial(2 * n) for n in range(2, 9))


def sine(angle: float) -> float:
    """Sine of an angle [rad], NaN beyond `LARGEST_ANGLE`."""
    rest, tail, quadrant = reduced(angle)
    found = cosine_near_zero(rest, tail) if abs(quadrant) == 1.0 else sine_near_zero(rest, tail)
    return -found if quadrant < 0.0 or quadrant == 2.0 else found


def cosine(angle: float) -> float:
    """Cosine of an angle [rad], NaN beyond `LARGEST_ANGLE`."""
    rest, tail, quadrant = reduced(angle)
    found = sine_near_zero(rest, tail) if abs(quadrant) == 1.0 else cosine_near_zero(rest, tail)
    return -found if quadrant > 0.0 or quadrant == -2.0 else found


def reduced(angle: float) -> tuple[float, float, float]:
    """What an angle exceeds the nearest multiple of pi / 2 by, as a sum of two numbers, and the quadrant, -2 to 2."""
    n = (angle * (2.0 / math.pi) + _TO_INTEGER) - _TO_INTEGER
    left = angle - n * _FIRST
    rounded = left - n * _SECOND
    missing = ((left - rounded) - n * _SECOND) - n * _THIRD
    rest = rounded + missing
    tail = (rounded - rest) + missing
    quadrant = n - 4.0 * ((0.25 * n + _TO_INTEGER) - _TO_INTEGER)
    return rest if abs(angle) <= LARGEST_ANGLE else math.nan, tail, quadrant


def sine_near_zero(x: float, tail: float) -> float:
    """Sine of x + tail, |x| <= pi / 4, by Taylor's series; in pairs, so that no factor waits for all before it."""
    z = x * x
    z2 = z * z
    low = (_S3 + z * _S5) + z2 * (_S7 + z * _S9)
    high = (_S11 + z * _S13) + z2 * (_S15 + z * _S17)
    return x + (tail + x * (z * (low + (z2 * z2) * high)))


def cosine_near_zero(x: float, tail: float) -> float:
    """Cosine of x + tail, the same."""
    z = x * x
    z2 = z * z
    low = (_C4 + z * _C6) + z2 * (_C8 + z * _C10)
    high = (_C12 + z * _C14) + z2 * _C16
    whole = 1.0 - 0.5 * z
    return whole + (((1.0 - whole) - 0.5 * z) + (z2 * (low + (z2 * z2) * high) - x * tail))
