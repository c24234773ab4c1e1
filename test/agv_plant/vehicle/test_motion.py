"""The AGV's motion with slip, skid, sub-steps and measurement noise, against closed forms."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.stats import chi2, kstest

from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate, simulate_batch
from agv_analysis.simulation.noise import normals
from agv_plant.parameters import PlantParameters
from agv_plant.random_stream import normals_of
from agv_plant.vehicle.motion import NOISE, SLIP, Motion, VehicleParameters, move, vehicle_parameters
from agv_plant.vehicle.slip import over_ground, side_slip
from agv_plant.vehicle.unicycle import STEPS

if TYPE_CHECKING:
    from test.conftest import Drive

PAPER = str(Path(__file__).parents[3] / "config" / "paper.yaml")
PLAIN = vehicle_parameters(PlantParameters())

number = st.floats(-1e3, 1e3)


def driven(body: VehicleParameters, v: float, w: float, steps: int) -> Motion:
    """The motion after some periods under one command, from rest at the origin."""
    motion = Motion(0.0, 0.0, 0.0)
    for _ in range(steps):
        motion = move(motion, v, w, 0.0, 0.0, body)
    return motion


@settings(deadline=None, derandomize=True)
@given(number, number, number, number, number, st.sampled_from(sorted(STEPS)))
def test_by_default_a_period_is_the_paper_s_to_the_last_bit(
    x: float, y: float, theta: float, v: float, w: float, integration: str
) -> None:
    body = PLAIN._replace(arc=integration == "arc")
    assert move(Motion(x, y, theta), v, w, 1.0, -1.0, body)[:3] == STEPS[integration](x, y, theta, v, w, body.ts)


# -- sub-steps ---------------------------------------------------------------------------------------------------------


@settings(deadline=None, derandomize=True)
@given(number, number, st.integers(1, 20))
def test_a_period_in_parts_is_as_many_short_periods(v: float, w: float, parts: int) -> None:
    heavy = PLAIN._replace(lag=0.1, a_max=3.0, j_max=50.0, skid=0.01, substeps=parts)
    short = heavy._replace(ts=heavy.ts / parts, substeps=1)
    assert driven(heavy, v, w, 3) == driven(short, v, w, 3 * parts)


@pytest.mark.parametrize(("body", "way"), [
    (PLAIN._replace(lag=0.5), 2.0 * (1.0 - 0.5 * (1.0 - math.exp(-2.0)))),  # v (t - L (1 - e^(-t/L))), t = 1, v = 2
    (PLAIN._replace(a_max=4.0), 2.0 * (1.0 - 0.5 * 0.5)),  # v (t - v / 2 a)
    (PLAIN._replace(j_max=32.0), 2.0 * (1.0 - 0.5 * 0.5)),  # v (t - T / 2), T = 2 sqrt(v / j)
], ids=["lag", "acceleration", "jerk"])  # fmt: skip
def test_with_more_parts_the_way_is_that_of_the_continuous_drive(body: VehicleParameters, way: float) -> None:
    missing = [driven(body._replace(ts=0.1, substeps=parts), 2.0, 0.0, 10).x - way for parts in (1, 8, 64, 512)]
    assert abs(missing[-1]) < 1e-3
    assert missing[1] / missing[2] == pytest.approx(8.0, rel=0.1)  # first order
    assert missing[2] / missing[3] == pytest.approx(8.0, rel=0.1)


def test_euler_in_parts_approaches_the_arc() -> None:
    exact = driven(PLAIN._replace(ts=0.1, arc=True), 1.0, 1.0, 10)
    distance = [
        math.dist(exact[:2], driven(PLAIN._replace(ts=0.1, substeps=parts), 1.0, 1.0, 10)[:2]) for parts in (10, 100)
    ]
    assert distance[0] / distance[1] == pytest.approx(10.0, rel=0.02)


# -- slip and skid -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("slip", [0.0, 0.1, 0.9, -0.2])
def test_wheels_that_slip_alike_go_the_same_way_slower(slip: float) -> None:
    arc = PLAIN._replace(arc=True, ts=1.0)
    slow = driven(arc._replace(ts=1.0 - slip), 2.0, 0.7, 1)  # the same arc, less of it
    assert driven(arc._replace(slip=slip), 2.0, 0.7, 1)[:3] == pytest.approx(slow[:3], abs=1e-12)


@settings(deadline=None, derandomize=True)
@given(number, number, st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(0.1, 10.0))
def test_slip_is_that_of_each_wheel(v: float, w: float, left: float, right: float, width: float) -> None:
    """A differential drive's kinematics, as a matrix."""
    rims = np.array([[1.0, -width / 2.0], [1.0, width / 2.0]])
    expected = np.linalg.solve(rims, np.diag([1.0 - left, 1.0 - right]) @ rims @ [v, w])
    scale = (abs(v) + abs(w) * width) * max(1.0, 1.0 / width)
    assert over_ground(v, w, left, right, width) == pytest.approx(tuple(expected), abs=1e-12 * scale + 1e-300)


def test_random_slip_spreads_speed_and_heading_as_it_must() -> None:
    """var v = s^2 (v_l^2 + v_r^2) / 4, var w = s^2 (v_l^2 + v_r^2) / b^2: a chi-squared estimate of either."""
    v, w, noise, width, steps = 1.5, 0.8, 0.1, 0.6, 20_000
    left, right = noise * normals(3, SLIP, steps)[:, :2].T
    found = np.array([over_ground(v, w, *s, width) for s in zip(left.tolist(), right.tolist(), strict=True)])
    rims = (v - 0.5 * w * width) ** 2 + (v + 0.5 * w * width) ** 2
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], steps) / steps
    for column, commanded, variance in zip(found.T, (v, w), (rims / 4.0, rims / width**2), strict=True):
        assert low < np.mean((column - commanded) ** 2) / (noise**2 * variance) < high


def test_an_agv_that_skids_solves_the_differential_equation() -> None:
    v, w, skid, ts = 2.0, -0.9, 0.05, 1.7
    beta = side_slip(v, w, skid)
    assert beta == pytest.approx(0.09)  # to the left in a curve to the right: outwards
    solution = solve_ivp(
        lambda _, X: (v * math.cos(X[2] + beta), v * math.sin(X[2] + beta), w), (0.0, ts), (0.0, 0.0, 0.0),
        method="DOP853", rtol=1e-13, atol=1e-13,
    )  # fmt: skip
    found = driven(PLAIN._replace(ts=ts, skid=skid, arc=True), v, w, 1)
    assert found[:3] == pytest.approx(tuple(solution.y[:, -1]), abs=1e-11)


# -- noise -------------------------------------------------------------------------------------------------------------


def test_numbers_of_the_node_are_those_of_the_simulation_in_any_order() -> None:
    found, stream = normals(5, NOISE, 1000), normals_of(5, NOISE)
    for k in (999, 0, 63, 64, 500, 1):
        assert stream.at(k) == tuple(found[k])


def test_numbers_are_normal_and_of_no_account_to_each_other() -> None:
    columns = np.concatenate([normals(seed, stream, 20_000) for seed in (1, 2) for stream in (NOISE, SLIP)], axis=1).T
    assert min(kstest(column, "norm").pvalue for column in columns) > 1e-4
    assert abs(np.corrcoef(columns) - np.eye(len(columns))).max() < 5.0 / math.sqrt(20_000)


def test_the_loop_makes_of_noise_what_its_pole_says() -> None:
    """On a line e(k+1) = (1 - a) e(k) - a n(k), a = T_s K_x: var e = a / (2 - a) var n, in the long run."""
    run = simulate(load_scenario(PAPER, [
        "error_detector.track=line", "plant.initial_pose=[0.0, 0.0, 1.5707963267948966]", "plant.noise_xy=0.001",
        "plant.duration=400.0",
    ]))  # fmt: skip
    assert run.measured is not None
    noise = run.measured - run.pose
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], len(run)) / len(run)
    for column in noise[:, :2].T:
        assert low < np.mean(column**2) / 1e-6 < high
    assert not noise[:, 2].any()
    a = 0.005 * 25.0
    # Its autocorrelation is (1 - a)^l: worth N (1 - q) / (1 + q) independent squares, q = (1 - a)^2.
    q = (1.0 - a) ** 2
    worth = len(run) * (1.0 - q) / (1.0 + q)
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], worth) / worth
    along = run.reference[200:, 1] - run.pose[200:, 1]
    assert low < np.mean(along**2) / (1e-6 * a / (2.0 - a)) < high


RANDOM = ("plant.noise_xy=0.01", "plant.noise_theta=0.02", "plant.slip_noise=0.05", "plant.duration=5.0")


def test_a_batch_s_seed_is_that_of_noise_and_slip_too() -> None:
    scenario = load_scenario(PAPER, RANDOM)
    table = simulate_batch([scenario], [4, 5])[0]
    for row, seed in zip(table, (4, 5), strict=True):
        run = simulate(load_scenario(PAPER, [*RANDOM, f"plant.seed={seed}"]))
        assert row["final"] == run.reference[-1, 1] - run.pose[-1, 1]
    assert table["final"][0] != table["final"][1]


def test_an_agv_of_one_seed_is_the_same_whatever_else_is_off() -> None:
    """Noise and slip have streams of their own: one does not change the other's numbers."""
    both, noise = (simulate(load_scenario(PAPER, settings)) for settings in (RANDOM, (*RANDOM, "plant.slip_noise=0.0")))
    assert both.measured is not None
    assert noise.measured is not None
    np.testing.assert_allclose(both.measured - both.pose, noise.measured - noise.pose, rtol=0.0, atol=1e-14)


def test_a_recording_without_the_truth_says_so(drive: Drive, tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    from agv_analysis.recordings.recording import read_run

    run = drive("plant.duration=0.5", bag=tmp_path / "bag")
    assert (run.measured, run.notes) == (None, ())
    noisy = drive("plant.duration=0.5", "plant.noise_xy=0.01", bag=tmp_path / "noisy")
    assert noisy.measured is not None
    (recorded,) = (tmp_path / "noisy").glob("*.mcap")
    notes = read_run(without_topic(recorded, "/agv/ground_truth", tmp_path / "untrue.mcap")).notes
    assert sum("agv/ground_truth is not in the recording" in note for note in notes) == 1


def without_topic(bag: Path, topic: str, target: Path) -> Path:
    """A copy of a bag without a topic, by the library of MCAP."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    with bag.open("rb") as source, target.open("wb") as copy:
        reader, writer = make_reader(source), Writer(copy)
        writer.start(profile="ros2")
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, dict(record.metadata))
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            if channel.topic == topic or schema is None:
                continue
            if channel.id not in channels:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, known, dict(channel.metadata)
                )
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()  # type: ignore[no-untyped-call]
    return target
