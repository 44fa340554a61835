"""What can go wrong for a user, and the exit code of each (sysexits.h, where it has one).

A message is one line: what, where, which value, what to do. A programmer's mistake is a ValueError instead.
"""


class BsmapError(Exception):
    """Computation that cannot go on, for example an underdetermined problem."""

    exit_code = 1


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
