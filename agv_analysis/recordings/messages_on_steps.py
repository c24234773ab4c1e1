"""Messages of a topic on the steps of the loop: one for each step that has any, by its stamp."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.run import Floats
from agv_ros.messages import SQUARED_LENGTH, yaw_of_quaternion
from agv_ros.stamps import AGREEING, NS_PER_S, Grid

Steps = NDArray[np.int64]

_NUMBERS = ("position.x", "position.y", "linear.x", "angular.z")
"""Ends of the paths of all numbers that are used, but for those of quaternions."""


class OnSteps(NamedTuple):
    """Messages of one topic, one for each step that has any, by increasing step."""

    k: Steps
    messages: NDArray[np.void]
    off_grid: int
    repeated: int
    unusable: int = 0
    far: int = 0
    """Messages whose steps are far from all others, as no node takes them."""

    def at(self, k: Steps) -> tuple[Steps, NDArray[np.bool_]]:
        """Index of the message of each of the steps `k`, and whether there is one (else the index means nothing)."""
        if not len(self.k):
            return np.zeros(len(k), dtype=np.int64), np.zeros(len(k), dtype=np.bool_)
        index = np.minimum(np.searchsorted(self.k, k), len(self.k) - 1)
        return index, self.k[index] == k

    def column(self, field: str, k: Steps) -> Floats:
        """A number of each of the steps `k`, shape (N,); NaN where there is no message."""
        index, there = self.at(k)
        values = np.full(len(k), np.nan)
        values[there] = self.messages[field][index[there]]
        return values


NOTHING = OnSteps(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.void), 0, 0)
"""Of a topic that is not recorded."""


def stamps_of(messages: NDArray[np.void], field: str = "header.stamp") -> Steps:
    """Instants [ns] in a field of type builtin_interfaces/Time, in its shape."""
    return np.asarray(messages[f"{field}.sec"].astype(np.int64) * NS_PER_S + messages[f"{field}.nanosec"])


def on_steps(messages: NDArray[np.void], grid: Grid, window: int) -> OnSteps:
    """The messages of a topic on the sampling instants of a grid; the first of each step counts.

    Fewer than AGREEING steps that are more than `window` steps from all others are taken for wrong stamps.
    """
    k, rest = np.divmod(stamps_of(messages) - grid.start_ns, grid.ts_ns)
    on_grid, usable = (rest == 0) & (k >= 0), _usable(messages)
    near = _near(k, on_grid, window)
    taken = on_grid & usable & near
    first_k, first = np.unique(k[taken], return_index=True)
    return OnSteps(
        k=first_k,
        messages=messages[taken][first],
        off_grid=int(np.count_nonzero(~on_grid)),
        repeated=int(np.count_nonzero(taken)) - len(first),
        unusable=int(np.count_nonzero(on_grid & near & ~usable)),
        far=int(np.count_nonzero(on_grid & ~near)),
    )


def _near(k: Steps, on_grid: NDArray[np.bool_], window: int) -> NDArray[np.bool_]:
    """Which of the steps `k` are not far from the others, shape (N,); all, if there is no group of AGREEING."""
    known, group = np.unique(k[on_grid], return_inverse=True)
    of_known = np.cumsum(np.diff(known, prepend=known[:1]) > window)
    is_large = np.bincount(of_known, minlength=1) >= AGREEING
    near = np.ones(len(k), dtype=np.bool_)
    if is_large.any():
        near[on_grid] = is_large[of_known][group]
    return near


def _usable(messages: NDArray[np.void]) -> NDArray[np.bool_]:
    """Which messages are such as a node takes: their numbers are finite, their quaternions have length one; (N,)."""
    usable = np.ones(len(messages), dtype=np.bool_)
    for name in messages.dtype.names or ():
        if name.endswith(_NUMBERS):
            usable &= np.isfinite(messages[name])
        elif name.endswith("orientation.x"):
            turn = name.removesuffix("x")
            with np.errstate(over="ignore", invalid="ignore"):
                squared = sum(messages[f"{turn}{axis}"] ** 2 for axis in "xyzw")
            usable &= np.abs(squared - 1.0) < SQUARED_LENGTH
    return usable


def _yaws(messages: OnSteps, pose: str, k: Steps) -> Floats:
    """Yaw [rad] in (-pi, pi] at each of the steps `k`; NaN where there is no message."""
    components = [messages.column(f"{pose}.orientation.{axis}", k).tolist() for axis in "xyzw"]
    return np.array([yaw_of_quaternion(*quaternion) for quaternion in zip(*components, strict=True)])


def postures(messages: OnSteps, pose: str, k: Steps, theta_0: float) -> Floats:
    """Postures (x, y, theta), shape (N, 3); theta counts turns, the first of them the one nearest to `theta_0`."""
    theta = np.unwrap(_yaws(messages, pose, k))
    theta += 2.0 * math.pi * round((theta_0 - theta[0]) / (2.0 * math.pi))
    return np.column_stack([messages.column(f"{pose}.position.{axis}", k) for axis in "xy"] + [theta])


def errors_of(messages: OnSteps, k: Steps) -> Floats:
    """Tracking errors as the edge sent them, shape (N, 3); theta_e in (-pi, pi]."""
    position = [messages.column(f"pose.pose.position.{axis}", k) for axis in "xy"]
    return np.column_stack([*position, _yaws(messages, "pose.pose", k)])


def speeds_of_errors(messages: OnSteps, k: Steps) -> Floats:
    """The reference's speeds (v_r, w_r) as the edge sent them with its errors, shape (N, 2)."""
    return np.column_stack([messages.column(f"twist.twist.{speed}", k) for speed in ("linear.x", "angular.z")])


def commands_of(messages: OnSteps, k: Steps) -> Floats:
    """Commands (v, w), shape (N, 2)."""
    return np.column_stack([messages.column("twist.linear.x", k), messages.column("twist.angular.z", k)])
