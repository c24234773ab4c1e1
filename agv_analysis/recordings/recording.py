"""From a recorded bag of this loop to a run: its messages by step, their number checked."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from agv_analysis.bags import Bag, read_bag
from agv_analysis.bags.writer import METADATA_NAME
from agv_analysis.recordings import notes, restarts
from agv_analysis.recordings.completeness import refuse_other_grid, unexplained
from agv_analysis.recordings.loop_timing import with_timing
from agv_analysis.recordings.messages_on_steps import (
    NOTHING,
    OnSteps,
    Steps,
    commands_of,
    errors_of,
    on_steps,
    postures,
    speeds_of_errors,
    stamps_of,
)
from agv_analysis.recordings.node_parameters import EVENTS, Said, said_by_nodes
from agv_analysis.recordings.slot_outcomes import slot_outcomes
from agv_analysis.run import Floats, Run
from agv_analysis.scenario import Scenario, load_scenario, parse_scenario
from agv_analysis.simulation.reference import reference_of
from agv_cloud.parameters import PATH
from agv_ros.errors import UserError

_POSE, _SLOT = "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/TimeReference"
_COMMAND, _ERROR = "geometry_msgs/msg/TwistStamped", "nav_msgs/msg/Odometry"

TOPICS = {
    "agv/pose": _POSE, "agv/ground_truth": _POSE, "edge/pose": _POSE, "edge/slot": _SLOT, "edge/age": _SLOT,
    "edge/error": _ERROR, "edge/reference_pose": _POSE, "edge/cmd_vel": _COMMAND, "agv/cmd_vel": _COMMAND,
    "agv/slot": _SLOT,
}  # fmt: skip
"""What is read, with its type."""

_DIAGNOSTICS, _EVENT = "diagnostic_msgs/msg/DiagnosticArray", "rcl_interfaces/msg/ParameterEvent"

_NEEDED = ("agv/pose", "edge/slot", "edge/error", "edge/cmd_vel")

_MOST_STEPS = 20_000_000
"""Steps of a reference that are computed: 28 hours at 5 ms, in 800 MB."""

_NO_TRUTH = "the AGV measures its pose with noise, and agv/ground_truth is not in the recording: errors hold the noise"


def read_run(path: Path, config: Path | None = None, namespace: str | None = None) -> Run:
    """Run of the loop that is recorded in a rosbag2 directory or an MCAP file.

    Parameters come from `config`, a params file, or from the bag itself; what the nodes said in the recording counts
    more than either, and notes tell where it differs. `namespace` chooses one of several loops.
    Raises UserError if the bag cannot be read, holds no loop, or if its parameters are not known.
    """
    bag = read_bag(path, topics=())
    names = loop_topics(bag, path, namespace)
    scenario = _scenario(bag, path, config)
    namespace = names["agv/pose"].removesuffix("agv/pose")
    own = f"{namespace}diagnostics"  # of a vehicle of a fleet
    diagnostics = own if own in bag.topics else restarts.TOPIC
    beside = [name for name, kind in ((diagnostics, _DIAGNOSTICS), (EVENTS, _EVENT)) if _is(bag, name, kind)]
    foreign = tuple(_foreign_topics(bag, namespace))
    bag = read_bag(path, topics=(*names.values(), *beside))
    said = said_by_nodes(bag, names, diagnostics, scenario, str(config or "the parameters in the bag"))
    run = _run(bag, names, said, str(path))
    run = dataclasses.replace(run, notes=(*run.notes, *foreign))
    reports = bag[diagnostics] if diagnostics in beside and diagnostics in bag else None
    if reports is not None:
        again = restarts.restarts(reports, namespace, run.scenario.grid)
        run = dataclasses.replace(run, notes=(*run.notes, *again))
    return with_timing(run, bag, names, reports, namespace)


def loop_topics(bag: Bag, path: Path, namespace: str | None) -> dict[str, str]:
    """The bag's name of each of the loop's topics. Raises UserError if it holds no loop, or several."""
    found = sorted({name.removesuffix("agv/pose") for name in bag.topics if name.endswith("/agv/pose")})
    if namespace is not None:
        found = [prefix for prefix in found if prefix.strip("/") == namespace.strip("/")]
    if len(found) > 1:
        choice = ", ".join(prefix.rstrip("/") or "/" for prefix in found)
        raise UserError(f"{path}: holds several loops, in the namespaces {choice}: choose one with --namespace")
    prefix = found[0] if found else f"/{namespace.strip('/')}/" if namespace else "/"
    missing = [prefix + topic for topic in _NEEDED if prefix + topic not in bag.topics]
    if missing:
        there = ", ".join(sorted(bag.topics)) or "none at all"
        raise UserError(f"{path}: no recording of the loop, it has no topic {', '.join(missing)}; it has {there}")
    wrong = {topic: bag.topics[prefix + topic].type for topic in _NEEDED if not _has_type(bag, prefix, topic)}
    if wrong:
        is_other = ", ".join(
            f"{prefix}{topic} has the type {kind}, not {TOPICS[topic]}" for topic, kind in wrong.items()
        )
        raise UserError(f"{path}: no recording of the loop: {is_other}")
    return {topic: prefix + topic for topic in TOPICS if _has_type(bag, prefix, topic)}


def _is(bag: Bag, name: str, kind: str) -> bool:
    """Is there a topic of this name and type?"""
    return name in bag.topics and bag.topics[name].type in ("", kind)


def _has_type(bag: Bag, prefix: str, topic: str) -> bool:
    """Is this topic of the loop in the bag, with its own type? A bag may not know the type of what is empty."""
    return _is(bag, prefix + topic, TOPICS[topic])


def _foreign_topics(bag: Bag, prefix: str) -> Iterator[str]:
    """Topics with a name of the loop's and another type, in words."""
    for topic, kind in TOPICS.items():
        if prefix + topic in bag.topics and not _has_type(bag, prefix, topic):
            yield f"{prefix}{topic} has the type {bag.topics[prefix + topic].type}, not {kind}, and is not used"


def _scenario(bag: Bag, path: Path, config: Path | None) -> Scenario:
    if config is not None:
        return load_scenario(str(config))
    embedded = bag.metadata.get(METADATA_NAME, {}).get("params")
    if embedded is None:
        raise UserError(f"{path}: does not carry the parameters of its run: name the run's params file with --config")
    return parse_scenario(embedded, f"parameters in {path}")


def _run(bag: Bag, names: dict[str, str], said: Said, source: str) -> Run:
    scenario = said.scenario
    topics = {topic: on_steps(bag[name], scenario.grid, scenario.plant.window_steps) for topic, name in names.items()}
    stamps = {topic: stamps_of(bag[names[topic]]) for topic in ("agv/pose", "edge/slot")}
    refuse_other_grid(topics, stamps, scenario.grid, source)
    poses, slots = topics["agv/pose"], topics["edge/slot"]
    k = np.intersect1d(poses.k, slots.k, assume_unique=True)
    if not len(k):
        raise UserError(
            f"{source}: no step of the loop in it: {len(bag[names['agv/pose']])} poses and "
            f"{len(bag[names['edge/slot']])} slots, of which {poses.off_grid} and {slots.off_grid} are not on the grid "
            f"of {scenario.plant.start_time:g} s + k * {scenario.plant.ts:g} s: are these the run's parameters?"
        )
    if k[-1] >= _MOST_STEPS:
        raise UserError(
            f"{source}: its last step is {k[-1]}, and the reference is computed from step 0 on, for {_MOST_STEPS} "
            "steps at most: is plant.start_time in the parameters the run's?"
        )
    n_ul, lost, uplink = slot_outcomes(slots, k, scenario.grid)
    ages = topics.get("edge/age", NOTHING)
    if len(ages.k):  # the edge stepped by its own clock, and says itself what it held
        n_ul = slot_outcomes(ages, k, scenario.grid)[0]
    downlink = topics.get("agv/slot", NOTHING)
    n_dl, downlink_lost, of_downlink = (
        slot_outcomes(downlink, k, scenario.grid) if len(downlink.k) else (None, np.zeros_like(lost), None)
    )
    sent = postures(poses, "pose", k, scenario.plant.initial_pose[2])
    true = topics.get("agv/ground_truth", NOTHING)
    is_true_known = bool(true.at(k)[1].all())
    run = Run(
        scenario=scenario,
        k=k,
        pose=postures(true, "pose", k, scenario.plant.initial_pose[2]) if is_true_known else sent,
        measured=sent if is_true_known else None,
        reference=_reference(topics, k, scenario, source),
        error=errors_of(topics["edge/error"], k),
        error_speeds=speeds_of_errors(topics["edge/error"], k),
        command=commands_of(topics["edge/cmd_vel"], k),
        n_ul=n_ul,
        lost=lost,
        downlink_lost=downlink_lost,
        n_dl=n_dl,
        uplink=uplink,
        downlink=of_downlink,
        source=source,
        unexplained=unexplained(topics, scenario.grid),
        parameter_changes=said.changes,
        gains_known=not said.foreign_controller,
    )
    unknown = () if is_true_known or not scenario.plant.is_noisy else (_NO_TRUTH,)
    of_run = (*notes.of_replay(bag), *notes.of_first_step(run))
    of_content = (*notes.of_messages(topics, names), *notes.of_mismatch(run), *notes.of_commands(run))
    foreign = tuple(notes.of_foreign_controller(said.foreign_controller))
    return dataclasses.replace(run, notes=(*bag.problems, *said.notes, *foreign, *of_run, *of_content, *unknown))


def _reference(topics: Mapping[str, OnSteps], k: Steps, scenario: Scenario, source: str) -> Floats:
    """X_r and its speeds at the steps `k`, shape (N, 5): those of the track, or, where paths were driven, as recorded.

    Where the edge did not answer, the recorded ones are interpolated. Raises UserError if there are none.
    """
    if scenario.error_detector.track != PATH:
        return reference_of(scenario.error_detector, int(k[-1]) + 1)[k]
    poses, errors = topics.get("edge/reference_pose", NOTHING), topics["edge/error"]
    known = np.intersect1d(poses.k, errors.k, assume_unique=True)
    if not len(known):
        raise UserError(
            f"{source}: the reference came as a path while the loop ran, and nothing of it is on edge/reference_pose: "
            "without it there is nothing to compare the poses with"
        )
    rows = np.column_stack(
        [postures(poses, "pose", known, scenario.plant.initial_pose[2]), speeds_of_errors(errors, known)]
    )
    return np.column_stack([np.interp(k, known, column) for column in rows.T])
