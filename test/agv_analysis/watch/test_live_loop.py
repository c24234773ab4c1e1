"""What a watcher makes of messages: against the run that they encode, and against the analysis of that run."""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from agv_analysis.metrics.outages import outages
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation.single import simulate
from agv_analysis.stability.analysis import analyse
from agv_analysis.watch.controls import controls_of
from agv_analysis.watch.link_margin import NOT_COVERED, STABLE, UNSTABLE, LinkMargin, link_margin
from agv_analysis.watch.live_loop import FAR, POINTS, TOPICS, LiveLoop
from agv_analysis.watch.live_tiles import live_tiles, metres
from agv_analysis.watch.message_log import Heard, MessageLog
from agv_analysis.watch.outage_order import with_outage
from agv_analysis.watch.step_ring import COLUMNS, StepRing
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import losses
from agv_ros.codec import encode_command, encode_error, encode_pose, encode_slot
from agv_ros.messages import DELIVERED, LOST, Command, Slot, StampedPose, TrackingError
from agv_ros.parameters import ParameterError

if TYPE_CHECKING:
    from agv_analysis.run import Run
    from agv_analysis.scenario import Scenario

REPOSITORY = Path(__file__).parents[3]


@functools.cache
def scenario() -> Scenario:
    settings = [
        "plant.duration=10.0",
        "error_detector.corridor=0.25",
        "plant.initial_pose=[0.0, 0.0, 1.5707963267948966]",
    ]
    return load_scenario(str(REPOSITORY / "config/outages.yaml"), settings)


@functools.cache
def run() -> Run:
    return simulate(scenario())


def messages(run: Run) -> list[Heard]:
    """The messages of a run, a topic after the other."""
    grid, found = run.scenario.grid, []
    for i, k in enumerate(run.k.tolist()):
        stamp = grid.stamp(k)
        slot = Slot(stamp, grid.stamp(k - int(run.n_ul[i])), LOST if run.lost[i] else DELIVERED)
        for topic, data in (
            ("edge/slot", encode_slot(slot)),
            ("agv/pose", encode_pose(StampedPose(stamp, *run.pose[i].tolist()))),
            ("edge/error", encode_error(TrackingError(stamp, *run.error[i].tolist(), *run.reference[i, 3:].tolist()))),
            ("agv/cmd_vel", encode_command(Command(stamp, *run.command[i].tolist()))),
        ):
            found.append(Heard(TOPICS.index(topic), data, stamp))
    return sorted(found, key=lambda heard: heard.topic)


@pytest.fixture(scope="module")
def seen() -> LiveLoop:
    loop = LiveLoop(scenario())
    loop.take(messages(run()))
    loop.make_points(is_over=True)
    return loop


def test_losses_and_outages_are_those_of_the_run(seen: LiveLoop) -> None:
    found = outages(run()).uplink
    assert (seen.slots, seen.first, seen.k, seen.skipped) == (2000, 0, 1999, 0)
    assert (seen.lost, seen.longest_outage) == (run().lost.sum(), found.longest)
    np.testing.assert_array_equal(seen.ring.seen("lost", 2000)[1], run().lost)
    np.testing.assert_array_equal(seen.ring.seen("age", 2000)[1], run().n_ul)


def test_points_hold_the_largest_deviation_and_age_of_their_steps(seen: LiveLoop) -> None:
    points = dict(zip(POINTS, np.array(seen.points).T, strict=True))
    distance = np.hypot(*(run().pose - run().reference[:, :3])[:, :2].T).reshape(200, 10)
    np.testing.assert_allclose(points["deviation"], distance.max(axis=1), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(points["age"], run().n_ul.reshape(200, 10).max(axis=1) * 0.005, atol=1e-12)
    np.testing.assert_array_equal(points["lost"], run().lost.reshape(200, 10).sum(axis=1))
    np.testing.assert_allclose(points["time"], run().time[9::10] - run().time[0], atol=1e-9)
    np.testing.assert_allclose(points["speed"], run().command[9::10, 0], atol=1e-12)


def test_what_is_not_seen_is_counted_and_not_made_up() -> None:
    loop = LiveLoop(scenario())
    stamps = {scenario().grid.stamp(k) for k in range(300, 320)}
    loop.take(
        heard for heard in messages(run()) if heard.received_ns not in stamps and heard.received_ns > 1_500_000_000
    )
    loop.make_points(is_over=True)
    assert (loop.first, loop.slots, loop.skipped) == (101, 1899 - 20, 20)
    gaps = [point for point in loop.points if math.isnan(point[POINTS.index("deviation")])]
    assert [round(point[0] / 0.005) for point in gaps] == [309, 319]
    assert f"{loop.skipped} slots not seen" in next(
        tile.note for tile in live_tiles(loop, None, {}) if tile.key == "losses"
    )


def test_the_newest_value_is_that_before_a_gap_of_its_topic() -> None:
    loop, k = LiveLoop(scenario()), 1949
    late = scenario().grid.stamp(k)
    loop.take(
        heard for heard in messages(run()) if heard.topic != TOPICS.index("agv/pose") or heard.received_ns <= late
    )
    assert loop.k == 1999
    distance = math.hypot(*(run().pose[k, :2] - run().reference[k, :2]))
    step, deviation = loop.latest_deviation()
    assert (step, round(deviation, 12)) == (k, round(distance, 12))
    assert loop.latest("x") == run().pose[k, 0]


def test_a_wild_stamp_is_refused_and_a_loop_that_has_leapt_is_followed() -> None:
    loop, grid = LiveLoop(scenario()), scenario().grid
    window = round(FAR / scenario().plant.ts)

    def slots(*steps: int) -> None:
        slots = (Slot(grid.stamp(k), grid.stamp(k), DELIVERED) for k in steps)
        loop.take(Heard(TOPICS.index("edge/slot"), encode_slot(slot), slot.stamp_ns) for slot in slots)

    slots(*range(5), 10 * window, *range(5, 8))
    assert (loop.k, loop.slots, loop.rejected["edge/slot"]) == (7, 8, 1)
    slots(*range(10 * window, 10 * window + 20))
    assert loop.k == 10 * window + 19
    loop.make_points()
    assert len(loop.points) <= loop.most_points


def test_a_loop_that_begins_anew_is_told_from_late_messages(seen: LiveLoop) -> None:
    loop = LiveLoop(scenario())
    loop.take(messages(run()))
    loop.take(messages(run())[:50])
    assert (loop.restarts, loop.slots, loop.k) == (1, 50, 49)


def test_the_tiles_say_what_the_analysis_says(seen: LiveLoop) -> None:
    margin = link_margin(scenario().to_yaml(), *seen.ring.seen("lost", 2000)[:1], run().lost, "")
    analysis = analyse(run())
    assert margin.word == STABLE
    assert margin.probability_stable == analysis.evidence.probability_stable
    assert margin.guaranteed == 14
    tiles = {tile.key: tile for tile in live_tiles(seen, margin, {"missed deadlines": "3", "step": "2000"})}
    assert tiles["losses"].value == f"{100.0 * run().lost.mean():.2f} %"
    largest = float(np.hypot(*(run().pose - run().reference[:, :3])[:, :2].T).max())
    assert tiles["deviation"].note == f"at most {largest:.3f} m in the last 10 s"
    assert tiles["corridor"].value == f"0.25 m: {'left' if largest > 0.25 else 'kept'}"
    assert tiles["deadlines"].value == "3"


def test_the_largest_deviation_is_no_smaller_than_that_of_now() -> None:
    """At the peak of the run's largest excursion, whose step is in no point yet."""
    distance = np.hypot(*(run().pose - run().reference[:, :3])[:, :2].T)
    loop, now = LiveLoop(scenario()), scenario().grid.stamp(int(distance.argmax()))
    loop.take(heard for heard in messages(run()) if heard.received_ns <= now)
    loop.make_points()
    tile = next(tile for tile in live_tiles(loop, None, {}) if tile.key == "deviation")
    assert tile.value == metres(float(distance.max()))
    assert tile.note.startswith(f"at most {tile.value} in the last ")


@pytest.mark.parametrize(
    ("value", "said"),
    [(0.15374, "0.154 m"), (9.9994, "9.999 m"), (12.3456, "12.35 m"), (6354.381, "6354 m"), (math.nan, "not known"),
     (math.inf, "diverges")],
)  # fmt: skip
def test_distances_have_millimetres_where_they_mean_something(value: float, said: str) -> None:
    assert metres(value) == said


def test_nothing_is_called_stable_whose_commands_came_late(seen: LiveLoop) -> None:
    margin = LinkMargin(STABLE, "", probability_stable=0.999, slots=2000)
    word = {
        missed: live_tiles(seen, margin, {"missed deadlines": missed, "step": "2000"})[0].value
        for missed in ("20", "21")
    }
    assert word == {"20": STABLE, "21": NOT_COVERED}


def test_a_link_that_the_loop_cannot_take_is_called_so() -> None:
    params, k = scenario().to_yaml(), np.arange(20_000)
    assert link_margin(params, k, k % 61 < 60, "").word == UNSTABLE
    assert link_margin(params, k, k < 0, "commands are lost").word == NOT_COVERED


def test_an_outage_that_is_asked_for_takes_exactly_its_slots() -> None:
    uplink = ChannelParameters(schedule="1: p=0.5")
    schedule = with_outage(uplink, 123, 20, 0.005)
    found = losses(
        ChannelParameters(schedule=with_outage(ChannelParameters(schedule=schedule), 300, 7, 0.005)), 1, "uplink", 400
    )
    assert np.flatnonzero(found).tolist() == [*range(123, 143), *range(300, 307)]
    with pytest.raises(ParameterError, match="come again"):
        with_outage(ChannelParameters(schedule="outage=0.1 every 5"), 1, 1, 0.005)


def test_the_log_gives_back_what_it_was_given_for_as_long_as_it_keeps_it() -> None:
    log = MessageLog(10.0)
    given = [Heard(i % 7, bytes([i % 256] * 90), i * 10_000_000) for i in range(5000)]
    for i in range(0, 5000, 700):
        log.add(given[i : i + 700])
    kept = list(log.messages())
    assert kept == given[-len(kept) :]
    assert 1000 <= len(kept) <= 1000 + 1024


def test_a_ring_forgets_steps_that_are_too_old() -> None:
    ring = StepRing(8)
    for k in range(12):
        ring.put(k, "x", float(k), -1.0, 0.0)
    ring.put(3, "x", 99.0, 0.0, 0.0)
    x = ring.rows(2, 13)[:, COLUMNS.index("x")]
    assert x[2:10].tolist() == list(range(4, 12))
    assert np.isnan(x[[0, 1, 10]]).all()


def test_sliders_are_those_of_the_law_and_of_the_channel() -> None:
    targets = [control["target"] for control in controls_of(scenario())]
    gains = [f"controller.{name}" for name in ("kx", "ky", "ktheta", "v_max")]
    assert targets == [*gains, "relay.uplink.p", "relay.uplink.r"]
    v_max = next(control for control in controls_of(scenario()) if control["target"] == "controller.v_max")
    assert (v_max["value"], v_max["values"][-1], v_max["values"][0]) == (None, None, 0.5)
