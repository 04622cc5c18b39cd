"""Inverse kinematics: configurations in which frames have given poses."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid.errors import ConfigError
from qpavoid.model.robot import Robot
from qpavoid.problem import Array

_STEPS, _MAX_STEP, _DAMPING = 80, 0.4, 1e-3
"""Settings of a search: steps, largest step of a joint [rad or m], damping of the pseudo-inverse [-]."""


class FrameGoal(NamedTuple):
    """Position and rotation that a frame is to have."""

    frame: int
    position: Array | None
    """(3,) world [m]; None: anywhere."""
    rotation: Array | None = None
    """(3, 3); None: any."""


class JointRanges(NamedTuple):
    """Ranges of joints, (nv,) each; those without limits have half a turn either way."""

    lower: Array
    upper: Array

    @classmethod
    def of(cls, robot: Robot) -> JointRanges:
        """Return the ranges of a robot from its position limits.

        Raises:
            ConfigError: a joint with other than one coordinate that is an angle or a length.
        """
        model = robot.model
        odd = [name for name, joint in zip(robot.joint_names, list(model.joints)[1:], strict=True) if joint.nq != 1]
        if odd:
            raise ConfigError(f"{robot.name}: joint {odd[0]!r} has more than one coordinate; lock it")
        bounds = robot.bounds()
        lower, upper = np.full(model.nv, -np.pi), np.full(model.nv, np.pi)
        lower[bounds.v_index] = np.where(np.isfinite(bounds.lower), bounds.lower, -np.pi)
        upper[bounds.v_index] = np.where(np.isfinite(bounds.upper), bounds.upper, np.pi)
        return cls(np.maximum(lower, -np.pi), np.minimum(upper, np.pi))


def solve_inverse_kinematics(
    robot: Robot, goals: list[FrameGoal], q: Array, ranges: JointRanges, tolerance: float
) -> Array | None:
    """Find q (nv,) within limits that attains the goals; None if the search ends elsewhere.

    Damped least squares with joints kept within their ranges.

    Args:
        robot: whose joints have one coordinate each.
        goals: of frames.
        q: where the search begins (nv,).
        ranges: of the joints.
        tolerance: distance that is good enough [m]; orientations as many rad.
    """
    model, data = robot.model, robot.model.createData()
    for _ in range(_STEPS):
        error, J = _errors(model, data, goals, q)
        if np.abs(error).max() < tolerance:
            return q
        step = J.T @ np.linalg.solve(J @ J.T + _DAMPING * np.eye(len(error)), error)
        step *= min(1.0, _MAX_STEP / max(np.abs(step).max(), 1e-12))
        q = np.clip(q + step, ranges.lower, ranges.upper)
    return None


def _errors(model: Any, data: Any, goals: list[FrameGoal], q: Array) -> tuple[Array, Array]:
    """Return the errors (m,) of the goals and their Jacobian (m, nv)."""
    pin.computeJointJacobians(model, data, q)
    errors, rows = [], []
    for goal in goals:
        pose = pin.updateFramePlacement(model, data, goal.frame)
        J = pin.getFrameJacobian(model, data, goal.frame, pin.LOCAL_WORLD_ALIGNED)
        if goal.position is not None:
            errors.append(goal.position - pose.translation)
            rows.append(J[:3])
        if goal.rotation is not None:
            errors.append(pin.log3(goal.rotation @ pose.rotation.T))
            rows.append(J[3:])
    return np.concatenate(errors), np.concatenate(rows)
