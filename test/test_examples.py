"""The examples run where there is no ROS, each in a process of its own, and write what they say they write."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

REPOSITORY = Path(__file__).parents[1]
NOTEBOOK = REPOSITORY / "examples/first_steps.ipynb"

WRITTEN = {
    "own_control_law": {"own_control_law.png"},
    "own_channel": {"own_channel.png"},
    "sweep_to_figure": {"sweep.png", "sweep.csv"},
    "bag_to_arrays": {"bag_to_arrays.png", "bag_to_arrays.npz", "bag_to_arrays.json"},
    "robot_bag_to_verdict": {"robot", "robot.yaml", "robot.html"},
}

RUN_SCRIPT = """
import runpy
runpy.run_path(sys.argv[0], run_name="__main__")
"""

RUN_NOTEBOOK = """
import json
shown = {"__name__": "__main__"}
for cell in json.load(open(sys.argv[0], encoding="utf-8"))["cells"]:
    if cell["cell_type"] == "code":
        exec(compile("".join(cell["source"]), f"<{cell['id']}>", "exec"), shown)
"""
"""The cells of code in their order, in one fresh interpreter, as a kernel runs them."""

Code = Callable[..., str]


def run(without_ros: Code, name: str, out: Path) -> str:
    """Run an example from elsewhere than the repository; gives what it printed."""
    return without_ros(RUN_SCRIPT, REPOSITORY / "examples" / f"{name}.py", "--out", out, cwd=out)


def test_every_example_is_run_here() -> None:
    assert {path.stem for path in (REPOSITORY / "examples").glob("*.py")} == set(WRITTEN)
    assert [path.name for path in (REPOSITORY / "examples").glob("*.ipynb")] == [NOTEBOOK.name]
    page = (REPOSITORY / "docs/python_api.md").read_text(encoding="utf-8")
    named = set(re.findall(r"\(\.\./examples/([\w.]+)\)", page))
    assert named == {path.name for path in (REPOSITORY / "examples").glob("*.*")}


@pytest.mark.no_cover
@pytest.mark.parametrize("name", WRITTEN)
def test_an_example_writes_what_it_says(name: str, without_ros: Code, tmp_path: Path) -> None:
    said = run(without_ros, name, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == WRITTEN[name]
    for file in map(tmp_path.joinpath, WRITTEN[name]):
        assert file.is_dir() or file.stat().st_size > 0
    for file in tmp_path.glob("*.json"):
        assert json.loads(file.read_text(encoding="utf-8"))["steps"] > 0
    if name == "own_channel":
        check_limit(said)


def check_limit(said: str) -> None:
    """Up to the guaranteed limit no run is unstable, and not far beyond it all are."""
    unstable = {int(ms): int(count) for ms, count in re.findall(r"of (\d+) ms: (\d+) of", said)}
    limit = re.search(r"up to \d+ slots \((\d+) ms\)", said)
    assert limit is not None
    assert not any(count for ms, count in unstable.items() if ms <= int(limit[1]))
    assert unstable[max(unstable)] == 10


@pytest.mark.parametrize("name", WRITTEN)
def test_an_example_is_short(name: str) -> None:
    assert len((REPOSITORY / "examples" / f"{name}.py").read_text(encoding="utf-8").splitlines()) <= 60


def test_the_notebook_is_one_without_outputs() -> None:
    content: dict[str, Any] = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert (content["nbformat"], content["nbformat_minor"]) == (4, 5)
    ids = [cell["id"] for cell in content["cells"]]
    assert len(set(ids)) == len(ids)
    for cell in content["cells"]:
        assert cell["cell_type"] in ("code", "markdown")
        assert (cell.get("outputs", []), cell.get("execution_count")) == ([], None)


@pytest.mark.no_cover
def test_the_notebook_runs_from_its_first_cell_to_its_last(without_ros: Code) -> None:
    assert "slots are tolerated" in without_ros(RUN_NOTEBOOK, NOTEBOOK, cwd=NOTEBOOK.parent)
