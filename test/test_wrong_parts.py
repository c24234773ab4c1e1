"""Parts of another package that are wrong: refused in one line that names them, wherever they run; others go on."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from test.conftest import Install

AgvNcs = Callable[..., tuple[int, str]]

PAPER = "config/paper.yaml"
LAWS, VEHICLES, POLICIES = "agv_ncs.control_laws", "agv_ncs.vehicles", "agv_ncs.staleness_policies"
LAW = ("--set", "controller.law=mine")
SHORT = ("--set", "plant.duration=1.0")
FIRST = "x_e, y_e, theta_e, v_r, w_r"


def law(body: str, signature: str = FIRST) -> str:
    return f"import math\n\n\ndef mine({signature}):\n" + textwrap.indent(textwrap.dedent(body), "    ")


def refusal(found: tuple[int, str]) -> str:
    """What a command said that was refused: one line, at the end of what it said before."""
    status, said = found
    assert status == 1, said
    assert "Traceback" not in said
    return said.strip().splitlines()[-1]


@pytest.mark.parametrize(
    ("code", "settings", "said"),
    [
        (law("return 1 / 0, 0.0"), (), "control law mine (wrong:mine) raises ZeroDivisionError: division by zero"),
        (law("return math.nan, 0.0"), (), "control law mine (wrong:mine) must return finite numbers, got (nan, 0.0)"),
        (law("return 1.0, 2.0, 3.0"), (), "control law mine (wrong:mine) must return numbers, a tuple of v [m/s], w"),
        (
            law("return v_r, w_r", "x_e, y_e, theta_e, w_r, v_r"),
            (),
            f"its first arguments must be {FIRST}, found x_e, y_e, theta_e, w_r, v_r",
        ),
        (law("return v_r, w_r", f"{FIRST}, k"), (), "control law mine (wrong:mine): its parameter k needs a default"),
        (law("return v_r, w_r", f"{FIRST}, k=2"), (), "its parameter k must be a float, got 2: write 2.0"),
        (law("return v_r, w_r", f"{FIRST}, *args"), (), "argument args must be an ordinary one, found *args"),
        (
            "import no_such_module",
            (),
            "control law mine (wrong:mine) cannot be loaded: No module named 'no_such_module'",
        ),
        ("raise SystemExit(3)", (), "control law mine (wrong:mine) cannot be loaded: SystemExit: 3"),
        (
            law("return v_r * look_ahead, w_r", f"{FIRST}, look_ahead"),
            (),
            "control law mine (wrong:mine) looks ahead, but look_ahead is 0: set it to one period ts at least",
        ),
        (
            law("return v_r, w_r", f"{FIRST}, k: Annotated[float, Quantity('a', low=0.0, high=1.0)] = 0.5").replace(
                "import math", "from typing import Annotated\nfrom agv_ros.parts import Quantity"
            ),
            ("--set", "controller.mine.k=2.0"),
            "--set controller.mine.k=2.0: controller.mine.k must be in [0, 1], got 2.0",
        ),
        (
            law("return v_r, w_r", f"{FIRST}, k='a'"),
            ("--set", "controller.mine.k=2.0"),
            "--set controller.mine.k=2.0: controller has no parameter 'mine.k', control law mine (wrong:mine): its "
            "parameter k must be a float, got k='a'",
        ),
    ],
)
def test_a_law_that_is_wrong_is_refused_when_it_is_chosen_and_disturbs_no_other(
    install: Install, agv_ncs: AgvNcs, tmp_path: Path, code: str, settings: tuple[str, ...], said: str
) -> None:
    environment = install(tmp_path, {"wrong": code}, {LAWS: {"mine": "wrong:mine"}})
    assert said in refusal(agv_ncs("simulate", PAPER, *SHORT, *LAW, *settings, env=environment))
    status, found = agv_ncs("parameters", env=environment)
    assert (status, "control law state_feedback" in found) == (0, True), found


def test_names_that_are_taken_are_refused(install: Install, agv_ncs: AgvNcs, tmp_path: Path) -> None:
    good = law("return v_r, w_r", f"{FIRST}, k=1.0").replace("mine", "{}")
    code = "\n\n".join(good.format(name) for name in ("one", "other"))
    points = {LAWS: {"v_max": "laws:one", "state_feedback": "laws:one", "my-law": "laws:one", "mine": "laws:one"}}
    environment = install(tmp_path / "one", {"laws": code}, points)
    second = install(tmp_path / "two", {}, {LAWS: {"mine": "laws:other"}}, "second")
    environment["PYTHONPATH"] = f"{tmp_path / 'two'}:{environment['PYTHONPATH']}"
    assert second

    def said(name: str) -> str:
        return refusal(agv_ncs("simulate", PAPER, *SHORT, "--set", f"controller.law={name}", env=environment))

    assert "control law v_max (laws:one): its node has a parameter v_max, so none can be called so" in said("v_max")
    assert "two control laws are called state_feedback: that of agv_ncs and laws:one of another" in said(
        "state_feedback"
    )
    assert "control law my-law (laws:one): its name must be letters, digits and _" in said("my-law")
    assert "two control laws are called mine: laws:one of another package and laws:other of another" in said("mine")
    status, found = agv_ncs("parameters", env=environment)
    assert (status, "v_max.k" in found, "Traceback" in found) == (0, False, False)
    status, found = agv_ncs("simulate", PAPER, *SHORT, env=environment)
    assert status == 0, found
    params = tmp_path / "params.yaml"
    params.write_text("controller: {ros__parameters: {law: mine, mine: {k: 2.0}}}")
    assert "two control laws are called mine" in refusal(agv_ncs("simulate", params, *SHORT, env=environment))


def test_a_gain_out_of_its_bounds_in_a_params_file_is_refused(
    install: Install, agv_ncs: AgvNcs, tmp_path: Path, page_block: Callable[[str, str], str]
) -> None:
    environment = install(
        tmp_path, {"my_laws": page_block("control_laws.md", "law")}, {LAWS: {"aim": "my_laws:aim"}}
    )  # fmt: skip
    params = tmp_path / "params.yaml"
    params.write_text("controller: {ros__parameters: {law: aim, look_ahead: 0.5, aim: {k: -1.0}}}")
    said = refusal(agv_ncs("simulate", params, env=environment))
    assert said.endswith(f"{params}: controller.aim.k must be in [0, 100], got -1.0")
    params.write_text("controller: {ros__parameters: {law: aim, look_ahead: 0.5, aim: {k: 1}}}")
    said = refusal(agv_ncs("simulate", params, env=environment))
    assert said.endswith("controller.aim.k is a double, got the integer 1: write 1.0")


# -- wrong at some step of a run ---------------------------------------------------------------------------------------

LATER = {
    LAWS: law("return (math.nan if -2.0 < x_e < -1.0 else v_r + 2.0 * x_e), w_r"),
    VEHICLES: (
        "import math\n\n\ndef mine(x, y, theta, far, v, w, dt):\n"
        "    far = far + dt * abs(v)\n"
        "    return x + dt * v * math.cos(theta), y + dt * v * math.sin(theta), theta + dt * w, "
        "(math.nan if far > 6.0 else far)\n"
    ),
    POLICIES: (
        "import math\n\n\ndef mine(held, target, reference):\n"
        "    return (math.nan if reference.y > 0.5 else held.x, held.y, held.theta), (reference.x, reference.y, 0.0)\n"
    ),
}
CHOICE = {
    LAWS: ("controller.law", "control law mine (later:mine)"),
    VEHICLES: ("plant.vehicle", "vehicle mine (later:mine)"),
    POLICIES: ("error_detector.policy", "staleness policy mine (later:mine)"),
}
LOSSES = ("--set", "relay.uplink.model=bernoulli", "--set", "relay.uplink.p=0.5", "--set", "plant.duration=20.0")


@pytest.mark.parametrize(
    ("group", "raises"), [(LAWS, False), (VEHICLES, False), (POLICIES, False), (LAWS, True)],
    ids=["law", "vehicle", "policy", "law that raises"],
)  # fmt: skip
def test_a_part_that_is_wrong_at_some_step_ends_the_run_there(
    install: Install, agv_ncs: AgvNcs, tmp_path: Path, group: str, raises: bool
) -> None:
    """By name, with reason and step: in nodes, simulation, sweep, twins, and in the replay of a recording."""
    code = LATER[group]
    assert "math.nan" in code
    if raises:  # and, compiled, returns NaN
        code = code.replace("math.nan", "math.sqrt(-1.0)")
    environment = install(tmp_path / "package", {"later": code}, {group: {"mine": "later:mine"}})
    name, where = CHOICE[group]
    chosen = ("--set", f"{name}=mine", *LOSSES)
    reason = f"{where} raises ValueError: math domain error" if raises else f"{where} returns NaN"

    said = refusal(agv_ncs("simulate", PAPER, *chosen, env=environment))
    assert reason in said
    step = int(said.rpartition("at step ")[2])
    assert step > 10
    said = refusal(agv_ncs("run", PAPER, *chosen, "--bag", tmp_path / "bag", env=environment))
    assert reason in said
    assert f"at step {step}" in said or f"{step * 0.005:.6g} s after the start of the run" in said
    sweep = ("sweep", PAPER, *chosen, "--vary", "controller.kx=20,25", "--seeds", "2")
    said = refusal(agv_ncs(*sweep, env=environment))
    assert reason in said
    assert "of the run with seed 1" in said
    if group != VEHICLES:
        said = refusal(agv_ncs("replay", tmp_path / "bag", "--compare", env=environment))
        assert f"{reason}, at step {step}" in said


def test_a_loop_that_diverges_is_not_held_against_its_parts(install: Install, agv_ncs: AgvNcs, tmp_path: Path) -> None:
    unstable = law("return v_r - 500.0 * x_e, w_r")
    environment = install(tmp_path, {"wrong": unstable}, {LAWS: {"mine": "wrong:mine"}})
    status, said = agv_ncs("simulate", PAPER, *LAW, "--set", "plant.initial_pose=[1.0, 5.0, 1.5]", env=environment)
    assert status == 0, said
    assert "diverged" in said
