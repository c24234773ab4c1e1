"""Fleets: each vehicle's recording is its own simulation, whoever drives beside it."""

from __future__ import annotations

import csv
import json
import math
import re
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from mcap.reader import make_reader

from agv_analysis.recordings.recording import read_run
from agv_analysis.runtime.fleet import Vehicle, instability, judge, vehicle_names, vehicle_scenarios
from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.simulation.channel_outcomes import ChannelRealisation
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import Channel, delay_draws, losses
from agv_ros.parameters import ParameterError

if TYPE_CHECKING:
    from agv_analysis.run import Run
    from test.agv_analysis.runtime.conftest import UntilSteps
    from test.conftest import Start

PAPER = str(Path(__file__).parents[3] / "config/paper.yaml")
SHARED = ("relay.uplink.model=shared", "relay.uplink.p=0.1", "relay.uplink.scheduler=oldest_first")
AgvNcs = Callable[..., tuple[int, str]]


def fleet_of(count: int, *settings: str, pitch: float = 20.0) -> dict[str, Scenario]:
    scenarios = vehicle_scenarios(load_scenario(PAPER, settings), count, pitch)
    return dict(zip(vehicle_names(count), scenarios, strict=True))


# -- derived -----------------------------------------------------------------------------------------------------------


def test_names_sort_as_they_count() -> None:
    assert vehicle_names(3) == ["agv_01", "agv_02", "agv_03"]
    assert vehicle_names(100)[::99] == ["agv_001", "agv_100"]


def test_in_every_slot_as_many_are_heard_as_there_are_blocks() -> None:
    fleet = fleet_of(5, "relay.uplink.blocks=2")
    lost = np.array([losses(one.relay.uplink, one.relay.seed, "uplink", 300) for one in fleet.values()])
    assert (np.count_nonzero(~lost[:, 1:], axis=0) == 2).all()


def test_tracks_lie_beside_each_other_and_the_agv_is_where_it_was_on_its_own() -> None:
    turned = "error_detector.track_start=[1.0, 2.0, 0.5]"
    first, _, third = fleet_of(3, turned, "plant.initial_pose=[0.0, 3.0, 0.4]", pitch=4.0).values()
    assert first.error_detector.track_start == (1.0, 2.0, 0.5)
    shift = np.subtract(third.error_detector.track_start, first.error_detector.track_start)
    assert shift == pytest.approx([-8.0 * math.sin(0.5), 8.0 * math.cos(0.5), 0.0])
    assert np.subtract(third.plant.initial_pose, first.plant.initial_pose) == pytest.approx(shift)


def test_each_has_its_own_downlink_noise_and_delays() -> None:
    settings = ("relay.downlink.model=bernoulli", "relay.downlink.p=0.5", "plant.noise_xy=0.01")
    fleet = list(fleet_of(3, *settings).values())
    of_downlink = [losses(one.relay.downlink, one.relay.seed, "downlink", 2000) for one in fleet]
    of_delays = [delay_draws(one.relay.uplink, one.relay.seed, "uplink", 0, 2000)[:, 0] for one in fleet]
    noise = [simulate(replace(one, plant=replace(one.plant, duration=10.0))).sent_pose[:, 0] for one in fleet]
    for drawn in (of_downlink, of_delays, [np.diff(values) for values in noise]):
        correlation = np.corrcoef(drawn) - np.eye(3)
        assert np.abs(correlation).max() < 5.0 / math.sqrt(1999)


def test_the_first_of_a_fleet_has_the_downlink_of_an_agv_alone() -> None:
    alone = load_scenario(PAPER, ["relay.downlink.model=bernoulli", "relay.downlink.p=0.5"]).relay
    first = fleet_of(3, "relay.downlink.model=bernoulli", "relay.downlink.p=0.5")["agv_01"].relay
    assert (losses(first.downlink, 1, "downlink", 500) == losses(alone.downlink, 1, "downlink", 500)).all()


@pytest.mark.parametrize("model", ["bernoulli", "gilbert_elliott"])
def test_a_vehicle_s_own_channel_is_the_same_simulated(model: str) -> None:
    channel = ChannelParameters(
        model=model, p=0.3, r=0.4, vehicles=5, vehicle=4, delay=0.01, jitter=0.02, lifetime=0.02
    )
    assert (losses(channel, 7, "downlink", 500) == ChannelRealisation(7, 500).outcomes(channel, "downlink")).all()
    relay, link_inputs = Channel(channel, 7, "downlink"), ChannelRealisation(7, 500).link_inputs(channel, "downlink")
    lost = ChannelRealisation(7, 500).outcomes(channel, "downlink")
    waits = [math.ceil(relay.delays(k)[0] - 1e-9) for k in range(500) if not lost[k]]
    assert np.asarray(link_inputs.waits)[~lost].tolist() == waits


@pytest.mark.parametrize(
    ("model", "p", "expected"), [("perfect", 0.3, 0.0), ("bernoulli", 0.3, 0.3), ("shared", 0.3, 0.3)]
)
def test_a_channel_without_memory_becomes_the_shared_one(model: str, p: float, expected: float) -> None:
    uplink = fleet_of(4, f"relay.uplink.model={model}", f"relay.uplink.p={p}")["agv_03"].relay.uplink
    assert (uplink.model, uplink.p, uplink.vehicles, uplink.vehicle) == ("shared", expected, 4, 2)


def test_other_channels_cannot_be_shared() -> None:
    with pytest.raises(
        ParameterError, match=r"uplink\.model is gilbert_elliott, but .* --set relay\.uplink\.model=shared"
    ):
        fleet_of(2, "relay.uplink.model=gilbert_elliott")
    with pytest.raises(ParameterError, match=r"downlink\.correlation is 0\.5"):
        fleet_of(2, "relay.downlink.correlation=0.5")


# -- judged ------------------------------------------------------------------------------------------------------------


def test_the_share_of_unstable_vehicles_is_of_those_judged() -> None:
    """Interval after 2 of 8: Clopper and Pearson by tables of the beta distribution."""
    fleet = [Vehicle(f"agv_{i:02}", 1, "", unstable=i < 2 if i < 8 else None) for i in range(10)]
    found = instability(fleet)
    assert (found.unstable, found.judged, found.fraction) == (2, 8, 0.25)
    assert (found.low, found.high) == pytest.approx((0.0318540, 0.6508558), abs=1e-6)
    assert math.isnan(instability([]).fraction)


# -- driven ------------------------------------------------------------------------------------------------------------


def payloads(bag: Path, namespace: str) -> dict[str, list[tuple[int, bytes]]]:
    """Log times and payloads by topic in a namespace."""
    found: dict[str, list[tuple[int, bytes]]] = {}
    with next(bag.glob("*.mcap")).open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            assert channel.topic.startswith(namespace), channel.topic
            found.setdefault(channel.topic, []).append((message.log_time, message.data))
    return found


def changed(one: Path, other: Path, namespace: str) -> list[str]:
    first, second = payloads(one, namespace), payloads(other, namespace)
    return sorted(topic for topic in first.keys() | second.keys() if first.get(topic) != second.get(topic))


def differences(recorded: Run, simulated: Run) -> list[str]:
    """What of a recorded run is not as simulated: outcomes to the last bit, numbers to what the wire keeps of them."""
    if len(recorded) != len(simulated):
        return [f"{len(recorded)} steps instead of {len(simulated)}"]
    exact = ("lost", "downlink_lost", "n_ul", "n_dl")
    found = [name for name in exact if not np.array_equal(getattr(recorded, name), getattr(simulated, name))]
    near = ("pose", "sent_pose", "reference", "command")
    return found + [
        name for name in near if not np.allclose(getattr(recorded, name), getattr(simulated, name), rtol=0.0, atol=1e-9)
    ]


LOSSY = (*SHARED, "relay.downlink.model=bernoulli", "relay.downlink.p=0.2", "plant.duration=2.0", "plant.noise_xy=0.01",
         "error_detector.corridor=0.1")  # fmt: skip


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings of a fleet of three in one process."""
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    from agv_analysis.runtime.runner import run_fleet

    folder = tmp_path_factory.mktemp("fleet")
    outcomes = run_fleet(fleet_of(3, *LOSSY), folder, lambda _: None)
    assert [(found.steps, found.failure, found.recording_failure) for found in outcomes] == [(400, "", "")] * 3
    return folder


@pytest.mark.parametrize("name", vehicle_names(3))
def test_a_vehicle_s_recording_is_its_simulation(driven: Path, name: str) -> None:
    recorded, scenario = read_run(driven / name), fleet_of(3, *LOSSY)[name]
    assert recorded.scenario == scenario
    assert not recorded.unexplained
    assert recorded.notes == ()
    assert differences(recorded, simulate(scenario)) == []


def test_a_vehicle_is_held_against_its_corridor(driven: Path) -> None:
    judged, run = judge("agv_02", 400, "", driven / "agv_02"), read_run(driven / "agv_02")
    distance = np.hypot(*(run.pose - run.reference[:, :3])[:, :2].T)
    assert judged.corridor_share is not None
    assert judged.corridor_share <= distance.max() / 0.1
    assert judged.outages_outside is not None
    assert judged.p_outage_at_most is not None
    assert (judged.outages_outside > 0) == (judged.corridor_share > 1.0)
    assert judged.p_outage_at_most > 0.0


def test_with_a_process_for_each_the_recordings_are_the_same_bytes(driven: Path, tmp_path: Path) -> None:
    from agv_analysis.runtime.processes import run_fleet_in_processes

    outcomes = run_fleet_in_processes(fleet_of(3, *LOSSY), tmp_path, lambda _: None)
    assert [(found.steps, found.failure, found.recording_failure) for found in outcomes] == [(400, "", "")] * 3
    for name in vehicle_names(3):
        assert changed(driven / name, tmp_path / name, f"/{name}/") == []


def test_a_vehicle_that_drives_alone_does_the_same(driven: Path, tmp_path: Path) -> None:
    from agv_analysis.runtime.runner import run_fleet

    run_fleet({"agv_02": fleet_of(3, *LOSSY)["agv_02"]}, tmp_path, lambda _: None)
    assert changed(driven / "agv_02", tmp_path / "agv_02", "/agv_02/") == []


def test_a_vehicle_that_fails_does_not_end_the_others(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    from agv_analysis.runtime.runner import run_fleet

    fleet = fleet_of(2, "plant.duration=1.0")
    late, impatient = fleet["agv_01"].error_detector, fleet["agv_01"].plant
    fleet["agv_01"] = replace(
        fleet["agv_01"],
        error_detector=replace(late, start_time=2.0),
        plant=replace(impatient, answer_timeout=1.0),
    )
    first, second = run_fleet(fleet, None, lambda _: None)
    assert "no answer to step 0" in first.failure
    assert (second.steps, second.failure) == (200, "")
    judged = judge("agv_01", first.steps, first.failure, tmp_path / "agv_01")
    assert judged.failure.startswith("no answer to step 0")
    assert f"; {tmp_path / 'agv_01'}: " in judged.failure
    assert judged.unstable is None


@pytest.mark.parametrize("how", [(), ("--processes",)], ids=["one process", "processes"])
def test_the_command_says_how_each_fared(agv_ncs: AgvNcs, tmp_path: Path, how: tuple[str, ...]) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    bag = tmp_path / "fleet"
    settings = [word for setting in (*SHARED, "controller.kx=5.0") for word in ("--set", setting)]
    status, said = agv_ncs(
        "run", PAPER, *settings, "--fleet", 2, "--pitch", 3.0, "--duration", 10.0, "--bag", bag, *how
    )
    assert status == 0, said[-2000:]
    rows = list(csv.DictReader((bag / "fleet.csv").open()))
    content = json.loads((bag / "fleet.json").read_text())
    assert [row["vehicle"] for row in rows] == ["agv_01", "agv_02"]
    assert [row["steps"] for row in content["vehicles"]] == [2000, 2000]
    assert (content["unstable"], content["judged"], content["fraction"]) == (0, 2, 0.0)
    assert "0 of 2 AGVs, 0 % (0 % .. 84.2 % with 95 % confidence)" in said
    worst = max(content["vehicles"], key=lambda one: one["deviation"]["max"])
    assert re.search(rf"│ +Deviation +largest: {worst['deviation']['max']:.3g} m \({worst['vehicle']}\) +│", said)
    assert said.index("Verdict") < said.index("Twins: ")
    assert (read_run(bag / "agv_02").scenario.error_detector.track_start[0]) == -3.0
    status, said = agv_ncs("analyse", bag / "agv_02", "--json", tmp_path / "analysis.json")
    assert status == 0, said[-2000:]
    assert json.loads((tmp_path / "analysis.json").read_text())["verdict"] == content["vehicles"][1]["verdict"]


def test_an_unstable_fleet_is_called_so(agv_ncs: AgvNcs, tmp_path: Path) -> None:
    """T_s K_x = 5: a fresh pose makes -4 times the error of it, an outdated one more."""
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    bag = tmp_path / "fleet"
    status, said = agv_ncs("run", PAPER, "--set", "controller.kx=1000.0", "--fleet", 2, "--duration", 1, "--bag", bag)
    assert status == 0, said[-2000:]
    assert "2 of 2 AGVs, 100 % (15.8 % .. 100 % with 95 % confidence)" in said
    assert re.search(r"Verdict +2 unstable ", said)
    assert re.search(r"Deviation +largest: diverges \(agv_0[12]\)", said)


def test_what_cannot_be_driven_is_said_in_a_line(agv_ncs: AgvNcs, tmp_path: Path) -> None:
    outages = PAPER.replace("paper", "outages")
    status, said = agv_ncs("run", outages, "--fleet", 2)
    assert (status, "relay.uplink.model is gilbert_elliott" in said, "Traceback" in said) == (1, True, False)
    status, said = agv_ncs("run", PAPER, "--fleet", 2, "--bag", tmp_path)
    assert (status, said.splitlines()[-1]) == (
        1, f"Error: {tmp_path}: exists already; name a new directory or remove it first",
    )  # fmt: skip


@pytest.mark.parametrize("how", [(), ("--processes",)], ids=["one process", "processes"])
def test_an_interrupted_fleet_leaves_readable_bags_and_nothing_else(
    start: Start, until_steps: UntilSteps, tmp_path: Path, how: tuple[str, ...]
) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    bag, names = tmp_path / "fleet", vehicle_names(2)
    run = start("agv_analysis.cli", "run", PAPER, "--fleet", "2", "--duration", "10000", "--bag", str(bag), *how)
    until_steps(300, *(f"/{name}/clock" for name in names))
    children = run.children()
    assert len(children) == (2 if how else 0)
    run.process.send_signal(signal.SIGINT)
    status, said = run.end(300.0)
    assert status == 1
    assert "agv_01: interrupted at step" in said
    assert "agv_02: interrupted at step" in said
    for name in names:
        assert not read_run(bag / name).unexplained
    assert not [child for child in children if child.exists()]


def test_in_real_time_every_vehicle_keeps_its_steps(tmp_path: Path) -> None:
    """At a tenth of the usual rate, which a busy machine manages."""
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    from agv_analysis.runtime.runner import run_fleet

    settings = ("plant.clock=realtime", "plant.duration=2.0", "controller.kx=1.0")
    slow = [f"{node}.ts=0.05" for node in ("plant", "relay", "error_detector", "controller")]
    outcomes = run_fleet(fleet_of(2, *SHARED, *settings, *slow), tmp_path, lambda _: None)
    assert [(found.steps, found.failure, found.recording_failure) for found in outcomes] == [(40, "", "")] * 2
    runs = [read_run(tmp_path / name) for name in vehicle_names(2)]
    assert all(not run.unexplained for run in runs)
    assert (runs[0].lost[1:] | runs[1].lost[1:]).all()  # one block
