"""Structures of arrays: NamedTuples whose fields are arrays with one row an object."""

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T", bound=tuple[Any, ...])


def take(table: T, rows: Any) -> T:
    """The same NamedTuple with these rows of every field: an index, a mask or a slice."""
    return type(table)(*(field[rows] for field in table))


def joined(tables: Sequence[T]) -> T:
    """One NamedTuple with the rows of all, in their order."""
    return type(tables[0])(*(np.concatenate(fields) for fields in zip(*tables, strict=True)))
