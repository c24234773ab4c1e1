"""Control laws by name: those of this package, and those of other packages in the group `agv_ncs.control_laws`.

A law gets the tracking error x_e, y_e [m], theta_e [rad], the reference in the AGV's frame, and the reference's speeds
v_r [m/s], w_r [rad/s]; it returns the command v [m/s], w [rad/s]. If it names them it also gets the sampling period
`ts` [s] and `look_ahead` [s]; then error and speeds are those of the reference so much later. A law with an argument
`memory`, a tuple of numbers that begins as its default, returns it anew as a third result. All other arguments are its
gains.
"""

from __future__ import annotations

from agv_ros.part_registry import Registry, own_parts
from agv_ros.parts import Call

KANAYAMA = "kanayama"
"""The paper's law, whose gains are parameters of the controller without a name before them."""

CONTROL_LAWS = Registry(
    kind="control law",
    group="agv_ncs.control_laws",
    own=own_parts("agv_cloud.control", KANAYAMA, besides=("command", "command_plan", "registry")),
    call=Call(
        arguments="x_e, y_e, theta_e, v_r, w_r, memory, parameters, ts, look_ahead",
        required=("x_e", "y_e", "theta_e", "v_r", "w_r"),
        optional=("ts", "look_ahead"),
        memory=True,
        runtime=True,
        result="v, w",
        shape=(None, None),
        returned="float(v), float(w), {memory}",
        words="v [m/s], w [rad/s]",
        in_range=("x_e", "y_e", "theta_e"),
    ),
)
