"""Running a whole scenario on DDS: all nodes in this process, or one process for each."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import rclpy
import rclpy.logging
from rclpy.executors import Executor
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from agv_analysis.parameters import RecorderParameters
from agv_analysis.recorder_node import RecorderNode
from agv_analysis.replay import EdgeInputs
from agv_analysis.replay_node import Pace, ReplayNode, ReplayRecorder
from agv_analysis.scenario import SCHEMAS, Scenario
from agv_cloud.controller_node import ControllerNode
from agv_cloud.error_detector_node import ErrorDetectorNode
from agv_plant.plant_node import PlantNode, progress_of
from agv_plant.radio import check_length
from agv_plant.relay_node import RelayNode
from agv_ros.errors import UserError
from agv_ros.executor import EXECUTORS, Stop, add, spin, spin_for, stop_on_signals
from agv_ros.node import LoopNode, overrides
from agv_ros.parameters import LoopParameters, as_dict
from agv_ros.wire import Command, TrackingError

N = TypeVar("N", bound=LoopNode[Any])
R = TypeVar("R", bound=RecorderNode)

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

_PATIENCE = 15.0
"""How long [s] a run that is interrupted waits for its recorder, if there is one that lags: nothing shall be lost.

DDS says only every 3 s that a message is there which a busy reader has missed.
"""

_STOP_TIMEOUT = 20.0
"""How long [s] a process that was asked to stop may take; more than `_PATIENCE`."""

_LOOK_PERIOD = 0.1
"""How often [s] the processes are looked at while they run."""

_STEPS_PER_LOOK = 64
"""How many steps pass between two calls of `progress`."""

_LOG_PREFIX = re.compile(r"^\[[A-Z]+\] \[[0-9.]+\] \[[^]]*\]: ")
"""What rclpy's logging puts before a line: severity, time, node."""

Progress = Callable[[int], None]
"""Called with the number of steps done, every now and then."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a run ended."""

    steps: int
    rate: float
    """Steps per second of wall time, without start-up and shut-down; 0 if there were too few to tell."""
    failure: str
    """Why the run ended early, empty if it did not."""
    recording: str
    """What the recorder says of the bag, empty without one."""
    recording_failure: str
    """Why the bag is not complete, empty if every message that was published is in it."""


def run_in_process(scenario: Scenario, bag: Path | None, progress: Progress, executor: str = "events") -> Outcome:
    """Run a scenario with all nodes in this process.

    Raises UserError if a parameter, the track's file or the bag's path cannot be used.
    """
    connected = _connected(scenario, recorded=bag is not None)
    with stop_on_signals() as stop, _params_file(scenario) as params, OneProcess() as process:
        plant = process.add(PlantNode, connected.plant, domain_id=connected.domain_of("plant"))
        rclpy.logging.set_logger_level("plant", rclpy.logging.LoggingSeverity.WARN)  # its Outcome says the same
        others = [name for name in SCHEMAS if name != "plant"]
        loop = [
            plant,
            *(process.add(NODES[n], getattr(connected, n), domain_id=connected.domain_of(n)) for n in others),
        ]
        recorder = None if bag is None else process.add_recorder(_recording(scenario, bag, params), RecorderNode)
        return run_nodes(EXECUTORS[executor](context=process.context), plant, loop, recorder, stop, progress)


def replay_in_process(
    scenario: Scenario, inputs: EdgeInputs, pace: Pace, bag: Path | None, progress: Progress, starts_edge: bool = True
) -> tuple[Outcome, dict[int, TrackingError], dict[int, Command]]:
    """Play recorded inputs to the edge's nodes, in this process or running elsewhere; also its answers by step.

    Raises UserError if a parameter, the track's file or the bag's path cannot be used.
    """
    recorded, predicts = bag is not None, scenario.error_detector.policy == "predict"
    listeners = {"error_detector": 2 + recorded, "controller": 1 + predicts + recorded}
    with stop_on_signals() as stop, _params_file(scenario) as params, OneProcess(inputs.namespace) as process:
        player = process.add(
            partial(ReplayNode, inputs, pace, not starts_edge),
            LoopParameters(scenario.plant.ts, scenario.plant.start_time, 1 + recorded),
        )
        nodes: list[LoopNode[Any]] = [player]
        for name, count in listeners.items() if starts_edge else ():
            only = {"trigger": "slot"} if name == "error_detector" else {"command_type": "twist_stamped"}
            given = getattr(scenario, name)
            settings = dataclasses.replace(given, wait_for_subscribers=count, plan_steps=0, **only)
            nodes.append(process.add(NODES[name], settings, use_sim_time=True))
        if bag is not None:
            own = [node.get_fully_qualified_name().lstrip("/") for node in nodes]
            make = partial(ReplayRecorder, inputs.source, own)
            player.recorder = process.add_recorder(_recording(scenario, bag, params), make)
            player.recorder.player = player
        executor = EXECUTORS["events"](context=process.context)
        outcome = run_nodes(executor, player, nodes, player.recorder, stop, progress)
        return outcome, player.errors, player.commands


class OneProcess:
    """Nodes of this process, in a context of their own."""

    def __init__(self, namespace: str = "") -> None:
        self.context = rclpy.Context()
        self._contexts: dict[int, rclpy.Context] = {}
        self._namespace = namespace
        self._stack = ExitStack()

    def __enter__(self) -> OneProcess:
        self._enter_domain(self.context, None)
        return self

    def _enter_domain(self, context: rclpy.Context, domain_id: int | None) -> None:
        rclpy.init(context=context, domain_id=domain_id, signal_handler_options=SignalHandlerOptions.NO)
        self._contexts[context.get_domain_id()] = context
        self._stack.callback(context.try_shutdown)

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def add(self, make: Callable[..., N], settings: object, use_sim_time: bool = False, domain_id: int = -1) -> N:
        """Make a node with these settings, in a DDS domain of its own if it is to have one."""
        if domain_id >= 0 and domain_id not in self._contexts:
            self._enter_domain(rclpy.Context(), domain_id)
        node = make(
            parameter_overrides=[*overrides(settings), Parameter("use_sim_time", value=use_sim_time)],
            context=self._contexts.get(domain_id, self.context), use_global_arguments=False, namespace=self._namespace,
        )  # fmt: skip
        self._stack.callback(node.destroy_node)
        return node

    def add_recorder(self, settings: RecorderParameters, make: Callable[..., R]) -> R:
        """Make a recorder, which says in the run's Outcome alone what it has recorded."""
        rclpy.logging.set_logger_level("recorder", rclpy.logging.LoggingSeverity.WARN)
        return self.add(make, settings)


def run_nodes(
    executor: Executor,
    plant: PlantNode | ReplayNode,
    loop: Sequence[LoopNode[Any]],
    recorder: RecorderNode | None,
    stop: Stop,
    progress: Progress,
) -> Outcome:
    """Run the nodes of a loop until the one that says when a step is over, plant or player, has done all steps."""
    for node in loop if recorder is None else (*loop, recorder):
        add(executor, node)
    pace = _Pace()

    def is_done() -> bool:
        if plant.k % _STEPS_PER_LOOK == 1:
            pace.see(plant.k)
            progress(plant.k)
        return plant.finished or stop.requested

    try:
        spin(executor, is_done)
        pace.see(plant.k)
        progress(plant.k)
    finally:  # whatever ended the loop, what was recorded is kept
        for node in loop:
            node.close()
            node.flush(_PATIENCE)
        if recorder is not None:
            spin_for(executor, recorder.is_settled, _PATIENCE)
            recorder.close()
        executor.shutdown()
    failure = plant.failure or (f"interrupted at step {plant.k}" if stop.requested else "")
    return Outcome(
        plant.k, pace.rate, failure, recorder.summary if recorder else "", recorder.failure if recorder else ""
    )


def _connected(scenario: Scenario, recorded: bool) -> Scenario:
    """The scenario with nodes that wait for each other, and for the recorder.

    Raises TraceError as the nodes would, and UserError if they would wait for ever.
    """
    if scenario.error_detector.trigger == "timer" and scenario.plant.clock == "lockstep":
        raise UserError(
            "error_detector.trigger is timer, but plant.clock is lockstep, in which the plant waits for an answer to "
            "each of its steps: set plant.clock=realtime"
        )
    steps = scenario.plant.duration / scenario.plant.ts
    for channel in (scenario.relay.uplink, scenario.relay.downlink):
        check_length(channel, steps)
    met = {"wait_for_subscribers": 1 + recorded, "stop_timeout": _PATIENCE if recorded else scenario.plant.stop_timeout}
    nodes = {name: dataclasses.replace(getattr(scenario, name), **met) for name in SCHEMAS}
    if scenario.error_detector.policy == "predict" and not scenario.plant.plan_steps:  # which hears commands as well
        nodes["controller"] = dataclasses.replace(nodes["controller"], wait_for_subscribers=2 + recorded)
    return Scenario(**nodes)


def _recording(scenario: Scenario, bag: Path, params: Path) -> RecorderParameters:
    log_time = "stamp" if scenario.plant.clock == "lockstep" else "receive"
    return RecorderParameters(
        bag=str(bag), params_file=str(params), log_time=log_time, stop_timeout=_PATIENCE,
        plant_domain_id=scenario.relay.plant_domain_id, edge_domain_id=scenario.relay.edge_domain_id,
    )  # fmt: skip


@contextmanager
def _params_file(scenario: Scenario) -> Iterator[Path]:
    """A file with the scenario's parameters, for as long as it is needed."""
    with tempfile.TemporaryDirectory(prefix="agv_ncs_") as folder:
        path = Path(folder) / "params.yaml"
        path.write_text(scenario.to_yaml(), encoding="utf-8")
        yield path


class _Pace:
    """Speed between the first and the last step that was seen."""

    def __init__(self) -> None:
        self._first: tuple[int, float] | None = None
        self._last = (0, 0.0)

    def see(self, steps: int) -> None:
        """So many steps are done now."""
        if steps > self._last[0]:
            self._last = (steps, time.monotonic())
            self._first = self._first or self._last

    @property
    def rate(self) -> float:
        """Steps per second."""
        (k, begun), (end_k, ended) = self._first or self._last, self._last
        return (end_k - k) / (ended - begun) if end_k > k else 0.0


def run_in_processes(scenario: Scenario, bag: Path | None, progress: Progress) -> Outcome:
    """Run a scenario with one process for each node.

    Raises UserError if a parameter, the track's file or the bag's path cannot be used.
    """
    connected = _connected(scenario, recorded=bag is not None)
    with stop_on_signals() as stop, _params_file(scenario) as params, _params_file(connected) as connected_params:
        nodes: dict[str, _Process] = {}
        try:
            if bag is not None:
                nodes["recorder"] = _Process("recorder", params, as_dict(_recording(scenario, bag, params)))
            for name in reversed(SCHEMAS):
                nodes[name] = _Process(name, connected_params, {}, connected.domain_of(name))
            outcome = _watch(nodes, stop, progress)
            return dataclasses.replace(outcome, recording=outcome.recording.removeprefix(f"{bag}: "))
        finally:
            for node in nodes.values():
                node.stop(signal.SIGTERM)


def _watch(nodes: dict[str, _Process], stop: Stop, progress: Progress) -> Outcome:
    """Wait for the plant to end, then stop the others, the recorder last."""
    plant = nodes["plant"]
    while plant.is_running(_LOOK_PERIOD) and all(node.is_running() for node in nodes.values()) and not stop.requested:
        progress(plant.steps)
    ended = [node for node in nodes.values() if node is not plant and not node.is_running()]
    recorder = nodes.pop("recorder", None)
    for node in nodes.values():
        node.tell(signal.SIGINT)
    for node in nodes.values():
        node.collect()
    if recorder is not None:
        recorder.stop(signal.SIGINT)
        nodes["recorder"] = recorder
    progress(plant.steps)
    if stop.requested:
        failure = f"interrupted after step {plant.steps}"
    elif ended:
        failure = f"{ended[0].name} ended: {ended[0].last_words()}"
    else:
        failure = plant.last_words() if plant.status else ""
    recording = recorder.last_words() if recorder else ""
    failed = recorder is not None and recorder.status != 0
    return Outcome(plant.steps, plant.pace.rate, failure, "" if failed else recording, recording if failed else "")


class _Process:
    """One node in a process of its own, with what it says."""

    def __init__(self, name: str, params: Path, settings: dict[str, Any], domain_id: int = -1) -> None:
        self.name = name
        self.steps = 0
        self.pace = _Pace()
        self._lines: list[str] = []
        command = [sys.executable, "-m", _MODULES[name], "--ros-args", "--params-file", str(params)]
        for parameter, value in settings.items():
            command += ["-p", f"{parameter}:={json.dumps(value)}"]
        domain = {"ROS_DOMAIN_ID": str(domain_id)} if domain_id >= 0 else {}
        # A session of its own: Ctrl-C reaches the runner alone, which then ends the nodes in order.
        self._process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
            env={**os.environ, "PYTHONUNBUFFERED": "1", **domain},
        )  # fmt: skip
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            text = _LOG_PREFIX.sub("", line.strip())
            steps = progress_of(text)
            if steps is None:
                self._lines.append(text)
            else:
                self.steps = steps
                self.pace.see(steps)

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

    def last_words(self) -> str:
        """The last line that it printed."""
        return self._lines[-1] if self._lines else f"exit status {self.status}, without a word"

    def tell(self, number: signal.Signals) -> None:
        """Send it a signal, unless it has ended."""
        if self.is_running():
            self._process.send_signal(number)

    def stop(self, number: signal.Signals) -> None:
        """Tell it to end, and see to it."""
        self.tell(number)
        self.collect()

    def collect(self) -> None:
        """Wait for its end, which comes by force if it takes too long, and for the rest of what it said."""
        if self.is_running(_STOP_TIMEOUT):
            self._process.kill()
        self._process.wait()
        self._reader.join()
