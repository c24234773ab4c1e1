"""From a recorded bag to a run: messages go to the loop's steps by their stamps, and what is missing is counted."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags import Bag, read_bag
from agv_analysis.bags.writer import METADATA_NAME, REPLAY_OF
from agv_analysis.metrics.convergence import body_errors, wrapped
from agv_analysis.recordings import restarts
from agv_analysis.run import Floats, LinkSlots, Run
from agv_analysis.scenario import Scenario, load_scenario, parse_scenario
from agv_cloud.parameters import PATH
from agv_cloud.reference.reference import Reference
from agv_ros.errors import UserError
from agv_ros.messages import DELAYED, DELIVERED, SQUARED_LENGTH, facts_in, yaw_of_quaternion
from agv_ros.stamps import NS_PER_S, Grid

Steps = NDArray[np.int64]

TOPICS = (
    "agv/pose", "agv/ground_truth", "edge/pose", "edge/slot", "edge/age", "edge/error", "edge/reference_pose",
    "edge/cmd_vel", "agv/cmd_vel", "agv/slot",
)  # fmt: skip

_NEEDED = ("agv/pose", "edge/slot", "edge/error", "edge/cmd_vel")

_NUMBERS = ("position.x", "position.y", "linear.x", "angular.z")
"""Ends of the paths of all numbers that are used, but for those of quaternions."""

_SAME_ERROR = 1e-6
"""Largest difference [m, rad] between a recorded tracking error and the one that follows from track and pose."""


def read_run(path: Path, config: Path | None = None, namespace: str | None = None) -> Run:
    """Run of the loop that is recorded in a rosbag2 directory or an MCAP file.

    Parameters come from `config`, a params file, or from the bag itself. `namespace` chooses one of several loops.
    Raises UserError if the bag cannot be read, holds no loop, or nobody says what its parameters were.
    """
    bag = read_bag(path, topics=())
    names = loop_topics(bag, path, namespace)
    scenario = _scenario(bag, path, config)
    namespace = names["agv/pose"].removesuffix("agv/pose")
    own = f"{namespace}diagnostics"  # of a vehicle of a fleet
    diagnostics = own if own in bag.topics else restarts.TOPIC
    bag = read_bag(path, topics=(*names.values(), diagnostics))
    run = _run(bag, names, scenario, str(path))
    if diagnostics not in bag.topics:
        return run
    again = restarts.restarts(bag[diagnostics], namespace, scenario.grid)
    return dataclasses.replace(run, notes=(*run.notes, *again))


def loop_topics(bag: Bag, path: Path, namespace: str | None) -> dict[str, str]:
    """The bag's name of each of the loop's topics. Raises UserError if it holds no loop, or nobody says which."""
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
    return {topic: prefix + topic for topic in TOPICS if prefix + topic in bag.topics}


def _scenario(bag: Bag, path: Path, config: Path | None) -> Scenario:
    if config is not None:
        return load_scenario(str(config))
    embedded = bag.metadata.get(METADATA_NAME, {}).get("params")
    if embedded is None:
        raise UserError(f"{path}: does not carry the parameters of its run: name the run's params file with --config")
    return parse_scenario(embedded, f"parameters in {path}")


# -- messages on steps ------------------------------------------------------------------------------------------------


class OnSteps(NamedTuple):
    """Messages of one topic, one for each step that has any, by increasing step."""

    k: Steps
    messages: NDArray[np.void]
    off_grid: int
    repeated: int
    unusable: int = 0

    def at(self, k: Steps) -> tuple[Steps, NDArray[np.bool_]]:
        """Index of the message of each of the steps `k`, and whether there is one (else the index means nothing)."""
        if not len(self.k):
            return np.zeros(len(k), dtype=np.int64), np.zeros(len(k), dtype=np.bool_)
        index = np.minimum(np.searchsorted(self.k, k), len(self.k) - 1)
        return index, self.k[index] == k

    def column(self, field: str, k: Steps) -> Floats:
        """A number of each of the steps `k`, shape (N,); NaN where there is no message."""
        index, there = self.at(k)
        values = np.full(len(k), np.nan)
        values[there] = self.messages[field][index[there]]
        return values


_NOTHING = OnSteps(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.void), 0, 0)

_NO_TRUTH = "the AGV measures its pose with noise, and agv/ground_truth is not in the recording: errors hold the noise"


def _stamps(messages: NDArray[np.void], field: str) -> Steps:
    return np.asarray(messages[f"{field}.sec"].astype(np.int64) * NS_PER_S + messages[f"{field}.nanosec"])


def _on_steps(messages: NDArray[np.void], grid: Grid) -> OnSteps:
    k, rest = np.divmod(_stamps(messages, "header.stamp") - grid.start_ns, grid.ts_ns)
    on_grid, usable = (rest == 0) & (k >= 0), _usable(messages)
    taken = on_grid & usable
    first_k, first = np.unique(k[taken], return_index=True)
    return OnSteps(
        k=first_k,
        messages=messages[taken][first],
        off_grid=int(np.count_nonzero(~on_grid)),
        repeated=int(np.count_nonzero(taken)) - len(first),
        unusable=int(np.count_nonzero(on_grid & ~usable)),
    )


def _usable(messages: NDArray[np.void]) -> NDArray[np.bool_]:
    """Which messages are such as a node takes: their numbers are finite, their quaternions have length one; (N,)."""
    usable = np.ones(len(messages), dtype=np.bool_)
    for name in messages.dtype.names or ():
        if name.endswith(_NUMBERS):
            usable &= np.isfinite(messages[name])
        elif name.endswith("orientation.x"):
            turn = name.removesuffix("x")
            with np.errstate(over="ignore", invalid="ignore"):
                squared = sum(messages[f"{turn}{axis}"] ** 2 for axis in "xyzw")
            usable &= np.abs(squared - 1.0) < SQUARED_LENGTH
    return usable


def _run(bag: Bag, names: dict[str, str], scenario: Scenario, source: str) -> Run:
    on_steps = {topic: _on_steps(bag[name], scenario.grid) for topic, name in names.items()}
    poses, slots = on_steps["agv/pose"], on_steps["edge/slot"]
    k = np.intersect1d(poses.k, slots.k, assume_unique=True)
    if not len(k):
        raise UserError(
            f"{source}: no step of the loop in it: {len(bag[names['agv/pose']])} poses and "
            f"{len(bag[names['edge/slot']])} slots, of which {poses.off_grid} and {slots.off_grid} are not on the grid "
            f"of {scenario.plant.start_time:g} s + k * {scenario.plant.ts:g} s: are these the run's parameters?"
        )
    n_ul, lost, uplink = _verdicts(slots, k, scenario.grid)
    ages = on_steps.get("edge/age", _NOTHING)
    if len(ages.k):  # the edge stepped by its own clock, and says itself what it held
        n_ul = _verdicts(ages, k, scenario.grid)[0]
    downlink = on_steps.get("agv/slot")
    n_dl, downlink_lost, of_downlink = (
        (None, np.zeros_like(lost), None) if downlink is None else _verdicts(downlink, k, scenario.grid)
    )
    sent = _postures(poses, "pose", k, scenario.plant.initial_pose[2])
    true = on_steps.get("agv/ground_truth", _NOTHING)
    knows = bool(true.at(k)[1].all())
    run = Run(
        scenario=scenario,
        k=k,
        pose=_postures(true, "pose", k, scenario.plant.initial_pose[2]) if knows else sent,
        measured=sent if knows else None,
        reference=_reference(on_steps, k, scenario, source),
        error=_errors(on_steps["edge/error"], k),
        command=_commands(on_steps["edge/cmd_vel"], k),
        n_ul=n_ul,
        lost=lost,
        downlink_lost=downlink_lost,
        n_dl=n_dl,
        uplink=uplink,
        downlink=of_downlink,
        source=source,
        unexplained=unexplained(on_steps, scenario.grid),
    )
    unknown = () if knows or not scenario.plant.is_noisy else (_NO_TRUTH,)
    return dataclasses.replace(
        run, notes=(*bag.problems, *_replayed(bag), *_begun(run), *_notes(on_steps, names), *_mismatch(run), *unknown)
    )


def _reference(on_steps: Mapping[str, OnSteps], k: Steps, scenario: Scenario, source: str) -> Floats:
    """X_r and its speeds at the steps `k`, shape (N, 5): those of the track, or, where paths were driven, as recorded.

    Where the edge did not answer, the recorded ones are interpolated. Raises UserError if there are none.
    """
    if scenario.error_detector.track != PATH:
        return Reference(scenario.error_detector).first(int(k[-1]) + 1)[k]
    postures, errors = on_steps.get("edge/reference_pose", _NOTHING), on_steps["edge/error"]
    known = np.intersect1d(postures.k, errors.k, assume_unique=True)
    if not len(known):
        raise UserError(
            f"{source}: the reference came as a path while the loop ran, and nothing of it is on edge/reference_pose: "
            "without it there is nothing to compare the poses with"
        )
    speeds = [errors.column(f"twist.twist.{speed}", known) for speed in ("linear.x", "angular.z")]
    rows = np.column_stack([_postures(postures, "pose", known, scenario.plant.initial_pose[2]), *speeds])
    return np.column_stack([np.interp(k, known, column) for column in rows.T])


def _verdicts(slots: OnSteps, k: Steps, grid: Grid) -> tuple[Steps, NDArray[np.bool_], LinkSlots]:
    """Age n(k) in steps of what is held behind a channel, whether slot k was lost, and why; shapes (N,).

    A relay that was started again names no message before it has passed one on; what was held before still is. Where
    nothing has been received yet, the age is the number of steps since step 0.
    """
    index, there = slots.at(k)
    held_ns = np.where(there, _stamps(slots.messages, "time_ref")[index], 0)
    held_ns = np.where(held_ns > 0, held_ns, np.maximum.accumulate(held_ns))
    age = np.where(held_ns > 0, k - (held_ns - grid.start_ns) // grid.ts_ns, k)
    source = slots.messages["source"][index]
    lost = there & (source != DELIVERED.encode()) & (source != DELAYED.encode())
    return age, lost, _reasons(np.where(there, slots.messages["header.frame_id"][index], b""))


def _reasons(notes: NDArray[np.bytes_]) -> LinkSlots:
    """What the notes of slots say, shape (N,). Those of older recordings are empty."""
    said, of = np.unique(notes, return_inverse=True)
    facts = [facts_in(note.decode("utf-8", "replace")) for note in said.tolist()]
    return LinkSlots(
        cause=np.array([fact.get("cause", "") for fact in facts], dtype=np.str_)[of],
        state=np.array([_number(fact, "state", 0.0) for fact in facts], dtype=np.int64)[of],
        gain=np.array([_number(fact, "gain", math.nan) for fact in facts])[of],
        delay=np.array([_number(fact, "delay", 0.0) for fact in facts], dtype=np.int64)[of],
    )


def _number(fact: Mapping[str, str], name: str, absent: float) -> float:
    """A number of a note; `absent` if it is not there, or none."""
    try:
        return float(fact.get(name, absent))
    except ValueError:
        return absent


def _yaws(messages: OnSteps, pose: str, k: Steps) -> Floats:
    """Yaw [rad] in (-pi, pi] at each of the steps `k`; NaN where there is no message."""
    components = [messages.column(f"{pose}.orientation.{axis}", k).tolist() for axis in "xyzw"]
    return np.array([yaw_of_quaternion(*quaternion) for quaternion in zip(*components, strict=True)])


def _postures(messages: OnSteps, pose: str, k: Steps, theta_0: float) -> Floats:
    """Postures (x, y, theta), shape (N, 3); theta counts turns, the first of them the one nearest to `theta_0`."""
    theta = np.unwrap(_yaws(messages, pose, k))
    theta += 2.0 * math.pi * round((theta_0 - theta[0]) / (2.0 * math.pi))
    return np.column_stack([messages.column(f"{pose}.position.{axis}", k) for axis in "xy"] + [theta])


def _errors(messages: OnSteps, k: Steps) -> Floats:
    """Tracking errors as the edge sent them, shape (N, 3); theta_e in (-pi, pi]."""
    position = [messages.column(f"pose.pose.position.{axis}", k) for axis in "xy"]
    return np.column_stack([*position, _yaws(messages, "pose.pose", k)])


def _commands(messages: OnSteps, k: Steps) -> Floats:
    """Commands (v, w), shape (N, 2)."""
    return np.column_stack([messages.column("twist.linear.x", k), messages.column("twist.angular.z", k)])


# -- what is missing --------------------------------------------------------------------------------------------------


def unexplained(on_steps: Mapping[str, OnSteps], grid: Grid) -> dict[str, int]:
    """Messages by topic that should be in the recording, since no channel lost them, and are not.

    Each message of a step follows from the one before it in the loop: a slot from the pose, the forwarded pose from a
    slot that says `delivered`, or `delayed` and until when, the error from a slot behind which a pose is held, and so
    on. The last step may have been under way when the recording ended, and does not count.
    """
    poses = on_steps["agv/pose"].k
    first = max((messages.k[0] for messages in on_steps.values() if len(messages.k)), default=0) if poses[0] else 0
    expected = {
        "agv/pose": np.arange(first, poses[-1] + 1),
        "edge/slot": poses,
        "edge/pose": _passed_on(on_steps["edge/slot"], poses[-1]),
        "edge/error": _where(on_steps["edge/slot"], lambda slots: _stamps(slots, "time_ref") >= grid.start_ns),
        "edge/cmd_vel": on_steps["edge/error"].k,
    }
    if len(on_steps.get("edge/age", _NOTHING).k):
        expected["edge/error"] = on_steps["edge/age"].k
    if len(on_steps.get("edge/reference_pose", _NOTHING).k):
        expected["edge/reference_pose"] = on_steps["edge/error"].k
    if len(on_steps.get("agv/ground_truth", _NOTHING).k):
        expected["agv/ground_truth"] = poses
    if "agv/slot" in on_steps:
        expected["agv/slot"] = on_steps["edge/cmd_vel"].k
        expected["agv/cmd_vel"] = _passed_on(on_steps["agv/slot"], poses[-1])
    missing = {
        topic: int(np.count_nonzero(~on_steps[topic].at(k[(k >= first) & (k < poses[-1])])[1]))
        for topic, k in expected.items()
        if topic in on_steps
    }
    return {topic: count for topic, count in missing.items() if count}


def _passed_on(slots: OnSteps, last: int) -> Steps:
    """Steps whose messages a link has passed on before step `last`."""
    source, delay = slots.messages["source"], _reasons(slots.messages["header.frame_id"]).delay
    came = (source == DELIVERED.encode()) | ((source == DELAYED.encode()) & (slots.k + delay < last))
    return np.asarray(slots.k[came])


def _where(messages: OnSteps, condition: Callable[[NDArray[np.void]], NDArray[np.bool_]]) -> Steps:
    return messages.k[condition(messages.messages)]


def _replayed(bag: Bag) -> Iterator[str]:
    source = bag.metadata.get(METADATA_NAME, {}).get(REPLAY_OF)
    if source is not None:
        yield f"a replay of {source}: errors and commands are new, but the AGV moves as it did there, whatever they are"


def _begun(run: Run) -> Iterator[str]:
    first = int(run.k[0])
    if first > 0:
        yield (
            f"it begins with step {first}, {first * run.scenario.plant.ts:g} s after the run's beginning: settling and "
            "overshoot are those from there on, of the error that was left"
        )


def _notes(on_steps: Mapping[str, OnSteps], names: Mapping[str, str]) -> Iterator[str]:
    for topic, messages in on_steps.items():
        if messages.off_grid:
            yield f"{names[topic]}: {messages.off_grid} messages are no sampling instant's, they are left out"
        if messages.unusable:
            yield f"{names[topic]}: {messages.unusable} messages with numbers that no node takes, they are left out"
        if messages.repeated:
            yield f"{names[topic]}: {messages.repeated} messages repeat a step, the first of each counts"


def _mismatch(run: Run) -> Iterator[str]:
    """A word of warning if the recorded errors do not belong to the track that the parameters name."""
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
