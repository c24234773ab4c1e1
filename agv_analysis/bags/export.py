"""Arrays of a bag -> files for other programs: CSV and Parquet, one a topic, or NPZ, one for all."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.recfunctions import repack_fields
from numpy.typing import NDArray

from agv_analysis.bags.bag import Bag
from agv_analysis.bags.bag_errors import BagError

_ROWS = 8192
"""Rows that are turned into text at a time."""


def columns(rows: NDArray[np.void]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Columns of one value a row; those of an array are called "path[0]", "path[1]", or "path[0][1]"."""
    for name in rows.dtype.names or ():
        values = rows[name]
        for index in itertools.product(*map(range, values.shape[1:])):
            place: Any = (slice(None), *index)
            yield name + "".join(f"[{i}]" for i in index), values[place]


def export_csv(bag: Bag, out: Path) -> list[Path]:
    """One CSV file for each topic in the directory `out`: floats in full, times in ns. Raises BagError."""
    return _for_each_topic(bag, out, ".csv", _write_csv)


def export_parquet(bag: Bag, out: Path) -> list[Path]:
    """One Parquet file for each topic in the directory `out`. Raises BagError, if pyarrow is not installed, too."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise BagError("Parquet needs pyarrow, which is not installed: `pip install pyarrow`") from None

    def write(rows: NDArray[np.void], path: Path) -> None:
        table = {
            name: pa.array(_texts(values) if values.dtype.kind == "S" else values) for name, values in columns(rows)
        }
        parquet.write_table(pa.table(table), path)

    return _for_each_topic(bag, out, ".parquet", write)


def export_npz(bag: Bag, out: Path) -> list[Path]:
    """One NPZ file, in which each topic without its first slash is a structured array. Raises BagError."""
    arrays: dict[str, Any] = {topic.lstrip("/"): repack_fields(rows) for topic, rows in bag.arrays.items()}
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with out.open("xb") as file:
            np.savez_compressed(file, **arrays)
    except FileExistsError:
        raise BagError(f"{out}: exists already; name a new file or remove it first") from None
    except OSError as error:
        raise BagError(f"{out}: cannot be written: {error.strerror}") from None
    return [out]


EXPORTS: dict[str, Callable[[Bag, Path], list[Path]]] = {
    "csv": export_csv,
    "parquet": export_parquet,
    "npz": export_npz,
}
"""By the name of the format; each returns the files that it wrote."""


def _for_each_topic(bag: Bag, out: Path, ending: str, write: Callable[[NDArray[np.void], Path], None]) -> list[Path]:
    # No name in ROS has a dot, so that no two topics share a file.
    paths = {topic: out / (topic.strip("/").replace("/", ".") + ending) for topic in bag.arrays}
    try:
        out.mkdir(parents=True, exist_ok=True)
        for topic, path in paths.items():
            if path.exists():
                raise BagError(f"{path}: exists already; name a new directory or remove it first")
            write(bag[topic], path)
    except OSError as error:
        raise BagError(f"{out}: cannot be written: {error.strerror}") from None
    return list(paths.values())


def _write_csv(rows: NDArray[np.void], path: Path) -> None:
    with path.open("x", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([name for name, _ in columns(rows[:0])])
        for begin in range(0, len(rows), _ROWS):
            parts = [_plain(values) for _, values in columns(rows[begin : begin + _ROWS])]
            writer.writerows(zip(*parts, strict=True))


def _plain(values: NDArray[Any]) -> list[Any]:
    return _texts(values) if values.dtype.kind == "S" else list(values.tolist())


def _texts(values: NDArray[Any]) -> list[str]:
    return [value.decode("utf-8", "backslashreplace") for value in values.tolist()]
