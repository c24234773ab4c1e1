"""The layers: imports point one way, and only the nodes, their plumbing and the runner know ROS."""

from __future__ import annotations

import ast
import graphlib
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
LAYERS = ("agv_ros", "agv_plant", "agv_cloud", "agv_analysis", "agv_ncs")
"""From the lowest to the highest; each may import those before it."""

ROS = re.compile(r"rclpy|.*_msgs|.*_interfaces|(rosidl|ament|rmw|rosbag2|tf2|launch)(_.*)?")
"""Packages that there are on a machine with ROS only."""

SPEAK_ROS = {
    "agv_ros.node", "agv_ros.parameter_declaration", "agv_ros.endpoints", "agv_ros.qos", "agv_ros.executor",
    "agv_ros.clock_mode",
    "agv_analysis.runtime.middleware", "agv_analysis.runtime.one_process", "agv_analysis.runtime.runner",
    "agv_analysis.runtime.processes",
}  # fmt: skip
"""Beside the nodes themselves."""


SHARED_NAMES = {
    "__init__": "Python's name for a package's own module",
    "registry": "each kind of part has one: channels, control laws, vehicles, staleness policies",
    "parameters": "each side declares those of its nodes",
    "parts": "what parts are, and which of the loop's functions they replace",
    "reference": "the nodes' reference step by step, and the same compiled for a whole run",
}
"""Module file names that stand more than once, each with the reason. A command's file has the name of the command."""


def name_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(path): path for layer in LAYERS for path in sorted((ROOT / layer).rglob("*.py"))}


def speaks_ros(module: str) -> bool:
    return module in SPEAK_ROS or module.endswith("_node")


def imports(source: str) -> Iterator[str]:
    """All modules that a source imports, anywhere in it, for types only or in earnest."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are written in full"
            assert node.module
            yield node.module


def upwards(module: str, source: str) -> list[str]:
    """Imports of a layer above the module's own."""
    above = LAYERS[LAYERS.index(module.partition(".")[0]) + 1 :]
    return [name for name in imports(source) if name.partition(".")[0] in above]


def of_ros(source: str) -> list[str]:
    return [name for name in imports(source) if ROS.fullmatch(name.partition(".")[0])]


def test_the_check_sees_what_it_is_for() -> None:
    source = "import agv_cloud.reference.tracks\ndef f():\n  from agv_analysis import run\n  import rclpy.node, numpy\n"
    source += "from geometry_msgs.msg import Twist\nfrom mcap_ros2.decoder import Decoder\nimport agv_ros.stamps\n"
    assert sorted(upwards("agv_plant.radio.link", source)) == ["agv_analysis", "agv_cloud.reference.tracks"]
    assert upwards("agv_cloud.reference.tracks", source) == ["agv_analysis"]
    assert sorted(of_ros(source)) == ["geometry_msgs.msg", "rclpy.node"]


def test_every_layer_is_there() -> None:
    assert {module.partition(".")[0] for module in MODULES} == set(LAYERS)
    assert set(MODULES) >= SPEAK_ROS
    assert {"agv_plant.plant_node", "agv_plant.relay_node", "agv_cloud.controller_node"} <= set(MODULES)


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_one_way(module: str) -> None:
    assert upwards(module, MODULES[module].read_text(encoding="utf-8")) == []


def test_what_speaks_ros_is_a_node_or_lives_in_agv_ros_or_runtime() -> None:
    assert {module for module in SPEAK_ROS if not module.startswith(("agv_ros.", "agv_analysis.runtime."))} == set()


def test_no_file_name_stands_twice_without_need() -> None:
    named = Counter(path.stem for path in MODULES.values() if path.parent.name != "commands")
    assert {name for name, count in named.items() if count > 1} <= set(SHARED_NAMES)


@pytest.mark.parametrize("module", [module for module, path in MODULES.items() if path.stem == "__init__"])
def test_each_package_says_its_job(module: str) -> None:
    docstring = ast.get_docstring(ast.parse(MODULES[module].read_text(encoding="utf-8")))
    assert docstring is not None
    assert len(docstring.splitlines()[0].split()) >= 5


def in_earnest(source: str) -> str:
    """The source without its imports for types only."""
    tree = ast.parse(source)
    tree.body = [
        node for node in tree.body if not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test))
    ]
    return ast.unparse(tree)


def test_no_module_needs_itself_by_way_of_others() -> None:
    sources = {module: in_earnest(path.read_text(encoding="utf-8")) for module, path in MODULES.items()}
    needs = {module: set(imports(source)) & set(MODULES) for module, source in sources.items()}
    graphlib.TopologicalSorter(needs).prepare()  # which raises CycleError, with the circle


@pytest.mark.parametrize("module", [module for module in MODULES if not speaks_ros(module)])
def test_only_nodes_and_their_plumbing_import_ros(module: str) -> None:
    assert of_ros(MODULES[module].read_text(encoding="utf-8")) == []


WITHOUT_ROS = f"""
import importlib, re, sys

class NoRos:
    def find_spec(self, name, path=None, target=None):
        if re.compile({ROS.pattern!r}).fullmatch(name.partition(".")[0]):
            raise ModuleNotFoundError(f"no ROS here: {{name}}", name=name)

sys.meta_path.insert(0, NoRos())
for module in sys.argv[1:]:
    importlib.import_module(module)
"""


def without_ros(*modules: str) -> subprocess.CompletedProcess[str]:
    """Import modules in a process in which ROS cannot be imported."""
    command = [sys.executable, "-c", WITHOUT_ROS, *modules]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_everything_else_can_be_imported_where_there_is_no_ros() -> None:
    done = without_ros(*(module for module in MODULES if not speaks_ros(module)))
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("module", ["agv_plant.plant_node", "agv_analysis.runtime.runner"])
def test_that_process_has_no_ros_indeed(module: str) -> None:
    done = without_ros(module)
    assert done.returncode == 1
    assert "no ROS here" in done.stderr
