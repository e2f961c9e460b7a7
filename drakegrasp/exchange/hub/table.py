"""A table of a folder for the Hub: its columns, its rows as Parquet files.

A configuration of the Hub has a table per split. Images are PNG files in their cells.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.schema import Field

if TYPE_CHECKING:
    import pyarrow as pa

#: Fields by the names of columns. An image is None, or a field that is an image.
Columns = Mapping[str, Field | None]
#: Rows in a file, which takes about 150 MB, and in a group of rows, which is read as a whole.
FILE_ROWS, GROUP_ROWS = 4000, 100


@dataclass(frozen=True, kw_only=True)
class HubTable:
    """The rows of a configuration in a split.

    Attributes:
        config, split: Names.
        what: What the rows are, in a sentence.
        count: Number of rows.
        columns: What they have.
        read: Returns the columns of the rows from one to before another, as lists of JSON types;
            an image is a cell of `png_cell`.
    """

    config: str
    split: str
    what: str
    count: int
    columns: Columns
    read: Callable[[int, int], Mapping[str, Sequence[Any]]]

    def write(self, folder: Path, wrote: Callable[[int], None]) -> Iterator[ParquetFile]:
        """Write the files of the table below a folder, and yield them.

        Args:
            folder: Of all configurations.
            wrote: Called with the number of rows of each group that is written.
        """
        import pyarrow.parquet as pq

        schema, files = _schema(self.columns), -(-self.count // FILE_ROWS)
        for number in range(files):
            rows = range(number * FILE_ROWS, min((number + 1) * FILE_ROWS, self.count))
            path = f"{self.config}/{self.split}-{number:05d}-of-{files:05d}.parquet"
            (folder / self.config).mkdir(exist_ok=True)
            with pq.ParquetWriter(folder / path, schema) as writer:
                for group in self._groups(rows, schema):
                    writer.write_table(group, row_group_size=GROUP_ROWS)
                    wrote(len(group))
            yield ParquetFile(table=self, path=path, rows=len(rows))

    def _groups(self, rows: range, schema: pa.Schema) -> Iterator[pa.Table]:
        """Yield the rows as tables of `GROUP_ROWS`."""
        import pyarrow as pa

        for start in range(rows.start, rows.stop, GROUP_ROWS):
            content = self.read(start, min(start + GROUP_ROWS, rows.stop))
            yield pa.Table.from_pydict(dict(content), schema=schema)


@dataclass(frozen=True, kw_only=True)
class ParquetFile:
    """A file of a hub folder.

    Attributes:
        table: Whose rows it holds.
        path: Below the folder.
        rows: Number of rows.
    """

    table: HubTable
    path: str
    rows: int


def png_cell(pixels: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> dict[str, Any]:
    """Return the cell of an image, as `datasets` reads it."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="PNG")
    return {"bytes": file.getvalue(), "path": None}


def _schema(columns: Columns) -> pa.Schema:
    """Return the schema of the files, with the types that `datasets` reads them as."""
    import pyarrow as pa

    features: dict[str, Any] = {}
    fields = []
    for name, field in columns.items():
        if field is None or field.sample:
            kind = pa.struct({"bytes": pa.binary(), "path": pa.string()})
            features[name] = {"_type": "Image"}
        else:
            text = field.dtype == "str"
            dtype = {"str": "string", "bool": "bool"}.get(field.dtype, field.dtype)
            kind = pa.string() if text else pa.from_numpy_dtype(np.dtype(field.dtype))
            features[name] = {"dtype": dtype, "_type": "Value"}
            for _ in field.axes:
                kind = pa.list_(kind)
                features[name] = {"feature": features[name], "_type": "Sequence"}
        fields.append(pa.field(name, kind))
    metadata: Mapping[str, str] = {"huggingface": json.dumps({"info": {"features": features}})}
    return pa.schema(fields, metadata=dict(metadata))
