"""The configurations that a robot may have, its root left where it is: drawn at random, and moved in."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.model.limits import JointBounds
from qpavoid.problem import Array


class Space:
    """The configurations of a robot, its root left where it is."""

    def __init__(self, model: Any, bounds: JointBounds) -> None:
        """Find the coordinates that move; a range without an end is one of a full turn here."""
        self.model = model
        self._q, self._v = bounds.q_index, bounds.v_index
        finite = np.isfinite(bounds.lower) & np.isfinite(bounds.upper)
        self._lower, self._upper = np.where(finite, bounds.lower, -np.pi), np.where(finite, bounds.upper, np.pi)
        self.free = np.ones(model.nv, dtype=bool)
        """(nv,) coordinates without limits: continuous joints; not a root, whose pose does not matter here."""
        self.free[self._v] = False
        for name, joint in zip(list(model.names)[1:], list(model.joints)[1:], strict=True):
            if name == "root_joint":
                self.free[joint.idx_v : joint.idx_v + joint.nv] = False
        self.moving = self.free.copy()
        """(nv,) coordinates that configurations differ in."""
        self.moving[self._v] = True

    def draw(self, random: np.random.Generator, count: int) -> Array:
        """Draw configurations (count, nq), uniform over the joints' ranges."""
        turns = random.uniform(-np.pi, np.pi, (count, self.model.nv)) * self.free
        neutral = pin.neutral(self.model)
        q = np.array([pin.integrate(self.model, neutral, turn) for turn in turns]).reshape(count, self.model.nq)
        q[:, self._q] = random.uniform(self._lower, self._upper, (count, len(self._q)))
        return q

    def move(self, q: Array, step: Array) -> Array:
        """Return q ⊕ step, clipped to the limits."""
        moved = np.asarray(pin.integrate(self.model, q, step))
        moved[self._q] = np.clip(moved[self._q], self._lower, self._upper)
        return moved
