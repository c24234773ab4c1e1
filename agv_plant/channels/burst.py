"""The deterministic outage of the theory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from agv_plant.channels.model import GOOD

if TYPE_CHECKING:
    from agv_plant.parameters import ChannelParameters


def burst(k: int, n: int, start_step: int) -> bool:
    """Exactly `n` consecutive losses: after each received message (start_step < 0), or once from step `start_step`.

    Loss rate n / (n + 1) in the periodic case, which is the switched system M_L with L = n + 1.
    """
    if start_step < 0:
        return k % (n + 1) != 0
    return start_step <= k < start_step + n


def model(c: ChannelParameters, k: int, u: Sequence[float], state: int) -> tuple[bool, int]:
    """The channel with this name, see `model.Model`."""
    return burst(k, c.n, c.start_step), GOOD
