"""What `agv-ncs channel` says of a channel, and netem's figures in and out."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_analysis.link.channel_study import age_distribution, fitted, study
from agv_analysis.link.markov_channel import bernoulli, gilbert_elliott
from agv_analysis.link.netem import NetemError, to_netem
from agv_analysis.link.netem_text import read_netem
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import losses

AgvNcs = Callable[..., tuple[int, str]]

# -- the age's distribution ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("p", [0.0, 0.3, 0.9])
def test_the_age_under_independent_losses_is_geometric(p: float) -> None:
    assert age_distribution(bernoulli(p), 50) == pytest.approx([(1.0 - p) * p**j for j in range(50)], abs=1e-15)


def test_the_age_under_bursts_begins_with_one_and_stays_with_one_less_r() -> None:
    p, r = 0.02, 0.2
    rate = p / (p + r)
    expected = [1.0 - rate] + [rate * r * (1.0 - r) ** (j - 1) for j in range(1, 60)]
    assert age_distribution(gilbert_elliott(p, r), 60) == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize("chain", [bernoulli(0.4), gilbert_elliott(0.1, 0.3, 0.2, 0.95)])
def test_the_ages_have_the_mean_of_the_chain(chain: object) -> None:
    shares = age_distribution(chain, 2000)  # type: ignore[arg-type]
    assert shares.sum() == pytest.approx(1.0, abs=1e-12)
    assert shares @ np.arange(2000) == pytest.approx(chain.mean_age, rel=1e-12)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "channel",
    [ChannelParameters(model="bernoulli", p=0.3), ChannelParameters(model="gilbert_elliott", p=0.05, r=0.2, h=0.1)],
)
def test_the_slots_of_a_channel_follow_its_closed_form(channel: ChannelParameters) -> None:
    found = study(channel, 5, "uplink", 200_000, 0.005)
    assert found.chain is not None
    assert found.expected_age_shares is not None
    # Five standard deviations; ages are correlated over some tens of slots at the most.
    bound = 5.0 * math.sqrt(0.25 / 200_000 * 20.0)
    assert abs(found.outages.loss_rate - found.chain.loss_rate) < bound
    assert np.abs(found.age_shares - found.expected_age_shares).max() < bound
    assert (found.lost == losses(channel, 5, "uplink", 200_000)).all()


def test_fading_s_closed_form_knows_the_speed() -> None:
    """Along the y axis, fades of 6 dB: theory's loss rate and mean outage, which is half as long at twice the speed."""
    channel = ChannelParameters(model="rayleigh", margin=6.0, carrier=9e8)
    slow, fast = (
        study(channel, 4, "uplink", 200_000, 0.001, np.outer(np.arange(200_000) * speed, (0.0, 0.001)))
        for speed in (2.0, 4.0)
    )
    rho = 10.0 ** (-6.0 / 20.0)
    lasts = 299_792_458.0 / 9e8 * math.expm1(rho**2) / (rho * math.sqrt(2.0 * math.pi)) / 0.002
    assert slow.expected.mean_burst == pytest.approx(lasts, rel=1e-5)
    assert fast.expected.mean_burst == pytest.approx(lasts / 2.0, rel=1e-5)
    for found in (slow, fast):
        assert found.expected.loss_rate == pytest.approx(-math.expm1(-(rho**2)))
        # One field along 400 m, 1200 wavelengths: some hundred fades, each of a length of its own.
        assert found.outages.loss_rate == pytest.approx(found.expected.loss_rate, rel=0.15)
        assert found.outages.mean_burst == pytest.approx(found.expected.mean_burst, rel=0.15)


def test_a_late_channel_has_its_losses_and_no_closed_form_of_its_ages() -> None:
    found = study(ChannelParameters(model="bernoulli", p=0.2, delay=0.015), 1, "uplink", 50_000, 0.005)
    assert found.expected.loss_rate == pytest.approx(0.2)
    assert (found.expected.mean_age, found.expected_age_shares) == (None, None)
    assert found.late == pytest.approx(1.0, abs=1e-4)  # all but that of slot 0
    # The age is that without the delay, and three slots.
    assert found.outages.age.mean == pytest.approx(0.2 / 0.8 + 3.0, abs=0.05)


def test_a_channel_with_parameters_has_them_fitted() -> None:
    channel = ChannelParameters(model="gilbert_elliott", p=0.05, r=0.2)
    found = fitted(losses(channel, 1, "uplink", 200_000), ChannelParameters())
    assert found.model == "gilbert_elliott"
    assert (found.p, found.r) == pytest.approx((0.05, 0.2), rel=0.05)
    independent = fitted(losses(ChannelParameters(model="bernoulli", p=0.3), 1, "uplink", 50_000), channel)
    assert independent.model == "bernoulli"
    assert independent.p == pytest.approx(0.3, rel=0.05)


# -- netem -----------------------------------------------------------------------------------------------------------


def from_netem(line: str, channel: ChannelParameters) -> ChannelParameters:
    """A channel of which a line says all."""
    found, differences = read_netem(line, channel)
    assert differences == ()
    return found


percents = st.integers(0, 10_000_000).map(lambda parts: f"{parts / 100_000:.5f}".rstrip("0").rstrip("."))


@settings(deadline=None, derandomize=True)
@given(st.tuples(percents, percents, percents, percents))
def test_netems_figures_go_in_and_out_unchanged(figures: tuple[str, ...]) -> None:
    line = "loss gemodel " + " ".join(f"{figure}%" for figure in figures)
    assert to_netem(from_netem(line, ChannelParameters())) == line


@settings(deadline=None, derandomize=True)
@given(st.tuples(*[st.floats(0.0, 1.0)] * 2), st.sampled_from([0.0, 0.1, 0.37, 1.0]))
def test_a_channel_goes_through_netem_unchanged(pr: tuple[float, float], h: float) -> None:
    channel = ChannelParameters(model="gilbert_elliott", p=pr[0], r=pr[1], h=h, k=1.0)
    assert from_netem(to_netem(channel), ChannelParameters()) == channel
    independent = ChannelParameters(model="bernoulli", p=pr[0])
    assert from_netem(to_netem(independent), ChannelParameters()) == independent


def test_what_a_line_leaves_out_is_as_in_netem() -> None:
    def parameters(line: str) -> tuple[float, ...]:
        channel = from_netem(line, ChannelParameters())
        return channel.p, channel.r, channel.h, channel.k

    assert parameters("loss gemodel 2%") == (0.02, 0.98, 0.0, 1.0)
    assert parameters("loss gemodel 2% 20%") == (0.02, 0.2, 0.0, 1.0)
    assert parameters("loss gemodel 2 20 70") == (0.02, 0.2, 0.3, 1.0)
    assert parameters("loss gemodel 1% 10% 70% 0.1%") == (0.01, 0.1, 0.3, 0.999)


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("loss gemodel 1% x", "'x'"),
        ("loss gemodel 101%", "'101%'"),
        ("loss gemodel nan", "needs a percentage, in 'loss gemodel nan'"),
        ("loss gemodel", "'loss gemodel'"),
        ("loss gemodel 1% 2% 3% 4% 5%", "takes 4 percentages at most, got 5"),
        ("loss random 1% loss random 2%", "takes loss once, in 'loss random 1% loss random 2%'"),
        ("delay 10ms latency 20ms", "takes latency once"),
        ("delay 10m", "needs a time, as in delay 20ms, in 'delay 10m'"),
        ("delay -1ms", "in 'delay -1ms'"),
        ("delay 1.2.3ms", "in 'delay 1.2.3ms'"),
        ("duplicate", "'duplicate'"),
        ("", "'' sets nothing of a channel"),
    ],
)
def test_a_line_that_netem_would_not_take_is_refused(line: str, found: str) -> None:
    with pytest.raises(NetemError, match=re.escape(found)):
        from_netem(line, ChannelParameters())


def test_a_model_that_netem_does_not_have_is_refused() -> None:
    with pytest.raises(NetemError, match="netem has no channel burst, only bernoulli and gilbert_elliott"):
        to_netem(ChannelParameters(model="burst", n=3))
    with pytest.raises(NetemError, match=r"netem has no schedule; the channel's is 1: p=0\.5"):
        to_netem(ChannelParameters(model="bernoulli", p=0.1, schedule="1: p=0.5"))
    with pytest.raises(NetemError, match=r"netem has no lifetime; the channel's is 0\.1"):
        to_netem(ChannelParameters(model="bernoulli", p=0.1, lifetime=0.1))


@pytest.mark.parametrize(
    "line",
    [
        "delay 20ms", "delay 20ms 5ms", "delay 0ms 5ms", "duplicate 30%", "delay 12.5ms loss random 1% duplicate 0.5%",
        "delay 3ms 1ms loss gemodel 1% 10% 70% 0.1%",
    ],
)  # fmt: skip
def test_delays_go_in_and_out_unchanged(line: str) -> None:
    assert to_netem(from_netem(line, ChannelParameters(delay=1.0, duplicate=0.2))) == line


def test_times_are_those_of_netem() -> None:
    for line in ("delay 20ms 5ms", "delay 0.02s 5000us", "delay 20000 5000"):
        found = from_netem(line, ChannelParameters(model="bernoulli", p=0.3))
        assert (found.model, found.delay, found.jitter) == ("perfect", 0.02, 0.005)


# -- the command -----------------------------------------------------------------------------------------------------


def test_channel_prints_writes_and_draws(agv_ncs: AgvNcs, tmp_path: Path) -> None:
    files = {name: tmp_path / f"channel.{name}" for name in ("json", "csv", "png")}
    code, said = agv_ncs(
        "channel", "config/outages.yaml", "--slots", "20000", "--json", str(files["json"]), "--csv", str(files["csv"]),
        "--picture", str(files["png"]),
    )  # fmt: skip
    assert code == 0, said
    assert "uplink: gilbert_elliott, p 0.02, r 0.2" in said
    assert "closed form" in said
    figures = json.loads(files["json"].read_text())
    assert figures["closed_form"]["loss_rate"] == pytest.approx(0.02 / 0.22)
    assert sum(figures["age_shares"]) == pytest.approx(1.0)
    assert len(files["csv"].read_text().splitlines()) == 1 + len(figures["age_shares"])
    assert files["png"].read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("settings_of", "said"),
    [
        (["model=rayleigh", "margin=3.0"], "rayleigh, carrier 3700000000.0, margin 3.0"),
        (
            ["model=coverage_hole", "hole_circles=[0, 10, 3]"],
            "coverage_hole, p 0.02, hole_loss 1.0, hole_circles (0.0,",
        ),
        (["delay=0.02"], "k 1.0, delay 0.02"),
        (["schedule=1: outage=0.2"], "k 1.0, schedule 1: outage=0.2"),
    ],
)
def test_channel_says_what_comes_on_top_and_where(agv_ncs: AgvNcs, settings_of: list[str], said: str) -> None:
    chosen = [word for setting in settings_of for word in ("--set", f"relay.uplink.{setting}")]
    code, found = agv_ncs("channel", "config/outages.yaml", "--slots", "4000", *chosen)
    assert code == 0, found
    assert said in found


def test_channel_fits_a_trace_and_speaks_netem(agv_ncs: AgvNcs, tmp_path: Path) -> None:
    trace = tmp_path / "outages.csv"
    lost = losses(ChannelParameters(model="gilbert_elliott", p=0.02, r=0.2), 1, "uplink", 20_000)
    trace.write_text("lost\n" + "".join(f"{value:d}\n" for value in lost.tolist()))
    code, said = agv_ncs("channel", "config/outages.yaml", "--fit", str(trace))
    assert code == 0, said
    assert "gilbert_elliott, p 0.02" in said
    line = "loss gemodel 1% 10% 70% 0.1%"
    assert agv_ncs("channel", "config/outages.yaml", "--from-netem", line, "--netem") == (0, line)
    pasted = "qdisc netem 8001: dev eth0 root refcnt 2 limit 1000 delay 20ms  5ms 25% loss 5%"
    code, said = agv_ncs("channel", "config/outages.yaml", "--from-netem", pasted, "--netem")
    assert code == 0
    assert said.splitlines()[-1] == "delay 20ms 5ms loss random 5%"
    assert "not the same: delays are correlated by 0.25 in netem" in said
    code, said = agv_ncs("channel", "config/outages.yaml", "--link", "downlink", "--netem")
    assert code == 1
    assert "netem has no channel perfect" in said
