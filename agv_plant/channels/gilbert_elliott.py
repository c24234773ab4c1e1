"""Losses in bursts: the Gilbert-Elliott channel, with netem's parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from agv_plant.parameters import ChannelParameters


def gilbert_elliott(
    state: int, u_loss: float, u_change: float, p: float, r: float, h: float, k: float
) -> tuple[bool, int]:
    """Loss of one message and the state for the next; states: 0 good, 1 bad.

    A message is delivered with probability `k` in the good and `h` in the bad state; afterwards the state changes with
    probability `p` (good to bad) or `r` (bad to good). `u_loss` and `u_change` are uniform in [0, 1).

    Loss rate (p (1 - h) + r (1 - k)) / (p + r); with h = 0, k = 1: p / (p + r), and outages of 1 / r slots on average.
    Source: Gilbert 1960, Elliott 1963, in the form of tc-netem(8) `loss gemodel p r 1-h 1-k`.
    """
    if state == 0:
        return u_loss >= k, 1 if u_change < p else 0
    return u_loss >= h, 0 if u_change < r else 1


def model(c: ChannelParameters, k: int, u: Sequence[float], state: int) -> tuple[bool, int]:
    """The channel with this name, see `model.Model`."""
    return gilbert_elliott(state, u[0], u[1], c.p, c.r, c.h, c.k)
