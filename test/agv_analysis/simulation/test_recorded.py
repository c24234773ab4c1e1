"""The simulation against recordings of the nodes on real DDS, step by step."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from agv_analysis.simulation import simulate
from agv_analysis.stability.driven_commands import driven_commands
from agv_cloud.staleness.registry import STALENESS_POLICIES
from agv_plant.downlink_policy import DOWNLINK_POLICIES

if TYPE_CHECKING:
    from agv_analysis.run import Run

pytest.importorskip("rclpy")

LOSSY = ("relay.uplink.model=gilbert_elliott", "relay.uplink.p=0.1", "relay.uplink.r=0.4", "relay.uplink.h=0.1")

RUNS = {
    "the paper": (),
    "both links lossy": (*LOSSY, "relay.downlink.model=bernoulli", "relay.downlink.p=0.3", "relay.seed=3"),
    "bursts, limited": ("relay.uplink.model=burst", "relay.uplink.n=9", "controller.v_max=6.0"),
    "arc, eight": (*LOSSY, "plant.integration=arc", "error_detector.track=eight", "relay.downlink.model=burst",
                   "relay.downlink.n=2"),
    "align": (*LOSSY, "error_detector.policy=align"),
    "predict": (*LOSSY, "error_detector.policy=predict", "plant.speed_scale=1.1", "controller.v_max=6.0"),
    "predict on the arc, lossy downlink": (
        *LOSSY, "error_detector.policy=predict", "error_detector.integration=arc", "plant.integration=arc",
        "relay.downlink.model=bernoulli", "relay.downlink.p=0.2",
    ),
    "stops in outages": (*LOSSY, "relay.downlink.model=burst", "relay.downlink.n=4", "plant.downlink_policy=zero"),
    "slows down in outages": (
        "relay.downlink.model=burst", "relay.downlink.n=9", "plant.downlink_policy=ramp", "plant.ramp_time=0.03",
    ),
    "a hole": (
        "relay.uplink.model=coverage_hole", "relay.uplink.hole_circles=[0.0, 5.5, 0.5, 0.0, 1.0, 0.5]",
        "relay.uplink.hole_loss=0.9", "relay.downlink.model=coverage_hole", "relay.downlink.p=0.2",
        "relay.downlink.hole_polygons=[-1.0, 0.5, 1.0, 0.5, 0.0, 2.0, -1.0, 0.5]",
    ),
    "fading": (
        "relay.uplink.model=rayleigh", "relay.uplink.margin=5.0", "relay.downlink.model=rayleigh",
        "relay.downlink.margin=8.0", "relay.downlink.correlation=0.6", "error_detector.policy=align",
    ),
    "late": ("relay.uplink.delay=0.0149", "relay.downlink.delay=0.01", *LOSSY, "plant.downlink_policy=ramp"),
    "out of order": (
        *LOSSY, "relay.uplink.delay=0.02", "relay.uplink.jitter=0.03", "relay.uplink.duplicate=0.3",
        "relay.downlink.jitter=0.02", "relay.downlink.duplicate=0.2", "controller.kx=5.0",
        "relay.uplink.lifetime=0.03", "relay.downlink.lifetime=0.01", "relay.downlink.model=coverage_hole",
        "relay.downlink.hole_circles=[0.0, 1.0, 0.7]",
    ),
    "out of order, predicted": (
        *LOSSY, "relay.uplink.delay=0.02", "relay.uplink.jitter=0.03", "relay.downlink.delay=0.012",
        "error_detector.policy=predict", "plant.lag=0.02", "controller.v_max=6.0",
    ),
    "by a schedule": (
        "relay.uplink.model=gilbert_elliott", "relay.uplink.r=0.3",
        "relay.uplink.schedule=0.5: p=0.1; 1: outage=0.05 every 0.4; 2: p=0; 2: delay=0.01; 2.5: outage=0",
        "relay.downlink.schedule=1.2: outage=0.1",
    ),
    "plays a plan in outages": (
        *LOSSY, "relay.downlink.model=burst", "relay.downlink.n=9", "plant.downlink_policy=buffer",
        "plant.plan_steps=7", "plant.integration=arc", "controller.integration=arc",
    ),
    "plans come late, and twice": (
        "relay.downlink.delay=0.012", "relay.downlink.jitter=0.008", "relay.downlink.duplicate=0.2", *LOSSY,
        "plant.downlink_policy=buffer", "plant.plan_steps=5",
    ),
    "predicts and plans": (
        *LOSSY, "relay.downlink.model=bernoulli", "relay.downlink.p=0.5", "plant.downlink_policy=buffer",
        "plant.plan_steps=3", "error_detector.policy=predict", "controller.v_max=3.0", "plant.speed_scale=1.05",
    ),
    "a heavy AGV": (*LOSSY, "plant.a_max=3.0", "plant.lag=0.02", "plant.w_max=1.5", "error_detector.track=eight"),
    "smooth, in parts": (*LOSSY, "plant.j_max=400.0", "plant.a_max=20.0", "plant.substeps=5", "plant.lag=0.01"),
    "slips and skids": (
        *LOSSY, "plant.slip=0.05", "plant.slip_noise=0.05", "plant.skid=0.02", "plant.seed=5", "plant.integration=arc",
        "error_detector.track=eight", "controller.v_max=3.0",
    ),
    "noisy": (*LOSSY, "plant.noise_xy=0.02", "plant.noise_theta=0.05", "plant.seed=9", "controller.v_max=6.0"),
    "noisy, predicted": (
        *LOSSY, "plant.noise_xy=0.02", "error_detector.policy=predict", "plant.slip_noise=0.05", "controller.v_max=3.0",
    ),
}  # fmt: skip


CHANNELS = {
    "perfect": (),
    "bernoulli": ("relay.uplink.model=bernoulli", "relay.uplink.p=0.4"),
    "gilbert_elliott": (*LOSSY, "relay.uplink.k=0.95"),
    "burst": ("relay.uplink.model=burst", "relay.uplink.n=11"),
    "trace": ("relay.uplink.model=trace",),
    "coverage_hole": ("relay.uplink.model=coverage_hole", "relay.uplink.hole_circles=[0.3, 0.4, 0.4]"),
    "rayleigh": ("relay.uplink.model=rayleigh", "relay.uplink.margin=6.0"),
    "late": (*LOSSY, "relay.uplink.delay=0.01", "relay.uplink.jitter=0.015", "relay.downlink.delay=0.007"),
}
TRACKS = ("paper", "line", "circle", "eight", "warehouse", "csv")
LIMITED = {"limited": "controller.v_max=2.0", "unlimited": "controller.v_max=.inf"}


@pytest.fixture
def files(tmp_path: Path) -> tuple[str, str]:
    """Settings that name a track's and a trace's file."""
    track, trace = tmp_path / "track.csv", tmp_path / "trace.csv"
    track.write_text("t,v,w\n0.0,1.0,0.5\n1.0,2.0,-0.5\n100.0,1.0,0.0\n")
    trace.write_text("lost\n" + "0\n1\n1\n0\n1\n" * 5)
    return f"error_detector.track_file={track}", f"relay.uplink.trace_file={trace}"


@pytest.mark.no_cover
@pytest.mark.parametrize("limit", LIMITED.values(), ids=LIMITED)
@pytest.mark.parametrize("channel", CHANNELS.values(), ids=CHANNELS)
@pytest.mark.parametrize("policy", STALENESS_POLICIES.names())
def test_every_channel_policy_and_limit(
    drive: Callable[..., Run], files: tuple[str, str], policy: str, channel: tuple[str, ...], limit: str
) -> None:
    """Each with a track and a downlink policy of its own turn, so that all of them meet every other kind."""
    turn = list(CHANNELS.values()).index(channel) + STALENESS_POLICIES.names().index(policy)
    downlink = DOWNLINK_POLICIES[turn % len(DOWNLINK_POLICIES)]
    settings = (*files, f"error_detector.track={TRACKS[turn % len(TRACKS)]}", f"plant.downlink_policy={downlink}")
    planned = ("plant.plan_steps=2",) if downlink == "buffer" else ()
    lossy = ("relay.downlink.model=bernoulli", "relay.downlink.p=0.2", "plant.initial_pose=[0.3, -0.2, 1.3]")
    agree(drive(*settings, *planned, *lossy, *channel, limit, f"error_detector.policy={policy}", "plant.duration=1.5"))


@pytest.mark.parametrize("track", TRACKS)
def test_every_track(drive: Callable[..., Run], files: tuple[str, str], track: str) -> None:
    agree(drive(*files, *LOSSY, f"error_detector.track={track}", "plant.duration=1.5"))


@pytest.mark.no_cover
@pytest.mark.parametrize("settings", RUNS.values(), ids=RUNS)
def test_a_recorded_run_is_the_simulated_one(drive: Callable[..., Run], settings: tuple[str, ...]) -> None:
    agree(drive(*settings, "plant.duration=3.0"))


def agree(recorded: Run) -> None:
    """Is the simulation of a recorded run's scenario that run, step by step?"""
    simulated = simulate(recorded.scenario)
    assert len(recorded) == len(simulated) == round(recorded.scenario.plant.duration / recorded.ts)
    for outcome in ("lost", "downlink_lost", "n_ul", "n_dl"):
        assert np.array_equal(getattr(recorded, outcome), getattr(simulated, outcome)), outcome
    for said, true in ((recorded.uplink, simulated.uplink), (recorded.downlink, simulated.downlink)):
        assert said is not None
        assert true is not None
        for fact in ("cause", "state", "delay"):
            assert np.array_equal(getattr(said, fact), getattr(true, fact)), fact
        np.testing.assert_allclose(said.gain, true.gain, rtol=0.0, atol=0.00501)
    assert (recorded.measured is None) == (simulated.measured is None)
    np.testing.assert_allclose(recorded.pose, simulated.pose, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(recorded.sent_pose, simulated.sent_pose, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(recorded.reference, simulated.reference, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(recorded.error[:, :2], simulated.error[:, :2], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(np.sin(recorded.error[:, 2] - simulated.error[:, 2]), 0.0, atol=1e-9)
    np.testing.assert_allclose(recorded.command, simulated.command, rtol=0.0, atol=1e-9)
    driven = driven_commands(recorded)
    assert (driven.sentence, driven.cannot_say, recorded.parameter_changes) == ("", "", ())
    assert driven.compared >= len(recorded) - 1
    assert not [note for note in recorded.notes if "the node said" in note or "do not fit" in note]
