"""The collision bodies of a robot, and of what it holds, as a camera has to tell them apart from obstacles."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np
import pinocchio as pin
from scipy.spatial import ConvexHull

from qpavoid.config import Shape
from qpavoid.errors import ConfigError, UnknownName
from qpavoid.geometry.bodies import bounding_box, bounding_sphere, enclosing_capsule, hull_points, make_shape
from qpavoid.kernels import OwnBodies
from qpavoid.kernels.support import BOX
from qpavoid.model.convex_shapes import core_of
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.model.robot import Robot
from qpavoid.perception.camera import Camera
from qpavoid.problem import Array

_MAX_HELD = 4
"""Objects that a robot holds at a time [-]."""
_FAR = 1e6
"""Where an object is that is not held [m]."""


class OwnBodiesAt:
    """Bodies of a robot in the axes of a camera, at any configuration."""

    def __init__(self, robot: Robot, camera: Camera) -> None:
        """Lay the bodies out.

        Raises:
            UnknownName: the camera's frame.
        """
        self._robot, self._camera, geometries = robot, camera, list(robot.bodies.geometryObjects)
        self._frame = None if camera.frame is None else robot.frame_id(camera.frame, "camera: frame")
        self._kinematics = ForwardKinematics(robot.model, [] if self._frame is None else [self._frame])
        self._joints = [body.parentJoint for body in geometries] + [0] * _MAX_HELD
        nowhere = pin.SE3(np.eye(3), np.full(3, _FAR))
        self._placements = [body.placement for body in geometries] + [nowhere] * _MAX_HELD
        self._objects: dict[str, int] = {}
        count, planes, core, spheres, span = len(self._joints), list[Array](), list[Any](), list[Any](), list[Any]()
        for body in geometries:
            kind, numbers = core_of(body.geometry)
            own = np.zeros((0, 4)) if kind <= BOX else _planes(body.geometry)
            first = sum(map(len, planes))
            planes.append(own)
            span.append((first, first + len(own)))
            core.append(numbers)
            spheres.append((*_sphere(body.geometry),))
        self.arrays = OwnBodies(
            np.zeros((count, 12)),
            np.array(core + [(0.0,) * 4] * _MAX_HELD),
            np.array(spheres + [(0.0,) * 4] * _MAX_HELD),
            np.concatenate([*planes, np.zeros((0, 4))]),
            np.array(span + [(0, 0)] * _MAX_HELD, dtype=np.intp),
        )
        """The bodies; the poses are those of the last `place`."""

    def hold(self, name: str, shape: Shape, frame: str, position: Any, rotation: Any) -> None:
        """Take an object as one of the robot's bodies: it is at a pose in one of its frames, until it is released.

        Raises:
            ConfigError: too many, or a name twice.
            UnknownName: no such frame.
        """
        if name in self._objects or len(self._objects) == _MAX_HELD:
            raise ConfigError(f"hold: {name!r}: held already, or {_MAX_HELD} others are")
        number = self._robot.frame_id(frame, "hold")
        geometry, placement = make_shape(shape), pin.SE3(np.asarray(rotation, float), np.asarray(position, float))
        if core_of(geometry)[0] > BOX:
            fit = enclosing_capsule(geometry)
            geometry, placement = coal.Capsule(fit.radius, fit.length), placement * pin.SE3(fit.rotation, fit.center)
        free = set(range(len(self._joints) - _MAX_HELD, len(self._joints))) - set(self._objects.values())
        self._objects[name] = i = min(free)
        frames = self._robot.model.frames
        self._joints[i], self._placements[i] = frames[number].parentJoint, frames[number].placement * placement
        self.arrays.core[i], self.arrays.sphere[i] = core_of(geometry)[1], _sphere(geometry)

    def release(self, name: str) -> None:
        """Take an object as one of the surroundings again.

        Raises:
            UnknownName: it is not held.
        """
        if name not in self._objects:
            raise UnknownName(f"release: {name!r} is not held")
        i = self._objects.pop(name)
        self._joints[i], self._placements[i] = 0, pin.SE3(np.eye(3), np.full(3, _FAR))

    def place(self, q: Array) -> Array:
        """Put the bodies to a configuration (nq,); return the world pose of the camera (12,)."""
        self._kinematics.compute(q)
        poses = self._kinematics.joint_poses
        camera = _se3(self._camera.pose)
        if self._frame is not None:
            camera = _se3(self._kinematics.frame_poses[self._frame]) * camera
        inverse, joints = camera.inverse(), {j: _se3(poses[j]) for j in set(self._joints)}
        for row, j, placement in zip(self.arrays.poses, self._joints, self._placements, strict=True):
            pose = inverse * joints[j] * placement
            row[:9], row[9:] = pose.rotation.T.ravel(), pose.translation
        return np.concatenate((camera.rotation.T.ravel(), camera.translation))


def _se3(pose: Array) -> Any:
    return pin.SE3(pose[:9].reshape(3, 3).T.copy(), pose[9:].copy())


def _sphere(geometry: Any) -> tuple[float, ...]:
    center, radius = bounding_sphere(geometry)
    return (*center.tolist(), float(radius))


def _planes(geometry: Any) -> Array:
    """Return planes (p, 4) around a shape: of the faces of its hull, and of a box, which cut sharp corners off."""
    center, half = bounding_box(geometry)
    faces = ConvexHull(hull_points(geometry)).equations
    axes = np.concatenate((np.eye(3), -np.eye(3)))
    return np.concatenate((faces, np.column_stack((axes, -(axes @ center) - np.tile(half, 2)))))
