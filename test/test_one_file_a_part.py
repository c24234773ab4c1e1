"""README's promise, counted: a law, vehicle, policy, channel with memory or criterion of our own is one new file.

Each is put into a copy of the sources, as one file and nothing else, and has to be there wherever such parts are shown.
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from test.conftest import AgvNcs

Command = Callable[..., str]

REPOSITORY = Path(__file__).parents[1]
SOURCES = ("agv_ros", "agv_plant", "agv_cloud", "agv_analysis", "agv_ncs")

PARTS = {
    "law": (
        "agv_cloud/control/gentle.py",
        """
from __future__ import annotations
from typing import Annotated
from agv_ros.parts import Quantity

def gentle(x_e: float, y_e: float, theta_e: float, v_r: float, w_r: float,
           k: Annotated[float, Quantity("gain of everything", "1/s", low=0.0, high=9.0)] = 2.0) -> tuple[float, float]:
    return v_r + k * x_e, w_r + k * (y_e + theta_e)
""",
        ("controller.law=gentle", "controller.gentle.k=1.5"),
        "`gentle.k`",
    ),
    "vehicle": (
        "agv_plant/vehicle/sluggish.py",
        """
from __future__ import annotations
import math
from typing import Annotated
from agv_ros.parts import Quantity

def sluggish(x: float, y: float, theta: float, turn: float, v: float, w: float, dt: float,
             lag: Annotated[float, Quantity("time constant of the turn", "s", above=0.0)] = 0.1,
             ) -> tuple[float, float, float, float]:
    turn = turn + (1.0 - math.exp(-dt / lag)) * (w - turn)
    return x + dt * v * math.cos(theta), y + dt * v * math.sin(theta), theta + dt * turn, turn
""",
        ("plant.vehicle=sluggish", "plant.sluggish.lag=0.05"),
        "`sluggish.lag`",
    ),
    "policy": (
        "agv_cloud/staleness/drift.py",
        """
from __future__ import annotations
import math
from typing import Any

def drift(held: Any, target: Any, reference: Any, ts: float, share: float = 1.0) -> Any:
    v = share * reference.v
    there = held.x + ts * v * math.cos(held.theta), held.y + ts * v * math.sin(held.theta), held.theta
    return there, (reference.x, reference.y, reference.theta)
""",
        ("error_detector.policy=drift", "error_detector.drift.share=0.9"),
        "`drift.share`",
    ),
    "channel": (
        "agv_plant/channels/sticky.py",
        '''
from __future__ import annotations
from typing import Any

def model(c: Any, k: int, u: Any, state: int) -> tuple[bool, int]:
    """After a loss the next two slots are lost as well."""
    if state > 0:
        return True, state - 1
    return (True, 2) if u[0] < c.p else (False, 0)
''',
        ("relay.uplink.model=sticky", "relay.uplink.p=0.05"),
        "sticky",
    ),
}

CRITERION = '''
"""Is the AGV slower than a walker?"""
from __future__ import annotations
import numpy as np
from agv_analysis.stability.criteria.criterion import Border, Criterion, Judgement, MapColumn, Margin

def _judge(facts):
    top = float(np.abs(facts.run.reference[:, 3]).max())
    return Judgement("Slower than a walker", top < 1.6, f"at most {top:g} m/s", {"walker_top_speed": top})

def _margins(facts):
    yield Margin("walker.speed", "Walker\\'s speed", 1.6, "1.6 m/s")

CRITERION = Criterion(
    key="walker", order=90, title="A walker", asks="Is it slower than a walker?", assumes="Nothing.",
    judge=_judge, margins=_margins, margin_names=(("walker.speed", "Walker\\'s speed"),),
    at_once=lambda facts: [("Walker at once", "1.6 m/s")],
    border=Border("walker", lambda scenario: scenario.controller.kx - 30.0),
    map_column=MapColumn("n_walker", "walker", lambda points: np.full(len(points), 7), lambda loop: 7),
)
'''

PLACES = """
import sys
from agv_analysis.explore.background_criteria import criteria_rows
from agv_analysis.explore.response import summary_rows
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.sweep.borders import border_places
from agv_analysis.sweep.plan import parse_axis
scenario = load_scenario("config/paper.yaml", ["plant.duration=2.0", "error_detector.track=line"])
assert dict(summary_rows(simulate(scenario)))["Walker at once"] == "1.6 m/s"
assert dict(criteria_rows(scenario))["Walker's speed"] == "1.6 m/s"
assert 29.0 < border_places(scenario, parse_axis("controller.kx=10:50:9"))["walker"][0] < 31.0
"""


@pytest.fixture(scope="module")
def copied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the sources."""
    folder = tmp_path_factory.mktemp("sources")
    for name in (*SOURCES, "config"):
        shutil.copytree(REPOSITORY / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


def environment_of(folder: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(folder), "COLUMNS": "200"}


def python(folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder, env=environment_of(folder), capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture
def command(copied: Path, agv_ncs: AgvNcs) -> Command:
    """Output of a command with the copy as it is when the test's first one is run; it must succeed."""

    def run(*arguments: str) -> str:
        status, said = agv_ncs(*arguments, env=environment_of(copied))
        assert status == 0, said
        return said

    return run


@pytest.mark.no_cover
@pytest.mark.parametrize("kind", PARTS)
def test_one_new_file_is_a_part(copied: Path, command: Command, kind: str, tmp_path: Path) -> None:
    file, source, settings, listed = PARTS[kind]
    assert not (copied / file).exists()
    (copied / file).write_text(source)
    try:
        assert listed in command("parameters")
        chosen = [word for setting in settings for word in ("--set", setting)]
        lossy = () if kind == "channel" else ("--set", "relay.uplink.model=bernoulli", "--set", "relay.uplink.p=0.2")
        out = tmp_path / "run.json"
        command("simulate", "config/paper.yaml", *lossy, *chosen, "--set", "plant.duration=2.0", "--json", str(out))
        found = json.loads(out.read_text())
        assert found["steps"] == 400
        assert found["loss_rate"] > 0.0
        assert found["lifted_radius"] > 0.0
    finally:
        (copied / file).unlink()


@pytest.mark.no_cover
def test_one_new_file_is_a_criterion(copied: Path, command: Command, tmp_path: Path) -> None:
    """Terminal, JSON, report, explorer, sweep's border, map and margins show it."""
    file = copied / "agv_analysis/stability/criteria/walker.py"
    file.write_text(CRITERION)
    out, page, table = tmp_path / "found.json", tmp_path / "report.html", tmp_path / "map.csv"
    line = ("config/paper.yaml", "--set", "error_detector.track=line")
    short = ("--set", "plant.duration=2.0")
    try:
        said = command("simulate", *line, *short, "--json", str(out), "--report", str(page))
        assert "Slower than a walker" in said
        assert json.loads(out.read_text())["walker_top_speed"] == 1.0
        assert "Slower than a walker" in page.read_text()
        assert "Walker&#39;s speed" in page.read_text()
        said = command("stability", *line, *short, "--json", str(out))
        assert "Walker's speed" in said
        assert json.loads(out.read_text())["walker"] == {"speed": 1.6}
        command(
            "stability", *line, "--map", "kx,ts", "--points", "2", "--csv", str(table),
            "--picture", str(tmp_path / "map.png"),
        )  # fmt: skip
        assert {row["n_walker"] for row in csv.DictReader(table.open())} == {"7"}
        python(copied, "-c", PLACES)
    finally:
        file.unlink()


@pytest.mark.no_cover
def test_a_law_that_was_edited_is_judged_as_it_is(copied: Path, tmp_path: Path) -> None:
    """With twice the gain in its code, the law at K_x = 25 has the margins of K_x = 50; with its sign turned, none."""
    file, out = copied / "agv_cloud/control/kanayama.py", tmp_path / "found.json"
    as_it_was = file.read_text()
    line = (
        "config/paper.yaml",
        "--set",
        "error_detector.track=line",
        "--set",
        "plant.duration=20.0",
        "--json",
        str(out),
    )

    def found(*arguments: str) -> Any:
        python(copied, "-m", "agv_analysis.cli", *arguments)
        return json.loads(out.read_text())

    assert "+ kx * x_e" in as_it_was
    try:
        file.write_text(as_it_was.replace("+ kx * x_e", "+ 2.0 * kx * x_e"))
        edited = found("stability", *line)["n_max"]
        assert edited["lifted"] == 5  # a = 0.25 < 2 sin(pi / (2 (2n + 1))), 0.2846 at n = 5 and 0.2411 at n = 6
        assert edited["bursts"] == 6  # (n + 1) a < 2
        assert edited["paper"] is None  # eq. 21 is of another law
        file.write_text(as_it_was.replace("+ kx * x_e", "- kx * x_e"))
        assert found("simulate", *line)["verdict"] not in ("asymptotic", "mean-square", "bounded")
    finally:
        file.write_text(as_it_was)
