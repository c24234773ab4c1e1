"""Control laws by name: those of this package, and those of other packages in the group `agv_ncs.control_laws`."""

from __future__ import annotations

from agv_cloud.control.kanayama import kanayama
from agv_cloud.control.pure_pursuit import pure_pursuit
from agv_cloud.control.state_feedback import state_feedback
from agv_ros.parts import Call, Registry

KANAYAMA = "kanayama"
"""The paper's law, whose gains are parameters of the controller without a name before them."""

CONTROL_LAWS = Registry(
    kind="control law",
    group="agv_ncs.control_laws",
    call=Call(required=("x_e", "y_e", "theta_e", "v_r", "w_r"), optional=("ts", "look_ahead"), memory=True),
    template=(
        "def {name}(x_e, y_e, theta_e, v_r, w_r, memory, parameters, ts, look_ahead):\n"
        "    v, w{memory} = {call}\n"
        "    return v, w, memory\n"
    ),
    own={KANAYAMA: kanayama, "state_feedback": state_feedback, "pure_pursuit": pure_pursuit},
)
