"""Everything that one control step computed, for logs and figures."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from qpavoid.model.kinematics import Kinematics
from qpavoid.problem import Array, Problem, Proximity, Solution, State


class Tick(NamedTuple):
    """Everything that one tick computed."""

    state: State
    """q, v and t that the step was computed for."""
    targets: tuple[Any, ...]
    """One for each of the controller's tasks."""
    errors: Array
    """How far each of the tasks that are not frames was from its target, in its unit."""
    kinematics: Kinematics
    """Poses of the tracked frames, and the Jacobian of every joint."""
    proximity: Proximity
    """Distances, normals and witness points of the pairs within the influence distance, by their numbers in `pair`."""
    problem: Problem
    """What the solver was asked: rows, bounds, tracking velocity, and the names of all pairs."""
    solution: Solution
    """What is commanded, and why."""
    obstacles: Array
    """(o, 12) where the step took the obstacles to be, by their numbers: rotation by columns, then position [m]."""
    backup: Array
    """(k, nv) displacement in each control step of the backup trajectory that begins where this step leads [rad or m];
    none where no obstacle moves near."""


def copied(value: Any) -> Any:
    """The same with arrays of its own: what a tick computed stays as it was when the next one comes."""
    if isinstance(value, np.ndarray):
        return value.copy()
    if hasattr(value, "_fields"):
        return type(value)(*map(copied, value))
    return value
