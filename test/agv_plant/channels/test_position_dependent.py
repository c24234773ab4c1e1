"""Channels that ask where the AGV is, against geometry and Clarke's closed forms, with bounds that a wrong one breaks.

The seeds are fixed, so a test passes or fails for good; each bound is five standard deviations of what it bounds.
"""

from __future__ import annotations

import cmath
import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.special import j0

from agv_analysis.compiled.functions import compiled
from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.simulation import simulate, simulate_batch
from agv_analysis.simulation.batch import TWIN_OFFSET
from agv_analysis.simulation.channel_outcomes import ChannelRealisation
from agv_analysis.simulation.link_loop import empty_trace, listen
from agv_plant.channels.coverage_hole import is_in_hole, rows_of
from agv_plant.channels.position_dependent import PLACED
from agv_plant.channels.rayleigh import SPEED_OF_LIGHT, fades_per_metre, fading_gain, loss_rate
from agv_plant.channels.rayleigh import rows_of as waves_of
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import Channel, losses
from agv_ros.parameters import ParameterError

NONE = (0.0,)
SQUARE = (0.0, 0.0, 2.0, 0.0, 2.0, 2.0, 0.0, 2.0, 0.0, 0.0)

# -- coverage_hole ---------------------------------------------------------------------------------------------------

coordinates = st.floats(-3.0, 3.0)


def winds_around(x: float, y: float, corners: Sequence[complex]) -> bool:
    """Is a point in a polygon, by the angles under which it sees the edges: they sum to a whole turn or to none."""
    seen = [corner - complex(x, y) for corner in corners]
    return abs(sum(cmath.phase(b / a) for a, b in zip(seen, [*seen[1:], seen[0]], strict=True))) > 1.0


def ring(corners: Sequence[complex]) -> tuple[float, ...]:
    return tuple(part for corner in (*corners, corners[0]) for part in (corner.real, corner.imag))


@settings(deadline=None, derandomize=True, max_examples=300)
@given(st.lists(st.tuples(st.floats(0.3, 3.0), st.floats(0.1, 1.0)), min_size=3, max_size=9), coordinates, coordinates)
def test_a_polygon_s_inside_is_what_its_edges_wind_around(star: list[tuple[float, float]], x: float, y: float) -> None:
    turns = np.cumsum([turn for _, turn in star])
    corners = [
        radius * cmath.exp(2j * math.pi * turn / turns[-1]) for (radius, _), turn in zip(star, turns, strict=True)
    ]
    for a, b in zip(corners, [*corners[1:], corners[0]], strict=True):
        if abs(complex(x, y) - a) + abs(complex(x, y) - b) - abs(a - b) < 1e-6:
            return  # on the very edge rounding decides
    assert is_in_hole(x, y, rows_of(NONE, ring(corners))) == winds_around(x, y, corners)


@settings(deadline=None, derandomize=True)
@given(coordinates, coordinates)
def test_several_holes_are_their_union(x: float, y: float) -> None:
    other = (1.0, 1.0, 3.0, 1.0, 3.0, 3.0, 1.0, 1.0)
    holes = rows_of((-1.0, -1.0, 0.5, 1.5, 1.5, 0.25), (*SQUARE, *other))
    alone = [rows_of((-1.0, -1.0, 0.5), NONE), rows_of((1.5, 1.5, 0.25), NONE), rows_of(NONE, SQUARE)]
    assert is_in_hole(x, y, holes) == any(is_in_hole(x, y, one) for one in [*alone, rows_of(NONE, other)])
    assert is_in_hole(x, y, alone[0]) == (abs(complex(x, y) - (-1.0 - 1.0j)) <= 0.5)


def test_nobody_is_in_a_hole_who_is_nowhere() -> None:
    assert not is_in_hole(math.nan, math.nan, rows_of((0.0, 0.0, 1e9), SQUARE))


def test_inside_and_outside_have_their_loss_rates_whatever_was_asked_before() -> None:
    c = ChannelParameters(model="coverage_hole", hole_polygons=SQUARE, p=0.1, hole_loss=0.8)
    channel, steps = Channel(c, 1, "uplink"), 50_000
    for place, p in (((1.0, 1.0), 0.8), ((-1.0, 1.0), 0.1)):
        lost = [channel.lost(k, *place) for k in range(steps)]
        assert abs(np.mean(lost) - p) < 5.0 * math.sqrt(p * (1.0 - p) / steps)
        assert [channel.lost(k, *place) for k in (77, 5, 40_000)] == [lost[k] for k in (77, 5, 40_000)]
        assert not lost[0]


@pytest.mark.no_cover
def test_an_outage_lasts_as_long_as_the_way_through_the_hole() -> None:
    """At 1 m/s through a circle of 0.5 m and a square of 2 m: 200 and 400 slots; the AGV is where it should be."""
    run = simulate(load_scenario("config/paper.yaml", [
        "error_detector.track=line", "error_detector.policy=predict",
        "plant.initial_pose=[0.0, 0.0, 1.5707963267948966]",
        "relay.uplink.model=coverage_hole", "relay.uplink.hole_circles=[0.0, 1.0, 0.5]",
        "relay.uplink.hole_polygons=[-1.0, 3.0, 1.0, 3.0, 1.0, 5.0, -1.0, 5.0, -1.0, 3.0]", "plant.duration=8.0",
    ]))  # fmt: skip
    edges = np.flatnonzero(np.diff(run.lost.astype(int)))
    assert abs(edges - [100, 300, 600, 1000]).max() <= 1
    assert run.uplink is not None
    assert set(run.uplink.cause[run.lost]) == {"coverage_hole"}


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        ({}, "neither hole_circles nor hole_polygons has one"),
        ({"hole_circles": (1.0, 2.0)}, "hole_circles must be x, y, radius of each circle, got 2 numbers"),
        ({"hole_circles": (1.0, 2.0, 0.0)}, r"a radius must be > 0, got 0.0 around \(1, 2\)"),
        ({"hole_polygons": (1.0, 2.0, 3.0)}, "hole_polygons must be x, y of each corner, got 3 numbers"),
        ({"hole_polygons": SQUARE[:-2]}, r"does not end with its first corner \(0, 0\): repeat it"),
        ({"hole_polygons": (0.0, 0.0, 1.0, 1.0, 0.0, 0.0)}, "has 2 corners, must be 3 at least"),
    ],
)
def test_a_hole_that_is_none_is_refused(wrong: dict[str, tuple[float, ...]], complaint: str) -> None:
    with pytest.raises(ParameterError, match=complaint):
        ChannelParameters(model="coverage_hole", **wrong)  # type: ignore[arg-type]


# -- rayleigh --------------------------------------------------------------------------------------------------------

CARRIER = 3.7e9
WAVELENGTH = SPEED_OF_LIGHT / CARRIER


def field(seed: int, x: NDArray[np.float64], y: NDArray[np.float64], stream: str = "uplink") -> NDArray[np.complex128]:
    """h at places [m], all at once."""
    rows = np.array(waves_of(seed, stream, CARRIER))
    angle = np.multiply.outer(x, rows[:, 0]) + np.multiply.outer(y, rows[:, 1]) + rows[:, 2]
    return np.asarray(np.exp(1j * angle) @ rows[:, 3])


def power(seed: int, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.abs(field(seed, x, y)) ** 2)


def test_the_gain_is_that_of_the_sum_of_the_waves() -> None:
    x, y = np.random.default_rng(1).uniform(-30.0, 30.0, (2, 200))
    waves = waves_of(5, "uplink", CARRIER)
    gains = [fading_gain(*place, waves) for place in zip(x.tolist(), y.tolist(), strict=True)]
    assert 10.0 ** (np.array(gains) / 10.0) == pytest.approx(power(5, x, y), rel=1e-9)


@pytest.mark.parametrize("margin", [0.0, 3.0, 10.0, 20.0])
def test_the_share_of_places_in_a_fade(margin: float) -> None:
    """1 - exp(-rho^2), over fields and places far apart; the sum of 64 waves differs by 1/128 of it at most."""
    rng, places = np.random.default_rng(2), 200
    found = [
        np.mean(power(seed, *rng.uniform(-1e3, 1e3, (2, places))) < 10.0 ** (-margin / 10.0)) for seed in range(200)
    ]
    expected = 1.0 - math.exp(-(10.0 ** (-margin / 10.0)))
    assert loss_rate(margin) == pytest.approx(expected, rel=1e-12)
    assert abs(np.mean(found) - expected) < 5.0 * np.std(found) / math.sqrt(len(found)) + expected / 128.0


@pytest.mark.parametrize("wavelengths", [0.1, 0.25, 0.3827, 0.6, 1.0, 2.5])
@pytest.mark.parametrize("direction", [0.0, 0.7])
def test_the_autocorrelation_is_bessel_s(wavelengths: float, direction: float) -> None:
    d = wavelengths * WAVELENGTH
    rng = np.random.default_rng(3)
    found = []
    for seed in range(100):
        x, y = rng.uniform(-1e3, 1e3, (2, 100))
        here, there = field(seed, x, y), field(seed, x + d * math.cos(direction), y + d * math.sin(direction))
        found.append(np.mean(here * there.conj()))
    spread = np.std(np.real(found)) / math.sqrt(len(found))
    assert abs(np.mean(np.real(found)) - j0(2.0 * math.pi * wavelengths)) < 5.0 * spread
    assert abs(np.mean(np.imag(found))) < 5.0 * np.std(np.imag(found)) / math.sqrt(len(found))


@pytest.mark.parametrize("margin", [0.0, 7.0, 15.0])
def test_fades_come_and_last_as_clarke_says(margin: float) -> None:
    """Level-crossing rate and mean length of a fade along straight lines of 100 wavelengths, finely sampled."""
    rho = 10.0 ** (-margin / 20.0)
    length, steps = 100.0 * WAVELENGTH, 10_000
    path = np.linspace(0.0, length, steps)
    fades, shares = [], []
    for seed in range(30):
        bad = power(seed, path * math.cos(0.4), path * math.sin(0.4)) < rho**2
        fades.append(np.count_nonzero(~bad[:-1] & bad[1:]) / length)
        shares.append(np.mean(bad))
    rate = math.sqrt(2.0 * math.pi) * rho * math.exp(-(rho**2)) / WAVELENGTH
    assert fades_per_metre(CARRIER, margin) == pytest.approx(rate, rel=1e-12)
    assert abs(np.mean(fades) - rate) < 5.0 * np.std(fades) / math.sqrt(len(fades)) + rate / 128.0
    lasts = WAVELENGTH * math.expm1(rho**2) / (rho * math.sqrt(2.0 * math.pi))
    ratio = np.array(shares) - lasts * np.array(fades)
    assert abs(np.mean(ratio)) < 5.0 * np.std(ratio) / math.sqrt(len(ratio)) + np.mean(shares) / 64.0


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
def test_speed_makes_fades_shorter_and_not_rarer(speed: float) -> None:
    """Outages in slots, of the very channel that nodes and simulation ask, against f_D = v / lambda."""
    c = ChannelParameters(model="rayleigh", margin=6.0, carrier=CARRIER)
    steps, ts = 30_000, 0.001
    path = np.arange(steps) * speed * ts
    outages, rates = [], []
    for seed in range(12):
        trace = empty_trace(steps)
        compiled(listen)(
            ChannelRealisation(seed, steps, ts).link_inputs(c, "uplink"),
            trace,
            np.column_stack([path, 0.5 * np.ones(steps)]),
        )
        outages.append(np.count_nonzero(~trace.lost[:-1] & trace.lost[1:]))
        rates.append(np.mean(trace.lost))
    expected = fades_per_metre(CARRIER, 6.0) * speed * ts * steps
    assert abs(np.mean(outages) - expected) < 5.0 * np.std(outages) / math.sqrt(len(outages)) + expected / 64.0
    assert abs(np.mean(rates) - loss_rate(6.0)) < 5.0 * np.std(rates) / math.sqrt(len(rates)) + 0.01


def test_who_stands_in_a_fade_stays_in_it() -> None:
    c = ChannelParameters(model="rayleigh", margin=0.0)
    channel = Channel(c, 1, "uplink")
    fates = {place: {channel.lost(k, *place) for k in range(1, 100)} for place in ((0.0, 0.0), (1.0, 2.0), (3.0, 0.5))}
    assert all(len(fate) == 1 for fate in fates.values())


@pytest.mark.parametrize("correlation", [0.0, 0.6, 1.0])
def test_a_correlated_downlink_s_gain(correlation: float) -> None:
    """Powers of complex normal gains with the correlation rho have the correlation rho^2."""
    c = ChannelParameters(model="rayleigh", correlation=correlation)
    rng = np.random.default_rng(6)
    found = []
    for seed in range(150):
        up, down = Channel(c, seed, "uplink"), Channel(c, seed, "downlink")
        places = rng.uniform(-1e3, 1e3, (60, 2)).tolist()
        gains = np.array([[up.outcome(1, *place).gain, down.outcome(1, *place).gain] for place in places])
        one, other = 10.0 ** (gains.T / 10.0)
        found.append(np.mean(one * other) - np.mean(one) * np.mean(other))
    spread = np.std(found) / math.sqrt(len(found))
    assert abs(np.mean(found) - correlation**2) < 5.0 * spread + 1.0 / 32.0


# -- both ------------------------------------------------------------------------------------------------------------

PLACES = {
    "coverage_hole": ChannelParameters(model="coverage_hole", hole_circles=(0.0, 5.0, 2.0), p=0.1, hole_loss=0.7),
    "rayleigh": ChannelParameters(model="rayleigh", margin=3.0),
}


def test_every_one_is_tested_here() -> None:
    assert tuple(PLACES) == PLACED[1:]


@pytest.mark.parametrize("model", PLACES)
def test_the_relay_s_outcomes_are_the_simulation_s(model: str) -> None:
    steps = 3000
    places = np.column_stack([np.linspace(-3.0, 3.0, steps), np.linspace(2.0, 8.0, steps)])
    for stream in ("uplink", "downlink"):
        trace, channel = empty_trace(steps), Channel(PLACES[model], 9, stream)
        compiled(listen)(ChannelRealisation(9, steps).link_inputs(PLACES[model], stream), trace, places)
        alone = [channel.outcome(k, *place) for k, place in enumerate(places.tolist())]
        assert np.array_equal(trace.lost, [one.lost for one in alone])
        np.testing.assert_allclose(trace.gain, [one.gain for one in alone], rtol=0.0, atol=1e-9)
        order = np.random.default_rng(4).permutation(steps)[:200].tolist()
        again = Channel(PLACES[model], 9, stream)
        assert [again.outcome(k, *places[k].tolist()).lost for k in order] == [alone[k].lost for k in order]


@pytest.mark.parametrize("model", PLACES)
def test_seeds_and_streams_differ(model: str) -> None:
    steps = 4000
    path = np.column_stack([np.linspace(-10.0, 10.0, steps), np.full(steps, 5.0)])

    def lost(seed: int, stream: str) -> list[bool]:
        trace = empty_trace(steps)
        compiled(listen)(ChannelRealisation(seed, steps).link_inputs(PLACES[model], stream), trace, path)
        found: list[bool] = trace.lost.tolist()
        return found

    assert lost(1, "uplink") == lost(1, "uplink")
    assert len({tuple(lost(*source)) for source in ((1, "uplink"), (2, "uplink"), (1, "downlink"))}) == 3


@pytest.mark.parametrize("model", PLACES)
def test_an_agv_that_is_nowhere_is_in_no_hole_and_no_fade(model: str) -> None:
    found = losses(PLACES[model], 1, "uplink", 2000)
    p = PLACES[model].p
    assert abs(found.mean() - p) <= 5.0 * math.sqrt(p * (1.0 - p) / 2000)


SCENARIOS: dict[str, Callable[[], list[str]]] = {
    "a hole": lambda: ["relay.uplink.model=coverage_hole", "relay.uplink.hole_circles=[0.0, 5.0, 3.0]"],
    "fading": lambda: ["relay.downlink.model=rayleigh", "relay.downlink.margin=5.0", "relay.uplink.model=rayleigh"],
    "late": lambda: ["relay.uplink.delay=0.02", "relay.uplink.jitter=0.02", "relay.downlink.delay=0.01"],
}


@pytest.mark.no_cover
@pytest.mark.parametrize("settings_of", SCENARIOS.values(), ids=SCENARIOS)
def test_many_runs_are_the_single_ones(settings_of: Callable[[], list[str]]) -> None:
    scenario = load_scenario("config/paper.yaml", [*settings_of(), "plant.duration=10.0", "controller.kx=5.0"])
    table = simulate_batch([scenario], [scenario.relay.seed], twins=True)[0, 0]
    run = simulate(scenario)
    assert table["n_ul_max"] == run.n_ul.max()
    assert table["final"] == pytest.approx(run.reference[-1, 1] - run.pose[-1, 1], rel=1e-9, abs=1e-9)
    start = np.array(run.scenario.plant.initial_pose)
    one, twin = (_after(scenario, tuple((start + offset).tolist())) for offset in (0.0, TWIN_OFFSET))
    apart = np.linalg.norm(twin - one) / (math.sqrt(3.0) * TWIN_OFFSET)
    assert table["contraction"] == pytest.approx(apart, rel=1e-4)
    assert simulate_batch([scenario], [scenario.relay.seed])[0, 0]["iae"] == table["iae"]


def _after(scenario: Scenario, start: tuple[float, float, float]) -> NDArray[np.float64]:
    """Where an AGV from elsewhere is after the last slot: a run that goes on for one more."""
    plant = dataclasses.replace(
        scenario.plant, initial_pose=start, duration=scenario.plant.duration + scenario.plant.ts
    )
    return np.asarray(simulate(dataclasses.replace(scenario, plant=plant)).pose[-1])
