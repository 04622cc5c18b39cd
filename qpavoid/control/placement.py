"""Obstacles where they are now, and what their motion means for distances: arrays in, arrays out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid import kernels
from qpavoid.control.trajectories import STATE, as_samples, put
from qpavoid.errors import NumericalError
from qpavoid.model.scene import Scene
from qpavoid.model.trajectory import Sample
from qpavoid.model.views import read_poses, view_poses
from qpavoid.problem import Array, IntArray

_FARTHEST_STOP = 1.0
"""How far the robot may go before it stands, where a half-space that turns is concerned [m]."""


class ObstaclePlacement:
    """Moves the obstacles of a scene about, in the geometry model of its distances."""

    def __init__(self, scene: Scene, bodies: Any, poses: Array, spheres: Array) -> None:
        """Lays the memory out: all obstacles rest where they are at time 0.

        Args:
            scene: robot and obstacles.
            bodies: geometry objects of the g bodies, to be placed.
            poses: world poses of the bodies in some tick, rotation by columns and translation (g, 12).
            spheres: bounding sphere of each body in its own frame, centre and radius (g, 4) [m].
        """
        self._bodies, self._poses, self._spheres, self._movable = bodies, poses, spheres, scene.movable
        self._names, count, joints = scene.obstacle_names, len(scene.obstacles), scene.robot.model.njoints
        loads = self._movable - len(scene.body_names)
        self.twists = np.zeros((count + 1 + loads, 6))
        """(o + 1 + c, 6) of the obstacles at the world's origin; row o stays zero: for the robot and its loads.
        The last c are those of the obstacles that can be carried, negative: for pairs of which they come first."""
        self.margin = np.zeros(len(self.twists))
        """(o + 1 + c,) to be taken off the distances to each obstacle, in the same order [m]."""
        self.speeds = np.zeros(joints + count)
        """(njoints + o,) largest speed of any point that a joint carries, or of an obstacle [m/s]; here, the latter."""
        self.moving = False
        """Whether any obstacle has a velocity or a margin."""
        self.states = np.zeros((count, STATE))
        """(o, 18) see `courses`; of one that is carried, in the axes of its joint."""
        self.samples = as_samples(self.states)
        """Views of the states."""
        for view, obstacle in zip(self.samples, scene.obstacles, strict=True):
            put(view, obstacle.motion.sample(0.0))
        self._first: IntArray = np.searchsorted(scene.obstacle_of, np.arange(count))
        self._pieces: IntArray = np.bincount(scene.obstacle_of[len(scene.body_names) :], minlength=count)
        self._pieces[list(scene.clouds)] = 0  # their balls are placed by every call for distances
        placements = view_poses([body.placement for body in bodies], writeable=True)
        self.copies = placements is None
        """Whether coal's placements cannot be viewed as an array."""
        farthest = np.linalg.norm(spheres[:, :3], axis=1) + spheres[:, 3]
        reach = np.zeros(count)
        np.maximum.at(reach, scene.obstacle_of[len(scene.body_names) :], farthest[len(scene.body_names) :])
        self.reach = reach
        """(o,) distance from each obstacle's origin to its farthest point; infinite of a half-space [m]."""
        self._planes = np.flatnonzero(np.isinf(reach)).tolist()
        self._memory = kernels.ObstacleArrays(
            states=self.states,
            twists=self.twists,
            margin=self.margin,
            speeds=self.speeds[joints:],
            bounding_radius=np.nan_to_num(reach, posinf=0.0),
            placements=read_poses([body.placement for body in bodies]) if placements is None else placements,
            local=spheres[:, :3].copy(),
            centers=np.ones((len(bodies), 5)),
        )
        for center, body, (*local, _) in zip(self._memory.centers, bodies, spheres.tolist(), strict=True):
            center[:3] = body.placement.rotation @ local + body.placement.translation
            center[4] = -(center[:3] @ center[:3])
        self.centers = self._memory.centers
        """(g, 5) centres of the bodies' bounding spheres in the world, as rows [c, 1, -|c|²] [m]; of bodies that joints
        carry, in the axes of their joint."""
        self._all = [np.array([i]) for i in range(count)]
        self._given, self._margins = np.zeros_like(self.states), np.zeros(count)
        self._views = as_samples(self._given)
        self._which: IntArray | None = None
        self.place(np.zeros(0, dtype=np.intp), self.states, self.margin)  # no tick waits for the compiler

    def place(self, which: IntArray, states: Array, margin: Array) -> None:
        """Moves some obstacles, in one go.

        Args:
            which: their numbers (k,), of none that is carried; quickest if it is the same array as the time before.
            states: of all obstacles; read where `which` says (o, 18).
            margin: to be taken off the distances to each obstacle (o,) [m].

        Raises:
            NumericalError: NaN or infinity; names the obstacle. All stay where they were.
        """
        if which is not self._which:
            self._which, count = which, self._pieces[which]
            self._owners = np.repeat(np.arange(len(which)), count)
            before = np.cumsum(count) - count
            self._geometries = (self._first[which] - before)[self._owners] + np.arange(len(self._owners))
        for i in self._planes:
            self._memory.bounding_radius[i] = self._reach_of_plane(states[i]) if states[i, 15:].any() else 0.0
        bad, moving = kernels.place_obstacles(self._memory, which, self._geometries, self._owners, states, margin)
        if bad >= 0:
            raise NumericalError(f"obstacle {self._names[bad]!r}: NaN or infinity in its pose or twist")
        self.moving = moving
        if self.copies:
            for g in self._geometries.tolist():
                pose = self._memory.placements[g]
                self._bodies[g].placement = pin.SE3(pose[:9].reshape(3, 3).T, pose[9:])

    def place_one(self, index: int, sample: Sample, margin: float) -> None:
        """`place` of obstacle number `index`, at a sample and with a margin [m]."""
        put(self._views[index], sample)
        self._margins[index] = margin
        self.place(self._all[index], self._given, self._margins)

    def reaches(self, index: int, reach: float) -> None:
        """Takes another distance from an obstacle's origin to its farthest point [m]."""
        self._memory.bounding_radius[index] = self.reach[index] = reach

    def _reach_of_plane(self, state: Array) -> float:
        """Distance from a half-space's origin to what the robot reaches, and may come to before it stands [m]."""
        away = np.linalg.norm(self._poses[: self._movable, 9:] - state[9:12], axis=1)
        return float(np.max(away + self._spheres[: self._movable, 3])) + _FARTHEST_STOP
