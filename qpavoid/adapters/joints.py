"""Where the joints of a robot stand in the configurations and velocities of another program."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid.errors import ConfigError, UnknownName, nearest
from qpavoid.model.robot import Robot
from qpavoid.problem import Array

_MUJOCO_BASE = [0, 1, 2, 4, 5, 6, 3]
"""Places of x, y, z and of the quaternion's x, y, z, w in the qpos of a free joint, which begins with w."""
_MUJOCO_FREE = 0
"""Type of a free joint, `mjJNT_FREE`."""


class JointMap:
    """Joints of a robot, by name, in the configuration and velocity of another program.

    That may have other joints as well, in any order.
    """

    def __init__(
        self, robot: Robot, places: Mapping[str, tuple[int, int]], nv: int, angles: bool = True, mujoco: bool = False
    ) -> None:
        """Find all joints of the robot.

        Args:
            robot: whose q and v go out and in.
            places: first index in q and in v of each joint of the other program, by its name.
            nv: number of velocity coordinates there.
            angles: whether joints without limits are one angle there; else they are cos and sin, as in Pinocchio.
            mujoco: whether a floating base is as in MuJoCo: w first, and the linear velocity in world axes.

        Raises:
            UnknownName: a joint that is not there.
            ConfigError: a joint of a kind that is written differently there.
        """
        q_from, q_to, v_from = list[int](), list[int](), list[int]()
        self._circles, self._has_base = list[tuple[int, int]](), False
        for name, joint in zip(robot.joint_names, list(robot.model.joints)[1:], strict=True):
            if joint.nv == 0:  # it mimics another one
                continue
            if name not in places:
                raise UnknownName(f"joint {name!r} of {robot.name} is not there{nearest(name, places)}")
            q, v = places[name]
            order: Sequence[int] = range(joint.nq)
            if (joint.nq, joint.nv) == (2, 1) and angles:
                self._circles.append((q, joint.idx_q))
                order = ()
            elif (joint.nq, joint.idx_q) == (7, 0) and mujoco:
                order, self._has_base = _MUJOCO_BASE, True
            elif joint.nv > 1 and angles:
                raise ConfigError(f"joint {name!r} of {robot.name} is neither a hinge nor a slide; lock it")
            q_from += [q + k for k in order]
            q_to += [joint.idx_q + k for k in range(len(order))]
            v_from += [v + k for k in range(joint.nv)]
        self._q, self._R, self._base = robot.home.copy(), np.eye(3), _places(v_from[:3])
        self.nv = nv
        """Number of velocity coordinates of the other program."""
        self._q_from, self._q_to, self._v_from = map(_places, (q_from, q_to, v_from))

    @classmethod
    def of_pinocchio(cls, robot: Robot, model: Any) -> JointMap:
        """Return the map of a program with a Pinocchio model."""
        joints = zip(list(model.names)[1:], list(model.joints)[1:], strict=True)
        places = {name: (joint.idx_q, joint.idx_v) for name, joint in joints}
        return cls(robot, places, model.nv, angles=False)

    @classmethod
    def of_mujoco(cls, robot: Robot, model: Any) -> JointMap:
        """Return the map of a program with a MuJoCo model, whose free joint may have another name."""
        joints = [model.joint(i) for i in range(model.njnt)]
        places = {joint.name: (int(joint.qposadr[0]), int(joint.dofadr[0])) for joint in joints}
        if robot.model.joints[1].nq == 7:
            free = [places[joint.name] for joint in joints if joint.type[0] == _MUJOCO_FREE]
            places |= zip(robot.joint_names, free[:1], strict=False)
        return cls(robot, places, model.nv, mujoco=True)

    @classmethod
    def of_names(cls, robot: Robot, names: Sequence[str]) -> JointMap:
        """Return the map of a program that has one number a joint, in the order of `names`."""
        return cls(robot, {name: (i, i) for i, name in enumerate(names)}, len(names))

    def q(self, values: Any) -> Array:
        """Return the robot's configuration (nq,), in memory that the next call overwrites."""
        values = np.asarray(values, dtype=np.float64)
        self._q[self._q_to] = values[self._q_from]
        for there, here in self._circles:
            self._q[here], self._q[here + 1] = np.cos(values[there]), np.sin(values[there])
        if self._has_base:
            self._R = pin.Quaternion(self._q[3:7]).toRotationMatrix()
        q: Array = self._q
        return q

    def v(self, values: Any) -> Array:
        """Return the robot's velocity (nv,); of a floating base, at the configuration that `q` was given last."""
        v: Array = np.array(np.asarray(values, dtype=np.float64)[self._v_from])
        if self._has_base:
            v[:3] = self._R.T @ v[:3]
        return v

    def merged(self, v: Array, values: Any) -> Array:
        """Return velocities of the other program, with those of the robot replaced by v (nv,).

        Joints that are not the robot's rest where their velocity is NaN or infinite.
        """
        out = np.array(values, dtype=np.float64)
        if not isfinite(out.sum()):
            out[~np.isfinite(out)] = 0.0
        out[self._v_from] = v
        if self._has_base:
            out[self._base] = self._R @ v[:3]
        return out

    def write_columns(self, J: Array, out: Array) -> None:
        """Write rows J (k, nv) on the robot's velocity as rows (k, `nv`) on that of the other program."""
        out[:] = 0.0
        out[:, self._v_from] = J
        if self._has_base:
            out[:, self._base] = J[:, :3] @ self._R.T


def _places(indices: list[int]) -> Any:
    """Return what indexes these places of an array: a slice where they follow each other, which is faster."""
    first = indices[0] if indices else 0
    is_run = indices == list(range(first, first + len(indices)))
    return slice(first, first + len(indices)) if is_run else np.array(indices, dtype=np.intp)
