"""Reading bags without ROS: recordings <-> numpy, and a report of everything that is wrong with them.

The reader is loaded when it is first asked for: a recorder, which writes and describes only, starts without it.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agv_analysis.bags.bag import Bag, Topic, read_bag
    from agv_analysis.bags.bag_errors import BagError

__all__ = ["Bag", "BagError", "Topic", "read_bag"]


def __getattr__(name: str) -> Any:
    """Load a name when it is first asked for."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    where = "bag_errors" if name == "BagError" else "bag"
    found = globals()[name] = getattr(importlib.import_module(f"{__name__}.{where}"), name)
    return found
