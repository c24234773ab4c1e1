"""Running a whole scenario on DDS, or a fleet of them, with all nodes in this process."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import rclpy
import rclpy.logging
from rclpy.executors import Executor
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from agv_analysis.runtime.edge_inputs import EdgeInputs
from agv_analysis.runtime.parameters import RecorderParameters
from agv_analysis.runtime.recorder_node import RecorderNode
from agv_analysis.runtime.replay_node import Pace, ReplayNode, ReplayRecorder
from agv_analysis.scenario import SCHEMAS, Scenario
from agv_cloud.controller_node import ControllerNode
from agv_cloud.error_detector_node import ErrorDetectorNode
from agv_plant.plant_node import PlantNode
from agv_plant.radio.channel import check_length
from agv_plant.relay_node import RelayNode
from agv_ros.errors import UserError
from agv_ros.executor import EXECUTORS, Stop, add, spin, spin_for, stop_on_signals
from agv_ros.messages import Command, TrackingError
from agv_ros.node import LoopNode, overrides
from agv_ros.parameters import LoopParameters

N = TypeVar("N", bound=LoopNode[Any])
R = TypeVar("R", bound=RecorderNode)

NODES: dict[str, Callable[..., LoopNode[Any]]] = {
    "plant": PlantNode,
    "relay": RelayNode,
    "error_detector": ErrorDetectorNode,
    "controller": ControllerNode,
}

_PATIENCE = 15.0
"""How long [s] a run that is interrupted waits for its recorder, if there is one that lags: nothing shall be lost.

DDS says only every 3 s that a message is there which a busy reader has missed.
"""

_EVENTS_PER_LOOK = 256
"""How many events pass between two calls of `progress`."""

_OWN_TOPICS = ["--ros-args", "-r", "/clock:=clock", "-r", "/diagnostics:=diagnostics"]
"""What makes of the topics of all nodes those of a namespace: each vehicle of a fleet has a clock of its own."""

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
    connected = scenario_that_waits(scenario, recorded=bag is not None)
    if vehicle:  # what nodes have to say beside warnings is in the fleet's table
        rclpy.logging.set_logger_level(vehicle, rclpy.logging.LoggingSeverity.WARN)
    plant = process.add(PlantNode, connected.plant, domain_id=connected.domain_of("plant"), vehicle=vehicle)
    plant.get_logger().set_level(rclpy.logging.LoggingSeverity.WARN)  # its Outcome says the same
    others = [
        process.add(NODES[name], getattr(connected, name), domain_id=connected.domain_of(name), vehicle=vehicle)
        for name in SCHEMAS
        if name != "plant"
    ]
    with params_file(scenario) as params:
        recorder = (
            None if bag is None else process.add_recorder(recording_of(scenario, bag, params), RecorderNode, vehicle)
        )
    return Loop(plant, [plant, *others], recorder)


def replay_in_process(
    scenario: Scenario, inputs: EdgeInputs, pace: Pace, bag: Path | None, progress: Progress, starts_edge: bool = True
) -> tuple[Outcome, dict[int, TrackingError], dict[int, Command]]:
    """Play recorded inputs to the edge's nodes, in this process or running elsewhere; also its answers by step.

    Raises UserError if a parameter, the track's file or the bag's path cannot be used.
    """
    recorded, hears = bag is not None, scenario.error_detector.hears_commands
    listeners = {"error_detector": 2 + recorded, "controller": 1 + hears + recorded}
    with stop_on_signals() as stop, params_file(scenario) as params, OneProcess(inputs.namespace) as process:
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
            player.recorder = process.add_recorder(recording_of(scenario, bag, params), make)
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

    def is_over(self) -> bool:
        """Has the plant done its steps, or can a node not go on? Asked after each event."""
        for node in self.nodes:  # noqa: SIM110  # a generator takes four times as long
            if node.finished:
                return True
        return False

    def outcome(self, rate: float, stopped: bool) -> Outcome:
        """How it ended."""
        plant, recorder = self.plant, self.recorder
        failure = plant.failure or next((node.failure for node in self.nodes if node.failure), "")
        failure = failure or (f"interrupted at step {plant.k}" if stopped and not plant.finished else "")
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
        deadline = time.monotonic() + _PATIENCE
        nodes = [node for loop in loops for node in loop.nodes]
        for node in nodes:
            node.close()
        recorders = [(loop.recorder, len(loop.nodes)) for loop in loops if loop.recorder]
        spin_for(executor, lambda: all(recorder.has_all_of(number) for recorder, number in recorders), _PATIENCE)
        for node in nodes:  # others may listen, too
            node.flush(max(0.0, deadline - time.monotonic()))
        for recorder, _ in recorders:
            recorder.close()
        executor.shutdown()
    return [loop.outcome(pace.rate, stop.requested) for loop, pace in zip(loops, watch.paces, strict=True)]


class _Watch:
    """Looks at loops while they run."""

    def __init__(self, loops: Sequence[Loop], stop: Stop, progress: Progress) -> None:
        self._plants = [loop.plant for loop in loops]
        self._unfinished = list(loops)
        self._stop, self._progress = stop, progress
        self._asked = 0
        self.paces = [Speedometer() for _ in loops]

    def is_done(self) -> bool:
        """Have all loops ended, or is all to stop? Asked after each event."""
        self._asked += 1
        if self._asked % _EVENTS_PER_LOOK == 0:
            self.look()
        while self._unfinished and self._unfinished[-1].is_over():  # one is looked at, for one is enough
            self._unfinished.pop()
        return not self._unfinished or self._stop.requested

    def look(self) -> None:
        """See how far each is."""
        for plant, pace in zip(self._plants, self.paces, strict=True):
            pace.see(plant.k)
        self._progress(sum(plant.k for plant in self._plants))


def scenario_that_waits(scenario: Scenario, recorded: bool) -> Scenario:
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
    if scenario.error_detector.hears_commands and not scenario.plant.plan_steps:
        nodes["controller"] = dataclasses.replace(nodes["controller"], wait_for_subscribers=2 + recorded)
    return Scenario(**nodes)


def recording_of(scenario: Scenario, bag: Path, params: Path) -> RecorderParameters:
    """What the recorder of a scenario is to do; `params` is the file of its parameters."""
    log_time = "stamp" if scenario.plant.clock == "lockstep" else "receive"
    return RecorderParameters(
        bag=str(bag), params_file=str(params), log_time=log_time, stop_timeout=_PATIENCE,
        plant_domain_id=scenario.relay.plant_domain_id, edge_domain_id=scenario.relay.edge_domain_id,
    )  # fmt: skip


@contextmanager
def params_file(scenario: Scenario) -> Iterator[Path]:
    """A file with the scenario's parameters, for as long as it is needed."""
    with tempfile.TemporaryDirectory(prefix="agv_ncs_") as folder:
        path = Path(folder) / "params.yaml"
        path.write_text(scenario.to_yaml(), encoding="utf-8")
        yield path


class Speedometer:
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
