# SPDX-License-Identifier: BSD-3-Clause
"""N rows as columns: the base of dataclasses whose fields are arrays."""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """N rows: each field of a subclass is an array of them, or other columns of the same rows; or None.

    Attributes:
        ROW_AXIS: the axis of the rows in every array; 0, or -1 of columns that native code reads one by one.
        SHARED: names of fields that belong to all rows together.
    """

    ROW_AXIS: ClassVar[int] = 0
    SHARED: ClassVar[frozenset[str]] = frozenset()

    def __len__(self) -> int:
        first = getattr(self, _first_name(type(self)))
        return len(first) if isinstance(first, Columns) else first.shape[self.ROW_AXIS]

    def select(self, rows: NDArray) -> Self:
        """The rows of a mask or an index array, contiguous in memory."""
        rows = rows.nonzero()[0] if rows.dtype == bool else rows
        return type(self)(*[self._selected(name, rows) for name in _names(type(self))])

    def joined(self, *others: Self) -> Self:
        """These rows, then those of the others."""
        parts = self, *others
        return type(self)(*(self._joined(name, parts) for name in _names(type(self))))

    def _selected(self, name: str, rows: NDArray) -> Any:
        column = getattr(self, name)
        if column is None or name in self.SHARED:
            return column
        return column.select(rows) if isinstance(column, Columns) else column.take(rows, self.ROW_AXIS)

    def _joined(self, name: str, parts: Iterable[Self]) -> Any:
        first, *others = (getattr(part, name) for part in parts)
        if first is None or name in self.SHARED:
            return first
        if isinstance(first, Columns):
            return first.joined(*others)
        return np.concatenate([first, *others], self.ROW_AXIS)


@cache
def _first_name(kind: type[Columns]) -> str:
    return next(name for name in _names(kind) if name not in kind.SHARED)


@cache
def _names(kind: type[Columns]) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind))
