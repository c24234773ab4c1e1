"""What a reader must know of a recording of the loop, a sentence each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from agv_analysis.bags import Bag
from agv_analysis.bags.writer import METADATA_NAME, REPLAY_OF
from agv_analysis.recordings.messages_on_steps import OnSteps
from agv_analysis.run import Run
from agv_analysis.stability.driven_commands import driven_commands, wrong_errors
from agv_ros.counted import counted


def of_replay(bag: Bag) -> Iterator[str]:
    """Is it the recording of a replay?"""
    source = bag.metadata.get(METADATA_NAME, {}).get(REPLAY_OF)
    if source is not None:
        yield f"a replay of {source}: errors and commands are new, but the AGV moves as it did there, whatever they are"


def of_foreign_controller(name: str) -> Iterator[str]:
    """Did another package's node give the commands?"""
    if name:
        yield (
            f"{name} gave the commands, which is not the controller of this package: its law is not known, so stability"
            " is not judged; losses, ages and errors are as they were seen"
        )


def of_first_step(run: Run) -> Iterator[str]:
    """Does it begin after the run did?"""
    first = int(run.k[0])
    if first > 0:
        yield (
            f"it begins with step {first}, {first * run.scenario.plant.ts:g} s after the run's beginning: settling and "
            "overshoot are those from there on, of the error that was left"
        )


def of_messages(on_steps: Mapping[str, OnSteps], names: Mapping[str, str]) -> Iterator[str]:
    """Messages that do not become part of the run, by topic."""
    for topic, messages in on_steps.items():
        if messages.off_grid:
            yield (
                f"{names[topic]}: {counted(messages.off_grid, 'message is', 'messages are')} not at a sampling "
                "instant: left out"
            )
        if messages.far:
            yield (
                f"{names[topic]}: {counted(messages.far, 'message has', 'messages have')} stamps far from all "
                "others, they are left out"
            )
        if messages.unusable:
            yield (
                f"{names[topic]}: {counted(messages.unusable, 'message')} with numbers that no node takes, they "
                "are left out"
            )
        if messages.repeated:
            yield (
                f"{names[topic]}: {counted(messages.repeated, 'message repeats', 'messages repeat')} a step, "
                "the first of each counts"
            )


def of_mismatch(run: Run) -> Iterator[str]:
    """A warning if the recorded errors do not belong to the track and the policy that the parameters name."""
    wrong, count = wrong_errors(run)
    if wrong:
        yield (
            f"{wrong} of {count} recorded errors do not fit the track in the parameters: are these the run's "
            "parameters, and did anything else publish poses?"
        )


def of_commands(run: Run) -> Iterator[str]:
    """A warning if the recorded commands are not those of the control law that the parameters name."""
    driven = driven_commands(run)
    if driven.sentence:
        yield driven.sentence
