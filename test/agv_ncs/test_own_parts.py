"""Parts of other people: registered in a process, or announced by a package that imports from agv_ncs."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
PAPER = REPOSITORY / "config/paper.yaml"

Code = Callable[..., str]


def each_kind() -> None:
    """Body of a process: a part of each kind is chosen as soon as it is registered."""
    import sys

    import agv_ncs
    from agv_analysis.sweep.plan import axis_of

    def law(x_e, y_e, theta_e, v_r, w_r, kx=25.0):  # type: ignore[no-untyped-def]
        return v_r + kx * x_e, w_r + y_e + 2.0 * theta_e

    def vehicle(x, y, theta, v, w, dt, share=1.0):  # type: ignore[no-untyped-def]
        return x, y + share * v * dt, theta

    def policy(held, target, reference):  # type: ignore[no-untyped-def]
        return held, target

    def channel(channel, k, u, state):  # type: ignore[no-untyped-def]
        return k % 4 == 3, 0

    before = agv_ncs.load_scenario(sys.argv[1], ["plant.duration=1.0"])
    agv_ncs.register_control_law("mine", law)
    agv_ncs.register_vehicle("sledge", vehicle)
    agv_ncs.register_staleness_policy("as_then", policy)
    agv_ncs.register_channel("every_fourth", channel)
    for names, name in (
        (agv_ncs.control_laws, "mine"), (agv_ncs.vehicles, "sledge"), (agv_ncs.staleness_policies, "as_then"),
        (agv_ncs.channels, "every_fourth"),
    ):  # fmt: skip
        assert names()[-1] == name
    chosen = ["controller.law=mine", "controller.mine.kx=20.0", "plant.vehicle=sledge", "plant.sledge.share=0.5"]
    chosen += ["error_detector.policy=as_then", "relay.uplink.model=every_fourth"]
    scenario = before.with_settings(chosen)
    assert scenario.controller.gains == (20.0,)
    run = agv_ncs.simulate(scenario)
    assert run.lost.tolist() == [k % 4 == 3 for k in range(200)]
    assert (run.pose[:, 0] == run.pose[0, 0]).all()
    y = (run.pose[1:, 1] - run.pose[:-1, 1] - 0.5 * 0.005 * run.command[:-1, 0]).tolist()
    assert max(map(abs, y)) < 1e-12
    assert agv_ncs.parse_scenario(scenario.to_yaml()) == scenario
    assert axis_of("controller.mine.kx", [10, 20.0]).values == (10.0, 20.0)


def changed() -> None:
    """Body of a process: a function is put in the place of another one that differs in a constant alone."""
    import sys

    import agv_ncs

    def first(x_e, y_e, theta_e, v_r, w_r, kx=25.0):  # type: ignore[no-untyped-def]
        return 2.0 * v_r, w_r

    def second(x_e, y_e, theta_e, v_r, w_r, kx=25.0):  # type: ignore[no-untyped-def]
        return 3.0 * v_r, w_r

    def other(x_e, y_e, theta_e, v_r, w_r, ky=25.0):  # type: ignore[no-untyped-def]
        return 4.0 * v_r, w_r

    agv_ncs.register_control_law("mine", first)
    scenario = agv_ncs.load_scenario(sys.argv[1], ["plant.duration=1.0", "controller.law=mine"])
    for law, factor in ((first, 2.0), (second, 3.0), (first, 2.0)):
        agv_ncs.register_control_law("mine", law)
        run = agv_ncs.simulate(scenario)
        assert (run.command[:, 0] == factor * run.reference[:, 3]).all(), factor
    with pytest.raises(agv_ncs.UserError, match="its parameters are ky, but scenarios may hold values of kx"):
        agv_ncs.register_control_law("mine", other)
    assert (agv_ncs.simulate(scenario).command[:, 0] == 2.0 * run.reference[:, 3]).all()


def taken() -> None:
    """Body of a process: names and functions that cannot be registered, with what is said of them."""
    import agv_ncs

    def law(x_e, y_e, theta_e, v_r, w_r):  # type: ignore[no-untyped-def]
        return v_r, w_r

    refused = (
        (agv_ncs.register_control_law, "kanayama", law, "there is a control law kanayama already"),
        (agv_ncs.register_control_law, "my law", law, "its name must be letters, digits and _"),
        (agv_ncs.register_control_law, "three", 3, "control law three must be a function, found 3"),
        (agv_ncs.register_vehicle, "law", law, "its first arguments must be x, y, theta, v, w, dt"),
        (agv_ncs.register_channel, "trace", law, "there is a channel model trace already"),
        (agv_ncs.register_channel, "three", 3, "channel model three must be a function, found 3"),
    )
    for register, name, part, complaint in refused:
        with pytest.raises(agv_ncs.UserError, match=complaint):
            register(name, part)  # type: ignore[arg-type]
    assert set(agv_ncs.control_laws()) == {"kanayama", "state_feedback", "pure_pursuit"}


@pytest.mark.parametrize("body", [each_kind, changed, taken])
def test_a_part_is_registered_in_a_process(body: Callable[[], None], without_ros: Code, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        f"from __future__ import annotations\nimport pytest\n{inspect.getsource(body)}\n\n{body.__name__}()\n"
    )
    for _ in range(2):  # the second time with what the first one compiled and kept
        without_ros("import runpy\nrunpy.run_path(sys.argv[0])", script, PAPER)


def test_what_is_typed_into_an_interpreter_is_not_kept(without_ros: Code) -> None:
    code = """
import agv_ncs
def law(x_e, y_e, theta_e, v_r, w_r):
    return FACTOR * v_r, w_r
agv_ncs.register_control_law("mine", law)
from agv_analysis.compiled.functions import compiled
from agv_cloud.control.command import command, control_law
from agv_cloud.control.registry import CONTROL_LAWS
fast = compiled(command, {control_law: CONTROL_LAWS.find("mine").adapter})
print(fast(0.0, 0.0, 0.0, 1.0, 0.0, (), (), 0.005, 0.0, 10.0)[0])
"""
    for factor in ("2.0", "3.0"):
        assert float(without_ros(code.replace("FACTOR", factor))) == float(factor)


PACKAGE = """
from typing import Annotated
from agv_ncs import Quantity, UserError

def law(x_e, y_e, theta_e, v_r, w_r, k: Annotated[float, Quantity("gain", unit="1/s", low=0.0)] = 4.0):
    return v_r + k * x_e, w_r
"""


@pytest.mark.parametrize(
    "first", ["import agv_ncs", "import agv_cloud.parameters", "import foreign_law", "from agv_ncs import UserError"]
)
def test_a_package_of_parts_imports_from_agv_ncs(first: str, without_ros: Code, tmp_path: Path) -> None:
    """Its module is loaded while agv_cloud.parameters is, which agv_ncs.load_scenario needs."""
    (tmp_path / "foreign_law.py").write_text(PACKAGE)
    information = tmp_path / "foreign_law-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: foreign_law\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[agv_ncs.control_laws]\nforeign = foreign_law:law\n")
    code = (
        f"{first}\nimport agv_ncs\n"
        "scenario = agv_ncs.load_scenario(sys.argv[0], ['controller.law=foreign', 'controller.foreign.k=5.0'])\n"
        "print(scenario.controller.gains, agv_ncs.control_laws()[-1])\n"
    )
    assert without_ros(code, PAPER, path=tmp_path).split() == ["(5.0,)", "foreign"]
