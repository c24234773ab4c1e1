"""The reference at one step."""

from __future__ import annotations

from typing import NamedTuple


class ReferencePoint(NamedTuple):
    """Pose X_r(k) in frame `map` [m, m, rad], and speeds v_r(k), w_r(k) [m/s, rad/s]."""

    x: float
    y: float
    theta: float
    v: float
    w: float
