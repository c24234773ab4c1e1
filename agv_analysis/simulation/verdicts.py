"""Verdicts of a channel on a whole run, compiled: those of `agv_plant.radio.Channel`, bit for bit.

The same models, the same random numbers; only the loop over the slots is another one, since that of the relay asks for
one slot at a time.
"""

from __future__ import annotations

import dataclasses
import functools
from collections import namedtuple
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled import compiled, numbers
from agv_analysis.simulation.chance import normals
from agv_plant.channels import GOOD, MODELS
from agv_plant.channels.installed import TRACE, find_model
from agv_plant.parameters import ChannelParameters
from agv_plant.radio import draws, losses

Verdicts = NDArray[np.bool_]

_NUMERIC = [field.name for field in dataclasses.fields(ChannelParameters) if not isinstance(field.default, str)]
_Numbers = namedtuple("_Numbers", _NUMERIC)  # type: ignore[misc]  # numba knows tuples, not dataclasses


class Air:
    """Channels under one seed; keeps the random numbers and the latest verdicts, which many runs share."""

    def __init__(self, seed: int, steps: int) -> None:
        self._steps = steps
        self._seed = seed
        self._shared = functools.cache(lambda stream: draws(ChannelParameters(), seed, stream, 0, steps))
        self.normals = functools.cache(lambda stream: normals(seed, stream, steps))
        """Normal numbers of a stream of the AGV's, shape (steps, DRAWS)."""
        self._verdicts = functools.lru_cache(maxsize=128)(self._judge)

    def verdicts(self, channel: ChannelParameters, stream: str) -> Verdicts:
        """Verdicts of the slots 0 .. steps - 1, True where lost, shape (steps,); not to be written to."""
        return self._verdicts(channel, stream)

    def _judge(self, channel: ChannelParameters, stream: str) -> Verdicts:
        if channel.model == TRACE:  # nothing to compute
            return losses(channel, self._seed, stream, self._steps)
        lost = np.zeros(self._steps, dtype=np.bool_)
        if channel.model != "perfect":  # which needs no random numbers
            parameters = _Numbers(*(getattr(channel, name) for name in _NUMERIC))
            try:
                _judge_all(channel.model)(parameters, numbers(self._draws(channel, stream)), lost)
            except Exception:
                if channel.model in MODELS:
                    raise
                # Another package's model may be more than numba compiles: slot by slot it is the same, or says why not.
                return losses(channel, self._seed, stream, self._steps)
        return lost

    def _draws(self, channel: ChannelParameters, stream: str) -> NDArray[np.float64]:
        if channel.correlation == 0.0:
            return self._shared(stream)
        return draws(channel, self._seed, stream, 0, self._steps)


@functools.cache
def _judge_all(name: str) -> Callable[[Any, Any, Verdicts], None]:
    model: Any = find_model(name)

    def judge_all(channel: Any, random: Any, lost: Verdicts) -> None:
        state = GOOD
        for k in range(len(lost)):
            lost[k], state = model(channel, k, random[k], state)
        lost[0] = False  # slot 0 never is

    return compiled(judge_all)
