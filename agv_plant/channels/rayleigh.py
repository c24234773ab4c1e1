"""Fading: waves from all sides add up or cancel, depending on the place.

The channel's gain is a field over the floor, fixed by the seed: a sum of plane waves, each from a direction of its own,

    h(x, y) = sum over m of a_m exp(i (k_x x + k_y y + phi_m)),   |k| = 2 pi / lambda,   sum of a_m^2 = 1

An AGV at the speed v meets the fades of Clarke's model with the Doppler frequency f_D = v / lambda; speed enters by
motion alone, and one that stands in a fade stays in it. With rho^2 = 10^(-margin / 10), margin in dB:

    loss rate                    1 - exp(-rho^2)
    autocorrelation of h         J0(2 pi d / lambda) over the distance d
    fades a metre                sqrt(2 pi) rho exp(-rho^2) / lambda
    mean length of a fade        lambda (exp(rho^2) - 1) / (rho sqrt(2 pi))

Source: Clarke, A Statistical Theory of Mobile-Radio Reception, BSTJ 47, 1968; Jakes, Microwave Mobile Communications,
1974. The directions are drawn one from each of WAVES equal sectors, so that one field alone has the autocorrelation.
"""

from __future__ import annotations

import math

from agv_plant.channels.coverage_hole import Table
from agv_plant.random_stream import uniforms

WAVES = 64
"""Plane waves of a field: the distribution of its gain differs from the exponential one by 1 / (2 WAVES) at most."""

SPEED_OF_LIGHT = 299_792_458.0
"""In vacuum [m/s]."""


def fading_gain(x: float, y: float, waves: Table) -> float:
    """|h|^2 in dB at a place [m] in frame `map`, 0 on average (of the power); `waves` as `rows_of` gives them."""
    in_phase, quadrature = 0.0, 0.0
    for k_x, k_y, phase, amplitude, _ in waves:
        angle = k_x * x + k_y * y + phase
        in_phase += amplitude * math.cos(angle)
        quadrature += amplitude * math.sin(angle)
    power = in_phase * in_phase + quadrature * quadrature
    return -math.inf if power == 0.0 else 10.0 * math.log10(power)


def rayleigh(gain: float, margin: float) -> bool:
    """Lost where the gain [dB] is more than the fade margin [dB] below its mean, which is 0 dB."""
    return gain < -margin


def rows_of(seed: int, stream: str, carrier: float, share: float = 1.0) -> list[list[float]]:
    """The waves of a field: rows (k_x, k_y [rad/m], phase [rad], amplitude, 0), from a carrier frequency [Hz].

    `share` is that of this field in the mean power of a sum of several.
    """
    number = 2.0 * math.pi * carrier / SPEED_OF_LIGHT
    amplitude = math.sqrt(share / WAVES)
    rows = []
    for m, (u_direction, u_phase, *_) in enumerate(uniforms(seed, f"{stream}/waves", 0, WAVES).tolist()):
        direction = 2.0 * math.pi * (m + u_direction) / WAVES
        wave = [number * math.cos(direction), number * math.sin(direction), 2.0 * math.pi * u_phase, amplitude, 0.0]
        rows.append(wave)
    return rows


def loss_rate(margin: float) -> float:
    """Share of places that are in a fade, 1 - exp(-rho^2), for a fade margin [dB]."""
    return -math.expm1(-(10.0 ** (-margin / 10.0)))


def fades_per_metre(carrier: float, margin: float) -> float:
    """Fades that begin on one metre of a straight way, sqrt(2 pi) rho exp(-rho^2) / lambda (level-crossing rate)."""
    square = 10.0 ** (-margin / 10.0)
    return math.sqrt(2.0 * math.pi * square) * math.exp(-square) * carrier / SPEED_OF_LIGHT
