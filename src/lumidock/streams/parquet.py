"""The fixes of a run as a Parquet table, with the description of the run in its metadata; rows as another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import csv
from pyarrow import parquet as pq

from lumidock.errors import InputError
from lumidock.streams.run_folder import FIX_COLUMNS

_TYPES = {
    **dict.fromkeys(FIX_COLUMNS, pa.float64()),
    **dict.fromkeys(("frame", "status", "stage", "reason", "aiding"), pa.string()),
    **dict.fromkeys(("valid", "guide"), pa.bool_()),
    **dict.fromkeys(("t_ns", "latency_us"), pa.int64()),
    **dict.fromkeys(("n_seen", "n_used"), pa.int32()),
}


def write_parquet(run: Path, path: Path) -> int:
    """Write fixes.csv of a run folder as typed columns, nulls where it is empty; returns the number of rows.

    Raises: InputError, one line, for a table that is none.
    """
    how = csv.ConvertOptions(
        column_types=_TYPES, include_columns=FIX_COLUMNS, true_values=["1"], false_values=["0"], null_values=[""]
    )
    try:
        table = csv.read_csv(run / "fixes.csv", convert_options=how)
        described = (run / "run.json").read_bytes()
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{run}: not a run: {' '.join(str(error).split())}") from None
    pq.write_table(table.replace_schema_metadata({"lumidock": described}), path)
    return int(table.num_rows)


def write_rows(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write rows of numbers and words, whose columns need not be the same, as one table with nulls between."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    columns = {name: [row.get(name) for row in rows] for name in names}
    arrays = {name: _column(values) for name, values in columns.items()}
    pq.write_table(pa.table(arrays), path)


def _column(values: Sequence[Any]) -> pa.Array:
    """Numbers as doubles where one is not whole, so that the type does not hang on which runs there are."""
    if any(isinstance(value, float) for value in values) or all(value is None for value in values):
        return pa.array([None if value is None else float(value) for value in values], pa.float64())
    return pa.array(values)
