"""Rows of results as a file: CSV or Parquet."""

from __future__ import annotations

import csv
import importlib
from pathlib import Path
from typing import Any

from agv_analysis.output_file import not_linked_out
from agv_analysis.sweep.plan import SweepError


def write_rows(rows: list[dict[str, Any]], path: Path) -> None:
    """Write rows to a .csv or a .parquet file in a directory of ours. Raises SweepError if that cannot be done."""
    not_linked_out(path)
    try:
        if path.suffix == ".parquet":
            _write_parquet(rows, path)
        else:
            with open(path, "w", encoding="utf-8", newline="") as file:
                writer = csv.DictWriter(file, list(rows[0]))
                writer.writeheader()
                writer.writerows(rows)
    except OSError as error:
        raise SweepError(f"{path}: cannot be written: {error}") from None


def _write_parquet(rows: list[dict[str, Any]], path: Path) -> None:
    try:
        arrow: Any = importlib.import_module("pyarrow")
        parquet: Any = importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise SweepError(f"{path}: Parquet needs pyarrow: pip install pyarrow, or take --format csv") from None
    parquet.write_table(arrow.Table.from_pylist(rows), path)
