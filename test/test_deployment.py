"""What is given for deployment and adoption holds: commands, parameters and links exist, ports are right."""

from __future__ import annotations

import getpass
import re
import shlex
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import click
import pytest
import yaml

from agv_analysis.cli import main
from agv_analysis.doctor.extras import requirements
from agv_analysis.doctor.network import ports
from agv_analysis.runtime.executables import NODE_MODULES
from agv_analysis.runtime.node_help import NODE_SCHEMAS
from agv_analysis.scenario import SCHEMAS
from agv_ros.parameters import parameters_of

REPOSITORY = Path(__file__).parents[1]
DEPLOYMENT = REPOSITORY / "deployment"
PAGES = [
    "SECURITY.md",
    "CODE_OF_CONDUCT.md",
    "QUALITY_DECLARATION.md",
    "docs/deployment.md",
    "docs/api_promise.md",
    "README.md",
]


def check_command(words: list[str]) -> None:
    """Fails if `agv-ncs` with these words is refused before it runs, or a parameter is not the node's."""
    context = click.Context(main)
    command = main.get_command(context, words[0])
    assert command is not None, words
    command.make_context(words[0], [*words[1:]])
    if words[0] == "node":
        known = parameters_of(NODE_SCHEMAS[words[1]])
        given = [word.partition(":=")[0] for word in words if ":=" in word]
        assert [name for name in given if name not in known] == []


def instructions(name: str) -> list[tuple[str, str]]:
    """Instructions of a Containerfile with what they say, lines that go on joined."""
    text = re.sub(r"\\\n", " ", (DEPLOYMENT / name).read_text())
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    return [(line.partition(" ")[0], line.partition(" ")[2]) for line in lines]


def test_a_wrong_command_is_seen() -> None:
    for words in (["node", "plane"], ["doctor", "--mend"]):
        with pytest.raises(click.UsageError):
            check_command(words)
    with pytest.raises(AssertionError, match="clocks"):
        check_command(["node", "plant", "--ros-args", "-p", "clocks:=realtime"])


def test_the_services_of_both_hosts_are_all_nodes_of_the_loop() -> None:
    services = yaml.safe_load((DEPLOYMENT / "compose.yaml").read_text())["services"]
    assert set(services) == set(SCHEMAS)
    for name, service in services.items():
        check_command(service["command"])
        assert service["command"][1] == name
        assert service["profiles"] == ["edge" if name in ("controller", "error_detector") else "agv"]
        assert service["security_opt"] == ["no-new-privileges:true"]


@pytest.mark.parametrize("name", ["Containerfile", "Containerfile.slim"])
def test_a_containerfile_builds_on_what_is_there(name: str) -> None:
    found = instructions(name)
    assert found[0][0] == "FROM"
    assert {kind for kind, _ in found} <= {"FROM", "COPY", "RUN", "USER", "WORKDIR", "ENTRYPOINT", "CMD"}
    assert ("USER", "loop") in found
    said = dict(found)
    for extra in re.findall(r"\[([a-z,]+)\]\"", " ".join(text for kind, text in found if kind == "RUN")):
        assert set(extra.split(",")) <= set(requirements())
    entry, command = (yaml.safe_load(said[kind]) for kind in ("ENTRYPOINT", "CMD"))
    if entry == ["agv-ncs"]:
        check_command(command)
    else:
        assert command[:3] == ["ros2", "launch", "agv_ncs"]
        assert (REPOSITORY / "launch" / command[3]).is_file()
        subprocess.run(["bash", "-n", "-c", entry[3]], check=True)


def test_the_image_on_ros_has_what_package_xml_names_of_python() -> None:
    named = {element.text for element in ET.parse(REPOSITORY / "package.xml").getroot().iter("exec_depend")}
    installed = set(" ".join(text for kind, text in instructions("Containerfile") if kind == "RUN").split())
    assert {name for name in named if str(name).startswith("python3-")} <= installed


@pytest.mark.parametrize("unit", sorted((DEPLOYMENT / "systemd").iterdir()), ids=lambda unit: unit.name)
def test_a_unit_starts_a_command_that_exists(unit: Path, tmp_path: Path) -> None:
    lines = [line.partition("=") for line in unit.read_text().splitlines() if "=" in line and not line.startswith("#")]
    said = {key: value for key, _, value in lines}
    assert said["NoNewPrivileges"] == "yes"
    words = shlex.split(said["ExecStart"])
    for node in NODE_MODULES if "%i" in said["ExecStart"] else ("",):
        check_command([word.replace("%i", node) for word in words[1:]])
    if shutil.which("systemd-analyze") is None:
        pytest.skip("needs systemd-analyze")
    for other in unit.parent.iterdir():
        text = other.read_text().replace(words[0], sys.executable).replace("User=agv_ncs", f"User={getpass.getuser()}")
        (tmp_path / other.name).write_text(text)
    name = unit.name.replace("@", "@plant")
    (tmp_path / unit.name).rename(tmp_path / name)
    done = subprocess.run(
        ["systemd-analyze", "verify", str(tmp_path / name)], capture_output=True, text=True, check=False
    )
    assert [line for line in done.stderr.splitlines() if "agv-ncs" in line] == []


def test_the_ports_of_the_page_are_those_of_dds() -> None:
    page = (REPOSITORY / "docs/deployment.md").read_text()
    rows = re.findall(r"^\| (\d+) \| (\d+)-(\d+) \| (\d+)-(\d+) \|$", page, re.MULTILINE)
    assert len(rows) == 3
    for domain, *among in rows:
        used = ports(int(domain), 10)
        assert [*map(int, among)] == [used[kind][end] for kind in ("multicast", "unicast") for end in (0, -1)]
    (rule,) = re.findall(r"udp dport (\d+)-(\d+)", page)
    assert (int(rule[0]), int(rule[1])) == (ports(42, 10)["multicast"][0], ports(42, 10)["unicast"][-1])


def test_the_commands_of_the_page_exist() -> None:
    page = (REPOSITORY / "docs/deployment.md").read_text()
    given = re.findall(r"^    agv-ncs (.+)$", page, re.MULTILINE)
    assert len(given) == 3
    for line in given:
        check_command(shlex.split(line))


@pytest.mark.parametrize("page", PAGES)
def test_each_link_leads_to_a_file(page: str) -> None:
    links = re.findall(r"\]\((?!https?:)([^)#]+)", (REPOSITORY / page).read_text())
    folder = (REPOSITORY / page).parent
    assert [link for link in links if not (folder / link).exists()] == []


def test_each_claim_of_quality_has_a_proof_or_is_missing() -> None:
    rows = re.findall(r"^\| \d\.\S.*$", (REPOSITORY / "QUALITY_DECLARATION.md").read_text(), re.MULTILINE)
    assert len(rows) >= 15
    assert [row for row in rows if "missing" not in row and "](" not in row] == []


@pytest.mark.parametrize("form", ["bug.yml", "question.yml"])
def test_who_reports_is_asked_for_doctor(form: str) -> None:
    asked: list[dict[str, Any]] = yaml.safe_load((REPOSITORY / ".github/ISSUE_TEMPLATE" / form).read_text())["body"]
    assert "doctor" in {one["id"] for one in asked}


def test_what_is_cited_is_this_version() -> None:
    cited = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())
    assert cited["version"] == ET.parse(REPOSITORY / "package.xml").findtext("version")
    assert cited["license"] == ET.parse(REPOSITORY / "package.xml").findtext("license")
    assert cited["preferred-citation"]["title"] in " ".join((REPOSITORY / "README.md").read_text().split())
