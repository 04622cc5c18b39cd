"""Tasks that are not a frame following a motion: each writes its rows A v = b into the memory of the tick.

They get a place in A and b when a controller is made, and are asked for their rows in every tick. Where none is used,
a tick has nothing to do with this module.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import pinocchio as pin

from qpavoid import config
from qpavoid.control.inputs import FARTHEST, Configurations
from qpavoid.control.poses import as_goal
from qpavoid.errors import NumericalError
from qpavoid.kernels.rotation import rotation_vector
from qpavoid.model.kinematics import ForwardKinematics, columns, support_masks
from qpavoid.problem import Array, IntArray, as_vector

_PARTS = {"position": slice(0, 3), "orientation": slice(3, 6), "pose": slice(0, 6)}
"""Rows of a frame's Jacobian, [linear, angular]."""
_ALIGNED = 1e-9
"""Sine of the angle between two directions below which any turn across them is as good as another [-]."""


class Target(Protocol):
    """What a task is to reach, as a function of time."""

    def sample(self, t: float) -> Any:
        """The target at t [s]: a `Sample`, or what else the task's `as_target` gives."""


class Constant:
    """A target that is the same at all times."""

    def __init__(self, value: Any = None) -> None:
        self.value = value

    def sample(self, t: float) -> Any:
        """See `Target.sample`."""
        return self.value


class RowTask:
    """What all of them share: a target, and rows in the memory of the tick."""

    unit = "m"
    """Of its error; `m` counts for the goal of a scenario."""

    def __init__(
        self, settings: config.TaskBlock, model: Any, motion: Target, rows: int, frame_ids: tuple[int, ...] = ()
    ) -> None:
        """Takes what is known beforehand.

        Args:
            settings: its block of a scenario.
            model: pinocchio model.
            motion: its target.
            rows: how many it has.
            frame_ids: frames that have to be up to date when its rows are written.
        """
        self.settings, self.motion, self.rows, self.frame_ids = settings, motion, rows, frame_ids
        self.scale = np.full(rows, np.sqrt(settings.weight))
        """(rows,) roots of the weights."""
        self.error = 0.0
        """How far from its target it was at the last tick, in its unit."""
        self._model = model

    def lay_out(self, A: Array, b: Array) -> None:
        """Takes its place in the memory of the tick: A (rows, nv), b (rows,)."""
        self._A, self._b = A, b

    def update(self, q: Array, kinematics: ForwardKinematics, target: Any) -> None:
        """Writes its rows at q (nq,), for which the kinematics are up to date."""
        raise NotImplementedError

    def as_target(self, value: Any) -> Any:
        """A target that was given at run time, checked: here, a `Sample` or a `Pose` that rests.

        Raises:
            NumericalError: of the wrong kind or shape, or the task has no target.
        """
        if isinstance(self.motion, Constant) and self.motion.value is None:
            raise NumericalError(f"a task of type {getattr(self.settings, 'type', '?')} takes none; leave it out")
        return as_goal(value)

    def fault(self, target: Any) -> str:
        """Say why a target that is no `Sample` cannot be true; nothing if it can."""
        return ""

    def _write(self, J: Array, wanted: Array, error: Array) -> None:
        np.multiply(J, self.scale[:, None], out=self._A)
        np.multiply(wanted, self.scale, out=self._b)
        self.error = _length(error)


class Relative(RowTask):
    """Pose of one frame in the axes of another one, X = M_a⁻¹ M_b.

    d/dt of its position is Rₐᵀ (ẋ_b - ẋ_a - ω_a × (x_b - x_a)), its angular velocity Rₐᵀ (ω_b - ω_a).
    """

    def __init__(self, settings: config.RelativeTask, model: Any, motion: Target, a: int, b: int) -> None:
        self._part, self._gain = _PARTS[settings.rows], settings.gain
        super().__init__(settings, model, motion, self._part.stop - self._part.start, (a, b))
        weights = np.repeat([settings.weight, settings.orientation_weight], 3)
        self.scale = np.sqrt(weights)[self._part]
        self.unit = "rad" if settings.rows == "orientation" else "m"

    def update(self, q: Array, kinematics: ForwardKinematics, target: Any) -> None:
        """See `RowTask.update`."""
        a, b = self.frame_ids
        (x_a, R_a), (x_b, R_b) = frame_pose(kinematics, a), frame_pose(kinematics, b)
        J_a, J = frame_jacobian(self._model, kinematics, a), frame_jacobian(self._model, kinematics, b)
        J -= J_a
        J[:3] += pin.skew(x_b - x_a) @ J_a[3:]  # -ω × r = r × ω
        J = (R_a.T @ J.reshape(2, 3, -1)).reshape(6, -1)
        missing = target.rotation @ (R_a.T @ R_b).T
        error = np.concatenate((target.position - R_a.T @ (x_b - x_a), rotation_vector(missing.tolist())))
        wanted = np.concatenate((target.linear, target.angular)) + self._gain * error
        self._write(J[self._part], wanted[self._part], error[self._part])
        if self.unit == "m":
            self.error = _length(error[:3])


class Com(RowTask):
    """Centre of mass of the robot, world."""

    def __init__(self, settings: config.ComTask, model: Any, motion: Target) -> None:
        super().__init__(settings, model, motion, len(settings.axes))
        self._gain = settings.gain

    def update(self, q: Array, kinematics: ForwardKinematics, target: Any) -> None:
        """See `RowTask.update`."""
        n = self.rows
        J = pin.jacobianCenterOfMass(self._model, kinematics.data, False)
        error = (target.position - kinematics.data.com[0])[:n]
        self._write(J[:n], target.linear[:n] + self._gain * error, error)


class Damping(RowTask):
    """Rest of some coordinates: v = 0. Its rows never change."""

    unit = "rad"

    def __init__(self, settings: config.TaskBlock, model: Any, motion: Target, coordinates: IntArray) -> None:
        super().__init__(settings, model, motion, len(coordinates))
        self._coordinates = coordinates

    def lay_out(self, A: Array, b: Array) -> None:
        """See `RowTask.lay_out`."""
        super().lay_out(A, b)
        A[:], b[:] = 0.0, 0.0
        A[np.arange(self.rows), self._coordinates] = self.scale

    def update(self, q: Array, kinematics: ForwardKinematics, target: Any) -> None:
        """Nothing to do."""


class Posture(Damping):
    """Velocity of some coordinates along the shortest way to a configuration: v = K (q_ref ⊖ q)."""

    def __init__(self, settings: config.PostureTask, model: Any, motion: Target, coordinates: IntArray) -> None:
        super().__init__(settings, model, motion, coordinates)
        self._asked = settings.gain * self.scale
        self._configurations = Configurations(model)

    def update(self, q: Array, kinematics: ForwardKinematics, target: Any) -> None:
        """See `RowTask.update`."""
        error = pin.difference(self._model, q, target)[self._coordinates]
        np.multiply(error, self._asked, out=self._b)
        self.error = _length(error)

    def as_target(self, value: Any) -> Any:
        """A configuration (nq,)."""
        return as_vector("q", value, (self._model.nq,))

    def fault(self, target: Any) -> str:
        """See `RowTask.fault`."""
        faults = self._configurations.read("q", target)[1]
        return str(faults[0]) if faults else ""


class Axis(RowTask):
    """An axis of a frame that points at a point, or in a direction of the world.

    With the unit axis a, the wanted direction d and the angle θ between them, the rows are the rates, seen from the
    frame, at which d moves towards a and across: τ·(ḋ - ω × d), τ = (a - (a·d) d)/sin θ, and the same with d × τ.
    Wanted are K θ and 0. Of a point at distance ρ, ḋ = (I - d dᵀ)(ṗ - ẋ)/ρ. Regular but where d = -a.
    """

    unit = "rad"

    def __init__(
        self, settings: config.LookAtTask | config.AlignTask, model: Any, motion: Target, frame_id: int, axis: Array
    ) -> None:
        super().__init__(settings, model, motion, 2, (frame_id,))
        self._gain, self._axis = settings.gain, axis
        self._looks = isinstance(settings, config.LookAtTask)

    def update(self, q: Array, kinematics: ForwardKinematics, target: Any) -> None:
        """See `RowTask.update`."""
        (frame_id,) = self.frame_ids
        x, R = frame_pose(kinematics, frame_id)
        J = frame_jacobian(self._model, kinematics, frame_id)
        way = target.position - x if self._looks else target
        distance = max(_length(way), 1e-6)
        d, a = way / distance, R @ self._axis
        across = np.array(_across(a, d))
        rates = np.cross(across, d) @ J[3:]  # -τ·(ω × d) = ω·(τ × d)
        angle = float(np.arctan2(_length(np.cross(a, d)), np.dot(a, d)))
        wanted = np.array([self._gain * angle, 0.0])
        if self._looks:
            rates -= across @ J[:3] / distance
            wanted -= across @ target.linear / distance
        self._write(rates, wanted, np.array([angle]))

    def as_target(self, value: Any) -> Any:
        """A `Sample` of the point to look at, or a direction (3,) to align with."""
        return as_goal(value) if self._looks else as_vector("direction", value, (3,))

    def fault(self, target: Any) -> str:
        """See `RowTask.fault`."""
        if not np.abs(target).max() <= FARTHEST:
            return "NaN, infinity or too large"
        return "" if _length(target) > _ALIGNED else "a direction of no length"


class Manipulability(RowTask):
    """One row ∇w·v = K ‖∇w‖²: ascent of w = √det(J Jᵀ) (Yoshikawa 1985), along its gradient and free across it.

    ∂w/∂q_i = w tr(∂J/∂q_i J⁺). In the frame's own axes, on which w does not depend, ∂J_j/∂q_i = J_j × J_i (of motion
    vectors) where joint i lies beyond joint j, and 0 elsewhere. `error` is w.
    """

    unit = "w"

    def __init__(self, settings: config.ManipulabilityTask, model: Any, motion: Target, frame_id: int) -> None:
        super().__init__(settings, model, motion, 1, (frame_id,))
        self._part, self._gain = _PARTS[settings.rows], settings.gain
        masks, joints = support_masks(model), np.zeros(model.nvExtended, dtype=np.intp)
        for i, joint in enumerate(list(model.joints)[1:], start=1):
            joints[joint.idx_vExtended : joint.idx_vExtended + joint.nvExtended] = i
        self._support = masks[model.frames[frame_id].parentJoint]
        self._beyond = masks[joints] * (joints[:, None] != joints)
        self._fold = np.eye(model.nv)[columns(model)]

    def update(self, q: Array, kinematics: ForwardKinematics, target: Any) -> None:
        """See `RowTask.update`."""
        self.error, gradient = self.measure(kinematics)
        np.multiply(gradient, self.scale, out=self._A[0])
        self._b[:] = self._gain * np.dot(gradient, gradient) * self.scale

    def measure(self, kinematics: ForwardKinematics) -> tuple[float, Array]:
        """w and its gradient (nv,)."""
        x, R = frame_pose(kinematics, self.frame_ids[0])
        linear, angular = kinematics.J[:3] * self._support, kinematics.J[3:] * self._support
        V, W = R.T @ (linear - pin.skew(x) @ angular), R.T @ angular  # (3, e), in the frame's axes
        J = (np.concatenate((V, W)) @ self._fold)[self._part]
        gram = J @ J.T
        w = float(np.sqrt(max(np.linalg.det(gram), 0.0)))
        Y = np.zeros((6, len(self._fold)))
        Y[self._part] = (w * np.linalg.pinv(gram, rcond=1e-12) @ J) @ self._fold.T
        # Σ_j Y_j·(J_j × J_i), with [v1; w1] × [v2; w2] = [w1 × v2 + v1 × w2; w1 × w2]
        along = np.cross(Y[:3], W, axis=0)
        about = np.cross(Y[:3], V, axis=0) + np.cross(Y[3:], W, axis=0)
        gradient = (V * (along @ self._beyond.T)).sum(axis=0) + (W * (about @ self._beyond.T)).sum(axis=0)
        return w, gradient @ self._fold


def frame_jacobian(model: Any, kinematics: ForwardKinematics, frame_id: int) -> Array:
    """(6, nv) velocity of a frame's origin and its angular velocity, in world axes."""
    return np.asarray(pin.getFrameJacobian(model, kinematics.data, frame_id, pin.LOCAL_WORLD_ALIGNED))


def frame_pose(kinematics: ForwardKinematics, frame_id: int) -> tuple[Array, Array]:
    """World position (3,) [m] and orientation (3, 3) of a frame that is kept up to date."""
    placement = kinematics.frame_poses[frame_id]
    return placement[9:], placement[:9].reshape(3, 3).T


def _across(a: Array, d: Array) -> tuple[Array, Array]:
    """Unit directions across d: that towards a, and the one that is left."""
    toward = a - np.dot(a, d) * d
    if _length(toward) < _ALIGNED:
        toward = np.cross(d, np.eye(3)[np.argmin(np.abs(d))])
    toward = toward / _length(toward)
    return toward, np.cross(d, toward)


def _length(vector: Array) -> float:
    return float(np.sqrt(np.dot(vector, vector)))
