"""Running a whole scenario on DDS, or a fleet of them, with all nodes in this process."""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import rclpy.logging
from rclpy.executors import Executor

from agv_analysis.runtime.edge_inputs import EdgeInputs
from agv_analysis.runtime.one_process import OneProcess
from agv_analysis.runtime.outcome import Outcome, Progress
from agv_analysis.runtime.recorder_node import RecorderNode
from agv_analysis.runtime.replay_node import Pace, ReplayNode, ReplayRecorder
from agv_analysis.runtime.run_setup import AS_USUAL, PATIENCE, OnDisk, params_file, recording_of, scenario_that_waits
from agv_analysis.runtime.speedometer import Speedometer
from agv_analysis.scenario import SCHEMAS, Scenario
from agv_analysis.watch.live_loop import TOPICS
from agv_cloud.controller_node import ControllerNode
from agv_cloud.error_detector_node import ErrorDetectorNode
from agv_plant.plant_node import PlantNode
from agv_plant.relay_node import RelayNode
from agv_ros.executor import EXECUTORS, add, spin, spin_while_more_comes
from agv_ros.messages import Command, TrackingError
from agv_ros.node import LoopNode
from agv_ros.parameters import LoopParameters
from agv_ros.stopping import Stop, stop_on_signals

NODES: dict[str, Callable[..., LoopNode[Any]]] = {
    "plant": PlantNode,
    "relay": RelayNode,
    "error_detector": ErrorDetectorNode,
    "controller": ControllerNode,
}

_EVENTS_PER_LOOK = 256
"""How many events pass between two calls of `progress`."""

_WATCHED = {topic.strip("/") for topic in TOPICS}

_PATIENCE_WITH_WATCHER, _LOOK_PERIOD = 5.0, 0.01
"""How long a run waits for its watcher, and how often it looks [s]."""


def run_in_process(
    scenario: Scenario, bag: Path | None, progress: Progress, executor: str = "events", on_disk: OnDisk = AS_USUAL,
    is_watched: bool = False,
) -> Outcome:  # fmt: skip
    """Run a scenario with all nodes in this process.

    One that `is_watched` begins once the watcher listens to all that it publishes, or some seconds later without it.
    Raises UserError if a parameter, the track's file or the bag's path cannot be used.
    """
    with stop_on_signals() as stop, OneProcess() as process:
        loop = loop_of(process, scenario, bag, on_disk=on_disk)
        if is_watched:
            _wait_for_watcher(loop)
        return run_loops(EXECUTORS[executor](context=process.context), [loop], stop, progress)[0]


def _wait_for_watcher(loop: Loop) -> None:
    watched = [output for node in loop.nodes for output in node.outputs if output.topic.strip("/") in _WATCHED]
    deadline = time.monotonic() + _PATIENCE_WITH_WATCHER
    while not all(output.is_watched() for output in watched) and time.monotonic() < deadline:
        time.sleep(_LOOK_PERIOD)


def run_fleet(
    fleet: Mapping[str, Scenario], bag: Path | None, progress: Progress, on_disk: OnDisk = AS_USUAL
) -> list[Outcome]:
    """Run scenarios beside each other in this process, each in the namespace that is its name and with its own bag.

    A vehicle that fails does not end the others. Raises UserError as `run_in_process` does.
    """
    with stop_on_signals() as stop, OneProcess() as process:
        loops = [
            loop_of(process, scenario, None if bag is None else bag / name, name, on_disk)
            for name, scenario in fleet.items()
        ]
        return run_loops(EXECUTORS["events"](context=process.context), loops, stop, progress)


def loop_of(
    process: OneProcess, scenario: Scenario, bag: Path | None, vehicle: str = "", on_disk: OnDisk = AS_USUAL
) -> Loop:
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
            None
            if bag is None
            else process.add_recorder(recording_of(scenario, bag, params, on_disk), RecorderNode, vehicle)
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
            player.recorder = process.add_recorder(recording_of(scenario, bag, params, AS_USUAL), make)
            player.recorder.player = player
        executor = EXECUTORS["events"](context=process.context)
        outcome = run_loops(executor, [Loop(player, nodes, player.recorder)], stop, progress)[0]
        return outcome, player.errors, player.commands


class Loop(NamedTuple):
    """The nodes of one loop."""

    plant: PlantNode | ReplayNode
    """The one that says when a step is over."""
    nodes: Sequence[LoopNode[Any]]
    """All of them but the recorder."""
    recorder: RecorderNode | None

    def all_nodes(self) -> Sequence[LoopNode[Any]]:
        """With the recorder, if there is one."""
        return self.nodes if self.recorder is None else (*self.nodes, self.recorder)

    def is_over(self) -> bool:
        """Has the plant done its steps, or can a node not go on?"""
        return any(node.finished for node in self.all_nodes())

    def outcome(self, rate: float, stopped: bool) -> Outcome:
        """How it ended."""
        plant, recorder = self.plant, self.recorder
        failure = plant.failure or next((node.failure for node in self.nodes if node.failure), "")
        if not (failure or plant.finished):
            failure = f"interrupted at step {plant.k}" if stopped else f"ended by the recorder at step {plant.k}"
        recorded = (recorder.summary, recorder.failure) if recorder else ("", "")
        return Outcome(plant.k, rate, failure, *recorded)


def run_loops(executor: Executor, loops: Sequence[Loop], stop: Stop, progress: Progress) -> list[Outcome]:
    """Run loops until all have done all their steps; `progress` receives the total of their steps."""
    for loop in loops:
        for node in loop.all_nodes():
            add(executor, node)
    watch = _Watch(loops, stop, progress)
    try:
        spin(executor, watch.is_done)
        watch.look()
    finally:  # whatever ended the loops, what was recorded is kept
        nodes = [node for loop in loops for node in loop.nodes]
        for loop in loops:
            loop.plant.close()
        # What the others have yet to answer would be missing from the bag.
        patience = max(node.settings.stop_timeout for node in nodes)
        spin_while_more_comes(
            executor, lambda: stop.insisted or _is_quiet(nodes), lambda: _received_by(nodes), patience
        )
        deadline = time.monotonic() + PATIENCE
        for node in nodes:
            node.close()
        recorders = [(loop.recorder, len(loop.nodes)) for loop in loops if loop.recorder]
        spin_while_more_comes(
            executor,
            lambda: stop.insisted or all(recorder.has_all_of(number) for recorder, number in recorders),
            lambda: _received_by([recorder for recorder, _ in recorders]),
            PATIENCE,
        )
        for node in nodes:  # others may listen, too
            node.flush(max(0.0, deadline - time.monotonic()), lambda: stop.insisted)
        for recorder, _ in recorders:
            recorder.close()
        executor.shutdown()
    return [loop.outcome(pace.rate, stop.requested) for loop, pace in zip(loops, watch.paces, strict=True)]


def _is_quiet(nodes: Sequence[LoopNode[Any]]) -> bool:
    """Has all arrived that these nodes have sent each other?"""
    published: Counter[str] = Counter()
    for node in nodes:
        published.update(node.published())
    return all(node.has_received(published) for node in nodes)


def _received_by(nodes: Sequence[LoopNode[Any]]) -> int:
    return sum(node.received.total() for node in nodes)


class _Watch:
    """Looks at loops while they run."""

    def __init__(self, loops: Sequence[Loop], stop: Stop, progress: Progress) -> None:
        self._plants = [loop.plant for loop in loops]
        self._unfinished = list(loops)
        self._stop, self._progress = stop, progress
        self._asked = 0
        self._watched: Sequence[LoopNode[Any]] = []
        self._go_on()
        self.paces = [Speedometer() for _ in loops]

    def is_done(self) -> bool:
        """Have all loops ended, or is all to stop? Asked after each event."""
        self._asked += 1
        if self._asked % _EVENTS_PER_LOOK == 0:
            self.look()
        for node in self._watched:  # one loop is looked at, for one that goes on is enough
            if node.finished:
                self._go_on()
                break
        return self._stop.requested or not self._unfinished

    def _go_on(self) -> None:
        """Leave out loops that have ended, until there is one to watch."""
        while self._unfinished and self._unfinished[-1].is_over():
            self._unfinished.pop()
        self._watched = self._unfinished[-1].all_nodes() if self._unfinished else []

    def look(self) -> None:
        """See how far each is."""
        for plant, pace in zip(self._plants, self.paces, strict=True):
            pace.see(plant.k)
        self._progress(sum(plant.k for plant in self._plants))
