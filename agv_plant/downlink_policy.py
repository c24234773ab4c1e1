"""Downlink policies: what the AGV does in a step whose command did not arrive.

The newest command that it holds was sent n steps ago. It goes on with it (`hold`), stands still (`zero`), takes its
speeds back in a straight line until it stands (`ramp`), or drives what the plan that came with it says for now, and
stands still when that is over (`buffer`).
"""

from __future__ import annotations

HOLD, ZERO, RAMP, BUFFER = range(4)

DOWNLINK_POLICIES = ("hold", "zero", "ramp", "buffer")
"""By name, each at the place of its number."""


def share_of_command(n: int, policy: int, steps: float) -> float:
    """Share of the newest command's speeds that the AGV drives n steps after it was sent, 1 for n = 0.

    `ramp` reaches 0 after `steps` > 0; the plan of `buffer`, which is then the command, is `steps` steps long.
    """
    if policy == RAMP:
        return max(0.0, 1.0 - n / steps)
    if policy == BUFFER:
        return 1.0 if n <= steps else 0.0
    return 1.0 if n == 0 or policy == HOLD else 0.0
