"""Staleness policies: what the edge makes of an outdated pose.

The freshest pose that the edge holds at step k is X_c(k-n). One of three errors goes to the controller, always with the
speeds v_r(k), w_r(k) of now:

- `hold`: X_r(k) against X_c(k-n), the paper's (eq. 1000). Zero error is no equilibrium: the AGV runs ahead by
  v_r n T_s.
- `align`: X_r(k-n) against X_c(k-n), both of one instant. That bias is gone, the stability limits are the same.
- `predict`: X_r(k) against X_c(k-n) moved on by the plant's model under the commands that were sent since. With an
  exact model the loop is the one without outages, whatever n.

The predictor takes every command that was sent for one that was obeyed: the edge does not see what the downlink loses.
"""

from __future__ import annotations

from collections.abc import Callable

from agv_ros.pose import Pose

POLICIES = ("hold", "align", "predict")
"""By name, each at the place of its number."""

HOLD, ALIGN, PREDICT = range(3)

Step = Callable[[float, float, float, float, float, float], tuple[float, float, float]]
"""One sampling period of the plant, as `agv_plant.vehicle.unicycle.euler_step`."""


class Prediction:
    """The pose that the AGV should have by now, from an outdated one and from the commands sent since.

    Each step is computed once: the prediction of step k goes on from that of step k-1 unless a fresher pose has come.
    """

    def __init__(self, step: Step, ts: float) -> None:
        self._step = step
        self._ts = ts
        self._sent: dict[int, tuple[float, float]] = {}
        self._newest = (0.0, 0.0)
        self._from = -1
        self._k = 0
        self._predicted = Pose(0.0, 0.0, 0.0)

    def add_command(self, k: int, v: float, w: float) -> None:
        """The command that was sent at step k [m/s, rad/s]."""
        self._sent[k] = (v, w)

    def has_command(self, k: int) -> bool:
        """Is it known what was sent at step k, or does it not matter any more?"""
        return k in self._sent or k < self._k

    def at(self, k: int, taken: int, pose: Pose) -> Pose:
        """The pose at step k, predicted from the one that was taken at step `taken` <= k.

        A step at which no command was sent is taken for one under the command before it.
        """
        if taken != self._from or k < self._k:
            self._from, self._k, self._predicted = taken, taken, pose
            self._sent = {step: command for step, command in self._sent.items() if step >= taken}
        for step in range(self._k, k):
            self._newest = self._sent.get(step, self._newest)
            self._predicted = Pose(*self._step(*self._predicted, *self._newest, self._ts))
        self._k = k
        return self._predicted
