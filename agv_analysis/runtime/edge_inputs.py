"""What came to the edge in a recording, slot by slot, as it came over the wire; and the answers to it, step by step."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from agv_analysis.bags import read_bag
from agv_analysis.recordings.recording import TOPICS, loop_topics
from agv_analysis.run import Floats, Run
from agv_ros.codec import decode_slot, stamp_of
from agv_ros.errors import UserError
from agv_ros.messages import Command, InvalidMessageError, TrackingError
from agv_ros.stamps import Grid, OffGridError

AGV_TOPICS = tuple(topic for topic in TOPICS if topic.startswith("agv/"))
"""The loop's topics on the AGV's side of the radio."""


class SlotInput(NamedTuple):
    """What the edge got in one slot, as it came over the wire."""

    k: int
    stamp_ns: int
    slot: bytes
    pose: bytes | None
    """The fresher pose that came in this slot, None if none did."""
    is_answered: bool
    """Is the pose that the slot names in the recording, so that the edge can answer it?"""
    agv_side: tuple[tuple[str, bytes], ...] = ()
    """Recorded messages of the step on the AGV's side of the radio, by topic."""


class EdgeInputs(NamedTuple):
    """All that came to the edge, by increasing step."""

    source: str
    """The recording."""
    namespace: str
    slots: tuple[SlotInput, ...]


def read_inputs(path: Path, grid: Grid, namespace: str | None = None) -> EdgeInputs:
    """Recorded slots and forwarded poses of one loop; of a step that is repeated, the first of each.

    Raises UserError if the bag cannot be read or holds none.
    """
    bag = read_bag(path, topics=())
    names = loop_topics(bag, path, namespace)
    if "edge/pose" not in names:
        raise UserError(f"{path}: has no topic edge/pose, without which nothing can be replayed: record it, too")
    poses, slots = (_by_step(bag.payloads(names[topic]), grid) for topic in ("edge/pose", "edge/slot"))
    if not slots:
        raise UserError(f"{path}: no slot of {names['edge/slot']} is one of the parameters' sampling instants")
    agv_side = {topic: _by_step(bag.payloads(names[topic]), grid) for topic in AGV_TOPICS if topic in names}
    inputs = tuple(
        slot._replace(agv_side=tuple((topic, data[slot.k]) for topic, data in agv_side.items() if slot.k in data))
        for slot in inputs_of(slots, poses, grid)
    )
    return EdgeInputs(str(path), names["edge/slot"].removesuffix("edge/slot").strip("/"), inputs)


def _by_step(payloads: Iterable[bytes], grid: Grid) -> dict[int, bytes]:
    found: dict[int, bytes] = {}
    for data in payloads:
        try:
            found.setdefault(grid.step(stamp_of(data)), data)
        except (InvalidMessageError, OffGridError):  # reported by the reader of the run
            continue
    return dict(sorted(found.items()))


def inputs_of(slots: Mapping[int, bytes], poses: Mapping[int, bytes], grid: Grid) -> Iterator[SlotInput]:
    """What the edge gets in each slot, from slots and forwarded poses by increasing step; damaged slots are dropped.

    A pose comes in the first slot that names it as the freshest: a late one in the slot of its arrival.
    """
    sent: set[int] = set()
    stamps = {grid.stamp(k): k for k in poses}
    for k, data in slots.items():
        try:
            slot = decode_slot(data)
        except InvalidMessageError:
            continue
        freshest, pose = slot.freshest_ns, None
        if freshest not in sent and freshest in stamps:
            pose = poses[stamps[freshest]]
            sent.add(freshest)
        yield SlotInput(k, slot.stamp_ns, data, pose, freshest in sent)


def aligned_answers(
    run: Run, inputs: EdgeInputs, errors: Mapping[int, TrackingError], commands: Mapping[int, Command]
) -> tuple[Run, Floats, Floats]:
    """The run, without the answers that cannot be repeated, and the edge's new answers, for `compare_answers`."""
    answerable = np.isin(run.k, [slot.k for slot in inputs.slots if slot.is_answered])[:, None]
    error, command = np.full((len(run), 3), np.nan), np.full((len(run), 2), np.nan)
    for row, k in enumerate(run.k.tolist()):
        if k in errors:
            error[row] = errors[k].x_e, errors[k].y_e, errors[k].theta_e
        if k in commands:
            command[row] = commands[k].v, commands[k].w
    recorded = dataclasses.replace(
        run, error=np.where(answerable, run.error, np.nan), command=np.where(answerable, run.command, np.nan)
    )
    return recorded, error, command
