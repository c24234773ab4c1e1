"""Parts: what a function must be to be one, what it is told, and what is said of one that is wrong."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any

import pytest

from agv_cloud.control.registry import CONTROL_LAWS
from agv_cloud.staleness.registry import STALENESS_POLICIES
from agv_plant.vehicle.registry import VEHICLES
from agv_ros.parts import NotANumberError, PartError, Quantity, culprit, part_of, try_part
from agv_ros.pose import Pose

LAW, VEHICLE, POLICY = CONTROL_LAWS.call, VEHICLES.call, STALENESS_POLICIES.call


def law(
    x_e: float,
    y_e: float,
    theta_e: float,
    v_r: float,
    w_r: float,
    look_ahead: float,
    k: Annotated[float, Quantity("a gain", "1/s", low=0.0, high=9.0)] = 2.0,
    memory: tuple[float, float] = (1.0, 2.0),
    ts: float = 0.1,
    w_max: float = math.inf,
) -> tuple[float, float, tuple[float, float]]:
    return v_r + k * x_e, min(w_r, w_max) * look_ahead, (memory[0] + ts, memory[1] + 1.0)


def test_a_law_is_given_what_it_names_in_its_own_order() -> None:
    found = part_of("mine", "control law mine", law, LAW)
    assert [known.name for known in found.parameters] == ["k", "w_max"]
    assert found.defaults == (2.0, math.inf)
    assert found.limits == ("w_max",)
    assert found.memory == (1.0, 2.0)
    assert found.adapter(0.5, 0.0, 0.0, 1.0, 8.0, found.memory, (4.0, 6.0), 0.25, 10.0) == (3.0, 60.0, (1.25, 3.0))
    (gain, _) = found.parameters
    assert (gain.unit, gain.low, gain.high, gain.description, gain.runtime) == ("1/s", 0.0, 9.0, "a gain", True)


def test_a_law_without_memory_leaves_that_of_the_loop_alone() -> None:
    found = part_of("mine", "control law mine", lambda x_e, y_e, theta_e, v_r, w_r: (1, 2), LAW)
    assert found.adapter(0.0, 0.0, 0.0, 0.0, 0.0, (), (), 0.1, 0.0) == (1.0, 2.0, ())
    assert all(type(number) is float for number in found.adapter(0.0, 0.0, 0.0, 0.0, 0.0, (), (), 0.1, 0.0)[:2])


def test_further_states_of_a_vehicle_stand_between_theta_and_v() -> None:
    def sled(
        x: float, y: float, theta: float, a: float, b: float, v: float, w: float, dt: float, m: float = 3.0
    ) -> Any:
        return x + v * dt, y, theta, a + 1.0, b + m

    found = part_of("sled", "vehicle sled", sled, VEHICLE)
    assert (found.states, found.memory) == (("a", "b"), ())
    moved = found.adapter(0.0, 0.0, 0.0, (1.0, 2.0), 2.0, 0.0, 2.0, 0.0, 0.5, False, (4.0,))
    assert moved == (1.0, 0.0, 0.0, (2.0, 6.0))


def test_a_policy_may_return_plain_tuples() -> None:
    found = part_of("own", "staleness policy own", lambda held, target, reference: ((1, 2, 3), target), POLICY)
    here = Pose(0.0, 0.0, 0.0)
    assert found.adapter(7, here, here, here, 0.0, 0.0, 0.1, False, ()) == (Pose(1.0, 2.0, 3.0), here)


# -- signatures --------------------------------------------------------------------------------------------------------


def refusal(function: Any, name: str = "mine", call: Any = LAW) -> str:
    with pytest.raises(PartError) as caught:
        part_of(name, f"control law {name} (my_laws:mine)", function, call)
    assert "\n" not in str(caught.value)
    assert f"control law {name} (my_laws:mine)" in str(caught.value)
    return str(caught.value)


FIRST = "its first arguments must be x_e, y_e, theta_e, v_r, w_r, found "


@pytest.mark.parametrize(
    ("signature", "said"),
    [
        ("x_e, y_e, theta_e, w_r, v_r", FIRST + "x_e, y_e, theta_e, w_r, v_r"),
        ("x, y, theta, v_r, w_r", FIRST + "x, y, theta, v_r, w_r"),
        ("", FIRST + "none"),
        ("x_e, y_e, theta_e, v_r, w_r, *args", "argument args must be an ordinary one, found *args"),
        ("x_e, y_e, theta_e, v_r, w_r, **more", "argument more must be an ordinary one, found **more"),
        ("x_e, y_e, theta_e, v_r, w_r, *, k=1.0", "argument k must be an ordinary one, found k=1.0"),
        ("x_e, y_e, theta_e, v_r, w_r, k", "its parameter k needs a default, as in k=1.0"),
        ("x_e, y_e, theta_e, v_r, w_r, k=2", "its parameter k must be a float, got 2: write 2.0"),
        ("x_e, y_e, theta_e, v_r, w_r, k='a'", "its parameter k must be a float, got k='a'"),
        ("x_e, y_e, theta_e, v_r, w_r, k=True", "its parameter k must be a float, got k=True"),
        ("x_e, y_e, theta_e, v_r, w_r, k: int = 2.0", "its parameter k must be a float, got k: 'int' = 2.0"),
        ("x_e, y_e, theta_e, v_r, w_r, k: 'Nothing' = 2.0", "the type of its parameter k cannot be read: NameError"),
        ("x_e, y_e, theta_e, v_r, w_r, k=float('nan')", "the default of its parameter k must be in"),
        (
            "x_e, y_e, theta_e, v_r, w_r, k: Annotated[float, Quantity('', low=0.0, high=1.0)] = 2.0",
            "the default of its parameter k must be in [0, 1], got 2.0",
        ),
        (
            "x_e, y_e, theta_e, v_r, w_r, memory",
            "memory must have a tuple of numbers as default, which it begins with, got no default",
        ),
        ("x_e, y_e, theta_e, v_r, w_r, memory=0.0", "memory must have a tuple of numbers as default"),
        ("x_e, y_e, theta_e, v_r, w_r, memory=()", "memory must have a tuple of numbers as default"),
        ("x_e, y_e, theta_e, v_r, w_r, memory=('a',)", "memory must have a tuple of numbers as default"),
    ],
)
def test_a_signature_that_the_loop_cannot_call_is_refused(signature: str, said: str) -> None:
    known: dict[str, Any] = {"Annotated": Annotated, "Quantity": Quantity}
    exec(f"def mine({signature}):\n    return v_r, w_r\n", known)
    assert said in refusal(known["mine"])


def test_types_of_other_arguments_need_not_be_known_when_the_nodes_run() -> None:
    known: dict[str, Any] = {}
    exec(
        "from __future__ import annotations\ndef mine(held: Pose, target: Pose, reference, k: float = 1.0): ...\n",
        known,
    )
    assert part_of("mine", "staleness policy mine", known["mine"], POLICY).defaults == (1.0,)


@pytest.mark.parametrize("name", ["my-law", "my law", "2nd", "lambda", "_own", "gesetz.1", "größe"])
def test_a_name_that_no_parameter_could_have_is_refused(name: str) -> None:
    assert "its name must be letters, digits and _" in refusal(law, name)


class Called:
    def __call__(self, x_e: float) -> float:
        return x_e


@pytest.mark.parametrize("what", [Called, Called(), math.hypot])
def test_only_functions_are_parts(what: Any) -> None:
    assert "must be a function, found" in refusal(what)


# -- results -----------------------------------------------------------------------------------------------------------


def trial(function: Callable[..., Any], call: Any = LAW) -> str:
    arguments: dict[int, tuple[Any, ...]] = {
        id(LAW): (0.1, 0.0, 0.0, 1.0, 0.0, (0.0, 0.0), (), 0.1, 0.0),
        id(VEHICLE): (0.0, 0.0, 0.0, (0.0,), 1.0, 0.0, 1.0, 0.0, 0.1, False, ()),
        id(POLICY): (3, Pose(0.0, 0.0, 0.0), Pose(0.0, 0.0, 0.0), Pose(0.0, 0.0, 0.0), 0.0, 0.0, 0.1, False, ()),
    }
    with pytest.raises(PartError) as caught:
        try_part(part_of("mine", "mine (a:b)", function, call), call, *arguments[id(call)])
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_results_that_are_none_are_refused() -> None:
    two = "mine (a:b) must return numbers, a tuple of v [m/s], w [rad/s]; got "
    assert trial(lambda x_e, y_e, theta_e, v_r, w_r: (1.0, 2.0, 3.0)) == two + "(1.0, 2.0, 3.0)"
    assert trial(lambda x_e, y_e, theta_e, v_r, w_r: 1.0) == two + "1.0"
    assert trial(lambda x_e, y_e, theta_e, v_r, w_r: None) == two + "None"
    assert trial(lambda x_e, y_e, theta_e, v_r, w_r: (1.0, "2")) == two + "(1.0, '2')"
    assert trial(lambda x_e, y_e, theta_e, v_r, w_r: ((-1.0) ** 0.5, 0.0)).startswith(two)
    assert trial(lambda x_e, y_e, theta_e, v_r, w_r: [1.0] * 500).endswith(" ...")
    assert trial(lambda x_e, y_e, theta_e, v_r, w_r, memory=(0.0, 0.0): (1.0, 2.0, (0.0,))) == (
        "mine (a:b) must return numbers, a tuple of v [m/s], w [rad/s], its memory, 2 of them; got (1.0, 2.0, (0.0,))"
    )
    assert trial(lambda x_e, y_e, theta_e, v_r, w_r: (math.nan, 0.0)) == (
        "mine (a:b) must return finite numbers, got (nan, 0.0) for x_e = 0.1, y_e = 0.0, theta_e = 0.0, v_r = 1.0, "
        "w_r = 0.0"
    )
    assert trial(lambda x_e, y_e, theta_e, v_r, w_r: 1 / 0) == "mine (a:b) raises ZeroDivisionError: division by zero"
    assert "a tuple of x [m], y [m], theta [rad], steer; got" in trial(
        lambda x, y, theta, steer, v, w, dt: (x, y, theta), VEHICLE
    )
    assert "held and target, each a tuple x [m], y [m], theta [rad]; got" in trial(
        lambda held, target, reference: held, POLICY
    )


def test_an_adapter_refuses_nan_unless_the_loop_has_diverged() -> None:
    found = part_of("mine", "mine (a:b)", lambda x_e, y_e, theta_e, v_r, w_r: (x_e - x_e, math.nan), LAW)
    with pytest.raises(NotANumberError, match=r"^returns NaN$") as caught:
        found.adapter(0.0, 0.0, 0.0, 0.0, 0.0, (), (), 0.1, 0.0)
    assert culprit(caught.value) == "mine (a:b)"
    assert math.isnan(found.adapter(1e200, 0.0, 0.0, 0.0, 0.0, (), (), 0.1, 0.0)[1])
    assert culprit(ValueError("from elsewhere")) == ""
