"""Many runs on all cores, of each only its statistics: no history is kept, whatever the number of runs."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from itertools import chain, groupby, zip_longest
from typing import get_type_hints

import numpy as np
from numpy.typing import NDArray

from agv_analysis.compiled.functions import HAS_NUMBA, numbers
from agv_analysis.compiled.lane_rows import LANES
from agv_analysis.metrics.order_statistics import distances_of
from agv_analysis.run import Floats
from agv_analysis.scenario import Scenario
from agv_analysis.simulation.channel_outcomes import ChannelRealisation
from agv_analysis.simulation.decay import Decay, decay, decay_over_links
from agv_analysis.simulation.lanes import VECTOR, Choices, choices_of, fits_lanes, statistics_over_lanes
from agv_analysis.simulation.link_loop import LinkTrace, contraction_over_links, empty_trace, statistics_over_links
from agv_analysis.simulation.loop import (
    Loop,
    RunInputs,
    RunMetrics,
    statistics,
    statistics_of_twins,
    statistics_of_two,
)
from agv_analysis.simulation.parts import replacements_of, run_parts
from agv_analysis.simulation.reference import reference_of
from agv_analysis.simulation.single import settings_of, simulate, start_of, steps_of
from agv_analysis.simulation.trace_windows import with_windows
from agv_cloud.parameters import ErrorDetectorParameters
from agv_plant.vehicle.motion import NOISE, SLIP
from agv_ros.parts import PartError
from agv_ros.pose import Pose
from agv_ros.substitution import Replacements

_FIRST, *_OTHERS = get_type_hints(RunMetrics).items()
STATISTICS = np.dtype([
    *((name, np.dtype(kind)) for name, kind in (_FIRST, *get_type_hints(Decay).items(), *_OTHERS)),
    ("deviation_p99", np.dtype(float)),
    ("contraction", np.dtype(float)),
])  # fmt: skip
"""One run's row: the fields of `loop.RunMetrics` and `decay.Decay`, and two more.

`deviation_p99`: 99 % of the steps since the initial error has settled are no farther from the reference [m].
`contraction` is that of `loop.statistics_of_twins`, NaN for a run without a twin.
"""

Table = NDArray[np.void]
Realisations = Callable[[int, int, float], ChannelRealisation]
Job = tuple[int, int]
"""One run: (row, column) of the table, that is, scenario and seed."""
Result = tuple[Job, RunMetrics, Decay, float, float]
"""What is known of a run: its metrics, what becomes of its initial error, p99, how far twins are apart in the end."""

TWIN_OFFSET = 1e-6
"""A twin begins this far from the run [m, m, rad]: far above rounding, far below what makes the loop nonlinear."""

_LARGEST_UNIT = 1024
"""Runs that one worker takes at once: enough to share the random numbers of a seed, few enough to tell of progress."""


def simulate_batch(
    scenarios: Sequence[Scenario],
    seeds: Sequence[int],
    workers: int | None = None,
    progress: Callable[[int], None] = lambda done: None,
    twins: bool = False,
) -> Table:
    """Statistics of every scenario under every seed, an array of STATISTICS of shape (scenarios, seeds).

    With `twins`, which takes twice the time, every run has a twin that begins a micrometre away and meets the same
    losses: their contraction says whether the loop is stable along this run.

    Seeds are paired: under one seed all scenarios with the same channel meet the same outages, and all AGVs the same
    noise and slip; `relay.seed` and `plant.seed` of the scenarios do not count. Of a measured link with times that
    lasts for two runs or more each seed meets another part (`trace_window`). `workers` threads, one a core by default,
    do the work; the result is the same for any number. `progress` receives the number of runs done. Raises UserError if
    a run has no end, PartError if a control law, a vehicle or a policy raises or returns NaN.
    """
    batch, workers, done = _Batch(scenarios, seeds, twins), workers or cores(), 0
    with ThreadPoolExecutor(workers) as pool:
        try:
            units = [pool.submit(batch.work, unit) for unit in batch.units(workers)]
            for unit in as_completed(units):
                done += unit.result()
                progress(done)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return batch.table


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Batch:
    """The table and what is needed to fill it; filled by several threads, each in places of its own."""

    def __init__(self, scenarios: Sequence[Scenario], seeds: Sequence[int], twins: bool) -> None:
        self.table: Table = np.zeros((len(scenarios), len(seeds)), dtype=STATISTICS)
        scenarios = [with_windows(scenario) for scenario in scenarios]
        self._scenarios, self._seeds, self._twins = scenarios, seeds, twins
        self._steps = [steps_of(scenario) for scenario in scenarios]
        # What the runs of a scenario share, made when the first of them needs it.
        self._settings = functools.cache(lambda row: settings_of(scenarios[row]))
        self._start = functools.cache(lambda row: start_of(scenarios[row]))
        self._on_reference = functools.cache(self._start_on_reference)
        self._of_kind = functools.cache(self._make_reference)
        self._choices = functools.cache(self._choices_of)
        # Runs of one kind share a reference and a compiled loop.
        kinds: dict[tuple[ErrorDetectorParameters, int, str, str], int] = {}
        self._kind = [
            kinds.setdefault((s.error_detector, steps, s.controller.law, s.plant.vehicle), len(kinds))
            for s, steps in zip(scenarios, self._steps, strict=True)
        ]

    def units(self, workers: int) -> list[list[Job]]:
        """All runs in parts, seed after seed; several for each worker, if it is not alone, so that none waits long."""
        rows, columns = self.table.shape
        jobs = [(row, column) for column in range(columns) for row in range(rows)]
        size = max(2, min(_LARGEST_UNIT, len(jobs) // (4 * workers if workers > 1 else 1)))
        if jobs and self._choices(0) is not None:  # a part of a vector would take as long as all of it
            size = max(VECTOR, size // VECTOR * VECTOR)
        return [jobs[first : first + size] for first in range(0, len(jobs), size)]

    def work(self, unit: list[Job]) -> int:
        """Run one part; returns the number of its runs."""
        realisations = functools.lru_cache(maxsize=4)(ChannelRealisation)
        run = self._with_twins if self._twins else self._by_twos
        for kind, jobs in groupby(sorted(unit, key=lambda job: self._kind[job[0]]), lambda job: self._kind[job[0]]):
            row = self._kind.index(kind)
            parts = replacements_of(self._scenarios[row])
            of_kind, reference = list(jobs), self._reference(row)
            try:
                alone: list[Job] = []  # which the lanes leave over
                for job, (steps, *metrics), of_start, *others in chain(
                    self._over_lanes(reference, of_kind, realisations, alone),
                    run(reference, alone, realisations, parts),
                ):
                    self.table[job] = (steps, *of_start, *metrics, *others)
            except PartError as error:
                raise PartError(self._where_it_fails(of_kind) or str(error)) from error
        return len(unit)

    def _where_it_fails(self, jobs: list[Job]) -> str:
        """What is wrong with a part, and at which step of which run; empty if no single run tells."""
        for row, column in jobs:
            scenario, seed = self._scenarios[row], self._seeds[column]
            relay, plant = replace(scenario.relay, seed=seed), replace(scenario.plant, seed=seed)
            try:
                simulate(replace(scenario, relay=relay, plant=plant))
            except PartError as error:
                return f"{error} of the run with seed {seed}"
        return ""

    def _over_lanes(
        self, reference: Floats, jobs: list[Job], realisations: Realisations, alone: list[Job]
    ) -> Iterator[Result]:
        """Side by side, as many as can be; all others come into `alone`."""
        groups: dict[Choices, list[Job]] = {}
        for job in jobs:
            choices = self._choices(job[0])
            (alone if choices is None else groups.setdefault(choices, [])).append(job)
        for of_group in groups.values():
            for first in range(0, len(of_group), LANES):
                group = of_group[first : first + LANES]
                inputs = [self._inputs(job, realisations) for job in group]
                on_reference = [self._on_reference(row) for row, _ in group]
                twins = [start_of(self._scenarios[row], TWIN_OFFSET) for row, _ in group] if self._twins else []
                for job, found in zip(
                    group, statistics_over_lanes(reference, inputs, on_reference, twins), strict=True
                ):
                    if found is None:
                        alone.append(job)
                    else:
                        yield job, *found

    def _by_twos(
        self, reference: Floats, jobs: list[Job], realisations: Realisations, parts: Replacements
    ) -> Iterator[Result]:
        direct = [job for job in jobs if self._is_direct(job)]
        for job in jobs:
            if not self._is_direct(job):
                yield job, *self._over_links(reference, job, realisations, parts)[:3], math.nan
        for one, other in zip_longest(direct[::2], direct[1::2]):
            pair = [one] if other is None else [one, other]
            inputs, decays = zip(*(self._with_decay(reference, job, realisations, parts) for job in pair), strict=True)
            squares = [np.zeros(self._steps[job[0]]) for job in pair]
            found = (
                [run_parts(statistics, parts, reference, *inputs, *squares)]
                if other is None
                else run_parts(statistics_of_two, parts, reference, *inputs, *squares)
            )
            for job, metrics, of_start, run, square in zip(pair, found, decays, inputs, squares, strict=True):
                yield job, metrics, of_start, distances_of(square[run.settled : metrics.steps]).p99, math.nan

    def _with_twins(
        self, reference: Floats, jobs: list[Job], realisations: Realisations, parts: Replacements
    ) -> Iterator[Result]:
        for job in jobs:
            twin = start_of(self._scenarios[job[0]], TWIN_OFFSET)
            if self._is_direct(job):
                inputs, of_start = self._with_decay(reference, job, realisations, parts)
                squares = np.zeros(self._steps[job[0]])
                found, contraction = run_parts(statistics_of_twins, parts, reference, inputs, twin, squares)
                yield job, found, of_start, distances_of(squares[inputs.settled : found.steps]).p99, contraction
            else:
                inputs = self._inputs(job, realisations)
                found, of_start, p99, traces = self._over_links(reference, job, realisations, parts)
                is_whole = found.steps == self._steps[job[0]]
                arguments = reference, inputs, twin, *traces
                apart = run_parts(contraction_over_links, parts, *arguments) if is_whole else math.inf
                yield job, found, of_start, p99, apart

    def _with_decay(
        self, reference: Floats, job: Job, realisations: Realisations, parts: Replacements
    ) -> tuple[RunInputs, Decay]:
        """A run whose messages arrive at once or not at all, and what becomes of its initial error."""
        inputs = self._inputs(job, realisations)
        found: Decay = run_parts(decay, parts, reference, inputs, self._on_reference(job[0]))
        return inputs._replace(settled=max(0, found.settle_1cm_steps)), found

    def _start_on_reference(self, row: int) -> Loop:
        """The loop before slot 0 with the AGV on its reference."""
        first = self._reference(row)[0]
        return start_of(self._scenarios[row], at=Pose(*(float(value) for value in first[:3])))

    def _choices_of(self, row: int) -> Choices | None:
        """Those of a scenario's runs, None if they cannot be in lanes: only what is lost may be random in a slot."""
        scenario = self._scenarios[row]
        plant, links = scenario.plant, (scenario.relay.uplink, scenario.relay.downlink)
        is_direct = all(link.is_direct for link in links) and not plant.is_noisy and plant.slip_noise == 0.0
        if not (HAS_NUMBA and is_direct) or replacements_of(scenario) or not fits_lanes(self._reference(row)):
            return None
        return choices_of(self._settings(row))

    def _is_direct(self, job: Job) -> bool:
        relay = self._scenarios[job[0]].relay
        return relay.uplink.is_direct and relay.downlink.is_direct

    def _over_links(
        self, reference: Floats, job: Job, realisations: Realisations, parts: Replacements
    ) -> tuple[RunMetrics, Decay, float, tuple[LinkTrace, LinkTrace]]:
        """One run whose links have to be asked in the loop, its initial error, p99, and what became of its messages."""
        realisation, inputs = self._realisation(job, realisations), self._inputs(job, realisations)
        relay, steps = self._scenarios[job[0]].relay, self._steps[job[0]]
        links = realisation.link_inputs(relay.uplink, "uplink"), realisation.link_inputs(relay.downlink, "downlink")
        up, down, squares = empty_trace(steps), empty_trace(steps), np.zeros(steps)
        found = run_parts(statistics_over_links, parts, reference, inputs, *links, up, down, squares)
        held = [numbers(trace.held[: found.steps]) for trace in (up, down)]
        of_start = run_parts(decay_over_links, parts, reference, inputs, self._on_reference(job[0]), *held)
        largest, rms, p99 = distances_of(squares[max(0, of_start.settle_1cm_steps) : found.steps])
        return found._replace(deviation_max=largest, deviation_rms=rms), of_start, p99, (up, down)

    def _realisation(self, job: Job, realisations: Realisations) -> ChannelRealisation:
        row, column = job
        return realisations(self._seeds[column], self._steps[row], self._scenarios[row].plant.ts)

    def _reference(self, row: int) -> Floats:
        return self._of_kind(self._kind[row])

    def _make_reference(self, kind: int) -> Floats:
        row = self._kind.index(kind)
        detector = self._scenarios[row].error_detector
        reference: Floats = numbers(reference_of(detector, self._steps[row] + detector.steps_ahead))
        return reference

    def _inputs(self, job: Job, realisations: Realisations) -> RunInputs:
        scenario, realisation = self._scenarios[job[0]], self._realisation(job, realisations)
        return RunInputs(
            numbers(realisation.outcomes(scenario.relay.uplink, "uplink")),
            numbers(realisation.outcomes(scenario.relay.downlink, "downlink")),
            self._start(job[0]),
            self._settings(job[0]),
            numbers(realisation.normals(NOISE)) if scenario.plant.is_noisy else None,
            numbers(realisation.normals(SLIP)) if scenario.plant.slip_noise > 0.0 else None,
        )
