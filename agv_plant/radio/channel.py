"""Outcomes of one direction of the radio: is the message of slot k lost, why, and how long is it under way?"""

from __future__ import annotations

import bisect
import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_plant.channels.model import GOOD, Model
from agv_plant.channels.position_dependent import NOWHERE, kind_of, outcome_at
from agv_plant.channels.registry import SHARED, TRACE, ChannelError, find_model
from agv_plant.channels.timed_trace import Trace, read_trace, start_of
from agv_plant.channels.trace import TraceError
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel_setup import UPLINK, Segment, levels_of, segments_of, spatial_table_of
from agv_plant.radio.delay import EXPIRED, delays_of, whole_slots
from agv_plant.radio.retransmission import GIVEN_UP, Retransmission
from agv_plant.radio.schedule import OUTAGE, is_scripted
from agv_plant.radio.shared_uplink import SCHEDULERS, serve, stream_of
from agv_plant.random_stream import InBlocks, uniforms
from agv_ros.parameters import LoopParameters

_BLOCK = 4096

_FAR = 4096
"""So many slots ahead of the last one are not all evaluated on the way, if that can be avoided."""

_BAD = 1

_TWO_STATES = ("perfect", "bernoulli", "burst", "gilbert_elliott")
"""Models that have no states but GOOD and _BAD."""


def own_stream(parameters: ChannelParameters, stream: str) -> str:
    """Name of a vehicle's random numbers on a link; those of the first have the link's own name."""
    return stream_of(stream, parameters.vehicle) if parameters.vehicle else stream


def draws(parameters: ChannelParameters, seed: int, stream: str, first: int, count: int) -> NDArray[np.float64]:
    """Random numbers of a channel's slots first .. first + count - 1, uniform in [0, 1), shape (count, DRAWS).

    In a share `correlation` of the slots they are those of the same vehicle's uplink. Of two equal channels without
    memory the losses then have exactly this correlation coefficient.
    """
    own = uniforms(seed, own_stream(parameters, stream), first, count)
    if parameters.correlation == 0.0:
        return own
    which = uniforms(seed, f"{own_stream(parameters, stream)}/correlation", first, count)[:, :1]
    uplink = uniforms(seed, own_stream(parameters, UPLINK), first, count)
    return np.where(which < parameters.correlation, uplink, own)


def delay_draws(parameters: ChannelParameters, seed: int, stream: str, first: int, count: int) -> NDArray[np.float64]:
    """The same for delays, those of a link alone."""
    return uniforms(seed, f"{own_stream(parameters, stream)}/delay", first, count)


def on_air(parameters: ChannelParameters) -> ChannelParameters:
    """The channel below a reliable one: what is lost before it is sent again."""
    return dataclasses.replace(parameters, reliable=False, delay=0.0, lifetime=math.inf)


class SlotOutcome(NamedTuple):
    """What the channel does to the message of a slot, and why."""

    lost: bool
    cause: str = ""
    """The channel's model, `outage` if the schedule says so, or `expired`; empty if the message is not lost."""
    state: int = GOOD
    """The state that decided, of a channel with memory."""
    gain: float = math.nan
    """Of the channel [dB], NaN if it has none."""


class MeasuredSlots:
    """What a measured channel's file says of each slot. Raises TraceError if it cannot be used."""

    def __init__(self, parameters: ChannelParameters, seed: int, stream: str, ts: float) -> None:
        self._file, self._end, self._ts = parameters.trace_file, parameters.trace_end, ts
        self._trace: Trace = read_trace(self._file, stream)
        self._start = start_of(self._trace, seed, parameters.trace_window, ts)

    def rows(self, first: int, count: int) -> NDArray[np.float64]:
        """Lost (0 or 1) and time under way [s] of the slots first .. first + count - 1, shape (count, 2).

        Raises TraceError for a slot behind the end of a trace that may not be outrun.
        """
        k = np.arange(first, first + count, dtype=np.int64)
        try:
            rows = self._trace.rows(k, self._ts, self._end, self._start)
        except TraceError as error:
            raise TraceError(f"{self._file}: {error}") from None
        found = np.zeros((count, 2))
        found[:, 0] = self._trace.lost[rows] & (rows >= 0)
        if self._trace.delay is not None:
            found[:, 1] = np.where(rows >= 0, self._trace.delay[rows], 0.0)
        return found


def _in_blocks(make: Callable[[int, int], NDArray[np.float64]]) -> InBlocks[list[float]]:
    return InBlocks(lambda first, count: make(first, count).tolist(), _BLOCK)


class _SharedUplinkModel:
    """The uplink that a fleet shares, as a model that is evaluated slot by slot."""

    def __init__(self, parameters: ChannelParameters, seed: int, link: str) -> None:
        self._scheduler = SCHEDULERS.index(parameters.scheduler)
        self._drawn = [
            _in_blocks(functools.partial(uniforms, seed, stream_of(link, vehicle)))
            for vehicle in range(parameters.vehicles)
        ]
        self._ages = [0] * parameters.vehicles

    def __call__(self, channel: ChannelParameters, k: int, _: Sequence[float], state: int) -> tuple[bool, int]:
        """As any `Model`; what it remembers of the other vehicles is reset in slot 0."""
        if k == 0:
            self._ages = [0] * channel.vehicles
        turns, fates = zip(*(drawn.at(k)[:2] for drawn in self._drawn), strict=True)
        lost = [False] * channel.vehicles
        serve(k, channel.blocks, self._scheduler, channel.p, turns, fates, self._ages, lost)
        return lost[channel.vehicle], state


def _model_of(parameters: ChannelParameters, seed: int, stream: str) -> Model:
    return _SharedUplinkModel(parameters, seed, stream) if parameters.model == SHARED else find_model(parameters.model)


class Channel:
    """Outcomes of one channel, a pure function of (parameters, seed, stream name, k) and, for some, of the place.

    The state of a channel with memory is kept for the next slot only; asking for an earlier slot starts again at slot
    0, so outcomes do not depend on the order of calls. New parameters hold from the slot after the last evaluated one.
    A measured channel's file is read here, once. Raises TraceError if it cannot be used, ChannelError for a model of
    another package that cannot be loaded.
    """

    def __init__(self, parameters: ChannelParameters, seed: int, stream: str, ts: float = LoopParameters.ts) -> None:
        self._ts = ts
        self._on_air = Channel(on_air(parameters), seed, stream, ts) if parameters.reliable else None
        """What is lost before it is sent again, of a reliable channel."""
        self.parameters = parameters
        measured = parameters.model == TRACE
        self._kind = kind_of(parameters.model)
        self._spatial_table = spatial_table_of(parameters, seed, stream) if parameters.is_placed else []
        self._slots = MeasuredSlots(parameters, seed, stream, ts) if measured else None
        self._measured: dict[int, tuple[float, float]] = {}
        self._model = None if measured or parameters.is_placed else _model_of(parameters, seed, stream)
        self._random = _in_blocks(lambda first, count: draws(self.parameters, seed, stream, first, count))
        self._random_delays = _in_blocks(lambda first, count: delay_draws(self.parameters, seed, stream, first, count))
        self._again = Retransmission(self._is_lost_on_air)
        self._causes: dict[int, SlotOutcome] = {}
        self._next = 0
        self._state = GOOD
        self._last = SlotOutcome(False)

    @property
    def parameters(self) -> ChannelParameters:
        """Those that its schedule starts from."""
        return self._parameters

    @parameters.setter
    def parameters(self, parameters: ChannelParameters) -> None:
        self._parameters = parameters
        self._segments = segments_of(parameters, self._ts)
        self._firsts = [segment.first for segment in self._segments]
        if self._on_air is not None:
            self._on_air.parameters = on_air(parameters)
        self._may_expire = any(segment.channel.lifetime < math.inf for segment in self._segments)
        self._has_outages = any(segment.outage.length > 0.0 for segment in self._segments)

    def lost(self, k: int, x: float = NOWHERE[0], y: float = NOWHERE[1]) -> bool:
        """Is the message of slot `k` lost, sent when the AGV is at (x, y) [m]?"""
        return self.outcome(k, x, y).lost

    def outcome(self, k: int, x: float = NOWHERE[0], y: float = NOWHERE[1]) -> SlotOutcome:
        """The outcome of slot `k`. Slot 0 is never lost: a run begins with the AGV known to the edge."""
        if self._on_air is not None:
            outcome = self._sent_again(k)
        else:
            outcome = self._by_place(k, x, y) if self._kind else self._by_slot(k)
        if k == 0:
            return outcome._replace(lost=False, cause="")
        if self._on_air is None and self._has_outages and is_scripted(k, *self._segment(k).outage, self._ts):
            return outcome._replace(lost=True, cause=OUTAGE)
        if self._may_expire and max(self.delays(k)) < 0.0:
            return outcome._replace(lost=True, cause=EXPIRED)
        return outcome

    def delays(self, k: int) -> tuple[float, float]:
        """Slots that the message of slot `k` is under way if it is not lost, and its copy; -1 for what never comes."""
        c = self._segment(k).channel
        delay = c.delay + (self._measured_at(k)[1] if self._slots is not None else 0.0)
        if self._on_air is not None:
            delay += max(0, self._wait_again(k)) * self._ts
        if delay + c.jitter + c.duplicate == 0.0:
            return 0.0, -1.0
        u_delay, u_twice, u_copy, _ = self._random_delays.at(k)
        return delays_of(k, u_delay, u_twice, u_copy, delay, c.jitter, c.duplicate, c.lifetime, self._ts)

    def _wait_again(self, k: int) -> int:
        """Slots that the message of slot `k` waits for others that are sent again, GIVEN_UP if it never comes."""
        c = self._parameters
        return self._again.wait(k, whole_slots(c.resend_after / self._ts), c.history)

    def _sent_again(self, k: int) -> SlotOutcome:
        assert self._on_air is not None
        wait = self._wait_again(k)
        found = self._causes[k] if k in self._causes else self._on_air.outcome(k)
        self._causes = {j: outcome for j, outcome in self._causes.items() if j >= k}
        return found if wait == GIVEN_UP else found._replace(lost=False, cause="")

    def _is_lost_on_air(self, k: int) -> bool:
        assert self._on_air is not None
        self._causes[k] = self._on_air.outcome(k)
        return self._causes[k].lost

    def _segment(self, k: int) -> Segment:
        if len(self._segments) == 1:
            return self._segments[0]
        return self._segments[bisect.bisect_right(self._firsts, k) - 1]

    def _by_place(self, k: int, x: float, y: float) -> SlotOutcome:
        levels, u = levels_of(self._segment(k).channel), self._random.at(k)[0]
        lost, gain = outcome_at(self._kind, self._spatial_table, *levels, u, x, y)
        return SlotOutcome(lost, self.parameters.model if lost else "", GOOD, gain)

    def _by_slot(self, k: int) -> SlotOutcome:
        if self._model is None:
            lost = self._measured_at(k)[0] != 0.0
            return SlotOutcome(lost, TRACE if lost else "")
        if k < self._next - 1:
            self._next, self._state = 0, GOOD
        if k - self._next > _FAR:
            self._skip_to(k)
        while self._next <= k:
            before = self._state
            try:
                lost, self._state = self._model(
                    self._segment(self._next).channel, self._next, self._random.at(self._next), before
                )
            except Exception as error:  # another package's model, in which anything can go wrong
                raise ChannelError(f"channel model {self.parameters.model}, slot {self._next}: {error}") from error
            self._last = SlotOutcome(bool(lost), self.parameters.model if lost else "", before)
            self._next += 1
        return self._last

    def _skip_to(self, k: int) -> None:
        """Go on with slot k, which is far ahead, if the state there can be told without all slots before it.

        Both states are followed from some slots before k on: where they have become one, it is that one, whatever was
        before (coupling from the past, Propp and Wilson 1996). Without memory that is so in the first of them.
        """
        model = self._model
        if self.parameters.model not in _TWO_STATES or model is None:
            return
        length = _FAR
        while (first := k - length) > self._next:
            good, bad = GOOD, _BAD
            for j in range(first, k):
                channel, u = self._segment(j).channel, self._random.at(j)
                good, bad = model(channel, j, u, good)[1], model(channel, j, u, bad)[1]
                if good == bad:
                    self._next, self._state = j + 1, good
                    return
            length *= 4

    def _measured_at(self, k: int) -> tuple[float, float]:
        """Lost (0 or 1) and time under way [s] of slot k; those around it are looked up with it.

        Not those behind the end of a trace that may not be outrun: that it ends is said of the slot behind it.
        """
        assert self._slots is not None
        if k not in self._measured:
            first = k - k % _BLOCK
            try:
                rows = self._slots.rows(first, _BLOCK)
            except TraceError:
                first, rows = k, self._slots.rows(k, 1)
            self._measured = {first + i: (row[0], row[1]) for i, row in enumerate(rows.tolist())}
        return self._measured[k]


def check_length(parameters: ChannelParameters, seed: int, stream: str, steps: float, ts: float) -> None:
    """Is a trace that may not be outrun long enough for a run of `steps`? Raises TraceError before the run if not."""
    if parameters.model == TRACE and math.isfinite(steps):
        MeasuredSlots(parameters, seed, stream, ts).rows(max(0, round(steps) - 1), 1)


def losses(
    parameters: ChannelParameters, seed: int, stream: str, steps: int, ts: float = LoopParameters.ts
) -> NDArray[np.bool_]:
    """Outcomes of the slots 0 .. steps - 1 of an AGV that is nowhere, True where lost, shape (steps,)."""
    channel = Channel(parameters, seed, stream, ts)
    return np.fromiter((channel.lost(k) for k in range(steps)), dtype=np.bool_, count=steps)
