"""A channel without losses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from agv_plant.channels.model import GOOD

if TYPE_CHECKING:
    from agv_plant.parameters import ChannelParameters


def perfect() -> bool:
    """Never lost."""
    return False


def model(c: ChannelParameters, k: int, u: Sequence[float], state: int) -> tuple[bool, int]:
    """The channel with this name, see `model.Model`."""
    return perfect(), GOOD
