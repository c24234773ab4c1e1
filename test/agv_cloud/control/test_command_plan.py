"""The controller's plan: with an exact model, outages of the downlink no longer than it do not matter."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_analysis.run import Run
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate, simulate_batch
from agv_cloud.control.command_plan import next_error
from agv_cloud.tracking_error import tracking_error
from agv_plant.downlink_policy import BUFFER, share_of_command
from agv_plant.vehicle.unicycle import STEPS
from agv_ros.messages import InvalidMessageError
from agv_ros.parameters import ParameterError
from agv_ros.speeds_codec import SpeedsAhead, decode_speeds, encode_speeds

PAPER = str(Path(__file__).parents[3] / "config" / "paper.yaml")

place = st.floats(-20.0, 20.0)
speed = st.floats(-5.0, 5.0)


def run_of(*settings: str) -> Run:
    return simulate(load_scenario(PAPER, [*settings, "plant.duration=20.0"]))


@settings(deadline=None, derandomize=True)
@given(st.tuples(place, place, place), st.tuples(place, place, place), speed, speed, speed, speed, st.booleans())
def test_the_next_error_is_that_of_the_two_that_have_moved_on(
    reference: tuple[float, float, float], agv: tuple[float, float, float], v: float, w: float, v_r: float, w_r: float,
    arc: bool,
) -> None:  # fmt: skip
    """Seen from the AGV, as the controller does it, or in the frame of the map."""
    ts = 0.05
    moved = STEPS["euler"](*reference, v_r, w_r, ts)
    expected = tracking_error(*moved, *STEPS["arc" if arc else "euler"](*agv, v, w, ts))
    assert next_error(*tracking_error(*reference, *agv), v, w, v_r, w_r, ts, arc) == pytest.approx(expected, abs=1e-12)


@pytest.mark.no_cover
@pytest.mark.parametrize("n", [1, 13, 200])
@pytest.mark.parametrize(
    "limited", [(), ("controller.v_max=2.0", "plant.integration=arc", "error_detector.track=eight")]
)
def test_outages_no_longer_than_the_plan_do_not_matter(n: int, limited: tuple[str, ...]) -> None:
    model = [setting.replace("plant.integration", "controller.integration") for setting in limited]
    planned = run_of(
        *limited, *model, "relay.downlink.model=burst", f"relay.downlink.n={n}", "plant.downlink_policy=buffer",
        f"plant.plan_steps={n}",
    )  # fmt: skip
    assert planned.downlink_lost.sum() > 0.4 * len(planned)
    np.testing.assert_allclose(planned.pose, run_of(*limited).pose, rtol=0.0, atol=1e-12)


def test_beyond_the_plan_the_agv_stands_still() -> None:
    planned = run_of(
        "relay.downlink.model=burst", "relay.downlink.n=9", "plant.downlink_policy=buffer", "plant.plan_steps=6"
    )
    moves = np.linalg.norm(np.diff(planned.pose, axis=0), axis=1).reshape(-1, 1)[: 390 * 10].reshape(-1, 10)
    assert not moves[:, 7:].any()
    assert moves[:, :7].all()
    assert [share_of_command(n, BUFFER, 6) for n in (0, 6, 7)] == [1.0, 1.0, 0.0]


@pytest.mark.no_cover
def test_a_batch_plans_as_a_single_run_does() -> None:
    lossy = ("relay.downlink.model=bernoulli", "relay.downlink.p=0.6", "plant.downlink_policy=buffer")
    scenario = load_scenario(PAPER, [*lossy, "plant.plan_steps=4", "plant.duration=20.0"])
    run = simulate(scenario)
    assert simulate_batch([scenario], [1])["final"][0, 0] == run.reference[-1, 1] - run.pose[-1, 1]


def test_a_buffer_without_a_plan_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"downlink_policy is buffer, but plan_steps is 0"):
        load_scenario(PAPER, ["plant.downlink_policy=buffer"])


# -- on the wire -------------------------------------------------------------------------------------------------------


ahead = st.builds(
    SpeedsAhead,
    st.integers(0, 2**31 * 10**9 - 1),
    st.lists(st.tuples(speed, speed), min_size=1, max_size=30).map(tuple),
)
names = st.text(st.characters(exclude_characters="\0", codec="ascii"), max_size=9)


@settings(deadline=None, derandomize=True)
@given(ahead, names)
def test_speeds_come_back_and_are_those_of_ros(value: SpeedsAhead, name: str) -> None:
    serialization = pytest.importorskip("rclpy.serialization")
    from trajectory_msgs.msg import MultiDOFJointTrajectory

    data = encode_speeds(value, 5_000_000, name)
    message = serialization.deserialize_message(data, MultiDOFJointTrajectory)
    found = [(point.velocities[0].linear.x, point.velocities[0].angular.z) for point in message.points]
    assert tuple(found) == value.speeds
    assert message.joint_names == [name]
    last = message.points[-1].time_from_start
    assert last.sec * 10**9 + last.nanosec == 5_000_000 * (len(found) - 1)
    assert decode_speeds(data) == decode_speeds(serialization.serialize_message(message)) == value


@settings(deadline=None, derandomize=True)
@given(ahead, st.data())
def test_what_is_cut_short_or_damaged_is_refused_or_read_but_never_another_error(
    value: SpeedsAhead, data: st.DataObject
) -> None:
    whole = bytearray(encode_speeds(value, 5_000_000, "base_link"))
    cut = whole[: data.draw(st.integers(0, len(whole) - 1))]
    with pytest.raises(InvalidMessageError):
        decode_speeds(bytes(cut))
    whole[data.draw(st.integers(0, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
    try:
        speeds = decode_speeds(bytes(whole)).speeds
    except InvalidMessageError:
        return
    assert all(math.isfinite(number) for pair in speeds for number in pair)
