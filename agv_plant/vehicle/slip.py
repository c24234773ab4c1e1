"""Wheels that slip and an AGV that skids: the speeds over the ground, from those of the drive.

A driven wheel that slips by a ratio s moves over the ground at 1 - s times the speed of its rim. The two wheels of the
AGV, a track width b apart, slip each for itself:

    v_right = v + w b / 2,  v_left = v - w b / 2,  s = slip + slip_noise n,  n normal, a new one for each wheel and step

In a curve the AGV skids outwards: it does not go where it heads, but at a side-slip angle beta to that,

    beta = -skid v w

as with tyres whose side force, m v w in a steady curve, is proportional to their slip angle; skid [s^2/m] is mass over
cornering stiffness.

Sources: Wong, Theory of Ground Vehicles, 4th ed. 2008, 1.3 (slip ratio; also under braking, where the same ratio makes
the AGV lag as well); Rajamani, Vehicle Dynamics and Control, 2nd ed. 2012, 2.3 (side force); Wang and Low, Modeling and
analysis of skidding and slipping in wheeled mobile robots, IEEE T-RO 24(3), 2008 (both in a unicycle's kinematics).
"""

from __future__ import annotations


def over_ground(v: float, w: float, s_left: float, s_right: float, track_width: float) -> tuple[float, float]:
    """Speeds over the ground [m/s, rad/s] of an AGV whose wheels turn for (v, w) and slip by s_left and s_right."""
    if s_left == 0.0 and s_right == 0.0:  # to the last bit, and whatever the size of the numbers
        return v, w
    half = 0.5 * w * track_width
    lost_left, lost_right = s_left * (v - half), s_right * (v + half)
    return v - 0.5 * (lost_left + lost_right), w - (lost_right - lost_left) / track_width


def side_slip(v: float, w: float, skid: float) -> float:
    """Angle [rad] from the AGV's heading to the direction in which it moves."""
    return -skid * v * w if skid > 0.0 else 0.0
