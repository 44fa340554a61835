"""What can go wrong for a user, and the exit code of each (sysexits.h, where it has one).

A message is one line: what, where, which value, what to do. A programmer's mistake is a ValueError instead.
"""


class BsmapError(Exception):
    """Computation that cannot go on, for example an underdetermined problem."""

    exit_code = 1


class PlacementError(BsmapError):
    """A map that cannot be brought together with others: they do not overlap, or it could lie elsewhere as well.

    survey : its number among those given.  reason : without its name.
    """

    exit_code = 3

    def __init__(self, survey: int, reason: str, name: str = "") -> None:
        super().__init__(f"{name or f'map {survey + 1}'}: {reason}")
        self.survey, self.reason = survey, reason


class ParameterError(BsmapError):
    """An option's value, or a combination of options, that makes no sense."""

    exit_code = 2


class BadInputError(BsmapError):
    """A file that is there but damaged, of another kind, or lacks what the stage needs."""

    exit_code = 65


class MissingInputError(BsmapError):
    """A file that is not there or cannot be opened."""

    exit_code = 66


class MissingLibraryError(BsmapError):
    """A shared library or package that this machine lacks."""

    exit_code = 69


class CannotWriteError(BsmapError):
    """An output that cannot be written."""

    exit_code = 73
