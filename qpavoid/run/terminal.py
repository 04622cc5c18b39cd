"""Progress bars on stderr, termination and lists of names, as all commands have them."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from qpavoid.errors import ConfigError

OUT = Console()
ERR = Console(stderr=True)


def progress() -> Progress:
    """Make progress bars on stderr: job, bar, count, remaining time."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=ERR,
        speed_estimate_period=_SPEED_WINDOW,
    )


_SPEED_WINDOW = 300.0
"""Window over which the remaining time is estimated [s]: runs of a sweep differ by minutes."""


@contextmanager
def terminate_like_interrupt() -> Iterator[None]:
    """End a run at SIGTERM as at Ctrl-C: the steps recorded so far are saved."""

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    handler_before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, handler_before)


def names_of(option: str, text: str) -> list[str]:
    """Split a list of names at its commas.

    Raises:
        ConfigError: there is none.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise ConfigError(f"{option}: names none; give some, as in tracking,eq10,qp")
    return names
