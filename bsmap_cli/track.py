"""How a stage tells of its progress: it calls `track(what, done, total)`; only the command line shows it."""

from typing import Protocol


class Track(Protocol):
    """Called with the name of what is being done, and how much of it (0 <= done <= total)."""

    def __call__(self, what: str, done: int, total: int) -> None: ...


def silent(what: str, done: int, total: int) -> None:
    """Track that shows nothing, the default of every stage."""
