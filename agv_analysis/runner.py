"""Running a whole scenario on DDS, or a fleet of them: all nodes in this process, or one process for each."""

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
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import click
import rclpy
import rclpy.logging
from rclpy.executors import Executor
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from agv_analysis.parameters import RecorderParameters
from agv_analysis.recorder_node import RecorderNode
from agv_analysis.replay import EdgeInputs
from agv_analysis.replay_node import Pace, ReplayNode, ReplayRecorder
from agv_analysis.scenario import SCHEMAS, Scenario, load_scenario
from agv_cloud.controller_node import ControllerNode
from agv_cloud.error_detector_node import ErrorDetectorNode
from agv_plant.plant_node import PlantNode, progress_line, progress_of
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

_EVENTS_PER_LOOK = 256
"""How many events pass between two calls of `progress`."""

_SAY_PERIOD = 0.2
"""How often [s] a vehicle's process says how far it is."""

_OWN_TOPICS = ["--ros-args", "-r", "/clock:=clock", "-r", "/diagnostics:=diagnostics"]
"""What makes of the topics of all nodes those of a namespace: each vehicle of a fleet has a clock of its own."""

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
    with stop_on_signals() as stop, OneProcess() as process:
        loop = loop_of(process, scenario, bag)
        return run_loops(EXECUTORS[executor](context=process.context), [loop], stop, progress)[0]


def run_fleet(fleet: Mapping[str, Scenario], bag: Path | None, progress: Progress) -> list[Outcome]:
    """Run scenarios beside each other in this process, each in the namespace that is its name and with its own bag.

    A vehicle that fails does not end the others. Raises UserError as `run_in_process` does.
    """
    with stop_on_signals() as stop, OneProcess() as process:
        loops = [
            loop_of(process, scenario, None if bag is None else bag / name, name) for name, scenario in fleet.items()
        ]
        return run_loops(EXECUTORS["events"](context=process.context), loops, stop, progress)


def loop_of(process: OneProcess, scenario: Scenario, bag: Path | None, vehicle: str = "") -> Loop:
    """The nodes of a scenario, in a namespace if they are a vehicle of a fleet."""
    connected = _connected(scenario, recorded=bag is not None)
    if vehicle:  # what nodes have to say beside warnings is in the fleet's table
        rclpy.logging.set_logger_level(vehicle, rclpy.logging.LoggingSeverity.WARN)
    plant = process.add(PlantNode, connected.plant, domain_id=connected.domain_of("plant"), vehicle=vehicle)
    plant.get_logger().set_level(rclpy.logging.LoggingSeverity.WARN)  # its Outcome says the same
    others = [
        process.add(NODES[name], getattr(connected, name), domain_id=connected.domain_of(name), vehicle=vehicle)
        for name in SCHEMAS
        if name != "plant"
    ]
    with _params_file(scenario) as params:
        recorder = (
            None if bag is None else process.add_recorder(_recording(scenario, bag, params), RecorderNode, vehicle)
        )
    return Loop(plant, [plant, *others], recorder)


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
        outcome = run_loops(executor, [Loop(player, nodes, player.recorder)], stop, progress)[0]
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

    def add(
        self, make: Callable[..., N], settings: object, use_sim_time: bool = False, domain_id: int = -1,
        vehicle: str = "",
    ) -> N:  # fmt: skip
        """Make a node with these settings, in a DDS domain of its own if it is to have one.

        The nodes of a `vehicle` of a fleet have this namespace, and in it clock and diagnostics of their own.
        """
        if domain_id >= 0 and domain_id not in self._contexts:
            self._enter_domain(rclpy.Context(), domain_id)
        node = make(
            parameter_overrides=[*overrides(settings), Parameter("use_sim_time", value=use_sim_time)],
            context=self._contexts.get(domain_id, self.context), use_global_arguments=False,
            namespace=vehicle or self._namespace, cli_args=_OWN_TOPICS if vehicle else None,
        )  # fmt: skip
        self._stack.callback(node.destroy_node)
        return node

    def add_recorder(self, settings: RecorderParameters, make: Callable[..., R], vehicle: str = "") -> R:
        """Make a recorder, which says in the run's Outcome alone what it has recorded."""
        recorder = self.add(make, settings, vehicle=vehicle)
        recorder.get_logger().set_level(rclpy.logging.LoggingSeverity.WARN)
        return recorder


class Loop(NamedTuple):
    """The nodes of one loop."""

    plant: PlantNode | ReplayNode
    """The one that says when a step is over."""
    nodes: Sequence[LoopNode[Any]]
    """All of them but the recorder."""
    recorder: RecorderNode | None

    def outcome(self, rate: float, stopped: bool) -> Outcome:
        """How it ended."""
        plant, recorder = self.plant, self.recorder
        failure = plant.failure or (f"interrupted at step {plant.k}" if stopped and not plant.finished else "")
        recorded = (recorder.summary, recorder.failure) if recorder else ("", "")
        return Outcome(plant.k, rate, failure, *recorded)


def run_loops(executor: Executor, loops: Sequence[Loop], stop: Stop, progress: Progress) -> list[Outcome]:
    """Run loops until all have done all their steps; `progress` is told of the steps of all of them together."""
    for loop in loops:
        for node in (*loop.nodes, loop.recorder) if loop.recorder else loop.nodes:
            add(executor, node)
    watch = _Watch(loops, stop, progress)
    try:
        spin(executor, watch.is_done)
        watch.look()
    finally:  # whatever ended the loops, what was recorded is kept
        for loop in loops:
            for node in loop.nodes:
                node.close()
                node.flush(_PATIENCE)
        recorders = [(loop.recorder, len(loop.nodes)) for loop in loops if loop.recorder]
        spin_for(executor, lambda: all(recorder.has_all_of(nodes) for recorder, nodes in recorders), _PATIENCE)
        for recorder, _ in recorders:
            recorder.close()
        executor.shutdown()
    return [loop.outcome(pace.rate, stop.requested) for loop, pace in zip(loops, watch.paces, strict=True)]


class _Watch:
    """Looks at loops while they run."""

    def __init__(self, loops: Sequence[Loop], stop: Stop, progress: Progress) -> None:
        self._plants = [loop.plant for loop in loops]
        self._unfinished = list(self._plants)
        self._stop, self._progress = stop, progress
        self._asked = 0
        self.paces = [_Pace() for _ in loops]

    def is_done(self) -> bool:
        """Have all loops ended, or is all to stop? Asked after each event."""
        self._asked += 1
        if self._asked % _EVENTS_PER_LOOK == 0:
            self.look()
        while self._unfinished and self._unfinished[-1].finished:  # one is looked at, for one is enough
            self._unfinished.pop()
        return not self._unfinished or self._stop.requested

    def look(self) -> None:
        """See how far each is."""
        for plant, pace in zip(self._plants, self.paces, strict=True):
            pace.see(plant.k)
        self._progress(sum(plant.k for plant in self._plants))


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
                recording = as_dict(_recording(scenario, bag, params))
                nodes["recorder"] = _Process("recorder", _node_command("recorder", params, recording))
            for name in reversed(SCHEMAS):
                nodes[name] = _Process(name, _node_command(name, connected_params, {}), connected.domain_of(name))
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


def run_fleet_in_processes(fleet: Mapping[str, Scenario], bag: Path | None, progress: Progress) -> list[Outcome]:
    """As `run_fleet`, with one process for each vehicle: its nodes have one, as they cost most where they are apart."""
    for scenario in fleet.values():  # what cannot be used is to be said once
        _connected(scenario, recorded=bag is not None)
    with stop_on_signals() as stop, ExitStack() as files:
        vehicles: list[_Process] = []
        try:
            for name, scenario in fleet.items():
                params = files.enter_context(_params_file(scenario))
                command = [sys.executable, "-m", "agv_analysis.runner", name, str(params), str(bag or "")]
                vehicles.append(_Process(name, command))
            for vehicle in vehicles:
                while vehicle.is_running(_LOOK_PERIOD) and not stop.requested:
                    progress(sum(other.steps for other in vehicles))
        finally:
            for vehicle in vehicles:
                vehicle.tell(signal.SIGINT)
            for vehicle in vehicles:
                vehicle.collect()
        outcomes = [_outcome_of(vehicle, stop.requested) for vehicle in vehicles]
        progress(sum(outcome.steps for outcome in outcomes))
        return outcomes


def _outcome_of(vehicle: _Process, stopped: bool) -> Outcome:
    """What a vehicle's process says in its last line, unless something ended it before."""
    try:
        return Outcome(**json.loads(vehicle.last_words()))
    except (ValueError, TypeError):
        failure = f"interrupted after step {vehicle.steps}" if stopped else vehicle.last_words()
        return Outcome(vehicle.steps, vehicle.pace.rate, failure, "", "")


def _drive_vehicle(name: str, params: str, bag: str) -> None:
    """Body of a vehicle's process: its progress goes to standard output and, as the last line, its Outcome."""
    scenario = load_scenario(params)
    steps, said = scenario.plant.duration / scenario.plant.ts, time.monotonic()

    def say(k: int) -> None:
        nonlocal said
        if time.monotonic() - said > _SAY_PERIOD:
            said = time.monotonic()
            click.echo(progress_line(k, steps))

    (outcome,) = run_fleet({name: scenario}, Path(bag) if bag else None, say)
    click.echo(json.dumps(dataclasses.asdict(outcome)))


def _node_command(name: str, params: Path, settings: dict[str, Any]) -> list[str]:
    """Command that starts a node."""
    command = [sys.executable, "-m", _MODULES[name], "--ros-args", "--params-file", str(params)]
    for parameter, value in settings.items():
        command += ["-p", f"{parameter}:={json.dumps(value)}"]
    return command


class _Process:
    """One node, or one vehicle, in a process of its own, with what it says."""

    def __init__(self, name: str, command: Sequence[str], domain_id: int = -1) -> None:
        self.name = name
        self.steps = 0
        self.pace = _Pace()
        self._lines: list[str] = []
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


if __name__ == "__main__":
    try:
        _drive_vehicle(*sys.argv[1:])
    except UserError as error:
        raise SystemExit(str(error)) from None
