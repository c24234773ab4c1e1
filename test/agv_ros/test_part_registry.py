"""Registries: names of this package and of others, and what is said of one that cannot be loaded."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint

import pytest

from agv_cloud.control.registry import CONTROL_LAWS
from agv_cloud.staleness.registry import STALENESS_POLICIES
from agv_plant.channels.registry import CHANNELS
from agv_plant.vehicle.registry import VEHICLES
from agv_ros import part_registry
from agv_ros.part_registry import Functions, Registry
from agv_ros.parts import PartError
from test.agv_ros.test_parts import LAW, law


@pytest.fixture
def others(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Registry]:
    """A registry of laws with entry points `name=value` of other packages."""

    def registry(*points: str) -> Registry:
        found: dict[str, tuple[EntryPoint, ...]] = {}
        for name, value in (point.split("=") for point in points):
            found[name] = (*found.get(name, ()), EntryPoint(name, value, "a_group"))
        monkeypatch.setattr(part_registry, "installed", lambda group: found)
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
