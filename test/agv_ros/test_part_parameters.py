"""The parameters of parts in the schemas of their nodes."""

from __future__ import annotations

import math
from typing import Any

import pytest

from agv_ros.parameters import parameters_of
from agv_ros.part_parameters import refuse_taken, schema_of, values_of
from agv_ros.parts import PartError, part_of
from test.agv_ros.test_parts import LAW, law


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
