"""A measured channel with times: played by time, so that outages last as long as they did."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.metrics.outages import outage_lengths
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.simulation.channel_outcomes import ChannelRealisation
from agv_analysis.stability.empirical import simulated_twins
from agv_plant.channels.trace import TraceError
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import Channel, losses

REPOSITORY = Path(__file__).parents[3]
INTERVAL = 0.02
OUTAGES = ((10, 16), (60, 1), (75, 4), (120, 40))
"""First packet lost and how many, of a measurement of 200 packets."""


def measured(path: Path, header: str = "time,lost", delay: str = "") -> Path:
    lost = np.zeros(200, dtype=int)
    for first, count in OUTAGES:
        lost[first : first + count] = 1
    rows = [f"{100.0 + i * INTERVAL:.3f},{flag}{delay}" for i, flag in enumerate(lost)]
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def channel(path: Path, **more: object) -> ChannelParameters:
    return ChannelParameters(model="trace", trace_file=str(path), **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("ts", [0.001, 0.005, 0.007, 0.05])
def test_outages_last_as_long_as_they_were_measured(tmp_path: Path, ts: float) -> None:
    c, steps = channel(measured(tmp_path / "t.csv")), round(200 * INTERVAL / ts)
    lost = ChannelRealisation(1, steps, ts).outcomes(c, "uplink")
    found = outage_lengths(np.arange(steps), lost) * ts
    true = np.array([count * INTERVAL for _, count in OUTAGES])
    if ts > INTERVAL:  # the outage of one packet falls between two slots
        found, true = found[found > ts], true[true > ts]
    assert len(found) == len(true)
    assert np.abs(found - true).max() <= ts + 1e-9
    assert abs(lost.sum() * ts - true.sum()) <= len(OUTAGES) * ts + INTERVAL


def test_at_its_own_period_each_packet_is_a_slot_round_after_round(tmp_path: Path) -> None:
    """Times are multiples of 0.02 s and so is the period, none of which a float can say."""
    lost = losses(channel(measured(tmp_path / "t.csv")), 1, "uplink", 600, INTERVAL)
    one = np.zeros(200, dtype=bool)
    for first, count in OUTAGES:
        one[first : first + count] = True
    assert lost.tolist() == np.tile(one, 3).tolist()


def test_what_follows_the_end(tmp_path: Path) -> None:
    path = measured(tmp_path / "t.csv")
    assert not losses(channel(path, trace_end="hold"), 1, "uplink", 600, INTERVAL)[200:].any()
    assert len(losses(channel(path, trace_end="stop"), 1, "uplink", 200, INTERVAL)) == 200
    with pytest.raises(TraceError, match=r"t\.csv: the trace ends after 200 slots, and slot 200 is asked for"):
        losses(channel(path, trace_end="stop"), 1, "uplink", 201, INTERVAL)


def test_the_relay_and_the_simulation_play_the_same(tmp_path: Path) -> None:
    path, ts = measured(tmp_path / "t.csv", "time,lost,delay", ",0.012"), 0.005
    for c in (channel(path, trace_window=1.3, jitter=0.004), channel(path, lifetime=0.011)):
        relay, realisation = Channel(c, 3, "uplink", ts), ChannelRealisation(3, 2000, ts)
        assert [relay.lost(k) for k in range(2000)] == realisation.outcomes(c, "uplink").tolist()
        late = [0 if relay.lost(k) else int(np.ceil(relay.delays(k)[0] - 1e-9)) for k in range(2000)]
        assert (
            late
            == np.where(
                realisation.outcomes(c, "uplink"), 0, np.asarray(realisation.link_inputs(c, "uplink").waits)
            ).tolist()
        )


def test_seeds_are_windows_of_a_long_trace(tmp_path: Path) -> None:
    c = channel(measured(tmp_path / "t.csv"), trace_window=1.0)
    runs = [losses(c, seed, "uplink", 50, INTERVAL)[1:] for seed in (1, 2, 3, 4, 5)]
    whole = losses(channel(Path(c.trace_file)), 1, "uplink", 200, INTERVAL)
    for i in range(4):
        assert runs[i].tolist() == whole[50 * i + 1 : 50 * (i + 1)].tolist()
    assert runs[4].tolist() == runs[0].tolist()  # the trace lasts four windows
    rows = tmp_path / "rows.csv"
    rows.write_text("lost\n" + "0\n1\n1\n0\n")
    c = channel(rows, trace_window=2 * INTERVAL)
    assert losses(c, 2, "uplink", 5, INTERVAL).tolist() == [False, False, False, True, True]


def test_twins_meet_different_parts_of_a_long_trace(tmp_path: Path) -> None:
    path = measured(tmp_path / "t.csv")
    settings = ("relay.uplink.model=trace", f"relay.uplink.trace_file={path}", "error_detector.track=line")
    runs = {
        seconds: simulated_twins(
            load_scenario(REPOSITORY / "config/paper.yaml", (*settings, f"plant.duration={seconds}")), range(1, 5)
        )
        for seconds in (1.0, 3.0)
    }
    assert runs[1.0].different == 4
    assert runs[3.0].different == 1  # the trace lasts 4 s


def test_each_direction_has_its_own_columns(tmp_path: Path) -> None:
    path = tmp_path / "both.csv"
    path.write_text(
        "time,uplink_lost,downlink_lost,downlink_delay\n0.0,0,0,0.01\n0.1,1,0,\n0.2,0,1,nan\n0.3,0,0,0.02\n"
    )
    c = channel(path)
    assert losses(c, 1, "uplink", 4, 0.1).tolist() == [False, True, False, False]
    assert losses(c, 1, "downlink", 4, 0.1).tolist() == [False, False, True, False]
    # What came at an unknown time came as late as the one before.
    down = Channel(c, 1, "downlink", 0.01)
    assert [down.delays(k)[0] for k in (1, 15, 35)] == pytest.approx([1.0, 1.0, 2.0])
    as_json = tmp_path / "both.json"
    as_json.write_text(json.dumps({"time": [0, 0.1, 0.2, 0.3], "uplink_lost": [0, 1, False, 0]}))
    assert losses(channel(as_json), 1, "uplink", 4, 0.1).tolist() == [False, True, False, False]
    with pytest.raises(TraceError, match=r"no column says what the downlink lost .*; it has uplink_lost"):
        losses(channel(as_json), 1, "downlink", 4, 0.1)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("time,lost\n0,0\n0,1\n", "row 2: time must increase from row to row, found 0 s"),
        ("time,lost\n0,0\n1,2\n", "row 2: lost must be 0 or 1, found 2"),
        ("time,lost\n0,0\n1,maybe\n", "t.csv:3: lost must be 0 or 1, found 'maybe'"),
        ("time,lost\n0,0\nnow,1\n", "t.csv:3: time must be a number of seconds, found 'now'"),
        ("time,lost,delay\n0,0,0.1\n1,0,-0.1\n", "row 2: delay must be >= 0 s and finite, found -0.1"),
        ("time,lost\n", "no rows below the header"),
        ("time,lost\n0.0,0\n\n0.1,1\n", ":3: the row is empty"),
        ("uplink_lost,downlink_lost\n0,0\n", "has outcomes of each direction, but no column time"),
    ],
)
def test_what_cannot_be_played_is_refused(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "t.csv"
    path.write_text(text)
    with pytest.raises(TraceError) as caught:
        losses(channel(path), 1, "uplink", 3, 0.1)
    assert complaint in str(caught.value)
    assert str(caught.value).startswith(f"{path}:")  # not a complaint about the name


@pytest.mark.parametrize("kind", ["csv", "json"])
def test_a_trace_of_today_decides_slot_by_slot_where_its_period_is_the_loops(tmp_path: Path, kind: str) -> None:
    """Times since 1970 are floats that are off by 0.1 us."""
    lost = [k > 0 and (k * k) % 7 < 2 for k in range(500)]
    at = [123_456 + 20_000 * k for k in range(500)]  # us
    time = [f"{1_700_000_000 + us // 10**6}.{us % 10**6:06d}" for us in at]
    path = tmp_path / f"t.{kind}"
    if kind == "csv":
        path.write_text("time,lost\n" + "".join(f"{t},{int(gone)}\n" for t, gone in zip(time, lost, strict=True)))
    else:
        path.write_text(f'{{"time": [{", ".join(time)}], "lost": {json.dumps([int(gone) for gone in lost])}}}')
    assert losses(channel(path), 1, "uplink", 500, 0.02).tolist() == lost


def test_a_loop_is_late_by_the_delays_of_its_trace(tmp_path: Path) -> None:
    path = tmp_path / "late.csv"
    path.write_text("time,lost,delay\n0.0,0,0.012\n1.0,0,0.012\n")
    settings = ("relay.uplink.model=trace", f"relay.uplink.trace_file={path}", "plant.duration=0.5")
    run = simulate(load_scenario(REPOSITORY / "config/paper.yaml", settings))
    assert run.n_ul[3:].tolist() == [3] * (len(run) - 3)
