"""The uplink of a fleet against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from agv_analysis.simulation.channel_outcomes import ChannelRealisation
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import Channel, losses
from agv_plant.radio.shared_uplink import OLDEST_FIRST, RANDOM, ROUND_ROBIN, SCHEDULERS, serve_all
from agv_ros.parameters import ParameterError


def losses_of(vehicles: int, blocks: int, scheduler: int, p: float, slots: int, seed: int = 1) -> NDArray[np.bool_]:
    random = np.random.default_rng(seed)
    lost = np.zeros((slots, vehicles), dtype=np.bool_)
    turn, loss = random.random((2, slots, vehicles))
    serve_all(0, blocks, scheduler, p, turn, loss, np.zeros(vehicles, dtype=np.int64), lost)
    return lost


@pytest.mark.parametrize("scheduler", [ROUND_ROBIN, OLDEST_FIRST])
@pytest.mark.parametrize(("vehicles", "blocks"), [(12, 1), (12, 3), (7, 7), (5, 9)])
def test_in_turn_a_pose_comes_every_n_over_r_slots(scheduler: int, vehicles: int, blocks: int) -> None:
    lost = losses_of(vehicles, blocks, scheduler, 0.0, 240)
    period = max(1, vehicles // blocks)
    for i in range(vehicles):
        assert set(np.diff(np.flatnonzero(~lost[:, i])).tolist()) == {period}
    assert (np.count_nonzero(~lost, axis=1) == min(blocks, vehicles)).all()


def test_with_a_remainder_nobody_waits_longer_than_the_next_whole_turn() -> None:
    for scheduler in (ROUND_ROBIN, OLDEST_FIRST):
        lost = losses_of(7, 3, scheduler, 0.0, 210)
        for i in range(7):
            assert set(np.diff(np.flatnonzero(~lost[:, i])).tolist()) <= {2, 3}


def test_a_random_scheduler_is_a_channel_of_independent_losses() -> None:
    """Loss rate 1 - R (1 - p) / N; z-tests at five standard deviations, of the rate and of two losses in a row."""
    n, r, p, slots = 10, 3, 0.2, 20_000
    lost = losses_of(n, r, RANDOM, p, slots)
    rate = 1.0 - r * (1.0 - p) / n
    sigma = np.sqrt(rate * (1.0 - rate) / slots)
    assert np.abs(lost.mean(axis=0) - rate).max() < 5.0 * sigma
    twice = (lost[1:] & lost[:-1]).mean(axis=0)
    assert np.abs(twice - rate**2).max() < 5.0 * np.sqrt(rate**2 * (1.0 - rate**2) / slots) * np.sqrt(3.0)


@pytest.mark.parametrize("p", [0.0, 0.1, 0.5])
def test_one_vehicle_alone_has_the_channel_to_itself(p: float) -> None:
    lost = losses_of(1, 1, OLDEST_FIRST, p, 20_000)[:, 0]
    assert lost.mean() == pytest.approx(p, abs=5.0 * np.sqrt(0.25 / 20_000))


def test_the_oldest_first_is_never_older_on_average() -> None:
    def mean_age(scheduler: int) -> float:
        lost = losses_of(12, 2, scheduler, 0.3, 20_000)
        slots = np.arange(len(lost))[:, None]
        return float((slots - np.maximum.accumulate(np.where(lost, 0, slots), axis=0)).mean())

    oldest, in_turn, random = (mean_age(scheduler) for scheduler in (OLDEST_FIRST, ROUND_ROBIN, RANDOM))
    assert oldest < in_turn < random
    # Each slot hears R (1 - p) vehicles, so a pose of one comes every N / (R (1 - p)) slots on average. At random the
    # age is geometric: its mean is that less one. In turn a pose fails p of the time, and a whole turn is waited for.
    assert random == pytest.approx(12 / (2 * 0.7) - 1.0, rel=0.03)
    assert in_turn == pytest.approx(6.0 * (1.0 + 0.3) / (2.0 * 0.7) - 0.5, rel=0.03)


@pytest.mark.parametrize("scheduler", SCHEDULERS)
def test_every_vehicle_s_relay_works_out_the_same_schedule(scheduler: str) -> None:
    """In each slot as many are heard as there are blocks, by the relays' own answers; simulated it is the same."""
    fleet = [ChannelParameters(model="shared", vehicles=5, vehicle=i, blocks=2, scheduler=scheduler) for i in range(5)]
    lost = np.array([losses(channel, 7, "uplink", 300) for channel in fleet])
    assert (np.count_nonzero(~lost[:, 1:], axis=0) == 2).all()
    assert (lost == [ChannelRealisation(7, 300).outcomes(channel, "uplink") for channel in fleet]).all()


def test_a_lossy_cell_with_a_schedule_is_the_same_simulated() -> None:
    channel = ChannelParameters(
        model="shared", vehicles=4, vehicle=3, blocks=2, scheduler="oldest_first", p=0.3, schedule="0.5: p=0.9"
    )
    lost = losses(channel, 3, "uplink", 400)
    assert lost[100:].mean() > lost[:100].mean()
    assert (lost == ChannelRealisation(3, 400).outcomes(channel, "uplink")).all()
    anew = Channel(channel, 3, "uplink")
    assert [anew.lost(k) for k in (250, 10, 11, 399)] == [lost[k] for k in (250, 10, 11, 399)]


def test_a_vehicle_that_is_not_there() -> None:
    with pytest.raises(ParameterError, match="must be 0 to 3"):
        ChannelParameters(model="shared", vehicles=4, vehicle=4)
