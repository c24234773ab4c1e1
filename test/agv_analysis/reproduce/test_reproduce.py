"""The executable paper: its numbers against closed forms, its verdicts against what is known of the paper."""

from __future__ import annotations

import csv
import html
import importlib.util
import json
import math
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import pytest

from agv_analysis.reproduce import constant_delay
from agv_analysis.reproduce.claim import FAILS, HOLDS, PART, REMARK, Finding, check
from agv_analysis.reproduce.claims import CLAIMS, ON_TRACK
from agv_analysis.reproduce.claims_page import PAGE, SHOWN_IN
from agv_analysis.reproduce.figures import figures, write
from agv_analysis.reproduce.future import settling_across
from agv_analysis.reproduce.report import text_of
from agv_analysis.reproduce.runs import GAINS, gain, recorded, scenario, simulated
from agv_analysis.scenario import Scenario, load_scenario
from agv_analysis.simulation import simulate
from agv_ros.errors import UserError

REPOSITORY = Path(__file__).parents[3]
TS = 0.005

EXPECTED = {
    "error_to_zero": HOLDS,
    "discretisation": HOLDS,
    "error_dynamics": FAILS,  # a misprint: d theta_e/dt = w_r - w, and w is w_r plus the bracket
    "stable_without_outages": HOLDS,
    "stable_for_any_gain": FAILS,  # 0 < T_s K_x < 2
    "equilibrium": HOLDS,
    "equilibrium_under_outages": FAILS,
    "criterion_sufficient": FAILS,
    "outages_decide": HOLDS,
    "eigenvalues_on_curves": REMARK,
    "eigenvalues_on_a_line": FAILS,
    "criterion_necessary": FAILS,
    "lap": HOLDS,
    "time_constant": REMARK,
    "start": REMARK,
    "faster_with_gain": HOLDS,
    "faster_with_any_gain": FAILS,
    "y_direction": FAILS,
    "oscillation": HOLDS,
    "required_speed_at_start": REMARK,
    "required_speed": FAILS,
    "faster_unlimited": HOLDS,
    "limited_impact": PART,
    "similar": HOLDS,
    "over_damped": HOLDS,
    "slowest": HOLDS,
    "under_damped": HOLDS,
    "more_oscillation": HOLDS,
    "oscillation_is_slower": FAILS,
    "critical": REMARK,
    "only_critical": FAILS,
    "optimum_of_three": HOLDS,
    "optimum": FAILS,
    "optimum_limited": FAILS,
    "impact": HOLDS,
}


@pytest.fixture(scope="module")
def findings() -> dict[str, Finding]:
    runs = simulated()
    return {claim.key: check(claim, runs) for claim in CLAIMS}


class Made(NamedTuple):
    """What the command has made, and the page of docs/ made of it."""

    folder: Path
    page: str
    content: dict[str, Any]

    def future(self, key: str) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = self.content["future_work"][key]
        return rows


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    spec = importlib.util.spec_from_file_location("update", REPOSITORY / "docs/update.py")
    assert spec is not None
    assert spec.loader is not None
    update = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(update)
    folder = tmp_path_factory.mktemp("paper")
    page = update.paper_page(str(folder))
    return Made(folder, page, json.loads((folder / "claims.json").read_text()))


def line(*settings: str) -> Scenario:
    return scenario("error_detector.track=line", ON_TRACK, *settings)


# -- runs --------------------------------------------------------------------------------------------------------------


def test_the_scenario_is_that_of_the_params_file() -> None:
    assert scenario() == load_scenario(str(REPOSITORY / "config/paper.yaml"))


def test_recordings_are_not_mixed_with_those_of_other_runs(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    with pytest.raises(UserError, match="remove it or choose another --out"):
        recorded(tmp_path)


def test_a_recorded_run_is_that_of_the_simulation(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    settings = (*gain(25.0, 6.0), "plant.duration=1.0")
    run = recorded(tmp_path / "bags").run(*settings)
    np.testing.assert_allclose(run.pose, simulated().run(*settings).pose, rtol=0.0, atol=1e-9)
    assert run.source == str(tmp_path / "bags" / "kx=25.0,v_max=6.0,duration=1.0")


# -- a pose that is always n steps old ---------------------------------------------------------------------------------


def test_a_pose_that_is_never_outdated_is_the_loop_without_outages() -> None:
    wanted = scenario("plant.duration=5.0")
    assert np.array_equal(constant_delay.poses(wanted, 0), simulate(wanted).pose)


@pytest.mark.parametrize("n", [1, 5, 12, 13, 20])
def test_on_a_line_it_is_a_scalar_recursion(n: int) -> None:
    wanted = scenario("error_detector.track=line", "plant.duration=2.0")
    e = [-5.0]
    for k in range(399):  # e(k) = y_r(k) - y_c(k); y_r - y_c(k-n) = e(k-n) + what the reference has moved since
        age = min(k, n)
        e.append(e[k] - TS * 25.0 * (e[k - age] + TS * age))
    y_r = TS * np.arange(400)
    np.testing.assert_allclose(constant_delay.poses(wanted, n)[:, 1], y_r - e, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kx", [5.0, 25.0, 100.0, 250.0])
def test_twins_part_where_the_characteristic_polynomial_says_so(kx: float) -> None:
    def radius(n: int) -> float:
        polynomial = np.zeros(n + 2)
        polynomial[0], polynomial[1], polynomial[-1] = 1.0, -1.0, polynomial[-1] + TS * kx
        if n == 0:
            polynomial[1] = TS * kx - 1.0
        return float(np.abs(np.roots(polynomial)).max())

    last = next(n for n in range(200) if radius(n + 1) >= 1.0)
    assert (
        constant_delay.contraction(line(*gain(kx)), last) < 1.0 < constant_delay.contraction(line(*gain(kx)), last + 1)
    )


def test_twins_of_which_one_leaves_the_range_of_numbers_have_parted() -> None:
    assert constant_delay.contraction(line(*gain(250.0)), 30) == math.inf


# -- claims ------------------------------------------------------------------------------------------------------------


def test_every_claim_has_the_verdict_that_is_known(findings: dict[str, Finding]) -> None:
    assert {key: finding.judgement.verdict for key, finding in findings.items()} == EXPECTED


def test_a_verdict_with_a_remark_has_one(findings: dict[str, Finding]) -> None:
    for finding in findings.values():
        if finding.judgement.verdict in (REMARK, PART):
            assert finding.judgement.remark


def test_settling_without_a_limit_is_that_of_a_geometric_series(findings: dict[str, Finding]) -> None:
    steps = [math.ceil(math.log(0.01 / 5.0) / math.log(abs(1.0 - TS * kx))) for kx in GAINS]
    assert list(findings["faster_with_gain"].measured.values()) == steps == [246, 47, 5]
    assert list(findings["faster_unlimited"].measured.values()) == [246, 47, 5, 307, 171, 154]


def test_the_first_commands_follow_from_the_control_law(findings: dict[str, Finding]) -> None:
    v0, v1, v19 = findings["required_speed"].measured.values()
    assert v0 == pytest.approx(0.5 - 5.0 * 5.0, abs=1e-12)
    assert findings["required_speed_at_start"].measured["v(0) [m/s]"] == v0
    assert v1 == pytest.approx(0.5 - 5.0 * 5.0 * 0.975, abs=1e-5)
    assert v19 == pytest.approx(0.5 - 5.0 * 5.0 * 0.975**19, abs=1e-3)


def test_more_gain_is_faster_up_to_deadbeat_only(findings: dict[str, Finding]) -> None:
    measured = findings["faster_with_any_gain"].measured
    for kx in (5.0, 25.0, 250.0, 300.0, 390.0):
        steps = math.ceil(math.log(0.01 / 5.0) / math.log(abs(1.0 - TS * kx)))
        assert measured[f"K_x = {kx:g} [steps]"] == steps
    assert measured["K_x = 390 [steps]"] == 122
    assert measured["K_x = 200 [steps]"] == 1


def v_r(k: int) -> float:
    return 1.0 - 0.5 * math.cos(8.0 * math.pi * k / 20000)


def along(kx: float, v_max: float, steps: int = 1000) -> tuple[list[float], list[float]]:
    """Error along the track, and v - v_r, of the scalar loop e(k+1) = e(k) + T_s (v_r - v)."""
    e, errors, commands = -5.0, [], []
    for k in range(steps):
        v = max(-v_max, min(v_max, v_r(k) + kx * e))
        errors.append(e)
        commands.append(v - v_r(k))
        e += TS * (v_r(k) - v)
    return errors, commands


def last_outside(values: list[float], band: float) -> int:
    return max((k for k, value in enumerate(values) if abs(value) >= band), default=-1)


def oscillates(d: list[float]) -> bool:
    band = 0.02 * max(map(abs, d))
    return any(value > band for value in d) and any(value < -band for value in d)


def settled(d: list[float]) -> int:
    return last_outside(d, 0.02 * max(map(abs, d))) + 1


@pytest.mark.parametrize(("key", "v_max", "best"), [("optimum", math.inf, 200.0), ("optimum_limited", 6.0, 195.0)])
def test_the_optimum_is_that_of_the_scalar_loop(
    findings: dict[str, Finding], key: str, v_max: float, best: float
) -> None:
    calm = {float(kx): settled(d) for kx in range(5, 400, 5) if not oscillates(d := along(float(kx), v_max)[1])}
    fastest = min(calm, key=lambda kx: calm[kx])
    measured = findings[key].measured
    assert measured["fastest K_x [1/s]"] == fastest == best
    assert measured["its command settles in [steps]"] == calm[fastest]
    assert measured["K_x = 25: command [steps]"] == calm[25.0]
    assert measured["its error is below 1 cm after [steps]"] == last_outside(along(best, v_max)[0], 0.01) + 1
    assert measured["K_x = 25: error [steps]"] == last_outside(along(25.0, v_max)[0], 0.01) + 1


def test_the_first_of_the_three_gains_are_those_of_the_scalar_loop(findings: dict[str, Finding]) -> None:
    for name, value in findings["optimum_of_three"].measured.items():
        v_max = math.inf if name.startswith("unlimited") else 6.0
        d = along(float(name.partition("K_x = ")[2].split()[0]), v_max)[1]
        assert value == ("oscillates" if oscillates(d) else settled(d))


def test_a_wide_range_of_gains_is_critically_damped(findings: dict[str, Finding]) -> None:
    for name, v_max in (("unlimited", math.inf), ("limited", 6.0)):
        critical = []
        for kx in range(5, 400, 5):
            d = along(float(kx), v_max)[1]
            saturated = [k for k in range(settled(d)) if abs(d[k] + v_r(k)) >= v_max]
            if not oscillates(d) and TS * (settled(d) - max(saturated, default=0)) <= 0.25:
                critical.append(kx)
        measured = findings["only_critical"].measured
        assert measured[f"{name}: from K_x [1/s]"] == min(critical)
        assert measured[f"{name}: to K_x [1/s]"] == max(critical)


def test_a_small_oscillation_is_faster_than_a_low_gain(findings: dict[str, Finding]) -> None:
    assert list(findings["oscillation_is_slower"].measured.values()) == [
        settled(along(kx, math.inf)[1]) for kx in (25.0, 250.0)
    ]
    assert list(findings["more_oscillation"].measured.values()) == [
        settled(along(kx, math.inf)[1]) for kx in (250.0, 300.0, 350.0)
    ]


def test_across_the_agv_a_higher_gain_is_slower(findings: dict[str, Finding]) -> None:
    for kx, measured in zip(GAINS, findings["y_direction"].measured.values(), strict=True):
        x, y, theta, outside = 0.0, 5.0, 0.0, -1
        for k in range(6000):
            dx, dy = TS * k - x, -y
            outside = k if math.hypot(dx, dy) >= 0.01 else outside
            x_e, y_e = math.cos(theta) * dx + math.sin(theta) * dy, math.cos(theta) * dy - math.sin(theta) * dx
            v, w = math.cos(theta) + kx * x_e, y_e - 2.0 * math.sin(theta)
            x, y, theta = x + TS * v * math.cos(theta), y + TS * v * math.sin(theta), theta + TS * w
        assert measured == outside + 1


def test_the_eigenvalues_see_outages_on_curves_only(findings: dict[str, Finding]) -> None:
    theta, speed = [math.pi / 2], [v_r(k) for k in range(20000)]
    for k in range(19999):
        theta.append(theta[-1] + TS * 2.0 * math.pi / 100.0 * (1.0 - math.cos(4.0 * math.pi * k / 20000)))
    measured = findings["eigenvalues_on_curves"].measured
    for n in (0, 13, 200, 2000):
        now, held = np.array(theta), np.array(theta)[np.maximum(np.arange(20000) - n, 0)]
        v = np.array(speed)[np.maximum(np.arange(20000) - n, 0)]
        (c, s), (c_n, s_n) = (np.cos(now), np.sin(now)), (np.cos(held), np.sin(held))
        a = TS * 25.0
        rows = [
            [1.0 - a * c * c_n, -a * c * s_n, -TS * s * v],
            [-a * s * c_n, 1.0 - a * s * s_n, TS * c * v],
            [TS * s_n * v, -TS * c_n * v, 1.0 - TS * 2.0 * v],
        ]
        matrices = np.array(rows).transpose(2, 0, 1)
        radius = np.abs(np.linalg.eigvals(matrices)).max()
        assert measured[f"{n} outages: |lambda|"] == pytest.approx(radius, rel=1e-7)
    assert len(set(findings["eigenvalues_on_a_line"].measured.values())) == 1
    b, c_ = TS * 2.0, TS**2
    on_line = max(abs(z) for z in (1.0 - TS * 25.0, *np.roots([1.0, b - 2.0, 1.0 - b + c_])))
    assert findings["eigenvalues_on_a_line"].measured["0 outages: |lambda|"] == pytest.approx(on_line, rel=1e-12)


def test_the_overshoot_is_the_pole(findings: dict[str, Finding]) -> None:
    assert findings["oscillation"].measured["overshoot"] == pytest.approx(0.25, abs=1e-4)


def test_the_time_constants_are_those_of_the_sampled_loop(findings: dict[str, Finding]) -> None:
    expected = [-1e3 * TS / math.log(abs(1.0 - TS * kx)) for kx in GAINS]
    assert list(findings["time_constant"].measured.values()) == pytest.approx(expected, rel=1e-6)


def test_row_3_of_the_error_dynamics_has_the_wrong_sign(findings: dict[str, Finding]) -> None:
    assert findings["error_dynamics"].measured["of eq. 20"] == pytest.approx(-1.0, abs=1e-9)
    assert findings["error_dynamics"].measured["of eq. 22"] == pytest.approx(1.0, abs=1e-9)


def test_under_outages_the_agv_runs_ahead_by_the_mean_age(findings: dict[str, Finding]) -> None:
    ahead = findings["equilibrium_under_outages"].measured["outages of 5 [m]"]
    assert ahead == pytest.approx(1.5 * 2.5 * TS, rel=0.02)  # at the highest speed, n_ul is 2.5 on average


def test_the_paper_s_test_calls_stable_what_grows(findings: dict[str, Finding]) -> None:
    radius, error, _ = findings["criterion_sufficient"].measured.values()
    a, b, c = TS * 25.0, TS * 2.0, TS**2 * 1.0
    eigenvalues = [1.0 - a, *np.roots([1.0, b - 2.0, 1.0 - b + c])]
    assert radius == pytest.approx(max(abs(z) for z in eigenvalues), rel=1e-12)
    e = [0.0]
    for k in range(3999):
        age = min(k, 13)
        e.append(e[k] - TS * 25.0 * (e[k - age] + TS * age))
    assert error == pytest.approx(abs(e[-1]), rel=1e-6)


REFUTED: dict[str, dict[str, Any]] = {
    "error_to_zero": {"": 0.5},
    "stable_without_outages": {"": 1.1},
    "oscillation": {"overshoot": 0.0, "sign changes": 0},
    "required_speed": {"v(0)": -10.0, "v(1)": -25.0},
    "limited_impact": {"unlimited": 10.0, "limited": 9.0},
    "time_constant": {"5": 100.0, "25": 40.0, "250": 4.0},
    "faster_with_gain": {"5": 40, "25": 60, "250": None},
    "similar": {"5": 300, "25": 170, "250": 150, "apart": 0.5},
    "more_oscillation": {"250": 9, "300": 6, "350": 14},
    "critical": {"": "under"},
    "lap": {"steps": 20000, "gap of the last step [m]": 3.0},
    "faster_with_any_gain": {"5": 40, "25": 60},
    "required_speed_at_start": {"v(0) [m/s]": -20.0},
    "optimum_of_three": {"unlimited, K_x = 5 [steps]": 20, "unlimited, K_x = 25 [steps]": 30},
    "outages_decide": {"0": 0.1, "13": 0.2},
}


UPHELD: dict[str, dict[str, Any]] = {
    "faster_with_any_gain": {"5": 246, "25": 47},
    "y_direction": {"5": 200, "25": 100},
    "required_speed": {"v(0)": -25.0, "v(19)": -24.9},
    "eigenvalues_on_a_line": {"0": 0.9, "13": 0.8},
    "equilibrium_under_outages": {"": 0.0},
    "stable_for_any_gain": {"399": 0.1, "401": 0.2},
    "only_critical": {"from": 25.0, "to": 25.0},
    "optimum": {"K_x": 25.0, "command": 30, "error": 47, "25": 30, "25 error": 47},
    "oscillation_is_slower": {"25": 3, "250": 30},
    "limited_impact": {"unlimited": 49.0, "limited": 1.01},
}


@pytest.mark.parametrize("key", UPHELD)
def test_other_values_uphold_a_claim(key: str) -> None:
    (claim,) = (claim for claim in CLAIMS if claim.key == key)
    assert claim.judge(UPHELD[key]).verdict in (HOLDS, REMARK)


@pytest.mark.parametrize("key", REFUTED)
def test_other_values_refute_a_claim(key: str) -> None:
    (claim,) = (claim for claim in CLAIMS if claim.key == key)
    assert claim.judge(REFUTED[key]).verdict == FAILS


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "never"),
        (3, "3"),
        ("over", "over"),
        (-24.5, "-24.5"),
        (1e-31, "0"),
        (1e196, "diverges"),
        (0.000615, "0.000615"),
        (260_312.4, "260300"),
    ],
)
def test_values_as_people_read_them(value: Any, text: str) -> None:
    assert text_of(value) == text


# -- figures and the command -------------------------------------------------------------------------------------------


def test_figures_are_a_column_wide_and_carry_their_data(tmp_path: Path) -> None:
    runs = simulated()
    drawn = list(figures(runs))
    assert [figure.where.partition(":")[0] for figure in drawn] == [
        "Fig. 2a", "Fig. 2b", *(f"Fig. 3{letter}" for letter in "abcdef")
    ]  # fmt: skip
    figure = next(figure for figure in drawn if figure.name == "limited_speed")
    write(figure, tmp_path)
    width, _ = struct.unpack(">II", (tmp_path / "fig_3f_limited_speed.png").read_bytes()[16:24])
    assert width == 1050  # 3.5 in at 300 dots an inch
    root = ElementTree.parse(tmp_path / "fig_3f_limited_speed.svg").getroot()
    assert root.attrib["width"] == "252pt"
    assert "Fig. 3f: translational velocity, limited" in (tmp_path / "fig_3f_limited_speed.svg").read_text()
    assert not root.findall(".//{http://www.w3.org/2000/svg}text"), "letters are paths"
    rows = list(csv.reader((tmp_path / "fig_3f_limited_speed.csv").open()))
    assert [float(row[1]) for row in rows[1:]] == runs.run(*gain(5.0, 6.0)).command[: len(rows) - 1, 0].tolist()


def test_a_figure_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    figure = next(iter(figures(simulated())))
    with pytest.raises(UserError, match="cannot be written"):
        write(figure, tmp_path / "missing")


def test_the_page_is_current(made: Made) -> None:
    assert made.page == (REPOSITORY / "docs/paper.md").read_text(encoding="utf-8")


def test_the_page_of_policies_has_the_ranking_that_the_command_makes(made: Made) -> None:
    page = (REPOSITORY / "docs/policies.md").read_text(encoding="utf-8")
    ranking = page.partition("<!-- ranking:begin -->\n")[2].partition("<!-- ranking:end -->")[0]
    assert ranking.count("###") == 2
    assert ranking in (made.folder / "future.md").read_text(encoding="utf-8")


def test_the_command_writes_everything(made: Made) -> None:
    assert {claim["key"]: claim["verdict"] for claim in made.content["claims"]} == EXPECTED
    assert made.content["source"] == "simulation"
    for suffix in ("svg", "png", "csv"):
        assert len(list(made.folder.glob(f"*.{suffix}"))) == 8 + 9
    assert (made.folder / "future.md").read_text().count("###") == len(made.content["future_work"]) == 9
    assert made.content["paper"]["arxiv"] in (REPOSITORY / "CITATION.cff").read_text()


def test_the_page_has_every_claim_once_beside_its_figure(made: Made) -> None:
    page = html.unescape((made.folder / PAGE).read_text())
    assert page.count("<img") == page.count("data:image/png;base64,") == 8 + 9
    for claim in made.content["claims"]:
        assert page.count(f"<td>{claim['claim']}</td>") == 1
    assert {key for keys in SHOWN_IN.values() for key in keys} < set(EXPECTED)
    _, _, behind = page.partition("Fig. 3b: ")
    assert behind.index("1/K_x is the time constant") < behind.index("Fig. 3c: ")
    words = re.sub(r"base64,[^\"]*", "", page)
    assert "e+1" not in words.partition("future work")[2]


def test_a_directory_that_cannot_be_made_is_one_line(agv_ncs: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    status, said = agv_ncs("reproduce", "--out", tmp_path / "file" / "paper")
    assert status == 1
    assert "cannot be made" in said
    assert "Traceback" not in said


# -- future work -------------------------------------------------------------------------------------------------------


def test_along_the_track_deadbeat_is_the_fastest(made: Made) -> None:
    rows = [row for row in made.future("gain_along") if row["speed"] == "unlimited"]
    assert [row["to 1 cm [steps]"] for row in rows] == [246, 47, 5, 1]
    assert rows[-1]["K_x [1/s]"] == 1.0 / TS


@pytest.mark.parametrize(("ky", "ktheta"), [(5.0, 4.0), (1.0, 2.0), (30.0, 8.0)])
def test_settling_across_is_that_of_the_linear_error(ky: float, ktheta: float) -> None:
    v_r = [1.0 - 0.5 * math.cos(8.0 * math.pi * k / 20000) for k in range(3000)]
    y, theta, last = 0.05, 0.0, -1
    for k, v in enumerate(v_r):
        if abs(y) >= 0.01 or abs(theta) >= 0.01:
            last = k
        y, theta = y + TS * v * theta, theta - TS * v * (ky * y + ktheta * theta)
    steps = settling_across(ky, ktheta, (0.05, 0.0, 0.5 * math.pi))
    assert steps is not None
    assert abs(steps - (last + 1)) <= 3


@pytest.mark.parametrize("n", [5, 10, 20, 50, 100])
@pytest.mark.parametrize("kx", GAINS)
def test_a_single_burst_overshoots_as_the_scalar_loop_does(made: Made, kx: float, n: int) -> None:
    y_r = np.cumsum([0.0, *(TS * (1.0 - 0.5 * math.cos(8.0 * math.pi * k / 20000)) for k in range(400))])
    y = [5.0]
    for k in range(400):
        held = y[0] if 1 <= k <= n else y[k]
        y.append(y[k] + (y_r[k + 1] - y_r[k]) + TS * kx * (y_r[k] - held))
    overshoot = max(0.0, float(np.max(y_r - y))) / 5.0
    (row,) = (row for row in made.future("single_burst") if row["n"] == n and row["speed"] == "unlimited")
    assert row[f"K_x = {kx:g} overshoot"] == pytest.approx(overshoot, rel=2e-3, abs=1e-9)


@pytest.mark.parametrize("track", ["line", "paper"])
def test_twins_agree_with_the_closed_forms_and_not_with_the_paper_s_test(made: Made, track: str) -> None:
    for row in made.future("criteria"):
        if row["track"] != track:
            continue
        a = TS * row["K_x [1/s]"]
        constant = max(n for n in range(100) if a < 2.0 * math.sin(math.pi / (2.0 * (2 * n + 1))) - 1e-12)
        burst = max(n for n in range(100) if (n + 1) * a < 2.0 - 1e-12)
        assert row["constant n"] == row["constant n, twins"] == constant
        assert row["bursts"] == row["bursts, twins"] == burst
        assert row["independent losses, mean square"] == pytest.approx((2.0 - a) / (2.0 + a), rel=1e-3)
        assert row["paper's test"] == "any" or row["paper's test"] > 2000


def test_a_limit_on_the_speed_bounds_what_is_unstable(made: Made) -> None:
    for row in made.future("limit"):
        stable = (row["n"] + 1) * TS * 25.0 < 2.0
        assert (row["unlimited: twins"] == "come closer") == stable
        assert row["limited: largest error [m]"] < 6.5 * TS * (row["n"] + 1)  # what one burst can drive


def test_outages_never_help(made: Made) -> None:
    rows = [row for row in made.future("loss_probability") if row["speed"] == "unlimited"]
    assert [row["p"] for row in rows] == [0.0, 0.2, 0.4, 0.6, 0.8, 0.9]
    assert rows[0]["K_x = 25 [m s]"] == pytest.approx(TS * 5.0 / (TS * 25.0), rel=1e-2)  # a geometric series
    for kx in GAINS:
        assert (
            rows[-1][f"K_x = {kx:g} [m s]"] is None or rows[-1][f"K_x = {kx:g} [m s]"] > rows[0][f"K_x = {kx:g} [m s]"]
        )
    assert [row["K_x = 250 part"] for row in rows[:1] + rows[-2:]] == [0.0, 1.0, 1.0]


def test_only_the_predictor_survives_200_outages_in_a_row(made: Made) -> None:
    rows = [row for row in made.future("staleness_policies") if row["uplink"] == "200 after each received"]
    assert [row["policy"] for row in rows if row["twins part"] == 0.0] == ["predict", "predict"]
    exact, scaled = (row["farthest from the reference [m]"] for row in rows if row["policy"] == "predict")
    assert exact == 0.0
    assert scaled == pytest.approx(0.1 * 1.5 * 200 * 0.005, rel=0.15)  # delta v_r n T_s where v_r is largest


def test_aligned_poses_have_no_bias(made: Made) -> None:
    """Held ones run ahead by v_r n T_s; both where the loop is stable."""
    rows = [row for row in made.future("staleness_policies") if row["uplink"] == "13 after each received"]
    by_policy = {row["policy"]: row["farthest from the reference [m]"] for row in rows if row["speed scale"] == 1.0}
    assert by_policy["align"] == 0.0
    assert by_policy["hold"] > 0.01


def test_every_table_of_the_future_work_is_a_figure_with_its_data(made: Made) -> None:
    for key, rows in made.content["future_work"].items():
        root = ElementTree.parse(made.folder / f"{key}.svg").getroot()
        assert root.get("width") == "252pt"
        assert (made.folder / f"{key}.png").read_bytes().startswith(b"\x89PNG")
        written = list(csv.DictReader((made.folder / f"{key}.csv").open()))
        assert len(written) == len(rows)
        for row, text in zip(rows, written, strict=True):
            assert list(row) == list(text)
            assert all(value is None or str(value) == text[name] for name, value in row.items())
