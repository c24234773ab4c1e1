"""Staleness policies by name: those of this package, and those of the group `agv_ncs.staleness_policies`.

A policy says what the edge makes of a pose that is one step older than it was, no newer one having come. It gets the
pose that the edge took for the AGV's in the step before (`held`) and the one that it compared it with (`target`), the
reference of now with its speeds (`reference`), and returns both for now. At a reception `held` is the pose received and
`target` the reference of its instant. If it names them it also gets the command (v [m/s], w [rad/s]) that was sent in
the step before, the sampling period `ts` [s] and `arc`, whether the plant's model moves along arcs.
"""

from __future__ import annotations

from agv_cloud.staleness.align import align
from agv_cloud.staleness.hold import hold
from agv_cloud.staleness.predict import predict
from agv_ros.parts import Call, Registry

STALENESS_POLICIES = Registry(
    kind="staleness policy",
    group="agv_ncs.staleness_policies",
    call=Call(required=("held", "target", "reference"), optional=("v", "w", "ts", "arc")),
    template=("def {name}(number, held, target, reference, v, w, ts, arc, parameters):\n    return {call}\n"),
    own={"hold": hold, "align": align, "predict": predict},
)

HOLD, ALIGN, PREDICT = range(3)
"""Numbers of the policies of this package, in the order of their names."""
