"""Outcomes of a channel on a whole run, compiled: those of `agv_plant.radio.channel.Channel`, bit for bit.

The same models and the same random numbers; only the loop over the slots differs, since the relay evaluates one slot at
a time.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections import namedtuple
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import compiled, numbers
from agv_analysis.simulation.link_loop import LinkInputs
from agv_analysis.simulation.noise import normals
from agv_plant.channels.model import GOOD
from agv_plant.channels.position_dependent import kind_of
from agv_plant.channels.registry import MODELS, SHARED, TRACE, find_model
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import Channel, MeasuredSlots, delay_draws, draws, on_air, own_stream
from agv_plant.radio.channel_setup import Segment, levels_of, segments_of, spatial_table_of
from agv_plant.radio.delay import NEVER, delays_of, soonest, whole_slots
from agv_plant.radio.retransmission import AHEAD, GIVEN_UP, waits_of
from agv_plant.radio.schedule import is_scripted
from agv_plant.radio.shared_uplink import SCHEDULERS, serve_all, stream_of
from agv_plant.random_stream import uniforms
from agv_ros.parameters import LoopParameters

Outcomes = NDArray[np.bool_]
States = NDArray[np.int64]

_NUMERIC = [field.name for field in dataclasses.fields(ChannelParameters) if not isinstance(field.default, str)]
_Numbers = namedtuple("_Numbers", _NUMERIC)  # type: ignore[misc]  # numba knows tuples, not dataclasses


class ChannelRealisation:
    """Channels under one seed; keeps the random numbers and the latest outcomes, which many runs share."""

    def __init__(self, seed: int, steps: int, ts: float = LoopParameters.ts) -> None:
        self._steps = steps
        self._seed = seed
        self._ts = ts
        self._shared = functools.cache(lambda stream: uniforms(seed, stream, 0, steps))
        self._outcomes = functools.lru_cache(maxsize=128)(self._compute)
        self._link_inputs = functools.lru_cache(maxsize=8)(self._make_link_inputs)
        self.normals = functools.cache(lambda stream: normals(seed, stream, steps))
        """Normal numbers of a stream of the AGV's, shape (steps, DRAWS)."""

    def outcomes(self, channel: ChannelParameters, stream: str) -> Outcomes:
        """Outcomes of the slots 0 .. steps - 1, True where lost, shape (steps,); not to be written to.

        Of a channel that asks for the place: what is lost wherever the AGV is.
        """
        return self._outcomes(channel, stream)

    def outcomes_and_states(self, channel: ChannelParameters, stream: str) -> tuple[Outcomes, States]:
        """Outcomes, and the state that decided each, of a channel with memory; shapes (steps,). Neither is kept."""
        states = np.full(self._steps, GOOD, dtype=np.int64)
        return self._compute(channel, stream, states), states

    def link_inputs(self, channel: ChannelParameters, stream: str) -> LinkInputs:
        """All that a link needs to be asked slot by slot."""
        return self._link_inputs(channel, stream)

    def _make_link_inputs(self, channel: ChannelParameters, stream: str) -> LinkInputs:
        lost, random = self.outcomes(channel, stream), self._draws(channel, stream)
        return link_inputs(channel, self._seed, stream, lost, random, self._ts)

    def _compute(self, channel: ChannelParameters, stream: str, states: States | None = None) -> Outcomes:
        """Outcomes, and into `states` the states that decided."""
        states = np.empty(self._steps, dtype=np.int64) if states is None else states
        lost = np.zeros(self._steps, dtype=np.bool_)
        if channel.reliable:
            lost[:] = waits_for_others(channel, self._seed, stream, self._steps, self._ts) == GIVEN_UP
            states[:] = _below(channel, self._seed, stream, self._steps, self._ts)[1][: self._steps]
        elif channel.model == TRACE:
            lost[:] = MeasuredSlots(channel, self._seed, stream, self._ts).rows(0, self._steps)[:, 0]
        elif channel.model == SHARED:
            self._serve(channel, stream, lost)
        elif channel.model != "perfect" and not channel.is_placed:
            try:
                self._ask(channel, stream, lost, states)
            except Exception:
                if channel.model in MODELS:
                    raise
                # Another package's model may be more than numba compiles: slot by slot it is the same, or says why not.
                return _one_by_one(Channel(channel, self._seed, stream, self._ts), states)
        for segment, end in _segments(channel, self._steps, self._ts):
            if segment.outage.length > 0.0 and not channel.reliable:
                compiled(_script)(lost, segment.first, end, *segment.outage, self._ts)
            if segment.channel.lifetime < math.inf:
                lost[segment.first : end] |= _slots_under_way(segment, end, self._seed, stream, self._ts) == NEVER
        lost[0] = False  # slot 0 never is
        return lost

    def _serve(self, channel: ChannelParameters, stream: str, lost: Outcomes) -> None:
        """Work out what becomes of the whole fleet."""
        streams = [stream_of(stream, vehicle) for vehicle in range(channel.vehicles)]
        drawn = np.stack([uniforms(self._seed, name, 0, self._steps) for name in streams], axis=2)
        ages, scheduler = np.zeros(channel.vehicles, dtype=np.int64), SCHEDULERS.index(channel.scheduler)
        of_all = np.zeros((self._steps, channel.vehicles), dtype=np.bool_)
        for segment, end in _segments(channel, self._steps, self._ts):
            u, p = drawn[segment.first : end], segment.channel.p
            served = of_all[segment.first : end]
            compiled(serve_all)(segment.first, channel.blocks, scheduler, p, u[:, 0], u[:, 1], ages, served)
        lost[:] = of_all[:, channel.vehicle]

    def _ask(self, channel: ChannelParameters, stream: str, lost: Outcomes, states: States) -> None:
        """Ask the channel's model, slot by slot."""
        compute = compiled(outcomes_of_slots, {model: find_model(channel.model)})
        random, state = numbers(self._draws(channel, stream)), GOOD
        for segment, end in _segments(channel, self._steps, self._ts):
            parameters = _Numbers(*(getattr(segment.channel, name) for name in _NUMERIC))
            state = compute(parameters, random, lost, states, segment.first, end, state)

    def _draws(self, channel: ChannelParameters, stream: str) -> NDArray[np.float64]:
        if channel.correlation == 0.0:
            return self._shared(own_stream(channel, stream))
        return draws(channel, self._seed, stream, 0, self._steps)


def link_inputs(
    channel: ChannelParameters, seed: int, stream: str, lost: Outcomes, random: NDArray[np.float64], ts: float
) -> LinkInputs:
    """A link from what is lost wherever the AGV is, shape (N,), and the channel's random numbers, shape (N, DRAWS)."""
    steps = len(lost)
    levels, waits = np.empty((steps, 2)), np.zeros(steps, dtype=np.int64)
    for segment, end in _segments(channel, steps, ts):
        now = segment.channel
        levels[segment.first : end] = levels_of(now)
        if channel.delays:
            waits[segment.first : end] = _slots_under_way(segment, end, seed, stream, ts)
    waits[waits == NEVER] = 0  # lost, as said
    spatial_table = np.array(
        spatial_table_of(channel, seed, stream) if channel.is_placed else [], dtype=np.float64
    ).reshape(-1, 5)
    return LinkInputs(
        numbers(lost), kind_of(channel.model), numbers(spatial_table), numbers(levels), numbers(random), numbers(waits)
    )


def _slots_under_way(segment: Segment, end: int, seed: int, stream: str, ts: float) -> NDArray[np.int64]:
    """Slots until the messages of a segment's slots arrive, or the first of their copies, NEVER if none does."""
    now, count = segment.channel, end - segment.first
    random = delay_draws(now, seed, stream, segment.first, count)
    delay = np.full(count, now.delay)
    if now.reliable:
        waits = waits_for_others(now, seed, stream, end, ts)
        delay += np.maximum(0, waits[segment.first :]) * ts
    if now.model == TRACE:
        delay += MeasuredSlots(now, seed, stream, ts).rows(segment.first, count)[:, 1]
    found: NDArray[np.int64] = compiled(_waits)(
        numbers(random), segment.first, numbers(delay), now.jitter, now.duplicate, now.lifetime, ts
    )
    return found


@functools.lru_cache(maxsize=16)
def waits_for_others(channel: ChannelParameters, seed: int, stream: str, steps: int, ts: float) -> NDArray[np.int64]:
    """Slots that messages of a reliable channel wait for others that are sent again, GIVEN_UP if lost; shape (N,)."""
    lost = _below(channel, seed, stream, steps, ts)[0]
    return waits_of(lost, whole_slots(channel.resend_after / ts), channel.history)


@functools.lru_cache(maxsize=16)
def _below(channel: ChannelParameters, seed: int, stream: str, steps: int, ts: float) -> tuple[Outcomes, States]:
    """Outcomes and states of the channel below a reliable one, for as long as anything is sent again."""
    return ChannelRealisation(seed, steps + AHEAD, ts).outcomes_and_states(on_air(channel), stream)


def _segments(channel: ChannelParameters, steps: int, ts: float) -> list[tuple[Segment, int]]:
    """Segments of a channel that begin within a run, each with the slot before which it ends."""
    found = [segment for segment in segments_of(channel, ts) if segment.first < steps]
    return list(zip(found, [*(segment.first for segment in found[1:]), steps], strict=True))


def _one_by_one(channel: Channel, states: States) -> Outcomes:
    lost = np.empty(len(states), dtype=np.bool_)
    for k in range(len(states)):
        outcome = channel.outcome(k)
        lost[k], states[k] = outcome.lost, outcome.state
    return lost


model: Any = MODELS["perfect"]
"""Of the channel that `outcomes_of_slots` is made for; by default one that loses nothing."""


def outcomes_of_slots(
    channel: Any, random: Any, lost: Outcomes, states: States, first: int, end: int, state: int
) -> int:
    """Outcomes of the slots first .. end - 1, and the states before them; returns the one after them."""
    for k in range(first, end):
        states[k] = state
        lost[k], state = model(channel, k, random[k], state)
    return state


def _script(lost: Outcomes, first: int, end: int, at: float, length: float, period: float, ts: float) -> None:
    for k in range(first, end):
        lost[k] = lost[k] or is_scripted(k, at, length, period, ts)


def _waits(
    random: Any, first: int, delay: Any, jitter: float, duplicate: float, lifetime: float, ts: float
) -> NDArray[np.int64]:
    waits = np.empty(len(random), dtype=np.int64)
    for i in range(len(random)):
        u_delay, u_twice, u_copy, _ = random[i]
        message, copy = delays_of(first + i, u_delay, u_twice, u_copy, delay[i], jitter, duplicate, lifetime, ts)
        waits[i] = soonest(message, copy)
    return waits
