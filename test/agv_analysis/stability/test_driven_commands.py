"""Recorded commands against the control law: what was driven, from which step on, and no alarm where all is well.

Commands are made here by the laws' equations in numpy, not by the functions of the nodes.
"""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from numpy.typing import NDArray

from agv_analysis.run import Floats, ParameterChange, Run
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.stability.driven_commands import driven_commands, wrong_errors
from agv_cloud.control.registry import CONTROL_LAWS
from agv_cloud.staleness.registry import STALENESS_POLICIES

if TYPE_CHECKING:
    from test.conftest import Code

PAPER = str(Path(__file__).parents[3] / "config/paper.yaml")
STEPS = 400
LOSSY = ("relay.uplink.model=gilbert_elliott", "relay.uplink.p=0.1", "relay.uplink.r=0.2", "plant.duration=4.0")

Mask = NDArray[np.bool_]


def kanayama(run: Run, kx: float = 25.0, ky: float = 1.0, ktheta: float = 2.0) -> Floats:
    assert run.error_speeds is not None
    (x_e, y_e, theta_e), (v_r, w_r) = run.error.T, run.error_speeds.T
    return np.column_stack([v_r * np.cos(theta_e) + kx * x_e, w_r + v_r * (ky * y_e + ktheta * np.sin(theta_e))])


def state_feedback(run: Run, kx: float, ky: float, ktheta: float) -> Floats:
    assert run.error_speeds is not None
    (x_e, y_e, theta_e), (v_r, w_r) = run.error.T, run.error_speeds.T
    return np.column_stack([v_r + kx * x_e, w_r + ky * y_e + ktheta * theta_e])


def limited(command: Floats, v_max: float) -> Floats:
    return np.column_stack([np.clip(command[:, 0], -v_max, v_max), command[:, 1]])


def recorded(*settings: str, seed: int = 1, scale: tuple[float, float, float] = (0.5, 0.4, 0.3)) -> Run:
    """A run with errors and speeds drawn at random, and Kanayama's commands to them under the paper's gains."""
    scenario = load_scenario(PAPER, [f"plant.duration={STEPS * 0.005}", *settings])
    draw = np.random.default_rng(seed)
    error, speeds = draw.normal(0.0, scale, (STEPS, 3)), draw.normal([1.0, 0.2], [0.3, 0.3], (STEPS, 2))
    run = dataclasses.replace(simulate(load_scenario(PAPER, [f"plant.duration={STEPS * 0.005}"])), scenario=scenario)
    run = dataclasses.replace(run, error=error, error_speeds=speeds)
    return dataclasses.replace(run, command=kanayama(run))


def sent(run: Run, command: Floats, rows: slice | Mask = slice(None)) -> Run:
    """The run with other commands in some of its steps."""
    commands = run.command.copy()
    commands[rows] = command[rows]
    return dataclasses.replace(run, command=commands)


def test_commands_of_the_law_do_not_differ() -> None:
    found = driven_commands(recorded())
    assert (found.compared, found.first, found.share, found.sentence, found.cannot_say) == (STEPS, None, 0.0, "", "")
    assert found.largest < 1e-12


@pytest.mark.parametrize(
    ("gains", "first", "words"),
    [
        ({"kx": 50.0}, 0, "K_x = 50.0, not 25.0"),
        ({"kx": 3.25}, 250, "K_x = 3.25, not 25.0"),
        ({"ky": 1.5}, 1, "K_y = 1.5, not 1.0"),
        ({"ktheta": 0.0}, 399, ""),
        ({"ky": 0.25, "ktheta": 7.0}, 100, "K_y = 0.25, not 1.0, K_theta = 7.0, not 2.0"),
        ({"kx": -25.0, "ky": -1.0, "ktheta": -2.0}, 30, "K_x = -25.0, not 25.0, K_y = -1.0, not 1.0, K_theta = -2.0"),
    ],
)
def test_gains_that_were_driven_are_named(gains: dict[str, float], first: int, words: str) -> None:
    run = recorded()
    found = driven_commands(sent(run, kanayama(run, **gains), slice(first, None)))
    assert found.first == first
    assert found.first_size == pytest.approx(np.abs(kanayama(run, **gains) - kanayama(run))[first].max(), rel=1e-12)
    assert found.share == (STEPS - first) / STEPS
    assert f"from step {first} ({first * 0.005:g} s) on" in found.sentence
    if words:
        assert words in found.sentence
        assert {name: pytest.approx(value, abs=1e-6) for name, value in gains.items()} == found.pieces[0].driven


@pytest.mark.parametrize("seed", range(5))
def test_random_gains_limits_and_steps(seed: int) -> None:
    draw, run = np.random.default_rng(seed), recorded(seed=seed)
    kx, ky, ktheta = draw.uniform(0.1, 80.0, 3)
    v_max, first = draw.uniform(1.2, 2.0), int(draw.integers(0, 300))
    found = driven_commands(sent(run, limited(kanayama(run, kx, ky, ktheta), v_max), slice(first, None)))
    assert found.first == first
    expected = {"kx": kx, "ky": ky, "ktheta": ktheta, "v_max": v_max}
    assert found.pieces[0].driven == {name: pytest.approx(value, abs=1e-6) for name, value in expected.items()}


def test_only_the_gains_that_errors_tell_are_named() -> None:
    """No error across the track, then an error across it that is always that of the heading's sine."""
    run = recorded(scale=(0.5, 0.0, 0.0))
    found = driven_commands(sent(run, kanayama(run, 30.0, 9.0, 9.0)))
    assert found.pieces[0].driven == {"kx": pytest.approx(30.0, abs=1e-6)}
    error = run.error.copy()
    error[:, 2] = np.random.default_rng(3).normal(0.0, 0.3, STEPS)
    error[:, 1] = 2.0 * np.sin(error[:, 2])
    run = dataclasses.replace(run, error=error)
    found = driven_commands(sent(run, kanayama(run, 25.0, 2.0, 2.0)))
    assert found.pieces[0].driven == {}
    assert "K_y and K_theta that these errors do not tell" in found.sentence


def test_without_errors_another_gain_cannot_be_seen() -> None:
    run = recorded(scale=(0.0, 0.0, 0.0))
    assert not driven_commands(sent(run, kanayama(run, 99.0, 9.0, 9.0))).differs


@pytest.mark.parametrize(
    ("driven", "told", "words"),
    [
        (0.8, ".inf", "v_max = 0.8 m/s, not none"),
        (6.0, "8.0", "v_max = 6.0 m/s, not 8.0 m/s"),
        (8.0, "6.0", "v_max = 8.0 m/s, not 6.0 m/s"),
        (math.inf, "6.0", "no v_max that shows, not 6.0 m/s"),
    ],
)
def test_another_limit_is_named(driven: float, told: str, words: str) -> None:
    run = recorded(f"controller.v_max={told}")
    found = driven_commands(sent(run, limited(kanayama(run), driven)))
    assert found.sentence.endswith(f"driven with {words}")


def test_a_turned_sign_and_a_scaled_speed_are_named() -> None:
    run = recorded()
    turned, scaled = run.command * [1.0, -1.0], run.command * [1.0, 1.1]
    assert driven_commands(sent(run, turned)).sentence.endswith("on: driven with the sign of w turned")
    assert driven_commands(sent(run, scaled)).sentence.endswith("on: driven with 1.1 times the law's w")


def test_gains_that_change_and_change_back() -> None:
    run = sent(recorded(), kanayama(recorded(), 50.0), slice(100, 200))
    found = driven_commands(sent(run, kanayama(run, 25.0, 4.0), slice(300, None)))
    assert [piece.k for piece in found.pieces] == [100, 200, 300]
    assert found.sentence.endswith(
        "from step 100 (0.5 s) on: driven with K_x = 50.0, not 25.0; from step 200 (1 s) on with these parameters; "
        "from step 300 (1.5 s) on with K_y = 4.0, not 1.0"
    )


def test_errors_too_small_to_tell_the_gains_do_not_say_that_the_own_ones_were_driven() -> None:
    small = recorded(scale=(6e-12, 5e-9, 5e-9))
    found = driven_commands(sent(small, kanayama(small, 250.0)))
    assert found.differs
    assert found.sentence.endswith("on, at errors so small that they do not tell which gains were driven")


def test_another_law_is_not_taken_for_kanayama_s() -> None:
    run = recorded()
    for command in (state_feedback(run, 2.0, 1.0, 2.0), np.random.default_rng(0).normal(size=(STEPS, 2))):
        found = driven_commands(sent(run, command))
        assert (found.first, found.pieces) == (0, ())
        assert found.sentence.endswith("on: no gains of kanayama explain these commands")
    run = dataclasses.replace(run, scenario=load_scenario(PAPER, ["controller.law=state_feedback"]))
    assert driven_commands(run).sentence.endswith("on: no gains of state_feedback explain these commands")


def test_gains_of_another_law_than_the_paper_s() -> None:
    run = dataclasses.replace(recorded(), scenario=load_scenario(PAPER, ["controller.law=state_feedback"]))
    found = driven_commands(sent(run, state_feedback(run, 2.0, 3.0, 4.0)))
    assert found.sentence.endswith("driven with k_y = 3.0, not 1.0, k_theta = 4.0, not 2.0")


def test_a_law_that_is_not_linear_in_its_parameters() -> None:
    """Pure pursuit, whose circle is no tighter than at the distance `closest`, has a kink there and a quotient."""
    settings = ("controller.law=pure_pursuit", "controller.look_ahead=0.3", "plant.duration=3.0")
    run = simulate(
        load_scenario(PAPER, [*settings, "controller.pure_pursuit.kx=3.0", "controller.pure_pursuit.closest=0.4"])
    )
    found = driven_commands(dataclasses.replace(run, scenario=load_scenario(PAPER, settings)))
    assert found.pieces[0].driven == {"kx": pytest.approx(3.0, abs=1e-6), "closest": pytest.approx(0.4, abs=1e-6)}


def test_a_command_of_somebody_else_is_no_gain() -> None:
    run = recorded()
    found = driven_commands(sent(run, run.command + 1.0, slice(70, 72)))
    assert (found.first, found.share) == (70, 2 / STEPS)
    assert found.sentence == (
        f"2 of {STEPS} commands are not those of the control law, the first at step 70 (0.35 s): did anything else "
        "publish commands?"
    )


def test_missing_errors_and_commands_and_such_as_are_not_finite_are_left_out() -> None:
    run = recorded()
    error, command = run.error.copy(), run.command.copy()
    error[5:9], command[20:30], command[40, 1] = math.nan, math.nan, math.inf
    found = driven_commands(dataclasses.replace(run, error=error, command=command))
    assert (found.differs, found.compared) == (False, STEPS - 4 - 10 - 1)


def test_a_change_that_the_run_knows_of_is_no_difference() -> None:
    run = recorded()
    changed = sent(run, limited(kanayama(run, 50.0), 3.0), slice(200, None))
    changed = sent(changed, kanayama(run, 50.0), slice(200, 300))
    known = (
        ParameterChange(200, "controller", "kx", 25.0, 50.0),
        ParameterChange(300, "controller", "v_max", math.inf, 3.0),
        ParameterChange(310, "relay", "uplink.p", 0.0, 0.5),
    )
    assert driven_commands(changed).first == 200
    assert not driven_commands(dataclasses.replace(changed, parameter_changes=known)).differs
    found = driven_commands(dataclasses.replace(changed, parameter_changes=known[:1]))
    assert [piece.words for piece in found.pieces] == ["v_max = 3.0 m/s, not none"]
    assert found.first is not None
    assert found.first >= 300
    # A change stamped by another clock may be some steps off.
    late = (dataclasses.replace(known[0], k=207), dataclasses.replace(known[1], k=295))
    assert not driven_commands(dataclasses.replace(changed, parameter_changes=late)).differs


def test_what_cannot_be_compared_is_said() -> None:
    run = recorded()
    silent = dataclasses.replace(run, error=np.full_like(run.error, math.nan))
    assert "no step has both an error and a command" in driven_commands(silent).cannot_say
    unknown = dataclasses.replace(run, gains_known=False)
    assert "gains are not known" in driven_commands(unknown).cannot_say
    for found in (driven_commands(silent), driven_commands(unknown)):
        assert (found.differs, found.compared, found.sentence) == (False, 0, "")


def test_json_has_no_infinity() -> None:
    run = recorded("controller.v_max=6.0")
    plain: dict[str, Any] = driven_commands(run).to_json()
    json.dumps(plain, allow_nan=False)
    assert plain["differs"] is True
    assert json.loads(json.dumps(plain))["pieces"][0]["words"].startswith("no v_max")


LAW_WITH_MEMORY = """
import dataclasses, math, sys
import numpy as np
import agv_ncs
from agv_analysis.stability.driven_commands import driven_commands

def integral(x_e, y_e, theta_e, v_r, w_r, ts, memory=(0.0,), kp=2.0, ki=0.5):
    s = memory[0] + ts * x_e
    return v_r * math.cos(theta_e) + kp * x_e + ki * s, w_r + v_r * (y_e + 2.0 * math.sin(theta_e)), (s,)

agv_ncs.register_control_law("integral", integral)
settings = ["controller.law=integral", "plant.duration=2.0", "relay.uplink.model=bernoulli", "relay.uplink.p=0.3"]
scenario = agv_ncs.load_scenario(sys.argv[0], settings)
run = agv_ncs.simulate(scenario)
print(driven_commands(run).sentence or "same")
other = scenario.with_settings(["controller.integral.ki=0.7"])
print(driven_commands(dataclasses.replace(run, scenario=other)).sentence)
error = run.error.copy()
error[300] = np.nan
gap = driven_commands(dataclasses.replace(run, error=error))
print(gap.compared, gap.sentence or "same", gap.cannot_say, sep="|")
print(driven_commands(dataclasses.replace(run, k=run.k + 10)).cannot_say)
"""


def test_a_law_that_remembers_is_checked_up_to_the_first_gap(without_ros: Code) -> None:
    assert without_ros(LAW_WITH_MEMORY, PAPER).splitlines() == [
        "same",
        "400 of 400 commands are not those of integral with these parameters, the first at step 0 (0 s)",
        "300|same|integral remembers, and steps are missing: its commands can only be checked before step 300",
        "integral remembers, and the recording begins at step 10: its commands cannot be checked",
    ]


# -- no false alarms ---------------------------------------------------------------------------------------------------

QUIET: dict[str, tuple[str, ...]] = {
    **{f"policy {name}": (*LOSSY, f"error_detector.policy={name}") for name in STALENESS_POLICIES.own},
    **{f"law {name}": (*LOSSY, f"controller.law={name}", "controller.look_ahead=0.3") for name in CONTROL_LAWS.own},
    "bicycle": (*LOSSY, "plant.vehicle=bicycle"),
    "noise": (*LOSSY, "plant.noise_xy=0.02", "plant.noise_theta=0.05", "error_detector.policy=predict"),
    "late, predicted": (*LOSSY, "relay.uplink.delay=0.02", "relay.uplink.jitter=0.03", "error_detector.policy=predict"),
    "limited": (*LOSSY, "controller.v_max=0.7", "relay.downlink.model=bernoulli", "relay.downlink.p=0.4"),
    "buffer": (
        *LOSSY, "plant.downlink_policy=buffer", "plant.plan_steps=5", "relay.downlink.model=burst",
        "relay.downlink.n=9",
    ),
    "zero": (*LOSSY, "plant.downlink_policy=zero", "relay.downlink.model=burst", "relay.downlink.n=4"),
    "diverges": ("controller.kx=1000.0", "plant.duration=20.0"),
    "another speed": (*LOSSY, "plant.speed_scale=1.3", "plant.lag=0.05"),
    "on the reference": ("plant.initial_pose=[0.0, 0.0, 1.5707963267948966]", "plant.duration=2.0"),
}  # fmt: skip


@pytest.mark.parametrize("settings", QUIET.values(), ids=QUIET)
def test_an_unchanged_run_gives_no_alarm(settings: tuple[str, ...]) -> None:
    run = simulate(load_scenario(PAPER, settings))
    found = driven_commands(run)
    assert (found.sentence, found.cannot_say) == ("", "")
    assert found.compared >= min(len(run), STEPS) - 1
    assert wrong_errors(run)[0] == 0


def test_errors_of_another_policy_and_another_track_are_counted() -> None:
    run = simulate(load_scenario(PAPER, [*LOSSY, "error_detector.policy=align"]))
    stale = int(np.count_nonzero(run.n_ul))
    held = dataclasses.replace(run, scenario=load_scenario(PAPER, LOSSY))
    assert wrong_errors(held) == (stale, len(run))
    elsewhere = load_scenario(PAPER, [*LOSSY, "error_detector.track=circle", "error_detector.policy=align"])
    assert wrong_errors(dataclasses.replace(run, scenario=elsewhere))[0] > len(run) // 2
