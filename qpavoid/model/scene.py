"""A scene: a robot among obstacles, with every pair that has to be checked. Built once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from qpavoid import config
from qpavoid.errors import ConfigError, NumericalError, located
from qpavoid.kernels.obstacles import NEARLY
from qpavoid.model.cloud import Voxels, read_points
from qpavoid.model.kinematics import support_masks
from qpavoid.model.pairs import pair_array
from qpavoid.model.robot import Robot
from qpavoid.model.sample import Sample
from qpavoid.model.solids import make_solids
from qpavoid.model.trajectory import Motion, build_motion, still
from qpavoid.problem import Array, IntArray

PARKING_DISTANCE = 1e4
"""Position of the proxy spheres of a cloud that stand for no voxel: beyond any influence distance [m]."""


@dataclass(frozen=True)
class Obstacle:
    """A body that moves on its own."""

    name: str
    shape: config.ObstacleShape
    motion: Motion
    moves: bool = True
    """Whether its motion has to be evaluated at every control step."""
    graspable: bool = False
    """Whether `Controller.attach` may attach it to the robot."""
    external: bool = False
    """Whether its pose comes from the program that steps the controller, and has to be updated from the start."""
    source: Path = Path("obstacle")
    """File to name in errors, from whose folder the paths of meshes and points start."""
    uncertainty: float = 0.0
    """How far it may be from where it is said to be [m]: that much is taken off its distances."""

    @classmethod
    def at(
        cls,
        name: str,
        shape: config.ObstacleShape,
        position: ArrayLike,
        rotation: ArrayLike | None = None,
        graspable: bool = False,
        external: bool = False,
        uncertainty: float = 0.0,
    ) -> Obstacle:
        """Make an obstacle at a pose.

        It stays there unless the program that steps the controller updates its pose.

        Args:
            name: by which pairs, logs and `Controller.step(obstacles=…)` know it.
            shape: its shape; files are looked for in the working directory.
            position: world position of the shape's origin (3,) [m].
            rotation: its orientation (3, 3); along the world axes if left out.
            graspable: whether it may be attached to the robot.
            external: whether its pose has to be updated by `Controller.step(obstacles=…)` from the start: the robot
                stops where it is not. An obstacle that is given in `step` is external from then on.
            uncertainty: how far it may be from where it is said to be [m]; the robot keeps d1 and that much away.

        Raises:
            ConfigError: wrong shape, NaN or infinity, no rotation, an uncertainty that is negative.
        """
        try:
            sample = Sample.at(position, rotation)
        except NumericalError as error:
            raise ConfigError(f"obstacle {name!r}: {error}") from None
        off = float(np.abs(sample.rotation.T @ sample.rotation - np.eye(3)).max())
        if off > NEARLY or np.linalg.det(sample.rotation) < 0.0:
            clause = "left-handed" if np.linalg.det(sample.rotation) < 0.0 else f"|RᵀR - I| is {off:.2g}"
            raise ConfigError(f"obstacle {name!r}: rotation: {clause}; give a rotation (3, 3)")
        if not 0.0 <= uncertainty < np.inf:
            raise ConfigError(f"obstacle {name!r}: uncertainty: {uncertainty} m, expected 0 or more")
        return cls(
            name, shape, still(sample), moves=False, graspable=graspable, external=external, uncertainty=uncertainty
        )


@dataclass(frozen=True)
class Scene:
    """Bodies of the robot, then obstacles, in one geometry model, and the layout of the pairs among them."""

    robot: Robot
    obstacles: tuple[Obstacle, ...]
    """Those that can be attached first."""
    geometry: Any
    """pinocchio geometry model: the robot's bodies, then the pieces of the obstacles in their order."""
    pairs: IntArray
    """(m, 2) geometry indices; the first of a pair belongs to the robot, or may be attached to it."""
    pair_names: tuple[tuple[str, str], ...]
    """Names of the bodies of each pair."""
    support: Array
    """(m, nv) support of the second body minus that of the first: which coordinates change the distance."""
    obstacle_of: IntArray
    """(g,) number of the obstacle that each geometry is a piece of; -1 for the robot's bodies."""
    clouds: dict[int, Voxels] = field(default_factory=dict)
    """What is in the point clouds at first, by number of the obstacle."""

    @property
    def body_names(self) -> list[str]:
        """Names of the robot's bodies, in the order of the geometry model."""
        return [body.name for body in self.robot.bodies.geometryObjects]

    @property
    def obstacle_names(self) -> list[str]:
        """Names of the obstacles."""
        return [obstacle.name for obstacle in self.obstacles]

    def distance_allowance(self, safety_distance: float) -> Array:
        """Return how much smaller each pair's safety distance is than the scenario's (m,) [m].

        Args:
            safety_distance: that of the scenario, between surfaces [m].
        """
        distances = [self.robot.safety_distance(a, b, safety_distance) for a, b in self.pair_names]
        return safety_distance - np.array(distances, dtype=np.float64)

    @property
    def movable(self) -> int:
        """Number of geometries, the first ones, that joints move or may come to move."""
        return len(self.robot.bodies.geometryObjects) + sum(obstacle.graspable for obstacle in self.obstacles)


def build_scene(robot: Robot, obstacles: Sequence[Obstacle] = ()) -> Scene:
    """Lay out the pairs of a robot with itself and with every obstacle.

    Args:
        robot: the robot with its own pairs.
        obstacles: the obstacles; each is paired with every body of the robot, and with those that may be attached.
            Half-spaces have no pair with bodies that no joint moves: a base stands on the ground.

    Raises:
        ConfigError: an obstacle that has the name of a body or that cannot be attached, a mesh or points that cannot be
            read.
    """
    obstacles = sorted(obstacles, key=lambda obstacle: not obstacle.graspable)
    geometry, bodies = pin.GeometryModel(robot.bodies), robot.bodies.ngeoms
    movable = bodies + sum(obstacle.graspable for obstacle in obstacles)
    names, obstacle_of = [body.name for body in robot.bodies.geometryObjects], [-1] * bodies
    clouds: dict[int, Voxels] = {}
    for number, obstacle in enumerate(obstacles):
        if obstacle.name in names:
            raise ConfigError(f"obstacles: {obstacle.name!r} is the name of a body of {robot.name}: rename it")
        start, shape = obstacle.motion.sample(0.0), obstacle.shape
        placement = pin.SE3(start.rotation, start.position)
        where, folder = f"obstacles: {obstacle.name!r}: shape", obstacle.source.parent
        solids = make_solids(shape, folder, where)
        if obstacle.graspable and (len(solids) > 1 or isinstance(shape, config.HalfSpace | config.PointCloud)):
            raise ConfigError(
                f"obstacles: {obstacle.name!r}: a {shape.type} cannot be carried; give a primitive, or a mesh with "
                "`method: convex`"
            )
        if isinstance(shape, config.PointCloud):
            clouds[number] = _points(shape, folder, where)
            solids = solids * (movable * shape.nearest)  # each body has spheres of its own
            placement = pin.SE3(np.eye(3), np.array([PARKING_DISTANCE, 0.0, 0.0]))
        for k, solid in enumerate(solids):
            piece = f"{obstacle.name}[{k}]" if len(solids) > 1 else obstacle.name
            index = geometry.addGeometryObject(pin.GeometryObject(piece, 0, 0, placement, solid))
            names.append(obstacle.name)
            obstacle_of.append(number)
            partners = [k // shape.nearest] if isinstance(shape, config.PointCloud) else range(min(index, movable))
            for partner in partners:
                fixed = partner < bodies and geometry.geometryObjects[partner].parentJoint == 0
                if not (fixed and isinstance(shape, config.HalfSpace)):
                    geometry.addCollisionPair(pin.CollisionPair(partner, index))
    _without_cylinders_among_spheres(geometry)
    pairs = pair_array(geometry)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]  # in the order in which bounding spheres are compared
    geometry.removeAllCollisionPairs()
    for a, b in pairs.tolist():
        geometry.addCollisionPair(pin.CollisionPair(a, b))
    joints = np.array([body.parentJoint for body in geometry.geometryObjects], dtype=np.intp)
    masks = support_masks(robot.model)
    return Scene(
        robot=robot,
        obstacles=tuple(obstacles),
        geometry=geometry,
        pairs=pairs,
        pair_names=tuple((names[a], names[b]) for a, b in pairs),
        support=masks[joints[pairs[:, 1]]] - masks[joints[pairs[:, 0]]],
        obstacle_of=np.array(obstacle_of, dtype=np.intp),
        clouds=clouds,
    )


def _without_cylinders_among_spheres(geometry: Any) -> None:
    """Replace spheres by capsules of no length where there are cylinders.

    coal 3.0 has a formula of its own for spheres and cylinders, which is wrong by centimetres once the centre of the
    sphere is inside; for capsules it iterates.
    """
    bodies = geometry.geometryObjects
    if any(isinstance(body.geometry, coal.Cylinder) for body in bodies):
        for body in bodies:
            if isinstance(body.geometry, coal.Sphere):
                body.geometry = coal.Capsule(body.geometry.radius, 0.0)


def _points(shape: config.PointCloud, folder: Path, where: str) -> Voxels:
    points = np.zeros((0, 3)) if shape.path is None else read_points(folder / shape.path, f"{where}.path")
    voxels = Voxels.of(points, shape.resolution)
    if voxels.dropped:
        raise ConfigError(
            f"{where}.path: {voxels.dropped} of {voxels.given} points are NaN, infinite or over 100 m away; leave them "
            "out"
        )
    return voxels


def build_obstacles(configs: Sequence[config.ObstacleConfig], source: Path) -> list[Obstacle]:
    """Build the obstacles of a scenario.

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
        obstacles.append(
            Obstacle(
                c.name,
                c.shape,
                motion,
                moves=not isinstance(c.motion, config.Fixed),
                graspable=c.graspable or c.attached_to is not None,
                external=c.source == "external",
                source=source,
                uncertainty=c.uncertainty,
            )
        )
    return obstacles
