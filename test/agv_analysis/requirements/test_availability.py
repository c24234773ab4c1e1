"""Availability and mean time between failures: closed forms, and slots counted one by one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agv_analysis.link.link_figures import LinkFigures
from agv_analysis.link.markov_channel import Chain, bernoulli, gilbert_elliott
from agv_analysis.link.measurement import Measurement, PacketOutcomes
from agv_analysis.requirements.availability import availability_of, packets_for
from agv_analysis.requirements.class_check import CANNOT_TELL, YES, meets
from agv_analysis.requirements.link_availability import of_measurement
from agv_analysis.requirements.service_classes import ServiceClass
from agv_analysis.run import Floats

TS = 0.005


def test_independent_losses_in_closed_form() -> None:
    found = availability_of(bernoulli(1e-2), 2, TS)
    assert found.unavailability == pytest.approx(1e-6)
    assert found.mtbf == pytest.approx(5050.5, abs=0.05)
    for p, n in ((0.5, 0), (0.3, 5), (0.9, 20)):
        found = availability_of(bernoulli(p), n, TS)
        assert found.unavailability == pytest.approx(p ** (n + 1))
        assert found.mtbf == pytest.approx(TS * (1 - p ** (n + 1)) / ((1 - p) * p ** (n + 1)))


def test_links_that_never_fail_and_links_that_do_nothing_else() -> None:
    assert availability_of(bernoulli(0.0), 3, TS) == (0.0, 0.0, math.inf)
    assert availability_of(bernoulli(1.0), 3, TS).unavailability == 1.0
    assert availability_of(bernoulli(1.0), 3, TS).mtbf == 0.0
    periodic = Chain(np.roll(np.eye(4), 1, axis=1), np.eye(4)[0])  # three lost after each received one
    assert availability_of(periodic, 3, TS).failures == pytest.approx(0.0)
    assert availability_of(periodic, 2, TS).failures == pytest.approx(0.25)
    assert availability_of(periodic, 2, TS).mtbf == pytest.approx(3 * TS)


def outcomes(chain: Chain, slots: int, seed: int) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Of a chain of one or two states, drawn by the lengths of its stays."""
    rng = np.random.default_rng(seed)
    if len(chain.delivery) == 1:
        return np.asarray(rng.random(slots) >= chain.delivery[0])
    leave = chain.transition[0, 1], chain.transition[1, 0]
    count = int(slots * min(leave)) * 4 + 100
    stays = np.stack([rng.geometric(one, count) for one in leave], axis=1).ravel()
    state = np.repeat(np.tile([0, 1], count), stays)[:slots]
    assert len(state) == slots
    return np.asarray(rng.random(slots) >= chain.delivery[state])


LOSSES = [(0.01, 1), (0.05, 1), (0.1, 2), (0.2, 1), (0.3, 3), (0.5, 6), (0.6, 4), (0.8, 10)]
"""Probability, and outages that are survived [slots]."""

GILBERT = [
    (0.02, 0.2, 0.0, 1.0, 6), (0.01, 0.1, 0.0, 1.0, 10), (0.05, 0.5, 0.0, 1.0, 3), (0.001, 0.05, 0.0, 1.0, 20),
    (0.2, 0.4, 0.0, 1.0, 4), (0.3, 0.9, 0.0, 1.0, 2), (0.1, 0.3, 0.2, 0.99, 3), (0.01, 0.3, 0.0, 0.995, 2),
]  # fmt: skip


@pytest.mark.parametrize(
    ("chain", "n"),
    [*((bernoulli(p), n) for p, n in LOSSES), *((gilbert_elliott(*channel), n) for *channel, n in GILBERT)],
)
def test_slots_counted_one_by_one(chain: Chain, n: int) -> None:
    lost, found = outcomes(chain, 1_000_000, 3), availability_of(chain, n, TS)
    age = np.arange(len(lost)) - np.maximum.accumulate(np.where(lost, 0, np.arange(len(lost))))
    failed = age > n
    begins = np.count_nonzero(failed[1:] & ~failed[:-1])
    spread = 5.0 / math.sqrt(begins)  # failures are nearly independent
    assert failed.mean() == pytest.approx(found.unavailability, rel=2.0 * spread)
    assert TS * np.count_nonzero(~failed) / begins == pytest.approx(found.mtbf, rel=spread)


def test_six_nines_need_three_million_clean_packets() -> None:
    assert packets_for(1.0 - 1e-6) == 2_995_731
    n = packets_for(0.99)
    assert 0.99**n <= 0.05 < 0.99 ** (n - 1)


def figures(lost: Floats, interval: float) -> LinkFigures:
    sent = np.linspace(0.0, (len(lost) - 1) * interval, len(lost))
    return LinkFigures(Measurement("x", "table", sent, PacketOutcomes(np.asarray(lost, dtype=np.int8))))


def test_what_a_measurement_shows_holds_the_truth() -> None:
    """Of forty measurements of a link that was seen to fail little the intervals miss the truth in few."""
    chain, survival = gilbert_elliott(0.01, 0.25), 3 * TS
    truth = availability_of(chain, 3, TS)
    missed = [0, 0]
    for seed in range(40):
        found = of_measurement(figures(outcomes(chain, 5_000, seed).astype(np.float64), TS), survival)
        missed[0] += not found.unavailability.low <= truth.unavailability <= found.unavailability.high
        missed[1] += not found.mtbf.low <= truth.mtbf <= found.mtbf.high
    assert max(missed) <= 5


def test_a_measurement_without_a_failure() -> None:
    lost = np.zeros(60_000)
    lost[100:103] = 1.0  # 3 packets of 20 ms are no longer than what is survived
    found = of_measurement(figures(lost, 0.02), 0.06)
    assert (found.failures, found.unavailability.value, found.packets) == (0, 0.0, 60_000)
    assert found.unavailability.high == pytest.approx(1.0 - 0.05 ** (1 / 60_000))
    assert found.more_packets(1.0 - 1e-6) == 2_995_731 - 60_000
    lost[103] = 1.0
    failed = of_measurement(figures(lost, 0.02), 0.06)
    assert failed.failures == 1
    assert failed.unavailability.value == pytest.approx(1 / 60_000)
    assert failed.more_packets(1.0 - 1e-6) is None


def test_how_much_longer_to_measure_a_link_that_never_failed() -> None:
    found = of_measurement(figures(np.zeros(60_000), 0.005), 0.07)
    assert found.loss_rate.high == found.unavailability.high == pytest.approx(3.0 / 60_000, rel=2e-3)
    for wanted in (a_class(availability=1.0 - 1e-6), a_class(loss_rate=1e-6)):
        answer, why = meets(wanted, found)
        assert answer == CANNOT_TELL
        assert "to show it takes 2 995 731 clean packets at 95 %, and there are 60 000, 4.08 h more" in why
    assert meets(a_class(loss_rate=1e-4), found)[0] == YES
    answer, why = meets(a_class(mtbf_s=600.0), found)
    assert (answer, "(100 s to no end)" in why) == (CANNOT_TELL, True)
    needed = int(why.split("takes ")[1].split(" clean")[0].replace(" ", ""))
    assert of_measurement(figures(np.zeros(needed), 0.005), 0.07).mtbf.low == pytest.approx(600.0, rel=1e-5)


def test_what_is_of_round_trips_is_said_to_be() -> None:
    outcome = np.zeros(1000, dtype=np.int8)
    trips = Measurement("x", "ping", 0.02 * np.arange(1000.0), round_trip=PacketOutcomes(outcome))
    assert "they are of round trips" in of_measurement(LinkFigures(trips), 0.06).assumption


def a_class(**wanted: float) -> ServiceClass:
    return ServiceClass("x", "service", "D", "T", "1", True, **wanted)  # type: ignore[arg-type]
