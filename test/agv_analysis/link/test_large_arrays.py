"""Columns in a file behave as those in memory do, and give their memory back; order statistics against a sort."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from agv_analysis.link import large_arrays
from agv_analysis.link.large_arrays import (
    Column,
    column_of,
    firsts_in_order,
    median_step,
    order_statistics,
    parts,
    places_in_order,
    release,
    sizes_and_counts,
)


def test_a_column_in_a_file_holds_what_one_in_memory_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    written = [rng.standard_normal(n) for n in (10, 5000, 1, 0, 70_000)]
    in_memory = column_of(written, np.float64)
    monkeypatch.setattr(large_arrays, "_IN_MEMORY", 1 << 16)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    in_file = column_of(written, np.float64)
    np.testing.assert_array_equal(in_file, in_memory)
    in_file[7] = 42.0
    release(in_file)
    assert in_file[7] == 42.0
    assert not list(tmp_path.iterdir())  # without a name


def test_what_was_not_written_is_0(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(large_arrays, "_IN_MEMORY", 1 << 10)
    column = Column(np.int8)
    column.reach(3000)
    column.extend(np.ones(5, dtype=np.int8))
    assert len(column) == 3005
    assert column.values.sum() == 5


def test_memory_of_a_column_in_a_file_is_given_back(monkeypatch: pytest.MonkeyPatch) -> None:
    def mapped() -> int:
        """Bytes of files in this process's memory."""
        status = Path("/proc/self/status").read_text()
        return sum(1024 * int(line.split()[1]) for line in status.splitlines() if line.startswith("RssFile"))

    monkeypatch.setattr(large_arrays, "_IN_MEMORY", 1 << 16)
    before = mapped()
    values = column_of((np.ones(large_arrays.PART) for _ in range(100)), np.float64)  # 100 MB
    assert sum(float(values[part].sum()) for part in parts(len(values), values)) == 100.0 * large_arrays.PART
    assert mapped() - before < 10e6


@pytest.mark.parametrize("size", [1, 2, 1000, 100_000])
def test_order_statistics_are_those_of_a_sort(size: int) -> None:
    rng = np.random.default_rng(size)
    values = np.concatenate((rng.standard_normal(size), rng.integers(-3, 3, size), 1e-300 * rng.standard_normal(size)))
    ordered, ranks = np.sort(values), [0, size, len(values) // 2, len(values) - 1]
    found = order_statistics(lambda: np.array_split(values, 7), ranks)
    np.testing.assert_array_equal(found, ordered[ranks])


def test_sizes_and_counts_are_those_of_the_values() -> None:
    values = np.random.default_rng(1).exponential(0.01, 10_000)
    sizes, counts = sizes_and_counts(lambda: np.array_split(values, 3))
    assert counts.sum() == len(values)
    assert (np.diff(sizes) > 0.0).all()
    each, ordered = np.repeat(sizes, counts), np.sort(values)
    assert (each <= ordered).all()
    assert (ordered <= each * (1.0 + 2.0**-8)).all()


@pytest.mark.parametrize("dtype", [np.float64, np.uint64, np.int64])
def test_a_large_array_is_sorted_as_a_small_one_is(dtype: type, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    drawn = np.concatenate((rng.integers(0, 50, 3000), rng.integers(0, 2**60, 2000), np.full(400, 7)))
    values: NDArray[Any] = rng.permutation(drawn).astype(dtype)
    ordered, firsts = np.argsort(values, kind="stable"), np.unique(values, return_index=True)[1]
    monkeypatch.setattr(large_arrays, "_TOGETHER", 256)
    monkeypatch.setattr(large_arrays, "_SAMPLED", 4)
    np.testing.assert_array_equal(places_in_order(values), ordered)
    np.testing.assert_array_equal(firsts_in_order(values), firsts)
    assert firsts_in_order(np.arange(5)) is None


def test_the_median_step_is_that_of_all_steps() -> None:
    for count in (2, 3, 10, 1001):
        times = np.cumsum(np.random.default_rng(count).exponential(0.02, count))
        assert median_step(times) == np.median(np.diff(times))
