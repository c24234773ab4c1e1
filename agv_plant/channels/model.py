"""What a channel model is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from agv_plant.parameters import ChannelParameters

GOOD = 0
"""The state in which every channel starts."""

Model = Callable[["ChannelParameters", int, Sequence[float], int], tuple[bool, int]]
"""(parameters, k, uniform numbers of slot k, state before) -> (lost, state after)."""
