"""From parts to rows: what is there already, what is done now, and what Ctrl-C left."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from agv_analysis.simulation import STATISTICS
from agv_analysis.sweep.plan import Part, Sweep
from agv_analysis.sweep.store import Store
from agv_analysis.sweep.summary import summarise

Results = Callable[[list[Part]], Any]


def collect(
    sweep: Sweep, store: Store | None, results: Results, progress: Callable[[int], None]
) -> tuple[list[dict[str, Any]], bool]:
    """Rows of a sweep, and whether it is complete: on Ctrl-C those of what is done.

    `results` gives the parts that it is asked for as they are done, in any order; each is kept in the `store` if there
    is one, and those that it holds are not computed again. `progress` receives the number of runs done.
    """
    table = np.zeros((sweep.size, sweep.seed_count), dtype=STATISTICS)
    done = np.zeros(table.shape, dtype=np.bool_)
    missing = []
    for part in sweep.parts():
        kept = None if store is None else store.load(part)
        if kept is None:
            missing.append(part)
        else:
            table[part.block], done[part.block] = kept, True
    try:
        progress(int(done.sum()))
        for part, found in results(missing):
            if store is not None:
                store.save(part, found)
            table[part.block], done[part.block] = found, True
            progress(int(done.sum()))
    except KeyboardInterrupt:
        pass
    return summarise(sweep, table, done), bool(done.all())
