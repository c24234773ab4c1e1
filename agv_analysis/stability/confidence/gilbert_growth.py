"""Growth of E[e^2] under many Gilbert channels at once, for what `mean_square.lap_growth` says of one of them.

At a few places of the lap the loop is taken as if it stayed as it is there. A slot that was received leaves h = C z, so
of that state only E[z z'] counts: with X the moments of z and Y those of (z, h) while slots are lost,

    X+ = (1 - p) M X M' + r [A_0 Y A_0']_zz        M = F + G C
    Y+ = p A_1 X A_1'  + (1 - r) A_0 Y A_0'        A_1, A_0 as in `mean_square`
"""

from __future__ import annotations

import numpy as np

from agv_analysis.run import Floats
from agv_analysis.stability.linear_loop import LinearLoop
from agv_analysis.stability.mean_square import step_maps
from agv_analysis.stability.moment_operators import leading_entries, log_radius, places, symmetric_operator


def gilbert_growths(loop: LinearLoop, p: Floats, r: Floats) -> Floats:
    """Growth of E[e^2] (logarithm, per step) under Gilbert channels, p and r of shape (n,): the mean over a lap."""
    steps = places(loop)
    return np.asarray(sum(_frozen(loop, int(k), p, r) for k in steps) / len(steps))


def _frozen(loop: LinearLoop, k: int, p: Floats, r: Floats) -> Floats:
    received, missed = step_maps(loop, k)
    R, Q = symmetric_operator(received[:, : loop.size]), symmetric_operator(missed)
    of_z = leading_entries(loop.size + loop.outputs, loop.size)
    p, r = p[:, None, None], r[:, None, None]
    stays, enters = (1.0 - p) * R[of_z], p * R
    leaves, remains = r * Q[of_z], (1.0 - r) * Q
    return log_radius(np.block([[stays, leaves], [enters, remains]]))
