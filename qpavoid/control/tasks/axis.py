"""An axis of a frame that points at a point, or in a direction."""

from __future__ import annotations

from math import atan2
from typing import Any

import numpy as np

from qpavoid import config
from qpavoid.control.tasks.base import Constant, RowTask, Target, frame_pose, length
from qpavoid.control.tasks.start import Start
from qpavoid.errors import ConfigError
from qpavoid.kernels.obstacles import FARTHEST
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.model.sample import as_goal
from qpavoid.problem import Array, as_vector

_ALIGNED = 1e-9
"""Sine of the angle between two directions below which any turn across them is as good as another [-]."""


class Axis(RowTask):
    """An axis of a frame that points at a point, or in a direction of the world.

    With the unit axis a, the wanted direction d and the angle θ between them, the rows are the rates, seen from the
    frame, at which d moves towards a and across: τ·(ḋ - ω × d), τ = (a - (a·d) d)/sin θ, and the same with d × τ.
    Wanted are K θ and 0. Of a point at distance ρ, ḋ = (I - d dᵀ)(ṗ - ẋ)/ρ. Regular but where d = -a.
    """

    unit = "rad"

    def __init__(self, settings: config.LookAtTask | config.AlignTask, start: Start) -> None:
        self._looks = isinstance(settings, config.LookAtTask)
        motion: Target
        if isinstance(settings, config.LookAtTask):
            motion = start.motion(settings.motion)
        else:
            motion = Constant(_unit(settings.direction, f"{start.where}.direction"))
        super().__init__(settings, motion, 2, (start.frame_id(settings.frame),))
        self._gain = settings.gain
        self._axis = _unit(settings.axis, f"{start.where}.axis")

    def write_rows(self, q: Array, kinematics: ForwardKinematics, target: Any, A: Array, b: Array) -> float:
        """See `RowTask.write_rows`."""
        (frame_id,) = self.frame_ids
        x, R = frame_pose(kinematics, frame_id)
        J = kinematics.frame_jacobian(frame_id)
        direction = target.position - x if self._looks else target
        distance = max(length(direction), 1e-6)
        d, a = direction / distance, R @ self._axis
        across = _across(a, d)
        angle = atan2(length(np.cross(a, d)), np.dot(a, d))
        rates = np.cross(across, d) @ J[3:]  # -τ·(ω × d) = ω·(τ × d)
        desired = np.array([self._gain * angle, 0.0])
        if self._looks:
            rates -= across @ J[:3] / distance
            desired -= across @ target.linear / distance
        self._scale_into(A, b, rates, desired)
        return angle

    def as_target(self, value: Any) -> Any:
        """Check a `Sample` of the point to look at, or a direction (3,) to align with."""
        return as_goal(value) if self._looks else as_vector("direction", value, (3,))

    def fault(self, target: Any) -> str:
        """See `RowTask.fault`."""
        if not np.abs(target).max() <= FARTHEST:
            return "NaN, infinity or too large"
        return "" if length(target) > _ALIGNED else "a direction of no length"


def _across(a: Array, d: Array) -> Array:
    """Unit directions (2, 3) across d: that towards a, and the one that is left."""
    toward = a - np.dot(a, d) * d
    if length(toward) < _ALIGNED:
        toward = np.cross(d, np.eye(3)[np.argmin(np.abs(d))])
    toward = toward / length(toward)
    return np.array((toward, np.cross(d, toward)))


def _unit(vector: tuple[float, float, float], where: str) -> Array:
    size = float(np.linalg.norm(vector))
    if size < _ALIGNED:
        raise ConfigError(f"{where} has no length; give a direction such as [0, 0, 1]")
    return np.array(vector) / size
