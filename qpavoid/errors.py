"""Errors that a user can act on: each message names the place, the field and the remedy.

An infeasible tick is not an error (it is a `Solution` with a status); these are for input that cannot be used.
"""

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager


class QpavoidError(Exception):
    """Base of every error that qpavoid raises on purpose."""


class ConfigError(QpavoidError):
    """A file or a field of it cannot be used: missing, mistyped, out of range, wrong shape."""

    def __str__(self) -> str:
        """Return one line of bounded length, whatever the file at fault holds."""
        text = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in super().__str__())
        half = _MAX_LENGTH // 2
        return text if len(text) <= _MAX_LENGTH else f"{text[:half]} … {text[-half:]}"


_MAX_LENGTH = 2000
"""Characters of a message; what a file holds may be of any length. It begins with the place and ends with the
remedy, so the middle is left out."""


class UnknownName(ConfigError):
    """A robot, scenario, frame, joint, body, solver or back end that does not exist."""


class SolverNotInstalled(QpavoidError):
    """A known QP back end whose package is missing."""


class NumericalError(QpavoidError):
    """NaN or infinity in a state or in a command: the input of the step is malformed."""


@contextmanager
def located(where: str) -> Iterator[None]:
    """Put the file and field that an error is about in front of its message."""
    try:
        yield
    except (ConfigError, SolverNotInstalled) as error:
        raise type(error)(f"{where}: {error}") from None


def nearest(name: str, valid: Iterable[str]) -> str:
    """Suggest the nearest valid name as `; did you mean 'x'?`, or list the valid ones."""
    names = sorted(valid)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; valid are {', '.join(names)}" if names else ""
