"""Downlink policies: what the AGV does in a step whose command did not arrive.

The newest command that it holds was sent n steps ago. It goes on with it (`hold`), stands still (`zero`), or takes its
speeds back in a straight line until it stands (`ramp`).
"""

from __future__ import annotations

HOLD, ZERO, RAMP = range(3)

DOWNLINK_POLICIES = ("hold", "zero", "ramp")
"""By name, each at the place of its number."""


def share_of_command(n: int, policy: int, ramp_steps: float) -> float:
    """Share of the newest command's speeds that the AGV drives n steps after it was sent, 1 for n = 0.

    `ramp` reaches 0 after `ramp_steps` > 0.
    """
    if policy == RAMP:
        return max(0.0, 1.0 - n / ramp_steps)
    return 1.0 if n == 0 or policy == HOLD else 0.0
