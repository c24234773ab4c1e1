"""Vehicles by name: those of this package, and those of other packages in the group `agv_ncs.vehicles`.

A vehicle is a step function over a state that begins with its pose x, y, theta in frame `map`. What stands between
theta and v in its signature are further states, 0 at the beginning of a run. v, w are the speeds over the ground, `dt`
is the time of the step; if it names them it also gets `arc`, whether poses are integrated along arcs, and `v_driven`,
`w_driven`, the speeds that the drive gives, before wheels slip. It must not matter to it where the map's origin is and
how its axes are turned.
"""

from __future__ import annotations

from agv_ros.part_registry import Registry, own_parts
from agv_ros.parts import Call

UNICYCLE = "unicycle"
"""The paper's vehicle."""

VEHICLES = Registry(
    kind="vehicle",
    group="agv_ncs.vehicles",
    own=own_parts("agv_plant.vehicle", UNICYCLE, besides=("drive", "motion", "registry", "slip")),
    call=Call(
        arguments="x, y, theta, states, v, w, v_driven, w_driven, dt, arc, parameters",
        required=("x", "y", "theta", "v", "w", "dt"),
        optional=("arc", "v_driven", "w_driven"),
        states="theta",
        result="x_to, y_to, theta_to",
        shape=(None, None, None),
        returned="float(x_to), float(y_to), float(theta_to), {states}",
        words="x [m], y [m], theta [rad]",
        in_range=("x", "y", "theta", "v", "w"),
    ),
)
