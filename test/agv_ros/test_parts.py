"""Parts: what a function must be to be one, what it is told, and what is said of one that is wrong."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.metadata import EntryPoint
from typing import Annotated, Any

import pytest

from agv_cloud.control.registry import CONTROL_LAWS
from agv_cloud.staleness.registry import STALENESS_POLICIES
from agv_plant.channels.registry import CHANNELS
from agv_plant.vehicle.registry import VEHICLES
from agv_ros import parts
from agv_ros.parameters import parameters_of
from agv_ros.parts import (
    Functions,
    NotANumberError,
    PartError,
    Quantity,
    Registry,
    culprit,
    part_of,
    refuse_taken,
    schema_of,
    try_part,
    values_of,
)
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


# -- registries --------------------------------------------------------------------------------------------------------


@pytest.fixture
def others(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Registry]:
    """A registry of laws with entry points `name=value` of other packages."""

    def registry(*points: str) -> Registry:
        found: dict[str, tuple[EntryPoint, ...]] = {}
        for name, value in (point.split("=") for point in points):
            found[name] = (*found.get(name, ()), EntryPoint(name, value, "a_group"))
        monkeypatch.setattr(parts, "installed", lambda group: found)
        return Registry(kind="control law", group="a_group", own={"kanayama": law}, call=LAW)

    return registry


def test_names_of_this_package_come_first_and_those_of_others_after_them(others: Callable[..., Registry]) -> None:
    found = others("mine=elsewhere:mine", "kanayama=elsewhere:kanayama")
    assert found.names() == ("kanayama", "mine")
    assert found.own_part("kanayama").function is law


@pytest.mark.parametrize(
    ("points", "name", "said"),
    [
        (
            (),
            "none",
            "there is no control law 'none', must be one of kanayama: if another package has this control law",
        ),
        (("mine=no_such:law",), "mine", "control law mine (no_such:law) cannot be loaded: No module named 'no_such'"),
        (("mine=math:no_such",), "mine", "control law mine (math:no_such) cannot be loaded: module 'math' has no"),
        (("mine=math:pi",), "mine", "control law mine (math:pi) must be a function, found 3.14"),
        (("mine=a:b", "mine=c:d"), "mine", "two control laws are called mine: a:b of another package and c:d of"),
        (("kanayama=a:b",), "kanayama", "two control laws are called kanayama: that of agv_ncs and a:b of another"),
    ],
)
def test_what_cannot_be_found_is_one_line_and_disturbs_no_other(
    others: Callable[..., Registry], points: tuple[str, ...], name: str, said: str
) -> None:
    found = others(*points)
    with pytest.raises(PartError) as caught:
        found.find(name)
    assert said in str(caught.value)
    if points:
        assert found.refusal(name) == str(caught.value)
    assert found.refusal("nobody") == ""
    assert name not in found.usable()


def test_every_kind_has_a_group_of_its_own() -> None:
    kinds: tuple[Functions, ...] = (CONTROL_LAWS, VEHICLES, STALENESS_POLICIES, CHANNELS)
    assert [kind.group for kind in kinds] == [
        "agv_ncs.control_laws", "agv_ncs.vehicles", "agv_ncs.staleness_policies", "agv_ncs.channels",
    ]  # fmt: skip
    for registry in (CONTROL_LAWS, VEHICLES, STALENESS_POLICIES):
        assert set(registry.own) <= set(registry.usable())


# -- parameters --------------------------------------------------------------------------------------------------------


def test_parameters_of_parts_are_groups_and_those_that_would_be_called_as_others_are_left_out() -> None:
    found = {name: part_of(name, f"control law {name}", law, LAW) for name in ("mine", "ts", "use_sim_time")}
    module: dict[str, Any] = {"__name__": __name__}
    schema = schema_of("Laws", found, ("ts",), module)
    assert list(parameters_of(schema)) == ["mine.k", "mine.w_max"]
    assert values_of(found["mine"], schema()) == (2.0, math.inf)
    refuse_taken(found["mine"], ("ts",))
    for taken in ("ts", "use_sim_time"):
        with pytest.raises(PartError, match=f"control law {taken}: its node has a parameter {taken}"):
            refuse_taken(found[taken], ("ts",))
    with pytest.raises(PartError, match="could not be loaded when its parameters were declared"):
        values_of(found["ts"], schema())
