"""A scene: a robot among obstacles, with every pair that has to be watched. Built once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from qpavoid import config
from qpavoid.bodies import make_shape
from qpavoid.errors import ConfigError, located
from qpavoid.kinematics import support_masks
from qpavoid.motion import Motion, Sample, Still, build_motion
from qpavoid.pairs import pair_array
from qpavoid.problem import Array, IntArray
from qpavoid.robot import Robot


@dataclass(frozen=True)
class Obstacle:
    """A body that moves on its own."""

    name: str
    shape: config.Shape
    motion: Motion
    moves: bool = True
    """Whether its motion has to be evaluated at every tick."""

    @classmethod
    def at(cls, name: str, shape: config.Shape, position: ArrayLike, rotation: ArrayLike | None = None) -> Obstacle:
        """An obstacle that stays, unless the program that steps the controller says where it is.

        Args:
            name: by which pairs, logs and `Controller.step(obstacles=…)` know it.
            shape: its shape.
            position: world position of the shape's origin (3,) [m].
            rotation: its orientation (3, 3); along the world axes if left out.

        Raises:
            ConfigError: wrong shape, NaN or infinity.
        """
        return cls(name, shape, Still(Sample.at(position, rotation)), moves=False)


@dataclass(frozen=True)
class Scene:
    """Bodies of the robot, then obstacles, in one geometry model, and the layout of the pairs among them."""

    robot: Robot
    obstacles: tuple[Obstacle, ...]
    geometry: Any
    """pinocchio geometry model: the robot's bodies first, then the obstacles."""
    pairs: IntArray
    """(m, 2) geometry indices; the first of a pair always belongs to the robot."""
    pair_names: tuple[tuple[str, str], ...]
    """Names of the bodies of each pair."""
    support: Array
    """(m, nv) support of the second body minus that of the first: which coordinates change the distance."""

    @property
    def body_names(self) -> list[str]:
        """Names of the robot's bodies, in the order of the geometry model."""
        return [body.name for body in self.robot.bodies.geometryObjects]

    @property
    def obstacle_names(self) -> list[str]:
        """Names of the obstacles, in the order of the geometry model."""
        return [obstacle.name for obstacle in self.obstacles]


def build_scene(robot: Robot, obstacles: Sequence[Obstacle] = ()) -> Scene:
    """Lays out the pairs of a robot with itself and with every obstacle.

    Args:
        robot: the robot with its own pairs.
        obstacles: the obstacles; each is paired with every body of the robot.

    Raises:
        ConfigError: an obstacle that has the name of a body.
    """
    geometry = pin.GeometryModel(robot.bodies)
    bodies = len(robot.bodies.geometryObjects)
    for obstacle in obstacles:
        if geometry.existGeometryName(obstacle.name):
            raise ConfigError(f"obstacles: {obstacle.name!r} is the name of a body of {robot.name}: rename it")
        start = obstacle.motion.sample(0.0)
        placement = pin.SE3(start.rotation, start.position)
        index = geometry.addGeometryObject(
            pin.GeometryObject(obstacle.name, 0, 0, placement, make_shape(obstacle.shape))
        )
        for body in range(bodies):
            geometry.addCollisionPair(pin.CollisionPair(body, index))
    pairs = pair_array(geometry)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]  # in the order in which bounding spheres are compared
    geometry.removeAllCollisionPairs()
    for a, b in pairs.tolist():
        geometry.addCollisionPair(pin.CollisionPair(a, b))
    joints = np.array([body.parentJoint for body in geometry.geometryObjects], dtype=np.intp)
    masks = support_masks(robot.model)
    names = [body.name for body in geometry.geometryObjects]
    return Scene(
        robot=robot,
        obstacles=tuple(obstacles),
        geometry=geometry,
        pairs=pairs,
        pair_names=tuple((names[a], names[b]) for a, b in pairs),
        support=masks[joints[pairs[:, 1]]] - masks[joints[pairs[:, 0]]],
    )


def build_obstacles(configs: Sequence[config.ObstacleConfig], source: Path) -> list[Obstacle]:
    """Obstacles of a scenario.

    Args:
        configs: the scenario's `obstacles`.
        source: scenario file, named in errors and the start of relative paths.

    Raises:
        ConfigError: a motion that cannot be built.
    """
    obstacles = []
    for index, c in enumerate(configs):
        with located(f"{source}: obstacles.{index}"):
            motion = build_motion(c.motion, None, source.parent)
        obstacles.append(Obstacle(c.name, c.shape, motion, moves=not isinstance(c.motion, config.Fixed)))
    return obstacles
