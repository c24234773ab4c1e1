"""Running a whole scenario on DDS with a process for each node, or a fleet with one for each vehicle."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from agv_analysis.runtime.executables import NODE_MODULES
from agv_analysis.runtime.outcome import Outcome, Progress
from agv_analysis.runtime.run_setup import AS_USUAL, OnDisk, params_file, recording_of, scenario_that_waits
from agv_analysis.runtime.shared_memory import leftovers, remove
from agv_analysis.runtime.speedometer import Speedometer
from agv_analysis.scenario import SCHEMAS, Scenario, load_scenario
from agv_plant.progress_line import progress_line, progress_of
from agv_ros.errors import UserError
from agv_ros.parameters import as_dict
from agv_ros.settling import has_all
from agv_ros.stopping import CLOSED, COUNTS, END, ENDS_WITH_STDIN, MAY_CLOSE, STOPPED_BY, Stop, stop_on_signals

_STOP_TIMEOUT = 20.0
"""How long [s] a process that was asked to stop may take; more than the runner's patience with its recorder."""

_SHORT_TIMEOUT = 0.8
"""Likewise, where another process is gone or halted: it will not say any more what would be waited for."""

_HURRY_TIMEOUT = 1.0
"""How long [s] a process may take that was asked to stop for the second time."""

_SILENCE = 7.0
"""After this time [s] without any message, what is still under way was lost: DDS repeats every 3 s what was missed."""

_SHORT_SILENCE = 0.1
"""Likewise, where a process is gone or halted, to which messages are under way that no one will answer."""

_SETTLED = 0.5
"""A file in shared memory that is younger than this [s] may belong to a process of another run that is starting."""

_LOOK_PERIOD = 0.1
"""How often [s] the processes are looked at while they run."""

_REPORT_PERIOD = 0.2
"""How often [s] a vehicle's process says how far it is."""

_LOG_PREFIX = re.compile(r"^\[[A-Z]+\] \[[0-9.]+\] \[[^]]*\]: ")
"""What rclpy's logging puts before a line: severity, time, node."""


def run_in_processes(scenario: Scenario, bag: Path | None, progress: Progress, on_disk: OnDisk = AS_USUAL) -> Outcome:
    """Run a scenario with one process for each node.

    Raises UserError if a parameter, the track's file or the bag's path cannot be used.
    """
    connected = scenario_that_waits(scenario, recorded=bag is not None)
    with stop_on_signals() as stop, params_file(scenario) as params, params_file(connected) as connected_params:
        nodes: dict[str, _Process] = {}
        try:
            if bag is not None:
                recording = as_dict(recording_of(scenario, bag, params, on_disk))
                nodes["recorder"] = _Process("recorder", _node_command("recorder", params, recording))
            for name in reversed(SCHEMAS):
                nodes[name] = _Process(name, _node_command(name, connected_params, {}), connected.domain_of(name))
            outcome = _watch(nodes, stop, progress)
            return dataclasses.replace(outcome, recording=outcome.recording.removeprefix(f"{bag}: "))
        finally:
            _end(nodes, stop, _STOP_TIMEOUT, _SHORT_SILENCE)
            _clean_up(nodes.values())


def _watch(nodes: dict[str, _Process], stop: Stop, progress: Progress) -> Outcome:
    """Wait for the plant to end, then stop the others, the recorder last."""
    plant, recorder = nodes["plant"], nodes.get("recorder")
    while plant.is_running(_LOOK_PERIOD) and not (stop.requested or any(map(_Process.is_ending, nodes.values()))):
        progress(plant.steps)
    # One that is halted when the plant is done may go on while the plant waits for it.
    while (
        not (plant.is_open() or stop.requested)
        and any(map(_Process.is_halted, nodes.values()))
        and plant.is_running(_LOOK_PERIOD)
    ):
        pass
    ended = [node for node in nodes.values() if node.is_ending()]
    halted = [node for node in nodes.values() if node.is_halted()]
    is_cut_off = bool(halted) or any(node.killed_by for node in ended)
    patience = (_SHORT_TIMEOUT, _SHORT_SILENCE) if is_cut_off else (_STOP_TIMEOUT, _SILENCE)
    _end(nodes, stop, *patience)
    progress(plant.steps)
    recording = recorder.last_line() if recorder else ""
    failed = recorder is not None and recorder.status != 0
    # With status 0 the plant has done all of its steps: what ended before it was not missed.
    failure = "" if plant.status == 0 else _failure(plant, ended, halted, stop)
    return Outcome(plant.steps, plant.pace.rate, failure, "" if failed else recording, recording if failed else "")


def _failure(plant: _Process, ended: Sequence[_Process], halted: Sequence[_Process], stop: Stop) -> str:
    """Why a run has ended before all of its steps were done."""
    if stop.requested:
        return f"interrupted after step {plant.steps}, by {stop.reason}"
    if killed := [node.last_line() for node in ended if node.killed_by]:
        return f"{'; '.join(killed)}, after step {plant.steps}"
    if stopped := [f"{node.name} was {node.stopped}" for node in ended if node.stopped]:
        return f"{'; '.join(stopped)}, after step {plant.steps}"
    said = [node.last_line() if node is plant else f"{node.name} ended: {node.last_line()}" for node in ended]
    return "; ".join([*said, *(f"{node.name} is halted by a signal" for node in halted)])


def _end(nodes: Mapping[str, _Process], stop: Stop, patience: float, silence: float) -> None:
    """End all nodes: first the plant, then, once they have answered what is under way, the others, the recorder last.

    After so much `silence` [s] they are waited for no longer. Until what they have published has arrived, all wait side
    by side: DDS asks for an answer every 3 s only.
    """
    loop, others = [nodes[name] for name in SCHEMAS if name in nodes], [nodes[n] for n in nodes if n not in SCHEMAS]
    for node in loop:
        if node.name == "plant":
            node.let_close()
        node.ask_to_end()
    _await_answers(loop, stop, silence)
    for one in (*loop, *others):
        one.let_close()
    deadline = time.monotonic() + patience
    while any(node.is_open(_LOOK_PERIOD / 10) for node in loop) and time.monotonic() < deadline:
        if stop.insisted or any(node.killed_by for node in loop):
            break
    _end_all([*loop, *others], stop, patience, after_kill=_SHORT_TIMEOUT)


def _await_answers(loop: Sequence[_Process], stop: Stop, silence: float) -> None:
    """Wait until each node has received all that was published, or for so much `silence` [s] nothing more."""
    newest, since = -1, time.monotonic()
    while not stop.insisted and (open_ones := [node for node in loop if node.is_open()]):
        published: Counter[str] = Counter()
        for node in loop:
            published.update(node.published)
        is_known = all(node.received is not None for node in open_ones)
        if is_known and all(has_all(node.received or {}, published) for node in open_ones):
            return
        count = sum(sum((node.received or {}).values()) for node in loop)
        if count != newest:
            newest, since = count, time.monotonic()
        elif time.monotonic() - since > silence:
            return
        time.sleep(_LOOK_PERIOD / 10)


def _end_all(
    processes: Sequence[_Process], stop: Stop, patience: float, after_kill: float = math.inf
) -> None:  # fmt: skip
    """Ask processes to end; after `patience` [s], or as soon as it is insisted on, to hurry; then kill them.

    Once one of them has been killed, the others have `after_kill` [s] at most.
    """
    for timeout, ask in ((patience, _Process.ask_to_end), (_HURRY_TIMEOUT, _Process.hurry)):
        for process in processes:
            ask(process)
        deadline = time.monotonic() + timeout
        while any(process.is_running(_LOOK_PERIOD / 10) for process in processes) and time.monotonic() < deadline:
            if stop.insisted and timeout == patience:
                break
            if any(process.killed_by for process in processes):
                deadline = min(deadline, time.monotonic() + after_kill)
    for process in processes:
        process.collect()


def _clean_up(processes: Iterable[_Process]) -> None:
    """Remove what processes that were killed had in shared memory: later runs could hang on it."""
    if not any(process.killed_by for process in processes):
        return
    remove(leftovers(settled=_SETTLED), _SETTLED)
    # Who still sent to a node that was killed may have made its port anew, a moment ago.
    if any(one.mine for one in leftovers(settled=0.0)):
        time.sleep(_SETTLED)
        remove(leftovers(settled=_SETTLED), _SETTLED)


def run_fleet_in_processes(
    fleet: Mapping[str, Scenario], bag: Path | None, progress: Progress, on_disk: OnDisk = AS_USUAL
) -> list[Outcome]:
    """As `run_fleet`, with one process for each vehicle: its nodes have one, as they cost most where they are apart."""
    for scenario in fleet.values():  # what cannot be used is to be said once
        scenario_that_waits(scenario, recorded=bag is not None)
    with stop_on_signals() as stop, ExitStack() as files:
        vehicles: list[_Process] = []
        try:
            for name, scenario in fleet.items():
                params = files.enter_context(params_file(scenario))
                command = [sys.executable, "-m", "agv_analysis.runtime.processes", name, str(params), str(bag or "")]
                command.append(json.dumps(on_disk))
                vehicles.append(_Process(name, command))
            for vehicle in vehicles:
                while vehicle.is_running(_LOOK_PERIOD) and not stop.requested:
                    progress(sum(other.steps for other in vehicles))
        finally:
            _end_all(vehicles, stop, _STOP_TIMEOUT)
            _clean_up(vehicles)
        outcomes = [_outcome_of(vehicle, stop.requested) for vehicle in vehicles]
        progress(sum(outcome.steps for outcome in outcomes))
        return outcomes


def _outcome_of(vehicle: _Process, stopped: bool) -> Outcome:
    """What a vehicle's process says in its last line, unless something ended it before."""
    try:
        return Outcome(**json.loads(vehicle.last_line()))
    except (ValueError, TypeError):
        failure = f"interrupted after step {vehicle.steps}" if stopped else vehicle.last_line()
        return Outcome(vehicle.steps, vehicle.pace.rate, failure, "", "")


def _drive_vehicle(name: str, params: str, bag: str, on_disk: str) -> None:
    """Body of a vehicle's process: its progress goes to standard output and, as the last line, its Outcome."""
    from agv_analysis.runtime.runner import run_fleet  # nodes and rclpy, which a process that starts others needs not

    scenario = load_scenario(params)
    steps, last_report = scenario.plant.duration / scenario.plant.ts, time.monotonic()

    def report(k: int) -> None:
        nonlocal last_report
        if time.monotonic() - last_report > _REPORT_PERIOD:
            last_report = time.monotonic()
            click.echo(progress_line(k, steps))

    (outcome,) = run_fleet({name: scenario}, Path(bag) if bag else None, report, OnDisk(*json.loads(on_disk)))
    click.echo(json.dumps(dataclasses.asdict(outcome)))


def _node_command(name: str, params: Path, settings: dict[str, Any]) -> list[str]:
    """Command that starts a node."""
    command = [sys.executable, "-m", NODE_MODULES[name], "--ros-args", "--params-file", str(params)]
    for parameter, value in settings.items():
        command += ["-p", f"{parameter}:={json.dumps(value)}"]
    return command


class _Process:
    """One node, or one vehicle, in a process of its own, with its output."""

    def __init__(self, name: str, command: Sequence[str], domain_id: int = -1) -> None:
        self.name = name
        self.steps = 0
        self.pace = Speedometer()
        self.stopped = ""
        """What it said when it was asked to end before it had done its work."""
        self.received: dict[str, int] | None = None
        """Messages by topic that it says have come; None before it was asked to end."""
        self.published: dict[str, int] = {}
        self._has_closed = False
        self._was_asked = False
        self._lines: list[str] = []
        domain = {"ROS_DOMAIN_ID": str(domain_id)} if domain_id >= 0 else {}
        # A session of its own: Ctrl-C reaches the runner alone, which then ends the nodes in order. However the runner
        # itself ends, the system closes its end of the pipe, and so they end, too.
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            start_new_session=True, env={**os.environ, "PYTHONUNBUFFERED": "1", ENDS_WITH_STDIN: "1", **domain},
        )  # fmt: skip
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            text = _LOG_PREFIX.sub("", line.strip())
            steps = progress_of(text)
            if steps is not None:
                self.steps = steps
                self.pace.see(steps)
            if text.startswith(STOPPED_BY):
                self.stopped = text
            if text.startswith(CLOSED):
                self._has_closed = True
            elif text.startswith(COUNTS):
                with contextlib.suppress(ValueError):  # another line has come into it; the next one is whole
                    counts = json.loads(text.removeprefix(COUNTS))
                    self.received, self.published = counts["received"], counts["published"]
            elif steps is None or not text.startswith("step "):  # else it says no more than that
                self._lines.append(text)

    @property
    def status(self) -> int | None:
        """Exit status, None while it runs."""
        return self._process.poll()

    def is_running(self, wait: float = 0.0) -> bool:
        """Does it still run after `wait` [s]?"""
        try:
            self._process.wait(wait)
        except subprocess.TimeoutExpired:
            return True
        return False

    def is_ending(self) -> bool:
        """Has it ended, has it published its last message, or has it been asked to end?"""
        return bool(self.stopped) or not self.is_open()

    def is_open(self, wait: float = 0.0) -> bool:
        """May it still publish after `wait` [s]?"""
        return self.is_running(wait) and not self._has_closed

    def is_halted(self) -> bool:
        """Has a signal, as SIGSTOP, halted it?"""
        if self._process.returncode is not None:
            return False
        with contextlib.suppress(ChildProcessError):
            return os.waitid(os.P_PID, self._process.pid, os.WSTOPPED | os.WNOHANG | os.WNOWAIT) is not None
        return False

    @property
    def killed_by(self) -> str:
        """The signal that ended it, empty if none did."""
        number = -(self.status or 0)
        names = {one.value: one.name for one in signal.Signals}
        return names.get(number, f"signal {number}") if number > 0 else ""

    def last_line(self) -> str:
        """The last line that it printed; if a signal ended it, which."""
        if self.killed_by:
            return f"{self.name} was ended by {self.killed_by}"
        return self._lines[-1] if self._lines else f"exit status {self.status}, without any output"

    def ask_to_end(self) -> None:
        """Ask it to end in order, unless it has been asked. One that is halted goes on for it."""
        if not (self._was_asked or self.stopped):
            self._was_asked = True
            self._write(END)
            self._signal(signal.SIGCONT)

    def let_close(self) -> None:
        """Let it publish its last message, once it is asked to end and has nothing more to answer."""
        self._write(MAY_CLOSE)

    def _write(self, word: bytes) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError, ValueError):  # it is gone
            os.write(self._process.stdin.fileno(), word)

    def _signal(self, number: signal.Signals) -> None:
        if self.is_running():
            self._process.send_signal(number)

    def hurry(self) -> None:
        """Ask one that was asked to end to wait for nothing."""
        self._signal(signal.SIGINT)
        self._signal(signal.SIGCONT)

    def collect(self) -> None:
        """Kill it if it still runs, and read the rest of its output."""
        self._process.kill()
        self._process.wait()
        self._reader.join()
        assert self._process.stdin is not None
        self._process.stdin.close()


if __name__ == "__main__":
    try:
        _drive_vehicle(*sys.argv[1:])
    except UserError as error:
        raise SystemExit(str(error)) from None
