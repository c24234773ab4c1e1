"""Typed parameters: what is known of each, what is refused and in which words, schema to values and back."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_analysis.scenario import SCHEMAS
from agv_cloud.control.registry import CONTROL_LAWS
from agv_ros.errors import UserError
from agv_ros.parameters import (
    SHARED,
    LoopParameters,
    Parameter,
    ParameterError,
    as_dict,
    build,
    check_values,
    group,
    parameter,
    parameters_of,
)

EVERY_PARAMETER = [
    pytest.param(found, id=f"{node}.{name}")
    for node, schema in SCHEMAS.items()
    for name, found in parameters_of(schema).items()
]

UNITLESS = (
    "speed_scale",
    "slip",
    "slip_noise",
    *(
        f"{link}.{name}"
        for link in ("uplink", "downlink")
        for name in (*"prhk", "arguments", "correlation", "hole_loss", "duplicate")
    ),
)
"""The only doubles without a unit."""


def refusal(found: Parameter, value: object) -> str:
    with pytest.raises(ParameterError) as caught:
        found.check("node", value)
    message = str(caught.value)
    assert message.startswith(f"node.{found.name} ")
    assert "\n" not in message
    return message


# -- every parameter of the loop -------------------------------------------------------------------------------------


@pytest.mark.parametrize("found", EVERY_PARAMETER)
def test_every_parameter_is_described(found: Parameter) -> None:
    assert len(found.description) > 10
    assert found.check("node", found.default) == found.default
    if found.kind in ("double", "double_array"):
        assert bool(found.unit) == (found.name not in UNITLESS)
    else:
        assert not found.unit


@pytest.mark.parametrize("found", EVERY_PARAMETER)
def test_every_number_has_bounds_on_both_sides(found: Parameter) -> None:
    if found.kind in ("double", "integer"):
        assert found.high is not None
        assert (found.low is None) != (found.above is None)


@pytest.mark.parametrize("found", [p for p in EVERY_PARAMETER if p.values[0].kind == "double"])  # type: ignore[union-attr]
def test_every_double_refuses_what_is_no_number_and_what_is_an_integer(found: Parameter) -> None:
    assert "got nan" in refusal(found, math.nan)
    assert "got -inf" in refusal(found, -math.inf)
    assert refusal(found, 25).endswith("is a double, got the integer 25: write 25.0")
    for value in (True, "25.0", None, [1.0], 1 + 0j):
        assert refusal(found, value).endswith(f"is a double, got {value!r}")
    limits = ("v_max", "duration", "w_max", "a_max", "j_max", "lifetime", "steering_rate")
    if found.name.rpartition(".")[2] not in limits:
        assert "got inf" in refusal(found, math.inf)
    else:
        assert found.check("node", math.inf) == math.inf


@pytest.mark.parametrize("found", EVERY_PARAMETER)
def test_every_bound_is_where_it_is_said_to_be(found: Parameter) -> None:
    if found.kind not in ("double", "integer"):
        return
    one = 1 if found.kind == "integer" else 1.0
    low = found.low if found.low is not None else found.above
    assert low is not None
    assert found.high is not None
    below = int(low) - 1 if found.kind == "integer" else low - 1.0
    assert found.allowed in refusal(found, below)
    if found.low is not None:
        assert found.check("node", type(one)(low)) == low
    else:
        refusal(found, low)
    if math.isfinite(found.high):
        assert found.check("node", type(one)(found.high)) == found.high
        refusal(found, type(one)(found.high * 2) + one)


@pytest.mark.parametrize("found", [p for p in EVERY_PARAMETER if p.values[0].kind == "integer"])  # type: ignore[union-attr]
def test_every_integer_refuses_doubles_and_bools(found: Parameter) -> None:
    for value in (1.0, True, "1", None, math.nan):
        assert refusal(found, value).endswith(f"is an integer, got {value!r}")


@pytest.mark.parametrize("found", [p for p in EVERY_PARAMETER if p.values[0].kind == "string"])  # type: ignore[union-attr]
def test_every_string_refuses_numbers_and_names_its_choices(found: Parameter) -> None:
    assert refusal(found, 5).endswith("is a string, got 5")
    if found.choices:
        remedy = f": {found.remedy}" if found.remedy else ""
        refused = f"must be one of {', '.join(found.choices)}, got 'nonsense'{remedy}"
        assert refusal(found, "nonsense").endswith(refused)
        assert all(found.check("node", choice) == choice for choice in found.choices)


ARRAYS = [p for p in EVERY_PARAMETER if p.values[0].kind == "double_array"]  # type: ignore[union-attr]


@pytest.mark.parametrize("found", [p for p in ARRAYS if p.values[0].length is None])  # type: ignore[union-attr]
def test_an_array_of_any_length_has_one_number_at_least(found: Parameter) -> None:
    assert found.check("node", [1.0]) == (1.0,)
    assert found.check("node", np.arange(9.0)) == tuple(map(float, range(9)))
    assert refusal(found, []).endswith("must be one or more finite numbers, got 0: []")
    assert refusal(found, 1.0).endswith("is a list of one or more doubles, got 1.0")
    assert refusal(found, [math.nan]).endswith("must be one or more finite numbers, got [nan]")


@pytest.mark.parametrize("found", [p for p in ARRAYS if p.values[0].length is not None])  # type: ignore[union-attr]
def test_every_array_is_of_finite_doubles_and_of_one_length(found: Parameter) -> None:
    assert found.check("node", np.array([1.0, 2.0, 3.0])) == found.check("node", [1.0, 2.0, 3.0]) == (1.0, 2.0, 3.0)
    assert refusal(found, [1.0, 2.0]).endswith("must be 3 finite numbers, got 2: [1.0, 2.0]")
    assert refusal(found, [1.0, 2.0, 3]).endswith("got the integer 3: write 3.0")
    assert refusal(found, 1.0).endswith("is a list of 3 doubles, got 1.0")
    for wrong in (math.nan, math.inf, -math.inf, "1.0", True, None):
        refusal(found, [1.0, 2.0, wrong])


def test_nodes_share_what_they_must_agree_on() -> None:
    assert tuple(parameters_of(LoopParameters)) == SHARED
    for schema in SCHEMAS.values():
        assert {name: parameters_of(schema)[name] for name in SHARED} == parameters_of(LoopParameters)
    assert LoopParameters().start_time > 0.0


def test_what_can_change_while_running() -> None:
    changing = {
        f"{node}.{name}" for node, schema in SCHEMAS.items() for name, p in parameters_of(schema).items() if p.runtime
    }
    gains = {f"controller.{name}" for name in ("kx", "ky", "ktheta", "v_max")}
    for law in ("state_feedback", "pure_pursuit"):
        gains |= {f"controller.{law}.{found.name}" for found in CONTROL_LAWS.find(law).parameters}
    losses = {
        f"relay.{link}.{name}"
        for link in ("uplink", "downlink")
        for name in (
            "p",
            "r",
            "h",
            "k",
            "n",
            "start_step",
            "arguments",
            "hole_loss",
            "margin",
            "delay",
            "jitter",
            "duplicate",
            "lifetime",
            "schedule",
        )
    }
    assert changing == gains | losses


# -- the machinery, on a schema of its own -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Inner:
    depth: float = parameter(1.0, "depth", unit="m", low=0.0, high=2.0)
    name: str = parameter("a", "name", choices=("a", "b"))


@dataclass(frozen=True)
class Outer:
    near: Inner = group(Inner)
    far: Inner = group(Inner)
    size: float = parameter(1.0, "size", unit="m", above=0.0)
    count: int = parameter(0, "count", low=0, runtime=True)
    on: bool = parameter(True, "is it on")
    spot: tuple[float, float] = parameter((0.0, 1.0), "where", unit="m, m")

    def __post_init__(self) -> None:
        if self.near.depth > self.far.depth:
            raise ParameterError("near must not be deeper than far")


def test_names_of_groups_are_dotted_and_in_order() -> None:
    assert list(parameters_of(Outer)) == [
        "near.depth",
        "near.name",
        "far.depth",
        "far.name",
        "size",
        "count",
        "on",
        "spot",
    ]
    assert parameters_of(Outer)["far.depth"].name == "far.depth"
    assert [p.kind for p in parameters_of(Outer).values()] == [
        "double", "string", "double", "string", "double", "integer", "bool", "double_array",
    ]  # fmt: skip


values = st.fixed_dictionaries(
    {},
    optional={
        "near.depth": st.floats(0.0, 1.0),
        "far.depth": st.floats(1.0, 2.0),
        "near.name": st.sampled_from("ab"),
        "size": st.floats(min_value=0.0, exclude_min=True, allow_infinity=False),
        "count": st.integers(0, 10**30),
        "on": st.booleans(),
        "spot": st.tuples(st.floats(-1e300, 1e300), st.floats(-1e300, 1e300)),
    },
)


@settings(deadline=None, derandomize=True)
@given(values)
def test_values_go_in_and_come_out(given_values: dict[str, object]) -> None:
    expected = {name: p.default for name, p in parameters_of(Outer).items()} | given_values
    built = build(Outer, given_values)
    assert as_dict(built) == expected
    assert build(Outer, as_dict(built)) == built
    assert check_values(Outer, given_values) == given_values


def test_unknown_names_are_refused_with_the_known_ones() -> None:
    for name in ("depth", "near", "near.depht", ""):
        with pytest.raises(ParameterError, match=r"unknown parameter node\..*: node has near\.depth, near\.name, far"):
            build(Outer, {name: 1.0}, "node")


def test_values_that_do_not_go_together_are_refused() -> None:
    with pytest.raises(ParameterError, match="near must not be deeper"):
        build(Outer, {"near.depth": 2.0, "far.depth": 1.0})
    assert check_values(Outer, {"near.depth": 2.0, "far.depth": 1.0})


@pytest.mark.parametrize(
    ("bounds", "words"),
    [
        ({"low": 0.0, "high": 1.0}, "in [0, 1]"),
        ({"low": 0.0}, "in [0, inf)"),
        ({"above": 0.0}, "> 0 and finite"),
        ({"above": 0.0, "high": 1.0}, "in (0, 1]"),
        ({"above": 0.0, "high": math.inf}, "in (0, inf]"),
        ({"high": 1.0}, "in (-inf, 1]"),
        ({}, "in (-inf, inf)"),
    ],
)
def test_bounds_in_words(bounds: dict[str, float], words: str) -> None:
    schema = dataclasses.make_dataclass("Schema", [("x", float, parameter(0.5, "a number", **bounds))])  # type: ignore[arg-type]
    found = parameters_of(schema)["x"]
    assert found.allowed == words
    for value in (-math.inf, -1.0, 0.0, 0.5, 1.0, 1.5, math.inf):
        inside = (
            value >= bounds.get("low", -math.inf)
            and value > bounds.get("above", -math.inf)
            and (value <= bounds["high"] if "high" in bounds else value < math.inf)
            and value != -math.inf
        )
        if inside:
            assert found.check("", value) == value
        else:
            assert refusal_text(found, value) == f"x must be {words}, got {value!r}"


def refusal_text(found: Parameter, value: float) -> str:
    with pytest.raises(ParameterError) as caught:
        found.check("", value)
    return str(caught.value)


def test_a_refusal_is_an_error_for_the_user() -> None:
    assert issubclass(ParameterError, UserError)
    assert issubclass(UserError, ValueError)
