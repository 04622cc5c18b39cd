"""Errors that a user can act on: each message names the place, the field and the remedy.

An infeasible tick is not an error (it is a `Solution` with a status); these are for input that cannot be used.
"""

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase


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


def require_known(name: str, valid: Iterable[str], what: str) -> None:
    """Raise `UnknownName` with place, field and kind of a name (`what`), and the nearest one, unless it is valid."""
    names = list(valid)
    if name not in names:
        raise UnknownName(f"{what} {name!r}{nearest(name, names)}")


def matching(patterns: Iterable[str], valid: Iterable[str], what: str) -> list[str]:
    """List the valid names that match some patterns, each once; `*` and `?` match as in file names.

    Raises:
        UnknownName: a pattern that matches none, as `require_known` says it.
    """
    names, matched = list(valid), dict[str, None]()
    for pattern in patterns:
        matches = [name for name in names if fnmatchcase(name, pattern)]
        if not matches:
            raise UnknownName(f"{what} {pattern!r}{nearest(pattern, names)}")
        matched |= dict.fromkeys(matches)
    return list(matched)
