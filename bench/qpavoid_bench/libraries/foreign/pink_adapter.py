"""Pink 4.4: FrameTasks, a SelfCollisionBarrier of the pairs, and its limits: its example kukas_self_collision."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pink
import pinocchio as pin
from base import Adapter
from pink.barriers import SelfCollisionBarrier
from pink.limits import AccelerationLimit, ConfigurationLimit, VelocityLimit
from pink.tasks import FrameTask
from pinocchio_bodies import add_bodies


class Library(Adapter):
    """Obstacles are bodies of its collision model that no joint moves: it has no interface for them.

    The barrier knows no motion of obstacles, and keeps its rows for as long as q stays the same to `np.allclose`:
    a robot at rest does not see what comes. It is used as it is.
    """

    def __init__(self, setup: SimpleNamespace) -> None:
        """Set Pink up."""
        super().__init__(setup)
        root = (pin.JointModelFreeFlyer(),) if setup.floating else ()
        model = pin.buildModelFromXML(setup.urdf, *root)
        joints = {name: model.joints[model.getJointId(name)] for name, _, _ in setup.joints}
        self.use_indices(pin.neutral(model), lambda name: joints[name].idx_q, lambda name: joints[name].idx_v)
        geometry = pin.GeometryModel()
        links = {link: model.frames[model.getFrameId(link)].parentJoint for link in setup.links}
        add_bodies(geometry, setup, {**links, "world": 0})
        self._configuration = pink.Configuration(
            model, model.createData(), self.configuration(setup.q), collision_model=geometry
        )
        cost = setup.options["cost"]
        self._tasks = [
            FrameTask(name, cost * np.sqrt(position), cost * np.sqrt(orientation))
            for name, _, _, position, orientation in setup.frames
        ]
        self._damping = max(cost**2 * setup.damping, 1e-12)
        acceleration = np.full(model.nv, np.inf)
        acceleration[self._v_index] = setup.acceleration
        self._limits = [ConfigurationLimit(model), VelocityLimit(model)]
        if np.isfinite(acceleration).any():  # with no such joint, Pink's own limit cannot be made
            self._limits.append(AccelerationLimit(model, acceleration))
        self._barriers = []
        if count := min(setup.options["n_collision_pairs"], len(setup.pairs)):
            gains = {name: setup.options[name] for name in ("gain", "safe_displacement_gain")}
            self._barriers.append(SelfCollisionBarrier(count, d_min=setup.d1, **gains))

    def targets(self, poses: Any) -> Any:
        """Return poses as Pink's."""
        return [pin.SE3(pose) for pose in poses]

    def move(self, placements: Mapping[int, Any]) -> None:
        """Place bodies of the collision model."""
        for number, placement in placements.items():
            self._configuration.collision_model.geometryObjects[number].placement = pin.SE3(placement)

    def step(self, q: Any, targets: Any) -> Any:
        """Raise NoSolutionFound or NotWithinConfigurationLimits where it finds nothing."""
        self._configuration.update(q)
        for task, target in zip(self._tasks, targets, strict=True):
            task.set_target(target)
        v, options = np.zeros(len(self._v_index)), {"solver": "daqp", "damping": self._damping}
        try:
            v = pink.solve_ik(
                self._configuration, self._tasks, self.setup.dt, limits=self._limits, barriers=self._barriers, **options
            )
        finally:
            for limit in self._limits:
                if isinstance(limit, AccelerationLimit):
                    limit.set_last_integration(v, self.setup.dt)
        return v

    def frames(self, q: Any) -> Any:
        """Return the poses of Pink's configuration."""
        self._configuration.update(q)
        get = self._configuration.get_transform_frame_to_world
        return np.array([get(task.frame).homogeneous for task in self._tasks])

    def distances(self, q: Any) -> Any:
        """Return the distances of Pink's configuration."""
        self._configuration.update(q)
        return np.array([result.min_distance for result in self._configuration.collision_data.distanceResults])
