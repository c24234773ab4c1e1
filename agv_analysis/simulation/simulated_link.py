"""One direction of the radio in a single run, of which everything is kept."""

from __future__ import annotations

import functools
import math

import numpy as np

from agv_analysis.metrics.outages import ages
from agv_analysis.run import LinkSlots
from agv_analysis.simulation.channel_outcomes import ChannelRealisation, Outcomes, link_inputs
from agv_analysis.simulation.link_loop import LinkInputs, LinkTrace, empty_trace
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import Channel, draws


class SimulatedLink:
    """A channel under one seed, evaluated in the loop or before it, and what became of its messages."""

    def __init__(self, channel: ChannelParameters, seed: int, stream: str, steps: int, ts: float) -> None:
        self.lost: Outcomes
        """What is lost wherever the AGV is, shape (N,)."""
        self.lost, self._state = ChannelRealisation(seed, steps, ts).outcomes_and_states(channel, stream)
        self._cause = np.full(steps, channel.model)
        if channel.entries or channel.lifetime < math.inf:  # which are causes of their own
            relay = Channel(channel, seed, stream, ts)
            causes = {k: relay.outcome(k).cause for k in np.flatnonzero(self.lost).tolist()}
            self._cause = np.array([causes.get(k, channel.model) for k in range(steps)])
        self.is_direct = channel.is_direct
        self.trace: LinkTrace = empty_trace(steps)
        """To be filled by the loop, if the link is not direct."""
        if self.is_direct:
            k = np.arange(steps)
            self.trace.lost[:] = self.lost
            self.trace.held[:] = k - ages(k, self.lost)
        self._asked = channel, seed, stream, ts

    @functools.cached_property
    def link_inputs(self) -> LinkInputs:
        """What is needed to ask it in the loop."""
        channel, seed, stream, ts = self._asked
        return link_inputs(channel, seed, stream, self.lost, draws(channel, seed, stream, 0, len(self.lost)), ts)

    def slots(self, count: int) -> LinkSlots:
        """The first `count` slots."""
        lost = self.trace.lost[:count]
        waits = np.zeros(count, dtype=np.int64) if self.is_direct else np.asarray(self.link_inputs.waits)[:count]
        return LinkSlots(
            cause=np.where(lost, self._cause[:count], ""),
            state=self._state[:count],
            gain=self.trace.gain[:count],
            delay=np.where(lost, 0, waits),
        )
