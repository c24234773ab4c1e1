"""Channel models: is the message of slot k lost?

One module a model. Each is a scalar function of its parameters, of the slot's uniform random numbers and, where the
channel has a memory, of its state before the slot; the function also gives the state after it. `MODELS` names them all,
but for `trace`, whose verdicts were measured and stand in a file, those that ask where the AGV is (`placed`), `shared`,
in which the messages of a fleet compete, and those of other packages (`installed`). On top of any of them messages may
be late (`delay`), and a schedule may change what a channel does while a run goes on (`schedule`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from agv_plant.channels.bernoulli import bernoulli
from agv_plant.channels.burst import burst
from agv_plant.channels.gilbert_elliott import gilbert_elliott
from agv_plant.channels.perfect import perfect

if TYPE_CHECKING:
    from agv_plant.parameters import ChannelParameters

GOOD = 0
"""The state in which every channel starts."""

Model = Callable[["ChannelParameters", int, Sequence[float], int], tuple[bool, int]]
"""(parameters, k, uniform numbers of slot k, state before) -> (lost, state after)."""

MODELS: dict[str, Model] = {
    "perfect": lambda c, k, u, state: (perfect(), GOOD),
    "bernoulli": lambda c, k, u, state: (bernoulli(u[0], c.p), GOOD),
    "gilbert_elliott": lambda c, k, u, state: gilbert_elliott(state, u[0], u[1], c.p, c.r, c.h, c.k),
    "burst": lambda c, k, u, state: (burst(k, c.n, c.start_step), GOOD),
}
