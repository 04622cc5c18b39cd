"""What is pulled with the mouse: it follows smoothly, so that the controller is given a velocity that is true."""

from __future__ import annotations

import numpy as np

from qpavoid.model.sample import Pose, Sample
from qpavoid.problem import Array

_TIME_CONSTANT = 0.1
"""Time in which a pulled body comes 63 % closer to the mouse [s]: browsers send 20 positions a second."""
_MAX_SPEED = 1.0
"""Largest speed of what is pulled [m/s]: that of a hand; a controller plans for obstacles that can be evaded."""


class Pulled:
    """A body that follows the mouse."""

    def __init__(self, pose: Array) -> None:
        """Begin at a pose (12,): rotation by columns, then position [m]."""
        self._rotation, self._position = pose[:9].reshape(3, 3).T.copy(), pose[9:].copy()
        self._goal, self._linear = self._position.copy(), np.zeros(3)

    def pull(self, pose: Pose) -> None:
        """Choose where it goes from now on; its orientation changes at once."""
        self._goal, self._rotation = pose.position, pose.rotation

    def advance(self, dt: float) -> None:
        """Move on by dt [s]."""
        linear = (self._goal - self._position) / max(_TIME_CONSTANT, dt)
        linear *= min(1.0, _MAX_SPEED / max(float(np.linalg.norm(linear)), 1e-12))
        self._position = self._position + linear * dt
        self._linear = linear

    @property
    def sample(self) -> Sample:
        """Return where it is, and its velocity."""
        return Sample.at(self._position, self._rotation, linear=self._linear)
