"""Channel models of other packages: found by the entry points of the group `agv_ncs.channels`."""

from __future__ import annotations

import functools
from importlib.metadata import EntryPoint, entry_points

from agv_plant.channels import MODELS, Model
from agv_plant.channels.position_dependent import PLACED
from agv_ros.errors import UserError

GROUP = "agv_ncs.channels"

TRACE = "trace"
"""The model whose verdicts stand in a file."""

SHARED = "shared"
"""The model whose verdicts depend on what became of other vehicles' messages."""


class ChannelError(UserError):
    """A channel model that cannot be used; the text names it and the reason."""


@functools.cache
def _installed() -> dict[str, tuple[EntryPoint, ...]]:
    found: dict[str, tuple[EntryPoint, ...]] = {}
    for point in sorted(set(entry_points(group=GROUP)), key=lambda point: (point.name, point.value)):
        found[point.name] = (*found.get(point.name, ()), point)
    return found


def known_models() -> tuple[str, ...]:
    """Names of all models: those of this package, then those of other installed ones."""
    own = (*MODELS, TRACE, *PLACED[1:], SHARED)
    return (*own, *(name for name in _installed() if name not in own))


@functools.cache
def find_model(name: str) -> Model:
    """The model called `name`, which is one of `known_models` but neither `trace`, `shared` nor one of `PLACED`.

    Raises ChannelError if two models have this name or if another package's model cannot be imported.
    """
    points = _installed().get(name, ())
    sources = [f"{point.value} of another package" for point in points]
    if name in (*MODELS, TRACE, SHARED, *PLACED):
        sources.insert(0, "that of agv_ncs")
    if len(sources) > 1:
        raise ChannelError(f"two channel models are called {name}: {' and '.join(sources)}; rename one")
    if name in MODELS:
        return MODELS[name]
    try:
        model: Model = points[0].load()
    except Exception as error:  # foreign code: anything can go wrong in it
        raise ChannelError(f"channel model {name} ({points[0].value}) cannot be loaded: {error}") from error
    if not callable(model):
        raise ChannelError(f"channel model {name} ({points[0].value}) must be a function, found {model!r}")
    return model
