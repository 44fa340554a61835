"""Structures of arrays: NamedTuples whose fields are arrays with one row an object."""

from typing import Any, TypeVar

T = TypeVar("T", bound=tuple[Any, ...])


def take(table: T, rows: Any) -> T:
    """The same NamedTuple with these rows of every field: an index, a mask or a slice."""
    return type(table)(*(field[rows] for field in table))
