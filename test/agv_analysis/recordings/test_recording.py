"""From bag to run: what is put where, and that nothing goes missing without a word.

Bags are made from the sample bag's messages with the mcap library, with messages taken out or changed.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from agv_analysis.metrics.convergence import wrapped
from agv_analysis.recordings.recording import TOPICS, read_run
from agv_analysis.scenario import load_scenario
from agv_ros.codec import decode_slot, encode_slot
from agv_ros.errors import UserError
from agv_ros.messages import DELAYED, DELIVERED, LOST

REPOSITORY = Path(__file__).parents[3]
SAMPLE = REPOSITORY / "bags/sample"

Change = Callable[[str, int, bytes], list[bytes]]
"""(topic, step, payload) -> what is written instead of it."""


def step_of(data: bytes) -> int:
    sec, nanosec = struct.unpack_from("<iI", data, 4)
    return int(sec * 1_000_000_000 + nanosec - 1_000_000_000) // 5_000_000


def messages() -> Iterator[tuple[str, str, bytes, int, bytes]]:
    """(topic, type, definition, log time, payload) of the sample bag."""
    with next(SAMPLE.glob("*.mcap")).open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            assert schema is not None
            yield channel.topic, schema.name, schema.data, message.log_time, message.data


def changed_bag(path: Path, change: Change, prefixes: tuple[str, ...] = ("",)) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        channels: dict[str, int] = {}
        for topic, kind, definition, log_time, data in messages():
            for name in [prefix + topic for prefix in prefixes]:
                if name not in channels:
                    schema = writer.register_schema(kind, "ros2msg", definition)
                    channels[name] = writer.register_channel(name, "cdr", schema)
                for payload in change(topic, step_of(data), data):
                    writer.add_message(channels[name], log_time, payload, log_time)
        params = load_scenario(str(REPOSITORY / "config/outages.yaml"), ["plant.duration=10.0"]).to_yaml()
        writer.add_metadata("agv_ncs", {"params": params})
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def unchanged(topic: str, k: int, data: bytes) -> list[bytes]:
    return [data]


def test_the_sample_bag_is_whole() -> None:
    run = read_run(SAMPLE)
    assert len(run) == 2000
    assert not run.unexplained
    np.testing.assert_array_equal(run.k, np.arange(2000))
    assert run.pose[0].tolist() == pytest.approx([0.0, 5.0, np.pi / 2])
    assert run.n_ul.max() == np.where(run.lost, run.n_ul, 0).max() > 0
    assert (run.n_ul == 0).tolist() == (~run.lost).tolist()


def test_a_recording_from_before_slots_said_why_says_nothing() -> None:
    run = read_run(SAMPLE)
    for link in (run.uplink, run.downlink):
        assert link is not None
        assert not link.cause.any()
        assert not link.delay.any()
        assert np.isnan(link.gain).all()
    assert run.n_dl is not None
    assert not run.n_dl.any()


def test_a_note_is_read_as_far_as_it_can_be(tmp_path: Path) -> None:
    notes = {
        3: "cause=rayleigh run=2 gain=-23.50", 4: "gain=x delay=y state=1", 5: "what = is this", 6: "", 7: "gain=inf",
    }  # fmt: skip

    def noted(topic: str, k: int, data: bytes) -> list[bytes]:
        if topic != "/edge/slot" or k not in notes:
            return [data]
        return [encode_slot(decode_slot(data)._replace(outcome=LOST if k == 3 else DELIVERED, note=notes[k]))]

    run = read_run(changed_bag(tmp_path / "bag.mcap", noted))
    assert run.uplink is not None
    assert run.uplink.cause[2:9].tolist() == ["", "rayleigh", "", "", "", "", ""]
    assert run.uplink.state[2:9].tolist() == [0, 0, 1, 0, 0, 0, 0]
    assert run.uplink.delay[2:9].tolist() == [0] * 7
    np.testing.assert_array_equal(run.uplink.gain[2:9], [np.nan, -23.5, np.nan, np.nan, np.nan, np.inf, np.nan])


@pytest.mark.parametrize("arrives", [False, True])
def test_a_late_pose_is_missed_only_if_the_recording_goes_on_until_it_comes(tmp_path: Path, arrives: bool) -> None:
    """Slot 1990 says that its pose comes eight slots later, before the last one, or nine: the run had ended."""

    def late(topic: str, k: int, data: bytes) -> list[bytes]:
        if topic == "/edge/pose" and k == 1990:
            return []
        if topic == "/edge/slot" and k == 1990:
            return [encode_slot(decode_slot(data)._replace(outcome=DELAYED, note=f"delay={8 if arrives else 9}"))]
        return [data]

    run = read_run(changed_bag(tmp_path / "bag.mcap", late))
    assert not run.lost[1990]
    assert run.unexplained == ({"edge/pose": 1} if arrives else {})


def test_recorded_errors_are_those_of_the_pose_that_the_edge_held() -> None:
    run = read_run(SAMPLE)
    held = run.pose[run.k - run.n_ul]
    d, c, s = run.reference[:, :3] - held, np.cos(held[:, 2]), np.sin(held[:, 2])
    expected = np.column_stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], wrapped(d[:, 2])])
    np.testing.assert_allclose(run.error, expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("topic", "steps"),
    [("/agv/pose", (100, 200)), ("/edge/slot", (50,)), ("/edge/error", (7, 8, 9)), ("/edge/cmd_vel", (1,)),
     ("/agv/slot", (1500,)), ("/agv/cmd_vel", (3, 4))],
)  # fmt: skip
def test_a_message_that_no_channel_lost_is_counted(tmp_path: Path, topic: str, steps: tuple[int, ...]) -> None:
    run = read_run(
        changed_bag(tmp_path / "bag.mcap", lambda name, k, data: [] if name == topic and k in steps else [data])
    )
    assert run.unexplained == {topic.lstrip("/"): len(steps)}


def test_a_forwarded_pose_that_the_relay_says_it_delivered_is_missed(tmp_path: Path) -> None:
    received = int(np.flatnonzero(~read_run(SAMPLE).lost)[17])
    run = read_run(
        changed_bag(
            tmp_path / "bag.mcap",
            lambda name, k, data: [] if name == "/edge/pose" and k == received else [data],
        )
    )
    assert run.unexplained == {"edge/pose": 1}


def test_a_recording_that_begins_and_ends_in_the_middle_is_whole(tmp_path: Path) -> None:
    """Its last step was under way when it ended."""

    def cut(topic: str, k: int, data: bytes) -> list[bytes]:
        begins = 300 if topic.startswith("/agv") else 302  # subscriptions come up one after the other
        ends = 900 if topic in ("/agv/pose", "/edge/slot", "/edge/pose") else 899
        return [data] if begins <= k <= ends else []

    run = read_run(changed_bag(tmp_path / "bag.mcap", cut))
    assert not run.unexplained
    assert (run.k[0], run.k[-1]) == (302, 900)
    assert [note for note in run.notes if "begins with step 302, 1.51 s after" in note]
    assert not [note for note in read_run(SAMPLE).notes if "begins with" in note]


def test_a_relay_that_was_started_again_and_names_no_pose_makes_none_older(tmp_path: Path) -> None:
    def forgotten(topic: str, k: int, data: bytes) -> list[bytes]:
        if topic != "/edge/slot" or k < 1000 or decode_slot(data).outcome != LOST:
            return [data]
        return [encode_slot(decode_slot(data)._replace(freshest_ns=0))]

    whole, run = read_run(SAMPLE), read_run(changed_bag(tmp_path / "bag.mcap", forgotten))
    assert whole.lost[1000:].any()
    np.testing.assert_array_equal(run.n_ul, whole.n_ul)
    assert not [note for note in run.notes if "do not fit" in note]


def test_messages_that_come_twice_count_once_and_are_mentioned(tmp_path: Path) -> None:
    run = read_run(changed_bag(tmp_path / "bag.mcap", lambda topic, k, data: [data] * (1 + (k == 5))))
    assert len(run) == 2000
    assert not run.unexplained
    assert any("/agv/pose: 1 message repeats a step" in note for note in run.notes)


def test_messages_off_the_grid_are_mentioned(tmp_path: Path) -> None:
    def shift(topic: str, k: int, data: bytes) -> list[bytes]:
        if topic != "/edge/cmd_vel" or k != 10:
            return [data]
        sec, nanosec = struct.unpack_from("<iI", data, 4)
        return [data[:4] + struct.pack("<iI", sec, nanosec + 1) + data[12:]]

    run = read_run(changed_bag(tmp_path / "bag.mcap", shift))
    assert any("/edge/cmd_vel: 1 message is not at a sampling instant" in note for note in run.notes)
    assert np.isnan(run.command[10]).all()
    assert run.unexplained == {"edge/cmd_vel": 1}


def test_a_loop_in_a_namespace(tmp_path: Path) -> None:
    run = read_run(changed_bag(tmp_path / "bag.mcap", unchanged, prefixes=("/agv_01",)))
    np.testing.assert_array_equal(run.pose, read_run(SAMPLE).pose)


def test_several_loops_need_a_choice(tmp_path: Path) -> None:
    path = changed_bag(tmp_path / "bag.mcap", unchanged, prefixes=("/agv_01", "/agv_02"))
    with pytest.raises(UserError, match="namespaces /agv_01, /agv_02: choose one with --namespace"):
        read_run(path)
    assert len(read_run(path, namespace="agv_02")) == 2000
    with pytest.raises(UserError, match="no topic /agv_03/agv/pose"):
        read_run(path, namespace="agv_03")


def test_parameters_of_another_run_are_noticed(tmp_path: Path) -> None:
    config = tmp_path / "other.yaml"
    config.write_text(load_scenario(str(REPOSITORY / "config/paper.yaml"), ["error_detector.track=circle"]).to_yaml())
    run = read_run(SAMPLE, config)
    assert any("recorded errors do not fit the track in the parameters" in note for note in run.notes)
    config.write_text(load_scenario(str(REPOSITORY / "config/paper.yaml"), ["plant.start_time=1.001"]).to_yaml())
    with pytest.raises(UserError, match="not on the grid"):
        read_run(SAMPLE, config)


@pytest.mark.parametrize("ts", [0.02, 0.01, 0.004, 0.0025, 0.0049])
def test_another_sampling_period_is_refused(tmp_path: Path, ts: float) -> None:
    config = tmp_path / "other.yaml"
    config.write_text(load_scenario(str(REPOSITORY / "config/outages.yaml"), [f"plant.ts={ts}"]).to_yaml())
    with pytest.raises(UserError) as refused:
        read_run(SAMPLE, config)
    assert str(refused.value) == (
        f"{SAMPLE}: plant.ts is {ts} s in the parameters, but poses and slots are recorded every 0.005 s: name the "
        "params file of this run with --config"
    )


def test_a_recording_of_every_fourth_step_is_refused(tmp_path: Path) -> None:
    """All its stamps are on the grid of 5 ms, and a run of 20 ms it is."""
    with pytest.raises(UserError, match=r"plant.ts is 0.005 s in the parameters, but .* are recorded every 0.02 s"):
        read_run(changed_bag(tmp_path / "bag.mcap", lambda _, k, data: [data] if k % 4 == 0 else []))


def test_a_recording_that_lost_many_messages_has_the_sampling_period_that_it_had(tmp_path: Path) -> None:
    lost = set(np.random.default_rng(1).choice(2000, 600, replace=False).tolist())
    run = read_run(changed_bag(tmp_path / "bag.mcap", lambda _, k, data: [] if k in lost else [data]))
    assert run.unexplained["agv/pose"] > 500


@pytest.mark.parametrize("topic", [topic for topic in TOPICS if topic not in ("agv/pose", "edge/slot")])
def test_a_topic_that_is_there_without_any_message_is_nothing_known(tmp_path: Path, topic: str) -> None:
    """So is the beginning of a run whose recorder was killed."""
    whole = read_run(SAMPLE)
    run = read_run(changed_bag(tmp_path / "bag.mcap", lambda name, _, data: [] if name == f"/{topic}" else [data]))
    assert len(run) == len(whole)
    assert not run.downlink_lost.any()
    np.testing.assert_array_equal(run.lost, whole.lost)
