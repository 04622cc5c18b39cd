"""A scene: a robot among obstacles, with every pair that has to be checked. Built once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from qpavoid import config
from qpavoid.config.scenario import MAX_SPARE
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
_SPARE_RADIUS = 1e-3
"""Radius of the sphere that stands for an empty slot [m]."""


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


@dataclass(eq=False)
class Scene:
    """Bodies of the robot, then obstacles, in one geometry model, and the layout of the pairs among them.

    What comes and goes at run time takes one of its spare slots, which is an obstacle without a name while it is empty.
    A controller has a copy of its own of a scene with spare slots.
    """

    robot: Robot
    slots: list[Obstacle]
    """Obstacle of each number: those that can be attached first, then spare slots, then all others."""
    geometry: Any
    """pinocchio geometry model: the robot's bodies, then the pieces of the obstacles in their order."""
    pairs: IntArray
    """(m, 2) geometry indices; the first of a pair belongs to the robot, or may be attached to it."""
    pair_names: tuple[tuple[str, str], ...]
    """Names of the bodies of each pair; another tuple once an obstacle is added or removed."""
    support: Array
    """(m, nv) support of the second body minus that of the first: which coordinates change the distance."""
    obstacle_of: IntArray
    """(g,) number of the obstacle that each geometry is a piece of; -1 for the robot's bodies."""
    movable: int
    """Number of geometries, the first ones, that joints move or may come to move."""
    spare: range
    """Numbers of the spare slots."""
    clouds: dict[int, Voxels] = field(default_factory=dict)
    """What is in the point clouds at first, by number of the obstacle."""

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """All obstacles, in the order of their numbers."""
        return tuple(obstacle for obstacle in self.slots if obstacle.name)

    def own_copy(self) -> Scene:
        """Return the same scene with slots of its own."""
        return replace(self, slots=list(self.slots), geometry=pin.GeometryModel(self.geometry))

    def emptied(self) -> Scene:
        """Return the same scene with nothing in its spare slots."""
        scene = self.own_copy()
        for number in scene.spare:
            if scene.slots[number].name:
                scene.put(number, None, spare_solid())
        return scene

    def put(self, number: int, obstacle: Obstacle | None, solid: Any) -> None:
        """Put an obstacle with a coal geometry into a spare slot, or none."""
        geometry = int(np.flatnonzero(self.obstacle_of == number)[0])
        self.slots[number] = obstacle = obstacle or _spare(number - self.spare.start)
        body, start = self.geometry.geometryObjects[geometry], obstacle.motion.sample(0.0)
        body.geometry, body.placement = solid, pin.SE3(start.rotation, start.position)
        names = list(self.pair_names)
        for pair in np.flatnonzero((self.pairs == geometry).any(axis=1)).tolist():
            a, b = names[pair]
            names[pair] = (obstacle.name, b) if self.pairs[pair, 0] == geometry else (a, obstacle.name)
        self.pair_names = tuple(names)

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


def build_scene(robot: Robot, obstacles: Sequence[Obstacle] = (), spare_obstacles: int = 0) -> Scene:
    """Lay out the pairs of a robot with itself and with every obstacle.

    Args:
        robot: the robot with its own pairs.
        obstacles: the obstacles; each is paired with every body of the robot, and with those that may be attached.
            Half-spaces have no pair with bodies that no joint moves: a base stands on the ground.
        spare_obstacles: how many more `Controller.add_obstacle` may add at the same time.

    Raises:
        ConfigError: an obstacle without a name, with that of a body or that cannot be attached, a mesh or points that
            cannot be read, a number of spare obstacles that cannot be meant.
    """
    if type(spare_obstacles) is not int or not 0 <= spare_obstacles <= MAX_SPARE:
        raise ConfigError(f"spare_obstacles: {spare_obstacles!r:.20}, expected 0 to {MAX_SPARE}")
    graspable = sum(obstacle.graspable for obstacle in obstacles)
    obstacles = sorted(obstacles, key=lambda obstacle: not obstacle.graspable)
    obstacles[graspable:graspable] = map(_spare, range(spare_obstacles))
    geometry, bodies = pin.GeometryModel(robot.bodies), robot.bodies.ngeoms
    movable, spare = bodies + graspable + spare_obstacles, range(graspable, graspable + spare_obstacles)
    names, obstacle_of = [body.name for body in robot.bodies.geometryObjects], [-1] * bodies
    clouds: dict[int, Voxels] = {}
    for number, obstacle in enumerate(obstacles):
        if number not in spare:
            check_name(obstacle, names, robot.name)
        start, shape = obstacle.motion.sample(0.0), obstacle.shape
        placement = pin.SE3(start.rotation, start.position)
        where, folder = f"obstacles: {obstacle.name!r}: shape", obstacle.source.parent
        solids = make_solids(shape, folder, where)
        if obstacle.graspable and not is_one_solid(shape, solids):
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
    if spare or any(isinstance(body.geometry, coal.Cylinder) for body in geometry.geometryObjects):
        for body in geometry.geometryObjects:
            body.geometry = without_sphere(body.geometry)
    pairs = pair_array(geometry)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]  # in the order in which bounding spheres are compared
    geometry.removeAllCollisionPairs()
    for a, b in pairs.tolist():
        geometry.addCollisionPair(pin.CollisionPair(a, b))
    joints = np.array([body.parentJoint for body in geometry.geometryObjects], dtype=np.intp)
    masks = support_masks(robot.model)
    return Scene(
        robot=robot,
        slots=obstacles,
        geometry=geometry,
        pairs=pairs,
        pair_names=tuple((names[a], names[b]) for a, b in pairs),
        support=masks[joints[pairs[:, 1]]] - masks[joints[pairs[:, 0]]],
        obstacle_of=np.array(obstacle_of, dtype=np.intp),
        movable=movable,
        spare=spare,
        clouds=clouds,
    )


def _spare(number: int) -> Obstacle:
    """Return what stands for an empty slot: no two of them touch, and nothing comes near."""
    place = still(Sample.at([PARKING_DISTANCE, float(number), 0.0]))
    return Obstacle("", config.Sphere(radius=_SPARE_RADIUS), place, moves=False, graspable=True)


def spare_solid() -> Any:
    """Return the coal geometry that stands for an empty slot."""
    return without_sphere(coal.Sphere(_SPARE_RADIUS))


def check_name(obstacle: Obstacle, names: Sequence[str], robot: str) -> None:
    """Check that an obstacle has a name that no body has.

    Raises:
        ConfigError: it has none, or one of `names`, of the bodies of the robot and of other obstacles.
    """
    if not isinstance(obstacle.name, str) or not obstacle.name:
        raise ConfigError(f"obstacles: {obstacle.name!r:.60}: give it a name")
    if obstacle.name in names:
        raise ConfigError(f"obstacles: {obstacle.name!r} is the name of a body of {robot}: rename it")


def is_one_solid(shape: config.ObstacleShape, solids: Sequence[Any]) -> bool:
    """Return whether a shape is one convex body of limited size, given its coal geometries."""
    convex = not isinstance(shape, config.HalfSpace | config.PointCloud) and not isinstance(
        solids[0], coal.BVHModelBase
    )
    return convex and len(solids) == 1


def without_sphere(solid: Any) -> Any:
    """Return a capsule of no length in place of a sphere, as where there are cylinders, or may come to be.

    coal 3.0 has a formula of its own for spheres and cylinders, which is wrong by centimetres once the centre of the
    sphere is inside; for capsules it iterates.
    """
    return coal.Capsule(solid.radius, 0.0) if isinstance(solid, coal.Sphere) else solid


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
