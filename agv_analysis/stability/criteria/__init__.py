"""The criteria of stability, one module each; `CRITERIA` has them all, in the order in which they are shown."""

from __future__ import annotations

import importlib
import pkgutil

from agv_analysis.stability.criteria.criterion import Criterion


def _found() -> tuple[Criterion, ...]:
    """The CRITERION of each module of this folder that has one."""
    modules = [importlib.import_module(f"{__name__}.{found.name}") for found in pkgutil.iter_modules(__path__)]
    criteria = [module.CRITERION for module in modules if hasattr(module, "CRITERION")]
    return tuple(sorted(criteria, key=lambda criterion: criterion.order))


CRITERIA = _found()
