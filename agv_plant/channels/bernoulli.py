"""Independent losses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from agv_plant.channels.model import GOOD

if TYPE_CHECKING:
    from agv_plant.parameters import ChannelParameters


def bernoulli(u: float, p: float) -> bool:
    """Lost with probability `p`, given `u` uniform in [0, 1).

    Loss rate p; an outage lasts l slots with probability p^(l-1) (1 - p), so 1 / (1 - p) on average.
    """
    return u < p


def model(c: ChannelParameters, k: int, u: Sequence[float], state: int) -> tuple[bool, int]:
    """The channel with this name, see `model.Model`."""
    return bernoulli(u[0], c.p), GOOD
