"""What is imported is declared: by setup.py for pip, by package.xml for a machine with ROS; and extras are optional."""

from __future__ import annotations

import ast
import functools
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path

import pytest

from agv_analysis.doctor.extras import extra_with, requirements
from agv_analysis.runtime.executables import NODE_MODULES

REPOSITORY = Path(__file__).parents[1]
OURS = {"agv_ros", "agv_plant", "agv_cloud", "agv_analysis", "agv_ncs"}
ROS = re.compile(r"rclpy|launch(_ros)?|.*_msgs|.*_interfaces")
DISTRIBUTION = {"yaml": "pyyaml", "foxglove": "foxglove-sdk"}
"""Where a package is imported by another name than pip's."""

FOR_PEOPLE = {"bags", "report", "explore", "cluster", "parquet", "captures", "irtt", "foxglove"}

HAS_KEY = {"flask", "jinja2", "matplotlib"}
"""Packages of extras with a key in rosdep's index; flask brings werkzeug."""

NEEDED_BY_OTHERS = {"setuptools": "colcon builds by it"}

ROOMS = {
    "bags": ("agv_analysis/bags/",),
    "report": ("agv_analysis/report/", "agv_analysis/reproduce/", "agv_analysis/sweep/", "agv_analysis/link/"),
    "explore": ("agv_analysis/explore/", "agv_analysis/watch/"),
    "cluster": ("agv_analysis/sweep/execute.py",),
    "parquet": ("agv_analysis/sweep/rows_file.py", "agv_analysis/bags/export.py"),
    "captures": ("agv_analysis/link/formats/capture_packets.py",),
    "irtt": ("agv_analysis/link/formats/irtt_json.py",),
    "foxglove": ("agv_analysis/watch/foxglove_server.py",),
}
"""Where the packages of each extra may be imported."""


def imported(source: str) -> Iterator[str]:
    """Top-level names of what a source imports, by statement or by `import_module("...")`."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module.partition(".")[0]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "_needed")):
            yield from (
                str(named.value).partition(".")[0] for named in node.args[:1] if isinstance(named, ast.Constant)
            )


@functools.cache
def third_party() -> list[tuple[str, str]]:
    """Files of the package, each with what it imports of others."""
    return list(_third_party())


def _third_party() -> Iterator[tuple[str, str]]:
    for folder in (*OURS, "launch"):
        for path in (REPOSITORY / folder).rglob("*.py"):
            for name in set(imported(path.read_text(encoding="utf-8"))) - OURS - sys.stdlib_module_names:
                yield path.relative_to(REPOSITORY).as_posix(), DISTRIBUTION.get(name, name)


NEEDED = {extra: {one.name for one in packages} for extra, packages in requirements().items()}


def test_the_check_sees_every_way_of_importing() -> None:
    source = "import a.b\ndef f():\n  from c.d import e\n  importlib.import_module('g.h')\n"
    assert set(imported(source)) == {"a", "c", "g"}


def test_the_installed_metadata_is_that_of_setup_py() -> None:
    assert FOR_PEOPLE | {"all", "ros", "site", "test", ""} == set(NEEDED)
    text = (REPOSITORY / "setup.py").read_text(encoding="utf-8")
    assert [name for name in NEEDED[""] if f'"{name}' not in text] == []


def test_each_import_is_needed_always_or_by_the_extra_of_its_room() -> None:
    undeclared = [
        (path, name)
        for path, name in third_party()
        if not ROS.fullmatch(name)
        and name not in NEEDED[""]
        and not any(name in NEEDED[extra] and path.startswith(rooms) for extra, rooms in ROOMS.items())
    ]
    assert undeclared == []


def test_nothing_is_declared_that_is_not_imported() -> None:
    used = {name for _, name in third_party()} | set(NEEDED_BY_OTHERS)
    assert {extra: names for extra in ("", *FOR_PEOPLE) if (names := NEEDED[extra] - used)} == {}


def test_all_is_what_the_extras_for_people_bring_and_test_has_all() -> None:
    assert NEEDED["all"] == set().union(*(NEEDED[extra] for extra in FOR_PEOPLE))
    assert NEEDED["all"] <= NEEDED["test"]
    assert not NEEDED["ros"] & NEEDED["all"]


def test_package_xml_names_what_is_imported_and_has_a_debian_package() -> None:
    """Keys that were looked up in the public index of rosdep and ROS Jazzy; what has none is optional."""
    root = ET.parse(REPOSITORY / "package.xml").getroot()
    named = {element.text for element in root.iter("exec_depend")}
    used = {name for _, name in third_party()}
    of_ros = {name for name in used if ROS.fullmatch(name)}
    keys = {f"python3-{name.removeprefix('py')}" for name in (NEEDED[""] | HAS_KEY) - {"packaging"}}
    assert of_ros <= named
    assert keys | {"python3-packaging"} <= named
    comment = (REPOSITORY / "package.xml").read_text(encoding="utf-8")
    assert [name for name in NEEDED["all"] - HAS_KEY - {"werkzeug"} if name not in comment] == []


WITHOUT = """
import sys

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {hidden}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Hidden())
from agv_analysis.cli import main
main(sys.argv[1:])
"""


def without_extras(*arguments: str) -> subprocess.CompletedProcess[str]:
    """A command of agv-ncs in a process in which nothing that an extra brings can be imported."""
    program = WITHOUT.format(hidden=sorted(NEEDED["all"]))
    return subprocess.run(
        [sys.executable, "-c", program, *arguments], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )


SIMULATE = ("simulate", "config/outages.yaml", "--set", "plant.duration=1.0", "--figures", "{}/figures")


@pytest.mark.parametrize(
    ("arguments", "said", "package", "extra"),
    [(("bag", "info", "bags/sample"), "", "zstandard", "bags"), (SIMULATE, "Verdict", "matplotlib", "report")],
)
def test_without_extras_the_loop_is_judged_and_what_needs_one_says_which(
    arguments: tuple[str, ...], said: str, package: str, extra: str, tmp_path: Path
) -> None:
    done = without_extras(*(word.replace("{}", str(tmp_path)) for word in arguments))
    assert done.returncode == 1, done.stdout
    assert "Traceback" not in done.stderr
    assert said in done.stdout
    assert package in done.stdout + done.stderr
    assert f"agv_ncs[{extra}]" in done.stdout + done.stderr
    assert extra_with(package) == extra


def test_a_bag_is_not_begun_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from agv_analysis.bags.writer import BagWriter
    from agv_ros.errors import UserError

    for name in ("mcap", "mcap.data_stream", "mcap.opcode", "mcap.records", "mcap.stream_reader"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "agv_analysis.bags.mcap_output", raising=False)
    with pytest.raises(UserError, match=r"agv_ncs\[bags\]"):
        BagWriter(tmp_path / "bag", [], {}, by_stamp=True)
    assert not (tmp_path / "bag").exists()


def test_pip_users_start_nodes_by_the_one_command(agv_ncs: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    status, said = agv_ncs("node", "plant", "--ros-args", "-p", "ts:=-1.0")
    assert status == 1
    assert "ts" in said
    assert "Traceback" not in said


def test_help_of_a_node_is_the_nodes(agv_ncs: Callable[..., tuple[int, str]]) -> None:
    status, said = agv_ncs("node", "link_emulator", "--help")
    assert (status, said.splitlines()[0]) == (
        0, "link_emulator: A radio link for topics of any type: loses, delays or doubles their messages, reproducibly.",
    )  # fmt: skip


@pytest.mark.parametrize("name", NODE_MODULES)
def test_old_names_stand_for_one_more_release_and_say_so(name: str, tmp_path: Path) -> None:
    point = next(one for one in metadata.entry_points(group="console_scripts") if one.name == name)
    assert point.value == f"agv_analysis.runtime.executables:{name}"
    for folder, noted in (("bin", True), ("lib/agv_ncs", False)):
        program = f"import sys; sys.argv = [{str(tmp_path / folder / name)!r}]\n" + WITHOUT_NODE.format(name=name)
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
        assert ("agv-ncs node" in done.stderr) is noted
        assert done.stdout == f"ran {NODE_MODULES[name]}\n"


WITHOUT_NODE = """
from agv_analysis.runtime import executables
executables.run_node_of = lambda name: print("ran", executables.NODE_MODULES[name])
executables.{name}()
"""
