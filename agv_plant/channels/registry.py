"""Channel models by name: those of this package, and those of other packages in the group `agv_ncs.channels`."""

from __future__ import annotations

from agv_plant.channels.model import Model
from agv_plant.channels.position_dependent import PLACED
from agv_ros.part_registry import Functions, own_parts
from agv_ros.parts import PartError

GROUP = "agv_ncs.channels"

MODELS: dict[str, Model] = own_parts(
    "agv_plant.channels", "perfect",
    besides=("coverage_hole", "model", "position_dependent", "rayleigh", "registry", "timed_trace", "trace"),
    name="model",
)  # fmt: skip
"""Those of this package that see neither the place nor other vehicles."""

TRACE = "trace"
"""The model whose verdicts stand in a file."""

SHARED = "shared"
"""The model whose verdicts depend on what became of other vehicles' messages."""

CHANNELS = Functions(kind="channel model", group=GROUP, own=MODELS, reserved=(TRACE, *PLACED[1:], SHARED))


class ChannelError(PartError):
    """A channel model that cannot be used; the text names it and the reason."""


def known_models() -> tuple[str, ...]:
    """Names of all models: those of this package, then those of other installed ones."""
    return CHANNELS.names()


def find_model(name: str) -> Model:
    """The model called `name`, which is one of `known_models` but neither `trace`, `shared` nor one of `PLACED`.

    Raises PartError if two models have this name or if another package's model cannot be imported.
    """
    model: Model = CHANNELS.load(name)[1]
    return model
