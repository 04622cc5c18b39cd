"""What commands share: progress on stderr, and a polite end."""

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
    """Bars on stderr: what, how far, how many, how long still."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=ERR,
        speed_estimate_period=_REMEMBERED,
    )


_REMEMBERED = 300.0
"""The time that is left is worked out from what was done within so many seconds [s]."""


@contextmanager
def terminate_like_interrupt() -> Iterator[None]:
    """A polite kill ends a run as Ctrl-C does: what was recorded is kept."""

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def names_of(option: str, text: str) -> list[str]:
    """Names with commas between them.

    Raises:
        ConfigError: there is none.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise ConfigError(f"{option}: names none; give some, as in tracking,eq10,qp")
    return names
