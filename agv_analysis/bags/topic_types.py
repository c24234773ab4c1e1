"""Which definition the messages of a topic have, where the bag leaves that open.

It does so where it names a type without defining it, of which several definitions are known or none, and where it does
not tell how wide the characters of wstrings are. All messages of the topic decide then, for which they are read once
more: the first ones may be all zeros, or have only empty sequences. A definition is believed if it describes more of
them than any other, and more than half. If that leaves several, the topic is not decoded: a number that may be wrong
is worse than none.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agv_analysis.bags.bag_errors import UndecodableError
from agv_analysis.bags.findings import Findings
from agv_analysis.bags.known_types import UNDEFINED, Definition, KnownTypes, no_definition
from agv_analysis.bags.layout import BODY, LEAD
from agv_analysis.bags.message_batch import NO_DEFINITION, Batch, Layouts
from agv_analysis.bags.message_compression import inflated_batches
from agv_analysis.bags.records import TYPE_HASH, Channel, Schema
from agv_analysis.bags.rosbag2 import Contents, open_files
from agv_analysis.bags.storage import Storage

_MEMBERLESS = BODY - LEAD + 4
"""Most bytes of a message without members: encapsulation, the zero that stands for a member, padding to 4 bytes."""

_Key = tuple[str, str]
"""Topic, and name of its type."""


class TopicTypes:
    """Definitions of the topics of one bag."""

    def __init__(self, contents: Contents, known: KnownTypes, is_thorough: bool = False) -> None:
        """`is_thorough`: even a single definition from elsewhere is held against all messages before it is used."""
        self._contents = contents
        self._known = known
        self._is_thorough = is_thorough
        self._held: dict[_Key, _Held] = {}

    def named(self, storage: Storage, channel: Channel) -> Schema | None:
        """What the bag says of a channel's type; by its name alone, if only metadata.yaml does."""
        kind = self._contents.types.get(channel.topic)
        return storage.schemas.get(channel.schema_id) or (Schema(0, kind, "", b"") if kind else None)

    def without_messages(self, storage: Storage, channel: Channel) -> Definition:
        """The definition of a channel that has no messages: the newest that is possible. Raises UndecodableError."""
        return self._candidates(storage, channel)[0]

    def define(self, storage: Storage, channel: Channel, batch: Batch) -> Definition:
        """The definition of a channel with these messages, and maybe others.

        Raises UndecodableError if none is known that describes them, or several are.
        """
        candidates = self._candidates(storage, channel)
        if not self._is_open(candidates) and (not candidates[0].source or _describes(candidates[0], batch.after(0, 1))):
            return candidates[0]
        if candidates[0].is_guess and not _describes(candidates[0], batch):
            raise UndecodableError(no_definition())
        key = _key(channel, candidates)
        if key not in self._held:
            self._hold(key)
        if key not in self._held:  # the bag describes this channel in several ways
            self._held[key] = _Held(candidates)
            self._held[key].take(batch)
        return self._held[key].chosen()

    def _candidates(self, storage: Storage, channel: Channel) -> list[Definition]:
        schema = self.named(storage, channel)
        if schema is None:
            raise UndecodableError(NO_DEFINITION)
        distro = storage.distro or self._contents.distro
        return self._known.candidates(schema, distro, channel.metadata.get(TYPE_HASH, ""))

    def _is_open(self, candidates: list[Definition]) -> bool:
        first = candidates[0]
        return len(candidates) > 1 or first.is_guess or (self._is_thorough and first.source != "")

    def _hold(self, wanted: _Key) -> None:
        """Read all messages of topics that are open, and of the one that is wanted."""
        found: dict[_Key, _Held] = {}
        for storage in open_files(Contents(self._contents.files)):
            asked: dict[int, tuple[Channel, list[Definition]]] = {}

            def is_asked(
                channel: Channel, storage: Storage = storage, asked: dict[int, tuple[Channel, list[Definition]]] = asked
            ) -> bool:
                if channel.id not in asked or asked[channel.id][0] is not channel:
                    asked[channel.id] = channel, self._asked(storage, channel, wanted)
                return bool(asked[channel.id][1])

            for channel, batch in inflated_batches(storage, is_asked, Findings()):
                candidates = asked[channel.id][1]
                if not candidates:  # the bag has described the channel anew meanwhile
                    continue
                key = _key(channel, candidates)
                if key not in found:
                    found[key] = _Held(candidates)
                found[key].take(batch)
        self._held.update(found)

    def _asked(self, storage: Storage, channel: Channel, wanted: _Key) -> list[Definition]:
        """Definitions that the messages of a channel are to be held against, none if they are not read for that."""
        if channel.encoding != "cdr":
            return []
        try:
            candidates = self._candidates(storage, channel)
        except UndecodableError:
            return []
        key = _key(channel, candidates)
        return candidates if key == wanted or (self._is_open(candidates) and key not in self._held) else []


def _key(channel: Channel, candidates: list[Definition]) -> _Key:
    return channel.topic, candidates[0].schema.name


def _describes(definition: Definition, batch: Batch) -> bool:
    """Does a definition describe all these messages?"""
    held = _Held([definition])
    held.take(batch)
    return held.misfits == [0]


class _Held:
    """Definitions, held against the messages of a topic."""

    def __init__(self, candidates: Sequence[Definition]) -> None:
        self._candidates = candidates
        self._layouts = [Layouts(candidate.form) for candidate in candidates]
        self._count = 0
        self.misfits = [0] * len(candidates)
        """Messages that each does not describe."""

    def take(self, batch: Batch) -> None:
        """Hold a batch against all definitions."""
        self._count += len(batch)
        for number, (candidate, layouts) in enumerate(zip(self._candidates, self._layouts, strict=True)):
            if candidate.is_guess:
                short = batch.at(np.flatnonzero(batch.sizes <= LEAD + _MEMBERLESS))
                self.misfits[number] += len(batch) - sum(map(_is_memberless, short.payloads()))
                continue
            before = layouts.misfits
            try:
                layouts.split(batch)
                self.misfits[number] += layouts.misfits - before
            except UndecodableError:  # the type has no members, the messages do
                self.misfits[number] += len(batch)

    def chosen(self) -> Definition:
        """The definition that describes the messages. Raises UndecodableError if that is none, or several."""
        fewest = min(self.misfits)
        best = [number for number, misfits in enumerate(self.misfits) if misfits == fewest]
        first = self._candidates[best[0]]
        if first.is_guess and fewest:
            raise UndecodableError(no_definition())
        sources = ", ".join(dict.fromkeys(candidate.source for candidate in self._candidates))
        if 2 * fewest >= self._count and first.source:
            raise UndecodableError(f"{UNDEFINED}, and that of {sources} does not describe its messages")
        rivals = [n for n in best if not self._is_same(n, best[0])]
        if rivals and fewest < self._count:
            if all(self._candidates[n].schema == first.schema for n in rivals):
                raise UndecodableError("its wstrings may have 2 or 4 bytes a character, its messages fit both")
            sources = ", ".join(dict.fromkeys(self._candidates[n].source for n in best))
            raise UndecodableError(f"{UNDEFINED}, and there are several that describe its messages ({sources})")
        return first

    def _is_same(self, one: int, other: int) -> bool:
        """Do two definitions of the same words find the same values in all messages that were met?"""
        is_one = self._candidates[one].schema == self._candidates[other].schema
        return is_one and self._layouts[one].places == self._layouts[other].places


def _is_memberless(payload: bytes) -> bool:
    """May these be the bytes of a message without members?"""
    head = BODY - LEAD
    return head < len(payload) <= _MEMBERLESS and payload[0] == 0 and payload[1] <= 1 and not any(payload[head:])
