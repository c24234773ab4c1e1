"""What a schedule changes, and when: against channels that never change, piece by piece."""

from __future__ import annotations

import dataclasses
import json
import re
import textwrap
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_analysis.cli import main
from agv_analysis.link.markov_channel import chain_of
from agv_analysis.simulation.channel_outcomes import ChannelRealisation
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import Channel, losses
from agv_plant.radio.schedule import OUTAGE, is_scripted
from agv_ros.parameters import ParameterError, build
from agv_ros.ros_yaml import load

REPOSITORY = Path(__file__).parents[3]
TS, STEPS = 0.005, 9000
BERNOULLI = ChannelParameters(model="bernoulli", p=0.3)


def scheduled(schedule: str, channel: ChannelParameters = BERNOULLI) -> ChannelParameters:
    return dataclasses.replace(channel, schedule=schedule)


@pytest.mark.parametrize("schedule", ["p=0.0; 10: p=0.1; 20: p=0.5", "20: p=0.5;  0 : p = 0; 10.0: p=1e-1 ;"])
def test_a_parameter_has_its_value_from_its_time_on(schedule: str) -> None:
    found = losses(scheduled(schedule), 3, "uplink", STEPS, TS)
    for first, last, p in ((0, 2000, 0.0), (2000, 4000, 0.1), (4000, STEPS, 0.5)):
        alone = losses(dataclasses.replace(BERNOULLI, p=p), 3, "uplink", STEPS, TS)
        assert np.array_equal(found[first:last], alone[first:last])


def test_a_channel_with_a_memory_keeps_it() -> None:
    c = ChannelParameters(model="gilbert_elliott", p=1.0, r=0.0)
    found = losses(scheduled("0.1: p=0.0; 0.2: r=1.0", c), 1, "uplink", 100, TS)
    assert found.tolist() == [False] + [True] * 40 + [False] * 59


def test_an_outage_comes_once_or_again_and_again_until_another_word() -> None:
    c = scheduled("20: outage=0.3 every 5; 34: outage=0; 40: outage=1", ChannelParameters())
    expected = {k for first in (20, 25, 30) for k in range(first * 200, first * 200 + 60)} | set(range(8000, 8200))
    channel = Channel(c, 1, "downlink", TS)
    outcomes = [channel.outcome(k) for k in range(STEPS)]
    assert {k for k, outcome in enumerate(outcomes) if outcome.lost} == expected
    assert {outcome.cause for outcome in outcomes} == {"", OUTAGE}


def test_losses_of_the_model_come_on_top() -> None:
    found = losses(scheduled("1: outage=0.5 every 1"), 2, "uplink", STEPS, TS)
    alone = losses(BERNOULLI, 2, "uplink", STEPS, TS)
    k = np.arange(STEPS)
    assert np.array_equal(found, alone | ((k >= 200) & (k % 200 < 100)))


@settings(deadline=None, derandomize=True)
@given(st.integers(0, 400), st.integers(0, 100), st.integers(1, 50), st.integers(0, 50))
def test_times_are_rounded_up_to_whole_slots(k: int, at: int, length: int, gap: int) -> None:
    period = length + gap
    inside = k >= at and (k - at) % period < length
    assert is_scripted(k, at * TS, length * TS, period * TS, TS) == inside
    assert is_scripted(k, at * TS - 0.4 * TS, length * TS - 0.4 * TS, period * TS - 0.4 * TS, TS) == inside
    assert is_scripted(k, at * TS, length * TS, 0.0, TS) == (at <= k < at + length)


SCHEDULES = {
    "values": scheduled("5: p=0.9; 7: p=0.0; 30: p=1.0"),
    "memory": scheduled("5: p=0.5; 9: h=0.5; 20: r=0.1", ChannelParameters(model="gilbert_elliott", p=0.1, r=0.3)),
    "outages": scheduled("1: outage=0.2 every 0.7; 12: p=0.2; 30: outage=0"),
    "of a perfect one": scheduled("3: outage=0.03 every 0.1", ChannelParameters()),
    "behind the end": scheduled("3: p=0.2; 1000: p=1.0; 2000: outage=3"),
    "bursts": scheduled("3: n=7; 9: n=0", ChannelParameters(model="burst", n=2)),
    "at once": scheduled("p=0.9; p=0.1; 0.0049: p=0.7; 0.005: outage=0.1"),
}


@pytest.mark.parametrize("c", SCHEDULES.values(), ids=SCHEDULES)
def test_the_simulation_follows_it_as_the_relay_does(c: ChannelParameters) -> None:
    assert np.array_equal(ChannelRealisation(5, STEPS, TS).outcomes(c, "uplink"), losses(c, 5, "uplink", STEPS, TS))


@pytest.mark.parametrize("c", SCHEDULES.values(), ids=SCHEDULES)
def test_outcomes_do_not_depend_on_what_was_asked_before(c: ChannelParameters) -> None:
    expected, channel = losses(c, 5, "uplink", STEPS, TS), Channel(c, 5, "uplink", TS)
    for k in (8000, 10, 5000, 5000, 4999, 0, 1001, 1000):
        assert channel.lost(k) == expected[k]


def test_a_schedule_holds_for_delays() -> None:
    channel = Channel(scheduled("1: delay=0.02; 2: delay=0.0"), 1, "uplink", TS)
    assert [channel.delays(k)[0] for k in (0, 199, 200, 399, 400)] == [0.0, 0.0, 4.0, 4.0, 0.0]
    assert not scheduled("1: delay=0.02").is_direct


def test_a_parameter_set_by_hand_holds_where_the_schedule_says_nothing() -> None:
    channel = Channel(scheduled("10: p=1.0"), 1, "uplink", TS)
    channel.parameters = scheduled("10: p=1.0", dataclasses.replace(BERNOULLI, p=0.0))
    assert not any(channel.lost(k) for k in range(2000))
    assert all(channel.lost(k) for k in range(2000, 2100))


def test_what_changes_has_no_closed_form() -> None:
    assert chain_of(BERNOULLI) is not None
    assert chain_of(scheduled("1: p=0.0")) is None


@pytest.mark.parametrize(
    ("schedule", "complaint"),
    [
        ("20 p=0.1", "must be TIME: NAME=VALUE or TIME: outage=SECONDS .*; got '20 p=0.1'"),
        ("20: p=0.1, 30: p=0.2", "got '20: p=0.1, 30: p=0.2'"),
        ("20: q=0.1", "'q' must be one of outage, p, r, h, k, .*; got '20: q=0.1'"),
        ("20: seed=1", "'seed' must be one of outage"),
        ("20: p=1.5", r"schedule.p must be in \[0, 1\], got 1.5"),
        ("20: n=1.5", "schedule.n is an integer, got 1.5"),
        ("-1: p=0.1", "a time must be in \\[0, 1e\\+09\\] s, got '-1: p=0.1'"),
        ("20: outage=6 every 5", "an outage must be >= 0 s and no longer than its period, got '20: outage=6 every 5'"),
        ("20: outage=0 every 5", "no longer than its period"),
        ("20: p=0.1 every 5", "only an outage comes again"),
    ],
)
def test_a_schedule_of_another_form_is_refused(schedule: str, complaint: str) -> None:
    with pytest.raises(ParameterError, match=complaint):
        scheduled(schedule)


def test_a_run_says_what_lost_its_messages(tmp_path: Path) -> None:
    """By a schedule and by a model, both counted by hand; the figures are in the table and in the JSON file."""
    settings = ("relay.uplink.model=bernoulli", "relay.uplink.p=0.1", "relay.uplink.schedule=1: outage=0.5 every 2")
    arguments = [word for setting in settings for word in ("--set", setting)]
    done = CliRunner().invoke(
        main,
        [
            "simulate",
            "config/paper.yaml",
            *arguments,
            "--set",
            "plant.duration=10.0",
            "--json",
            str(tmp_path / "a.json"),
        ],
    )
    assert done.exit_code == 0, done.output
    alone = losses(dataclasses.replace(BERNOULLI, p=0.1), 1, "uplink", 2000, TS)
    outage = (np.arange(2000) >= 200) & ((np.arange(2000) - 200) % 400 < 100)
    expected = {"outage": int(outage.sum()), "bernoulli": int((alone & ~outage).sum())}
    found = json.loads((tmp_path / "a.json").read_text())
    assert found["loss_causes"] == expected
    assert found["downlink_loss_causes"] == {}
    assert f"outage ({expected['outage']}), bernoulli ({expected['bernoulli']})" in done.output


def test_the_examples_of_the_page_are_channels() -> None:
    page = (REPOSITORY / "docs/channels.md").read_text(encoding="utf-8")
    examples = [block for block in re.findall(r"(?:^    .*\n)+", page, re.MULTILINE) if block.startswith("    uplink:")]
    models = []
    for example in examples:
        values = load(textwrap.dedent(example))["uplink"]
        if values["model"] != "roadworks":
            models.append(build(ChannelParameters, values).model)
    assert models == ["coverage_hole", "bernoulli"]
