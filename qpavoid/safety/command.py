"""What is commanded in a control step, while backup trajectories decide about it."""

from __future__ import annotations

from typing import NamedTuple

from qpavoid.problem import Array
from qpavoid.safety.rollout import Start


class Command(NamedTuple):
    """What is commanded in a control step, as far as it is decided."""

    v: Array
    """(nv,)."""
    after: Start
    """State that it leads to."""
    after_task: Start
    """State that the velocity of the solver leads to."""
    is_task: bool
    """Whether it is the velocity of the solver."""

    def to_task(self) -> Command:
        """Return the velocity of the solver as the command."""
        return Command(self.after_task.v, self.after_task, self.after_task, True)
