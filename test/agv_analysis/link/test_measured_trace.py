"""From a measurement to a trace, and from a trace to the loop: what was measured is what is driven."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from agv_analysis.commands.link import command
from agv_analysis.link.formats import read_link
from agv_analysis.link.link_figures import LinkFigures
from agv_analysis.link.measured_trace import HALF, ROUND_TRIPS, link_of_loop, of_trace, write_trace
from agv_analysis.link.measurement import LOST, NOT_SENT, RECEIVED, UNKNOWN, Measurement, PacketOutcomes
from agv_analysis.recordings.recording import read_run
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.stability import through_link
from agv_analysis.stability.through_link import fitted_scenario, through_trace, without_delays
from agv_plant.channels.timed_trace import read_trace

REPOSITORY = Path(__file__).parents[3]
AgvNcs = Callable[..., tuple[int, str]]


def measured(path: Path) -> Measurement:
    found = read_link(path)
    assert isinstance(found, Measurement)
    return found


def of_round_trips(lost: list[int], rtt: float) -> Measurement:
    outcome = np.array(lost, dtype=np.int8)
    delay = np.where(outcome == LOST, np.nan, rtt)
    return Measurement(
        "x", "ping", np.linspace(0.0, 0.02 * (len(lost) - 1), len(lost)), round_trip=PacketOutcomes(outcome, delay)
    )


def test_a_run_through_the_trace_of_a_recorded_run_repeats_its_outages_slot_by_slot(tmp_path: Path) -> None:
    recorded, path = read_run(REPOSITORY / "bags/sample"), tmp_path / "trace.csv"
    write_trace(path, link_of_loop(measured(REPOSITORY / "bags/sample")))
    settings = [
        f"relay.{link}.{name}" for link in ("uplink", "downlink") for name in ("model=trace", f"trace_file={path}")
    ]
    run = simulate(load_scenario(REPOSITORY / "config/outages.yaml", [*settings, "plant.duration=10.0"]))
    assert run.lost.tolist() == recorded.lost.tolist()
    assert np.abs(run.pose - recorded.pose).max() < 1e-9


def test_what_was_written_is_read(tmp_path: Path) -> None:
    found = of_round_trips([0, 1, 1, 0, 0, 1, 0], 0.0123456)
    path = tmp_path / "trace.csv"
    for rtt in ROUND_TRIPS:
        link = link_of_loop(found, rtt)
        write_trace(path, link)
        again = link_of_loop(measured(path))
        assert again.uplink_lost.tolist() == link.uplink_lost.tolist()
        assert again.time == pytest.approx(link.time)
        for one, other in ((again.uplink_delay, link.uplink_delay), (again.downlink_delay, link.downlink_delay)):
            if other is not None:
                assert one is not None
                received = ~link.uplink_lost & ~np.isnan(other)
                assert one[received] == pytest.approx(other[received])


@pytest.mark.parametrize(
    ("rtt", "lost_up", "shares"), [("half", True, (0.5, 0.5)), ("up", True, (1.0, 0.0)), ("down", False, (0.0, 1.0))]
)
def test_where_a_round_trip_was_lost_is_an_assumption_that_is_said(
    rtt: str, lost_up: bool, shares: tuple[float, float]
) -> None:
    link = link_of_loop(of_round_trips([0, 1, 0], 0.01), rtt)
    assert link.uplink_lost.tolist() == [False, lost_up, False]
    assert (link.downlink_lost is not None and bool(link.downlink_lost[1])) is not lost_up
    delays = [0.0 if delay is None else float(np.nanmean(delay)) for delay in (link.uplink_delay, link.downlink_delay)]
    assert delays == pytest.approx([0.01 * share for share in shares])
    assert f"--rtt {rtt}" in link.notes[-1]


@pytest.mark.parametrize("rtt", ["up", "half", "down"])
def test_a_loss_on_a_way_that_is_known_stays_there(rtt: str) -> None:
    """irtt's words false, true_up, true, true_down, true: picture, trace and driven loop take them alike."""
    up, down = [RECEIVED, LOST, UNKNOWN, RECEIVED, UNKNOWN], [RECEIVED, NOT_SENT, UNKNOWN, LOST, UNKNOWN]
    ways = [PacketOutcomes(np.array(one, dtype=np.int8)) for one in (up, down, [RECEIVED, *[LOST] * 4])]
    found = Measurement("x", "irtt", 0.02 * np.arange(5.0), ways[0], ways[1], ways[2])
    figures = LinkFigures(found).to_json()
    for way in ("uplink", "downlink"):
        assert (figures[way]["lost"], figures[way]["unknown"]) == (1, 2)
        assert figures[way]["loss_rate"] is figures[way]["outages"] is figures[way]["outage_max_s"] is None
    link, blind = link_of_loop(found, rtt), rtt != "down"
    assert link.uplink_lost.tolist() == [False, True, blind, False, blind]
    assert link.downlink_lost is not None
    assert link.downlink_lost.tolist() == [False, False, not blind, True, True]  # not sent: as before
    assert link.notes == (
        f"2 losses on a way that is not known are taken for the {'uplink' if blind else 'downlink'}'s, beside 1 that "
        f"are known to be the uplink's and 1 the downlink's, its delay is not known (--rtt {rtt})",
    )
    fitted = fitted_scenario(load_scenario(str(REPOSITORY / "config/outages.yaml")), link, 0.02).relay
    assert fitted.uplink.model != "perfect"
    assert fitted.downlink.model != "perfect"
    one_way = link_of_loop(of_round_trips([0, 1, 0, 0, 1, 0], 0.01), rtt)
    fitted = fitted_scenario(load_scenario(str(REPOSITORY / "config/outages.yaml")), one_way, 0.02).relay
    assert (fitted.uplink.model == "perfect", fitted.downlink.model == "perfect") == (not blind, blind)


def test_no_more_of_a_long_link_is_kept_than_is_judged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(through_link, "_MOST_SLOTS", 400)
    monkeypatch.setattr(through_link, "_MOST_STEPS", 100)
    scenario = load_scenario(str(REPOSITORY / "config/paper.yaml"))
    losses = np.zeros(1000, dtype=np.int8)
    losses[50::100] = 1
    link = link_of_loop(of_round_trips(losses.tolist(), 0.0))
    found = through_trace(scenario, link, tmp_path / "link.csv")
    assert found.judged == found.to_json()["judged_s"] == 400 * scenario.plant.ts
    assert len(read_trace(str(tmp_path / "link.csv"), "uplink").lost) == 101  # 2 s of one packet every 20 ms
    assert found.longest_slots == 4


def test_what_was_never_sent_is_no_loss_of_the_downlink() -> None:
    up, down = np.array([RECEIVED, LOST, RECEIVED, RECEIVED]), np.array([LOST, NOT_SENT, NOT_SENT, RECEIVED])
    found = Measurement(
        "x", "irtt", np.arange(4.0), PacketOutcomes(up.astype(np.int8)), PacketOutcomes(down.astype(np.int8)),
        PacketOutcomes(np.array([LOST, LOST, UNKNOWN, RECEIVED], dtype=np.int8)),
    )  # fmt: skip
    link = link_of_loop(found, HALF)
    assert link.uplink_lost.tolist() == [False, True, False, False]
    assert link.downlink_lost is not None
    assert link.downlink_lost.tolist() == [True, True, True, False]  # as it was before
    rate = LinkFigures(found).to_json()["downlink"]["loss_rate"]
    assert rate["value"] == 0.5


def test_a_trace_is_a_measurement_again(tmp_path: Path) -> None:
    path, rows = tmp_path / "trace.csv", tmp_path / "rows.csv"
    write_trace(path, link_of_loop(of_round_trips([0, 1, 1, 0], 0.01)))
    found = of_trace(str(path), "uplink", 0.005)
    assert found.uplink is not None
    assert (found.uplink.lost.tolist(), found.interval) == ([False, True, True, False], 0.02)
    rows.write_text("lost\n0\n1\n0\n")
    assert of_trace(str(rows), "uplink", 0.005).interval == 0.005


def test_negative_delays_count_as_none_and_are_counted() -> None:
    found = of_round_trips([0, 0, 0], -0.001)
    link = link_of_loop(found, "up")
    assert link.uplink_delay is not None
    assert link.uplink_delay.tolist() == [0.0, 0.0, 0.0]
    assert "3 delays are below 0" in link.notes[-1]


def log(path: Path) -> Path:
    """Three packets of 20 ms in twenty are lost."""
    lines = ["PING 10.0.0.2 (10.0.0.2) 56(84) bytes of data."]
    for i in range(400):
        if i % 20 not in (3, 4, 5):
            lines.append(f"[{1000 + 0.02 * i:.6f}] 64 bytes from 10.0.0.2: icmp_seq={i + 1} ttl=64 time=0.000 ms")
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_loop_through_a_measured_link_is_judged_by_outages_as_long_as_they_were(tmp_path: Path) -> None:
    """60 ms are 12 slots, fewer than the 14 of which any sequence contracts; rows would be 3."""
    scenario = load_scenario(REPOSITORY / "config/outages.yaml", ["error_detector.track=line"])
    link = without_delays(link_of_loop(measured(log(tmp_path / "ping.txt"))))
    found = through_trace(scenario, link, tmp_path / "link.csv")
    assert found.longest_slots == 12
    assert found.verdict.word == "asymptotic"
    assert found.confidence == pytest.approx(20.5 / 21.0)  # twenty periods
    # One outage leaves a v T_s n (n + 1) / 2 along a line, and a share of the one before.
    one = 0.125 * 0.005 * 12 * 13 / 2
    assert one <= found.deviations.max() < 1.5 * one
    inside, outside = (dataclasses.replace(found, corridor=share * one) for share in (1.5, 0.9))
    assert (inside.left, outside.left) == (0, len(found.deviations))


# -- the command -------------------------------------------------------------------------------------------------------


def test_what_is_said_of_a_ping_log(tmp_path: Path, agv_ncs: AgvNcs) -> None:
    path, picture, found = log(tmp_path / "ping.txt"), tmp_path / "link.png", tmp_path / "link.json"
    trace = tmp_path / "trace.csv"
    status, said = agv_ncs("link", path, "--rtt", "up", "--json", found, "--picture", picture, "--trace", trace)
    assert status == 0, said
    content = json.loads(found.read_text())
    assert content["packets"] == 400
    assert content["span_s"] == pytest.approx(399 * 0.02)
    assert content["interval_s"] == pytest.approx(0.02)
    assert content["outage_max_s"] == pytest.approx(0.06)
    assert content["uplink"]["loss_rate"] is None
    assert content["round_trip"]["loss_rate"]["value"] == pytest.approx(0.15)
    assert (content["delay"]["p50_s"], content["delay"]["of"]) == (0.0, "round_trip")
    assert content["fit"]["goodness"]["fits"] is False  # as regular as no Gilbert channel is
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "only the round trip is known" in said
    assert len(trace.read_text().splitlines()) == 401


def test_what_a_file_cannot_say_is_said_in_a_line(tmp_path: Path, agv_ncs: AgvNcs) -> None:
    path = tmp_path / "iperf.json"
    one = {"start": 0.0, "end": 1.0, "packets": 1000, "lost_packets": 5}
    path.write_text(json.dumps({"start": {"version": "iperf 3.16"}, "intervals": [{"sum": one}]}))
    status, said = agv_ncs("link", path)
    assert status == 0
    assert "0.5 % lost" in said
    status, said = agv_ncs("link", path, "--trace", tmp_path / "t.csv")
    assert status == 1
    assert "a loss rate, but no trace to drive a loop with" in said.splitlines()[-1]
    status, said = agv_ncs("link", tmp_path / "none")
    assert (status, said.strip()) == (1, f"Error: {tmp_path / 'none'}: no such file")


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["loss 5%", "--trace", "{}"], "is a setting, of which there is no measurement"),
        (["loss 5%", "--picture", "{}"], "is a setting, of which there is no measurement"),
        (["loss 5%", "--corridor", "0.5"], "give PARAMS behind FILE"),
        (["loss 5%", "--set", "controller.kx=5.0"], "give PARAMS behind FILE"),
    ],
)
def test_what_is_asked_for_in_vain_is_refused(tmp_path: Path, options: list[str], complaint: str) -> None:
    target = tmp_path / "output"
    done = CliRunner().invoke(command, [option.format(target) for option in options])
    assert done.exit_code != 0
    assert complaint in " ".join(done.output.split())
    assert not target.exists()
