"""Running a whole scenario on DDS: all nodes in this process, or one process for each."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
import rclpy.logging
from rclpy.signals import SignalHandlerOptions

from agv_analysis.recorder_node import RecorderNode
from agv_analysis.scenario import SCHEMAS, Scenario
from agv_cloud.controller_node import ControllerNode
from agv_cloud.error_detector_node import ErrorDetectorNode
from agv_plant.plant_node import PlantNode, progress_of
from agv_plant.relay_node import RelayNode
from agv_ros.executor import EXECUTORS, FLUSH_TIMEOUT, Stop, spin, spin_for, stop_on_signals
from agv_ros.node import LoopNode, overrides

NODES: dict[str, Callable[..., LoopNode[Any]]] = {
    "plant": PlantNode,
    "relay": RelayNode,
    "error_detector": ErrorDetectorNode,
    "controller": ControllerNode,
}

_MODULES = {
    "plant": "agv_plant.plant_node",
    "relay": "agv_plant.relay_node",
    "error_detector": "agv_cloud.error_detector_node",
    "controller": "agv_cloud.controller_node",
    "recorder": "agv_analysis.recorder_node",
}

_STOP_TIMEOUT = 10.0
"""How long [s] a process that was asked to stop may take; a node needs less than 2 s, a recorder writes its bag."""

Progress = Callable[[int], None]
"""Called with the number of steps done, every now and then."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a run ended."""

    steps: int
    seconds: float
    """Wall time of the loop, without start-up and shut-down."""
    failure: str
    """Why the run ended early, empty if it did not."""
    recording: str
    """What the recorder has to say of its completeness, empty without a bag."""
    complete: bool
    """Is every message that was published in the bag? True without a bag."""


def run_in_process(scenario: Scenario, bag: Path | None, progress: Progress, executor: str = "events") -> Outcome:
    """Run a scenario with all nodes in this process.

    Raises UserError if a parameter, the track's file or the bag's path cannot be used.
    """
    scenario = _connected(scenario, recorded=bag is not None)
    with stop_on_signals() as stop:
        context = rclpy.Context()
        rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
        nodes: list[LoopNode[Any]] = []
        try:
            return _run_nodes(scenario, bag, progress, executor, stop, context, nodes)
        finally:
            for node in nodes:
                node.destroy_node()
            context.try_shutdown()


def _connected(scenario: Scenario, recorded: bool) -> Scenario:
    """The scenario with nodes that wait for each other, and for the recorder."""
    wait = 1 + recorded
    return Scenario(**{
        name: dataclasses.replace(getattr(scenario, name), wait_for_subscribers=wait) for name in SCHEMAS
    })  # fmt: skip


def _run_nodes(
    scenario: Scenario,
    bag: Path | None,
    progress: Progress,
    executor_name: str,
    stop: Stop,
    context: rclpy.Context,
    nodes: list[LoopNode[Any]],
) -> Outcome:
    options: dict[str, Any] = {"context": context, "use_global_arguments": False}
    plant = PlantNode(parameter_overrides=overrides(scenario.plant), **options)
    nodes.append(plant)
    rclpy.logging.set_logger_level("plant", rclpy.logging.LoggingSeverity.WARN)  # `progress` says it already
    for name in ("relay", "error_detector", "controller"):
        nodes.append(NODES[name](parameter_overrides=overrides(getattr(scenario, name)), **options))
    recorder = RecorderNode(bag=bag, scenario=scenario, **options) if bag is not None else None
    if recorder is not None:
        nodes.append(recorder)
    executor = EXECUTORS[executor_name](context=context)
    for node in nodes:
        executor.add_node(node)
    begun = _Stopwatch()

    def is_done() -> bool:
        if plant.k % 64 == 1:
            begun.start()
            progress(plant.k)
        return plant.finished or stop.requested

    spin(executor, is_done)
    seconds = begun.seconds()
    progress(plant.k)
    failure = plant.failure or (f"interrupted at step {plant.k}" if stop.requested else "")
    for node in nodes:
        node.flush(FLUSH_TIMEOUT)
    recording, complete = "", True
    if recorder is not None:
        sent = {output.topic: output.count for node in nodes for output in node.outputs}
        spin_for(executor, lambda: recorder.has(sent), 2.0)
        recording, complete = recorder.finish(sent)
    executor.shutdown()
    return Outcome(plant.k, seconds, failure, recording, complete)


class _Stopwatch:
    """Time since the first `start`."""

    def __init__(self) -> None:
        self._started: float | None = None

    def start(self) -> None:
        if self._started is None:
            self._started = time.monotonic()

    def seconds(self) -> float:
        return 0.0 if self._started is None else time.monotonic() - self._started


def run_in_processes(scenario: Scenario, bag: Path | None, progress: Progress) -> Outcome:
    """Run a scenario with one process for each node.

    Raises UserError if a parameter, the track's file or the bag's path cannot be used.
    """
    with stop_on_signals() as stop, tempfile.TemporaryDirectory(prefix="agv_ncs_") as folder:
        params = Path(folder) / "params.yaml"
        params.write_text(_connected(scenario, recorded=bag is not None).to_yaml(), encoding="utf-8")
        nodes: dict[str, _Process] = {}
        try:
            if bag is not None:
                nodes["recorder"] = _Process("recorder", params, {"bag": str(bag), "params_file": str(params)})
            for name in ("controller", "error_detector", "relay", "plant"):
                nodes[name] = _Process(name, params, {})
            return _watch(nodes, stop, progress)
        finally:
            for node in nodes.values():
                node.stop(signal.SIGTERM)


def _watch(nodes: dict[str, _Process], stop: Stop, progress: Progress) -> Outcome:
    """Wait for the plant to end, then stop the others, the recorder last."""
    plant, begun = nodes["plant"], _Stopwatch()
    while plant.is_running(0.1) and all(node.is_running(0.0) for node in nodes.values()) and not stop.requested:
        if plant.steps:
            begun.start()
            progress(plant.steps)
    seconds = begun.seconds()
    ended = [node for node in nodes.values() if not node.is_running(0.0) and node is not plant]
    recorder = nodes.get("recorder")
    for node in nodes.values():
        if node is not recorder:
            node.stop(signal.SIGINT)
    if recorder is not None:
        recorder.stop(signal.SIGINT)
    progress(plant.steps)
    failure = ""
    if stop.requested:
        failure = f"interrupted after step {plant.steps}"
    elif ended:
        failure = f"{ended[0].name} ended: {ended[0].last_words()}"
    elif plant.status:
        failure = plant.last_words()
    if recorder is None:
        return Outcome(plant.steps, seconds, failure, "", True)
    return Outcome(plant.steps, seconds, failure, recorder.last_words(), recorder.status == 0)


class _Process:
    """One node in a process of its own, with what it says."""

    def __init__(self, name: str, params: Path, settings: dict[str, str]) -> None:
        self.name = name
        self.steps = 0
        self._lines: list[str] = []
        command = [sys.executable, "-m", _MODULES[name], "--ros-args", "--params-file", str(params)]
        for parameter, value in settings.items():
            command += ["-p", f"{parameter}:={value}"]
        # A session of its own: Ctrl-C reaches the runner alone, which then ends the nodes in order.
        self._process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )  # fmt: skip
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            steps = progress_of(line.strip())
            if steps is None:
                self._lines.append(line.strip())
            else:
                self.steps = steps

    @property
    def status(self) -> int | None:
        """Exit status, None while it runs."""
        return self._process.poll()

    def is_running(self, wait: float) -> bool:
        """Does it still run after `wait` [s]?"""
        try:
            self._process.wait(wait)
        except subprocess.TimeoutExpired:
            return True
        return False

    def last_words(self) -> str:
        """The last line that it printed."""
        return self._lines[-1] if self._lines else f"exit status {self.status}, without a word"

    def stop(self, number: signal.Signals) -> None:
        """End it, if need be by force, and collect the rest of what it said."""
        if self.is_running(0.0):
            self._process.send_signal(number)
            if self.is_running(_STOP_TIMEOUT):
                self._process.kill()
        self._process.wait()
        self._reader.join()
