"""Compiled or not, the same numbers to the last bit; and nothing stale is ever run."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from agv_analysis.compiled.functions import compiled
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.simulation.loop import RunInputs, at_rest, history, statistics, statistics_of_two
from agv_analysis.simulation.single import settings_of
from agv_plant.parameters import ChannelParameters
from agv_plant.radio.channel import losses

ROOT = Path(__file__).parents[3]
PAPER = str(ROOT / "config" / "paper.yaml")

SCENARIOS = {
    "the paper": (),
    "arc, limited": ("plant.integration=arc", "controller.v_max=6.0"),
    "both links lossy": (
        "relay.uplink.model=bernoulli", "relay.uplink.p=0.4", "relay.downlink.model=burst", "relay.downlink.n=3",
    ),
    "wild": ("relay.uplink.model=burst", "relay.uplink.n=30", "controller.kx=250.0"),
}  # fmt: skip


def in_another_process(code: str, cache: Path, *arguments: str) -> str:
    environment = {
        **{name: value for name, value in os.environ.items() if not name.startswith(("NUMBA", "_ROS_WHEELS"))},
        "XDG_CACHE_HOME": str(cache),
        "PYTHONPATH": str(ROOT),
    }
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("settings", SCENARIOS.values(), ids=SCENARIOS)
def test_compiled_and_plain_agree_to_the_last_bit(settings: tuple[str, ...]) -> None:
    pytest.importorskip("numba")
    run = simulate(load_scenario(PAPER, [*settings, "plant.duration=20.0"]))
    steps = len(run)
    start, numbers = at_rest(*run.scenario.plant.initial_pose), settings_of(run.scenario)
    reference = run.reference.tolist()
    plain = RunInputs(run.lost.tolist(), run.downlink_lost.tolist(), start, numbers)
    fast = RunInputs(run.lost, run.downlink_lost, start, numbers)
    rows, n_ul = np.empty((steps, 8)), np.empty(steps, dtype=np.int64)
    assert history(reference, plain, rows, n_ul) == steps
    assert rows.tobytes() == np.hstack([run.pose, run.error, run.command]).tobytes()
    assert n_ul.tolist() == run.n_ul.tolist()
    squares, others, more = np.zeros((3, steps))
    assert statistics(reference, plain, squares) == compiled(statistics)(run.reference, fast, others)
    assert squares.tobytes() == others.tobytes()
    slower = fast._replace(settings=numbers._replace(gains=(5.0, *numbers.gains[1:])))
    both = compiled(statistics_of_two)(run.reference, fast, slower, others, more)
    one, other = (compiled(statistics)(run.reference, inputs, squares) for inputs in (fast, slower))
    assert both == (one, other)
    assert squares.tobytes() == more.tobytes() != others.tobytes()


WITHOUT_NUMBA = """
import sys
sys.modules["numba"] = None
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate, simulate_batch
scenario = load_scenario(sys.argv[1], sys.argv[2:])
run = simulate(scenario)
print(run.pose.tobytes().hex(), run.error.tobytes().hex(), simulate_batch([scenario], [5]).tobytes().hex())
"""


def test_without_numba_everything_runs_as_it_is(tmp_path: Path) -> None:
    from agv_analysis.simulation import STATISTICS, simulate_batch

    settings = (*SCENARIOS["both links lossy"], "plant.duration=2.0")
    scenario = load_scenario(PAPER, settings)
    run = simulate(scenario)
    *single, many = in_another_process(WITHOUT_NUMBA, tmp_path, PAPER, *settings).split()
    assert single == [run.pose.tobytes().hex(), run.error.tobytes().hex()]
    table = np.frombuffer(bytes.fromhex(many), dtype=STATISTICS)  # side by side with numba, with another sine
    for name, found in zip(STATISTICS.names or (), simulate_batch([scenario], [5])[0, 0], strict=True):
        np.testing.assert_allclose(table[name], found, rtol=1e-9, atol=1e-9)


CALL = """
import sys
sys.path.insert(0, sys.argv[1])
import outer
from agv_analysis.compiled.functions import compiled
print(compiled(outer.outer)(2.0))
"""


def test_a_change_in_any_file_or_constant_is_seen_in_spite_of_the_cache(tmp_path: Path) -> None:
    config = pytest.importorskip("numba").config
    folder, cache = tmp_path / "code", tmp_path / "cache"
    folder.mkdir()
    (folder / "outer.py").write_text(
        "from inner import inner\nfrom constants import FACTOR\ndef outer(x):\n    return FACTOR * inner(x)\n"
    )
    (folder / "inner.py").write_text("def inner(x):\n    return x + 1.0\n")
    (folder / "constants.py").write_text("FACTOR = 10.0\n")
    assert in_another_process(CALL, cache, str(folder)) == "30.0\n"
    assert list(cache.rglob("*.nbc")), "nothing was kept"
    kept = sorted(cache.rglob("*.nbc"))
    assert in_another_process(CALL, cache, str(folder)) == "30.0\n"
    assert sorted(cache.rglob("*.nbc")) == kept, "what was kept was not found again"
    if hasattr(config, "CACHE_LOCATOR_CLASSES"):
        shutil.copytree(folder, tmp_path / "copy")
        assert in_another_process(CALL, cache, str(tmp_path / "copy")) == "30.0\n"
        assert sorted(cache.rglob("*.nbc")) == kept, "the same code in another place was compiled again"
    (folder / "inner.py").write_text("def inner(x):\n    return x + 2.0\n")
    assert in_another_process(CALL, cache, str(folder)) == "40.0\n"
    (folder / "constants.py").write_text("FACTOR = 100.0\n")
    assert in_another_process(CALL, cache, str(folder)) == "400.0\n"


def shared(x: float) -> float:
    return 2.0 * x


def first(x: float) -> float:
    return shared(x) + 1.0


def second(x: float) -> float:
    return shared(x) - first(x)


def both(x: float) -> float:
    return first(x) * second(x) + shared(x)


def test_a_function_that_several_call_is_compiled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    event = pytest.importorskip("numba.core.event")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))  # where nothing is kept yet
    with event.install_recorder("numba:compile") as recorder:
        assert compiled(both)(3.0) == both(3.0) == -1.0
    names = [entry.data["dispatcher"].py_func.__name__ for _, entry in recorder.buffer if entry.is_start]
    assert sorted(name for name in names if name in ("both", "first", "second", "shared")) == [
        "both", "first", "second", "shared",
    ]  # fmt: skip


LOST = """
import sys
from agv_analysis.simulation.channel_outcomes import ChannelRealisation
from agv_plant.parameters import ChannelParameters
channel = ChannelParameters(model=sys.argv[1], p=0.5, r=0.5, n=2)
print(*ChannelRealisation(3, 40).outcomes(channel, "uplink").astype(int), sep="")
"""


def test_what_is_kept_of_one_channel_model_is_not_taken_for_another(tmp_path: Path) -> None:
    """All of them run through one loop, whose code does not say which model is in it."""
    pytest.importorskip("numba")
    models = ("bernoulli", "burst", "gilbert_elliott")
    found = [in_another_process(LOST, tmp_path, model) for model in models]
    kept = sorted(tmp_path.rglob("*.nbc"))
    assert found[1] == f"0{'110' * 13}\n"
    for model, outcomes in zip(models, found, strict=True):
        expected = losses(ChannelParameters(model=model, p=0.5, r=0.5, n=2), 3, "uplink", 40)
        assert outcomes == "".join(map(str, expected.astype(int))) + "\n"
    assert [in_another_process(LOST, tmp_path, model) for model in models] == found
    assert sorted(tmp_path.rglob("*.nbc")) == kept, "what was kept was not found again"


def test_where_nothing_can_be_kept_it_is_compiled_each_time(tmp_path: Path) -> None:
    pytest.importorskip("numba")
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "outer.py").write_text("def outer(x):\n    return 3.0 * x\n")
    assert in_another_process(CALL, tmp_path / "file" / "cache", str(tmp_path)) == "6.0\n"


def test_of_several_processes_one_compiles_and_the_others_load(tmp_path: Path) -> None:
    """All wait for a line before they call a function for the first time; numba counts what its cache had."""
    pytest.importorskip("numba")
    code = (
        "import sys, numpy as np\n"
        "from agv_analysis.compiled.functions import compiled\n"
        "from agv_analysis.stability.products import multiply\n"
        "one = np.eye(3)\n"
        "print('ready', flush=True)\n"
        "sys.stdin.readline()\n"
        "function = compiled(multiply)\n"
        "function(one, one, False, one.copy(), False)\n"
        "print(sum(function.stats.cache_hits.values()), sum(function.stats.cache_misses.values()))\n"
    )
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": str(ROOT)}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": environment}
    processes = [subprocess.Popen([sys.executable, "-c", code], **pipes) for _ in range(3)]  # type: ignore[call-overload]
    try:
        for process in processes:
            assert process.stdout.readline() == "ready\n"
        for process in processes:
            process.stdin.write("go\n")
            process.stdin.flush()
        said = sorted(process.communicate()[0] for process in processes)
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert said == ["0 1\n", "1 0\n", "1 0\n"]
