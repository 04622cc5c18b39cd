"""roboplan: the displacements of its OInK filtered. Its limits and barriers are C++, and take no rows from outside."""

from __future__ import annotations

from roboplan.core import Scene

from qpavoid.adapters.joints import JointMap
from qpavoid.adapters.velocities import VelocityFilter
from qpavoid.controller import Controller


def velocity_filter(controller: Controller, scene: Scene) -> VelocityFilter:
    """Return the filter to call with q and v = Δq/dt of an OInK that has all joints of a scene.

    Raises:
        UnknownName: the scene lacks a joint of the controller's robot.
    """
    places, nv = dict[str, tuple[int, int]](), 0
    for name in scene.getJointNames():
        places[name] = int(scene.getJointPositionIndices([name])[0]), nv
        nv += scene.getJointInfo(name).num_velocity_dofs
    return VelocityFilter(controller, JointMap(controller.scene.robot, places, nv, angles=False))
