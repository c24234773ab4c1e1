"""What takes too long for a move of a slider: the criteria over the whole lap, and for the loss sequence of the run."""

from __future__ import annotations

import functools
import math
import multiprocessing
import os
import resource
import signal
import threading
from collections.abc import Callable
from multiprocessing import resource_tracker
from typing import Any, Generic, TypeVar

from agv_analysis.explore.response import MOST_POINTS, with_channel_of
from agv_analysis.scenario import Scenario
from agv_ros.errors import UserError

R = TypeVar("R")

_NICE = 19
"""Background computations yield to the page and to the browser."""


_MOST_MEMORY = 8 * 2**30
"""Most address space [B] of background computations, of which a part is memory."""

WORD, SURE, WHY = "In a word", "How sure", "Because"
"""Rows that the badge shows, too."""

_LAPS = 50
"""Laps that are simulated for a corridor."""


def compared_criteria_rows(scenario: Scenario, pinned: Scenario | None) -> list[tuple[str, str, str]]:
    """Name, value and that of a pinned scenario, which meets the same outages; empty without one."""
    others = {} if pinned is None else dict(criteria_rows(with_channel_of(pinned, scenario)))
    return [(name, value, others.get(name, "")) for name, value in criteria_rows(scenario)]


@functools.lru_cache(maxsize=64)
def criteria_rows(scenario: Scenario) -> list[tuple[str, str]]:
    """The verdict, what the losses of the simulated run do, and the margins of a scenario over its lap.

    What cannot be simulated has no rows: the page says why at once.
    """
    from agv_analysis.corridor.corridor import corridor
    from agv_analysis.report.table import margin_rows
    from agv_analysis.report.tiles import how_sure
    from agv_analysis.report.verdict_sentence import sentence
    from agv_analysis.simulation.single import simulate
    from agv_analysis.stability.analysis import analyse

    try:
        analysis = analyse(simulate(scenario))
        found = [("Verdict", sentence(analysis)), (WORD, analysis.verdict.word)]
        found.append((WHY, analysis.verdict.reason))
        if sure := how_sure(analysis):
            found.append((SURE, sure))
        if analysis.floquet is not None:
            found.append(("This loss sequence (Floquet)", _growth(analysis.floquet)))
        within = corridor(scenario, _LAPS, proved=False)
        return [*found, *(() if within is None else within.rows()), *margin_rows(scenario)]
    except UserError:
        return []


def tube_traces(scenario: Scenario) -> list[dict[str, Any]]:
    """The edges of a scenario's corridor along the track, and of a tube in it, as traces of plotly.js; [] without one.

    The tube is that of the linear loop, for no longer outages than a single one may be by some places of the lap.
    """
    from agv_analysis.corridor.corridor import rough_tube
    from agv_analysis.corridor.lap_loop import LapLoop
    from agv_analysis.corridor.widths import widths_of
    from agv_analysis.report.corridor_panels import edges_along
    from agv_analysis.report.plotly import traces

    widths = widths_of(scenario.error_detector)
    if widths is None:
        return []
    try:
        loop = LapLoop(scenario, widths)
        tube, remark = rough_tube(loop)
    except UserError:
        return []
    return traces(edges_along(loop.lap, widths, tube, remark), MOST_POINTS)


def _growth(factor: float) -> str:
    """Whether errors that grow by a factor a step die out, in words."""
    if not math.isfinite(factor):
        return "unstable: diverges"
    if factor < 1.0:
        return f"stable: errors shrink by {100.0 * (1.0 - factor):.2g} % per step"
    return f"unstable: errors grow by {100.0 * (factor - 1.0):.2g} % per step"


class WorkerDiedError(RuntimeError):
    """The other process has ended before it had an answer."""


class LatestOnlyWorker(Generic[R]):
    """Makes calls in another process, one at a time; of those that wait for their turn only the newest is made.

    So a slider that is dragged does not leave a queue behind it, and the page's own process answers moves meanwhile.
    A call waits `rest` seconds for a newer one before it takes its turn.
    """

    def __init__(self, function: Callable[..., R], rest: float = 0.0) -> None:
        self._function = function
        self._rest = rest
        self._changed = threading.Condition()
        self._newest = 0
        self._busy = False
        self._of_process = threading.Lock()
        self._process: Any = None
        self._closed = False

    def __call__(self, *arguments: Any) -> R | None:
        """What the function, one of a module, returns.

        None if a newer call came before this one had its turn, or if nothing is computed any more.
        """
        with self._changed:
            self._newest += 1
            mine = self._newest
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._is_over(mine), self._rest)
            self._changed.wait_for(lambda: not self._busy or self._is_over(mine))
            if self._is_over(mine):
                return None
            self._busy = True
        try:
            return self._compute(arguments)
        finally:
            with self._changed:
                self._busy = False
                self._changed.notify_all()

    def _is_over(self, mine: int) -> bool:
        return self._closed or mine != self._newest

    def _compute(self, arguments: tuple[Any, ...]) -> R | None:
        with self._of_process:
            if self._closed:
                return None
            self._process = self._process or _begun()
            process, pipe = self._process
        try:
            pipe.send((self._function, arguments))
            found, error = pipe.recv()
        except (EOFError, OSError):
            with self._of_process:
                process.join()
                self._process = None
                is_closed = bool(self._closed)
            if is_closed:
                return None
            raise WorkerDiedError(f"the process that was to compute it ended with {process.exitcode}") from None
        if error is not None:
            raise error
        result: R = found
        return result

    def close(self) -> None:
        """End the other process, whatever it is at; no other begins."""
        with self._of_process:
            self._closed = True
            if self._process is not None:
                self._process[0].terminate()
        with self._changed:
            self._changed.notify_all()


def _begun() -> tuple[Any, Any]:
    """A process, and the pipe that carries the calls.

    Ctrl-C reaches every process of a terminal, and is the page's own to act upon: a process inherits what is blocked
    when it begins. It is spawned, since the server has threads; multiprocessing's own tracker, which would come up with
    it and take the block away, comes first.
    """
    resource_tracker.ensure_running()
    spawn = multiprocessing.get_context("spawn")
    ours, theirs = spawn.Pipe()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process = spawn.Process(target=_compute_what_comes, args=(theirs,), daemon=True)
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    theirs.close()
    return process, ours


def _compute_what_comes(pipe: Any) -> None:
    """Body of the other process: it ends with the one that began it, in the midst of a computation, too."""
    os.nice(_NICE)
    resource.setrlimit(resource.RLIMIT_AS, (_MOST_MEMORY, resource.getrlimit(resource.RLIMIT_AS)[1]))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while True:
        try:
            function, arguments = pipe.recv()
        except EOFError:
            return
        answer: tuple[Any, Exception | None]
        try:
            answer = function(*arguments), None
        except Exception as error:
            answer = None, error
        pipe.send(answer)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
