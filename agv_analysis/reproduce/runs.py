"""The paper's scenario and its runs, simulated or recorded."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable
from pathlib import Path

from agv_analysis.metrics.convergence import Convergence, convergence
from agv_analysis.run import Run
from agv_analysis.scenario import SCHEMAS, Scenario
from agv_analysis.simulation.single import simulate
from agv_ros.errors import UserError
from agv_ros.params_file import resolve

GAINS = (5.0, 25.0, 250.0)
"""The paper's K_x [1/s]."""

LIMIT = 6.0
"""The paper's limit on |v| [m/s]."""

Drive = Callable[[Scenario, str], Run]
"""Drives a scenario; the name is that of its bag."""


def scenario(*settings: str) -> Scenario:
    """The paper's scenario, which is that of all defaults, with settings `node.parameter=value` on top."""
    return Scenario(**resolve(SCHEMAS, {}, settings))


def gain(kx: float, v_max: float = math.inf) -> tuple[str, ...]:
    """Settings of a run with the gain K_x [1/s] and the limit `v_max` [m/s] on |v|."""
    limit = () if math.isinf(v_max) else (f"controller.v_max={v_max}",)
    return (f"controller.kx={kx}", *limit)


class Runs:
    """Runs of the paper's scenario by their settings; each is driven once, when it is first asked for."""

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        self._run = functools.cache(lambda settings: self._drive(scenario(*settings), _name(settings)))
        self._found = functools.cache(lambda settings: convergence(self._run(settings)))

    def run(self, *settings: str) -> Run:
        """The run with these settings."""
        run: Run = self._run(settings)
        return run

    def found(self, *settings: str) -> Convergence:
        """Its convergence."""
        found: Convergence = self._found(settings)
        return found


def simulated() -> Runs:
    """Runs from the simulation."""
    return Runs(lambda wanted, _: simulate(wanted))


def recorded(folder: Path) -> Runs:
    """Runs of the nodes on DDS, each recorded to a bag in `folder` and read from there.

    Raises UserError if the folder exists or a run or its recording fails; ImportError where there is no ROS 2.
    """
    from agv_analysis.recordings.recording import read_run
    from agv_analysis.runtime.runner import run_in_process

    if folder.exists():
        raise UserError(f"{folder}: exists already, with recordings of other runs: remove it or choose another --out")

    def drive(wanted: Scenario, name: str) -> Run:
        outcome = run_in_process(wanted, folder / name, lambda _: None)
        failure = outcome.failure or outcome.recording_failure
        if failure:
            raise UserError(f"{folder / name}: {failure}")
        return read_run(folder / name)

    return Runs(drive)


def _name(settings: tuple[str, ...]) -> str:
    """A name for a bag: the settings without their nodes, and without what a file's name should not hold."""
    short = [re.sub(r"[^\w.=]+", "_", setting.partition(".")[2]).strip("_") for setting in settings]
    return ",".join(short) or "paper"
