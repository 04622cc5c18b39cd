"""Time that a control step may take, where a program sets a limit: work beyond it is left out, or goes on later."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import inf
from time import perf_counter


class BudgetSpent(Exception):
    """The budget of a control step is spent: raised and caught within the step."""


class Budget:
    """Time for one control step after the other, by a clock."""

    def __init__(self, seconds: float = inf, clock: Callable[[], float] = perf_counter) -> None:
        """Take over the time of each step [s]; tests give a clock of their own."""
        self.is_limited, self._seconds, self._clock, self._end = seconds < inf, seconds, clock, inf

    def begin(self) -> None:
        """Begin a control step."""
        if self.is_limited:
            self._end = self._clock() + self._seconds

    @contextmanager
    def suspended(self) -> Iterator[None]:
        """Let what is done within take as long as it takes."""
        is_limited, self.is_limited = self.is_limited, False
        try:
            yield
        finally:
            self.is_limited = is_limited

    @property
    def is_spent(self) -> bool:
        """Whether the step has taken its time."""
        return self.is_limited and self._clock() >= self._end

    def check(self, work: str) -> None:
        """Raise `BudgetSpent`, which names the work that is left out, where the budget is spent."""
        if self.is_spent:
            raise BudgetSpent(work)


UNLIMITED = Budget()
"""Of a step that may take as long as it takes."""
