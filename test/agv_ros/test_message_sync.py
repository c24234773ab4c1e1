"""Joining slots with messages: the same answers in whatever order the two topics arrive."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_ros.message_sync import MOST_WAITING, Joined, MessageSync
from agv_ros.messages import DELIVERED, LOST, Slot

START, TS = 1_000_000_000, 5_000_000


class Message(NamedTuple):
    """A stamped message that knows which run it is of."""

    stamp_ns: int
    run: int = 0


def t(k: int) -> int:
    return START + k * TS


class Schedule(NamedTuple):
    """What the channel did to the slots 0, 1, ... of one run: lost, delivered, or delivered but unusable."""

    fates: str  # "x" lost, "." delivered, "!" delivered, but nothing that can be used
    run: int = 0

    def messages(self) -> list[Message | int]:
        """In the order of their topic; of an unusable message only the stamp is known."""
        known: list[Message | int] = []
        for k, fate in enumerate(self.fates):
            if fate == ".":
                known.append(Message(t(k), self.run))
            elif fate == "!":
                known.append(t(k))
        return known

    def slots(self) -> list[Slot]:
        freshest, slots = 0, []
        for k, fate in enumerate(self.fates):
            freshest = freshest if fate == "x" else t(k)
            slots.append(Slot(t(k), freshest, LOST if fate == "x" else DELIVERED))
        return slots

    def answers(self) -> list[tuple[int, Message | None]]:
        """By definition: each slot with the last usable message up to it."""
        usable = [self.fates.rfind(".", 0, k + 1) for k in range(len(self.fates))]
        return [(t(k), None if j < 0 else Message(t(j), self.run)) for k, j in enumerate(usable)]


def feed(join: MessageSync[Message], event: Message | int | Slot) -> Iterator[tuple[int, Message | None]]:
    joined: list[Joined[Message]]
    if isinstance(event, Slot):
        joined = join.add_slot(event)
    elif isinstance(event, Message):
        joined = join.add_message(event)
    else:
        joined = join.reject(event)
    return ((one.slot.stamp_ns, one.message) for one in joined)


def merged(turns: list[bool], a: list[Message | int], b: list[Slot]) -> Iterator[Message | int | Slot]:
    """One of all the orders in which two topics can arrive, each of which keeps its own order."""
    i = j = 0
    for turn in [*turns, *[True] * len(a), *[False] * len(b)]:
        if turn and i < len(a):
            yield a[i]
            i += 1
        elif not turn and j < len(b):
            yield b[j]
            j += 1


turns = st.lists(st.booleans(), max_size=80)
first_delivered = st.text(alphabet="..x!", max_size=40).map(lambda rest: "." + rest)
any_fates = st.text(alphabet="..x!", min_size=1, max_size=40)


@settings(deadline=None, derandomize=True, max_examples=300)
@given(first_delivered, turns)
def test_every_order_of_arrival_has_the_same_answers(fates: str, order: list[bool]) -> None:
    schedule, join = Schedule(fates), MessageSync[Message](START)
    events = list(merged(order, schedule.messages(), schedule.slots()))
    assert [answer for event in events for answer in feed(join, event)] == schedule.answers()
    assert (join.outdated, join.unanswered) == (0, 0)


@settings(deadline=None, derandomize=True, max_examples=300)
@given(any_fates.filter(lambda fates: fates[0] != "x"), turns)
def test_a_run_may_begin_with_a_message_that_cannot_be_used(fates: str, order: list[bool]) -> None:
    schedule, join = Schedule(fates), MessageSync[Message](START)
    events = merged(order, schedule.messages(), schedule.slots())
    assert [answer for event in events for answer in feed(join, event)] == schedule.answers()


@settings(deadline=None, derandomize=True, max_examples=300)
@given(first_delivered, first_delivered, turns, turns)
def test_a_second_run_hears_nothing_of_the_first(a: str, b: str, order: list[bool], again: list[bool]) -> None:
    """The plant is started again: both topics begin anew, either may be first."""
    join = MessageSync[Message](START)
    for schedule, turns_of_run in ((Schedule(a, 1), order), (Schedule(b, 2), again)):
        events = merged(turns_of_run, schedule.messages(), schedule.slots())
        assert [answer for event in events for answer in feed(join, event)] == schedule.answers()


@settings(deadline=None, derandomize=True, max_examples=200)
@given(st.text(alphabet=".x", min_size=1, max_size=30), st.integers(0, 1000), turns)
def test_a_node_that_joins_a_running_loop(fates: str, k: int, order: list[bool]) -> None:
    """Slots from step k on; what was delivered before is unknown, until the first fresh message."""
    join = MessageSync[Message](START - (k + 1) * TS)
    schedule = Schedule("." + fates)
    events = merged(order, schedule.messages()[1:], schedule.slots()[1:])
    answers = [answer for event in events for answer in feed(join, event)]
    blind = len(fates) - len(fates.lstrip("x"))
    assert answers == schedule.answers()[1 + blind :]


@pytest.mark.parametrize("slot_first", [True, False])
def test_what_a_run_left_behind_is_not_taken_for_the_next_one_s(slot_first: bool) -> None:
    join = MessageSync[Message](START)
    begin: list[Message | Slot] = [Message(t(0), 1), Slot(t(0), t(0), DELIVERED)]
    left_behind: list[Message | Slot] = [*(begin[::-1] if slot_first else begin), Message(t(2), 1)]
    for event in left_behind:  # slot 2 never comes: the run ends
        list(feed(join, event))
    for slot in Schedule("...").slots():
        assert not join.add_slot(slot)
    answers = [answer for message in Schedule("...", 2).messages() for answer in feed(join, message)]
    assert answers == Schedule("...", 2).answers()


def test_a_run_that_begins_with_an_unusable_message_does_not_go_on_with_the_last_run_s() -> None:
    join = MessageSync[Message](START)
    events: list[Message | int | Slot] = [Message(t(0)), Slot(t(0), t(0), DELIVERED), t(0)]
    for event in events:
        list(feed(join, event))
    assert [one.message for one in join.add_slot(Slot(t(0), t(0), DELIVERED))] == [None]


def test_a_slot_waits_for_the_message_that_it_names() -> None:
    join = MessageSync[Message](START)
    assert not join.add_slot(Slot(t(0), t(0), DELIVERED))
    assert not join.add_slot(Slot(t(1), t(0), LOST))
    joined = join.add_message(Message(t(0)))
    assert [(one.slot.stamp_ns, one.message) for one in joined] == [(t(0), Message(t(0))), (t(1), Message(t(0)))]


def test_a_slot_before_any_message_is_answered_with_none() -> None:
    join = MessageSync[Message](START)
    assert [one.message for one in join.add_slot(Slot(t(0), 0, LOST))] == [None]


def test_a_slot_whose_message_never_comes_is_passed_over_and_counted() -> None:
    join = MessageSync[Message](START)
    join.add_message(Message(t(0)))
    join.add_slot(Slot(t(0), t(0), DELIVERED))
    assert not join.add_slot(Slot(t(1), t(1), DELIVERED))
    assert not join.add_slot(Slot(t(2), t(1), LOST))
    join.add_message(Message(t(3)))
    assert [one.message for one in join.add_slot(Slot(t(3), t(3), DELIVERED))] == [Message(t(3))]
    assert (join.unanswered, join.outdated) == (2, 0)
    assert not join.add_message(Message(t(1)))
    assert not join.add_slot(Slot(t(2), t(1), LOST))
    assert (join.unanswered, join.outdated) == (2, 2)


def test_a_repeated_message_changes_nothing_and_a_repeated_slot_is_answered_alike() -> None:
    join = MessageSync[Message](START)
    for k in range(3):
        join.add_message(Message(t(k)))
        join.add_message(Message(t(k)))
        first = join.add_slot(Slot(t(k), t(k), DELIVERED))
        again = join.add_slot(Slot(t(k), t(k), DELIVERED)) if k else first
        assert [one.message for one in first] == [one.message for one in again] == [Message(t(k))]


def test_step_0_repeated_is_answered_again_and_the_loop_goes_on() -> None:
    join = MessageSync[Message](START)
    for _ in range(3):
        join.add_message(Message(t(0)))
        assert [one.message for one in join.add_slot(Slot(t(0), t(0), DELIVERED))] == [Message(t(0))]
    # The answer to the repeated step and the next one may be in flight together.
    join.add_message(Message(t(0)))
    join.add_message(Message(t(1)))
    assert [one.message for one in join.add_slot(Slot(t(0), t(0), DELIVERED))] == [Message(t(0))]
    assert [one.message for one in join.add_slot(Slot(t(1), t(1), DELIVERED))] == [Message(t(1))]


def test_a_usable_message_stands_against_a_rejected_one_of_the_same_stamp() -> None:
    join = MessageSync[Message](START)
    join.add_message(Message(t(0)))
    join.reject(t(0))
    assert [one.message for one in join.add_slot(Slot(t(0), t(0), DELIVERED))] == [Message(t(0))]


@pytest.mark.parametrize("k", [0, 5, 10**9])
def test_a_stray_rejected_message_does_no_harm(k: int) -> None:
    join = MessageSync[Message](START)
    for step in range(4):
        join.add_message(Message(t(step)))
        if step == 2:
            join.add_message(Message(t(3)))
            join.reject(t(k))
        assert [one.message for one in join.add_slot(Slot(t(step), t(step), DELIVERED))] == [Message(t(step))]


@pytest.mark.parametrize("slots_first", [True, False])
def test_all_that_a_subscription_may_have_unread_can_come_before_the_other_topic(slots_first: bool) -> None:
    join, schedule = MessageSync[Message](START), Schedule("..x." * (MOST_WAITING // 4))
    topics: list[list[Message | int | Slot]] = [[*schedule.messages()], [*schedule.slots()]]
    events = [event for topic in (topics[::-1] if slots_first else topics) for event in topic]
    assert [answer for event in events for answer in feed(join, event)] == schedule.answers()
    assert (join.outdated, join.unanswered) == (0, 0)


def test_a_dead_topic_does_not_let_the_other_fill_the_memory() -> None:
    slots_only, messages_only = MessageSync[Message](START), MessageSync[Message](START)
    for k in range(MOST_WAITING + 50):
        assert not slots_only.add_slot(Slot(t(k), t(k), DELIVERED))
        assert not messages_only.add_message(Message(t(k)))
    assert (slots_only.unanswered, messages_only.outdated) == (50, 50)
    # What is left is the newest, and it is still answered.
    last = MOST_WAITING + 49
    assert [one.slot.stamp_ns for one in slots_only.add_message(Message(t(last)))] == [t(last)]
    assert [one.message for one in messages_only.add_slot(Slot(t(60), t(60), DELIVERED))] == [Message(t(60))]


def test_a_relay_that_was_started_again_leaves_what_is_held() -> None:
    """It names no message before it has passed one on."""
    join: MessageSync[Message] = MessageSync(START)
    assert join.add_slot(Slot(t(0), 0, LOST)) == [Joined(Slot(t(0), 0, LOST), None)]
    join.add_message(Message(t(1)))
    join.add_slot(Slot(t(1), t(1), DELIVERED))
    (joined,) = join.add_slot(Slot(t(2), 0, LOST))
    assert (joined.slot.stamp_ns, joined.message) == (t(2), Message(t(1)))
    assert join.add_slot(Slot(t(3), t(3), DELIVERED)) == []
    assert join.add_slot(Slot(t(4), 0, LOST)) == []  # step 3's message is under way
    assert [(j.slot.stamp_ns, j.message) for j in join.add_message(Message(t(3)))] == [
        (t(3), Message(t(3))), (t(4), Message(t(3))),
    ]  # fmt: skip
    assert (join.outdated, join.unanswered) == (0, 0)
