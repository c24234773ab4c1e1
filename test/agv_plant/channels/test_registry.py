"""A channel model of another package: the one of docs/channels.md, installed for real, in processes of their own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from agv_plant.channels.position_dependent import PLACED
from agv_plant.channels.registry import GROUP, MODELS, known_models
from agv_plant.random_stream import uniforms

REPOSITORY = Path(__file__).parents[3]
ARGUMENTS = (0.5, 20.0, 200.0)
CHANNEL = ("--set", "relay.uplink.model=roadworks", "--set", "relay.uplink.arguments=[0.5, 20.0, 200.0]")

SAME = """
from agv_analysis.simulation.channel_outcomes import ChannelRealisation
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import losses
channel = ChannelParameters(model="roadworks", arguments=(0.5, 20.0, 200.0))
found = losses(channel, 3, "uplink", 5000)
assert (ChannelRealisation(3, 5000).outcomes(channel, "uplink") == found).all()
print("".join(str(int(lost)) for lost in found))
"""


def block(mark: str) -> str:
    """The code between two marks of the page."""
    page = (REPOSITORY / "docs/channels.md").read_text(encoding="utf-8")
    found = re.search(rf"<!-- {mark}:begin -->\n```\w+\n(.*?)```\n<!-- {mark}:end -->", page, re.DOTALL)
    assert found
    return found.group(1)


def installed(folder: Path, name: str, code: str) -> Path:
    """A folder for PYTHONPATH with the page's package in it as pip leaves it, its model called `name`."""
    (group, value), = re.findall(r'entry-points\."(.*?)"\]\n\w+ = "(.*?)"', block("package"))  # fmt: skip
    assert group == GROUP
    (folder / "roadworks.py").write_text(code)
    information = folder / "roadworks-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: roadworks\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text(f"[{group}]\n{name} = {value}\n")
    return folder


@pytest.fixture
def package(tmp_path: Path) -> Path:
    return installed(tmp_path, "roadworks", block("model"))


def python(folder: Path, *arguments: str) -> tuple[int, str]:
    """Exit status and output of a process that has the package."""
    environment = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{REPOSITORY}", "COLUMNS": "200"}
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=REPOSITORY, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=300,
    )  # fmt: skip
    return done.returncode, done.stdout


def agv_ncs(folder: Path, *arguments: str) -> tuple[int, str]:
    return python(folder, "-m", "agv_analysis.cli", *arguments)


def expected(seed: int, slots: int) -> list[bool]:
    p, length, period = ARGUMENTS
    draws = uniforms(seed, "uplink", 0, slots)[:, 0].tolist()
    return [k > 0 and k % period < length and u < p for k, u in enumerate(draws)]


def test_nodes_and_simulation_have_its_outcomes(package: Path) -> None:
    code, said = python(package, "-c", SAME)
    assert code == 0, said
    assert said.strip() == "".join(str(int(lost)) for lost in expected(3, 5000))


def test_what_numba_does_not_compile_runs_as_it_is(tmp_path: Path) -> None:
    slow = block("model").replace("    return", "    open(__file__).close()\n    return")
    code, said = python(installed(tmp_path, "roadworks", slow), "-c", SAME)
    assert code == 0, said
    assert said.strip() == "".join(str(int(lost)) for lost in expected(3, 5000))


def test_a_recorded_run_of_the_nodes_meets_it(package: Path, tmp_path: Path) -> None:
    bag, outages = tmp_path / "bag", tmp_path / "outages.csv"
    run = ("run", "config/outages.yaml", *CHANNEL, "--set", "plant.duration=4.0", "--bag", str(bag))
    code, said = agv_ncs(package, *run)
    assert code == 0, said
    code, said = agv_ncs(package, "replay", str(bag), "--outages", str(outages))
    assert code == 0, said
    rows = outages.read_text().splitlines()[1:]
    assert [row.endswith(",1") for row in rows] == expected(1, len(rows))
    assert len(rows) == 800


def test_the_commands_know_it(package: Path) -> None:
    code, said = agv_ncs(package, "channel", "config/outages.yaml", *CHANNEL)
    assert code == 0, said
    assert "roadworks" in said
    code, said = agv_ncs(package, "simulate", "config/outages.yaml", *CHANNEL, "--set", "plant.duration=4.0")
    assert code == 0, said
    code, said = agv_ncs(package, "channel", "config/outages.yaml", "--set", "relay.uplink.model=rain")
    assert code == 1
    assert (
        "must be one of " + ", ".join((*MODELS, "trace", *PLACED[1:], "shared", "roadworks")) + ", got 'rain'" in said
    )


@pytest.mark.parametrize(
    ("name", "code", "settings", "complaint"),
    [
        ("roadworks", "import no_such_module", (), "roadworks:roadworks) cannot be loaded: No module named"),
        ("roadworks", "roadworks = 3", (), "roadworks:roadworks) must be a function, found 3"),
        ("roadworks", None, ("--set", "relay.uplink.arguments=[1.0]"), "channel model roadworks, slot 0: not enough"),
        ("burst", None, ("--set", "relay.uplink.model=burst"), "two channel models are called burst: that of agv_ncs"),
    ],
)
def test_a_model_that_cannot_be_used_is_one_line(
    tmp_path: Path, name: str, code: str | None, settings: tuple[str, ...], complaint: str
) -> None:
    folder = installed(tmp_path, name, block("model") if code is None else code)
    chosen = CHANNEL if name == "roadworks" else ()
    status, said = agv_ncs(folder, "channel", "config/outages.yaml", *chosen, *settings)
    assert status == 1
    assert complaint in said
    assert "Traceback" not in said


def test_without_such_packages_the_models_are_those_of_the_page() -> None:
    assert known_models() == (*MODELS, "trace", *PLACED[1:], "shared")
    page = (REPOSITORY / "docs/channels.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE) == list(known_models())
