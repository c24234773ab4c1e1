"""One direction of the radio link: the verdict on slot k, and what the other end holds after it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from agv_plant.channels import GOOD
from agv_plant.channels.installed import TRACE, ChannelError, find_model
from agv_plant.channels.trace import TraceError, load_trace, trace
from agv_plant.parameters import ChannelParameters
from agv_plant.random_stream import uniforms
from agv_ros.stamps import Grid, Steps
from agv_ros.wire import DELIVERED, LOST, Slot

_BLOCK = 4096

UPLINK = "uplink"
"""The stream from which a correlated channel takes its random numbers."""


def draws(parameters: ChannelParameters, seed: int, stream: str, first: int, count: int) -> NDArray[np.float64]:
    """Random numbers of a channel's slots first .. first + count - 1, uniform in [0, 1), shape (count, DRAWS).

    In a share `correlation` of the slots they are those of the uplink. Of two equal channels without memory the losses
    then have exactly this correlation coefficient.
    """
    own = uniforms(seed, stream, first, count)
    if parameters.correlation == 0.0:
        return own
    shared = uniforms(seed, f"{stream}/correlation", first, count)[:, :1] < parameters.correlation
    return np.where(shared, uniforms(seed, UPLINK, first, count), own)


class Channel:
    """Verdicts of one channel, a pure function of (parameters, seed, stream name, k).

    The state of a channel with memory is kept for the next slot only; asking for an earlier slot starts again at slot
    0, so any order of questions has the same answers. New parameters hold from the slot after the last one asked for.
    A measured channel's file is read here, once. Raises TraceError if it cannot be used, ChannelError for a model of
    another package that cannot be loaded.
    """

    def __init__(self, parameters: ChannelParameters, seed: int, stream: str) -> None:
        self.parameters = parameters
        self._seed = seed
        self._stream = stream
        measured = parameters.model == TRACE
        self._trace = load_trace(parameters.trace_file) if measured else ()
        self._model = None if measured else find_model(parameters.model)
        self._next = 0
        self._state = GOOD
        self._last = False
        self._first_of_block = -1
        self._block: Sequence[Sequence[float]] = ()

    def lost(self, k: int) -> bool:
        """Is the message of slot `k` lost? Slot 0 never is: a run begins with the AGV known to the edge."""
        if self._model is None:
            return k > 0 and self._measured(k)
        if k < self._next - 1:
            self._next, self._state = 0, GOOD
        while self._next <= k:
            try:
                lost, self._state = self._model(self.parameters, self._next, self._uniforms(self._next), self._state)
            except Exception as error:  # another package's model, in which anything can go wrong
                raise ChannelError(f"channel model {self.parameters.model}, slot {self._next}: {error}") from error
            self._last = lost and self._next > 0
            self._next += 1
        return self._last

    def _measured(self, k: int) -> bool:
        try:
            return trace(k, self._trace, self.parameters.trace_end)
        except TraceError as error:
            raise TraceError(f"{self.parameters.trace_file}: {error}") from None

    def _uniforms(self, k: int) -> Sequence[float]:
        first = k - k % _BLOCK
        if first != self._first_of_block:
            self._block = draws(self.parameters, self._seed, self._stream, first, _BLOCK).tolist()
            self._first_of_block = first
        return self._block[k - first]


def check_length(parameters: ChannelParameters, steps: float) -> None:
    """Is a trace that may not be outrun long enough for a run of `steps`? Raises TraceError before the run if not."""
    if parameters.model == TRACE and math.isfinite(steps):
        Channel(parameters, 0, "").lost(max(0, round(steps) - 1))


def losses(parameters: ChannelParameters, seed: int, stream: str, steps: int) -> NDArray[np.bool_]:
    """Verdicts of the slots 0 .. steps - 1, True where lost, shape (steps,)."""
    channel = Channel(parameters, seed, stream)
    return np.fromiter((channel.lost(k) for k in range(steps)), dtype=np.bool_, count=steps)


class Link:
    """A channel, the memory of the receiver behind it, and a count of what became of the messages."""

    def __init__(self, channel: Channel, grid: Grid) -> None:
        self.channel = channel
        self._steps = Steps(grid)
        self._freshest_ns = 0
        self.sent = 0
        self.lost = 0
        self.longest = 0
        """Most messages lost in a row."""
        self._run = 0

    def transmit(self, stamp_ns: int) -> Slot:
        """The slot of the message with this stamp. Raises OffGridError if the stamp is no sampling instant."""
        k = self._steps.of(stamp_ns)
        lost = self.channel.lost(k)
        self.sent += 1
        if lost:
            self.lost += 1
            self._run += 1
            self.longest = max(self.longest, self._run)
        else:
            self._run = 0
            # Step 0 begins a run: whatever is held of a run before it is not fresher.
            self._freshest_ns = stamp_ns if k == 0 else max(self._freshest_ns, stamp_ns)
        return Slot(stamp_ns, self._freshest_ns, LOST if lost else DELIVERED)
