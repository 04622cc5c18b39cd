"""States of the obstacles of a scene at one time, and what a control step is given and says of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from qpavoid.control.updates import Update
from qpavoid.model.cloud import Voxels
from qpavoid.model.sample import STATE, Sample
from qpavoid.problem import Array, IntArray
from qpavoid.reason import Reason


class ObstacleStates(NamedTuple):
    """States of the obstacles at one time."""

    which: IntArray
    """(k,) numbers of those that may have another state than at time 0."""
    states: Array
    """(o, 18) of all obstacles, see `trajectories`; of an attached one, where it was when it was attached."""
    margin: Array
    """(o,) to be taken off the distances to each [m]."""
    voxels: dict[int, Voxels]
    """Of point clouds that were updated, by number: what is in them."""

    @classmethod
    def of(cls, samples: Sequence[Sample], margin: float = 0.0) -> ObstacleStates:
        """Return the states of all obstacles at some samples, with a margin of each [m]."""
        states = np.array([sample.row for sample in samples]).reshape(-1, STATE)
        return cls(np.arange(len(samples)), states, np.full(len(samples), margin), {})


class Observation(NamedTuple):
    """What a control step has to say of the obstacles."""

    assumptions: tuple[Reason, ...] = ()
    """What was not measured but taken for granted."""
    stop: tuple[Reason, ...] = ()
    """Why the robot has to stop; empty if it has not."""


NOTHING = Observation()
"""Where there are no obstacles to know anything of."""


class StepUpdate(NamedTuple):
    """Arguments of a step that concern obstacles, checked; none of them is taken over yet."""

    t: float
    """Time of the step [s]."""
    shift: float
    """By how much the clock was set back [s]."""
    given: Update
    sampled: Sequence[tuple[int, Sample]]
    """Obstacles on a trajectory of another class, sampled."""
