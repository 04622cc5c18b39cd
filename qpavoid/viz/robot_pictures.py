"""The robot of a log as surfaces: its visual meshes where its files are at hand, else the capsules of the log."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from qpavoid.errors import QpavoidError
from qpavoid.problem import Array
from qpavoid.run.log import Log
from qpavoid.viz.raster import Surface
from qpavoid.viz.style import AT_REST, COLLISION, MOVING, rgb
from qpavoid.viz.surfaces import capsule_faces, moving_bodies, triangulated

if TYPE_CHECKING:
    from qpavoid.model.robot import Robot

_COARSE = 0.02
"""Size of details that are left out of the small pictures by which a view is chosen [m]."""
_RED = rgb(COLLISION)
_CACHE: dict[str, RobotPictures] = {}
_MAX_CACHED = 4


class RobotPictures:
    """A robot that can be drawn at any step of a log."""

    def __init__(self, robot: Robot | None) -> None:
        """Read the visual meshes; None draws capsules."""
        self._parts: list[tuple[int, Any, Any]] = []  # joint, mesh, coarse mesh: on the axes of the joint
        if robot is None:
            return
        from qpavoid.model.visuals import read_visuals
        from qpavoid.viz.meshes import decimated, of_visual

        self._model, self._data = robot.model, robot.model.createData()
        self._joint_of_body = {body.name: body.parentJoint for body in robot.bodies.geometryObjects}
        for visual in read_visuals(robot.model, robot.urdf, robot.package_dirs):
            for mesh in of_visual(visual):
                vertices = mesh.vertices @ visual.placement.rotation.T + visual.placement.translation
                placed = mesh._replace(vertices=vertices.astype(np.float32))
                self._parts.append((visual.joint, placed, decimated(placed, _COARSE)))

    @classmethod
    def of(cls, log: Log) -> RobotPictures:
        """Return the robot of a log, read once for all runs of a scenario."""
        config = log.meta["config"]
        key = repr([log.meta["source"], config["robot"], config["lock"], config["q0"]])
        if key not in _CACHE:
            if len(_CACHE) >= _MAX_CACHED:
                _CACHE.pop(next(iter(_CACHE)))
            try:
                _CACHE[key] = cls(_robot_of(log))
            except (QpavoidError, ImportError, OSError):  # a file is not at hand, or no library that reads it
                _CACHE[key] = cls(None)
        return _CACHE[key]

    def surfaces(self, log: Log, step: int, *, is_coarse: bool = False) -> list[Surface]:
        """Return the surfaces at a step; of links that touch something, in red; with fewer triangles if coarse."""
        if not self._parts:
            return _capsules(log, step)
        import pinocchio as pin

        pin.forwardKinematics(self._model, self._data, log.q[step])
        touching = {
            self._joint_of_body.get(log.meta["bodies"][i]) for i in np.flatnonzero(log.body_distance[step] < 0.0)
        }
        surfaces: list[Surface] = []
        for joint, fine, coarse in self._parts:
            pose, mesh = self._data.oMi[joint], coarse if is_coarse else fine
            colour = _RED if joint in touching else mesh.colour
            surfaces.append((mesh.vertices @ pose.rotation.T + pose.translation, mesh.faces, colour))
        return surfaces


def _robot_of(log: Log) -> Robot | None:
    """Return the robot of a log; None where that of today has other joints."""
    from qpavoid.model.robot import Robot
    from qpavoid.viz.log_frames import scenario_of

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the run has issued them
        config = scenario_of(log)
        robot = Robot.load(config.robot, config.source.parent)
        robot = robot.lock(config.lock, robot.configuration(config.q0, "q0"), "lock")[0]
    return robot if robot.model.nq == log.q.shape[1] else None


def _capsules(log: Log, step: int) -> list[Surface]:
    """Return the capsules of a log, which enclose whatever shape the robot's bodies have."""
    touching, moving, surfaces = log.body_distance[step] < 0.0, moving_bodies(log), list[Surface]()
    for i, radius in enumerate(log.meta["body_radii"]):
        # a little thicker when hit: neighbours share the ball at their joint, and its colour would be patchy
        faces: Array = capsule_faces(log.body_ends[step, i], 1.06 * radius if touching[i] else radius)
        colour = COLLISION if touching[i] else MOVING if moving[i] else AT_REST
        surfaces.append((*triangulated(faces), rgb(colour)))
    return surfaces
