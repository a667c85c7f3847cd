"""Tables of results in memory, as numpy arrays by column; pandas only for those who ask for it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Self, TypeAlias

import numpy as np
from numpy.typing import DTypeLike

from calib.errors import UsageError, one_of
from calib.workers.extras import needing

if TYPE_CHECKING:
    import pandas

    DataFrame: TypeAlias = pandas.DataFrame

# Rows and columns that ``print`` shows of a table.
SHOWN_ROWS = 10
SHOWN_COLUMNS = 12


class ResultTable:
    """Rows of a result with named columns: ``table["dx [mm]"]`` is the array (m,) of a column.

    Columns of texts are arrays of str, all others of float, with NaN for an empty cell. ``len`` is the number of rows,
    iteration yields the rows as tuples, ``numpy.asarray`` the structured array of `to_numpy`.

    Attributes:
        columns: names of the columns, with their units.
    """

    def __init__(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Create a table of columns (m,) by name."""
        self.columns = tuple(arrays)
        self._arrays = dict(arrays)

    @classmethod
    def of_rows(cls, rows: Iterable[Sequence[object]], columns: Sequence[str]) -> Self:
        """Return the table of rows with one cell for each of the named columns."""
        cells = list(zip(*rows)) or [()] * len(columns)
        arrays = map(_column, cells)
        return cls(dict(zip(columns, arrays, strict=True)))

    def __getitem__(self, column: str) -> np.ndarray:
        """Return a column (m,).

        Raises:
            UsageError: there is no column of this name.
        """
        one_of(column, self.columns, "column", UsageError)
        return self._arrays[column]

    def __len__(self) -> int:
        return len(self._arrays[self.columns[0]])

    def __iter__(self) -> Iterator[tuple[object, ...]]:
        return iter(self.to_numpy().tolist())

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self.to_numpy(), dtype=dtype)

    def to_numpy(self) -> np.ndarray:
        """Return the rows as a structured array (m,), whose fields are the columns."""
        fields = [(name, values.dtype) for name, values in self._arrays.items()]
        array = np.empty(len(self), dtype=fields)
        for name in self.columns:
            array[name] = self._arrays[name]
        return array

    def to_dict(self) -> dict[str, list[object]]:
        """Return the columns by name, as lists."""
        return {name: values.tolist() for name, values in self._arrays.items()}

    def to_dataframe(self) -> DataFrame:
        """Return the table as a pandas DataFrame.

        Raises:
            UsageError: pandas is not installed.
        """
        return data_frame(self, self.columns)

    def __repr__(self) -> str:
        return f"<ResultTable: {len(self)} rows of {', '.join(self.columns)}>"

    def __str__(self) -> str:
        rows: list[tuple[object, ...]] = [self.columns]
        rows += list(self)[:SHOWN_ROWS]
        columns = []
        for cells in list(zip(*rows))[:SHOWN_COLUMNS]:
            texts = list(map(_shown, cells))
            width = max(map(len, texts))
            columns.append([text.ljust(width) for text in texts])
        lines = ["  ".join(cells).rstrip() for cells in zip(*columns)]
        if len(self) > SHOWN_ROWS or len(self.columns) > SHOWN_COLUMNS:
            lines.append(f"… {len(self)} rows, {len(self.columns)} columns")
        return "\n".join(lines)


def _column(values: Sequence[object]) -> np.ndarray:
    """Return the cells of a column as an array of str if any is a text, else of float, with NaN for None and ""."""
    texts = [value for value in values if isinstance(value, str)]
    if len(texts) == len(values) or any(texts):
        return np.array(values, dtype=str)
    numbers = np.full(len(values), np.nan)
    for number, value in enumerate(values):
        if value is not None and value != "":
            numbers[number] = value
    return numbers


def _shown(cell: object) -> str:
    """Return a cell as a text, with six digits of a number."""
    if isinstance(cell, float):
        return f"{cell:.6g}"
    return str(cell)


def data_frame(rows: Iterable[object], columns: Sequence[str]) -> DataFrame:
    """Return rows as a pandas DataFrame with the given columns.

    Args:
        rows: sequences or records, one per row.
        columns: names of the columns.

    Raises:
        UsageError: pandas is not installed.
    """
    with needing("pandas", "; to_dict() and save() do without"):
        import pandas
    return pandas.DataFrame(list(rows), columns=list(columns))
