"""Runs in real time whose timing was not what their stamps say, from bags with log times of known delays.

The values are those of a simulated run, written with our own writer; only the log times differ. Ages are recomputed by
following all events in the order of their log times, one by one.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from agv_analysis.bags.rosbag2_metadata import TopicInfo
from agv_analysis.bags.writer import REPLAY_OF, BagWriter
from agv_analysis.recordings.loop_timing import is_more_than_jitter
from agv_analysis.recordings.recording import read_run
from agv_analysis.report.panels import age as age_panel
from agv_analysis.report.table import rows
from agv_analysis.run import Run
from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.stability.analysis import analyse, observe
from agv_analysis.stability.criteria.criterion import RunFacts
from agv_analysis.stability.criteria.recorded_losses import CRITERION
from agv_analysis.stability.verdict import ASYMPTOTIC, MEAN_SQUARE
from agv_ros.codec import encode_command, encode_diagnostics, encode_error, encode_pose, encode_slot
from agv_ros.messages import DELIVERED, LOST, Command, Slot, StampedPose, TrackingError

REPOSITORY = Path(__file__).parents[3]
MS = 1_000_000
T = 5 * MS
OFFSET = 1_700_000_000_123_456_789
"""The recorder's clock minus the AGV's [ns]."""

ON_THE_WAY = {
    "agv/pose": 0.1, "edge/pose": 0.3, "edge/slot": 0.4, "edge/error": 0.5, "edge/cmd_vel": 0.8, "agv/cmd_vel": 1.0,
    "agv/slot": 1.1,
}  # fmt: skip
"""Log time of a message after the instant of its step if nothing is late [ms]."""

KINDS = {
    "agv/pose": "PoseStamped", "edge/pose": "PoseStamped", "edge/slot": "TimeReference", "edge/error": "Odometry",
    "edge/cmd_vel": "TwistStamped", "agv/cmd_vel": "TwistStamped", "agv/slot": "TimeReference",
    "/diagnostics": "DiagnosticArray",
}  # fmt: skip

Delay = Callable[[int], float]
"""Step -> how much later than on time its message came [ms]."""


def definitions() -> dict[str, tuple[str, str]]:
    """Type and definition of each type of the loop, from the sample bag."""
    with next((REPOSITORY / "bags/sample").glob("*.mcap")).open("rb") as file:
        schemas = make_reader(file).get_summary()
        assert schemas is not None
        return {schema.name.split("/")[-1]: (schema.name, schema.data.decode()) for schema in schemas.schemas.values()}


def simulated(steps: int, *settings: str) -> Run:
    quick = (f"plant.duration={steps * 0.005}", "plant.clock=realtime", *settings)
    return simulate(load_scenario(str(REPOSITORY / "config/paper.yaml"), quick))


def payloads(run: Run, i: int) -> dict[str, bytes]:
    """The messages of a step by topic, those that the run lost left out."""
    grid = run.scenario.grid
    stamp, k = grid.stamp(int(run.k[i])), int(run.k[i])
    up, down = (LOST if lost[i] else DELIVERED for lost in (run.lost, run.downlink_lost))
    n_dl = 0 if run.n_dl is None else int(run.n_dl[i])
    made = {
        "agv/pose": encode_pose(StampedPose(stamp, *run.pose[i].tolist())),
        "edge/pose": encode_pose(StampedPose(stamp, *run.pose[i].tolist())),
        "edge/slot": encode_slot(Slot(stamp, grid.stamp(k - int(run.n_ul[i])), up)),
        "edge/error": encode_error(TrackingError(stamp, *run.error[i].tolist(), *run.reference[i, 3:].tolist())),
        "edge/cmd_vel": encode_command(Command(stamp, *run.command[i].tolist())),
        "agv/cmd_vel": encode_command(Command(stamp, *run.command[i].tolist())),
        "agv/slot": encode_slot(Slot(stamp, grid.stamp(k - n_dl), down)),
    }
    gone = {"edge/pose"} if run.lost[i] else set()
    gone |= {"agv/cmd_vel"} if run.downlink_lost[i] else set()
    return {topic: data for topic, data in made.items() if topic not in gone}


def write(
    path: Path, run: Run, delays: Mapping[str, Delay] | None = None, reports: tuple[dict[str, str], ...] = (),
    again: tuple[str, ...] = (), log_time: Callable[[int, str], int] | None = None,
    about: Mapping[str, str] | None = None, params: Scenario | None = None, without: tuple[str, ...] = (),
) -> tuple[Path, dict[str, dict[int, int]]]:  # fmt: skip
    """A bag of the run; and the log time of each message by topic and step, of those that come twice the first."""
    known, grid = definitions(), run.scenario.grid
    names = [topic if topic.startswith("/") else f"/{topic}" for topic in KINDS]

    def described(name: str, kind: str) -> Callable[[], TopicInfo]:
        return lambda: TopicInfo(name, *known[kind], "", [{"depth": 10}] if name != "/diagnostics" else [])

    embedded = {"version": "0", "params": (params or run.scenario).to_yaml(), **(about or {})}
    describe = [described(*pair) for pair in zip(names, KINDS.values(), strict=True)]
    writer = BagWriter(path, describe, embedded, by_stamp=False)
    numbers = {topic: number for number, topic in enumerate(KINDS)}
    logs: dict[str, dict[int, int]] = {topic: {} for topic in KINDS}
    pending: list[tuple[int, int, bytes, int]] = []
    for i, k in enumerate(run.k.tolist()):
        stamp = grid.stamp(k)
        for topic, data in payloads(run, i).items():
            if topic in without:
                continue
            late = delays[topic](k) if delays is not None and topic in delays else 0.0
            log = stamp + OFFSET + round((ON_THE_WAY[topic] + late) * MS)
            log = log if log_time is None else log_time(stamp, topic)
            logs[topic][k] = log
            pending.append((log, numbers[topic], data, stamp))
            if topic in again:
                pending.append((log + 3 * T, numbers[topic], data, stamp))
    for number, facts in enumerate(reports):
        stamp = grid.stamp(number * 200)
        data = encode_diagnostics(stamp, 0, "plant", "", facts)
        pending.append((stamp + OFFSET, numbers["/diagnostics"], data, stamp))
    for log, topic_number, data, stamp in sorted(pending):
        writer.write(topic_number, data, log, stamp)
    writer.close()
    return path, logs


def followed(logs: Mapping[str, Mapping[int, int]], steps: int) -> tuple[list[int], list[int], list[int]]:
    """Ages at the edge, of the command, and of the pose behind it, at the end of each step: event by event."""
    by_time = [(log, {"edge/pose": 0, "edge/cmd_vel": 1, "agv/cmd_vel": 2}[topic], k)
               for topic in ("edge/pose", "edge/cmd_vel", "agv/cmd_vel") for k, log in logs[topic].items()]  # fmt: skip
    start = min(log - k * T for k, log in logs["agv/pose"].items())
    by_time += [(logs["agv/pose"].get(k + 1, start + (k + 1) * T), -1, k) for k in range(steps)]
    pose, command, behind = 0, 0, {0: 0}
    ages: list[tuple[int, int, int]] = []
    waiting: list[int] = []
    arrived: list[int] = []
    for _, kind, k in sorted(by_time):
        if kind == 0:
            arrived.append(k)
            pose = max(pose, k)
        elif kind == 1:
            waiting.append(k)
        elif kind == 2:
            command = max(command, k)
        else:  # step k ends: poses that came until here count for its command
            for sent in waiting:
                behind[sent] = max((j for j in arrived if j <= sent), default=0)
            waiting = []
            ages.append((k - pose, k - command, k - behind.get(command, 0)))
    return tuple([list(column) for column in zip(*ages, strict=True)])  # type: ignore[return-value]


def burst(k: int, period: int = 1200, waits: int = 1000) -> float:
    """For `waits` of every `period` steps messages wait, then they come together: by how much each is later [ms]."""
    return max(0, waits - k % period) * 5.0


def notes_of(run: Run) -> str:
    return "\n".join(run.notes)


def received(run: Run) -> tuple[list[int], list[int], list[int]]:
    assert run.n_ul_received is not None
    assert run.n_dl_received is not None
    return run.n_ul_received.tolist(), run.n_dl_received.tolist(), run.command_age.tolist()


def test_what_comes_in_time_has_the_ages_of_its_slots(tmp_path: Path) -> None:
    truth = simulated(600, "relay.uplink.model=bernoulli", "relay.uplink.p=0.3", "relay.downlink.model=bernoulli",
                      "relay.downlink.p=0.2")  # fmt: skip
    run = read_run(write(tmp_path / "bag", truth)[0])
    assert not run.is_late
    assert run.n_ul_received is not None
    assert run.n_dl_received is not None
    np.testing.assert_array_equal(run.n_ul_received, truth.n_ul)
    np.testing.assert_array_equal(run.n_dl_received, truth.n_dl)
    assert run.command_age is run.n_ul
    assert not RunFacts(run).is_late


@pytest.mark.parametrize("seed", [1, 2])
def test_jitter_of_less_than_a_period_is_nothing(tmp_path: Path, seed: int) -> None:
    noise = np.random.default_rng(seed).uniform(0.0, 3.8, (len(KINDS), 600))
    delays: dict[str, Delay] = {topic: lambda k, row=noise[i]: float(row[k]) for i, topic in enumerate(KINDS)}  # type: ignore[misc]
    run = read_run(write(tmp_path / "bag", simulated(600), delays)[0])
    assert run.timing is not None
    assert (run.is_late, run.timing.late_poses, run.timing.late_commands) == (False, 0, 0)
    assert run.notes == ("the plant's diagnostics are not in the recording: missed deadlines are not known",)


def test_poses_that_wait_and_come_together_have_the_age_of_the_wait(tmp_path: Path) -> None:
    """Nothing is lost, but for 5 of every 6 s poses wait, as over a reliable connection that stalls."""
    run = read_run(write(tmp_path / "bag", simulated(2600), {"edge/pose": burst})[0])
    assert not run.lost.any()
    assert run.n_ul.max() == 0
    at_edge = [0 if k % 1200 >= 1000 else k % 1200 + (k >= 1200) for k in range(2600)]
    n_ul, n_dl, acted = received(run)
    assert n_ul == at_edge
    assert max(n_dl) == 0
    assert acted == at_edge
    assert "age by receive time at most 1000 steps (5 s)" in notes_of(run)
    facts = RunFacts(run)
    assert facts.is_late
    assert facts.n == 1000
    judged = CRITERION.judge(facts)
    assert judged is not None
    assert judged.stable is False
    analysed = analyse(run)
    assert analysed.verdict.word not in (ASYMPTOTIC, MEAN_SQUARE)
    assert analysed.judgements["mean_square"].stable is None
    assert "bursts" not in analysed.judgements
    assert any("at most 1000 steps (5 s)" in value for name, value in rows(analysed) if name == "Age by receive time")
    assert [len(line.x) for line in age_panel(run).lines] == [2600, 2600]
    found = analysed.to_json()
    assert found["timing"]["late"]
    assert (found["n_ul_max"], found["timing"]["command_age_max"]) == (0, 1000)


def test_an_edge_that_answers_when_the_poses_come_has_late_commands_of_the_same_age(tmp_path: Path) -> None:
    late = {topic: burst for topic in KINDS if topic not in ("agv/pose", "/diagnostics")}
    run = read_run(write(tmp_path / "bag", simulated(1500), late)[0])
    n_ul, n_dl, acted = received(run)
    assert max(n_ul[1200:]) == max(n_dl[1200:]) == max(acted[1200:]) == 300
    assert acted == [0 if 1000 <= k < 1200 else k % 1200 + (k >= 1200) for k in range(1500)]
    assert run.is_late


def test_a_recorder_behind_the_same_connection_hears_the_agv_as_late_as_the_edge_does(tmp_path: Path) -> None:
    """Also where only the end of the recording shows how early a message can come."""
    late: dict[str, Delay] = dict.fromkeys(ON_THE_WAY, burst)
    run = read_run(write(tmp_path / "bag", simulated(1190), late)[0])
    assert run.is_late
    assert run.command_age.max() in (998, 999, 1000)


def test_log_times_of_a_bag_that_was_written_in_one_go_say_nothing(tmp_path: Path) -> None:
    run = read_run(write(tmp_path / "bag", simulated(400), log_time=lambda stamp, topic: OFFSET + stamp // 50)[0])
    assert run.n_ul_received is None
    assert "log times last less than a twentieth of what the stamps do" in notes_of(run)


def late_by(steps: Mapping[int, float]) -> Delay:
    return lambda k: 5.0 * steps.get(k, 0.0)


REORDERED = {k: float((7 * k) % 5) for k in range(100, 160)}

CASES: dict[str, tuple[dict[str, Delay], tuple[str, ...]]] = {
    "bursts of poses": ({"edge/pose": lambda k: burst(k, 90, 40)}, ()),
    "poses in another order": ({"edge/pose": late_by(REORDERED)}, ()),
    "poses that come twice": ({"edge/pose": lambda k: burst(k, 50, 20)}, ("edge/pose",)),
    "commands late": ({"agv/cmd_vel": lambda k: burst(k, 120, 30)}, ()),
    "commands in another order": ({"agv/cmd_vel": late_by(REORDERED)}, ("agv/cmd_vel",)),
    "a slow edge": ({topic: lambda k: 6.0 for topic in ("edge/cmd_vel", "agv/cmd_vel")}, ()),
    "both": ({"edge/pose": lambda k: burst(k, 70, 30), "agv/cmd_vel": lambda k: burst(k + 17, 110, 25)}, ()),
    "a queue that grows": ({"edge/pose": lambda k: 0.04 * k}, ()),
    "a stall of the plant": ({topic: lambda k: burst(k, 200, 12) for topic in KINDS}, ()),
}


@pytest.mark.parametrize("name", CASES)
def test_ages_are_those_of_following_every_event(tmp_path: Path, name: str) -> None:
    delays, again = CASES[name]
    truth = simulated(400, "relay.uplink.model=bernoulli", "relay.uplink.p=0.1")
    reports = ({"missed deadlines": "0", "jitter max": "0.1", "step": "400"},)
    path, logs = write(tmp_path / "bag", truth, delays, reports, again)
    run = read_run(path)
    n_ul, n_dl, acted = followed(logs, 400)
    assert received(run)[0] == n_ul
    assert received(run)[1] == n_dl
    assert run.is_late
    assert run.command_age.tolist() == np.maximum(acted, truth.n_ul).tolist()
    assert max(acted) > truth.n_ul.max() or name == "a slow edge"


def test_another_clock_that_drifts_makes_nothing_late(tmp_path: Path) -> None:
    run = read_run(
        write(tmp_path / "bag", simulated(4000), log_time=lambda stamp, topic: int(
            stamp * (1.0 - 120e-6) + round(ON_THE_WAY[topic] * MS)) + OFFSET)[0]
    )  # fmt: skip
    assert not run.is_late
    assert received(run)[0] == [0] * 4000


def test_missed_deadlines_are_counted_and_said(tmp_path: Path) -> None:
    """Of every 8 steps the plant takes the last one together with the next: the command of that step comes too late."""
    truth = simulated(1200)
    missed = [k for k in range(1200) if k % 8 == 7]
    late = {topic: late_by(dict.fromkeys(missed, 1.0)) for topic in ON_THE_WAY}
    reports = tuple(
        {"missed deadlines": str(count), "jitter max": str(jitter), "stops without command": "0",
         "outdated commands": "0", "step": str(step)}
        for count, jitter, step in ((0, 0.0001, 1), (100, 0.012, 800), (150, 0.004, 1200))
    )  # fmt: skip
    run = read_run(write(tmp_path / "bag", truth, late, reports)[0])
    assert "150 of 1200 deadlines missed, the longest by 12 ms; the AGV held its command" in run.notes
    assert run.timing is not None
    assert (run.timing.missed_deadlines, run.timing.deadlines, run.timing.longest_overdue) == (150, 1200, 0.012)
    assert run.is_late
    assert [k for k in range(1200) if run.command_age[k]] == missed
    assert run.command_age.max() == 1


def test_a_plant_that_was_started_again_goes_on_counting(tmp_path: Path) -> None:
    reports = tuple({"missed deadlines": str(count)} for count in (3, 5, 1, 4))
    run = read_run(write(tmp_path / "bag", simulated(800), reports=reports)[0])
    assert run.timing is not None
    assert run.timing.missed_deadlines == 9


def test_commands_that_the_agv_ignored_did_not_act(tmp_path: Path) -> None:
    """The edge is far ahead of the AGV: a command comes 0.5 s before its instant, and the AGV ignores those.

    It has a lag, so that its motion does not say which command it obeys.
    """
    truth = simulated(400, "plant.lag=0.1")
    ahead = {"edge/cmd_vel": lambda k: -508.0 * (k % 2), "agv/cmd_vel": lambda k: -508.0 * (k % 2)}
    said = {"missed deadlines": "0", "outdated commands": "200"}
    run = read_run(write(tmp_path / "bag", truth, ahead, (said,))[0])
    assert received(run)[1][120:] == [k % 2 for k in range(120, 400)]
    assert run.is_late
    trusted = read_run(write(tmp_path / "other", truth, ahead, ({**said, "outdated commands": "0"},))[0])
    assert not trusted.is_late


@pytest.mark.parametrize("taken_late", [{}, {k: k - 99 for k in range(100, 112)} | {200: 1, 201: 2, 300: 3}])
def test_the_motion_says_which_command_the_agv_obeyed(tmp_path: Path, taken_late: dict[int, int]) -> None:
    """The recorder hears every command in time, but the AGV takes some of them later."""
    truth = simulated(400)
    x, y, theta = truth.pose[0].tolist()
    poses = [(x, y, theta)]
    for k in range(399):
        v, w = truth.command[k - taken_late.get(k, 0)].tolist()
        x, y, theta = x + 0.005 * v * math.cos(theta), y + 0.005 * v * math.sin(theta), theta + 0.005 * w
        poses.append((x, y, theta))
    run = read_run(write(tmp_path / "bag", dataclasses.replace(truth, pose=np.array(poses)))[0])
    assert received(run)[1] == [taken_late.get(k, 0) for k in range(400)]
    assert run.is_late == bool(taken_late)


def test_where_log_times_are_stamps_the_run_says_that_it_does_not_know(tmp_path: Path) -> None:
    run = read_run(write(tmp_path / "bag", simulated(400), log_time=lambda stamp, topic: stamp)[0])
    assert "log times are the stamps: when poses and commands came is not recorded" in notes_of(run)
    assert run.n_ul_received is None
    assert not run.is_late
    assert observe(run).to_json()["timing"]["late"] is None


@pytest.mark.parametrize("change", [{"params": "lockstep"}, {"about": {REPLAY_OF: "other"}}])
def test_lockstep_and_replays_have_no_timing(tmp_path: Path, change: dict[str, Any]) -> None:
    """Their log times, if they are those of the wall, have nothing to do with the sampling period."""
    if "params" in change:
        change = {"params": simulated(400, "plant.clock=lockstep").scenario}
    run = read_run(write(tmp_path / "bag", simulated(400), {"edge/pose": burst}, **change)[0])
    assert run.timing is None
    assert run.n_ul_received is None
    assert not [note for note in run.notes if "deadlines" in note or "late" in note]


def test_one_step_now_and_then_is_jitter() -> None:
    excess = np.zeros(1000, dtype=np.int64)
    excess[:10] = 1
    assert not is_more_than_jitter(excess)
    excess[10] = 1
    assert is_more_than_jitter(excess)
    assert is_more_than_jitter(np.array([0] * 10_000 + [2]))


def test_without_the_poses_at_the_edge_only_commands_are_held_against_the_clock(tmp_path: Path) -> None:
    late: dict[str, Delay] = {"agv/cmd_vel": lambda k: burst(k, 90, 40)}
    run = read_run(write(tmp_path / "bag", simulated(400), late, without=("edge/pose",))[0])
    assert run.n_ul_received is None
    assert "edge/pose is not in the recording: when poses came to the edge is not known" in run.notes
    assert run.is_late
    assert run.command_age.max() == 40


def test_the_growth_of_a_late_run_is_that_of_its_own_ages(tmp_path: Path) -> None:
    """Poses wait for 55 of 60 steps: the error along a straight track, e(k+1) = e(k) - a e(k - n(k)), grows fastest."""
    run = read_run(write(tmp_path / "bag", simulated(600, "error_detector.track=line"),
                         {"edge/pose": lambda k: burst(k, 60, 55)})[0])  # fmt: skip
    a, errors = run.ts * run.scenario.controller.kx, [1.0]
    for k in range(600):
        errors.append(errors[k] - a * errors[k - int(run.command_age[k])])
    judged = CRITERION.judge(RunFacts(run))
    assert judged is not None
    assert judged.values["floquet_multiplier_per_step"] == pytest.approx(abs(errors[-1]) ** (1 / 600), rel=1e-6)
    assert abs(errors[-1]) > 1.0
    assert judged.stable is False


def test_an_agv_that_stopped_is_not_judged_as_one_that_held_its_command(tmp_path: Path) -> None:
    run = read_run(write(tmp_path / "bag", simulated(1000), {"agv/cmd_vel": lambda k: burst(k, 400, 200)})[0])
    assert run.n_dl_received is not None
    assert run.n_dl_received.max() * run.ts > run.scenario.plant.cmd_vel_timeout
    judged = CRITERION.judge(RunFacts(run))
    assert judged is not None
    assert judged.stable is None
