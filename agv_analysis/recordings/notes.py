"""What a reader must know of a recording of the loop, a sentence each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from agv_analysis.bags import Bag
from agv_analysis.bags.writer import METADATA_NAME, REPLAY_OF
from agv_analysis.metrics.convergence import body_errors, wrapped
from agv_analysis.recordings.messages_on_steps import OnSteps
from agv_analysis.run import Run

_SAME_ERROR = 1e-6
"""Largest difference [m, rad] between a recorded tracking error and the one that follows from track and pose."""


def of_replay(bag: Bag) -> Iterator[str]:
    """Is it the recording of a replay?"""
    source = bag.metadata.get(METADATA_NAME, {}).get(REPLAY_OF)
    if source is not None:
        yield f"a replay of {source}: errors and commands are new, but the AGV moves as it did there, whatever they are"


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
            yield f"{names[topic]}: {messages.off_grid} messages are no sampling instant's, they are left out"
        if messages.unusable:
            yield f"{names[topic]}: {messages.unusable} messages with numbers that no node takes, they are left out"
        if messages.repeated:
            yield f"{names[topic]}: {messages.repeated} messages repeat a step, the first of each counts"


def of_mismatch(run: Run) -> Iterator[str]:
    """A warning if the recorded errors do not belong to the track that the parameters name."""
    held = np.searchsorted(run.k, run.k - run.n_ul)
    known = (held < len(run)) & np.isfinite(run.error[:, 0])
    known[known] &= run.k[held[known]] == (run.k - run.n_ul)[known]
    eps = body_errors(run.reference[known], run.sent_pose[held[known]])
    difference = run.error[known] - eps
    difference[:, 2] = wrapped(difference[:, 2])
    scale = 1.0 + np.abs(run.sent_pose[held[known], :2]).max(axis=1, initial=0.0)
    wrong = np.count_nonzero(np.abs(difference).max(axis=1, initial=0.0) > _SAME_ERROR * scale)
    if wrong:
        yield (
            f"{wrong} of {len(eps)} recorded errors do not fit the track in the parameters: are these the run's "
            "parameters, and did anything else publish poses?"
        )
