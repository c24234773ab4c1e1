"""What a loop asks of its radio: closed forms on a straight track, other criteria, and the inverse."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import agv_ncs
from agv_analysis.cli import main
from agv_analysis.link.age_chain import behind_constant_delay
from agv_analysis.link.markov_channel import bernoulli, bursty, gilbert_elliott
from agv_analysis.requirements.availability import availability_of
from agv_analysis.requirements.class_check import CANNOT_TELL, NO, YES, meets, would_do
from agv_analysis.requirements.link_availability import of_channel
from agv_analysis.requirements.loop_requirements import require
from agv_analysis.requirements.loss_behind_delay import critical_loss_behind
from agv_analysis.requirements.offered_service import OfferedService, on_service, slots_of
from agv_analysis.requirements.service_channel import channel_of_service
from agv_analysis.requirements.service_classes import ServiceClass, find_class, load_classes
from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.stability import delayed_mean_square, floquet
from agv_analysis.stability.scenario_loop import loop_on_lap
from agv_ros.errors import UserError

REPOSITORY = Path(__file__).parents[3]
AgvNcs = Callable[..., tuple[int, str]]


def of(kx: float, *settings: str) -> Scenario:
    return load_scenario(
        REPOSITORY / "config/paper.yaml", (f"controller.kx={kx}", "error_detector.track=line", *settings)
    )


@pytest.mark.parametrize(("kx", "time"), [(25.0, 0.07), (250.0, 0.0)])
def test_survival_time_latency_losses_bursts_and_age_in_closed_form(kx: float, time: float) -> None:
    found, a = require(of(kx)), 0.005 * kx
    assert found.survival_time == pytest.approx(time)
    assert found.loss_rate == pytest.approx((2.0 - a) / (2.0 + a), rel=1e-6)
    assert found.mean_age == pytest.approx(1.0 / kx - 0.0025, rel=1e-5)  # mean age + T_s / 2 < 1 / K_x
    assert found.latency is not None
    n = found.latency / 0.005
    assert 2.0 * np.sin(np.pi / (2.0 * (2.0 * n + 1.0))) == pytest.approx(a)
    for rate, burst in found.bursts:
        bound = (1.0 / a - 0.5) / rate  # loss rate times mean burst
        if burst is None:
            assert bound < max(1.0, rate / (1.0 - rate)) * 1.0001
        elif rate >= 0.05:  # of rarer and longer ones the error across the track takes fewer
            assert burst == pytest.approx(bound, rel=1e-4)
        else:
            assert burst <= bound * 1.0001


def test_the_slowest_gain_survives_longest() -> None:
    assert agv_ncs.require(of(5.0)).survival_time == pytest.approx(0.39)


def test_a_loop_that_runs_at_its_survival_time_contracts_and_one_slot_more_does_not() -> None:
    scenario = of(25.0)
    loop, n = loop_on_lap(scenario), require(scenario).survival_slots
    assert n == 14
    for slots, contracts in ((n, True), (n + 1, False)):
        lost = np.arange((slots + 1) * 500) % (slots + 1) != 0
        growth = floquet.drop_sequence(loop.at(np.zeros(len(lost), dtype=np.int64)), lost, 1)[0]
        assert bool(growth < 0.0) is contracts


def test_require_and_its_inverse_agree() -> None:
    scenario = of(25.0)
    time, period = require(scenario).survival_time, 0.005
    assert time is not None
    held = on_service(scenario, OfferedService(time))
    assert held.holds
    assert not on_service(scenario, OfferedService(time + period)).holds
    assert held.kx_max == pytest.approx(2.0 / (15 * period))
    assert held.kx_max is not None
    assert held.kx_best is not None
    assert 0.0 < held.kx_best < held.kx_max
    # (n + 1) T_s K_x < 2 is all along the track: at S = 70 ms that is T_s = 5.33 ms with 13 slots, and 1 slot at 40 ms.
    assert held.interval_max is not None
    assert (slots_of(time, held.interval_max) + 1) * held.interval_max * 25.0 == pytest.approx(2.0, rel=1e-3)
    speed = held.speed_max
    assert speed is not None
    faster, slower = (of(25.0, f"error_detector.speed={speed * factor}") for factor in (1.01, 0.99))
    assert require(slower).survival_slots == 14
    assert (require(faster).survival_slots or 0) < 14


def test_the_channel_of_a_service_has_its_figures() -> None:
    """Availability and mean time between failures of a channel, and the channel of these, for loops that survive n."""
    for p, r, n in ((1e-3, 0.1, 0), (0.02, 0.2, 14), (1e-4, 1.0 / 120.0, 3), (0.3, 0.9, 2), (0.5, 1.0, 0)):
        given = availability_of(gilbert_elliott(p, r), n, 0.005)
        found = channel_of_service(given.availability, given.mtbf, n, 0.005)
        assert found.chain is not None, found.why
        assert found.chain.transition == pytest.approx(np.array([[1.0 - p, p], [r, 1.0 - r]]), rel=1e-6)
        assert found.failure == pytest.approx(0.005 / r)
    for p, n in ((1e-2, 2), (0.5, 14), (0.9, 0)):
        given = availability_of(bernoulli(p), n, 0.005)
        for availability, mtbf in ((given.availability, None), (None, given.mtbf)):
            chain = channel_of_service(availability, mtbf, n, 0.005).chain
            assert chain is not None
            assert chain.loss_rate == pytest.approx(p, rel=1e-6)
    # A failure of 0.86 ms is shorter than a slot; and outages of 14 slots before each leave no half of the time for it.
    assert "would last 0.864 ms" in channel_of_service(0.99999999, 86400.0, 3, 0.005).why
    assert channel_of_service(0.5, 0.1, 14, 0.005).chain is None
    assert channel_of_service(None, None, 14, 0.005).chain is None


def test_the_inverse_knows_the_border_of_bursts_that_require_prints() -> None:
    """A service that fails as the critical Gilbert channel: a hair milder the loop holds, a hair worse it does not."""
    scenario = of(25.0, "error_detector.speed=1.0")
    border = dict(require(scenario).bursts)[0.1]
    assert border is not None
    for factor, holds in ((0.98, True), (1.02, False)):
        link = availability_of(bursty(0.1, border * factor), 2, 0.005)
        found = on_service(scenario, OfferedService(0.01, availability=link.availability, mtbf=link.mtbf))
        assert (found.holds, found.mean_square) == (holds, holds), found.why
        assert found.channel.failure == pytest.approx(border * factor * 0.005)
        assert found.slots == 2
    assert "make the mean square of the error grow" in found.why
    assert found.deviation < found.deviation_in_failure if found.deviation_in_failure is not None else False


def test_the_best_sampling_period_is_one_that_holds_and_none_is_better() -> None:
    """Along a line the worst of the outages within 50 ms leaves |1 - a L|, L <= n + 1, of an error: in closed form."""
    scenario = of(25.0)
    found = on_service(scenario, OfferedService(0.05))
    assert found.interval_best is not None
    assert found.interval_max is not None

    def growth(ts: float) -> float:
        L = np.arange(1, slots_of(0.05, ts) + 2)
        return float((np.log(np.maximum(np.abs(1.0 - 25.0 * ts * L), 1e-12)) / L).max() / ts)

    periods = np.geomspace(0.005 / 8.0, found.interval_max, 40)
    across = -1.0  # poles at 1/s across the line: no period is faster than these
    assert max(growth(found.interval_best), across) <= min(max(growth(ts), across) for ts in periods) + 0.05


def test_a_latency_that_is_offered_too() -> None:
    scenario = of(25.0)
    assert on_service(scenario, OfferedService(0.03, latency=0.06)).holds  # 12 slots
    refused = on_service(scenario, OfferedService(0.03, latency=0.0601))
    assert not refused.holds
    assert "always 13 slots late" in refused.why


@pytest.mark.parametrize(("kx", "delay"), [(25.0, 0), (25.0, 7), (25.0, 12), (5.0, 30)])
def test_losses_behind_a_delay_are_those_of_the_second_moments(kx: float, delay: int) -> None:
    """The norm of a transfer function, and the argument principle, against the moments driven step by step."""
    loop = loop_on_lap(of(kx)).frozen(0)
    p = critical_loss_behind(loop, delay)
    for factor, sign in ((0.98, -1.0), (1.02, 1.0)):
        growth = delayed_mean_square.lap_growth(loop, behind_constant_delay(bernoulli(min(1.0, p * factor)), delay))
        assert growth * sign > 0.0
    if delay == 0:
        assert p == pytest.approx((2.0 - 0.125) / (2.0 + 0.125), rel=1e-3)


def test_no_delay_leaves_room_for_losses_that_is_too_long_itself() -> None:
    assert critical_loss_behind(loop_on_lap(of(25.0)).frozen(0), 13) == 0.0


def test_lines_for_netem_are_within_the_border() -> None:
    found = require(of(25.0))
    lines = found.netem()
    assert lines[0] == "delay 60.2ms"
    assert re.fullmatch(r"loss random 88(\.\d)?%", lines[1])
    p, r = (float(word.rstrip("%")) / 100.0 for word in lines[2].split()[2:4])
    at = dict(found.bursts)[0.01]
    assert at is not None
    assert p / (p + r) <= 0.01
    assert bursty(0.01, at).transition[1, 0] <= r * 1.0001


def test_a_loop_that_does_not_settle_asks_for_nothing() -> None:
    found = require(of(25.0, "controller.v_max=0.5"))
    assert found.infeasible
    assert (found.survival_time, found.latency, found.netem()) == (None, None, ())
    assert would_do(load_classes()[0], found)[0] == NO


def test_behind_an_exact_predictor_nothing_is_too_long() -> None:
    found = require(of(25.0, "error_detector.policy=predict"))
    assert found.survival_slots is None
    assert found.loss_rate is None
    assert "no bound" in found.reasons["survival_time_s"]


def test_a_corridor_shortens_the_survival_time() -> None:
    """One outage of n slots leads a v T_s n (n + 1) / 2 along a line: the largest n within 0.1 m, and the inverse."""
    scenario = of(25.0, "error_detector.corridor=0.1", "plant.initial_pose=[0.0, 0.0, 1.5707963267948966]")
    found = require(scenario)
    deviations = [0.125 * 0.005 * n * (n + 1) / 2.0 for n in range(30)]
    n = max(n for n, deviation in enumerate(deviations) if deviation <= 0.1)
    assert found.corridor is not None
    assert found.corridor.single == n
    assert found.corridor.any_sequence is not None
    assert found.survival_slots == min(14, found.corridor.any_sequence)
    assert on_service(scenario, OfferedService(0.05)).deviation == pytest.approx(deviations[10], rel=1e-3)


# -- classes -----------------------------------------------------------------------------------------------------------


def test_every_row_has_a_source() -> None:
    for one in load_classes():
        assert one.document
        assert one.read or "not read in the document" in one.source
        assert one.version in one.source or "version not recorded" in one.source


def test_a_row_without_a_source_is_refused(tmp_path: Path) -> None:
    path, row = tmp_path / "own.yaml", "name: ours, kind: service, document: D, table: T, version: '1', read: true"
    path.write_text(f"- {{{row}, mtbf_s: 3600.0}}\n")
    assert find_class("ours", load_classes(path)).mtbf_s == 3600.0
    for left_out in ("document", "table", "version", "read"):
        path.write_text(f"- {{{re.sub(f'{left_out}: [^,]*,? ?', '', row)}}}\n")
        with pytest.raises(UserError, match=rf"own\.yaml: class 1: has no {left_out}"):
            load_classes(path)
    path.write_text(f"- {{{row}, jitter_s: 1.0}}\n")
    with pytest.raises(UserError, match="no figure is called 'jitter_s'"):
        load_classes(path)
    with pytest.raises(UserError, match="no class is called 'gold'"):
        find_class("gold", load_classes())


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "must be a list of classes, got nothing"),
        ("name: x", "must be a list of classes, got {'name': 'x'}"),
        ("{", "is not YAML: while parsing a flow node"),
        ("- {version: 2026-13-01}", "is not YAML: month must be in 1..12"),
        ("- 7", "class 1: must have names and values, got 7"),
    ],
)
def test_a_file_that_has_no_classes_is_refused_in_a_line(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(text)
    with pytest.raises(UserError) as refused:
        load_classes(path)
    assert str(refused.value).startswith(f"{path}: {complaint}")
    assert len(str(refused.value).splitlines()) == 1


def a_class(**figures: float) -> ServiceClass:
    return ServiceClass("x", "service", "D", "T", "1", True, **figures)  # type: ignore[arg-type]


def test_what_a_link_meets() -> None:
    link = of_channel(bernoulli(1e-2), 2, 0.005, latency=0.004)  # U = 1e-6, 5050.5 s
    for wanted, answer in (
        (a_class(availability=0.999999), YES), (a_class(availability=0.9999999), NO), (a_class(mtbf_s=5050.0), YES),
        (a_class(mtbf_s=5051.0), NO), (a_class(loss_rate=1e-2), YES), (a_class(loss_rate=9e-3), NO),
        (a_class(latency_s=0.004), YES), (a_class(latency_s=0.003), NO), (a_class(), CANNOT_TELL),
    ):  # fmt: skip
        assert meets(wanted, link)[0] == answer, wanted
    assert meets(a_class(mtbf_s=1.0), None)[0] == CANNOT_TELL


def test_what_would_do() -> None:
    loop = require(of(25.0))  # 70 ms, 60.3 ms, 0.882
    for offered, answer in (
        (a_class(survival_time_s=0.07), YES), (a_class(survival_time_s=0.071), NO), (a_class(loss_rate=0.88), YES),
        (a_class(loss_rate=0.89), NO), (a_class(latency_s=0.06), CANNOT_TELL), (a_class(latency_s=0.061), NO),
    ):  # fmt: skip
        assert would_do(offered, loop)[0] == answer, offered


# -- the command -------------------------------------------------------------------------------------------------------


def test_what_the_command_says(tmp_path: Path, agv_ncs: AgvNcs) -> None:
    table, found, page = tmp_path / "table.md", tmp_path / "found.json", tmp_path / "page.html"
    status, said = agv_ncs(
        "require", "config/outages.yaml", "--set", "error_detector.track=line", "--set", "relay.uplink.model=bernoulli",
        "--set", "relay.uplink.p=0.5", "--mtbf", "10000", "--survival-time", "0.02", "--table", table, "--json", found,
        "--report", page,
    )  # fmt: skip
    assert status == 0, said
    content = json.loads(found.read_text())
    assert (content["survival_slots"], content["transfer_interval_s"]) == (14, 0.005)
    assert content["survival_time_s"] == pytest.approx(0.07)
    assert content["unavailability"] == pytest.approx(0.5**15)
    assert content["mtbf_s"] == pytest.approx(0.005 * (1 - 0.5**15) / 0.5**16)
    assert content["meets"]["as asked"] == "no"
    assert content["would_do"]["mobile operation panel, emergency stop"] == "yes"
    assert content["offered"]["holds"] is True
    assert "70 ms (14 slots)" in said
    assert "| Survival time, by stability | 70 ms (14 slots) |" in table.read_text()
    offered = content["offered"]
    assert (offered["mtbf_s"], offered["latency_s"], offered["survival_slots"]) == (10000.0, 0.0, 4)
    p = offered["channel"]["loss_rate"]
    assert 0.005 * (1 - p**5) / ((1 - p) * p**5) == pytest.approx(10000.0)
    assert offered["mean_square"] is True
    html = page.read_text()
    assert "Every 5 ms a message; outages of 70 ms at most, or a latency of 60.29 ms" in html
    assert 'id="plot-bursts"' in html


def test_a_class_is_what_is_offered(tmp_path: Path) -> None:
    """Its latency and losses, and where it has no survival time that of the loop."""
    found, params = tmp_path / "found.json", str(REPOSITORY / "config/paper.yaml")
    settings = ("--set", "error_detector.track=line", "--set", "error_detector.speed=1.0")
    answer = CliRunner().invoke(main, ["require", params, *settings, "--class", "5QI 82", "--json", str(found)])
    assert answer.exit_code == 0, answer.output
    offered = json.loads(found.read_text())["offered"]
    assert (offered["survival_slots"], offered["latency_s"], offered["holds"]) == (14, 0.01, True)
    assert offered["channel"]["loss_rate"] == pytest.approx(1e-4)
    answer = CliRunner().invoke(main, ["require", params, "--transfer-interval", "0.01"])
    assert (answer.exit_code, "is offered with a --survival-time, --availability" in answer.output) == (1, True)


def test_a_table_is_read_as_the_options_say(tmp_path: Path, agv_ncs: AgvNcs) -> None:
    """Of 4000 packets, 20 ms apart, every 40th is lost: an outage of 20 ms, which the loop survives."""
    table, found = tmp_path / "table.txt", tmp_path / "found.json"
    table.write_text("n when gone\n" + "".join(f"{i} {0.02 * i:.2f} {int(i % 40 == 7)}\n" for i in range(4000)))
    columns = [f"--column={role}" for role in ("seq=n", "time=when", "lost=gone")]
    options = (*columns, "--delimiter", "space", "--format", "table")
    status, said = agv_ncs("require", "config/outages.yaml", "--link", table, *options, "--json", found)
    assert status == 0, said
    assert re.search(r"Loss rate +0\.025 ", said)
    assert json.loads(found.read_text())["unavailability"] == 0.0


@pytest.mark.parametrize("option", ["--interval=0.02", "--delimiter=;", "--column=lost=gone", "--format=table"])
def test_an_option_about_the_file_needs_the_file(option: str) -> None:
    answer = CliRunner().invoke(main, ["require", str(REPOSITORY / "config/outages.yaml"), option])
    assert (answer.exit_code, answer.output.count("\n")) == (1, 1)
    assert f"{option.split('=')[0]} is about the file of a measured link: name the file with --link" in answer.output


def test_a_line_for_netem_is_no_file(agv_ncs: AgvNcs) -> None:
    for command in (("link", "loss 5%"), ("require", "config/outages.yaml", "--link", "loss 5%")):
        status, said = agv_ncs(*command, "--topic", "/edge/pose", "--interval", "0.02")
        assert (status, len(said.splitlines())) == (1, 1)
        assert " are about the file of a measured link, but 'loss 5%' is not a file" in said
