"""Arrays of a bag -> files for other programs: CSV, Parquet and TUM trajectories, one a topic, or NPZ, one for all."""

from __future__ import annotations

import contextlib
import csv
import itertools
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TextIO
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags.bag import Bag
from agv_analysis.bags.bag_errors import BagError
from agv_analysis.bags.column_notes import column_notes
from agv_analysis.bags.trajectories import trajectories_of

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
    """One Parquet file for each topic in the directory `out`, its schema with unit and meaning of each column.

    Raises BagError, if pyarrow is not installed, too.
    """
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise BagError("Parquet needs pyarrow, which is not installed: `pip install pyarrow`") from None

    def write(topic: str, rows: NDArray[np.void], path: Path) -> None:
        about, fields, arrays = bag.topics[topic], [], []
        notes = column_notes(about.type, about.schema)
        for name, values in columns(rows):
            array = pa.array(_texts(values) if values.dtype.kind == "S" else values)
            note = notes.get(re.sub(r"(\[\d+\])+$", "", name))
            known = {key: value for key, value in note._asdict().items() if value} if note else {}
            fields.append(pa.field(name, array.type, metadata=known or None))
            arrays.append(array)
        of_topic = {"topic": topic, "type": about.type, "definition": about.schema, "bag": str(bag.path)}
        parquet.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=of_topic)), path)

    return _for_each_topic(bag, out, ".parquet", write)


def export_npz(bag: Bag, out: Path) -> list[Path]:
    """One NPZ file, in which each topic without its first slash is a structured array. Raises BagError.

    It is not compressed: that would take ten times as long as to read the bag, and numpy can map it as it is.
    """
    arrays: dict[str, Any] = {topic.lstrip("/"): _packed(rows) for topic, rows in bag.arrays.items()}
    with _writing(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        with out.open("xb") as file:
            np.savez(file, **arrays)
    return [out]


def export_tum(bag: Bag, out: Path) -> list[Path]:
    """One TUM trajectory for each topic with poses, and each frame of /tf, in the directory `out`. Raises BagError."""
    found = [
        (out / f"{_file_name(topic)}{f'.{_file_name(item.name)}' if item.name else ''}.tum", item)
        for topic, rows in bag.arrays.items()
        for item in trajectories_of(rows)
    ]
    if not found:
        raise BagError(f"{bag.path}: no topic with poses: {', '.join(bag.arrays) or 'no topic at all'}")
    with _writing(out):
        out.mkdir(parents=True, exist_ok=True)
        for path, trajectory in found:
            with _new(path) as file:
                file.writelines(f"{line}\n" for line in trajectory.lines())
    return [path for path, _ in found]


EXPORTS: dict[str, Callable[[Bag, Path], list[Path]]] = {
    "csv": export_csv,
    "parquet": export_parquet,
    "npz": export_npz,
    "tum": export_tum,
}
"""By the name of the format; each returns the files that it wrote."""


def _packed(rows: NDArray[np.void]) -> NDArray[np.void]:
    """The same rows without the bytes that align their values."""
    names = rows.dtype.names or ()
    packed = np.empty(len(rows), [(name, rows.dtype[name]) for name in names])
    for name in names:
        packed[name] = rows[name]
    return packed


def _for_each_topic(
    bag: Bag, out: Path, ending: str, write: Callable[[str, NDArray[np.void], Path], None]
) -> list[Path]:
    # No name in ROS has a dot, so that no two topics share a file.
    paths = {topic: out / f"{_file_name(topic)}{ending}" for topic in bag.arrays}
    with _writing(out):
        out.mkdir(parents=True, exist_ok=True)
        for topic, path in paths.items():
            if path.exists():
                raise FileExistsError(path)
            write(topic, bag.arrays[topic], path)
    return list(paths.values())


def _file_name(name: str) -> str:
    """Name of a file for a topic or frame, whatever characters a bag has in it."""
    return quote(name.strip("/").replace("/", "."), safe="")


def _new(path: Path) -> TextIO:
    return path.open("x", encoding="utf-8", newline="")


@contextlib.contextmanager
def _writing(out: Path) -> Iterator[None]:
    """Turn what goes wrong with files into a BagError."""
    try:
        yield
    except FileExistsError as error:
        raise BagError(f"{error.filename or error}: exists already; name a new one or remove it first") from None
    except OSError as error:
        raise BagError(f"{out}: cannot be written: {error.strerror}") from None


def _write_csv(_: str, rows: NDArray[np.void], path: Path) -> None:
    with _new(path) as file:
        writer = csv.writer(file)
        writer.writerow([name for name, _ in columns(rows[:0])])
        for begin in range(0, len(rows), _ROWS):
            parts = [_plain(values) for _, values in columns(rows[begin : begin + _ROWS])]
            writer.writerows(zip(*parts, strict=True))


def _plain(values: NDArray[Any]) -> list[Any]:
    return _texts(values) if values.dtype.kind == "S" else list(values.tolist())


def _texts(values: NDArray[Any]) -> list[str]:
    return [value.decode("utf-8", "backslashreplace") for value in values.tolist()]
