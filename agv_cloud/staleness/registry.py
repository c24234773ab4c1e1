"""Staleness policies by name: those of this package, and those of the group `agv_ncs.staleness_policies`.

A policy says how the edge uses a pose that is one step older than it was, because no newer one has arrived. It gets the
pose that the edge took for the AGV's in the step before (`held`), the one that it compared it with (`target`), each
with x, y [m], theta [rad], and the reference of now with its speeds as well (`reference`: x, y, theta, v, w). It
returns held and target for now. At a reception `held` is the pose received and `target` the reference of its instant.
If it names them it also gets the command v [m/s], w [rad/s] that was sent in the step before, the sampling period `ts`
[s] and `arc`, whether the plant's model moves along arcs. All other arguments are its parameters.
"""

from __future__ import annotations

from agv_ros.part_registry import Registry, own_parts
from agv_ros.parts import Call
from agv_ros.pose import Pose

STALENESS_POLICIES = Registry(
    kind="staleness policy",
    group="agv_ncs.staleness_policies",
    own=own_parts("agv_cloud.staleness", "hold", besides=("estimate", "registry")),
    call=Call(
        arguments="number, held, target, reference, v, w, ts, arc, parameters",
        required=("held", "target", "reference"),
        optional=("v", "w", "ts", "arc"),
        result="(x, y, theta), (x_r, y_r, theta_r)",
        shape=((None,) * 3, (None,) * 3),
        returned="Pose(float(x), float(y), float(theta)), Pose(float(x_r), float(y_r), float(theta_r))",
        words="held and target, each a tuple x [m], y [m], theta [rad]",
        in_range=("held.x", "held.y", "held.theta", "target.x", "target.y", "target.theta", "v", "w"),
        known={"Pose": Pose},
    ),
)

COMPILED = ("hold", "align", "predict")
"""Policies that every compiled loop has in it and chooses by number; others are put in their place."""

HOLD, ALIGN, PREDICT = range(3)
"""Their numbers."""


def number_of(policy: str) -> int:
    """Number of a policy among those that are compiled in; that of the others is one more."""
    return COMPILED.index(policy) if policy in COMPILED else len(COMPILED)
