"""Lines for netem as people write them, held to the kernel's own recursions, simulated here."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.link.formats import read_link
from agv_analysis.link.link_figures import LinkFigures, setting_to_json
from agv_analysis.link.markov_channel import chain_of
from agv_analysis.link.measurement import LOST, RECEIVED, Measurement, MeasurementError, PacketOutcomes, Setting
from agv_analysis.link.netem import NetemError
from agv_analysis.link.netem_text import correlated_loss, four_states, read_netem
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.delay import delay_in_slots


def read(line: str) -> tuple[ChannelParameters, tuple[str, ...]]:
    return read_netem(line, ChannelParameters())


def test_what_ours_can_is_exact() -> None:
    for line in (
        "loss 5%", "loss random 5%", "tc qdisc add dev eth0 root netem loss 5%", "netem limit 1000 loss 5% seed 42",
        "qdisc netem 8001: dev eth0 root refcnt 2 limit 1000 loss 5%", "loss 5", "loss 5% 0% ecn",
    ):  # fmt: skip
        found, differences = read(line)
        assert (found.model, found.p, differences) == ("bernoulli", 0.05, ()), line
    for line in ("loss gemodel 1% 10% 70% 0.1%", "loss gemodel p 1% r 10% 1-h 70% 1-k 0.1%"):
        found, differences = read(line)
        assert (found.p, found.r, found.k, differences) == (0.01, 0.1, 0.999, ())
        assert found.h == pytest.approx(0.3)
    found, differences = read("loss state 2% 25%")
    assert (found.model, found.p, found.r, differences) == ("gilbert_elliott", 0.02, 0.25, ())
    found, differences = read("delay 20ms 5ms duplicate 1%")
    assert (found.delay, found.jitter, found.duplicate, found.model) == (0.02, 0.005, 0.01, "perfect")
    assert differences == ()
    assert read("delay 1.5s")[0].delay == 1.5
    assert read("delay 250usec")[0].delay == pytest.approx(250e-6)


def test_options_that_say_nothing_of_a_message_may_stand_anywhere(tmp_path: Path) -> None:
    found, differences = read(
        "qdisc netem 1: dev lo root rate 1Mbit packetoverhead 20 cellsize 53 celloverhead 5 loss 5%"
    )
    assert (found.p, len(differences)) == (0.05, 1)
    path = tmp_path / "netem.txt"
    path.write_text("limit 1000 seed 3 delay 5ms loss 1% ecn\n")
    setting = read_link(path)
    assert isinstance(setting, Setting)
    assert (setting.channel.delay, setting.channel.p, setting.differences) == (0.005, 0.01, ())


@pytest.mark.parametrize("line", ["delay 20ms", "delay 20ms 5ms loss 1%", "delay 10ms 20ms"])
def test_the_figures_of_a_setting_have_the_names_of_a_measurement(line: str) -> None:
    found = setting_to_json(Setting("", "netem", line, *read(line)))
    measured = Measurement("", "table", np.arange(3.0), PacketOutcomes(np.array([RECEIVED, LOST, RECEIVED], np.int8)))
    assert set(LinkFigures(measured).to_json()) <= set(found)
    assert (found["packets"], found["outage_max_s"], found["fit"], found["downlink"]["loss_rate"]) == (None,) * 4
    u = np.linspace(0.0, 1.0, 100_001)
    channel = read(line)[0]
    late = np.array([delay_in_slots(value, channel.delay, channel.jitter, 1.0) for value in u])
    expected = [late.mean(), *np.quantile(late, [0.5, 0.95, 0.99]), late.max()]
    delay = [found["delay"][name] for name in ("mean_s", "p50_s", "p95_s", "p99_s", "max_s")]
    assert delay == pytest.approx(expected, rel=1e-4)
    assert found["uplink"]["delay"]["p95_s"] == found["delay"]["p95_s"]


def test_what_ours_cannot_is_said() -> None:
    line = "delay 20ms 5ms 25% distribution normal loss 5% 25% reorder 25% 50% gap 5 rate 1mbit corrupt 0.1%"
    found, differences = read(line)
    assert found.delay == 0.02
    assert found.jitter == pytest.approx(0.005 * math.sqrt(3.0))  # the same standard deviation
    for word in (
        "correlated by 0.25",
        "normal distribution",
        "loss 0.05 with correlation",
        "reorder",
        "rate",
        "corrupt",
    ):
        assert any(word in sentence for sentence in differences), word


@pytest.mark.parametrize(("p", "rho"), [(0.3, 0.25), (0.1, 0.1), (0.5, 0.9)])
def test_correlated_losses_are_those_of_the_kernel(p: float, rho: float) -> None:
    u, x, lost = np.random.default_rng(1).random(100_000).tolist(), 0.5, []
    for value in u:
        x = value * (1.0 - rho) + rho * x
        lost.append(x < p)
    outcomes = np.array(lost)
    rate, burst = correlated_loss(p, rho)
    begins = np.count_nonzero(outcomes[1:] & ~outcomes[:-1])
    assert outcomes.mean() == pytest.approx(rate, rel=0.05)
    assert outcomes.sum() / begins == pytest.approx(burst, rel=0.05)
    channel, differences = read(f"loss {p:%} {rho:%}")
    chain = chain_of(channel)
    assert chain is not None
    assert [chain.loss_rate, chain.mean_burst] == pytest.approx([rate, burst])
    assert len(differences) == 1


def loss_4state(p13: float, p31: float, p32: float, p23: float, p14: float, count: int) -> list[bool]:
    """Linux' loss_4state(), state by state: its names and its order."""
    state, lost = 1, []
    for rnd in np.random.default_rng(2).random(count).tolist():
        is_lost = False
        if state == 1:
            if rnd < p14:
                state, is_lost = 4, True
            elif rnd < p13 + p14:
                state, is_lost = 3, True
        elif state == 2:
            if rnd < p23:
                state, is_lost = 3, True
        elif state == 3:
            if rnd < p32:
                state = 2
            elif rnd < p31 + p32:
                state = 1
            else:
                is_lost = True
        else:
            state = 1
        lost.append(is_lost)
    return lost


def test_four_states_are_those_of_the_kernel() -> None:
    figures = (0.05, 0.2, 0.3, 0.6, 0.02)
    outcomes, chain = np.array(loss_4state(*figures, 100_000)), four_states(*figures)
    begins = np.count_nonzero(outcomes[1:] & ~outcomes[:-1])
    assert outcomes.mean() == pytest.approx(chain.loss_rate, rel=0.03)
    assert outcomes.sum() / begins == pytest.approx(chain.mean_burst, rel=0.03)
    channel, differences = read("loss state " + " ".join(f"{figure:%}" for figure in figures))
    nearest = chain_of(channel)
    assert nearest is not None
    assert [nearest.loss_rate, nearest.mean_burst] == pytest.approx([chain.loss_rate, chain.mean_burst])
    assert "four states" in differences[0]


@pytest.mark.parametrize("line", ["loss", "loss 101%", "netem", "delay fast", "lose 5%", "limit 1000", "loss 5% 100%"])
def test_what_netem_would_not_take_is_refused(line: str) -> None:
    with pytest.raises(NetemError):
        read(line)


def test_a_file_with_a_line_is_a_setting(tmp_path: Path) -> None:
    path = tmp_path / "netem.txt"
    path.write_text("# as on the bench\ntc qdisc add dev eth0 root netem \\\n    delay 20ms loss 1%\n")
    found = read_link(path)
    assert isinstance(found, Setting)
    assert (found.channel.delay, found.channel.p) == (0.02, 0.01)
    path.write_text("delay 20ms\nloss 1%\n")
    again = read_link(path)
    assert isinstance(again, Setting)
    assert again.channel == found.channel
    path.write_text("tc qdisc add dev eth0 root netem loss 1%\ntc qdisc add dev eth1 root netem loss 2%\n")
    with pytest.raises(MeasurementError, match="has 2 lines for netem, which are one link each"):
        read_link(path)


def shown(options: dict[str, object], kind: str = "netem", dev: str = "eth0") -> dict[str, object]:
    return {"kind": kind, "handle": "1:", "dev": dev, "root": True, "refcnt": 2, "options": options}


def test_what_tc_shows_as_json_is_what_it_shows_as_text(tmp_path: Path) -> None:
    path, limit = tmp_path / "tc.json", {"limit": 1000, "ecn": False, "gap": 0}
    delay = {"delay": {"delay": 0.02, "jitter": 0.005, "correlation": 0}}
    pairs: list[tuple[dict[str, object], str]] = [
        ({**delay, "loss-random": {"loss": 0.05, "correlation": 0}}, "delay 20ms 5ms loss 5%"),
        ({"delay": {"delay": 1.5e-05, "jitter": 0, "correlation": 0.25}}, "delay 15us 0s 25%"),
        ({"loss-random": {"loss": 0.3, "correlation": 0.25}}, "loss 30% 25%"),
        ({"loss-gemodel": {"p": 0.01, "r": 0.1, "1-h": 0.7, "1-k": 0.001}}, "loss gemodel 1% 10% 70% 0.1%"),
        ({"loss-state": {"p13": 0.01, "p31": 0.1, "p32": 0, "p23": 1, "p14": 0.02}}, "loss state 1% 10% 0% 100% 2%"),
        ({"duplicate": {"duplicate": 0.01, "correlation": 0.5}}, "duplicate 1% 50%"),
        ({**delay, "reorder": {"reorder": 0.25, "correlation": 0.5}, "gap": 5}, "delay 20ms 5ms reorder 25% 50% gap 5"),
        ({"corrupt": {"corrupt": 1e-3, "correlation": 0}, "rate": {"rate": 125000, "cellsize": 0}},
         "corrupt 0.1% rate 1000000bit"),
    ]  # fmt: skip
    for options, line in pairs:
        path.write_text(json.dumps([shown({}, "noqueue", "lo"), shown({**limit, **options})], indent=4))
        found = read_link(path)
        assert isinstance(found, Setting)
        channel, differences = read(line)
        assert (found.channel, found.differences) == (channel, differences), line
    path.write_text(json.dumps([shown({**limit, **delay}), shown({"rate": 125000}, "tbf")]))
    found = read_link(path)
    assert isinstance(found, Setting)
    assert found.differences == ("the qdisc tbf of eth0 acts on the link as well, and is left out here",)
    for other in ("[1, 2]", '[{"kind": "netem", "options": {"delay": 7, "loss-random": {"loss": "x"}}}]', "[", "[]"):
        path.write_text(other)
        with pytest.raises(MeasurementError, match="unknown format, known are: "):
            read_link(path)


def test_what_tc_shows_of_several_devices(tmp_path: Path) -> None:
    path = tmp_path / "tc.txt"
    netem = "qdisc netem 1: dev eth0 root refcnt 2 limit 1000 delay 20ms  5ms loss random 5% seed 42"
    others = (
        "qdisc noqueue 0: dev lo root refcnt 2 \n Sent 0 bytes 0 pkt (dropped 0, overlimits 0 requeues 0) \n"
        "qdisc tbf 10: dev eth0 parent 1:1 rate 1Mbit burst 1600b lat 50ms \nqdisc htb 1: dev wlan0 root\n"
    )
    path.write_text(others + netem + "\n backlog 0b 0p requeues 0\n")
    found = read_link(path)
    assert isinstance(found, Setting)
    assert (found.channel.delay, found.channel.jitter, found.channel.p) == (0.02, 0.005, 0.05)
    assert found.differences == ("the qdisc tbf of eth0 acts on the link as well, and is left out here",)
    path.write_text(f"{netem}\n{netem.replace('eth0', 'wlan0')}\n")
    with pytest.raises(MeasurementError, match=r"one link each \(eth0, wlan0\): leave one of them"):
        read_link(path)
