"""Running the parts of a sweep: on all cores of this machine, or on a Dask cluster. The numbers are the same."""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from typing import Any

from agv_analysis.simulation import simulate_batch
from agv_analysis.simulation.batch import Table, cores
from agv_analysis.sweep.plan import Part, Sweep, SweepError

Results = Iterator[tuple[Part, Table]]

_RETRIES = 5
"""How often a part is given to another worker after one that was lost with it."""

_PARTS_AHEAD = 4
"""Parts of each worker that wait on the cluster: enough to keep it busy, few enough to hold."""


def run_part(sweep: Sweep, part: Part) -> Table:
    """Statistics of a part's runs, each with its twin, shape (points, seeds); a pure function of its arguments."""
    scenarios = [sweep.scenario(point) for point in range(*part.points)]
    return simulate_batch(scenarios, sweep.seeds[slice(*part.seeds)], workers=1, twins=True)


def on_this_machine(sweep: Sweep, parts: Sequence[Part], workers: int | None = None) -> Results:
    """The parts as they are done by `workers` threads, one a core by default."""
    with ThreadPoolExecutor(workers or cores()) as pool:
        futures = {pool.submit(run_part, sweep, part): part for part in parts}
        try:
            for future in as_completed(futures):
                yield futures.pop(future), future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def on_dask(sweep: Sweep, parts: Sequence[Part], address: str) -> Results:
    """The parts as they are done by the workers of the cluster whose scheduler is at `address`.

    A part that is lost with its worker is done by another one. Raises SweepError if the cluster cannot be used.
    """
    with _client(address) as client:
        waiting = iter(parts)
        ahead = _PARTS_AHEAD * max(1, sum(client.nthreads().values()))

        def submit(part: Part) -> Any:
            return client.submit(_numbered, sweep, part, pure=False, retries=_RETRIES)

        first = [submit(part) for part in itertools.islice(waiting, ahead)]
        futures = _distributed().as_completed(first, loop=client.loop)
        for future in futures:
            yield future.result()
            for part in itertools.islice(waiting, 1):
                futures.add(submit(part))


def _numbered(sweep: Sweep, part: Part) -> tuple[Part, Table]:
    return part, run_part(sweep, part)


def _distributed() -> Any:
    try:
        return importlib.import_module("distributed")
    except ImportError:
        raise SweepError(
            "--scheduler needs Dask on this machine and on its workers: pip install 'agv_ncs[cluster]'"
        ) from None


@contextmanager
def _client(address: str) -> Iterator[Any]:
    try:
        client = _distributed().Client(address, timeout=10.0, set_as_default=False)
    except (OSError, ValueError) as error:
        raise SweepError(f"--scheduler {address}: no Dask scheduler answers there: {error}") from None
    try:
        if not client.nthreads():
            raise SweepError(
                f"--scheduler {address}: the cluster has no workers: start some with `dask worker {address}`"
            )
        yield client
    finally:
        client.close()
