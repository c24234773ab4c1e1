"""The params files in config/: valid, in step with the defaults, with each other and with what their comments say."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from agv_analysis.scenario import SCHEMAS, Scenario, load_scenario
from agv_ros.parameters import as_dict, parameters_of
from agv_ros.params_file import read_sections

CONFIG = Path(__file__).parent.parent / "config"
FILES = set(CONFIG.glob("*.yaml")) - {CONFIG / "rosbag2_qos.yaml"}  # which is not for our nodes
LOOPS = sorted(path for path in FILES if set(read_sections(str(path))) & set(SCHEMAS))


def differences(a: Scenario, b: Scenario) -> dict[str, tuple[Any, Any]]:
    """Parameters in which two scenarios differ, by `node.parameter`."""
    return {
        f"{node}.{name}": (value, as_dict(getattr(b, node))[name])
        for node in SCHEMAS
        for name, value in as_dict(getattr(a, node)).items()
        if value != as_dict(getattr(b, node))[name]
    }


@pytest.mark.parametrize("path", LOOPS, ids=lambda path: path.name)
def test_every_file_is_a_scenario(path: Path) -> None:
    load_scenario(str(path))


@pytest.mark.parametrize("path", LOOPS, ids=lambda path: path.name)
def test_every_file_means_the_same_to_any_yaml_reader(path: Path) -> None:
    plain = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert [flat(section["ros__parameters"]) for section in plain.values()] == [*read_sections(str(path)).values()]


def flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    leaves: dict[str, Any] = {}
    for name, value in tree.items():
        leaves |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return leaves


def test_the_paper_s_scenario_is_the_default_one() -> None:
    defaults = Scenario(**{node: schema() for node, schema in SCHEMAS.items()})
    assert differences(load_scenario(str(CONFIG / "paper.yaml")), defaults) == {}


def test_the_paper_s_scenario_in_numbers() -> None:
    # Section "Simulation setup" of the paper; the AGV starts 5 m away in global y, heading along y.
    found = load_scenario(str(CONFIG / "paper.yaml"))
    assert (found.plant.ts, found.plant.duration, found.error_detector.lap_time) == (0.005, 100.0, 100.0)
    assert found.plant.initial_pose == pytest.approx((0.0, 5.0, 1.5707963267948966), abs=0.0)
    assert found.error_detector.track_start == (0.0, 0.0, 1.5707963267948966)
    assert (found.controller.kx, found.controller.ky, found.controller.ktheta) == (25.0, 1.0, 2.0)
    assert found.controller.v_max == float("inf")


def test_the_scenario_with_outages_differs_by_its_uplink_alone() -> None:
    paper, outages = (load_scenario(str(CONFIG / f"{name}.yaml")) for name in ("paper", "outages"))
    changed = differences(outages, paper)
    assert set(changed) == {"relay.uplink.model", "relay.uplink.p", "relay.uplink.r"}


def test_the_comment_on_outages_is_true() -> None:
    text = (CONFIG / "outages.yaml").read_text(encoding="utf-8")
    uplink = load_scenario(str(CONFIG / "outages.yaml")).relay.uplink
    percent = [float(word) / 100.0 for word in re.findall(r"(\d+)%", text)]
    assert percent == [uplink.p, uplink.r, 1.0 - uplink.h, 1.0 - uplink.k]
    assert re.findall(r"bursts of (\d+) slots", text) == [f"{1.0 / uplink.r:.0f}"]
    assert re.findall(r"(\d+) % of the poses lost", text) == [f"{100.0 * uplink.p / (uplink.p + uplink.r):.0f}"]


@pytest.mark.parametrize("path", LOOPS, ids=lambda path: path.name)
def test_every_file_names_the_parameters_that_a_reader_would_look_for(path: Path) -> None:
    sections = read_sections(str(path))
    assert set(sections["controller"]) == {"kx", "ky", "ktheta", "v_max"}
    for node in set(sections) & set(SCHEMAS):
        assert set(sections[node]) <= set(parameters_of(SCHEMAS[node]))
