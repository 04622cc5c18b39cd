"""Obstacles that come and go at run time, in spare slots of the scene whose memory is laid out from the start.

A slot is one body, with pairs to all others; those of an empty one are disabled. What is in it changes numbers in
arrays, and no shape of an array, so that nothing is compiled.
"""

from __future__ import annotations

from math import inf
from typing import Any

import coal
import numpy as np

from qpavoid import kernels
from qpavoid.control.attach import Attachments
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.inputs import FAULTS
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.errors import ConfigError, NumericalError
from qpavoid.kernels.obstacles import FARTHEST, FASTEST, NORMALISED, SAMPLE
from qpavoid.model.scene import Obstacle, Scene, check_name, is_one_solid, spare_solid, without_sphere
from qpavoid.model.solids import make_solids


class ObstacleSlots:
    """Adds obstacles to the scene of one controller, and removes them."""

    def __init__(self, scene: Scene, query: DistanceQuery, tracker: ObstacleTracker, attachments: Attachments) -> None:
        """Take over who knows obstacles: the scene, distances of the control step, their states, what is attached."""
        self._scene, self._query, self._tracker, self._attachments = scene, query, tracker, attachments

    def add(self, obstacle: Obstacle) -> None:
        """Add an obstacle; see `Controller.add_obstacle`."""
        scene = self._scene
        if not isinstance(obstacle, Obstacle):
            raise ConfigError(f"add_obstacle: {obstacle!r:.60}: give an `Obstacle.at(name, shape, position)`")
        if obstacle.name in scene.obstacle_names:
            raise ConfigError(f"add_obstacle: there is an obstacle {obstacle.name!r}: remove it first, or rename one")
        check_name(obstacle, scene.body_names, scene.robot.name)
        empty = [i for i in scene.spare if not scene.slots[i].name]
        if not empty:
            raise ConfigError(
                f"add_obstacle: {obstacle.name!r}: all {len(scene.spare)} spare slots are taken; remove an obstacle, "
                "or give `build_scene` more `spare_obstacles`"
            )
        solid = _solid(obstacle)
        _check_state(obstacle, self._tracker.now)
        self._put(empty[0], obstacle, solid)

    def remove(self, index: int) -> None:
        """Remove obstacle number `index`; see `Controller.remove_obstacle`."""
        name = self._scene.slots[index].name
        if index not in self._scene.spare:
            raise ConfigError(
                f"remove_obstacle: {name!r} was built into the scene; leave it out there, and add it by `add_obstacle`"
            )
        if index in self._query.table.attached:
            raise ConfigError(f"remove_obstacle: {name!r} is attached to the robot; release it first")
        self._put(index, None, spare_solid())

    def take_over(self, scene: Scene) -> None:
        """Put what is in the slots of another scene into the same slots, which are empty."""
        for index in scene.spare:
            if scene.slots[index].name:
                self._put(index, scene.slots[index], _solid(scene.slots[index]))

    def _put(self, index: int, obstacle: Obstacle | None, solid: Any) -> None:
        """Change what is in a slot, everywhere."""
        name = self._scene.slots[index].name
        self._scene.put(index, obstacle, solid)
        self._query.table.put(index, solid, is_empty=obstacle is None)
        self._tracker.put(index, name, obstacle is not None)
        self._attachments.forget(index)
        self._query.place(self._tracker.current)


def _solid(obstacle: Obstacle) -> Any:
    """Return the coal geometry of an obstacle.

    Raises:
        ConfigError: it has none, or several, or an endless one.
    """
    where = f"obstacles: {obstacle.name!r}: shape"
    solids = make_solids(obstacle.shape, obstacle.source.parent, where)
    if not isinstance(solids[0], coal.CollisionGeometry):
        raise ConfigError(f"{where}: {obstacle.shape!r:.60}; give a shape of `qpavoid.config`, as Sphere(radius=0.05)")
    if not is_one_solid(obstacle.shape, solids):
        raise ConfigError(
            f"{where}: a {obstacle.shape.type} cannot be added at run time; give it to `build_scene`, or give a "
            "primitive or a mesh with `method: convex`"
        )
    return without_sphere(solids[0])


def _check_state(obstacle: Obstacle, t: float) -> None:
    """Check that an obstacle is somewhere at t [s].

    Raises:
        ConfigError: its pose or twist cannot be true, or what it may be off.
    """
    try:
        state = obstacle.motion.sample(t).row[None].copy()
    except NumericalError as error:
        raise ConfigError(f"obstacles: {obstacle.name!r}: motion: {error}") from None
    code = int(kernels.check_states(state, np.array([0]), np.array([SAMPLE]), FARTHEST, FASTEST)[0][0])
    if code > NORMALISED:
        raise ConfigError(f"obstacles: {obstacle.name!r}: motion: {FAULTS[code]}; give a pose in metres")
    if not 0.0 <= obstacle.uncertainty < inf:
        raise ConfigError(f"obstacles: {obstacle.name!r}: uncertainty: {obstacle.uncertainty} m, expected 0 or more")
