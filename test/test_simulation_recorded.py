"""The simulation against recordings of the nodes on real DDS, step by step."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import pytest

from agv_analysis.simulation import simulate

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
    "a heavy AGV": (*LOSSY, "plant.a_max=3.0", "plant.lag=0.02", "plant.w_max=1.5", "error_detector.track=eight"),
}  # fmt: skip


@pytest.mark.parametrize("settings", RUNS.values(), ids=RUNS)
def test_a_recorded_run_is_the_simulated_one(drive: Callable[..., Run], settings: tuple[str, ...]) -> None:
    recorded = drive(*settings, "plant.duration=3.0")
    simulated = simulate(recorded.scenario)
    assert len(recorded) == len(simulated) == 600
    for verdict in ("lost", "downlink_lost", "n_ul"):
        assert np.array_equal(getattr(recorded, verdict), getattr(simulated, verdict)), verdict
    np.testing.assert_allclose(recorded.pose, simulated.pose, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(recorded.reference, simulated.reference, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(recorded.error[:, :2], simulated.error[:, :2], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(np.sin(recorded.error[:, 2] - simulated.error[:, 2]), 0.0, atol=1e-9)
    np.testing.assert_allclose(recorded.command, simulated.command, rtol=0.0, atol=1e-9)
