"""The Python API: its names stand in one list, are lazy, work without ROS, and give what the command line gives."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import agv_ncs
from agv_analysis.recordings.recording import read_run
from agv_analysis.sweep.collect import collect
from agv_analysis.sweep.execute import on_this_machine
from agv_analysis.sweep.plan import Sweep, parse_axis

REPOSITORY = Path(__file__).parents[2]
SAMPLE = REPOSITORY / "bags/sample"
PAPER = REPOSITORY / "config/paper.yaml"
LOSSY = ("relay.uplink.model=bernoulli", "plant.duration=2.0")

Code = Callable[..., str]


def imported_for_types() -> dict[str, str]:
    """Module by name of what the package imports for types only."""
    tree = ast.parse((REPOSITORY / "agv_ncs/__init__.py").read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    assert ast.unparse(block.test) == "TYPE_CHECKING"
    return {
        alias.name: str(node.module) for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }


def test_one_list_names_everything() -> None:
    assert imported_for_types() == agv_ncs._MODULES
    assert agv_ncs.__all__ == sorted(agv_ncs._MODULES)
    assert set(agv_ncs.__all__) <= set(dir(agv_ncs))
    page = (REPOSITORY / "docs/python_api.md").read_text(encoding="utf-8")
    table = page.partition("<!-- names:begin -->")[2].partition("<!-- names:end -->")[0]
    assert re.findall(r"^\| `(\w+)", table, re.MULTILINE) == list(agv_ncs._MODULES)


def test_what_the_page_names_is_there() -> None:
    page = (REPOSITORY / "docs/python_api.md").read_text(encoding="utf-8")
    assert set(re.findall(r"\bagv_ncs\.(\w+)", page)) <= set(agv_ncs.__all__)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'no_such_name'"):
        _ = agv_ncs.no_such_name


def test_the_import_loads_nothing_else(without_ros: Code) -> None:
    said = without_ros("import agv_ncs\nprint(sorted(sys.modules))")
    loaded = {name.partition(".")[0] for name in ast.literal_eval(said)}
    assert loaded & {"numpy", "numba", "rclpy", "matplotlib", "click", "yaml", "agv_analysis", "agv_ros"} == set()


def test_every_name_is_there_without_ros(without_ros: Code) -> None:
    without_ros("import agv_ncs\nfor name in agv_ncs.__all__: assert getattr(agv_ncs, name).__doc__, name")
    without_ros("from agv_ncs import *\nassert load_scenario and Quantity and run")


def test_running_without_ros_says_what_to_install(without_ros: Code) -> None:
    code = "import agv_ncs\ntry: agv_ncs.run(agv_ncs.load_scenario(sys.argv[0]))\n"
    said = without_ros(code + "except agv_ncs.UserError as error: print(error)", PAPER)
    assert "agv_ncs.run needs ROS 2" in said
    assert "pip install 'agv_ncs[ros]'" in said


@pytest.mark.no_cover
def test_the_session_of_the_page_runs(without_ros: Code, tmp_path: Path) -> None:
    page = (REPOSITORY / "docs/python_api.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(blocks) == 3
    for folder in ("config", "bags"):
        (tmp_path / folder).symlink_to(REPOSITORY / folder)
    without_ros("\n".join(blocks), cwd=tmp_path)
    assert (tmp_path / "report.html").stat().st_size > 0
    assert (tmp_path / "sweep.png").stat().st_size > 0


def test_a_recording_is_read_by_its_name(tmp_path: Path) -> None:
    run, expected = agv_ncs.read_recording(str(SAMPLE)), read_run(SAMPLE)
    np.testing.assert_array_equal(run.pose, expected.pose)
    (tmp_path / "params.yaml").write_text(expected.scenario.to_yaml(), encoding="utf-8")
    assert agv_ncs.read_recording(SAMPLE, config=str(tmp_path / "params.yaml")).scenario == expected.scenario


def test_our_recording_read_as_that_of_a_robot(tmp_path: Path) -> None:
    (tmp_path / "params.yaml").write_text(read_run(SAMPLE).scenario.to_yaml(), encoding="utf-8")
    run = agv_ncs.read_robot_recording(
        SAMPLE, pose="/edge/pose", command="/edge/cmd_vel", config=tmp_path / "params.yaml"
    )
    np.testing.assert_array_equal(run.lost, read_run(SAMPLE).lost[: len(run)])
    with pytest.raises(agv_ncs.UserError, match="no reference: give the name of its topic"):
        agv_ncs.read_robot_recording(SAMPLE, pose="/edge/pose")
    with pytest.raises(agv_ncs.UserError, match=r"two references, the topic /plan and the file track\.csv"):
        agv_ncs.read_robot_recording(SAMPLE, pose="/edge/pose", reference="/plan", track_file="track.csv")


@pytest.fixture(scope="module")
def swept() -> agv_ncs.SweepResult:
    scenario = agv_ncs.load_scenario(PAPER, LOSSY)
    vary: dict[str, list[float]] = {"controller.kx": [25, 250.0], "relay.uplink.p": [0.0, 0.3, 0.9]}
    return agv_ncs.sweep(scenario, vary, seeds=3, verdicts=False)


def test_a_sweep_is_that_of_the_command_line(swept: agv_ncs.SweepResult) -> None:
    axes = tuple(map(parse_axis, ("controller.kx=25,250", "relay.uplink.p=0,0.3,0.9")))
    plan = Sweep(agv_ncs.load_scenario(PAPER, LOSSY), axes, 3)
    rows, _ = collect(plan, None, lambda parts: on_this_machine(plan, parts), lambda done: None)
    assert json.dumps(swept.rows) == json.dumps(rows)


def test_a_sweep_has_a_verdict_on_each_point() -> None:
    (row,) = agv_ncs.sweep(agv_ncs.load_scenario(PAPER, LOSSY), {"relay.uplink.p": np.array([0.97])}, seeds=1).rows
    assert (row["verdict"], row["verdict_reason"]) == ("unstable", "under this link the mean square of the error grows")


def test_columns_of_a_sweep_have_its_shape(swept: agv_ncs.SweepResult, tmp_path: Path) -> None:
    assert swept.shape == (2, 3)
    assert swept.axes == {"controller.kx": (25.0, 250.0), "relay.uplink.p": (0.0, 0.3, 0.9)}
    np.testing.assert_array_equal(swept["relay.uplink.p"], [[0.0, 0.3, 0.9]] * 2)
    assert swept["instability"][1, 2] == 1.0
    with pytest.raises(agv_ncs.UserError, match=r"no column 'kx', it has controller\.kx, relay"):
        _ = swept["kx"]
    swept.draw(tmp_path / "map.png")
    swept.write(tmp_path / "rows.csv")
    assert len((tmp_path / "rows.csv").read_text().splitlines()) == 7


@pytest.mark.parametrize(
    ("name", "values", "complaint"),
    [
        ("kx", [1.0], "kx is not a parameter; expected node.parameter"),
        ("controller.k", [1.0], "controller.k is not a parameter"),
        ("controller.kx", [], "controller.kx: must have values, each once, got []"),
        ("controller.kx", [1.0, 1.0], "each once"),
        ("controller.kx", [-1.0], "controller.kx must be in [0, 1e+06], got -1.0"),
        ("relay.seed", [1, 2], "seeds are what"),
        ("error_detector.policy", ["hold", "guess"], "must be one of hold, align, predict"),
    ],
)
def test_a_sweep_that_cannot_be_done_is_refused(name: str, values: list[object], complaint: str) -> None:
    with pytest.raises(agv_ncs.UserError, match=re.escape(complaint)):
        agv_ncs.sweep(agv_ncs.load_scenario(PAPER, LOSSY), {name: values})


def test_a_run_on_ros_is_recorded(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    scenario = agv_ncs.load_scenario(REPOSITORY / "config/outages.yaml", ["plant.duration=1.0"])
    steps: list[int] = []
    outcome = agv_ncs.run(scenario, tmp_path / "bag", progress=steps.append)
    assert (outcome.steps, steps[-1]) == (200, 200)
    run = agv_ncs.read_recording(tmp_path / "bag")
    np.testing.assert_allclose(run.pose, agv_ncs.simulate(scenario).pose, rtol=0.0, atol=1e-9)
    with pytest.raises(agv_ncs.UserError, match="exists"):
        agv_ncs.run(scenario, tmp_path / "bag")
