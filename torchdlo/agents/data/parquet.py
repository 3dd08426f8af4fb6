"""Tables of a set as Parquet files, through pyarrow."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.errors import InputError

__all__ = ["frame_table", "import_pyarrow", "read_table", "tasks_table", "write_tables"]


def import_pyarrow() -> tuple[Any, Any]:
    """Return pyarrow and its part for Parquet, or say how to get it."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise InputError("data sets need pyarrow; install it with pip install 'torchdlo[dataset]'.") from None
    return pyarrow, pyarrow.parquet


def frame_table(columns: Mapping[str, np.ndarray]) -> Any:
    """Return columns as a table: vectors as lists of fixed size, single numbers as they are."""
    pa, _ = import_pyarrow()
    arrays = {}
    for name, x in columns.items():
        flat = pa.array(np.ascontiguousarray(x).reshape(-1))
        arrays[name] = flat if x.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, x.shape[1])
    return pa.table(arrays)


def tasks_table(sentences: Sequence[str]) -> Any:
    """Return the table of instructions. Readers take the sentences for its index, as pandas would have written it."""
    pa, _ = import_pyarrow()
    table = pa.table(
        {"task_index": pa.array(range(len(sentences)), pa.int64()), "task": pa.array(list(sentences), pa.string())}
    )
    columns = [
        {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"},
        {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object"},
    ]
    content = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [column | {"metadata": None} for column in columns],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.0.0",
    }
    return table.replace_schema_metadata({b"pandas": json.dumps(content).encode()})


def write_tables(path: Path, tables: Sequence[Any]) -> None:
    """Write tables of one schema to a file, each as a row group of its own."""
    _, pq = import_pyarrow()
    with pq.ParquetWriter(path, tables[0].schema, compression="snappy", store_schema=True) as writer:
        for table in tables:
            writer.write_table(table, row_group_size=max(1, len(table)))


def read_table(path: Path) -> Any:
    """Return the table in a file."""
    pa, pq = import_pyarrow()
    if not path.is_file():
        raise InputError(f"{path}: the file is missing.")
    try:
        return pq.read_table(path, partitioning=None)
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: it is damaged and cannot be read ({str(error).splitlines()[0][:120]}).") from None
