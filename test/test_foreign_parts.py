"""Parts of another package, those of the pages in docs/, in every way that there is to a run.

They are installed as pip would, in processes of their own; what they must come to is written out here once more.
"""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytest

from agv_analysis.scenario import load_scenario
from agv_cloud.reference.reference import Reference
from agv_plant.random_stream import uniforms

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from test.conftest import AgvNcs, Install, Start

REPOSITORY = Path(__file__).parents[1]
PAPER = "config/paper.yaml"
TS, STEPS, SEED = 0.005, 1200, 3
TOLERANCE = 1e-9


class Given(NamedTuple):
    """What a run is asked for."""

    law: str = "kanayama"
    gains: tuple[float, ...] = (25.0, 1.0, 2.0)
    look_ahead: float = 0.0
    vehicle: str = "unicycle"
    lags: tuple[float, float] = (0.05, 0.02)
    policy: str = "hold"
    share: float = 1.0
    stall: tuple[float, float] | None = None

    @property
    def settings(self) -> list[str]:
        names = {"integral": ("kx", "ki", "ky", "ktheta"), "aim": ("k",), "kanayama": ("kx", "ky", "ktheta")}[self.law]
        prefix = "" if self.law == "kanayama" else f"{self.law}."
        found = [f"controller.{prefix}{name}={value}" for name, value in zip(names, self.gains, strict=True)]
        found += [f"controller.law={self.law}", f"plant.vehicle={self.vehicle}", f"error_detector.policy={self.policy}"]
        if self.look_ahead:
            found.append(f"controller.look_ahead={self.look_ahead}")
        if self.vehicle == "tug":
            found += [f"plant.tug.speed_lag={self.lags[0]}", f"plant.tug.rate_lag={self.lags[1]}"]
        if self.policy == "coast":
            found.append(f"error_detector.coast.share={self.share}")
        if self.stall:
            found += ["relay.uplink.model=stall", f"relay.uplink.arguments={list(self.stall)}"]
        return [*found, f"plant.duration={STEPS * TS}", f"relay.seed={SEED}"]

    @property
    def options(self) -> list[str]:
        return [word for setting in self.settings for word in ("--set", setting)]


ALL = Given("integral", (8.0, 4.0, 1.5, 2.5), 0.0, "tug", (0.08, 0.03), "coast", 0.9, (0.05, 6.0))
AHEAD = Given("aim", (2.0,), 0.4, stall=(0.05, 4.0))


def expected(given: Given) -> NDArray[np.float64]:
    """The run without anything of agv_ncs but its track and its random numbers: x, y, theta, eps, u, lost; (N, 9)."""
    ahead = round(given.look_ahead / TS)
    reference = Reference(load_scenario(PAPER).error_detector).first(STEPS + ahead).tolist()
    draws = uniforms(SEED, "uplink", 0, STEPS)[:, 0].tolist()
    x, y, theta, speed, rate = 0.0, 5.0, math.pi / 2.0, 0.0, 0.0
    held, target = (x, y, theta), tuple(reference[0][:3])
    total, stalled, rows = 0.0, 0, []
    for k in range(STEPS):
        lost, stalled = stalled > 0, max(0, stalled - 1)
        if given.stall and not lost and draws[k] < given.stall[0]:
            lost, stalled = True, int(given.stall[1]) - 1
        lost = lost and k > 0
        x_r, y_r, theta_r, v_r, w_r = reference[k + ahead]
        if not lost:
            held, target = (x, y, theta), (x_r, y_r, theta_r)
        elif given.policy == "coast":
            step = TS * given.share * v_r
            held = (
                held[0] + step * math.cos(held[2]), held[1] + step * math.sin(held[2]),
                held[2] + TS * given.share * w_r,
            )  # fmt: skip
            target = (x_r, y_r, theta_r)
        else:
            target = (x_r, y_r, theta_r)
        dx, dy, cos, sin = target[0] - held[0], target[1] - held[1], math.cos(held[2]), math.sin(held[2])
        x_e, y_e, theta_e = cos * dx + sin * dy, cos * dy - sin * dx, target[2] - held[2]
        if given.law == "integral":
            kx, ki, ky, ktheta = given.gains
            total += TS * x_e
            v = v_r * math.cos(theta_e) + kx * x_e + ki * total
            w = w_r + v_r * (ky * y_e + ktheta * math.sin(theta_e))
        else:
            v = v_r + given.gains[0] * (x_e - v_r * given.look_ahead)
            w = 2.0 * v * y_e / max(0.01, x_e**2 + y_e**2)
        rows.append((x, y, theta, x_e, y_e, theta_e, v, w, lost))
        if given.vehicle == "tug":
            speed = v + math.exp(-TS / given.lags[0]) * (speed - v)
            rate = w + math.exp(-TS / given.lags[1]) * (rate - w)
        else:
            speed, rate = v, w
        x, y, theta = x + TS * speed * math.cos(theta), y + TS * speed * math.sin(theta), theta + TS * rate
    return np.array(rows, dtype=float)


@pytest.fixture(scope="module")
def package(install: Install, page_block: Callable[[str, str], str], tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The environment of processes that have the parts of the pages, with the entry points of the pages."""
    points: dict[str, dict[str, str]] = {"agv_ncs.channels": {"stall": "roadworks:stall"}}
    pages = (("control_laws.md", "package"), ("plant.md", "vehicle-package"), ("policies.md", "policy-package"))
    for page, mark in pages:
        text = page_block(page, mark)
        (group,) = re.findall(r'\[project\.entry-points\."(.*?)"\]', text)
        points[group] = dict(re.findall(r'^(\w+) = "(\w+:\w+)"', text, re.MULTILINE))
    modules = {
        "my_laws": page_block("control_laws.md", "law"),
        "my_vehicles": page_block("plant.md", "vehicle"),
        "my_policies": page_block("policies.md", "policy"),
        "roadworks": page_block("channels.md", "memory"),
    }
    return install(tmp_path_factory.mktemp("package"), modules, points)


def python(environment: dict[str, str], *arguments: str) -> str:
    """Output of a process that has the package; it must succeed."""
    done = subprocess.run(
        [sys.executable, *arguments], cwd=REPOSITORY, env=environment, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    return done.stdout


@pytest.fixture
def cli(package: dict[str, str], agv_ncs: AgvNcs) -> Callable[..., str]:
    """Output of a command where the package is installed; it must succeed."""

    def run(*arguments: str | Path) -> str:
        status, said = agv_ncs(*arguments, env=package)
        assert status == 0, said
        return said

    return run


READ = """
import sys
from pathlib import Path
import numpy as np
from agv_analysis.recordings.recording import read_run
run = read_run(Path(sys.argv[1]))
assert not run.unexplained
rows = np.column_stack([run.pose, run.error, run.command, run.lost])
np.save(sys.argv[2], rows)
"""


SIMULATE = """
import sys
import numpy as np
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate
run = simulate(load_scenario(sys.argv[1], sys.argv[3:]))
np.save(sys.argv[2], np.column_stack([run.pose, run.error, run.command, run.lost]))
"""


def assert_same(found: NDArray[np.float64], given: Given) -> None:
    wanted = expected(given)
    assert wanted[:, 8].sum() > 50
    assert np.abs(wanted[-1, :3]).max() < 100.0
    np.testing.assert_array_equal(found[:, 8], wanted[:, 8])
    np.testing.assert_allclose(found[:, :8], wanted[:, :8], rtol=0.0, atol=TOLERANCE)


@pytest.mark.parametrize("given", [ALL, AHEAD], ids=["law, vehicle, policy, channel", "look-ahead"])
def test_nodes_simulation_and_recording_do_what_is_written_here(
    package: dict[str, str], cli: Callable[..., str], tmp_path: Path, given: Given
) -> None:
    bag, recorded, simulated = tmp_path / "bag", tmp_path / "recorded.npy", tmp_path / "simulated.npy"
    cli("run", PAPER, *given.options, "--bag", bag)
    python(package, "-c", READ, str(bag), str(recorded))
    assert_same(np.load(recorded), given)
    python(package, "-c", SIMULATE, PAPER, str(simulated), *given.settings)
    assert_same(np.load(simulated), given)
    assert cli("replay", bag, "--compare").count("equal (largest difference") == 2


def test_a_recording_is_judged(cli: Callable[..., str], tmp_path: Path) -> None:
    bag, short = tmp_path / "bag", ("--set", "plant.duration=0.5")
    cli("run", PAPER, *AHEAD.options, *short, "--bag", bag)
    assert "Verdict" in cli("analyse", bag, "--json", tmp_path / "found.json")
    found = json.loads((tmp_path / "found.json").read_text())
    assert (found["steps"], found["unexplained"]) == (100, {})
    assert found["verdict"] is not None
    assert "Verdict" in cli("simulate", PAPER, *AHEAD.options, *short)


def test_the_loop_in_processes_and_a_replay_on_dds_have_the_policy_s_commands(
    package: dict[str, str], cli: Callable[..., str], tmp_path: Path
) -> None:
    bag, rows = tmp_path / "bag", tmp_path / "rows.npy"
    cli("run", PAPER, *ALL.options, "--processes", "--bag", bag)
    python(package, "-c", READ, str(bag), str(rows))
    assert_same(np.load(rows), ALL)
    assert cli("replay", bag, "--lockstep", "--compare").count("equal (largest difference") == 2


def test_late_messages_go_another_way_through_the_simulation_to_the_same_numbers(
    package: dict[str, str], tmp_path: Path
) -> None:
    """A jitter of nothing: links are asked slot by slot, memories and states are kept by them."""
    rows, later = tmp_path / "rows.npy", ["relay.downlink.delay=0.0001", "relay.downlink.schedule=0.0: delay=0.0"]
    python(package, "-c", SIMULATE, PAPER, str(rows), *ALL.settings, *later)
    assert_same(np.load(rows), ALL)


BATCH = """
import sys
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate, simulate_batch
from agv_analysis.simulation.parts import _NOT_COMPILED
scenario = load_scenario(sys.argv[1], sys.argv[2:])
run = simulate(scenario)
print(run.pose.tobytes().hex(), run.error.tobytes().hex(), run.command.tobytes().hex(), run.lost.tobytes().hex())
print(simulate_batch([scenario] * 2, [3, 4], twins=True).tobytes().hex())
print(simulate_batch([scenario] * 2, [3, 4]).tobytes().hex())
"""


def more_than_numba_compiles(package: dict[str, str], folder: Path) -> dict[str, str]:
    """The environment of processes in which each of the parts has something in it that numba does not know."""
    folder.mkdir()
    for module in ("my_laws", "my_vehicles", "my_policies", "roadworks"):
        source = Path(package["PYTHONPATH"].split(":")[0], f"{module}.py").read_text(encoding="utf-8")
        slow = source.replace('\n    """', '\n    known = {"open": open, "file": __file__}\n    """')
        lines = re.sub(r"^    return", '    known["open"](known["file"]).close()\n    return', slow, flags=re.MULTILINE)
        (folder / f"{module}.py").write_text(lines, encoding="utf-8")
    return {**package, "PYTHONPATH": f"{folder}:{package['PYTHONPATH']}"}


def test_numba_changes_nothing(package: dict[str, str], tmp_path: Path) -> None:
    """Compiled, more than can be compiled, and without numba: the same numbers to the last bit."""
    short, slow = [*ALL.settings, "plant.duration=2.0"], more_than_numba_compiles(package, tmp_path / "slow")
    compiled = python(package, "-c", BATCH + "assert not _NOT_COMPILED\n", PAPER, *short)
    assert python(slow, "-c", BATCH + "assert len(_NOT_COMPILED) == 4\n", PAPER, *short) == compiled
    without = "import sys; sys.modules['numba'] = None\n" + BATCH
    assert python(package, "-c", without, PAPER, *short) == compiled


def test_a_gain_of_it_can_be_swept(cli: Callable[..., str], tmp_path: Path) -> None:
    cli(
        "sweep", PAPER, *ALL.options, "--vary", "controller.integral.ki=0:8:3", "--seeds", "2",
        "--no-verdicts", "--out", tmp_path / "sweep",
    )  # fmt: skip
    points = np.genfromtxt(tmp_path / "sweep/points.csv", delimiter=",", names=True)
    assert points["controllerintegralki"].tolist() == [0.0, 4.0, 8.0]
    assert points["runs"].tolist() == [2, 2, 2]
    assert len(set(points["iae_p50"].tolist())) == 3
    said = cli(
        "sweep", PAPER, "--set", "plant.duration=1.0", "--vary", "controller.law=kanayama,integral",
        "--out", tmp_path / "laws",
    )  # fmt: skip
    assert "integral" in said


def test_its_parameters_are_listed_with_unit_bounds_and_meaning(cli: Callable[..., str]) -> None:
    said = cli("parameters")
    for name, unit, default, bounds, meaning in (
        ("integral.ki", "1/s^2", "4.0", "in [0, 1000]", "gain of the integral of the error along the track"),
        ("aim.k", "1/s", "1.5", "in [0, 100]", "gain of the distance to the point ahead"),
        ("tug.speed_lag", "s", "0.05", "in (0, 10]", "time constant of the speed"),
        ("coast.share", "", "1.0", "in [0, 1]", "share of the reference's speeds"),
    ):
        (row,) = re.findall(rf"^\| `{name}` \|.*$", said, re.MULTILINE)
        assert [unit, f"`{default}`", bounds] == [cell.strip() for cell in row.split("|")[3:6]]
        assert meaning in row
    assert re.search(r"^## `controller`, control law integral \(my_laws:integral\)$", said, re.MULTILINE)


ROUND_TRIP = """
import sys
from agv_analysis.scenario import load_scenario, parse_scenario
scenario = load_scenario(sys.argv[1], sys.argv[2:])
print(scenario.to_yaml())
assert parse_scenario(scenario.to_yaml(), "again") == scenario
assert parse_scenario(scenario.to_yaml(of_all_parts=True), "again") == scenario
"""


EXPLORE = """
import sys
from agv_analysis.explore.response import respond
from agv_analysis.explore.settings import scenario_of, values_of
from agv_analysis.explore.sliders import CHOICES, GAIN_SLIDERS, LOOKING_AHEAD
from agv_analysis.scenario import load_scenario
assert {"integral", "aim"} <= set(CHOICES["law"].names)
assert {"tug"} < set(CHOICES["vehicle"].names) and {"coast"} < set(CHOICES["policy"].names)
assert "stall" in CHOICES["model"].names and "aim" in LOOKING_AHEAD
for slider in GAIN_SLIDERS["integral"]:
    print(slider.label, slider.low, slider.high)
base = load_scenario(sys.argv[1], ["plant.duration=2.0"])
chosen = {"law": "aim", "vehicle": "tug", "policy": "coast", "aim-k": 3.0, "look_ahead": 400}
scenario = scenario_of(base, {**values_of(base), **chosen})
assert scenario.controller.gains == (3.0,) and scenario.plant.look_ahead == 0.4
assert respond(scenario).rows[0][0] == "Error in the last tenth"
"""


def test_the_explorer_offers_them(package: dict[str, str]) -> None:
    assert python(package, "-c", EXPLORE, PAPER).splitlines() == [
        "kx [1/s] 0.0 32.0", "ki [1/s^2] 0.0 16.0", "ky [1/m^2] 0.0 4.0", "ktheta [1/m] 0.0 8.0",
    ]  # fmt: skip


def test_a_params_file_holds_the_parameters_of_the_parts_chosen(package: dict[str, str]) -> None:
    text = python(package, "-c", ROUND_TRIP, PAPER, *ALL.settings)
    for name in ("integral.ki: 4.0", "tug.rate_lag: 0.03", "coast.share: 0.9", "law: integral"):
        assert name in text
    for other in ("aim.", "pure_pursuit.", "state_feedback.", "bicycle.", " kx:"):
        assert other not in text


def test_a_bag_is_read_in_part_where_the_package_is_missing(
    cli: Callable[..., str], tmp_path: Path, agv_ncs: Callable[..., tuple[int, str]]
) -> None:
    bag = tmp_path / "bag"
    short = ("--set", "plant.duration=0.5", "--bag", bag)
    cli("run", PAPER, *AHEAD.options, *short)
    status, said = agv_ncs("analyse", bag)
    assert status == 1
    assert "Traceback" not in said
    assert len(said.strip().splitlines()) == 1
    assert "controller.law must be one of kanayama, state_feedback, pure_pursuit, got 'aim'" in said or "stall" in said
    assert "install it" in said
    for command in (("bag", "info", bag), ("bag", "export", bag, "--csv")):
        assert agv_ncs(*command)[0] == 0
    status, said = agv_ncs("replay", bag, "--compare")
    assert (status, "Traceback" in said, "install it" in said) == (1, False, True)


def test_a_gain_of_it_changes_while_the_controller_runs(package: dict[str, str], start: Start) -> None:
    rclpy: Any = pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    from rcl_interfaces.srv import DescribeParameters, SetParameters
    from rclpy.parameter import Parameter

    from agv_ros.executor import spin_for

    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("probe", context=context)
    executor: Any = rclpy.executors.SingleThreadedExecutor(context=context)
    executor.add_node(node)
    controller = start("agv_cloud.controller_node", "--ros-args", "-p", "law:=integral", env=package)

    def call(kind: Any, name: str, request: Any) -> Any:
        client = node.create_client(kind, f"/controller/{name}")
        assert spin_for(executor, client.service_is_ready, 60.0)
        future = client.call_async(request)
        assert spin_for(executor, future.done, 60.0)
        return future.result()

    def change(name: str, value: Any) -> Any:
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        return call(SetParameters, "set_parameters", request).results[0]

    try:
        request = DescribeParameters.Request(names=["integral.ki"])
        (known,) = call(DescribeParameters, "describe_parameters", request).descriptors
        assert known.description == "gain of the integral of the error along the track [1/s^2]"
        assert change("integral.ki", 7.0).successful
        refused = change("integral.ki", -7.0)
        assert (refused.successful, "integral.ki" in refused.reason) == (False, True)
        assert not change("law", "aim").successful
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()
        controller.process.terminate()
        assert "Traceback" not in controller.end()[1]
