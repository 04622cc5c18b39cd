"""Drake 1.51: DifferentialInverseKinematicsSystem with the ingredients of its documentation.

LeastSquaresCost (weight 100 beside JointCenteringCost, as it advises, towards where the robot is),
JointVelocityLimitConstraint at its defaults, CollisionConstraint between safety and influence distance; K_VX is 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
from base import Adapter, urdf_with_bodies
from pydrake.common import Parallelism
from pydrake.common.value import Value
from pydrake.geometry import Box, Capsule, Cylinder, Ellipsoid, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.inverse_kinematics import DifferentialInverseKinematicsSystem as System
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import CoulombFriction
from pydrake.planning import DofMask, JointLimits, RobotDiagramBuilder, SceneGraphCollisionChecker
from pydrake.systems.framework import BusValue

_SHAPES = {"Sphere": Sphere, "Capsule": Capsule, "Cylinder": Cylinder, "Box": Box, "Ellipsoid": Ellipsoid}


class Library(Adapter):
    """Obstacles are bodies of the plant that are welded to the world; those that move are shapes of the checker."""

    def __init__(self, setup: SimpleNamespace) -> None:
        """Set Drake up."""
        super().__init__(setup)
        if setup.floating:
            raise ValueError("it works only where v is the rate of q, which a floating base's is not")
        builder = RobotDiagramBuilder(time_step=0.0)
        plant = builder.plant()
        (robot,) = Parser(plant).AddModelsFromString(urdf_with_bodies(SimpleNamespace(urdf=setup.urdf), ()), "urdf")
        welded = {}
        for number, (_, link, kind, size, placement, moves) in enumerate(setup.bodies):
            if kind not in _SHAPES:
                raise ValueError(f"a {kind} cannot be given to it")
            instance = robot if number < setup.robot_bodies else plant.AddModelInstance(f"obstacle_{number}")
            body = plant.AddRigidBody(f"body_{number}", instance)
            parent = plant.world_frame() if link == "world" else plant.GetFrameByName(link)
            plant.WeldFrames(parent, body.body_frame(), RigidTransform(placement))
            if not moves:
                shape, friction = _SHAPES[kind](*size), CoulombFriction(1.0, 1.0)
                plant.RegisterCollisionGeometry(body, RigidTransform(), shape, f"body_{number}", friction)
            welded[number] = body.index()
        plant.Finalize()
        self.plant, diagram = plant, builder.Build()
        self.checker = SceneGraphCollisionChecker(
            model=diagram,
            robot_model_instances=[robot],
            edge_step_size=0.1,
            implicit_context_parallelism=Parallelism(1),
        )
        self._bodies = [welded[number] for number in range(len(setup.bodies))]
        self._filter_pairs()
        joints = {name: plant.GetJointByName(name) for name, _, _ in setup.joints}
        self.use_indices(
            np.zeros(plant.num_positions()),
            lambda name: joints[name].position_start(),
            lambda name: joints[name].velocity_start(),
        )
        self.move({n: body[4] for n, body in enumerate(setup.bodies) if body[5]})
        self._system(setup, plant, robot)

    def _system(self, setup: SimpleNamespace, plant: Any, robot: Any) -> None:
        scope = plant.GetModelInstanceName(robot)
        self._names = [f"{scope}::{frame[0]}" for frame in setup.frames]
        masks = {
            name: np.array([bool(frame[4])] * 3 + [bool(frame[3])] * 3, dtype=float)
            for name, frame in zip(self._names, setup.frames, strict=True)
        }
        recipe = System.Recipe()
        least, centering = System.LeastSquaresCost.Config(), System.JointCenteringCost.Config()
        least.cartesian_qp_weight, least.cartesian_axis_masks = 100.0, masks
        centering.cartesian_axis_masks = masks
        collision = System.CollisionConstraint.Config()
        collision.safety_distance, collision.influence_distance = setup.d1, setup.d2
        recipe.AddIngredient(System.LeastSquaresCost(least))
        recipe.AddIngredient(System.JointCenteringCost(centering))
        limits = System.JointVelocityLimitConstraint.Config()
        recipe.AddIngredient(System.JointVelocityLimitConstraint(limits, JointLimits(plant)))
        if len(setup.pairs):
            recipe.AddIngredient(System.CollisionConstraint(collision))
        self.system = System(
            recipe, "world", self.checker, DofMask(plant.num_velocities(), True), setup.dt, 1.0,
            SpatialVelocity(np.full(3, 1e3), np.full(3, 1e3)),
        )  # fmt: skip
        self._context = self.system.CreateDefaultContext()
        self._ports = [self.system.GetInputPort(n) for n in ("position", "nominal_posture", "desired_cartesian_poses")]
        self._output = self.system.GetOutputPort("commanded_velocity")

    def _filter_pairs(self) -> None:
        """Take out all pairs of robot bodies, and of these with obstacles, that the setup has not."""
        required = {frozenset(pair) for pair in self.setup.pairs.tolist()}
        for b in range(len(self._bodies)):
            for a in range(min(b, self.setup.robot_bodies)):
                skip = frozenset((a, b)) not in required
                if self.checker.IsCollisionFilteredBetween(self._bodies[a], self._bodies[b]) != skip:
                    self.checker.SetCollisionFilteredBetween(self._bodies[a], self._bodies[b], skip)

    def targets(self, poses: Any) -> Any:
        """Return poses as Drake's bus of them."""
        bus = BusValue()
        for name, pose in zip(self._names, poses, strict=True):
            bus.Set(name, Value(RigidTransform(pose)))
        return Value(bus)

    def move(self, placements: Mapping[int, Any]) -> None:
        """Take shapes out of the checker and add them at their new places."""
        for number, placement in placements.items():
            _, _, kind, size, at_start, _ = self.setup.bodies[number]
            self.checker.RemoveAllAddedCollisionShapes(f"body_{number}")
            frame = self.plant.get_body(self._bodies[number]).body_frame()
            relative = RigidTransform(at_start).inverse() @ RigidTransform(placement)
            self.checker.AddCollisionShapeToFrame(f"body_{number}", frame, _SHAPES[kind](*size), relative)

    def step(self, q: Any, targets: Any) -> Any:
        """Return zero where it finds nothing, as the system does."""
        position, posture, poses = self._ports
        position.FixValue(self._context, q)
        posture.FixValue(self._context, q)
        poses.FixValue(self._context, targets)
        return self._output.Eval(self._context)

    def frames(self, q: Any) -> Any:
        """Return the poses of its frames."""
        context = self.checker.UpdatePositions(q)
        frames = [self.plant.GetFrameByName(frame[0]) for frame in self.setup.frames]
        return np.array([frame.CalcPoseInWorld(context).GetAsMatrix4() for frame in frames])

    def distances(self, q: Any) -> Any:
        """Return the distances of its collision checker."""
        clearance = self.checker.CalcRobotClearance(q, 100.0)
        numbers = {index: number for number, index in enumerate(self._bodies)}
        pairs = zip(clearance.robot_indices(), clearance.other_indices(), clearance.distances(), strict=True)
        by_pair = {frozenset((numbers.get(a), numbers.get(b))): distance for a, b, distance in pairs}
        return np.array([by_pair.get(frozenset(pair), np.nan) for pair in self.setup.pairs.tolist()])
