"""Outages of a recording as a channel for other runs: files for the channel `trace`, and a scenario that uses them."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agv_analysis.output_file import output_file
from agv_analysis.run import Run
from agv_analysis.scenario import Scenario
from agv_ros.counted import counted
from agv_ros.errors import UserError


def write_outages(path: Path, run: Run, downlink: bool = False) -> int:
    """Write the outcomes of one link to a CSV file for the channel `trace`; returns the number of slots lost.

    Row 0 is the first slot recorded. Raises UserError if slots are missing, or for a path that cannot be written.
    """
    topic, lost = ("agv/slot", run.downlink_lost) if downlink else ("edge/slot", run.lost)
    gaps = int(run.k[-1] - run.k[0]) + 1 - len(run) + run.unexplained.get(topic, 0)
    if gaps:
        raise UserError(
            f"{run.source}: {counted(gaps, f'slot of {topic} is', f'slots of {topic} are')} missing, "
            "so it is not known "
            "whether they were lost"
        )
    try:
        _write(path, lost)
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None
    return int(np.count_nonzero(lost))


def _write(path: Path, lost: NDArray[np.bool_]) -> None:
    with open(output_file(path), "w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(("k", "lost"))
        rows.writerows(enumerate(lost.astype(int).tolist()))


def with_outages_of(run: Run, scenario: Scenario, folder: Path) -> Scenario:
    """`scenario` in lockstep, for as long as the run and with the outcomes of both its links, in files in `folder`.

    Raises UserError if the recording does not begin with step 0 or slots are missing.
    """
    if run.k[0] != 0:
        raise UserError(f"{run.source}: begins with step {run.k[0]}, so its outages do not fit a run from step 0 on")
    plant = dataclasses.replace(scenario.plant, duration=len(run) * run.ts, clock="lockstep")
    uplink, downlink = (folder / f"{link}.csv" for link in ("uplink", "downlink"))
    write_outages(uplink, run)
    write_outages(downlink, run, downlink=True)
    relay = dataclasses.replace(
        scenario.relay,
        uplink=dataclasses.replace(scenario.relay.uplink, model="trace", trace_file=str(uplink)),
        downlink=dataclasses.replace(scenario.relay.downlink, model="trace", trace_file=str(downlink)),
    )
    return dataclasses.replace(scenario, plant=plant, relay=relay)
