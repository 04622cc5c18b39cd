"""Protocol of entrants: anything that turns state, targets and obstacles into a velocity."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from qpavoid.model.trajectory import Sample
from qpavoid.problem import Array, Solution


class Pilot(Protocol):
    """One entrant, set up for one case.

    A `Controller` is one; other libraries come in through adapters. A pilot that works in another process gives the
    time of its last step there in an attribute `seconds` [s].

    One that works in another process says in an attribute `seconds` what its last step took there [s].
    """

    def step(self, q: Array, t: float, targets: Mapping[str, Sample], obstacles: Mapping[str, Sample]) -> Solution:
        """Compute the velocity for the next control period.

        Args:
            q: configuration (nq,) in the order of the scene's model.
            t: time [s].
            targets: what each task should reach now, by its name.
            obstacles: where each obstacle is seen, and how it moves.

        Raises:
            Exception: it has no velocity for this tick; the robot is held, and asked again at the next one.
        """
        ...
