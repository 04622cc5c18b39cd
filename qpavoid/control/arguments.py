"""Arguments of a control step, all checked before anything is changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from qpavoid.control.inputs import LARGEST_COMMAND, LARGEST_VELOCITY, Clock, Configurations, Times, check_velocity
from qpavoid.control.obstacle_states import StepUpdate
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.control.targets import TargetReader
from qpavoid.problem import Array, as_vector
from qpavoid.reason import Reason

Obstacles = Mapping[str, Any] | Mapping[tuple[str, ...], Array] | Array | None
"""What a step is given of obstacles, see `Controller.step`."""
Arguments = tuple[
    Times,
    Array | None,
    Array | None,
    Array | None,
    Sequence[Any],
    StepUpdate | None,
    tuple[Reason, ...],
    tuple[Reason, ...],
]
"""Arguments of a step, checked; nothing has been changed by them yet: times; q (nq,), None where it cannot be true; v
(nv,) as measured, None where it is not given, or cannot be true; velocity (nv,) to follow in place of the tasks, zero
where it cannot be true; targets of all tasks; update of obstacles; why the robot has to stop; notes."""


class ArgumentReader:
    """Checks the arguments of the steps of one controller."""

    def __init__(
        self,
        shapes: tuple[tuple[int, ...], tuple[int, ...]],
        clock: Clock,
        configurations: Configurations,
        targets: TargetReader,
        obstacles: ObstacleTracker,
    ) -> None:
        """Take over who checks what; `shapes` are those of q and v."""
        self._q_shape, self._v_shape = shapes
        self._clock, self._configurations, self._targets, self._obstacles = clock, configurations, targets, obstacles

    def read(
        self, q: Any, t: Any, targets: Mapping[str, Any] | None, obstacles: Obstacles, v: Any,
        v_desired: Any = None,
    ) -> Arguments:  # fmt: skip
        """Check the arguments of a step, see `Controller.step`: whatever raises does so here."""
        q = as_vector("q", q, self._q_shape)
        times = self._clock.read(t)
        q, faults, notes = self._configurations.read("q", q)
        q = None if faults else q
        if v is not None:
            v = as_vector("v", v, self._v_shape)
            if wrong := check_velocity("v", v, LARGEST_VELOCITY):
                v, faults = None, wrong + faults
        faults += times.faults
        if v_desired is not None and (wrong := check_velocity("v_desired", v_desired, LARGEST_COMMAND)):
            v_desired, faults = np.zeros(self._v_shape), faults + wrong
        samples, missing, normalised = self._targets.read(times.t, targets)
        update = self._obstacles.read(times.t, obstacles, times.shift)
        return times, q, v, v_desired, samples, update, faults + missing, times.notes + notes + normalised
